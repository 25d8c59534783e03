"""The model as most filters see it: noises that are white and independent of one another, sensor by sensor.

    x_k = F x_{k-1} + w,  cov w = Q;      y^j_k = H_j x_k + v^j,  cov v^j = R_j

Where the system's noises are correlated over time or between sensors, a filter that uses this is not optimal, and
the covariance that it reports is not that of its errors. Random matrices enter with what they add to Q and R_j.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from typing import NamedTuple

import numpy as np

from zfusion.errors import RunError
from zfusion.methods.neighbourhood import StepModels
from zfusion.methods.packing import is_definite
from zfusion.model.checks import ModelError, lowest_eigenvalue
from zfusion.model.statistics import MOMENT_LIMIT, PriorMoments, prior_moments, step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

CHECKED_STEPS = 1000
"""Steps of a system that varies without end whose covariances are looked at before it runs."""

NEGLIGIBLE = 1e-12
"""Information, in parts of what is known already, that counts as none; negative information beyond it is refused."""


class Information(NamedTuple):
    """What a measurement y of one sensor says of x: gain y = Hᵀ R^-1 y and weight Hᵀ R^-1 H."""

    gain: Array
    """Hᵀ R^-1, (nx, ny)."""
    weight: Array
    """Hᵀ R^-1 H, (nx, nx)."""


class White:
    """The statistics of some sensors, step by step."""

    def __init__(self, system: System, ids: Iterable[NodeId]) -> None:
        """KeyError for an unknown sensor."""
        self._ids = tuple(ids)
        self._models = StepModels(lambda: step_models(system, self._ids))
        self._initial = prior_moments(system)
        ends = np.cumsum([system.by_id[i].ny for i in self._ids])
        self._rows = {i: slice(end - system.by_id[i].ny, end) for i, end in zip(self._ids, ends.tolist(), strict=True)}
        self._of: object = None
        self._information: dict[NodeId, Information] = {}

    def before(self, step: int) -> PriorMoments:
        """Mean and covariance of x at the step before `step`, without any measurement."""
        return self._initial if step == 1 else self._models.at(step - 1)[1]

    def predict(self, step: int, x: Array, P: Array) -> tuple[Array, Array]:
        """F x and F P Fᵀ + Q: from the step before to `step`. RunError where they outgrow what can be computed with."""
        model = self._models.at(step)[0]
        x, P = model.F @ x, model.F @ P @ model.F.T + model.Q
        if not P.trace() < MOMENT_LIMIT or not np.abs(x).max() < MOMENT_LIMIT:
            raise RunError(
                f"what is believed of the state at step {step} is beyond {MOMENT_LIMIT:g}: "
                "a part of the state grows and is not measured, or the filter is unstable"
            )
        return x, 0.5 * (P + P.T)

    def information(self, step: int) -> dict[NodeId, Information]:
        """What each sensor's measurement of `step` says; computed once while the model stays the same."""
        model = self._models.at(step)[0]
        if model is not self._of:
            self._of, self._information = model, {}
            for i, rows in self._rows.items():
                H = model.H[rows]
                gain: Array = np.linalg.solve(model.R[rows, rows], H).T.astype(np.float64, copy=False)
                self._information[i] = Information(gain, gain @ H)
        return self._information

    def observation(self, step: int, node: NodeId) -> tuple[Array, Array]:
        """H_j, (ny, nx), and R_j, (ny, ny)."""
        model, rows = self._models.at(step)[0], self._rows[node]
        return model.H[rows], model.R[rows, rows]


def check_white(system: System, *, invertible: bool = False) -> None:
    """ModelError unless every sensor's noise has a positive definite covariance at every step.

    With `invertible`, so must the covariance of every prediction, whatever has been measured before.
    """
    before: object = None
    P = system.initial_covariance
    for step, (model, _) in enumerate(islice(step_models(system, system.ids), CHECKED_STEPS), start=1):
        if model is before:
            return
        before, end = model, 0
        for sensor in system.sensors:
            start, end = end, end + sensor.ny
            R = model.R[start:end, start:end]
            if not is_definite(R):
                field = f"noise of sensor {sensor.id!r}, step {step}"
                raise ModelError(field, R.tolist(), "the method needs a positive definite covariance")
        predicted = model.F @ P @ model.F.T + model.Q
        if invertible and not is_definite(predicted):
            expected = "the method needs predictions with a positive definite covariance F P Fᵀ + Q"
            raise ModelError(f"system, step {step}", predicted.tolist(), expected)
        if step == 1:
            P = predicted  # which part of a later prediction is certain does not depend on how large P is


def kalman_update(x: Array, P: Array, y: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The Kalman filter's x and P after a measurement y = H x + v, cov v = R; P in Joseph's form."""
    PH = P @ H.T
    gain = np.linalg.solve(H @ PH + R, PH.T).T
    left = np.eye(len(x)) - gain @ H
    P = left @ P @ left.T + gain @ R @ gain.T
    return x + gain @ (y - H @ x), 0.5 * (P + P.T)


def absorb(x: Array, P: Array, told: Array, weight: Array) -> tuple[Array, Array] | None:
    """x + P⁺ (told - weight x) and P⁺ = (P^-1 + weight)^-1, also where P or weight is singular.

    `told` = Σ Hᵀ R^-1 y, (nx,), and `weight` = Σ Hᵀ R^-1 H, (nx, nx), of some measurements. None where the weight is
    not positive semi-definite: information that is less than none, which no measurement has.

    Computed as the Kalman update with the measurement Λ^½ Vᵀ d + noise I of the deviation d = D^-1 (x_true - x), for
    D² = diag P and D weight D = V Λ Vᵀ: so nothing but the information is inverted, and units do not matter.
    """
    D = np.sqrt(np.maximum(P.diagonal(), 0.0))
    values, vectors = np.linalg.eigh(D[:, None] * weight * D)
    if not values[0] >= -NEGLIGIBLE * max(1.0, values[-1]):
        return None
    kept = values > np.finfo(float).eps * len(x) * values[-1]
    roots = np.sqrt(values[kept])
    live = D > 0
    P_unit = np.zeros_like(P)
    P_unit[np.ix_(live, live)] = P[np.ix_(live, live)] / np.multiply.outer(D[live], D[live])
    y = vectors[:, kept].T @ (D * (told - weight @ x)) / roots
    d, P_unit = kalman_update(np.zeros_like(x), P_unit, y, roots[:, None] * vectors[:, kept].T, np.eye(len(roots)))
    return x + D * d, D[:, None] * P_unit * D


def inverse(matrix: Array) -> Array:
    """Of a positive definite matrix, scaled to unit diagonal first. RunError where it is not, or not any more."""
    if not (matrix.diagonal() > 0).all() or not lowest_eigenvalue(matrix) > 0:
        raise RunError("a covariance has become singular to working precision: the method cannot go on")
    D = np.sqrt(matrix.diagonal())
    scaled = np.linalg.inv(matrix / np.multiply.outer(D, D)) / np.multiply.outer(D, D)
    return np.asarray(0.5 * (scaled + scaled.T))
