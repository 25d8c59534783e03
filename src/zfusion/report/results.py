"""The results of an experiment, read from its directory for a report.

Nothing is computed here that is in the tables: means and intervals over seeds are those of `summary`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from zfusion.errors import InputError
from zfusion.model.types import Array
from zfusion.stages import ESTIMATE
from zfusion.studies.experiment.axes import Label
from zfusion.studies.experiment.catalogue import ALL
from zfusion.studies.experiment.run import FACTS
from zfusion.studies.intervals import mean_interval

LABEL = "label."
"""Beginning of axes that set nothing: their values stand for those of others."""


class Value(NamedTuple):
    """A mean over seeds and its interval; NaN where there is none."""

    mean: float
    low: float = math.nan
    high: float = math.nan
    n: int = 0


NOTHING = Value(math.nan)


@dataclass(frozen=True, slots=True)
class Axis:
    """What was varied: the path of it in the scenario, and the labels of its values, in order."""

    path: str
    labels: tuple[Label, ...]

    @property
    def numeric(self) -> bool:
        """Whether its values are numbers."""
        return all(isinstance(label, int | float) and not isinstance(label, bool) for label in self.labels)

    @property
    def name(self) -> str:
        """The path without its first part, where that is only the table that it is in: enough for a title."""
        first, _, rest = self.path.partition(".")
        return rest if rest and "[" not in first else self.path


@dataclass(frozen=True, slots=True)
class Point:
    """One combination of values."""

    number: int
    labels: Mapping[str, Label]
    steps: int
    facts: Mapping[str, Any]

    def words(self, axes: Iterable[Axis]) -> str:
        """The values of some axes: ``delay = 0.02, late = drop``."""
        return ", ".join(f"{axis.name} = {label_text(self.labels[axis.path])}" for axis in axes)


@dataclass(frozen=True)
class Course:
    """Squared errors over time, averaged over seeds, with an interval where it is in the table; (n,)."""

    steps: Array
    error_sq: Array
    low: Array
    high: Array
    predicted: Array
    n: int


class Results:
    """An experiment's tables."""

    def __init__(self, directory: Path) -> None:
        """Reads the directory; InputError where it is none of an experiment's, or has no tables."""
        self.directory = directory
        self.facts = _read_facts(directory)
        axes = [Axis(axis["path"], tuple(axis["labels"])) for axis in self.facts["axes"]]
        self.all_axes = tuple(axes)
        """All, also those that have one value only."""
        self.points = tuple(
            Point(point["point"], point["labels"], point["steps"], point) for point in self.facts["points"]
        )
        self.axes = _independent([axis for axis in axes if len(axis.labels) > 1], self.points)
        """Those that vary, each of its own."""
        self.follows = {a.path: _leaders(a, self.axes, self.points) for a in axes if a not in self.axes}
        """Axis that varies with others -> those that say what its value is."""
        self._summary: dict[tuple[str, str, str, str], dict[int, Value]] = {}
        for row in _rows(directory / "summary.parquet", ("point", "node", "sender", "stage", "metric", "mean")):
            key = row["metric"], row["stage"], row["node"], row["sender"]
            self._summary.setdefault(key, {})[row["point"]] = Value(
                _number(row["mean"]), _number(row["low"]), _number(row["high"]), row["n"] or 0
            )

    def values(self, metric: str, stage: str = ESTIMATE.name, node: str = ALL, sender: str = "") -> Mapping[int, Value]:
        """By point; empty where there are none."""
        return self._summary.get((metric, stage, node, sender), {})

    def stages(self, metric: str) -> list[str]:
        """The stages of which there is a metric for the whole network."""
        found = {stage for name, stage, node, _ in self._summary if name == metric and node == ALL}
        return sorted(found, key=lambda stage: (stage != ESTIMATE.name, stage))

    def senders(self, metric: str) -> list[tuple[str, str, str]]:
        """(sender, receiver, stage) of which there is a metric."""
        return [(sender, node, stage) for name, stage, node, sender in self._summary if name == metric and sender]

    def total(self, metric: str) -> Mapping[int, Value]:
        """By point, a count of the whole network over all stages: means over seeds, without intervals."""
        whole = self.values(metric, "")
        if whole:
            return whole
        found: dict[int, float] = {}
        for (name, _, node, sender), values in self._summary.items():
            if name == metric and node == ALL and not sender:
                for point, value in values.items():
                    found[point] = found.get(point, 0.0) + value.mean
        return {point: Value(mean) for point, mean in found.items()}

    @cached_property
    def timings(self) -> Mapping[int, Value]:
        """Rounds a second by point."""
        of_run = {run: point["point"] for point in self.facts["points"] for run in point["runs"]}
        values: dict[int, list[float]] = {}
        for row in _rows(self.directory / "timings.parquet", ("run", "metric", "value"), needed=False):
            if row["metric"] == "rounds_per_s" and row["run"] in of_run:
                values.setdefault(of_run[row["run"]], []).append(row["value"])
        intervals = {point: mean_interval(of, self.facts["confidence"]) for point, of in values.items()}
        return {p: Value(i.mean, _number(i.low), _number(i.high), i.n) for p, i in intervals.items()}

    def courses(self, stage: str = ESTIMATE.name) -> dict[int, Course]:
        """Errors over time of the whole network, by point."""
        found: dict[int, list[Mapping[str, Any]]] = {}
        columns = ("point", "node", "stage", "step", "error_sq", "predicted", "n")
        for row in _rows(self.directory / "series_mean.parquet", columns, needed=False):
            if row["node"] == ALL and row["stage"] == stage:
                found.setdefault(row["point"], []).append(row)
        return {point: _course(sorted(rows, key=lambda row: row["step"])) for point, rows in found.items()}

    def scenario_file(self, point: Point) -> Path:
        """The point's scenario."""
        return self.directory / str(point.facts["scenario"])


