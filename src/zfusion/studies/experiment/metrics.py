"""The metrics of one run, from what was observed of it: rows (node, sender, stage, metric, value).

`node` is ALL for the network as a whole; `sender` is empty except for what is about an edge. Averages over time leave
out the first `burn_in` steps; counts are of the whole run.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zfusion.drivers.metrics import Latencies, NodeReport
from zfusion.methods.covariances import advance, prior
from zfusion.methods.layout import Layout
from zfusion.methods.neighbourhood import StepModels
from zfusion.methods.prediction import predict
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.schema.run import LARGEST_WINDOW
from zfusion.model.statistics import step_models
from zfusion.model.types import Array, NodeId, sorted_ids
from zfusion.stages import ESTIMATE, INTERMEDIATE, MEASUREMENT
from zfusion.studies.experiment.catalogue import ALL
from zfusion.studies.experiment.observed import Observer, Told, used_sets
from zfusion.used_sets import UsedSet

MOST_EDGES = 64
"""Edges up to which a run has rows for each of them; beyond, for the nodes only."""


COUNTED = ("missed", "late", "lost", "revised", "too_late", "stale")
"""What nodes count of every edge and stage."""

RESPONSES = {"response_p50": 0.5, "response_p99": 0.99}

QUANTILES = {"latency_p50": 0.5, "latency_p90": 0.9, "latency_p99": 0.99}


class Row(NamedTuple):
    """One value of a run."""

    node: str
    sender: str
    stage: str
    metric: str
    value: float


class Curve(NamedTuple):
    """Squared errors over time of one node's estimates of one stage."""

    node: str
    stage: str
    steps: list[int]
    error_sq: list[float]
    predicted: list[float]
    """trace P; empty where nothing was predicted."""


class _Errors(NamedTuple):
    """One node's errors of one stage, over the steps that count."""

    steps: Array
    squared: Array
    predicted: Array | None
    nees: Array | None


Reports = Mapping[NodeId, Sequence[NodeReport]]


def metrics(observer: Observer, reports: Reports, burn_in: int) -> tuple[list[Row], list[Curve]]:
    """All metrics of a run, and its errors over time."""
    observer.finish()
    rows: list[Row] = []
    curves: list[Curve] = []
    if observer.scenario.truth_known:
        errors = _errors(observer)
        rows += _error_rows(observer, errors, burn_in)
        curves += [
            Curve(str(i), stage, e.steps.tolist(), e.squared.tolist(), _listed(e.predicted))
            for (stage, i), e in errors.items()
        ]
    rows += _disagreement_rows(observer, burn_in)
    rows += _use_rows(observer, burn_in)
    rows += _report_rows(observer, reports)
    rows += _response_rows(observer, reports)
    rows += _traffic_rows(observer)
    rows += _latency_rows(observer)
    return rows, curves


def _listed(values: Array | None) -> list[float]:
    listed: list[float] = [] if values is None else values.tolist()
    return listed


def _errors(observer: Observer) -> dict[tuple[str, NodeId], _Errors]:
    """By stage and node."""
    scenario = observer.scenario
    path = SamplePath(scenario.system(), scenario.seed)
    truth = np.array([path.truth(k) for k in range(scenario.steps + 1)])
    found = {}
    for stage in observer.told_stages:
        covariances = _covariances(observer, stage)
        for i in scenario.ids:
            told = observer.estimates.get((stage, i))
            if told is not None:
                found[stage, i] = _compared(told, truth, covariances.get(i))
    return found


def _compared(told: Told, truth: Array, P: Array | None) -> _Errors:
    steps = np.array(told.steps)
    errors = np.array(told.x) - truth[steps]
    squared = np.einsum("ka,ka->k", errors, errors)
    if P is None:
        return _Errors(steps, squared, None, None)
    try:
        nees = np.einsum("ka,ka->k", errors, np.linalg.solve(P, errors[:, :, None])[:, :, 0])
    except np.linalg.LinAlgError:  # an error that is predicted to be zero in some direction has no NEES
        nees = None
    return _Errors(steps, squared, np.einsum("kaa->k", P), nees)


