"""How well a swarm that ran on the library's readings predicted them, beside simple baselines.

Everything is computed from the recording of the run and the data: the estimates are the recorded ones, the model is
identified again, and must be the one that the recorded scenario has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from rich.console import Console
from rich.table import Table

from zfusion import keys
from zfusion.errors import InputError, MessageError
from zfusion.messages import Decoder
from zfusion.methods.least_squares import LeastSquaresFilter
from zfusion.model.scenario import Scenario
from zfusion.model.schema.run import CsvSource
from zfusion.model.statistics import prior_moments, step_models
from zfusion.model.types import Array, NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import ESTIMATE
from zfusion.studies.library.data import Readings, load_readings
from zfusion.studies.library.field import FieldModel, identify

SAME = 1e-6
"""Relative difference up to which two models are the same: identified on machines that round differently."""


NEXT_COLUMNS = {"swarm": "swarm", "alone": "alone", "last value": "last", "mean of motes": "mean"}
HELD_OUT_COLUMNS = {
    "swarm": "swarm",
    "all nodes": "nodes",
    "worst node": "worst",
    "alone": "alone",
    "mean": "mean",
    "mean + offset": "corrected_mean",
    "nearest": "nearest",
    "last value": "last",
}
"""Headings of the tables, and the attributes that stand below them."""


@dataclass(frozen=True, slots=True)
class NextReading:
    """Root mean square errors (°C) of predictions of a member's next reading."""

    mote: int
    rounds: int
    """Predicted readings, the same for all that are compared."""
    swarm: float
    """By the mote's estimate in the swarm."""
    alone: float
    """By the same model from the mote's own readings only."""
    last: float
    """By its last reading."""
    mean: float
    """By the mean of the others' last readings, corrected by the mote's mean distance from it in the training."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Root mean square errors (°C) of what is said of a mote that is not in the swarm."""

    mote: int
    rounds: int
    swarm: float
    """By the estimate, in each round, of the node that was most certain: by its predicted error covariance."""
    nodes: float
    """By the estimates of all nodes: over all rounds and nodes."""
    worst: float
    """By those of the node that did worst."""
    alone: float
    """By the same model at each mote from its own readings only: over all rounds and motes."""
    mean: float
    """By the mean of the members' readings."""
    corrected_mean: float
    """The same corrected by its mean distance from it in the training."""
    nearest: float
    """By the member whose readings ran most nearly parallel in the training, corrected likewise."""
    last: float
    """By its last reading in the training."""


@dataclass(frozen=True, slots=True)
class Score:
    """The score of one run."""

    recording: str
    method: str
    training: int
    """Rounds that the model was identified from."""
    rounds: int
    """Rounds that the swarm ran on."""
    next_reading: tuple[NextReading, ...]
    held_out: tuple[HeldOut, ...]

    def facts(self) -> dict[str, Any]:
        """As plain data, for JSON: None where nothing could be computed."""
        facts = asdict(self)
        for row in (*facts["next_reading"], *facts["held_out"]):
            row.update({name: None for name, value in row.items() if np.isnan(value)})
        return facts


def score(recording: str | Path, data: str | Path) -> Score:
    """The score of the run in `recording`, which was made by a scenario that `prepare` made of these data.

    RecordingError for a recording that cannot be read, InputError for one of something else, or for other data.
    """
    readings = load_readings(Path(data))
    with Recording.open(recording) as opened:
        scenario = Scenario.from_toml(opened.scenario_toml, source=f"scenario of {recording}")
        members, training = _study_of(scenario, readings, recording)
        model = identify(readings, members, scenario.system().nx - 2 - len(members), training)
        _check_same(model, scenario, recording)
        estimates = _estimates(opened, scenario)
    rounds = estimates.x.shape[1]
    part = readings.celsius[training : training + rounds]
    tested = _Tested(model, Readings(readings.motes, readings.celsius[:training]), Readings(readings.motes, part))
    alone = np.stack([_alone(scenario, mote, tested.after.of([mote])[:, 0]) for mote in members])
    held_out = [mote for mote in readings.motes if mote not in members]
    return Score(
        recording=str(recording),
        method=opened.metadata.get("method", scenario.method.name),
        training=training,
        rounds=rounds,
        next_reading=tuple(tested.next_reading(m, x, y) for m, x, y in zip(members, estimates.x, alone, strict=True)),
        held_out=tuple(tested.held_out(mote, estimates, alone) for mote in held_out),
    )


