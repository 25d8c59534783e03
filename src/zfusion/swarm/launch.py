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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Any

from zfusion.drivers.clocks import Clock
from zfusion.drivers.designs import with_design
from zfusion.drivers.endpoints import dialled, links_of
from zfusion.drivers.meeting import connected
from zfusion.drivers.metrics import NodeReport, RecorderReport
from zfusion.drivers.registry import Entry, registered
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.swarm.control import LauncherEnd
from zfusion.swarm.netns.addresses import places
from zfusion.swarm.standstill import STANDSTILL_S, Standstill, is_stopped

STOP_S = 15.0
"""How long a process that was told to stop may take: a node waits some seconds for its neighbours to hear it out."""

TICK_S = 0.1
"""How often processes are looked after when nothing is heard of them."""

BLINK_S = 0.002
"""How soon it is looked again whether a process that has said that it stops, or dies, has done so."""

MAX_RESTARTS = 10
"""Lives that `restart` gives a node beyond the first; one that keeps dying has a cause that more lives do not mend."""

TAIL_LINES = 15
"""Last lines of a failed process's log that are shown."""

TAIL_BYTES = 65_536
"""Bytes from the end of a log in which those lines are looked for: logs may be long."""

PORTS = range(20_000, 32_000)
"""Where free ports are looked for: below those that the system gives to whoever dials, who might get one of them
between our finding it free and the node's listening on it."""

BLOCK = 200
"""Ports that one process at a time takes from."""

DESIGN = "design.npz"
"""Among the logs: what all nodes share, where the method is designed off-line and the scenario names no file."""

ZFUSION = (sys.executable, "-m", "zfusion")

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""A node's matrices are small: threads of a BLAS only get into each other's way, and the other nodes'."""


@dataclass(slots=True)
class Child:
    """One process of the swarm."""

    name: str
    node: NodeId | None
    """None for the recorder and the network."""
    command: list[str]
    log: Path
    place: int = 0
    """Its number among the namespaces, where there are any."""
    process: subprocess.Popen[bytes] | None = None
    line: LauncherEnd | None = None
    status: Mapping[str, Any] = field(default_factory=dict)
    health: Mapping[str, Any] = field(default_factory=dict)
    """`drivers.health.health`, the last that it told."""
    reports: list[Mapping[str, Any]] = field(default_factory=list)
    told: bool = False
    """Whether it has reported on its present life."""
    error: str | None = None
    exit_code: int | None = None
    restarts: int = 0
    blow: Mapping[str, Any] | None = None
    """What has felled it by plan, as `misfortune.Blow`, until it is raised again."""

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
    network: Mapping[str, Any] | None = None
    """What the network between the namespaces was, and what it counted; None where there was none."""


@dataclass(frozen=True, slots=True)
class LaunchOptions:
    """What is not in the scenario."""

    run: str
    logs: Path
    recording: Path | None
    restart: bool = False
    netns: str | None = None
    """Have every node in a network namespace of its own, joined by "tun", "netem" or what of them is best: "auto"."""
    health_s: float = 0.0
    """How often every node tells of its health; 0: never."""
    on_update: Callable[[Mapping[NodeId, Child], Child | None], None] | None = None
    """Called about ten times a second with the nodes' processes and the recorder's."""
    on_message: Callable[[str], None] = lambda _: None
    """Called with what a person wants to know at once: a death, a restart."""


