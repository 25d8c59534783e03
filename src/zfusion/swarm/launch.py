"""Launch a swarm on this machine: a process for every node and one for the recorder, watched until all have ended.

Nothing is left running whatever happens: every child holds one end of a line and stops when the launcher is gone.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from zfusion.drivers.endpoints import dialled
from zfusion.drivers.metrics import NodeReport, RecorderReport
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.swarm.control import LauncherEnd

STOP_S = 15.0
"""How long a process that was told to stop may take: a node waits some seconds for its neighbours to hear it out."""

TICK_S = 0.1
"""How often processes are looked after when nothing is heard of them."""

MAX_RESTARTS = 10
"""Lives that `restart` gives a node beyond the first; one that keeps dying has a cause that more lives do not mend."""

TAIL_LINES = 15
"""Last lines of a failed process's log that are shown."""

PORTS = range(20_000, 32_000)
"""Where free ports are looked for: below those that the system gives to whoever dials, who might get one of them
between our finding it free and the node's listening on it."""

_tried = count(os.getpid() * 61)
"""Two launchers begin at different places."""

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""A node's matrices are small: threads of a BLAS only get into each other's way, and the other nodes'."""


@dataclass(slots=True)
class Child:
    """One process of the swarm."""

    name: str
    node: NodeId | None
    """None for the recorder."""
    command: list[str]
    log: Path
    process: subprocess.Popen[bytes] | None = None
    line: LauncherEnd | None = None
    status: Mapping[str, Any] = field(default_factory=dict)
    reports: list[Mapping[str, Any]] = field(default_factory=list)
    error: str | None = None
    exit_code: int | None = None
    restarts: int = 0

    @property
    def running(self) -> bool:
        """Whether its process has been started and not been seen to end."""
        return self.process is not None and self.exit_code is None


@dataclass(slots=True)
class RunResult:
    """How a run went."""

    run: str
    scenario: Scenario
    reports: dict[NodeId, list[NodeReport]]
    """A report for every life of a node that ended by itself."""
    recorder: RecorderReport | None
    failures: list[str]
    """What went wrong, in words; empty where nothing did."""
    interrupted: bool
    """Stopped before its end."""
    elapsed_s: float
    logs: Path


@dataclass(frozen=True, slots=True)
class LaunchOptions:
    """What is not in the scenario."""

    run: str
    logs: Path
    recording: Path | None
    restart: bool = False
    on_update: Callable[[Mapping[NodeId, Child], Child | None], None] | None = None
    """Called about ten times a second with the nodes' processes and the recorder's."""
    on_message: Callable[[str], None] = lambda _: None
    """Called with what a person wants to know at once: a death, a restart."""


