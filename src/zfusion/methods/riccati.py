"""The stationary Kalman predictor, by structured doubling: also for states that are not stable by themselves."""

from __future__ import annotations

import numpy as np

from zfusion.errors import RunError
from zfusion.model.types import Array

DOUBLINGS = 60
"""2^60 steps of the Riccati recursion: whatever has not settled by then does not."""

CONVERGED = 1e-15
"""Change, relative to the largest entry, that counts as none."""


def predictor(A: Array, C: Array, W: Array, R: Array) -> Array:
    """S = A (S - S Cᵀ (C S Cᵀ + R)^-1 C S) Aᵀ + W, (nx, nx), the stationary covariance before a measurement; R > 0.

    Source: the structured doubling algorithm of Chu, Fan, Lin, Wang, Int. J. Control 77 (2004) 767-788, eqs. (2.12).
    RunError where there is none: some part of the state grows and is never measured.
    """
    identity = np.eye(len(A))
    power, G, S = A.T, C.T @ np.linalg.solve(R, C), 0.5 * (W + W.T)
    for _ in range(DOUBLINGS):
        half = np.linalg.solve(identity + G @ S, np.hstack((power, G)))
        moved, joined = half[:, : len(A)], half[:, len(A) :]
        added = power.T @ S @ moved
        G = G + power @ joined @ power.T
        S, power = S + 0.5 * (added + added.T), power @ moved
        G = 0.5 * (G + G.T)
        if not np.isfinite(S).all():
            break
        if np.abs(added).max() <= CONVERGED * np.abs(S).max():
            return S
    raise RunError("there is no stationary Kalman filter: a part of the state grows and is not measured")
