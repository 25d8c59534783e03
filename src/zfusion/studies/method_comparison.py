"""Methods compared: the same measurements and the same network for all, and what each costs.

Every seed gives measurements and the links' randomness, the same for all methods; a recording has measurements of its
own, and stretches of its steps stand in the place of seeds. Only steps count of which every method has an estimate.
What a method computes in is measured in CPU time of this machine: the only numbers that differ from run to run.
"""

from __future__ import annotations

import time
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from zfusion import keys
from zfusion.drivers.designs import handed_on, with_design
from zfusion.drivers.rerun import on_recording, read_recorded
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError, ZfusionError
from zfusion.methods import METHODS, chosen
from zfusion.methods.check import check_method
from zfusion.methods.prediction import predict
from zfusion.methods.protocol import Fields, Method, Outcome, Revising, Setting, Wary
from zfusion.methods.two_stage import CENTRALIZED
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Overrides, Scenario
from zfusion.model.types import Array, NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import ESTIMATE, Message, Stage
from zfusion.studies.compare import (
    ALL,
    CONFIDENCE,
    SHORTEST,
    STRETCHES,
    Comparison,
    common_steps,
    means_over_steps,
    paired_by_node,
    series_of,
)
from zfusion.studies.intervals import Interval, mean_interval
from zfusion.studies.parallel import in_order
from zfusion.studies.settings import parse_settings, with_settings
from zfusion.used_sets import Ledger, UsedSet

BELIEVED = 0.05
"""By how much of itself a mean NEES may be off before covariances are not to be believed."""

WORTH_PROCESSES = 2_000
"""Steps of all nodes, methods and seeds from which on processes share the work: to start one takes a second."""

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Contestant:
    """A method that can run: under the scenario's links, and, where it has any, on the ideal network too."""

    label: str
    scenario: Scenario
    ideal: Scenario | None


@dataclass(frozen=True)
class Field:
    """All that are compared, and who could not be."""

    contestants: Sequence[Contestant]
    refused: Mapping[str, str]
    """By label the reason, in one line."""
    truths: Mapping[int, Array] | None = None
    """By step, of a recording; None where each seed draws its own."""


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


def field_of(scenario: Scenario, labels: Sequence[str], designs: Path) -> Field:
    """The methods that can stand the scenario, and the reasons of those that cannot; designs go into `designs`.

    A label is a method's name, with options after colons: ``consensus:rounds=8:step_size=fastest``. InputError for a
    name that is no method's or comes twice, and where nobody is left.
    """
    if len(set(labels)) != len(labels):
        raise InputError(f"--methods: expected every method once (is {', '.join(labels)})")
    contestants, refused = [], {}
    for number, label in enumerate(labels):
        try:
            contestants.append(_contestant(scenario, label, designs / f"{number}.npz"))
        except UnknownMethodError:
            raise
        except ZfusionError as error:
            refused[label] = _one_line(error, label)
    if not contestants:
        told = "; ".join(f"{label}: {reason}" for label, reason in refused.items())
        raise InputError(f"no method can stand {scenario.name}: {told}")
    return Field(contestants, refused)


def field_of_recording(
    recording: Recording, labels: Sequence[str], designs: Path, overrides: Overrides | None = None
) -> Field:
    """The same for the measurements on a recording, under its scenario's links or others.

    InputError also where the truth is not on it.
    """
    recorded = on_recording(recording)
    scenario = handed_on(recorded, recorded.with_overrides(**(overrides or {})))
    truths = read_recorded(recording, scenario).truths
    if not truths:
        raise InputError(f"{recording.path}: the true state is not on it: there is nothing to set estimates beside")
    field = field_of(scenario, labels, designs)
    return Field(field.contestants, field.refused, truths)


class UnknownMethodError(InputError):
    """A name that is no method's."""


def _contestant(scenario: Scenario, label: str, design: Path) -> Contestant:
    name, *settings = label.split(":")
    if name not in METHODS:
        raise UnknownMethodError(f"--methods: expected some of {', '.join(METHODS)} (is {name!r})")
    if settings:
        changed = {"name": name, "options": parse_settings(settings, "--methods")}
        wanted = with_settings(scenario, {"method": changed}, label)
    else:
        wanted = scenario.with_overrides(method=name)
        check_method(wanted, label)
    scenario = _ready(handed_on(scenario, wanted), design)
    ideal = _without_links(scenario)
    return Contestant(label, scenario, None if ideal is None else _ready(ideal, design.with_suffix(".ideal.npz")))


def _ready(scenario: Scenario, design: Path) -> Scenario:
    """With its design in a file, and known to start."""
    scenario = with_design(scenario, design)
    Simulation(scenario).close()
    return scenario


def _without_links(scenario: Scenario) -> Scenario | None:
    """The scenario on an ideal network; None where it has that anyway."""
    if not scenario.links.model_fields_set and not scenario.faults:
        return None
    document = tomllib.loads(scenario.anchored().to_toml())
    if scenario.links.topology is not None and isinstance(document.get("method"), dict):
        document["method"].pop("design", None)  # it is one for those topologies
    kept = {key: value for key, value in document.items() if key not in ("links", "faults")}
    return Scenario.model_validate(kept)


def _one_line(error: ZfusionError, label: str) -> str:
    lines = [line.removeprefix(f"{label}: ").removesuffix(" (is None)") for line in str(error).splitlines()]
    return "; ".join(line.removeprefix(f"method {label.partition(':')[0]}: ") for line in lines)


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
    found: list[_Seed] = []
    work = partial(_run_all, field)
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