def _study_of(scenario: Scenario, readings: Readings, recording: str | Path) -> tuple[tuple[int, ...], int]:
    """Members and rounds of the training, as `prepare` has put them into the scenario."""
    source, members = scenario.source, tuple(i for i in scenario.ids if isinstance(i, int))
    training = source.first_step - 1 if isinstance(source, CsvSource) else 0
    if not members or not set(members) <= set(readings.motes) or not 0 < training < readings.rounds:
        raise InputError(f"{recording}: is not a run of a scenario that `zfusion library prepare` made of these data")
    return members, training


def _check_same(model: FieldModel, scenario: Scenario, recording: str | Path) -> None:
    """Refuse to judge a run by a model that it did not have."""
    system = scenario.system()
    pairs = [(model.F, system.F.items[0].mean), (model.initial_mean, system.initial_mean)]
    pairs += [(model.H[mote], system.by_id[mote].H.items[0].mean[0]) for mote in model.members]
    for identified, recorded in pairs:
        if identified.shape != recorded.shape or not np.allclose(identified, recorded, rtol=SAME, atol=SAME):
            raise InputError(f"{recording}: its model is not the one that is identified from these data")


class _Estimates(NamedTuple):
    """What the nodes estimated; NaN where there is nothing."""

    x: Array
    """(members, rounds, nx)."""
    P: Array
    """(members, rounds, nx, nx)."""


def _estimates(recording: Recording, scenario: Scenario) -> _Estimates:
    """The recorded estimates; InputError if there are none."""
    nx, ids = scenario.system().nx, scenario.ids
    by_step = [_by_step(recording, i, Decoder(ESTIMATE, i, sizes={"nx": nx}, ids=ids)) for i in ids]
    rounds = max(max(found, default=0) for found in by_step)
    if not rounds:
        raise InputError(f"{recording.path}: holds no estimates")
    x, P = np.full((len(ids), rounds, nx), np.nan), np.full((len(ids), rounds, nx, nx), np.nan)
    for row, found in enumerate(by_step):
        for step, fields in found.items():
            x[row, step - 1], P[row, step - 1] = cast(Array, fields["x"]), cast(Array, fields["P"])
    return _Estimates(x, P)


def _by_step(recording: Recording, node: NodeId, decoder: Decoder) -> dict[int, Mapping[str, object]]:
    """A node's estimates."""
    found: dict[int, Mapping[str, object]] = {}
    for record in recording.records([keys.stage_key(recording.metadata["run"], node, ESTIMATE.name)]):
        try:
            message = decoder.decode(record.data)
        except MessageError:
            continue  # nobody in the swarm took it for an estimate
        found.setdefault(message.step, message.fields)
    return found


def _alone(scenario: Scenario, mote: int, celsius: Array) -> Array:
    """What a mote estimates from its own readings, (rounds,), by the swarm's model, (rounds, nx)."""
    start = prior_moments(scenario.system())
    one = LeastSquaresFilter([mote], {mote: 1}, start.mean, start.covariance)
    states = []
    models = islice(step_models(scenario.system(), [mote]), len(celsius))
    for (model, _), reading in zip(models, celsius, strict=True):
        one.step(model, {} if np.isnan(reading) else {mote: np.array([reading])})
        states.append(one.x)
    return np.array(states)


