"""How regularly something is published: rate, intervals, bytes and gaps of one key, over a window of messages."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from zfusion.errors import MessageError
from zfusion.gaps import GapCounter
from zfusion.messages import read_stamp

WINDOW = 10_000
"""Messages over which the intervals are taken."""

MOST_KEYS = 10_000
"""Keys that are told apart; what comes on more of them is nobody's swarm."""


class Rhythm:
    """One key's. Times are the observer's, when a message came; gaps are told by the sender's own counter."""

    def __init__(self, window: int = WINDOW) -> None:
        """`window` is the number of messages, at least 2."""
        self.messages = 0
        """That ever came."""
        self._came: deque[tuple[int, int]] = deque(maxlen=window)
        """(time in ns, bytes)."""
        self._gaps = GapCounter()

    def add(self, received_ns: int, data: bytes, size: int) -> None:
        """A message came."""
        self.messages += 1
        self._came.append((received_ns, size))
        try:
            stamp = read_stamp(data)
        except MessageError:
            self._gaps.observe_unreadable()
        else:
            self._gaps.observe(stamp.born, stamp.seq)

    def told(self) -> dict[str, Any]:
        """messages; of the window: rate_hz, mean_s, min_s, max_s, std_s, bytes_per_s (None below two messages).

        lost: missing between the first and the last message that came; unreadable: without legal counters.
        """
        gaps = self._gaps.gaps()
        told = {"messages": self.messages, "lost": gaps.lost_between, "unreadable": gaps.unreadable}
        names = ("rate_hz", "mean_s", "min_s", "max_s", "std_s", "bytes_per_s")
        times = np.array([time for time, _ in self._came], dtype=np.int64)
        passed_s = (times[-1] - times[0]) / 1e9 if len(times) > 1 else 0.0
        if passed_s <= 0:
            return told | dict.fromkeys(names)
        apart = np.diff(times) / 1e9
        octets = sum(size for _, size in self._came) - self._came[0][1]
        values = (len(apart) / passed_s, apart.mean(), apart.min(), apart.max(), apart.std(), octets / passed_s)
        return told | {name: float(value) for name, value in zip(names, values, strict=True)}