def _covariances(observer: Observer, stage: str) -> dict[NodeId, Array]:
    """By node, what was predicted of the errors, (n, nx, nx): what it told, or what its used sets say."""
    told = {i: observer.estimates[stage, i] for i in observer.scenario.ids if (stage, i) in observer.estimates}
    if stage == INTERMEDIATE.name:
        return _from_used_sets(observer, told)
    given = {i: [P for P in of.P if P is not None] for i, of in told.items()}
    return {i: np.array(covariances) for i, covariances in given.items() if len(covariances) == len(told[i].x)}


def _from_used_sets(observer: Observer, told: Mapping[NodeId, Told]) -> dict[NodeId, Array]:
    """Covariances of the nodes' filters, in every life from the prior on: a life that has used nothing is at it."""
    system = observer.scenario.system()
    lives = [(i, born) for i, of in told.items() for born in sorted(set(of.born))]
    number = {life: n for n, life in enumerate(lives)}
    used: dict[int, dict[NodeId, UsedSet]] = {}
    for i, of in told.items():
        for step, born, ids in zip(of.steps, of.born, of.used, strict=True):
            used.setdefault(step, {})[number[i, born]] = ids
    neighbourhoods: dict[NodeId, UsedSet] = {n: observer.graph.neighbours(i) for n, (i, _) in enumerate(lives)}
    nothing: dict[NodeId, UsedSet] = dict.fromkeys(neighbourhoods, ())
    changes = _changes(observer, number)
    layout = Layout.build(neighbourhoods, {sensor.id: sensor.ny for sensor in system.sensors})
    states = {0: prior(layout, system.initial_covariance)}
    models = StepModels(lambda: step_models(system, observer.scenario.ids))
    last = max(used, default=0)
    P = np.empty((last + 1, len(lives), system.nx, system.nx))
    for step in range(1, last + 1):
        first = step
        for life, changed, ids in changes.get(step, ()):  # what came late: back to its step, and forward again
            known = used.setdefault(changed, {})
            known[life] = tuple(sorted_ids({*known.get(life, ()), *ids}))
            first = min(first, changed)
        for k in range(first, step + 1):
            states[k] = advance(layout, states[k - 1], models.at(k)[0], layout.used({**nothing, **used.get(k, {})}))
        states.pop(step - LARGEST_WINDOW - 1, None)
        P[step] = layout.in_order(layout.own(states[step].P))
    return {i: P[of.steps, [number[i, born] for born in of.born]] for i, of in told.items()}


def _changes(observer: Observer, number: Mapping[tuple[NodeId, int], int]) -> dict[int, list[tuple[int, int, UsedSet]]]:
    """By step, what was taken in at it: (which life, step that was changed, whose measurements)."""
    found: dict[int, list[tuple[int, int, UsedSet]]] = {}
    for i, revisions in observer.revised.items():
        for step, changed, ids in revisions:
            born = max((b for j, b in number if j == i and b <= changed), default=None)
            if born is not None:
                found.setdefault(step, []).append((number[i, born], changed, ids))
    return found


def _error_rows(observer: Observer, errors: Mapping[tuple[str, NodeId], _Errors], burn_in: int) -> Iterator[Row]:
    last = observer.scenario.steps
    for stage in observer.told_stages:
        parts = {i: _after(errors[stage, i], burn_in) for i in observer.scenario.ids if (stage, i) in errors}
        parts = {i: part for i, part in parts.items() if len(part.steps)}
        if not parts:
            continue
        for name, chosen in [(ALL, list(parts.values())), *((str(i), [part]) for i, part in parts.items())]:
            yield from (Row(name, "", stage, metric, value) for metric, value in _summed(chosen, last))


def _after(errors: _Errors, burn_in: int) -> _Errors:
    kept = errors.steps > burn_in
    return _Errors(*(None if part is None else part[kept] for part in errors))  # type: ignore[arg-type]


