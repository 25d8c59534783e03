"""Methods compared: the same measurements and the same network for all, and what each costs.

Every seed gives measurements and the links' randomness, the same for all methods; a recording has measurements of its
own, and stretches of its steps stand in the place of seeds. Only steps count of which every method has an estimate.
What a method computes in is measured in CPU time of this machine: the only numbers that differ from run to run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zfusion.drivers.workers import in_order
from zfusion.errors import InputError
from zfusion.methods import chosen
from zfusion.methods.prediction import predict
from zfusion.methods.two_stage import CENTRALIZED
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array
from zfusion.studies.compare import (
    ALL,
    CONFIDENCE,
    SHORTEST,
    STRETCHES,
    Comparison,
    means_over_steps,
    paired_by_node,
)
from zfusion.studies.contestants import Field
from zfusion.studies.intervals import Interval, mean_interval
from zfusion.studies.method_runs import Cost, SeedRun, run_all

BELIEVED = 0.05
"""By how much of itself a mean NEES may be off before covariances are not to be believed."""

WORTH_PROCESSES = 2_000
"""Steps of all nodes, methods and seeds from which on processes share the work: to start one takes a second."""

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Standing:
    """How one method did."""

    label: str
    mse: Interval
    """Mean squared error, over nodes and steps."""
    by_node: Mapping[str, float]
    ideal_mse: Interval | None
    """On the ideal network; None where that is the network."""
    nees: Interval | None
    """eᵀ P⁻¹ e / nx: 1 where covariances are right. None where they do not exist, or are singular."""
    rounds: int
    """Exchanges a step."""
    messages: float
    """That all nodes send to neighbours in a step: one for each edge, lost or not."""
    bytes: float
    """The same, their payloads."""
    cpu_us: float
    """Median time in the method of a node for a step. Timing: of this machine, now."""
    against: Comparison | None
    """With the first method; None of the first itself."""
    note: str
    heavy_tailed: bool = False
    """Whether matrices are random: then rare large errors make up much of the mean, and few seeds miss them."""

    @property
    def believed(self) -> str:
        """Whether its covariances can be: "yes"; "optimistic" where errors are larger than it says, or "pessimistic";

        "unclear" where the interval does not tell, or where tails are heavy and it is too small, which it is in most
        samples then; "unknown" where there is no NEES.
        """
        if self.nees is None:
            return "unknown"
        mean, low, high, _ = self.nees
        if abs(mean - 1) <= BELIEVED:
            return "yes"
        if low is None or high is None or low <= 1 + BELIEVED <= high or low <= 1 - BELIEVED <= high:
            return "unclear"
        if mean < 1:
            return "unclear" if self.heavy_tailed else "pessimistic"
        return "optimistic"

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return {
            "method": self.label,
            "mse": self.mse._asdict(),
            "nodes": dict(self.by_node),
            "ideal_mse": None if self.ideal_mse is None else self.ideal_mse._asdict(),
            "nees": None if self.nees is None else self.nees._asdict(),
            "believed": self.believed,
            "rounds": self.rounds,
            "messages_per_step": self.messages,
            "bytes_per_step": self.bytes,
            "timing": {"cpu_us_per_node_and_step": self.cpu_us, "reproducible": False},
            "against": None if self.against is None else self.against.as_dict(),
            "note": self.note,
        }


@dataclass(frozen=True)
class MethodComparison:
    """How all of them did."""

    scenario: str
    unit: str
    """What intervals are over: "seed", or "stretch" of a recording."""
    units: int
    steps: int
    local: Mapping[str, float]
    """Predicted mean squared error of the best estimate from a node's own measurements, by node and over ALL."""
    centralized: float
    """The same from all measurements, without any loss: nobody can be better."""
    standings: Sequence[Standing]
    refused: Mapping[str, str]

    @property
    def best(self) -> float:
        """What a centre with all measurements reaches: on these very measurements, where `centralized` is one of the
        methods, else as predicted."""
        for standing in self.standings:
            if standing.label == CENTRALIZED.name:
                return (standing.ideal_mse or standing.mse).mean
        return self.centralized

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return {
            "scenario": self.scenario,
            "unit": self.unit,
            "units": self.units,
            "steps": self.steps,
            "bounds": {"local": dict(self.local), "centralized": self.centralized, "best": self.best},
            "methods": [standing.as_dict() for standing in self.standings],
            "refused": dict(self.refused),
        }


