"""The tables of an experiment: tidy, in one order, each as CSV and as Parquet.

results     a row per run, node, stage and metric
summary     a row per point, node, stage and metric: mean over the seeds and its interval
series      a row per run, node, stage and step: squared error and what was predicted of it, of the first seeds
series_mean the same averaged over all seeds
timings     as results: what depends on the machine
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from zfusion.stages import BUILT_IN, ESTIMATE
from zfusion.studies.experiment.axes import Label
from zfusion.studies.experiment.catalogue import ALL, METRICS
from zfusion.studies.experiment.plan import Plan, Point, Task
from zfusion.studies.experiment.store import Store
from zfusion.studies.intervals import Interval, mean_interval, nees_band

BAND_CONFIDENCE = 0.99
"""Of the band in which NEES is expected."""

RESULT = ("node", "sender", "stage", "metric", "value", "low", "high")
SUMMARY = ("node", "sender", "stage", "metric", "mean", "low", "high", "n")
SERIES = ("node", "stage", "step", "error_sq", "predicted")
SERIES_MEAN = ("node", "stage", "step", "error_sq", "low", "high", "predicted", "n")

TYPES = {
    **dict.fromkeys(("run", "node", "sender", "stage", "metric"), pa.string()),
    **dict.fromkeys(("point", "seed", "step", "n"), pa.int64()),
    **dict.fromkeys(("value", "low", "high", "mean", "error_sq", "predicted"), pa.float64()),
}

THEORY_METRICS = {"bound_centralized", "bound_local", "design_mse"}
"""Those that are not averaged over seeds."""

Rows = list[tuple[Any, ...]]


@dataclass(frozen=True)
class Written:
    """What was written."""

    files: tuple[str, ...]
    """Relative to the directory."""
    headlines: tuple[dict[str, Any], ...]
    """For every point, its labels and what became of the final estimates of the network as a whole: `metrics`, by
    name [mean, low, high]."""


def write_tables(plan: Plan, store: Store) -> Written:
    """Write the tables of what is done, and the points' scenarios."""
    tables = _Tables(plan)
    for point in plan.points:
        tables.add(point, store)
    written = []
    for name, (columns, rows) in tables.all().items():
        for suffix, content in (("csv", _csv(columns, rows)), ("parquet", _parquet(columns, rows))):
            store.write(store.directory / f"{name}.{suffix}", content)
            written.append(f"{name}.{suffix}")
    scenarios = store.directory / "scenarios"
    scenarios.mkdir(exist_ok=True)
    for point in plan.points:
        store.write(scenarios / f"{point.number}.toml", point.scenario.anchored().to_toml().encode())
    return Written(tuple(written), tuple(tables.headlines))


class _Tables:
    """The rows of all tables, point by point."""

    def __init__(self, plan: Plan) -> None:
        spec = plan.experiment.spec
        self._axes = plan.axes
        self._kinds = {path: _kind([point.labels[path] for point in plan.points]) for path in plan.axes}
        self._chosen = set(spec.metrics or METRICS)
        self._confidence, self._series = spec.confidence, set(spec.seeds[: spec.series])
        self.results: Rows = []
        self.summary: Rows = []
        self.series: Rows = []
        self.series_mean: Rows = []
        self.timings: Rows = []
        self.headlines: list[dict[str, Any]] = []

    def all(self) -> dict[str, tuple[tuple[tuple[str, pa.DataType], ...], Rows]]:
        """By name, the columns with their types, and the rows."""
        per_run = ("run", *self._axes, "seed")
        per_point = ("point", *self._axes)
        found = {
            "results": ((*per_run, *RESULT), self.results),
            "summary": ((*per_point, *SUMMARY), self.summary),
            "series": ((*per_run, *SERIES), self.series),
            "series_mean": ((*per_point, *SERIES_MEAN), self.series_mean),
            "timings": ((*per_run, *RESULT), self.timings),
        }
        types = {**TYPES, **self._kinds}
        return {name: (tuple((c, types[c]) for c in columns), rows) for name, (columns, rows) in found.items()}

    def add(self, point: Point, store: Store) -> None:
        """Everything that is done of a point."""
        labels = tuple(_cell(self._kinds[path], point.labels[path]) for path in self._axes)
        order = _order(point)
        values: dict[tuple[str, ...], list[float]] = {}
        curves: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
        for task in (point.theory, *point.seeds):
            record = store.load(task.hash)
            if record is None:
                continue
            seed = None if task is point.theory else task.seed
            head = (task.hash, *labels, seed)
            rows = sorted(record["rows"], key=order)
            self.results += [(*head, *row, None, None) for row in rows if row[3] in self._chosen]
            self.timings += [(*head, *row, None, None) for row in record["timings"] if row[3] in self._chosen]
            for *place, value in rows:
                values.setdefault(tuple(place), []).append(value)
            self._add_curves(head, task, record["curves"], curves)
        self._summarize(point, labels, values, order)
        self._average(point, labels, curves)

    def _add_curves(
        self,
        head: tuple[Any, ...],
        task: Task,
        told: Iterable[Sequence[Any]],
        curves: dict[tuple[str, str, int], list[tuple[float, float]]],
    ) -> None:
        for node, stage, step, error, predicted in _with_means(told):
            if task.seed in self._series:
                self.series.append((*head, node, stage, step, error, None if math.isnan(predicted) else predicted))
            curves.setdefault((node, stage, step), []).append((error, predicted))

    def _summarize(
        self, point: Point, labels: tuple[Any, ...], values: Mapping[tuple[str, ...], list[float]], order: Any
    ) -> None:
        headline: dict[str, Any] = {}
        self.headlines.append({"point": point.number, "labels": dict(point.labels), "metrics": headline})
        for place in sorted(values, key=order):
            *where, metric = place
            if metric not in self._chosen:
                continue
            interval = mean_interval(values[place], self._confidence)
            if metric == "rmse":
                interval = _root(mean_interval(values[*where, "mse"], self._confidence))
            n = None if metric in THEORY_METRICS else interval.n
            head = (point.number, *labels, *where)
            self.summary.append((*head, metric, *interval[:3], n))
            if where[0] == ALL and where[2] in {"", ESTIMATE.name}:
                headline[metric] = list(interval[:3])
            if metric == "nees" and "nees_band" in self._chosen:
                dimension = point.scenario.system().nx
                band = nees_band(dimension, interval.n, BAND_CONFIDENCE)
                self.summary.append((*head, "nees_band", float(dimension), *band, n))

    def _average(
        self, point: Point, labels: tuple[Any, ...], curves: Mapping[tuple[str, str, int], list[tuple[float, float]]]
    ) -> None:
        for (node, stage, step), pairs in curves.items():
            errors, predictions = zip(*pairs, strict=True)
            mean, low, high, n = mean_interval(errors, self._confidence)
            predicted = math.fsum(predictions) / n
            told = None if math.isnan(predicted) else predicted
            self.series_mean.append((point.number, *labels, node, stage, step, mean, low, high, told, n))


