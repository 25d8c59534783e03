"""What a scenario plans to happen to a live node, done by the node to itself.

It dies or stands still when it is to begin a step: really, by the signals that do that to any process. Whoever started
it is told just before, for only others can raise it again: its launcher starts it anew, or sets it going.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from zfusion.errors import InputError
from zfusion.links import Timeline
from zfusion.model.scenario import Scenario
from zfusion.model.schema.faults import ClockFault
from zfusion.model.types import NodeId

LAST_WORDS_S = 0.02
"""From a node's last message to its planned death: what was put has left the process by then."""


@dataclass(frozen=True, slots=True)
class Blow:
    """What fells a node, and when it is to be raised again; `None` for both: never."""

    kind: str
    """kill or stop."""
    step: int
    until_step: int | None
    until_ns: int | None
    """When that step is due, on the machine's clock; None where steps have no times."""


class Misfortune:
    """The planned faults of one node of a live swarm."""

    def __init__(self, scenario: Scenario, node: NodeId, announce: Callable[[Blow], None] | None) -> None:
        """`announce` is told what happens, just before. InputError for a stop where nobody is told."""
        self.timeline = Timeline(scenario)
        self._node, self._announce = node, announce
        self._period_ns = scenario.timing.period_ns
        self._stops = list(self.timeline.stops(node))
        self._told: int | None = None
        self.clock_goes_wrong = any(
            isinstance(planned.fault, ClockFault) and planned.fault.node == node for planned in self.timeline.planned
        )
        if self._stops and announce is None:
            raise InputError(
                f"node {node}: the scenario stops it at step {self._stops[0].first}: only a launcher could set it going"
            )

    def __bool__(self) -> bool:
        return bool(self.timeline)

    def news(self, born: int, step: int) -> list[dict[str, Any]]:
        """The data of the events that tell what has begun and ended up to this step, and was not told before."""
        since = self.timeline.told_before(self._node, born) if self._told is None else self._told
        self._told = step
        return self.timeline.events(self._node, step, since + 1)

    def kills(self, born: int, step: int) -> bool:
        """Whether a life that began with step `born` ends when it is to begin this one."""
        return any(born <= kill.step <= step for kill in self.timeline.kills(self._node))

    def strike(self, born: int, step: int, epoch_ns: int) -> None:
        """Die, or stand still, if that is planned. `epoch_ns` is when step 0 was, on the machine's clock."""
        for kill in self.timeline.kills(self._node):
            if born <= kill.step <= step:
                self._say(Blow("kill", step, kill.restart, self._due(kill.restart, epoch_ns)))
                time.sleep(LAST_WORDS_S)
                os.kill(os.getpid(), signal.SIGKILL)
        while self._stops and self._stops[0].first <= step:
            stop = self._stops.pop(0)
            if stop.first >= born and stop.end > step:
                self._say(Blow("stop", step, stop.end, self._due(stop.end, epoch_ns)))
                os.kill(os.getpid(), signal.SIGSTOP)

    def clock_ns(self, step: int) -> int:
        """How far the node's clock is ahead at a step."""
        return self.timeline.clock_ns(self._node, step)

    def slow_s(self, step: int) -> float:
        """How much longer the node takes before it publishes a stage of this step, in seconds."""
        return self.timeline.slow_ns(self._node, step) / 1e9

    def _due(self, step: int | None, epoch_ns: int) -> int | None:
        return None if step is None or self._period_ns is None else epoch_ns + step * self._period_ns

    def _say(self, blow: Blow) -> None:
        if self._announce is not None:
            self._announce(blow)