class Launcher:
    """One launch of a swarm."""

    def __init__(self, scenario: Scenario, options: LaunchOptions) -> None:
        """InputError where the logs cannot be written."""
        self._scenario, self._options = scenario, options
        self._selector = selectors.DefaultSelector()
        self._failures: list[str] = []
        self._interrupts = 0
        self._stop_by: float | None = None
        self._begun = False
        """Whether the swarm was seen to run."""
        self._file = options.logs / "scenario.toml"
        try:
            options.logs.mkdir(parents=True, exist_ok=True)
            self._file.write_text(scenario.anchored().to_toml())
        except OSError as error:
            raise InputError(f"{options.logs}: cannot be written: {error.strerror}") from None
        self._recorder, self._nodes = self._plan()

    def run(self) -> RunResult:
        """Start all, watch until all nodes have ended, finish the recording.

        InputError, with the words of the process that said it, where a node or the recorder refuses to start.
        """
        began = time.monotonic()
        try:
            for child in self._everybody():
                self._start(child)
            self._watch_nodes()
            self._kill(self._nodes.values())
            self._finish_recording()
        finally:
            self._kill(self._everybody())
            self._selector.close()
        return RunResult(
            run=self._options.run,
            scenario=self._scenario,
            reports={node: [NodeReport(**r) for r in child.reports] for node, child in self._nodes.items()},
            recorder=self._recorder_report(),
            failures=self._failures,
            interrupted=self._stop_by is not None,
            elapsed_s=time.monotonic() - began,
            logs=self._options.logs,
        )

    def interrupt(self) -> None:
        """Stop cleanly; called again, kill what has not stopped. For signal handlers: only leaves word."""
        self._interrupts += 1

    def _plan(self) -> tuple[Child | None, dict[NodeId, Child]]:
        scenario, options = self._scenario, self._options
        transport, common = scenario.transport, ["--run", options.run]
        listens = dict(zip(scenario.ids, free_endpoints(len(scenario.ids)), strict=True)) | transport.endpoints
        base = [sys.executable, "-m", "zfusion"]
        nodes: dict[NodeId, Child] = {}
        for i in scenario.ids:
            command = [*base, "node", str(self._file), "--id", str(i), *common]
            if not transport.zenoh_config:
                command += ["--listen", listens[i], *_each("--connect", dialled(scenario, i, listens))]
            if options.recording is not None:
                command.append("--await-recorder")
            nodes[i] = Child(f"node {i}", i, command, options.logs / f"node-{i}.log")
        recorder = None
        if options.recording is not None:
            command = [*base, "record", str(self._file), *common, "-o", str(options.recording)]
            if not transport.zenoh_config:
                command += _each("--connect", [listens[i] for i in scenario.ids])
            recorder = Child("the recorder", None, command, options.logs / "recorder.log")
        return recorder, nodes

    def _everybody(self) -> list[Child]:
        return [child for child in (self._recorder, *self._nodes.values()) if child is not None]

    def _start(self, child: Child) -> None:
        line = child.line = LauncherEnd()
        number = line.child.fileno()
        with child.log.open("ab") as log:
            child.process = subprocess.Popen(
                [*child.command, "--control-fd", str(number)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=[number],
                start_new_session=True,  # Ctrl-C is the launcher's to handle
                env={**os.environ, **ONE_THREAD},
            )
        line.child.close()
        if child.node is not None:
            _let_finish(child.process.pid)
        child.exit_code, child.error, child.status = None, None, {}
        self._selector.register(line.socket, selectors.EVENT_READ, child)

    def _watch_nodes(self) -> None:
        """Until every node's process has ended for good, or will not."""
        while any(child.running for child in self._nodes.values()):
            self._look_after_all()
            if self._interrupts and self._stop_by is None:
                self._options.on_message("stopping (once more kills)")
                self._stop_nodes()
            if self._interrupts > 1:
                self._failures.append("killed before it had stopped")
                return
            if self._stop_by is not None and time.monotonic() > self._stop_by:
                stuck = [child.name for child in self._nodes.values() if child.running]
                self._failures.append(f"{', '.join(stuck)}: did not stop within {STOP_S:g} s and had to be killed")
                return

    def _look_after_all(self) -> None:
        for key, _ in self._selector.select(TICK_S):
            self._listen(key.data)
        for child in self._everybody():
            if child.running and child.process is not None and child.process.poll() is not None:
                self._on_end(child, child.process.returncode)
        if self._options.on_update is not None:
            self._options.on_update(self._nodes, self._recorder)

    def _listen(self, child: Child) -> None:
        assert child.line is not None  # it was registered with its line
        for message in child.line.messages():
            if "status" in message:
                child.status = message["status"]
                self._begun |= child.status.get("phase") in {"running", "done"}
            elif "report" in message:
                child.reports.append(message["report"])
            elif "error" in message:
                child.error = message["error"]

    def _on_end(self, child: Child, code: int) -> None:
        self._listen(child)
        assert child.line is not None
        self._selector.unregister(child.line.socket)
        child.line.close()
        child.exit_code = code
        if code == 0:
            return
        if child.node is not None and child.status:
            child.reports.append(asdict(NodeReport.cut_short(child.node, child.status)))
        message = f"{child.name} died{_step(child)}: {_cause(child, code)}"
        restarting = self._may_restart(child)
        self._options.on_message(
            f"{message}{'; starting it again' if restarting else ''}\n{self._tail(child)}".rstrip()
        )
        if restarting:
            child.restarts += 1
            self._start(child)
            return
        self._failures.append(message)
        if child.node is None or not self._begun:
            self._stop_nodes()  # a swarm without its recorder is not recorded; one without this node never begins
            if code == InputError.exit_code and child.error is not None:
                raise InputError(f"{child.name}: {child.error}")

    def _may_restart(self, child: Child) -> bool:
        return (
            self._options.restart
            and child.node is not None
            and self._begun
            and self._stop_by is None
            and child.restarts < MAX_RESTARTS
        )

    def _tail(self, child: Child) -> str:
        lines = child.log.read_text(errors="replace").splitlines()[-TAIL_LINES:]
        return "\n".join([f"  last lines of {child.log}:", *(f"    {line}" for line in lines)]) if lines else ""

    def _stop_nodes(self) -> None:
        self._stop_by = self._stop_by or time.monotonic() + STOP_S
        for child in self._nodes.values():
            if child.running and child.line is not None:
                child.line.stop()

    def _finish_recording(self) -> None:
        child, end = self._recorder, time.monotonic() + STOP_S
        if child is None or not child.running or child.line is None:
            return
        child.line.stop()
        while child.running and time.monotonic() < end:
            self._look_after_all()
        if child.running:
            self._failures.append(f"the recorder: did not finish within {STOP_S:g} s and had to be killed")

    def _recorder_report(self) -> RecorderReport | None:
        if self._recorder is None or not self._recorder.reports:
            return None
        return RecorderReport(**self._recorder.reports[-1])

    def _kill(self, children: Collection[Child]) -> None:
        """End what has not ended yet."""
        for child in children:
            if child.running and child.process is not None and child.line is not None:
                child.process.kill()
                child.exit_code = child.process.wait()
                self._selector.unregister(child.line.socket)
                child.line.close()


def free_endpoints(number: int) -> list[str]:
    """Endpoints on the loopback interface that nobody listens on now. InputError if there are not so many."""
    sockets: list[socket.socket] = []
    try:
        for _ in PORTS:
            if len(sockets) == number:
                break
            sockets.append(socket.socket())
            try:
                sockets[-1].bind(("127.0.0.1", PORTS[next(_tried) % len(PORTS)]))
            except OSError:
                sockets.pop().close()
        if len(sockets) < number:
            raise InputError(f"there are not {number} free ports between {PORTS.start} and {PORTS.stop}")
        return [f"tcp/127.0.0.1:{s.getsockname()[1]}" for s in sockets]
    finally:
        for s in sockets:
            s.close()


def _let_finish(pid: int) -> None:
    """Have a node not be interrupted by the others whenever they wake up, where there are more nodes than processors.

    (Linux's SCHED_BATCH: a sixth less CPU for a step of the four-sensor example on two processors.)
    """
    if sys.platform == "linux":
        with suppress(OSError):  # it is gone already, or we are not allowed to
            os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))


def _each(option: str, values: Collection[str]) -> list[str]:
    return [word for value in values for word in (option, value)]


def _step(child: Child) -> str:
    return f" at step {child.status['step']}" if child.status.get("step") else ""


def _cause(child: Child, code: int) -> str:
    if child.error is not None:
        return child.error
    return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