@dataclass(frozen=True)
class _Tested:
    """A model, the readings that it was identified from, and those that it is tested on."""

    model: FieldModel
    before: Readings
    after: Readings

    def next_reading(self, mote: int, swarm: Array, alone: Array) -> NextReading:
        """From the states that the mote estimated in the swarm and alone, each (rounds, nx)."""
        own = self.after.of([mote])[:, 0]
        last = own.copy()
        for k in np.flatnonzero(np.isnan(own[1:])) + 1:
            last[k] = last[k - 1]
        mean, distance = self._mean(mote)
        predictions = {
            "swarm": self.model.reading(mote, swarm @ self.model.F.T),
            "alone": self.model.reading(mote, alone @ self.model.F.T),
            "last": last,
            "mean": mean + distance,
        }
        errors = {name: own[1:] - prediction[:-1] for name, prediction in predictions.items()}
        common = ~np.isnan(list(errors.values())).any(axis=0)
        return NextReading(mote, int(common.sum()), **{name: _rms(error[common]) for name, error in errors.items()})

    def held_out(self, mote: int, swarm: _Estimates, alone: Array) -> HeldOut:
        """From what all members estimated in the swarm, and their states alone, (members, rounds, nx)."""
        truth = self.after.of([mote])[:, 0]
        told = self.model.reading(mote, swarm.x)
        variance = self.model.variance(mote, swarm.P)
        most_certain = np.where(np.isnan(variance), np.inf, variance).argmin(axis=0)
        by_node = [error for error in (_rms(truth - of_node) for of_node in told) if not np.isnan(error)]
        mean, distance = self._mean(mote)
        training = self.before.of([mote])[:, 0]
        return HeldOut(
            mote=mote,
            rounds=int((~np.isnan(truth)).sum()),
            swarm=_rms(truth - told[most_certain, np.arange(len(truth))]),
            nodes=_rms(truth - told),
            worst=max(by_node, default=float("nan")),
            alone=_rms(truth - self.model.reading(mote, alone)),
            mean=_rms(truth - mean),
            corrected_mean=_rms(truth - mean - distance),
            nearest=_rms(truth - self._nearest(mote)),
            last=_rms(truth - training[~np.isnan(training)][-1]),
        )

    def _mean(self, mote: int) -> tuple[Array, float]:
        """Mean of the other members' readings in every round, and how far the mote was from it in the training."""
        others = [member for member in self.model.members if member != mote]
        distances = self.before.of([mote])[:, 0] - _mean(self.before.of(others), axis=1)
        return _mean(self.after.of(others), axis=1), float(_mean(distances, axis=0))

    def _nearest(self, mote: int) -> Array:
        """Readings of the member whose distance from the mote varied least in the training, plus that distance."""
        distances = self.before.of([mote]) - self.before.of(self.model.members)
        typical = _mean(distances, axis=0)
        nearest = self.model.members[int(np.nanargmin(_mean((distances - typical) ** 2, axis=0)))]
        parallel: Array = self.after.of([nearest])[:, 0] + typical[self.model.members.index(nearest)]
        return parallel


def _mean(values: Array, axis: int) -> Array:
    """Mean of those that are known; NaN where none is."""
    known = ~np.isnan(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    mean: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean


def _rms(errors: Array) -> float:
    """Root of the mean square of those that are known; NaN if none is."""
    return float(np.sqrt(_mean(errors.ravel() ** 2, axis=0)))


def _together(rows: Sequence[NextReading] | Sequence[HeldOut], name: str) -> float:
    """Root mean square over motes, each with the same weight."""
    return _rms(np.array([getattr(row, name) for row in rows]))


def show_score(console: Console, result: Score) -> None:
    """The score for people."""
    console.print(
        f"{result.rounds} rounds after {result.training} of training, {result.method}; root mean square errors in °C"
    )
    for title, rows, columns, digits in (
        ("next reading of the motes in the swarm", result.next_reading, NEXT_COLUMNS, 4),
        ("readings of the motes that were held out", result.held_out, HELD_OUT_COLUMNS, 3),
    ):
        table = Table(title=title, title_justify="left")
        for heading in ("mote", *columns):
            table.add_column(heading, justify="right")
        for row in rows:
            table.add_row(str(row.mote), *(_shown(getattr(row, name), digits) for name in columns.values()))
        table.add_section()
        table.add_row("all", *(_shown(_together(rows, name), digits) for name in columns.values()))
        console.print(table)


def _shown(value: float, digits: int) -> str:
    return "–" if np.isnan(value) else f"{value:.{digits}f}"
