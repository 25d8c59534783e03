"""What the filters need to know of the system at one step: second-order statistics, nothing else.

The names are those of the method's paper (Caballero-Águila et al., Information Fusion 45 (2019) 324-332).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count
from math import inf, isfinite, isinf, sqrt
from typing import NamedTuple

import numpy as np

from zfusion.errors import RunError
from zfusion.model.matrices import constant_from, multiplicative_noise
from zfusion.model.noise_model import NoiseCovariances
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId

SETTLED = 1e-15
"""Change of a moment in one step, relative to the sizes of the components, that counts as none: rounding's size."""

MOMENT_LIMIT = 1e150
"""Largest variance of a state that random matrices multiply: its products with them can still be represented."""

SETTLED_EVERY = 16
"""Whether the moments have settled is looked at every so many steps: a look costs as much as a step."""


class StepModel(NamedTuple):
    """Statistics that carry a filter from step k-1 to step k, for a chosen set of sensors.

    ``ny`` is the sum of the chosen sensors' measurement sizes, stacked in sorted order of their ids.
    While the system is time-invariant and its moments have settled, consecutive steps share *the same
    object*, so that ``is`` tells a filter that nothing has changed.
    """

    F: Array
    """F̄_{k-1}, (nx, nx)."""
    Q: Array
    """E[F̃_{k-1} D_{k-1} F̃_{k-1}ᵀ] + Q_{k-1}, (nx, nx)."""
    Q1: Array
    """E[w_{k-1} x_{k-1}ᵀ] = Q_{k-1,k-2}; zero for k = 1, (nx, nx)."""
    W: Array
    """W_{k-1} = E[w_{k-1} Y_{k-1}ᵀ] = Q_{k-1,k-2} H̄_{k-1}ᵀ + S_{k-1}; zero for k = 1, (nx, ny)."""
    V: Array
    """V_{k,k-1} = E[V_k Y_{k-1}ᵀ] = S_{k-2,k}ᵀ H̄_{k-1}ᵀ + R_{k,k-1}; zero for k = 1, (ny, ny)."""
    B: Array
    """B_k = E[x_k V_kᵀ] = F̄_{k-1} S_{k-2,k} + S_{k-1,k}; B_1 = S_{0,1}, (nx, ny)."""
    H: Array
    """H̄_k, (ny, nx)."""
    R: Array
    """R_k + E[H̃_k D_k H̃_kᵀ], (ny, ny)."""


class PriorMoments(NamedTuple):
    """Mean m_k = E[x_k], (nx,), and covariance Cov[x_k], (nx, nx), of the state before any measurement."""

    mean: Array
    covariance: Array


def prior_moments(system: System) -> PriorMoments:
    """Mean and covariance of x_0."""
    return PriorMoments(system.initial_mean, system.initial_covariance)


def step_models(system: System, ids: Iterable[NodeId]) -> Iterator[tuple[StepModel, PriorMoments]]:
    """For k = 1, 2, ..., without end: what carries a filter from step k-1 to step k, and the moments of x_k.

    `ids` chooses the sensors, stacked in the order given (sorted everywhere in this package). Once the system has
    become time-invariant, the same two objects come again and again as soon as D_k = E[x_k x_kᵀ] has settled to
    1e-15 of its size; if no matrix is random, the StepModel is the same from then on whatever D_k does.

    A mean or covariance that outgrows the range of floating-point numbers, as those of an unstable system do in the
    end, is returned with all its entries infinite from that step on. That harms nobody where no matrix is random.
    Where one is, a filter cannot go on: RunError.

    KeyError for an unknown sensor.
    """
    ids = tuple(ids)
    sensors = system.chosen(ids)
    constant = _constant_from(system, sensors)
    random = any(matrix.is_random for schedule in (system.F, *(s.H for s in sensors)) for matrix in schedule.items)
    moments = prior_moments(system)
    D = _second_moment(moments, 0) if random else moments.covariance
    before: _SensorStack | None = None
    noises = [system.noise.covariances(0, ids)]
    for k in count(1):
        changed = constant is None or k <= constant
        if changed:
            F, stack = system.F.at(k - 1), _stack(sensors, k)
            noises = [*noises[-2:], system.noise.covariances(k, ids)]
            additive = model = _additive(F.mean, before, stack, noises)
            noise = drift = _drift(additive)
            before = stack
        if F.is_random:
            spread = F.second_moment(D)
            noise = drift + spread
            model = model._replace(Q=_frozen(additive.Q + spread))
        earlier, moments = moments, _next_moments(F.mean, noise, moments)
        if random:
            D = _second_moment(moments, k)
        if stack.is_random:
            model = model._replace(R=_frozen(additive.R + stack.second_moment(D)))
        yield model, moments
        if not changed and k % SETTLED_EVERY == 0 and _settled(earlier, moments):
            break
    while True:
        yield model, moments