def _summed(parts: Sequence[_Errors], last: int) -> Iterator[tuple[str, float]]:
    """The metrics of several nodes' errors together: every estimate has the same weight."""
    mse = float(np.concatenate([part.squared for part in parts]).mean())
    yield "mse", mse
    yield "rmse", math.sqrt(mse)
    predictions = [part.predicted for part in parts if part.predicted is not None]
    if len(predictions) == len(parts):
        predicted = float(np.concatenate(predictions).mean())
        yield "predicted_mse", predicted
        yield "excess_mse", mse - predicted
    nees = [part.nees for part in parts if part.nees is not None]
    if len(nees) == len(parts):
        yield "nees", float(np.concatenate(nees).mean())
        final = [of[part.steps == last] for of, part in zip(nees, parts, strict=True)]
        if any(map(len, final)):
            yield "nees_final", float(np.concatenate(final).mean())


def _disagreement_rows(observer: Observer, burn_in: int) -> Iterator[Row]:
    """Mean over the steps at which at least two nodes told an estimate; of two of one step the later counts."""
    scenario = observer.scenario
    place = {i: n for n, i in enumerate(scenario.ids)}
    for stage in observer.told_stages:
        x = np.full((scenario.steps + 1, len(place), scenario.system().nx), np.nan)
        for i, row in place.items():
            told = observer.estimates.get((stage, i))
            if told is not None:
                x[told.steps, row] = np.array(told.x)
        x = x[burn_in + 1 :]
        there = ~np.isnan(x[:, :, 0])
        count = there.sum(axis=1)
        x, there, count = x[count > 1], there[count > 1], count[count > 1]
        if len(x):
            known = np.where(there[:, :, None], x, 0.0)
            distance = np.where(there[:, :, None], x - (known.sum(axis=1) / count[:, None])[:, None], 0.0)
            by_step = np.einsum("kia,kia->k", distance, distance) / count
            yield Row(ALL, "", stage, "disagreement", float(by_step.mean()))


def _use_rows(observer: Observer, burn_in: int) -> Iterator[Row]:
    """Used fractions, the age of information, and how much of it was not there at all."""
    graph, ids, stages = observer.graph, observer.scenario.ids, observer.stages
    place = {i: n for n, i in enumerate(ids)}
    sets = used_sets(observer)
    counted = np.diagonal(sets.fused, axis1=1, axis2=2).copy()
    counted[: burn_in + 1] = False
    found: dict[tuple[str, str], dict[str, NDArray[Any]]] = {}

    def note(metric: str, stage: str, i: NodeId, values: NDArray[Any]) -> None:
        if values.size:
            found.setdefault((metric, stage), {})[str(i)] = values

    def note_ages(stage: str, i: NodeId, at: NDArray[np.int64], newest: NDArray[np.int64]) -> None:
        note("unheard", stage, i, newest == 0)
        note("age", stage, i, (at[:, None] - newest)[newest > 0])

    for i in ids:
        row = place[i]
        at = np.flatnonzero(counted[:, row]).astype(np.int64)
        others = [place[j] for j in graph.neighbours(i) if j != i]
        newest = sets.newest[at, row]
        note("used_fraction", MEASUREMENT.name, i, sets.used[at, row][:, others])
        if len(stages) == 1:
            note_ages(ESTIMATE.name, i, at, newest[:, others])
            continue
        note_ages(stages[1], i, at, newest[:, others])
        note("used_fraction", stages[1], i, sets.fused[at, row][:, others])
        for column in others:  # what a fused neighbour knows is known
            known = np.where(sets.fused[at, row, column][:, None], sets.newest[at, column], 0)
            newest = np.maximum(newest, known)
        note_ages(ESTIMATE.name, i, at, newest[:, [place[j] for j in graph.two_hop(i) if j != i]])
    for (metric, stage), of_nodes in found.items():
        yield from _means(metric, stage, of_nodes)


def _means(metric: str, stage: str, of_nodes: Mapping[str, NDArray[Any]]) -> Iterator[Row]:
    """Means of every node's values, and of the nodes' means."""
    means = {node: float(values.mean()) for node, values in of_nodes.items()}
    yield Row(ALL, "", stage, metric, math.fsum(means.values()) / len(means))
    yield from (Row(node, "", stage, metric, value) for node, value in means.items())


