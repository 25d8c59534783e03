"""Whether anything grows with the length of a run: every quantity's trend against what is tolerated of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from zfusion.drivers.health import QUEUES
from zfusion.model.types import Array
from zfusion.studies.soak.samples import Course, longest_lives
from zfusion.studies.soak.trend import Trend, theil_sen
from zfusion.swarm.watch import LAUNCHER, NODE

HOUR_S = 3600.0

MOST_WARM_UP_S = 600.0
WARM_UP_PART = 0.25
"""What is not judged: caches fill, covariances settle. A quarter of what there is, but at most ten minutes."""

FEWEST_SAMPLES = 10
"""After the warm-up; a trend of less says nothing."""

LEVEL_PART = 0.1
"""Part of the judged samples, at their beginning and at their end, whose medians are shown as start and end."""

SWARM = "swarm"

LOAD_S = 300.0
"""What depends on what else the machine does is judged from five minutes on."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What is judged of a process, or of the swarm."""

    name: str
    unit: str
    tolerance: float
    """Growth per hour that passes."""
    floor: float
    """Growth over the judged time that passes, however fast it was: less cannot be told from chance in a short run."""
    least_s: float
    """Time that must be judged: of less, nothing is said."""
    meaning: str


MEMORY = Quantity("memory", "MiB", 4.0, 4.0, 0.0, "of the process that no file backs")
DESCRIPTORS = Quantity("descriptors", "", 1.0, 2.0, 0.0, "open files and sockets")
THREADS = Quantity("threads", "", 1.0, 2.0, 0.0, "of the process")
CPU = Quantity("cpu", "%", 5.0, 3.0, LOAD_S, "of one processor")
QUEUED = Quantity("queued", "messages", 10.0, 10.0, 0.0, "in the node: ahead, held, posted and notices together")
ROUND = Quantity("round", "% of the period", 10.0, 5.0, LOAD_S, "from measurement to estimate, median")
MISSED = Quantity("missed", "%", 2.0, 2.0, LOAD_S, "of the messages: not there at the deadline")
SKIPPED = Quantity("skipped", "%", 2.0, 2.0, LOAD_S, "of the steps")
LOGS = Quantity("logs", "MiB", 1.0, 0.25, 0.0, "that all processes wrote")

QUANTITIES = (MEMORY, DESCRIPTORS, THREADS, CPU, QUEUED, ROUND, MISSED, SKIPPED, LOGS)


@dataclass(frozen=True, slots=True)
class Growth:
    """The trend of one quantity of one process, or of the swarm."""

    process: str
    quantity: Quantity
    start: float
    end: float
    """Medians of the first and last of the judged samples."""
    per_hour: Trend
    rise: float
    """What the trend makes of the judged time."""

    @property
    def grows(self) -> bool:
        """Whether it surely grows faster than is tolerated, and by more than chance does."""
        return self.per_hour.low > self.quantity.tolerance and self.rise > self.quantity.floor

    def told(self) -> dict[str, object]:
        """As plain data."""
        trend, quantity = self.per_hour, self.quantity
        return {
            "process": self.process,
            "quantity": quantity.name,
            "unit": quantity.unit,
            "start": self.start,
            "end": self.end,
            "per_hour": trend.slope,
            "low": trend.low,
            "high": trend.high,
            "tolerance": quantity.tolerance,
            "grows": self.grows,
        }


@dataclass(frozen=True, slots=True)
class Series:
    """A quantity over time, (n,) each; NaN where nothing is known."""

    process: str
    quantity: Quantity
    t_s: Array
    values: Array


def begun_s(courses: Sequence[Course]) -> float:
    """When all nodes were first seen to take steps; 0 where that was not seen of all."""
    first: dict[str, float] = {}
    for course in courses:
        running = np.flatnonzero(course.columns["step"] > 0)
        if course.kind == NODE and len(running):
            at = float(course.t_s[running[0]])
            first[course.process] = min(at, first.get(course.process, at))
    nodes = {course.process for course in courses if course.kind == NODE}
    return max(first.values()) if first and first.keys() == nodes else 0.0


