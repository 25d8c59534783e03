"""What happens to nodes and links by plan: what each fault means at a step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from zfusion.model.network import Edge
from zfusion.model.scenario import Scenario
from zfusion.model.schema.faults import (
    AnyFault,
    ClockFault,
    CutFault,
    KillFault,
    PartitionFault,
    SlowFault,
    StopFault,
)
from zfusion.model.schema.run import NANOSECONDS
from zfusion.model.types import NodeId

BEGINS, ENDS = "begins", "ends"
"""The phases of a fault that are told."""


class Kill(NamedTuple):
    """A node dies when it is to begin `step`; it is to live again from step `restart` on, None: never."""

    step: int
    restart: int | None


class Stop(NamedTuple):
    """A node stands still from the step `first` on, when it is to begin it, until the step `end` is due."""

    first: int
    end: int


@dataclass(frozen=True, slots=True)
class Planned:
    """A fault, when it is, and how it is told."""

    fault: AnyFault
    first: int
    end: int | None
    """The first step that it does not concern any more; None: it lasts to the end."""
    told: Mapping[str, Any]
    """As plain data: what the scenario says."""

    def at(self, step: int) -> bool:
        """Whether it is on at a step."""
        return self.first <= step and (self.end is None or step < self.end)


class Timeline:
    """The faults of a scenario, by node, by edge and by step."""

    def __init__(self, scenario: Scenario) -> None:
        period = scenario.timing.period_ns
        self.planned = tuple(
            Planned(fault, *fault.span(period), told=fault.model_dump(mode="json", by_alias=True, exclude_none=True))
            for fault in scenario.faults
        )
        """All faults, in the order of the scenario."""
        self._by_node: dict[NodeId, list[Planned]] = {i: [] for i in scenario.ids}
        self._told_by: dict[NodeId, list[Planned]] = {i: [] for i in scenario.ids}
        """By node: the faults that concern it, those of its in-edges among them."""
        for planned in self.planned:
            fault = planned.fault
            if isinstance(fault, CutFault | PartitionFault):
                for i in scenario.ids:
                    if any(fault.cuts((j, i)) for j in scenario.network.neighbours(i) if j != i):
                        self._told_by[i].append(planned)
            else:
                self._by_node[fault.node].append(planned)
                self._told_by[fault.node].append(planned)

    def __bool__(self) -> bool:
        return bool(self.planned)

    def beyond(self, last: int) -> list[int]:
        """The faults, by their place in the scenario, that begin after the last step: nobody will see them."""
        return [n for n, planned in enumerate(self.planned) if planned.first > last]

    def kills(self, node: NodeId) -> tuple[Kill, ...]:
        """When the node dies, ascending."""
        kills = (Kill(p.first, p.end) for p in self._by_node[node] if isinstance(p.fault, KillFault))
        return tuple(sorted(kills, key=lambda kill: kill.step))

    def stops(self, node: NodeId) -> tuple[Stop, ...]:
        """When the node stands still, ascending."""
        stops = ((p.first, p.end) for p in self._by_node[node] if isinstance(p.fault, StopFault))
        return tuple(sorted(Stop(first, end) for first, end in stops if end is not None))

    def dead(self, node: NodeId, step: int) -> bool:
        """Whether the node is dead at a step."""
        return any(p.at(step) for p in self._by_node[node] if isinstance(p.fault, KillFault))

    def slow_ns(self, node: NodeId, step: int) -> int:
        """How much longer the node takes before it publishes a stage of this step."""
        delays = (p.fault.delay_s for p in self._by_node[node] if isinstance(p.fault, SlowFault) and p.at(step))
        return round(NANOSECONDS * sum(delays))

    def clock_ns(self, node: NodeId, step: int) -> int:
        """How far the node's clock is ahead at a step; negative: behind."""
        offsets = (p.fault.offset_s for p in self._by_node[node] if isinstance(p.fault, ClockFault) and p.at(step))
        return round(NANOSECONDS * sum(offsets))

    def cut(self, edge: Edge, step: int) -> bool:
        """Whether the link carries nothing at a step."""
        return any(planned.at(step) for planned in self.cuts(edge))

    def cuts(self, edge: Edge) -> tuple[Planned, ...]:
        """The cuts and partitions that the edge is concerned by."""
        return tuple(p for p in self.planned if isinstance(p.fault, CutFault | PartitionFault) and p.fault.cuts(edge))

    def events(self, node: NodeId, step: int, since: int | None = None) -> list[dict[str, Any]]:
        """What begins and ends for a node at the steps from `since` (by default `step` alone) to `step`, in order.

        Each is the data of an event of kind "fault": the fault as the scenario has it, its phase, and the step. Those
        of a link are told by its receiver.
        """
        first = step if since is None else since
        found = [
            (at, order, phase, planned.told)
            for planned in self._told_by[node]
            for at, order, phase in _phases(planned)
            if first <= at <= step
        ]
        found.sort(key=lambda event: event[:2])
        return [{"fault": dict(told), "phase": phase, "step": at} for at, _, phase, told in found]

    def told_before(self, node: NodeId, born: int) -> int:
        """The last step up to which earlier lives have told their faults, for a life that begins at `born`."""
        return max((kill.step for kill in self.kills(node) if kill.step < born), default=0)


def _phases(planned: Planned) -> Iterable[tuple[int, int, str]]:
    """(step, order among those of one step, phase): what ends goes before what begins."""
    yield planned.first, 1, BEGINS
    if planned.end is not None:
        yield planned.end, 0, ENDS
