"""What an edge does to packets, for whoever sends messages by real ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from zfusion.links.lanes import Lane
from zfusion.links.line import Line
from zfusion.links.protocol import CUT, LOST, QUEUE_FULL


class PacketModel:
    """What an edge does to packets: their number, 1, 2, 3, ..., stands in the place of the step in what is drawn.

    Bursts of losses go by packets, too. Duplicates are not made: whoever sends packets would count them again.
    """

    def __init__(self, lane: Lane, is_cut: Callable[[int], bool] | None) -> None:
        self._lane, self._is_cut = lane, is_cut
        self._packets = 0
        self._line = Line()
        self._latest = 0
        self.counters: Counter[str] = Counter()
        """Packets: lost, cut, queue_full."""

    def next(self, now_ns: int, size_bytes: int) -> int | None:
        """When the packet that is sent now arrives; None: never. Called once for every packet, in order."""
        self._packets += 1
        fate, rules = self._lane.fate(self._packets), self._lane.rules
        if self._is_cut is not None and self._is_cut(now_ns):
            self.counters[CUT] += 1
            return None
        left_ns: int | None = now_ns
        if rules.bandwidth is not None:
            left_ns = self._line.send(now_ns, size_bytes, rules.bandwidth)
        if left_ns is None or not fate:
            self.counters[QUEUE_FULL if left_ns is None else LOST] += 1
            return None
        arrival = left_ns + fate[0]
        if not rules.reorder:
            arrival = self._latest = max(arrival, self._latest)
        return arrival
