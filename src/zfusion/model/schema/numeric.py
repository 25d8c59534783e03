"""From the pieces of a scenario to the system that the numerics work with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from zfusion.model.distributions import Normal
from zfusion.model.matrices import Schedule
from zfusion.model.noise import CovarianceNoise, MovingAverageNoise, NoiseModel, Tap, WhiteNoise
from zfusion.model.schema.matrices import fixed_schedule, items_of, random_schedule, shape_of
from zfusion.model.schema.system import NoiseSpec, SensorSpec, SystemSpec, TapSpec, is_by_parts
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId, sorted_ids

OWN = "own/"
"""Begins the names of white noises that a single noise has to itself; no name in a scenario has a slash."""


def numeric_system(system: SystemSpec, sensors: Iterable[SensorSpec], noise: NoiseSpec) -> System:
    """The system that these pieces, which must agree in shapes and names, describe.

    Raises ModelError where the noises are not jointly possible, or correlated as the model does not provide for.
    """
    by_id = {i: sensor for sensor in sensors for i in sensor.members}
    entries = {i: by_id[i] for i in sorted_ids(by_id)}
    H = {id(sensor): random_schedule(sensor.H, first=1) for sensor in entries.values()}
    nx = size_of(system.F)
    return System(
        nx=nx,
        initial_mean=np.zeros(nx) if system.initial_mean is None else np.array(system.initial_mean),
        initial_covariance=np.array(system.initial_covariance),
        F=random_schedule(system.F, first=0),
        sensors=tuple(Sensor(i, size_of(sensor.H), H[id(sensor)]) for i, sensor in entries.items()),
        noise=_noise(system, entries, noise),
    )


def size_of(matrix: Any) -> int:
    """Number of rows of a matrix, random or not, varying with time or not."""
    return shape_of(items_of(matrix)[0])[0]


def _noise(system: SystemSpec, sensors: Mapping[NodeId, SensorSpec], noise: NoiseSpec) -> NoiseModel:
    if system.noise or any(sensor.noise for sensor in sensors.values()):
        return _moving_average(system, sensors, noise)
    return _by_covariance(system, sensors, noise)


def _moving_average(system: SystemSpec, sensors: Mapping[NodeId, SensorSpec], noise: NoiseSpec) -> MovingAverageNoise:
    white = {name: WhiteNoise(np.array(spec.covariance), spec.shape or Normal()) for name, spec in noise.white.items()}
    taps: dict[str, tuple[Tap, ...]] = {}
    noises = [("process", system.noise, system.Q, 0)]
    noises += [(f"sensor/{i}", sensor.noise, sensor.R, 1) for i, sensor in sensors.items()]
    for name, given, own, first in noises:
        taps[name] = tuple(_tap(tap, white, first) for tap in given or ())
        if own is not None:
            white[OWN + name], tap = _own_white(OWN + name, own, first)
            taps[name] += (tap,)
    return MovingAverageNoise(white, taps["process"], {i: taps[f"sensor/{i}"] for i in sensors})


def _tap(tap: TapSpec, white: Mapping[str, WhiteNoise], first: int) -> Tap:
    if tap.matrix is None:
        return Tap(tap.source, tap.lag, Schedule.constant(np.eye(white[tap.source].size)))
    return Tap(tap.source, tap.lag, fixed_schedule(tap.matrix, first))


def _own_white(name: str, covariance: Any, first: int) -> tuple[WhiteNoise, Tap]:
    """A white noise of this covariance, and the tap that takes it as it is."""
    schedule = fixed_schedule(covariance, first)
    unit = np.eye(len(schedule.items[0]))
    if len(schedule.items) == 1:
        return WhiteNoise(schedule.items[0]), Tap(name, 0, Schedule.constant(unit))
    roots = tuple(_symmetric_root(item) for item in schedule.items)
    return WhiteNoise(unit), Tap(name, 0, Schedule(roots, 0, schedule.after))


def _symmetric_root(covariance: Array) -> Array:
    """The positive semi-definite A with A A = covariance."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root


def _by_covariance(system: SystemSpec, sensors: Mapping[NodeId, SensorSpec], noise: NoiseSpec) -> CovarianceNoise:
    rows, end = dict[NodeId, slice](), 0
    for i, sensor in sensors.items():
        rows[i] = slice(end, end + size_of(sensor.H))
        end = rows[i].stop
    own = {(i, i): fixed_schedule(s.R, first=1) for i, s in sensors.items() if s.R is not None}
    R = _by_pair(noise.R, rows)
    once = {(i, j): block for (i, j), block in R.items() if rows[i].start <= rows[j].start or (j, i) not in R}
    return CovarianceNoise(
        Q=fixed_schedule(system.Q, first=0),
        R=own | once,
        Q1=None if noise.Q1 is None else fixed_schedule(noise.Q1, first=0),
        R1=_by_pair(noise.R1, rows),
        S0=_by_sensor(noise.S0, rows),
        S1=_by_sensor(noise.S1, rows),
        S2=_by_sensor(noise.S2, rows),
    )


def _by_pair(given: Any, rows: Mapping[NodeId, slice]) -> dict[tuple[NodeId, NodeId], Schedule[Array]]:
    """A covariance of all sensors with all by pairs, without the zeros off the diagonal."""
    if given is None:
        return {}
    if is_by_parts(given):
        return {part.sensors: fixed_schedule(part.value, first=0) for part in given}
    whole = fixed_schedule(given, first=0)
    blocks = {(i, j): _cut(whole, rows[i], rows[j]) for i in rows for j in rows}
    return {(i, j): block for (i, j), block in blocks.items() if i == j or _occurs(block)}


def _by_sensor(given: Any, columns: Mapping[NodeId, slice]) -> dict[NodeId, Schedule[Array]]:
    """A covariance of the process noise with all sensors by sensor."""
    if given is None:
        return {}
    if is_by_parts(given):
        return {part.sensor: fixed_schedule(part.value, first=0) for part in given}
    whole = fixed_schedule(given, first=0)
    blocks = {i: _cut(whole, slice(None), columns[i]) for i in columns}
    return {i: block for i, block in blocks.items() if _occurs(block)}


def _cut(whole: Schedule[Array], rows: slice, columns: slice) -> Schedule[Array]:
    return Schedule(tuple(item[rows, columns] for item in whole.items), whole.first, whole.after)


def _occurs(block: Schedule[Array]) -> bool:
    return any(item.any() for item in block.items)
