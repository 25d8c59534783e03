"""The model as most filters see it: noises that are white and independent of one another, sensor by sensor.

    x_k = F x_{k-1} + w,  cov w = Q;      y^j_k = H_j x_k + v^j,  cov v^j = R_j

Where the system's noises are correlated over time or between sensors, a filter that uses this is not optimal, and
the covariance that it reports is not that of its errors. Random matrices enter with what they add to Q and R_j.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from zfusion.methods.neighbourhood import StepModels
from zfusion.model.statistics import PriorMoments, prior_moments, step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId


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
        """F x and F P Fᵀ + Q: from the step before to `step`."""
        model = self._models.at(step)[0]
        P = model.F @ P @ model.F.T + model.Q
        return model.F @ x, 0.5 * (P + P.T)

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


def kalman_update(x: Array, P: Array, y: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The Kalman filter's x and P after a measurement y = H x + v, cov v = R."""
    PH = P @ H.T
    gain = np.linalg.solve(H @ PH + R, PH.T).T
    P = P - gain @ PH.T
    return x + gain @ (y - H @ x), 0.5 * (P + P.T)
