"""Clocks: the node's own, and how far its neighbours' are ahead of it.

A neighbour's clock is read by asking for its status: asked at t1 and answered at t4 here, heard at t2 and told at t3
there, its clock is ahead by ((t2 - t1) + (t3 - t4)) / 2, to within half of the time that was spent on the way,
((t4 - t1) - (t3 - t2)) / 2, whichever way that was longer. Of several readings the quickest counts. Two processes on
one machine read one clock: nothing has to be found out.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

READINGS = 16
"""Readings from which the quickest is taken: clocks drift, old ones are to be forgotten."""

ROUNDING_NS = 10
"""What is lost by counting in whole nanoseconds."""

ASK_AGAIN_NS = 5_000_000_000
"""How often the clock of a neighbour on another machine is read: quartz drifts by some 10 µs meanwhile."""


class Clock:
    """What the time is for a node: the machine's, or so much more as a scenario wants it to be wrong."""

    def __init__(self) -> None:
        self.ahead_ns = 0
        self.now = time.time_ns

    def set_ahead(self, ahead_ns: int) -> None:
        """From now on the clock is so far ahead of the machine's."""
        self.ahead_ns = ahead_ns


class WrongClock(Clock):
    """One that can be set."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self._now

    def _now(self) -> int:
        return time.time_ns() + self.ahead_ns


@cache
def machine() -> str | None:
    """What two processes have in common that read the same clock; None where that cannot be told."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return None


@dataclass(slots=True)
class ClockOffset:
    """How far a neighbour's clock is ahead of the own one."""

    same_machine: bool = False
    _readings: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=READINGS))
    """(uncertainty, offset)."""

    def read(self, asked_ns: int, heard_ns: int, told_ns: int, answered_ns: int) -> None:
        """A question and its answer; what cannot be, is not counted. Where a clock was set, readings begin anew."""
        on_the_way = (answered_ns - asked_ns) - (told_ns - heard_ns)
        if on_the_way < 0 or told_ns < heard_ns:
            return
        uncertainty, offset = (on_the_way + 1) // 2, ((heard_ns - asked_ns) + (told_ns - answered_ns)) // 2
        if any(abs(offset - before) > uncertainty + unsure + ROUNDING_NS for unsure, before in self._readings):
            self._readings.clear()
        self._readings.append((uncertainty, offset))

    @property
    def known(self) -> bool:
        """Whether anything is known."""
        return self.same_machine or bool(self._readings)

    def told(self) -> dict[str, float]:
        """offset_us, and uncertainty_us: the offset is right to within that. Empty where nothing is known."""
        if self.same_machine:
            return {"offset_us": 0.0, "uncertainty_us": 0.0}
        if not self._readings:
            return {}
        uncertainty, offset = min(self._readings)
        return {"offset_us": offset / 1000, "uncertainty_us": uncertainty / 1000}
