"""Clocks: the node's own, and how far its neighbours' are ahead of it.

A node keeps the time line that it has begun with: the machine's clock at that time, and from then on the time that has
passed, which nobody can set. Where the machine's clock is slewed, as it always is a little, the line follows; where it
is set, it does not, so that steps, deadlines and stamps go on as before.

A neighbour's clock is read by asking for its status: asked at t1 and answered at t4 here, heard at t2 and told at t3
there, its clock is ahead by ((t2 - t1) + (t3 - t4)) / 2, to within half of the time that was spent on the way,
((t4 - t1) - (t3 - t2)) / 2, whichever way that was longer. Of several readings the quickest counts. Two processes on
one machine count the same time: they tell each other where their lines begin, and nothing has to be found out.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

READINGS = 16
"""Readings from which the quickest is taken: clocks drift, old ones are to be forgotten."""

ROUNDING_NS = 10
"""What is lost by counting in whole nanoseconds."""

ASK_AGAIN_NS = 5_000_000_000
"""How often the clock of a neighbour on another machine is read: quartz drifts by some 10 µs meanwhile."""

JUMP_NS = 1_000_000
"""By how much a clock may differ from where it was expected without having jumped: a millisecond is nothing to a step,
and more than is lost between two readings."""

SLEWED = 1 / 1000
"""The part by which a clock may be faster or slower than time passes: kernels slew by half of that at the most."""

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
TIME_NAMESPACE = "/proc/self/ns/time"

Reader = Callable[[], int]
"""A clock of the machine's, in nanoseconds."""

steady_ns: Reader = partial(time.clock_gettime_ns, getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
"""The time that has passed, also while the machine was suspended (on Linux)."""


class Jump(NamedTuple):
    """What became of a machine's clock between two looks at it."""

    set_ns: int
    """By how much it was set forward; 0 where it was not set."""
    suspended_ns: int
    """How long the machine was suspended; 0 where it was not."""

    def __str__(self) -> str:
        """In words."""
        told = [f"it was set by {self.set_ns / 1e9:+.6g} s"] if self.set_ns else []
        told += [f"the machine was suspended for {self.suspended_ns / 1e9:.6g} s"] if self.suspended_ns else []
        return ", ".join(told)


class Clock:
    """What the time is for a node: its time line, or so much more as a scenario wants that to be wrong."""

    def __init__(
        self, wall: Reader = time.time_ns, steady: Reader = steady_ns, awake: Reader = time.monotonic_ns
    ) -> None:
        """`wall` is what can be set; `steady` counts all time, `awake` what was not spent suspended."""
        self.ahead_ns = 0
        self.jumps = 0
        """How often the machine's clock was seen to have jumped since the line is kept."""
        self.kept = False
        """Whether the line is kept; until then it is the machine's clock, whatever that does."""
        self._wall, self._steady, self._awake = wall, steady, awake
        self._set_ns = 0
        """How far the machine's clock is ahead of the line for having been set."""
        self._wall_ahead_ns = self._read()
        self._asleep_ns = steady() - awake()
        self._looked_ns = steady()
        self._base_ns = self._wall_ahead_ns
        """What is added to the time that has passed."""

    def now(self) -> int:
        """The time, in nanoseconds since 1970."""
        return self._steady() + self._base_ns

    @property
    def line_ns(self) -> int:
        """Where the line begins: when the count of time was zero. Of two processes on one machine, all that differs."""
        return self._base_ns

    def set_ahead(self, ahead_ns: int) -> None:
        """From now on the clock is so far ahead of its line."""
        self.ahead_ns = ahead_ns
        self._place()

    def keep(self) -> None:
        """From now on keep the line."""
        self.kept = True

    def join(self, line_ns: int) -> None:
        """Keep the line of another process on this machine."""
        self.kept = True
        self._set_ns = self._wall_ahead_ns + self.ahead_ns - line_ns
        self._place()

    def of_machine(self, wall_ns: int) -> int:
        """A reading of the machine's clock, on the line."""
        return wall_ns - self._set_ns + self.ahead_ns

    def on_machine(self, line_ns: int) -> int:
        """A time on the line, as the machine's clock has it now."""
        return line_ns + self._set_ns - self.ahead_ns

    def look(self) -> Jump | None:
        """See what the machine's clock has done since the last look: follow where it was slewed, tell where it jumped.

        To be called some times a second.
        """
        steady = self._steady()
        most = JUMP_NS + int((steady - self._looked_ns) * SLEWED)
        ahead, asleep = self._read(), self._steady() - self._awake()
        set_ns, suspended_ns = ahead - self._wall_ahead_ns, asleep - self._asleep_ns
        self._looked_ns, self._wall_ahead_ns, self._asleep_ns = steady, ahead, asleep
        jump = Jump(set_ns if abs(set_ns) > most else 0, suspended_ns if suspended_ns > most else 0)
        if self.kept:
            self._set_ns += jump.set_ns
        self._place()
        if not self.kept or jump == (0, 0):
            return None
        self.jumps += 1
        return jump

    def _place(self) -> None:
        self._base_ns = self._wall_ahead_ns - self._set_ns + self.ahead_ns

    def _read(self) -> int:
        """How far the machine's clock is ahead of the count of time: of some readings, that of the quickest."""
        best = (1 << 62, 0)
        for _ in range(3):
            before, wall, after = self._steady(), self._wall(), self._steady()
            best = min(best, (after - before, wall - (before + after) // 2))
        return best[1]


@cache
def machine() -> str | None:
    """What two processes have in common that count the same time; None where that cannot be told."""
    try:
        boot = BOOT_ID.read_text().strip()
    except OSError:
        return None
    try:
        return f"{boot} {os.readlink(TIME_NAMESPACE)}"
    except OSError:  # a kernel without namespaces of time
        return boot


@dataclass(slots=True)
class ClockOffset:
    """How far a neighbour's clock is ahead of the own one."""

    same_machine: bool = False
    lines_apart_ns: int = 0
    """On the same machine: how far the neighbour's line is ahead of the own one."""
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
    def found(self) -> tuple[int, int] | None:
        """(offset, uncertainty) in ns: the offset is right to within that. None where nothing is known."""
        if self.same_machine:  # lines that follow one clock are apart by what is lost in following it
            return (self.lines_apart_ns if abs(self.lines_apart_ns) > JUMP_NS else 0), 0
        if not self._readings:
            return None
        uncertainty, offset = min(self._readings)
        return offset, uncertainty

    @property
    def error_ns(self) -> int | None:
        """By how much a difference of stamps of the two may be wrong; None where nobody knows."""
        return None if self.found is None else abs(self.found[0]) + self.found[1]

    def told(self) -> dict[str, float]:
        """`found` as offset_us and uncertainty_us; empty where nothing is known."""
        if self.found is None:
            return {}
        offset, uncertainty = self.found
        return {"offset_us": offset / 1000, "uncertainty_us": uncertainty / 1000}