def _with_means(curves: Iterable[Sequence[Any]]) -> Iterator[tuple[str, str, int, float, float]]:
    """All curves, and before those of a stage their mean over the nodes: (node, stage, step, |e|², trace P)."""
    by_stage: dict[str, list[Sequence[Any]]] = {}
    for curve in curves:
        by_stage.setdefault(curve[1], []).append(curve)
    for stage, of_stage in by_stage.items():
        sums: dict[int, list[tuple[float, float]]] = {}
        single = []
        for node, _, steps, errors, predicted in of_stage:
            known = predicted or [math.nan] * len(steps)
            for step, error, P in zip(steps, errors, known, strict=True):
                sums.setdefault(step, []).append((error, P))
                single.append((node, stage, step, error, P))
        for step in sorted(sums):
            error, P = np.array(sums[step]).mean(axis=0).tolist()
            yield ALL, stage, step, error, P
        yield from single


def _root(interval: Interval) -> Interval:
    """The interval of the root of a mean square."""
    low, high = (None if end is None else math.sqrt(max(0.0, end)) for end in (interval.low, interval.high))
    return Interval(math.sqrt(interval.mean), low, high, interval.n)


def _order(point: Point) -> Any:
    """Key that sorts rows: by node, sender, stage and metric, each in its natural order."""
    nodes = {name: n for n, name in enumerate(("", ALL, *map(str, point.scenario.ids)))}
    stages = {name: n for n, name in enumerate(("", *(stage.name for stage in BUILT_IN)))}
    numbers = {name: n for n, name in enumerate(METRICS)}

    def key(row: Sequence[Any]) -> tuple[Any, ...]:
        node, sender, stage, metric = row[:4]
        return nodes[node], nodes[sender], stages.get(stage, len(stages)), stage, numbers[metric]

    return key


def _kind(labels: Sequence[Label]) -> pa.DataType:
    """The type of an axis' column: numbers where all are, and text otherwise."""
    if any(isinstance(label, bool | str) for label in labels):
        return pa.string()
    return pa.int64() if all(isinstance(label, int) for label in labels) else pa.float64()


def _cell(kind: pa.DataType, label: Label) -> Label:
    if kind == pa.string():
        return str(label).lower() if isinstance(label, bool) else str(label)
    return float(label) if kind == pa.float64() else label


def _csv(columns: Sequence[tuple[str, pa.DataType]], rows: Rows) -> bytes:
    """Floats so that they can be read back exactly; nothing where there is nothing."""
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow([name for name, _ in columns])
    table.writerows(rows)
    return text.getvalue().encode()


def _parquet(columns: Sequence[tuple[str, pa.DataType]], rows: Rows) -> bytes:
    cells: list[Sequence[Any]] = list(zip(*rows, strict=True)) if rows else [()] * len(columns)
    arrays = [pa.array(column, type=kind) for (_, kind), column in zip(columns, cells, strict=True)]
    table = pa.Table.from_arrays(arrays, names=[name for name, _ in columns])
    sink = io.BytesIO()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()
