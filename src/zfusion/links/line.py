"""A line of limited bandwidth: one message after the other, and only so many wait."""

from __future__ import annotations

from collections import deque

from zfusion.model.schema.links import BandwidthSpec
from zfusion.model.schema.run import NANOSECONDS


class Line:
    """What sends one message after the other, at a limited rate."""

    def __init__(self) -> None:
        self._free_ns = 0
        self._starts: deque[int] = deque()
        """When those that waited, or wait, begin to be sent."""

    def send(self, now_ns: int, size: int, bandwidth: BandwidthSpec) -> int | None:
        """When the last bit of a message of `size` bytes leaves; None where there is no room for it to wait."""
        starts = self._starts
        while starts and starts[0] <= now_ns:
            starts.popleft()
        if now_ns < self._free_ns:
            if len(starts) >= bandwidth.queue:
                return None
            starts.append(self._free_ns)
        self._free_ns = max(now_ns, self._free_ns) + round(8 * size * NANOSECONDS / bandwidth.rate_bps)
        return self._free_ns
