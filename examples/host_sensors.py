"""Six sensors that every Linux machine has, for host.toml: what the kernel tells about its own activity in /proc.

Each function reads another quantity and puts it on the same scale: 0 where the machine rests, 1 where it can do no
more. All but `queue` are counters, of which the change since the last call counts, so the first call has no reading;
nor has one for which the machine lacks the file (pressure needs a kernel with PSI, a container may hide its disks).
"""

# ruff: noqa: ARG001 - all are called alike, and none of these needs to know the step, the time and the sensor's name

from __future__ import annotations

import os
import time
from collections.abc import Sequence

CPUS = os.cpu_count() or 1

LOAD_DECAY = 1884 / 2048
"""Every five seconds the kernel makes the one-minute load average of this much of the old one and the rest of the
number of tasks that run or wait just then."""

if not os.path.exists("/proc/stat"):
    raise RuntimeError("these sensors read /proc, which only Linux has")


class Rates:
    """How fast counters grow."""

    def __init__(self) -> None:
        self._before: tuple[float, Sequence[int]] | None = None

    def per_second(self, counters: Sequence[int] | None) -> list[float] | None:
        """Growth per second since the last call; None at the first one, and where there are no such counters."""
        now = time.monotonic()
        before, self._before = self._before, None if counters is None else (now, counters)
        if counters is None or before is None or len(before[1]) != len(counters) or now <= before[0]:
            return None
        return [(new - old) / (now - before[0]) for new, old in zip(counters, before[1], strict=True)]


# Each sensor has the variables of this file to itself.
rates = Rates()
load: float | None = None


def busy(step: int, t_ns: int, node: str) -> float | None:
    """The share of their time that the processors worked."""
    ticks = rates.per_second([int(field) for field in lines("/proc/stat")[0][1:9]])
    if ticks is None or sum(ticks) <= 0:
        return None
    idle, waiting_for_disk = ticks[3], ticks[4]
    return 1 - (idle + waiting_for_disk) / sum(ticks)


def queue(step: int, t_ns: int, node: str) -> float | None:
    """Tasks that run or wait to run, per processor, at most 1.

    Nothing tells this over time but the load average, a smoothed value from which the newest term is taken here: a
    reading every five seconds, and none in between.
    """
    global load
    found = lines("/proc/loadavg")
    before, load = load, float(found[0][0]) if found else None
    if load is None or before is None or load == before:
        return None
    tasks = (load - LOAD_DECAY * before) / (1 - LOAD_DECAY)
    return min(max(tasks / CPUS, 0.0), 1.0)


def pressure(step: int, t_ns: int, node: str) -> float | None:
    """The share of the time during which some task had to wait for a processor."""
    totals = [int(fields[-1].removeprefix("total=")) for fields in lines("/proc/pressure/cpu") if fields[0] == "some"]
    waited_us = rates.per_second(totals or None)
    return None if waited_us is None else min(waited_us[0] / 1e6, 1.0)


def switches(step: int, t_ns: int, node: str, half: float) -> float | None:
    """How often a processor turns to another task; `half` per second and processor is half of all it can do."""
    counts = [int(fields[1]) for fields in lines("/proc/stat") if fields[0] == "ctxt"]
    return saturating(rates.per_second(counts or None), half * CPUS)


def network(step: int, t_ns: int, node: str, half: float) -> float | None:
    """Bytes per second that come and go, not counting what the machine sends itself; `half` is half of all."""
    cards = [fields for fields in lines("/proc/net/dev")[2:] if fields[0] != "lo:"]
    total = sum(int(fields[1]) + int(fields[9]) for fields in cards)
    return saturating(rates.per_second([total] if cards else None), half)


def disk(step: int, t_ns: int, node: str) -> float | None:
    """The share of the time that the busiest disk worked."""
    working_ms = rates.per_second([int(fields[12]) for fields in lines("/proc/diskstats")] or None)
    return None if working_ms is None else min(max(working_ms) / 1e3, 1.0)


def saturating(rate: list[float] | None, half: float) -> float | None:
    """From 0 to 1 for a rate that has no natural limit."""
    return None if rate is None else rate[0] / (rate[0] + half)


def lines(path: str) -> list[list[str]]:
    """The fields of every line of a file; nothing if it is not there or not for us."""
    try:
        with open(path, encoding="ascii") as file:
            return [line.split() for line in file if line.strip()]
    except OSError:
        return []