def label_text(label: Label) -> str:
    """A label as people read it."""
    return f"{label:g}" if isinstance(label, float) else str(label)


def _read_facts(directory: Path) -> dict[str, Any]:
    if not directory.is_dir():
        raise InputError(f"{directory}: there is no such directory")
    try:
        facts = json.loads((directory / FACTS).read_text(encoding="utf-8"))
        wanted = ("name", "axes", "points", "seeds", "confidence", "failed", "runs")
        missing = [name for name in wanted if name not in facts]
    except FileNotFoundError:
        hint = "it is no experiment's, or the experiment has not come to its end"
        raise InputError(f"{directory}: there is no {FACTS} in it: {hint}") from None
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{directory / FACTS}: cannot be read: {error}") from None
    if missing:
        raise InputError(f"{directory / FACTS}: is not an experiment's: it has no {missing[0]}")
    return dict(facts)


def _rows(path: Path, columns: Sequence[str], *, needed: bool = True) -> Iterator[Mapping[str, Any]]:
    """The rows of a table; InputError where it cannot be read or lacks one of these columns."""
    if not needed and not path.exists():
        return
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None
    missing = [column for column in columns if column not in table.column_names]
    if missing:
        raise InputError(f"{path}: has no column {missing[0]!r}")
    yield from table.to_pylist()


def _course(rows: Sequence[Mapping[str, Any]]) -> Course:
    columns = {
        name: np.array([_number(row.get(name)) for row in rows])
        for name in ("step", "error_sq", "low", "high", "predicted")
    }
    seeds = max(row["n"] for row in rows)
    return Course(columns["step"], columns["error_sq"], columns["low"], columns["high"], columns["predicted"], seeds)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _independent(axes: Sequence[Axis], points: Sequence[Point]) -> tuple[Axis, ...]:
    """As few of the axes as still tell the points apart: those that only follow the others are left out.

    What is left out first is what says least on an axis: names of tables, then numbers, later ones before earlier ones;
    axes that stand for nothing but their labels stay longest.
    """
    kept = list(axes)
    for axis in sorted(axes, key=lambda a: (a.path.startswith(LABEL), a.numeric, -axes.index(a))):
        rest = [a for a in kept if a is not axis]
        if len({_place(rest, point) for point in points}) == len({_place(kept, point) for point in points}):
            kept = rest
    return tuple(kept)


def _leaders(axis: Axis, kept: Sequence[Axis], points: Sequence[Point]) -> tuple[str, ...]:
    """The axes that say what the value of an axis is: one of those that were kept, or all of them together."""
    for leader in kept:
        pairs = {(_place([leader], point), _place([axis], point)) for point in points}
        if len(pairs) == len({first for first, _ in pairs}):
            return (leader.path,)
    return tuple(a.path for a in kept)


def _place(axes: Sequence[Axis], point: Point) -> tuple[tuple[type, Label], ...]:
    return tuple(_key(point.labels[axis.path]) for axis in axes)


def _key(label: Label) -> tuple[type, Label]:
    return (type(label), label)
