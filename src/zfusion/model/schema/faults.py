"""The pieces of a scenario that say what happens to nodes and links by plan: the timeline of faults.

Times are seconds, and steps are those of the node concerned. What a fault means at a step is the business of
`zfusion.links.timeline`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from zfusion.errors import Problem
from zfusion.model.network import Edge, Network
from zfusion.model.schema.base import Count, Id, Number, Positive, Spec
from zfusion.model.schema.links import Ids, LinksSpec, Nested, Seconds, between, end_problems
from zfusion.model.schema.run import NANOSECONDS
from zfusion.model.types import NodeId


class FaultSpec(Spec):
    """Something that happens to a node or a link from a step on: from `step`, or the first that is due at `at_s`."""

    TAG = "kind"

    step: Count | None = None
    at_s: Seconds | None = None
    """Seconds after step 0."""

    @model_validator(mode="after")
    def _check_beginning(self) -> Self:
        if (self.step is None) == (self.at_s is None):
            raise ValueError("expected either step or at_s")
        return self

    def span(self, period_ns: int | None) -> tuple[int, int | None]:
        """(first step concerned, first step no longer concerned; None: to the end)."""
        if self.step is not None:
            return self.step, None
        assert self.at_s is not None  # one of the two is given
        return max(1, _steps(self.at_s, period_ns)), None

    @property
    def in_seconds(self) -> tuple[str, ...]:
        """The fields by which it is timed in seconds."""
        return tuple(name for name in ("at_s", "for_s") if getattr(self, name, None) is not None)


def _steps(seconds: float, period_ns: int | None) -> int:
    """How many steps it takes until so many seconds have passed; ValueError where steps have no times."""
    if period_ns is None:
        raise ValueError("free-running steps have no times")
    return -(-round(seconds * NANOSECONDS) // period_ns)


class LastingFault(FaultSpec):
    """A fault that is over after some steps, or seconds; by default it lasts to the end."""

    steps: Count | None = None
    for_s: Positive | None = None

    @model_validator(mode="after")
    def _check_end(self) -> Self:
        if self.steps is not None and self.for_s is not None:
            raise ValueError("expected either steps or for_s")
        return self

    def span(self, period_ns: int | None) -> tuple[int, int | None]:
        """See `FaultSpec`."""
        first, _ = super().span(period_ns)
        if self.steps is not None:
            return first, first + self.steps
        if self.for_s is None:
            return first, None
        begins_s = first * (period_ns or 0) / NANOSECONDS if self.at_s is None else self.at_s
        return first, max(first + 1, _steps(begins_s + self.for_s, period_ns))


class KillFault(FaultSpec):
    """The node's process dies when it is to begin the step; it begins anew `restart_after` steps later, or never."""

    kind: Literal["kill"] = "kill"
    node: Id
    restart_after: Count | None = None

    def span(self, period_ns: int | None) -> tuple[int, int | None]:
        """See `FaultSpec`."""
        first, _ = super().span(period_ns)
        return first, None if self.restart_after is None else first + self.restart_after


class StopFault(LastingFault):
    """The node's process stands still (SIGSTOP) and then goes on (SIGCONT)."""

    kind: Literal["stop"] = "stop"
    node: Id

    @model_validator(mode="after")
    def _check_duration(self) -> Self:
        if self.steps is None and self.for_s is None:
            raise ValueError("expected steps or for_s")
        return self


class SlowFault(LastingFault):
    """The node takes so much longer before it publishes each stage."""

    kind: Literal["slow"] = "slow"
    node: Id
    delay_s: Positive


class ClockFault(LastingFault):
    """The node's clock is so far ahead; behind, if the offset is negative."""

    kind: Literal["clock"] = "clock"
    node: Id
    offset_s: Number


class CutFault(LastingFault):
    """Links that carry nothing."""

    kind: Literal["cut"] = "cut"
    senders: Ids | None = Field(default=None, alias="from")
    receivers: Ids | None = Field(default=None, alias="to")

    def cuts(self, edge: Edge) -> bool:
        """Whether it is about this edge."""
        return between(edge, self)


class PartitionFault(LastingFault):
    """Nothing passes between groups; the nodes that are in none form one of their own."""

    kind: Literal["partition"] = "partition"
    groups: Annotated[tuple[Annotated[tuple[Id, ...], Field(min_length=1)], ...], Field(min_length=1)]

    def cuts(self, edge: Edge) -> bool:
        """Whether the edge's ends are in different groups."""
        return any((edge[0] in group) != (edge[1] in group) for group in self.groups)


AnyFault = Annotated[
    KillFault | StopFault | SlowFault | ClockFault | CutFault | PartitionFault, Field(discriminator="kind")
]

Timeline = tuple[AnyFault, ...]
"""The faults of a run, in any order."""

EXCLUSIVE = (KillFault, StopFault)
"""Faults that cannot happen to a node that they have already happened to; others add up."""


class LinksFile(Nested):
    """A file of links and faults, which stand in the place of a scenario's own."""

    links: LinksSpec | None = None
    faults: Timeline | None = None


def fault_problems(
    faults: Timeline, ids: Collection[NodeId], network: Network | None, period_ns: int | None
) -> Iterator[Problem]:
    """Faults of nodes and edges that are not there, in seconds where steps have no times, or one inside another."""
    for n, fault in enumerate(faults):
        place = f"faults[{n}]"
        if period_ns is None:
            for name in fault.in_seconds:
                yield Problem(
                    f"{place}.{name}", getattr(fault, name), "expected steps: free-running ones have no times"
                )
        if isinstance(fault, CutFault):
            yield from end_problems(place, fault, ids, network)
        elif isinstance(fault, PartitionFault):
            yield from _group_problems(place, fault, ids)
        elif fault.node not in ids:
            yield Problem(f"{place}.node", fault.node, "expected the id of a sensor")
    if period_ns is not None or not any(fault.in_seconds for fault in faults):
        yield from _overlap_problems(faults, period_ns)


def _group_problems(place: str, fault: PartitionFault, ids: Collection[NodeId]) -> Iterator[Problem]:
    seen = set[NodeId]()
    for n, group in enumerate(fault.groups):
        for i in group:
            if i not in ids:
                yield Problem(f"{place}.groups[{n}]", i, "expected the id of a sensor")
            elif i in seen:
                yield Problem(f"{place}.groups[{n}]", i, "expected each node in one group only")
            seen.add(i)
    if len(fault.groups) == 1 and seen >= set(ids):
        yield Problem(f"{place}.groups", [list(fault.groups[0])], "expected another group, or nodes in none")


def _overlap_problems(faults: Timeline, period_ns: int | None) -> Iterator[Problem]:
    spans: dict[tuple[str, NodeId], list[tuple[int, int | None, int]]] = {}
    for n, fault in enumerate(faults):
        if isinstance(fault, EXCLUSIVE):
            spans.setdefault((fault.kind, fault.node), []).append((*fault.span(period_ns), n))
    for (kind, node), several in spans.items():
        several.sort(key=lambda span: (span[0], span[2]))
        for (_, end, _), (first, _, n) in pairwise(several):
            if end is None or first < end:
                until = "for ever" if end is None else f"until step {end}"
                expected = f"expected a {kind} of node {node} after the one before, which lasts {until}"
                yield Problem(f"faults[{n}]", first, expected)