class _SensorStack(NamedTuple):
    """The chosen sensors' measurement matrices at one step."""

    H: Array
    """H̄_k, (ny, nx)."""
    factors: Array
    """Those of each H^i_k in its rows, (count, ny, nx)."""
    same_sensor: Array
    """1 where row and column belong to one sensor, else 0, (ny, ny)."""

    @property
    def is_random(self) -> bool:
        """Whether any of them is random."""
        return len(self.factors) > 0

    def second_moment(self, D: Array) -> Array:
        """E[H̃_k D H̃_kᵀ], block-diagonal, (ny, ny)."""
        return multiplicative_noise(self.factors, D) * self.same_sensor


def _stack(sensors: tuple[Sensor, ...], k: int) -> _SensorStack:
    matrices = [sensor.H.at(k) for sensor in sensors]
    H = np.vstack([matrix.mean for matrix in matrices])
    owner = np.repeat(np.arange(len(sensors)), [sensor.ny for sensor in sensors])
    factors = np.zeros((max(len(matrix.factors) for matrix in matrices), *H.shape))
    for n, matrix in enumerate(matrices):
        factors[: len(matrix.factors), owner == n] = matrix.factors
    return _SensorStack(_frozen(H), factors, (owner[:, None] == owner).astype(np.float64))


def _constant_from(system: System, sensors: tuple[Sensor, ...]) -> int | None:
    """First step whose StepModel has the same non-multiplicative parts as all later ones; None if there is none."""
    F, H = system.F.constant_from, constant_from(sensor.H for sensor in sensors)
    noise = system.noise.constant_from
    return None if F is None or H is None or noise is None else max(2, F + 1, H + 1, noise + 2)


def _additive(F: Array, before: _SensorStack | None, stack: _SensorStack, noises: list[NoiseCovariances]) -> StepModel:
    """The StepModel of step k without its multiplicative noises, from the noises of steps k-2, k-1, k (k = 1: 0, 1)."""
    last, now = noises[-2:]
    if before is None:
        zero = np.zeros_like(now.S0)
        return StepModel(F, last.Q, _frozen(np.zeros_like(F)), _frozen(zero), now.R1, last.S1, stack.H, now.R)
    first = noises[0]
    return StepModel(
        F=F,
        Q=last.Q,
        Q1=last.Q1,
        W=_frozen(last.Q1 @ before.H.T + last.S0),
        V=_frozen(first.S2.T @ before.H.T + now.R1),
        B=_frozen(F @ first.S2 + last.S1),
        H=stack.H,
        R=now.R,
    )


def _drift(model: StepModel) -> Array:
    """What the noise adds to the covariance: Q + F̄ Q1ᵀ + Q1 F̄ᵀ."""
    correlated = model.F @ model.Q1.T
    return model.Q + correlated + correlated.T


def _next_moments(F: Array, noise: Array, moments: PriorMoments) -> PriorMoments:
    """F̄ m and F̄ Cov F̄ᵀ + noise; infinite in all entries where one cannot be represented."""
    mean, covariance = moments
    with np.errstate(over="ignore", invalid="ignore"):
        if isfinite(mean[0]):
            mean = _or_infinite(F @ mean)
        if isfinite(covariance[0, 0]):
            moved = F @ covariance @ F.T
            covariance = _or_infinite(0.5 * (moved + moved.T) + noise)
    return PriorMoments(mean, covariance)


def _or_infinite(values: Array) -> Array:
    if not isfinite(np.add.reduce(values, axis=None)) and not np.isfinite(values).all():
        values = np.full_like(values, inf)
    return _frozen(values)


def _second_moment(moments: PriorMoments, k: int) -> Array:
    """D_k = Cov[x_k] + m_k m_kᵀ; RunError if it leaves no room to compute with."""
    mean, covariance = moments
    if not covariance.trace() < MOMENT_LIMIT or not np.abs(mean).max() < sqrt(MOMENT_LIMIT):
        raise RunError(
            f"the state at step {k} is too large for a model with random matrices: its mean square is "
            f"beyond {MOMENT_LIMIT:g}"
        )
    return covariance + np.multiply.outer(mean, mean)


def _settled(old: PriorMoments, new: PriorMoments) -> bool:
    """Whether nothing changed but what rounding may; each entry is measured by the components it belongs to."""
    if isinf(new.covariance[0, 0]):
        return new.covariance is old.covariance and (new.mean is old.mean or np.array_equal(new.mean, old.mean))
    size = np.sqrt(new.covariance.diagonal() + new.mean**2)
    return bool(
        (np.abs(new.mean - old.mean) <= SETTLED * size).all()
        and (np.abs(new.covariance - old.covariance) <= SETTLED * np.multiply.outer(size, size)).all()
    )


def _frozen(array: Array) -> Array:
    array.setflags(write=False)
    return array