def warm_up_s(running_s: float) -> float:
    """How much of the time that a swarm runs is not judged, unless something else is said."""
    return min(MOST_WARM_UP_S, WARM_UP_PART * running_s)


def judge(courses: Sequence[Course], after_s: float, period_s: float | None) -> list[Growth]:
    """The growth of all that there are samples enough of after `after_s`; `period_s` of a step, None: free-running."""
    found = []
    for series in all_series(courses, period_s):
        kept = (series.t_s >= after_s) & np.isfinite(series.values)
        t_s = series.t_s[kept]
        if len(t_s) >= FEWEST_SAMPLES and t_s[-1] - t_s[0] >= series.quantity.least_s:
            found.append(_growth(series, t_s, series.values[kept]))
    return found


def all_series(courses: Sequence[Course], period_s: float | None) -> Iterator[Series]:
    """Every quantity of the longest life of every process, and of the swarm."""
    lives = longest_lives(courses)
    for course in lives:
        columns = course.columns
        of_process = {
            MEMORY: columns["anonymous_bytes"] / 2**20,
            DESCRIPTORS: columns["fds"],
            THREADS: columns["threads"],
            CPU: 100 * course.rate("cpu_s"),
        }
        if course.kind == NODE:
            of_process[QUEUED] = np.sum([columns[name] for name in QUEUES], axis=0)
        if course.kind == LAUNCHER:
            of_process[LOGS] = columns["logs_bytes"] / 2**20
        for quantity, values in of_process.items():
            yield Series(course.name, quantity, course.t_s, values)
    yield from _of_swarm([course for course in courses if course.kind == NODE], period_s)


def _of_swarm(nodes: Sequence[Course], period_s: float | None) -> Iterator[Series]:
    """How late all nodes are together, sample by sample."""
    t_s = np.unique(np.concatenate([course.t_s for course in nodes])) if nodes else np.zeros(0)
    if not len(t_s):
        return
    if period_s is not None:
        rounds = np.array([_at(t_s, course, course.columns["round_p50_us"]) for course in nodes])
        yield Series(SWARM, ROUND, t_s, _median(rounds) / (1e4 * period_s))
    for quantity, counter, other in ((MISSED, "missed", "received"), (SKIPPED, "skipped", "completed")):
        counted = _sum(t_s, nodes, counter)
        both = counted + _sum(t_s, nodes, other)
        share = np.divide(100 * counted, both, out=np.full(len(t_s), np.nan), where=both > 0)
        yield Series(SWARM, quantity, t_s, share)


def _sum(t_s: Array, nodes: Sequence[Course], counter: str) -> Array:
    """How fast a counter grows in all nodes together."""
    rates = np.array([_at(t_s, course, course.rate(counter)) for course in nodes])
    total: Array = np.nansum(rates, axis=0)
    return total


def _at(t_s: Array, course: Course, values: Array) -> Array:
    """The values of a course at the times of all, NaN where it was not looked at."""
    found = np.full(len(t_s), np.nan)
    found[np.searchsorted(t_s, course.t_s)] = values
    return found


def _median(values: Array) -> Array:
    """Over the first axis, of what is known; NaN where nothing is."""
    known = np.isfinite(values).any(axis=0)
    median = np.full(values.shape[1], np.nan)
    median[known] = np.nanmedian(values[:, known], axis=0)
    return median


def _growth(series: Series, t_s: Array, values: Array) -> Growth:
    level = max(1, round(LEVEL_PART * len(values)))
    trend = theil_sen(t_s / HOUR_S, values)
    rise = trend.slope * (t_s[-1] - t_s[0]) / HOUR_S
    start, end = float(np.median(values[:level])), float(np.median(values[-level:]))
    return Growth(series.process, series.quantity, start, end, trend, float(rise))