def compare_methods(
    field: Field, seeds: Sequence[int], *, jobs: int = 1, progress: Progress | None = None
) -> MethodComparison:
    """Run them all; the same whatever `jobs`, but for the timing. Of a recording no seeds matter.

    InputError where the true state is not known, or a recording is too short.
    """
    first = field.contestants[0].scenario
    if field.truths is None and not first.truth_known:
        raise InputError("the true state is not known where measurements are not simulated")
    if not (seeds or field.truths):
        raise InputError("seeds: expected 1 or more")
    found: list[SeedRun] = []
    work = partial(run_all, field)
    configurations = sum(1 + (one.ideal is not None) for one in field.contestants)
    if configurations * len(seeds) * first.steps * len(first.ids) < WORTH_PROCESSES:
        jobs = 1
    for one in in_order(work, [None] if field.truths is not None else list(seeds), jobs):
        found.append(one)
        if progress is not None:
            progress(1)
    if field.truths is not None:
        unit, errors, nees = "stretch", _cut(found[0].errors, first), _cut(found[0].nees, first)
    else:
        unit = "seed"
        errors = np.array([[means_over_steps(series) for series in one.errors] for one in found])
        nees = np.array([[means_over_steps(series) for series in one.nees] for one in found])
    return _judged(field, unit, errors, nees / first.system().nx, [one.costs for one in found])


def _cut(series: Sequence[Array], scenario: Scenario) -> Array:
    """(stretches, configurations, m); InputError where there are not two."""
    count = min(STRETCHES, len(series[0]) // SHORTEST)
    if count < 2:
        raise InputError(f"{scenario.name}: expected {2 * SHORTEST} steps or more (is {len(series[0])})")
    parts = [np.array_split(one, count) for one in series]
    return np.array([[means_over_steps(part[n]) for part in parts] for n in range(count)])


def _judged(field: Field, unit: str, errors: Array, nees: Array, costs: Sequence[Sequence[Cost]]) -> MethodComparison:
    """From (units, configurations, m)."""
    contestants = field.contestants
    scenario, count = contestants[0].scenario, len(contestants)
    labels, ids = [one.label for one in contestants], scenario.ids
    there: NDArray[np.bool_] = np.logical_not(np.isnan(errors).any(axis=(0, 1)))
    if not there.any():
        raise InputError("no node has an estimate of every method")
    several = len(errors) > 1 and count > 1
    against = paired_by_node(labels, errors[:, :count], ids, "mse", unit) if several else []
    whole = errors[:, :, there].mean(axis=2)
    twins = iter(range(count, errors.shape[1]))
    standings = []
    for n, one in enumerate(contestants):
        twin = None if one.ideal is None else mean_interval(whole[:, next(twins)].tolist(), CONFIDENCE)
        of = [seed[n] for seed in costs]
        taken = scenario.steps * len(of)
        usable: Array = nees[:, n]
        usable = usable[:, ~np.any(np.isnan(usable), axis=0)]
        believed = usable.mean(axis=1).tolist() if usable.size else []
        standings.append(
            Standing(
                label=one.label,
                mse=mean_interval(whole[:, n].tolist(), CONFIDENCE),
                by_node={str(i): float(errors[:, n, p].mean()) for p, i in enumerate(ids) if there[p]},
                ideal_mse=twin,
                nees=mean_interval(believed, CONFIDENCE) if believed else None,
                rounds=len(chosen(one.scenario).stages) if any(cost.messages for cost in of) else 0,
                messages=sum(cost.messages for cost in of) / taken,
                bytes=sum(cost.bytes for cost in of) / taken,
                cpu_us=float(np.median([ns for cost in of for ns in cost.ns])) / 1000,
                against=against[n - 1] if n and against else None,
                note=chosen(one.scenario).family.note,
                heavy_tailed=_has_random_matrices(scenario),
            )
        )
    local, centralized = _bounds(scenario)
    return MethodComparison(
        scenario.name, unit, len(errors), scenario.steps, local, centralized, standings, field.refused
    )


def _has_random_matrices(scenario: Scenario) -> bool:
    system = scenario.system()
    schedules = (system.F, *(sensor.H for sensor in system.sensors))
    return any(matrix.is_random for schedule in schedules for matrix in schedule.items)


def _bounds(scenario: Scenario) -> tuple[dict[str, float], float]:
    """Predicted means over the steps: own measurements only, by node and over ALL; and all measurements."""
    prediction = predict(scenario.system(), scenario.network, scenario.steps)
    local = np.einsum("kmaa->m", prediction.local[1:]) / scenario.steps
    of = {str(i): float(local[position]) for position, i in enumerate(prediction.ids)}
    return of | {ALL: float(local.mean())}, float(np.einsum("kaa->", prediction.centralized[1:]) / scenario.steps)
