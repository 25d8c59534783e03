"""One process of a swarm, as its launcher has it: its command, its line, and what became of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from zfusion.drivers.metrics import NodeReport
from zfusion.drivers.workers import ONE_THREAD
from zfusion.model.types import NodeId
from zfusion.swarm.control import LauncherEnd

TAIL_LINES = 15
"""Last lines of a failed process's log that are shown."""

TAIL_BYTES = 65_536
"""Bytes from the end of a log in which those lines are looked for: logs may be long."""


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
    epoch_ns: int | None = None
    """When step 0 was, as it said first; None as long as it has not."""
    health: Mapping[str, Any] = field(default_factory=dict)
    """`drivers.health.health`, the last that it told."""
    reports: list[Mapping[str, Any]] = field(default_factory=list)
    told: bool = False
    """Whether it has reported on its present life."""
    error: str | None = None
    exit_code: int | None = None
    restarts: int = 0
    resumes: bool = False
    """Whether it was told, while it waited, to begin in the midst of the run; where steps have times."""
    first_step: int | None = None
    """With which step it was started to begin in the midst of the run, where they have none."""
    blow: Mapping[str, Any] | None = None
    """What has felled it by plan, as `misfortune.Blow`, until it is raised again."""

    @property
    def running(self) -> bool:
        """Whether its process has been started and not been seen to end."""
        return self.process is not None and self.exit_code is None

    def start(self, entrance: Sequence[str] = (), more: Sequence[str] = ()) -> LauncherEnd:
        """Start its process, or start it again, with `more` words after its command.

        `entrance` are those before it that have it run in its namespace.
        """
        line = self.line = LauncherEnd()
        number = line.child.fileno()
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*entrance, *self.command, *more, "--control-fd", str(number)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=[number],
                start_new_session=True,  # Ctrl-C is the launcher's to handle
                env={**os.environ, **ONE_THREAD},
            )
        line.child.close()
        if self.node is not None:
            _let_finish(self.process.pid)
        self.exit_code, self.error, self.status, self.health, self.told = None, None, {}, {}, False
        self.resumes = False
        return line

    def note_status(self, status: Mapping[str, Any]) -> None:
        """It has told how it is doing."""
        self.status = status
        if self.epoch_ns is None:
            self.epoch_ns = status.get("epoch_ns")

    def note_cut_short(self) -> None:
        """Take for a report what is known of a node's life that did not end by itself."""
        if self.node is not None and self.status and not self.told:
            self.reports.append(asdict(NodeReport.cut_short(self.node, self.status)))

    def at_step(self) -> str:
        """How far it was, in words; nothing where that is not known."""
        return f" at step {self.status['step']}" if self.status.get("step") else ""

    def cause(self, code: int) -> str:
        """Why it ended so, in words."""
        if self.error is not None:
            return self.error
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"

    def tail(self) -> str:
        """The last lines of its log."""
        with self.log.open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - TAIL_BYTES))
            lines = log.read().decode(errors="replace").splitlines()[-TAIL_LINES:]
        return "\n".join([f"  last lines of {self.log}:", *(f"    {line}" for line in lines)]) if lines else ""


def latecomers(nodes: Collection[Child]) -> list[Child]:
    """Of connected nodes, those that find nobody to join any more: all others have taken their steps and ended.

    They were started again; or the machine was so busy that the others were through before these had begun. One that is
    connected with nobody begins whenever it comes.
    """
    running = [child for child in nodes if child.running]
    if len(running) == len(nodes):
        return []
    again = all(child.restarts and child.status.get("phase") != "running" for child in running)
    return running if again or all(child.status.get("phase") == "joining" for child in running) else []


def bereft(nodes: Collection[Child]) -> list[Child]:
    """Of connected nodes, those that would wait for each other for ever, all having died at about the same time.

    Each was started again to join the others, and there are no others: nobody takes steps, or has come to their end.
    """
    running = [child for child in nodes if child.running]
    lost = all(child.restarts and child.status.get("phase", "joining") == "joining" for child in running)
    begun = any(child.epoch_ns is not None for child in nodes)
    return running if len(nodes) > 1 and begun and lost and not any(child.exit_code == 0 for child in nodes) else []


def _let_finish(pid: int) -> None:
    """Have a node not be interrupted by the others whenever they wake up, where there are more nodes than processors.

    (Linux's SCHED_BATCH: a sixth less CPU for a step of the four-sensor example on two processors.)
    """
    if sys.platform == "linux":
        with suppress(OSError):  # it is gone already, or we are not allowed to
            os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))