class Launcher:
    """One launch of a swarm."""

    def __init__(self, scenario: Scenario, options: LaunchOptions) -> None:
        """InputError where the logs cannot be written, or the method cannot be designed: it is here, for all nodes."""
        self._options = options
        self._selector = selectors.DefaultSelector()
        self._failures: list[str] = []
        self._interrupts = 0
        self._stop_by: float | None = None
        self._clock = Clock()
        self._clock.keep()
        self._standstill = Standstill()
        links = links_of(scenario)
        self._parts = {connected(i, links) for i in scenario.ids}
        """Nodes that wait for each other."""
        self._dismissed: set[str] = set()
        """Nodes that came too late."""
        self._begun = False
        """Whether the swarm was seen to run."""
        self._file = options.logs / "scenario.toml"
        try:
            options.logs.mkdir(parents=True, exist_ok=True)
            self._scenario = with_design(scenario, options.logs / DESIGN)
            self._file.write_text(self._scenario.anchored().to_toml())
        except OSError as error:
            raise InputError(f"{options.logs}: cannot be written: {error.strerror}") from None
        self._network = self._plan_network()
        self._recorder, self._nodes = self._plan()

    def run(self) -> RunResult:
        """Start all, watch until all nodes have ended, finish the recording.

        InputError, with the words of the process that said it, where a node or the recorder refuses to start.
        """
        began = time.monotonic()
        try:
            if self._network is None or self._has_come_up(self._network):
                for child in self._everybody():
                    if child is not self._network:
                        self._start(child)
            with registered(self._entry()):
                self._watch_nodes()
            self._kill(self._nodes.values())
            self._finish(self._recorder)
            self._finish(self._network)
            self._note_unrecorded()
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
            network=self._network_report(),
        )

    def interrupt(self) -> None:
        """Stop cleanly; called again, kill what has not stopped. For signal handlers: only leaves word."""
        self._interrupts += 1

    def _plan(self) -> tuple[Child | None, dict[NodeId, Child]]:
        scenario, options = self._scenario, self._options
        transport, common = scenario.transport, ["--run", options.run]
        listens, recorder_dials = self._endpoints()
        self._dials, self._recorder_listens = recorder_dials, ""
        nodes: dict[NodeId, Child] = {}
        for place, i in enumerate(scenario.ids):
            command = [*ZFUSION, "node", str(self._file), "--id", str(i), *common]
            if self._network is not None or not transport.zenoh_config:
                command += _each("--listen", dict.fromkeys((listens[i], recorder_dials[i])))
                command += _each("--connect", dialled(scenario, i, listens))
            if options.recording is not None:
                command.append("--await-recorder")
            if self._network is not None:
                command.append("--no-emulation")
            if options.health_s:
                command += ["--health", str(options.health_s)]
            nodes[i] = Child(f"node {i}", i, command, options.logs / f"node-{i}.log", place)
        recorder = None
        if options.recording is not None:
            command = [*ZFUSION, "record", str(self._file), *common, "-o", str(options.recording)]
            if self._network is not None or not transport.zenoh_config:
                command += _each("--connect", [recorder_dials[i] for i in scenario.ids])
                [self._recorder_listens] = free_endpoints(1)  # for observers: peers pass nothing on
                command += ["--listen", self._recorder_listens]
            recorder = Child("the recorder", None, command, options.logs / "recorder.log", len(scenario.ids))
        return recorder, nodes

    def _endpoints(self) -> tuple[Mapping[NodeId, str], Mapping[NodeId, str]]:
        """Where every node is dialled by the others, and where by the recorder."""
        ids = self._scenario.ids
        if self._network is not None:
            where = places(ids)
            return {p.node: p.endpoint for p in where}, {p.node: p.recorder_dials for p in where}
        listens = dict(zip(ids, free_endpoints(len(ids)), strict=True)) | self._scenario.transport.endpoints
        return listens, listens

    def _entry(self) -> Entry:
        """What observers on this machine need in order to look at the run."""
        transport, network = self._scenario.transport, self._network
        own = None if network is not None else transport.zenoh_config
        enter = network.status.get("enter", ()) if network is not None else ()
        return Entry(
            run=self._options.run,
            scenario=self._scenario.name,
            endpoints={str(i): endpoint for i, endpoint in self._dials.items()},
            recorder=self._recorder_listens if self._recorder is not None else None,
            low_latency=transport.preset == "lowlatency",
            config=str(self._scenario.absolute(own)) if own else None,
            enter=tuple(enter[len(self._scenario.ids)]) if enter else (),
        )

    def _plan_network(self) -> Child | None:
        options = self._options
        if options.netns is None:
            return None
        command = [*ZFUSION, "network", str(self._file), "--run", options.run]
        if options.netns != "auto":
            command += ["--kind", options.netns]
        return Child("the network", None, command, options.logs / "network.log")

    def _everybody(self) -> list[Child]:
        return [child for child in (self._network, self._recorder, *self._nodes.values()) if child is not None]

    def _has_come_up(self, network: Child) -> bool:
        """Start the network and wait until the namespaces are there; False where it ends, or is to end, before."""
        self._start(network)
        while network.running and not network.status and not self._interrupts:
            self._look_after_all()
            self._give_up_stopped()
        if self._interrupts:
            self._stop_nodes()
        elif network.status:
            kind = network.status["kind"]
            self._options.on_message(f"network namespaces: {kind} ({network.status['why']})")
            if self._recorder is not None:
                self._recorder.command += ["--network", kind]
        return network.running and not self._interrupts

    def _start(self, child: Child) -> None:
        line = child.line = LauncherEnd()
        number = line.child.fileno()
        with child.log.open("ab") as log:
            child.process = subprocess.Popen(
                [*self._entrance(child), *child.command, "--control-fd", str(number)],
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
        child.exit_code, child.error, child.status, child.health, child.told = None, None, {}, {}, False
        self._selector.register(line.socket, selectors.EVENT_READ, child)

    def _entrance(self, child: Child) -> Sequence[str]:
        """The words before its command that have it run in its namespace."""
        if self._network is None or child is self._network:
            return ()
        words: Sequence[str] = self._network.status["enter"][child.place]
        return words

    def _watch_nodes(self) -> None:
        """Until every node's process has ended for good, or will not."""
        while any(child.running for child in self._nodes.values()):
            self._look_after_all()
            self._give_up_stopped()
            self._dismiss_latecomers()
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

    def _dismiss_latecomers(self) -> None:
        for child in chain.from_iterable(latecomers([self._nodes[i] for i in part]) for part in self._parts):
            if not child.restarts and child.name not in self._dismissed:
                self._dismissed.add(child.name)
                self._failures.append(f"{child.name} had not begun when all others had ended")
            if child.line is not None:
                child.line.stop()

    def _give_up_stopped(self) -> None:
        """End processes that somebody has stopped, where the run can only wait for them, and has for too long."""
        awaited = self._nodes.values() if self._begun else self._everybody()
        running = {c.name: c for c in awaited if c.running and c.blow is None}
        processes = {name: c.process.pid for name, c in running.items() if c.process is not None}
        for name in self._standstill.overdue(processes, begun=self._begun):
            self._failures.append(
                f"{name} was stopped{_step(running[name])} and not set going within {STANDSTILL_S:g} s: killed"
            )
            self._options.on_message(self._failures[-1])
            self._kill([running[name]])
            if not self._begun:
                self._stop_nodes()

    def _look_after_all(self) -> None:
        self._clock.look()
        for key, _ in self._selector.select(self._raise_fallen()):
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
                self._note_beginning(child.status)
            elif "health" in message:
                child.health = message["health"]
            elif "blow" in message:
                self._note_blow(child, message["blow"])
                child.reports += [message["report"]] if message["report"] else []
            elif "report" in message:
                child.reports.append(message["report"])
                child.told = True
            elif "error" in message:
                child.error = message["error"]

    def _note_beginning(self, status: Mapping[str, Any]) -> None:
        if not self._begun and status.get("phase") in {"running", "done"}:
            self._begun = True
            if self._network is not None and self._network.line is not None:
                self._network.line.tell(epoch_ns=status["epoch_ns"])

    def _on_end(self, child: Child, code: int) -> None:
        self._listen(child)
        assert child.line is not None
        self._selector.unregister(child.line.socket)
        child.line.close()
        child.exit_code = code
        if code == 0 or (child.blow is not None and code == -signal.SIGKILL):
            return
        # Without its recorder a swarm is not recorded; without its network, or a node at the start, there is none.
        essential = child.node is None or not self._begun
        if essential and code == InputError.exit_code and child.error is not None:
            raise InputError(f"{child.name}: {child.error}")
        self._note_cut_short(child)
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
        if child is self._network:
            self._kill(self._nodes.values())  # they could only wait for each other
        if essential:
            self._stop_nodes()

    def _note_blow(self, child: Child, blow: Mapping[str, Any]) -> None:
        child.blow = blow
        until = f" until step {blow['until_step']}" if blow["until_step"] else ""
        done = {"kill": "killed", "stop": "stopped"}[blow["kind"]]
        self._options.on_message(f"{child.name} {done} at step {blow['step']}{until}, as planned")

    def _raise_fallen(self) -> float:
        """Start again, or set going, the nodes that were felled by plan and whose time has come.

        Seconds until the next one's may come.
        """
        wait = TICK_S
        for child in self._nodes.values():
            if child.blow is None or child.blow["until_step"] is None or self._stop_by is not None:
                continue
            left = self._left(child, child.blow)
            if left > 0:
                wait = min(wait, left)
            elif child.blow["kind"] == "kill" and not child.running:
                child.blow = None
                child.restarts += 1
                self._start(child)
            elif child.process is not None and is_stopped(child.process.pid) is not False:
                child.blow = None
                child.process.send_signal(signal.SIGCONT)
            else:
                wait = min(wait, BLINK_S)
        return wait

    def _left(self, child: Child, blow: Mapping[str, Any]) -> float:
        """Seconds until a felled node is to be raised; where steps have no times, at least until it is looked after."""
        if blow["until_ns"] is not None:
            left: float = (blow["until_ns"] - self._clock.now()) / 1e9
            return left
        others = [other for other in self._nodes.values() if other is not child and other.running]
        reached = any(other.status.get("step", 0) >= blow["until_step"] for other in others)
        return 0 if reached or (not others and blow["kind"] == "stop") else TICK_S

    def _note_cut_short(self, child: Child) -> None:
        """What is known of a node's life that did not end by itself."""
        if child.node is not None and child.status and not child.told:
            child.reports.append(asdict(NodeReport.cut_short(child.node, child.status)))

    def _may_restart(self, child: Child) -> bool:
        return (
            self._options.restart
            and child.node is not None
            and self._begun
            and self._stop_by is None
            and child.restarts < MAX_RESTARTS
        )

    def _tail(self, child: Child) -> str:
        with child.log.open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = log.read().decode(errors="replace").splitlines()[-TAIL_LINES:]
        return "\n".join([f"  last lines of {child.log}:", *(f"    {line}" for line in lines)]) if lines else ""

    def _stop_nodes(self) -> None:
        self._stop_by = self._stop_by or time.monotonic() + STOP_S
        if self._network is not None and self._network.line is not None:
            self._network.line.tell(epoch_ns=None)  # nothing is cut any more: they are to hear each other out
        for child in self._nodes.values():
            if child.running and child.line is not None:
                child.line.stop()
                if child.blow is not None and child.process is not None:
                    child.process.send_signal(signal.SIGCONT)

    def _finish(self, child: Child | None) -> None:
        """Have the recorder, or the network, end."""
        end = time.monotonic() + STOP_S
        if child is None or not child.running or child.line is None:
            return
        child.line.stop()
        while child.running and time.monotonic() < end:
            self._look_after_all()
        if child.running:
            self._failures.append(f"{child.name}: did not finish within {STOP_S:g} s and had to be killed")

    def _recorder_report(self) -> RecorderReport | None:
        if self._recorder is None or not self._recorder.reports:
            return None
        return RecorderReport(**self._recorder.reports[-1])

    def _note_unrecorded(self) -> None:
        """A swarm goes on without its recording, but it has not been recorded as it was to be."""
        report = self._recorder_report()
        if report is not None and report.stopped:
            self._failures.append(f"{report.stopped}: {report.unrecorded} messages are not on the recording")

    def _network_report(self) -> Mapping[str, Any] | None:
        """What it told at its end; of one that died before, what it was."""
        network = self._network
        if network is None or not network.status:
            return None
        return network.reports[-1] if network.reports else {name: network.status[name] for name in ("kind", "why")}

    def _kill(self, children: Collection[Child]) -> None:
        """End what has not ended yet."""
        for child in children:
            if child.running and child.process is not None and child.line is not None:
                child.process.kill()
                child.exit_code = child.process.wait()
                self._listen(child)
                self._note_cut_short(child)
                self._selector.unregister(child.line.socket)
                child.line.close()


def latecomers(nodes: Collection[Child]) -> list[Child]:
    """Of connected nodes, those that find nobody to join any more: all others have taken their steps and ended.

    They were started again; or the machine was so busy that the others were through before these had begun. One that is
    connected with nobody begins whenever it comes.
    """
    if len(nodes) == 1:
        return []
    running = [child for child in nodes if child.running]
    again = all(child.restarts and child.status.get("phase") != "running" for child in running)
    ended = len(running) < len(nodes) and all(child.status.get("phase") == "joining" for child in running)
    return running if again or ended else []


def free_endpoints(number: int) -> list[str]:
    """Endpoints on the loopback interface that nobody listens on now. InputError if there are not so many."""
    sockets: list[socket.socket] = []
    try:
        for _ in PORTS:
            if len(sockets) == number:
                break
            sockets.append(socket.socket())
            try:
                sockets[-1].bind(("127.0.0.1", next(_ports)))
            except OSError:
                sockets.pop().close()
        if len(sockets) < number:
            raise InputError(f"there are not {number} free ports between {PORTS.start} and {PORTS.stop}")
        return [f"tcp/127.0.0.1:{s.getsockname()[1]}" for s in sockets]
    finally:
        for s in sockets:
            s.close()


def _own_ports() -> Iterator[int]:
    """Ports, without end, of blocks that no other process takes ports from meanwhile.

    What is free for one launcher is free for another, too, until the node listens: both would give it away. So a
    block is his who holds its first port; one that somebody else holds is passed over, after a port that is not free.
    """
    blocks = [PORTS[first : first + BLOCK] for first in range(0, len(PORTS), BLOCK)]
    for n in count(os.getpid()):
        mark, *ports = blocks[n % len(blocks)]
        with socket.socket() as holder:
            try:
                holder.bind(("127.0.0.1", mark))
            except OSError:
                ports = [mark]
            yield from ports


_ports = _own_ports()


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
