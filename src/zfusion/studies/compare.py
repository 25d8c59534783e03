"""Configurations compared on the same measurements: which one is better, by how much, and how sure is that?

Each seed gives measurements and the links' randomness, the same for all configurations (as far as their links are
alike); what is compared are the differences within a seed, in which most of the scatter cancels (`paired`). Recordings
of the same measurements are compared in the same way, stretches of steps in the place of seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import numpy as np

from zfusion import keys
from zfusion.drivers.replayed import recorded_scenario
from zfusion.drivers.rerun import Recorded, read_recorded
from zfusion.drivers.simulated import Simulation
from zfusion.drivers.workers import in_order
from zfusion.errors import InputError, MessageError
from zfusion.messages import Decoder
from zfusion.methods import chosen
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import ESTIMATE, Message
from zfusion.studies.paired import MEDIAN, Paired, paired

Metric = Literal["mse", "nees", "disagreement"]

MEANINGS: Mapping[Metric, str] = {
    "mse": "mean squared error",
    "nees": "normalised squared error, eᵀ P⁻¹ e",
    "disagreement": "mean squared distance from the mean of all nodes' estimates",
}

BETTER_IF_SMALLER: tuple[Metric, ...] = ("mse", "disagreement")
"""A NEES is right, neither good nor bad, where it is the dimension of the state."""

CONFIDENCE = 0.95

STRETCHES = 20
"""Parts into which recordings are cut: long, so that errors in one tell little about those in the next."""

SHORTEST = 5
"""Steps of a stretch at least."""

ALL = "all"

Progress = Callable[[int], None]

Series = Array
"""(steps, m): the metric of each step and node; NaN where it has no estimate."""


@dataclass(frozen=True)
class Configuration:
    """One of those that are compared."""

    label: str
    scenario: Scenario


@dataclass(frozen=True)
class Comparison:
    """How `other` differs from `base`."""

    metric: Metric
    base: str
    other: str
    unit: str
    """What the pairs are: "seed", or "stretch" of a recording."""
    nodes: Mapping[str, Paired]
    """By node; ALL is the mean over the nodes."""

    @property
    def verdict(self) -> str:
        """In a sentence."""
        whole = self.nodes[ALL]
        if not whole.above + whole.below:
            return f"no difference at all: {MEANINGS[self.metric]} is the same in every {self.unit}"
        scale = 100 / abs(whole.a)
        if not whole.told_apart:
            bound = "" if whole.interval is None else f": |difference| < {max(map(abs, whole.interval)) * scale:.2g} %"
            return f"no difference can be told{bound} ({self._how(whole)})"
        low, high = sorted(abs(end) * scale for end in cast("tuple[float, float]", whole.interval))
        size = f"by {abs(whole.difference) * scale:.3g} % ({whole.confidence:.0%} CI {low:.2g}..{high:.2g} %"
        less = whole.difference < 0
        if self.metric in BETTER_IF_SMALLER:
            return f"{self.other if less else self.base} is better {size}, {self._how(whole)})"
        return (
            f"{MEANINGS[self.metric]} of {self.other} is {'smaller' if less else 'larger'} {size}, {self._how(whole)})"
        )

    def _how(self, whole: Paired) -> str:
        plural = {"seed": "seeds", "stretch": "stretches"}[self.unit]
        if whole.basis == MEDIAN:
            return f"of the median over {whole.n} {plural}, by order statistics: single ones outweigh the others"
        return f"of the mean over {whole.n} {plural}, paired t"

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        nodes = {node: one.as_dict() for node, one in self.nodes.items()}
        told = {"metric": self.metric, "a": self.base, "b": self.other, "unit": self.unit, "verdict": self.verdict}
        return {**told, ALL: nodes.pop(ALL), "nodes": nodes}


def compare(
    configurations: Sequence[Configuration],
    seeds: Sequence[int],
    metric: Metric = "mse",
    *,
    jobs: int = 1,
    progress: Progress | None = None,
) -> list[Comparison]:
    """Each of the other configurations with the first one, in simulations with these seeds; the same whatever `jobs`.

    InputError where they do not measure the same, where there are less than two seeds, or where the metric needs a
    truth that is not known.
    """
    if len(seeds) < 2:
        raise InputError(f"seeds: expected 2 or more, for an interval (is {len(seeds)})")
    scenarios = [configuration.scenario for configuration in configurations]
    _check_alike(configurations)
    if metric != "disagreement" and not all(scenario.truth_known for scenario in scenarios):
        raise InputError(f"{metric}: the true state is not known where measurements are not simulated")
    found: list[Array] = []
    for means in in_order(partial(_means_of_seed, scenarios, metric), seeds, jobs):
        found.append(means)
        if progress is not None:
            progress(1)
    values = np.array(found)
    return paired_by_node([c.label for c in configurations], values, scenarios[0].ids, metric, "seed")


def compare_recordings(recordings: Sequence[Recording], metric: Metric = "mse") -> list[Comparison]:
    """Each of the other recordings with the first one; they must hold the same measurements.

    InputError where they do not, where the truth that the metric needs is on none, or where they are too short.
    """
    scenarios = [recorded_scenario(recording) for recording in recordings]
    ids, nx = scenarios[0].ids, scenarios[0].system().nx
    for recording, scenario in zip(recordings, scenarios, strict=True):
        if (scenario.ids, scenario.system().nx) != (ids, nx):
            raise InputError(f"{recording.path}: not the sensors and the state of {recordings[0].path}")
    held = [read_recorded(recording, scenario) for recording, scenario in zip(recordings, scenarios, strict=True)]
    for recording, content in zip(recordings, held, strict=True):
        _check_same_measurements(recordings[0], held[0], recording, content)
    steps = min(content.steps for content in held)
    truth = np.full((steps + 1, nx), np.nan)
    for step, x in next((content.truths for content in held if content.truths), {}).items():
        if step <= steps:
            truth[step] = x
    series = [
        series_of(_recorded_estimates(recording, scenario), ids, truth, metric)
        for recording, scenario in zip(recordings, scenarios, strict=True)
    ]
    common = common_steps(series)
    count = min(STRETCHES, len(common[0]) // SHORTEST)
    if count < 2 or np.isnan(common[0]).all():
        raise InputError(f"{recordings[0].path}: expected {2 * SHORTEST} steps or more with what {metric} needs")
    parts = [np.array_split(one, count) for one in common]
    values = np.array([[means_over_steps(part[n]) for part in parts] for n in range(count)])
    return paired_by_node([str(recording.path) for recording in recordings], values, ids, metric, "stretch")


def paired_by_node(
    labels: Sequence[str], values: Array, ids: Sequence[NodeId], metric: Metric, unit: str
) -> list[Comparison]:
    """Each of the other configurations with the first one, from (pairs, configurations, m).

    Nodes that have not a value everywhere do not count; InputError where there is no other.
    """
    columns = {str(i): values[:, :, position] for position, i in enumerate(ids)}
    columns = {node: of for node, of in columns.items() if not np.isnan(of).any()}
    if not columns:
        raise InputError(f"{metric}: no node has it everywhere")
    columns = {ALL: np.mean(list(columns.values()), axis=0), **columns}
    return [
        Comparison(
            metric,
            labels[0],
            labels[other],
            unit,
            {node: paired(of[:, 0].tolist(), of[:, other].tolist(), CONFIDENCE) for node, of in columns.items()},
        )
        for other in range(1, len(labels))
    ]


def _means_of_seed(scenarios: Sequence[Scenario], metric: Metric, seed: int) -> Array:
    """(configurations, m): means over the steps of which all configurations have an estimate."""
    chosen = [scenario.with_overrides(seed=seed) for scenario in scenarios]
    truth = np.full((chosen[0].steps + 1, chosen[0].system().nx), np.nan)
    if chosen[0].truth_known:
        path = SamplePath(chosen[0].system(), seed)
        truth = np.array([path.truth(k) for k in range(chosen[0].steps + 1)])
    series = [series_of(_simulated_estimates(scenario), scenario.ids, truth, metric) for scenario in chosen]
    return np.array([means_over_steps(one) for one in common_steps(series)])


def common_steps(series: Sequence[Series]) -> list[Series]:
    """NaN wherever one of them is."""
    there = ~np.isnan(np.array(series)).any(axis=0)
    return [np.where(there, one, np.nan) for one in series]


def means_over_steps(series: Series) -> Array:
    """Over the steps at which there is a value, (m,); NaN where there is none."""
    there = ~np.isnan(series)
    total = np.where(there, series, 0.0).sum(axis=0)
    count = there.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _simulated_estimates(scenario: Scenario) -> Iterator[Message]:
    told: list[Message] = []

    def observe(message: Message, _now_ns: int) -> None:
        if message.stage == ESTIMATE.name:
            told.append(message)

    simulation = Simulation(scenario, observe=observe)
    try:
        simulation.run()
    finally:
        simulation.close()
    yield from told


def _recorded_estimates(recording: Recording, scenario: Scenario) -> Iterator[Message]:
    run, nx = recording.metadata["run"], scenario.system().nx
    graph = chosen(scenario).network(scenario.network)
    decoders = {
        keys.stage_key(run, i, ESTIMATE.name): Decoder(ESTIMATE, i, sizes={"nx": nx}, ids=graph.neighbours(i))
        for i in scenario.ids
    }
    for topic, data, *_ in recording.records(decoders):
        try:
            yield decoders[topic].decode(data)
        except MessageError:
            continue  # nobody in the swarm took it for one


def series_of(estimates: Iterator[Message], ids: Sequence[NodeId], truth: Array, metric: Metric) -> Series:
    """The metric of steps 1, 2, ...; truth (steps + 1, nx). Of two estimates of one step the later counts."""
    place = {i: position for position, i in enumerate(ids)}
    steps, nx = len(truth) - 1, truth.shape[1]
    x = np.full((steps, len(ids), nx), np.nan)
    P = np.full((steps, len(ids), nx, nx), np.nan)
    for message in estimates:
        if message.step <= steps:
            x[message.step - 1, place[message.node]] = message.fields["x"]
            P[message.step - 1, place[message.node]] = message.fields["P"]
    if metric == "disagreement":
        mean = means_over_steps(x.swapaxes(0, 1))
        return np.asarray(((x - mean[:, None]) ** 2).sum(axis=-1))
    error = x - truth[1:, None]
    if metric == "mse":
        return np.asarray((error**2).sum(axis=-1))
    found = np.full(error.shape[:2], np.nan)
    there = ~(np.isnan(error).any(axis=-1) | np.isnan(P).any(axis=(-1, -2)))
    try:
        solved = np.linalg.solve(P[there], error[there][:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        raise InputError("nees: there is an error that is predicted to be zero in some direction") from None
    found[there] = (error[there] * solved).sum(axis=-1)
    return found


def _check_alike(configurations: Sequence[Configuration]) -> None:
    """InputError unless all measure the same in as many steps."""
    first = configurations[0]
    for other in configurations[1:]:
        for piece in ("system_spec", "sensors", "noise", "source", "steps"):
            if getattr(other.scenario, piece) != getattr(first.scenario, piece):
                name = piece.removesuffix("_spec")
                raise InputError(f"{other.label}: {name}: not that of {first.label}: they do not measure the same")


def _check_same_measurements(first: Recording, one: Recorded, second: Recording, other: Recorded) -> None:
    for i, measurements in one.measurements.items():
        others = other.measurements[i]
        for step in measurements.keys() & others.keys():
            if not np.array_equal(measurements[step], others[step]):
                raise InputError(
                    f"{second.path}: not the measurements of {first.path}: those of sensor {i} at step {step} differ"
                )