def _report_rows(observer: Observer, reports: Reports) -> Iterator[Row]:
    """What the nodes counted, over all their lives."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for i in observer.scenario.ids:
        lives = reports.get(i, ())
        for name in (ALL, str(i)):
            counts[name, "", "restarts"] += max(0, len(lives) - 1)
            for life in lives:
                counts[name, "", "completed"] += life.completed
                counts[name, "", "skipped"] += life.skipped
                counts[name, "", "fallbacks"] += life.fallbacks
                for edge in life.edges.values():
                    for kind in COUNTED:
                        for stage in observer.stages:
                            counts[name, stage, kind] += edge.get(kind, {}).get(stage, 0)
    yield from (Row(node, "", stage, metric, float(count)) for (node, stage, metric), count in counts.items())


def _response_rows(observer: Observer, reports: Reports) -> Iterator[Row]:
    """How long the nodes took, by the clock of the world that they ran in."""
    for name, nodes in [(ALL, observer.scenario.ids), *((str(i), (i,)) for i in observer.scenario.ids)]:
        merged = Latencies()
        for life in (life for i in nodes for life in reports.get(i, ())):
            merged.merge({int(number): count for number, count in life.latency.items()})
        for metric, q in RESPONSES.items():
            quantile_us = merged.quantile_us(q)
            if quantile_us is not None:
                yield Row(name, "", ESTIMATE.name, metric, quantile_us / 1e6)


def _traffic_rows(observer: Observer) -> Iterator[Row]:
    for metric, counter in (("messages", observer.messages), ("bytes", observer.bytes)):
        total: Counter[tuple[str, str]] = Counter()
        for (node, stage), count in counter.items():
            for name in (ALL, str(node)):
                for of in ("", stage):
                    total[name, of] += count
        yield from (Row(node, "", stage, metric, float(count)) for (node, stage), count in total.items())


def _latency_rows(observer: Observer) -> Iterator[Row]:
    """Quantiles of the one-way latencies of what arrived: of each edge, where they are not too many, of each node."""
    by_place: dict[tuple[str, str, str], list[int]] = {}
    edges = len({(sender, receiver) for sender, receiver, _ in observer.latencies_ns})
    for (sender, receiver, stage), latencies in observer.latencies_ns.items():
        places = [(ALL, ""), (str(receiver), ""), *([(str(receiver), str(sender))] if edges <= MOST_EDGES else [])]
        for node, of in places:
            by_place.setdefault((node, of, stage), []).extend(latencies)
    for (node, sender, stage), latencies in by_place.items():
        found = np.quantile(latencies, list(QUANTILES.values()), method="inverted_cdf")
        yield from (Row(node, sender, stage, q, float(ns) / 1e9) for q, ns in zip(QUANTILES, found, strict=True))


def theory_metrics(scenario: Scenario, burn_in: int) -> list[Row]:
    """What is predicted of a scenario without running it: the bounds, and the errors if every message arrived.

    Raises RunError where the state outgrows what can be computed with.
    """
    prediction = predict(scenario.system(), scenario.network, scenario.steps)
    rows = []
    traces = {
        (ESTIMATE.name, "bound_local"): np.einsum("kiaa->ki", prediction.local),
        (INTERMEDIATE.name, "design_mse"): np.einsum("kiaa->ki", prediction.intermediate),
        (ESTIMATE.name, "design_mse"): np.einsum("kiaa->ki", prediction.distributed),
    }
    everywhere = float(np.einsum("kaa->k", prediction.centralized)[burn_in + 1 :].mean())
    rows.append(Row(ALL, "", ESTIMATE.name, "bound_centralized", everywhere))
    for (stage, metric), trace in traces.items():
        means = trace[burn_in + 1 :].mean(axis=0)
        rows.append(Row(ALL, "", stage, metric, float(means.mean())))
        rows += [Row(str(i), "", stage, metric, float(of)) for i, of in zip(prediction.ids, means, strict=True)]
    return rows