class _Cost(NamedTuple):
    messages: int
    bytes: int
    ns: Sequence[int]
    """Of every node and step."""


class _Seed(NamedTuple):
    errors: Sequence[Array]
    """Squared, by configuration, (steps, m): the contestants, then their ideal twins where there are any."""
    nees: Sequence[Array]
    costs: Sequence[_Cost]
    """By contestant."""


def _run_all(field: Field, seed: int | None) -> _Seed:
    scenarios = [one.scenario for one in field.contestants]
    ideals = [one.ideal for one in field.contestants if one.ideal is not None]
    if seed is not None:
        scenarios = [scenario.with_overrides(seed=seed) for scenario in scenarios]
        ideals = [scenario.with_overrides(seed=seed) for scenario in ideals]
    truth = _truth(scenarios[0], field.truths)
    runs = [_observed(scenario) for scenario in scenarios]
    estimates = [told for told, _ in runs] + [_observed(scenario)[0] for scenario in ideals]
    ids = scenarios[0].ids
    errors = common_steps([series_of(iter(told), ids, truth, "mse") for told in estimates])
    nees = [_nees(told, ids, truth) for told in estimates[: len(scenarios)]]
    return _Seed(errors, nees, [cost for _, cost in runs])


def _truth(scenario: Scenario, recorded: Mapping[int, Array] | None) -> Array:
    """(steps + 1, nx), NaN where it is not known."""
    if recorded is None:
        path = SamplePath(scenario.system(), scenario.seed)
        return np.array([path.truth(k) for k in range(scenario.steps + 1)])
    truth = np.full((scenario.steps + 1, scenario.system().nx), np.nan)
    for step, x in recorded.items():
        if step <= scenario.steps:
            truth[step] = x
    return truth


def _nees(estimates: Sequence[Message], ids: Sequence[NodeId], truth: Array) -> Array:
    try:
        return series_of(iter(estimates), ids, truth, "nees")
    except InputError:  # an error that is predicted to be zero in some direction
        return np.full((len(truth) - 1, len(ids)), np.nan)


def _observed(scenario: Scenario) -> tuple[list[Message], _Cost]:
    """Simulate it: its estimates, and what it cost."""
    make, told, timed, payloads = chosen(scenario), list[Message](), list[_Timed](), Counter[tuple[str, str]]()
    sizes: Counter[tuple[str, str]] = Counter()

    def method(setting: Setting) -> Method:
        made = make(setting)
        timed.append(_TimedAndWary(made) if isinstance(made, Wary) else _Timed(made))
        return timed[-1]

    def observe(message: Message, _now_ns: int) -> None:
        if message.stage == ESTIMATE.name:
            told.append(message)

    def record(key: str, payload: bytes, _now_ns: int) -> None:
        with suppress(ZfusionError):
            said = keys.parse(key)
            payloads[str(said.node), said.stage] += 1
            sizes[str(said.node), said.stage] += len(payload)

    simulation = Simulation(scenario, method=method, observe=observe, record=record)
    try:
        simulation.run()
    finally:
        simulation.close()
    listeners = _listeners(make.network(scenario.network))
    exchanged = {stage.name for stage in make.stages}
    sent = [
        (listeners[node] * count, listeners[node] * sizes[node, stage])
        for (node, stage), count in payloads.items()
        if stage in exchanged
    ]
    ns = [spent for one in timed for spent in one.spent_ns.values()]
    return told, _Cost(sum(count for count, _ in sent), sum(size for _, size in sent), ns)


def _listeners(graph: Network) -> Counter[str]:
    """How many others hear each node."""
    return Counter(str(j) for i in graph.ids for j in graph.neighbours(i) if j != i)


class _Timed:
    """A method, and the CPU time that it took by step."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self.spent_ns: Counter[int] = Counter()
        self._step = 0

    @property
    def stages(self) -> tuple[Stage, ...]:
        return self._method.stages

    def begin(self, step: int, y: Array | None) -> Fields:
        self._step, began = step, time.process_time_ns()
        fields = self._method.begin(step, y)
        self.spent_ns[step] += time.process_time_ns() - began
        return fields

    def skip(self, step: int) -> None:
        self._method.skip(step)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:
        began = time.process_time_ns()
        result = self._method.advance(stage, step, arrived, ledger)
        self.spent_ns[step] += time.process_time_ns() - began
        return result

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        began = time.process_time_ns()
        taken = cast(Revising, self._method).revise(late)
        self.spent_ns[self._step] += time.process_time_ns() - began
        return taken

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:
        began = time.process_time_ns()
        outcome = cast(Revising, self._method).correct(step, heard)
        self.spent_ns[self._step] += time.process_time_ns() - began
        return outcome


class _TimedAndWary(_Timed):
    """Of a method that refuses messages."""

    def refuses(self, stage: int, fields: Fields) -> str | None:
        return cast(Wary, self._method).refuses(stage, fields)


def _cut(series: Sequence[Array], scenario: Scenario) -> Array:
    """(stretches, configurations, m); InputError where there are not two."""
    count = min(STRETCHES, len(series[0]) // SHORTEST)
    if count < 2:
        raise InputError(f"{scenario.name}: expected {2 * SHORTEST} steps or more (is {len(series[0])})")
    parts = [np.array_split(one, count) for one in series]
    return np.array([[means_over_steps(part[n]) for part in parts] for n in range(count)])


def _judged(field: Field, unit: str, errors: Array, nees: Array, costs: Sequence[Sequence[_Cost]]) -> MethodComparison:
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
