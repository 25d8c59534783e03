"""Whether the neighbours' clocks agree with a node's well enough for its deadlines.

Steps begin on everybody's own clock. What a neighbour sends whose clock is behind comes later by that much, and its
stages close later; one that is ahead does not wait for what this node sends. So an offset eats the time that a stage is
open, and one that leaves too little of it is refused at the start, or told.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import Any

from zfusion.drivers.account import patience_of
from zfusion.drivers.clocks import Clock, ClockOffset
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId, sorted_ids
from zfusion.status import Phase, Status

log = logging.getLogger(__name__)

SHARE = 4
"""An offset may be this part of the time that the shortest stage is open: the rest is for computing and for the way."""


def clock_limit_ns(scenario: Scenario) -> int | None:
    """How far the clocks of two neighbours may be apart: as the scenario says, or by its deadlines.

    That is a quarter of the shortest time that a stage is open: until its deadline, from the one before. None for a
    free-running swarm, which has no times to keep.
    """
    timing = scenario.timing
    if timing.max_clock_offset_s is not None:
        return round(timing.max_clock_offset_s * 1e9)
    if timing.period_ns is None:
        return None
    patience = patience_of(scenario)
    waits = patience.waits_ns
    open_ns = [later - earlier for earlier, later in pairwise((0, *waits))] if patience.paced else waits
    return min(open_ns) // SHARE


class ClockWatch:
    """A node's view of its neighbours' clocks. No input or output: it is told what they answered."""

    def __init__(self, scenario: Scenario, own: NodeId, neighbours: Collection[NodeId], clock: Clock) -> None:
        """`clock` is the node's own; `neighbours` are all that it is linked to."""
        self.offsets = {j: ClockOffset() for j in neighbours}
        """How far the neighbours' clocks are ahead."""
        self.exceeded = 0
        """Readings of a neighbour's clock, since this node began, that were beyond the limit."""
        self.limit_ns = clock_limit_ns(scenario)
        self._own, self._clock = own, clock
        planned = any(fault.kind == "clock" for fault in scenario.faults)
        self._refuses = scenario.timing.on_clock_offset == "refuse" and not planned
        """A scenario that sets a clock wrong wants to see what that does."""
        self._warned: set[NodeId] = set()

    def read(self, status: Status, on_machine: str | None, asked_ns: int, answered_ns: int, *, begun: bool) -> None:
        """What an answer tells of its sender's clock; `on_machine` is what this node tells of its own machine.

        A node that has not begun takes up the time line of one on its machine that has: the clock may have been set
        since. The line of one that is still to take up this node's is not to be looked at.
        """
        offset = self.offsets.get(status.node)
        if offset is None:
            return
        offset.same_machine = on_machine is not None and status.machine == on_machine
        if offset.same_machine:
            if not begun and status.phase is Phase.RUNNING:
                self._clock.join(status.line_ns)
            if begun and status.phase is Phase.JOINING:
                return
            offset.lines_apart_ns = status.line_ns - self._clock.line_ns
        else:
            offset.read(asked_ns, status.heard_ns, status.told_ns, answered_ns)
        if begun and status.phase is not Phase.JOINING and self._is_beyond(status.node):
            self.exceeded += 1
            self._warn(status.node)

    def agree(self, with_whom: Collection[NodeId]) -> None:
        """To be called before beginning. InputError, naming the neighbour, where its clock is beyond the limit.

        Where the scenario wants it so, a warning instead. What is not known is told, and not refused.
        """
        beyond = list(self._beyond(with_whom))
        if beyond and self._refuses:
            raise InputError("\n".join(self._told(j) + REMEDY for j in beyond))
        for j in beyond:
            self._warn(j)

    def mark(self, arrivals: dict[str, Any]) -> None:
        """Mark the edges of a message "arrivals" whose latencies are differences of clocks that are not one.

        `clock_error_ns` is by how much they may be wrong; None where nobody knows.
        """
        for edge in arrivals["edges"]:
            offset = self.offsets.get(edge["from"])
            if offset is not None and offset.error_ns != 0:
                edge["clock_error_ns"] = offset.error_ns

    def tell_unknown(self, of: Collection[NodeId]) -> None:
        """Tell whose clock could not be read; to be called once, when the node begins."""
        unknown = [str(j) for j in sorted_ids(of) if j in self.offsets and self.offsets[j].found is None]
        if unknown and self.limit_ns is not None:
            log.warning("how far the clocks of these nodes are off is not known: %s", ", ".join(unknown))

    def _beyond(self, of: Collection[NodeId]) -> Iterator[NodeId]:
        return (j for j in sorted_ids(of) if self._is_beyond(j))

    def _is_beyond(self, j: NodeId) -> bool:
        """Whether a neighbour's clock is certainly farther off than it may be."""
        found = self.offsets[j].found if j in self.offsets else None
        if found is None or self.limit_ns is None:
            return False
        offset, uncertainty = found
        return abs(offset) - uncertainty > self.limit_ns

    def _warn(self, j: NodeId) -> None:
        if j not in self._warned:
            self._warned.add(j)
            log.warning("%s", self._told(j))

    def _told(self, j: NodeId) -> str:
        offset, uncertainty = self.offsets[j].found or (0, 0)
        side = "ahead of" if offset > 0 else "behind"
        return (
            f"the clock of node {j} is {abs(offset) / 1e9:.6g} s {side} that of node {self._own}, here, to within "
            f"{uncertainty / 1e9:.2g} s, where {(self.limit_ns or 0) / 1e9:.6g} s are allowed"
        )


REMEDY = (
    ": set the clocks of both machines (chronyc tracking, timedatectl), allow more by timing.max_clock_offset_s, "
    'or begin all the same by timing.on_clock_offset = "warn"'
)
"""What to do about it."""
