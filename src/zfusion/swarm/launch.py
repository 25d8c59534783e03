"""Launch a swarm on this machine: a process for every node and one for the recorder, watched until all have ended.

Nothing is left running whatever happens: every child holds one end of a line and stops when the launcher is gone.
"""

from __future__ import annotations

import selectors
import signal
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zfusion.drivers.clocks import Clock
from zfusion.drivers.designs import with_design
from zfusion.drivers.endpoints import links_of
from zfusion.drivers.meeting import connected
from zfusion.drivers.metrics import NodeReport, RecorderReport
from zfusion.drivers.registry import registered
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.swarm.child import Child, bereft, latecomers
from zfusion.swarm.fallen import TICK_S, Fallen
from zfusion.swarm.processes import processes
from zfusion.swarm.standstill import STANDSTILL_S, Standstill

STOP_S = 15.0
"""How long a process that was told to stop may take: a node waits some seconds for its neighbours to hear it out."""

MAX_RESTARTS = 10
"""Lives that `restart` gives a node beyond the first; one that keeps dying has a cause that more lives do not mend."""

DESIGN = "design.npz"
"""Among the logs: what all nodes share, where the method is designed off-line and the scenario names no file."""


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
        self._part_of = {i: connected(i, links) for i in scenario.ids}
        """Those that a node waits for, or is waited for by: whom it is connected with, itself included."""
        self._paced = scenario.timing.period_ns is not None
        self._dismissed: set[str] = set()
        """Nodes that were told to end before they had begun."""
        self._begun = False
        """Whether the swarm was seen to run."""
        file = options.logs / "scenario.toml"
        try:
            options.logs.mkdir(parents=True, exist_ok=True)
            self._scenario = with_design(scenario, options.logs / DESIGN)
            file.write_text(self._scenario.anchored().to_toml())
        except OSError as error:
            raise InputError(f"{options.logs}: cannot be written: {error.strerror}") from None
        self._processes = processes(
            self._scenario,
            file,
            run=options.run,
            logs=options.logs,
            recording=options.recording,
            netns=options.netns,
            health_s=options.health_s,
        )
        self._network, self._recorder = self._processes.network, self._processes.recorder
        self._nodes = self._processes.nodes
        self._fallen = Fallen(self._nodes, self._part_of, self._paced)

    def run(self) -> RunResult:
        """Start all, watch until all nodes have ended, finish the recording.

        InputError, with the words of the process that said it, where a node or the recorder refuses to start.
        """
        began = time.monotonic()
        try:
            if self._network is None or self._has_come_up(self._network):
                for child in self._processes.everybody:
                    if child is not self._network:
                        self._start(child)
            with registered(self._processes.entry()):
                self._watch_nodes()
            self._kill(self._nodes.values())
            self._finish(self._recorder)
            self._finish(self._network)
            self._note_unrecorded()
        finally:
            self._kill(self._processes.everybody)
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

    def _start(self, child: Child, first_step: int | None = None) -> None:
        entrance: Sequence[str] = ()
        if self._network is not None and child is not self._network:
            entrance = self._network.status["enter"][child.place]
        where = self._where_it_was(child) if first_step is None else ("--first-step", str(first_step))
        line = child.start(entrance, where)
        child.first_step = first_step
        self._selector.register(line.socket, selectors.EVENT_READ, child)

    def _where_it_was(self, child: Child) -> Sequence[str]:
        """What has a node of paced steps, started again, go on with the one that is due where no other can tell it."""
        if child.node is None or len(self._part_of[child.node]) > 1 or child.epoch_ns is None or not self._paced:
            return ()
        epoch_s = self._clock.on_machine(child.epoch_ns) / 1e9
        return "--epoch", datetime.fromtimestamp(epoch_s, UTC).isoformat()

    def _watch_nodes(self) -> None:
        """Until every node's process has ended for good, or will not."""
        while self._goes_on():
            self._look_after_all()
            self._give_up_stopped()
            self._help_who_finds_nobody()
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

    def _goes_on(self) -> bool:
        """Whether a node's process runs; or all that are connected were felled by plan, and return before the end."""
        if any(child.running for child in self._nodes.values()):
            return True
        return self._stop_by is None and self._fallen.returns(self._scenario.steps)

    def _help_who_finds_nobody(self) -> None:
        """Have nodes end, or begin together, that would wait for ever for those that they are to join."""
        if self._stop_by is not None:
            return  # they all end, wherever they are
        for part in set(self._part_of.values()):
            nodes = [self._nodes[i] for i in part]
            if left := bereft(nodes):
                self._reunite(left, min(child.epoch_ns for child in nodes if child.epoch_ns is not None))
                continue
            for child in latecomers(nodes):
                late = f"{child.name} had not begun when all others had ended"
                self._dismiss(child, "" if child.restarts else late)

    def _reunite(self, left: Sequence[Child], epoch_ns: int) -> None:
        """Have nodes go on together that all died at about the same time, where steps have times: else all is lost."""
        if not self._paced:
            for child in left:
                if child.first_step is None:
                    self._dismiss(child, f"{child.name} found nobody to join: all had died at about the same time")
            return
        for child in left:
            if not child.resumes and child.line is not None:
                child.resumes = True
                child.line.tell(epoch_ns=self._clock.on_machine(epoch_ns))

    def _dismiss(self, child: Child, failure: str) -> None:
        """Have a node end that has not begun; if that is a `failure`, say so, once."""
        if failure and child.name not in self._dismissed:
            self._dismissed.add(child.name)
            self._failures.append(failure)
        if child.line is not None:
            child.line.stop()

    def _give_up_stopped(self) -> None:
        """End processes that somebody has stopped, where the run can only wait for them, and has for too long."""
        awaited = self._nodes.values() if self._begun else self._processes.everybody
        running = {c.name: c for c in awaited if c.running and c.blow is None}
        processes = {name: c.process.pid for name, c in running.items() if c.process is not None}
        for name in self._standstill.overdue(processes, begun=self._begun):
            self._failures.append(
                f"{name} was stopped{running[name].at_step()} and not set going within {STANDSTILL_S:g} s: killed"
            )
            self._options.on_message(self._failures[-1])
            self._kill([running[name]])
            if not self._begun:
                self._stop_nodes()

    def _look_after_all(self) -> None:
        self._clock.look()
        for key, _ in self._selector.select(self._raise_fallen()):
            self._listen(key.data)
        for child in self._processes.everybody:
            if child.running and child.process is not None and child.process.poll() is not None:
                self._on_end(child, child.process.returncode)
        if self._options.on_update is not None:
            self._options.on_update(self._nodes, self._recorder)

    def _listen(self, child: Child) -> None:
        assert child.line is not None  # it was registered with its line
        for message in child.line.messages():
            if "status" in message:
                child.note_status(message["status"])
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
        child.note_cut_short()
        message = f"{child.name} died{child.at_step()}: {child.cause(code)}"
        restarting = self._may_restart(child)
        self._options.on_message(f"{message}{'; starting it again' if restarting else ''}\n{child.tail()}".rstrip())
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
        if self._stop_by is not None:
            return TICK_S
        raised, wait = self._fallen.due(self._clock.now())
        first_steps = [self._fallen.first_step(child, raised) for child in raised]
        for child, first_step in zip(raised, first_steps, strict=True):
            died, child.blow = not child.running, None
            if died:
                child.restarts += 1
                self._start(child, first_step)
            elif child.process is not None:
                child.process.send_signal(signal.SIGCONT)
        return wait

    def _may_restart(self, child: Child) -> bool:
        """Whether a node that died is to be started again; where it was, its neighbours tell it, or the time."""
        return (
            self._options.restart
            and child.node is not None
            and (self._paced or len(self._part_of[child.node]) > 1)
            and self._begun
            and self._stop_by is None
            and child.restarts < MAX_RESTARTS
        )

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
                child.note_cut_short()
                self._selector.unregister(child.line.socket)
                child.line.close()
