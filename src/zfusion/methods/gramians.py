"""Stationary covariances: Lyapunov and Riccati equations, by iterations that converge quadratically."""

from __future__ import annotations

import numpy as np

from zfusion.errors import RunError
from zfusion.model.types import Array

DOUBLINGS = 64
"""More than any stable matrix of floating-point numbers needs: its power 2^64 is zero."""

NEWTON_STEPS = 64
"""Far more than Newton's method takes, which doubles the digits at each step once it is near."""

CONVERGED = 1e-14
"""Change, relative to the largest entry, that counts as none."""

NEWTON_CONVERGED = 1e-12
"""The same of a step of Newton's method: the step after it would change nothing but rounding."""


def spectral_radius(A: Array) -> float:
    """Largest modulus of an eigenvalue."""
    return float(np.abs(np.linalg.eigvals(A)).max())


def lyapunov(A: Array, Q: Array) -> Array:
    """P = A P Aᵀ + Q for symmetric Q, (n, n), by doubling: P = Σ A^t Q A^tᵀ, twice as many terms each time.

    RunError unless A is stable enough for the sum to be representable.
    """
    P: Array = 0.5 * (Q + Q.T)
    power = A
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            added = power @ P @ power.T
            P = P + 0.5 * (added + added.T)
            size = np.abs(P).max()
            if not np.isfinite(size):
                break
            if np.abs(added).max() <= CONVERGED * size:
                return P
            power = power @ power
    raise RunError(f"no stationary covariance: the spectral radius is {spectral_radius(A):.6g}")


def predictor_gain(A: Array, C: Array, S: Array, R: Array, cross: Array | None = None) -> Array:
    """L = (A S Cᵀ + cross) (C S Cᵀ + R)⁺, (nx, ny); `cross` = Cov[w, v]. The innovation may be singular."""
    left = A @ S @ C.T if cross is None else A @ S @ C.T + cross
    gain: Array = np.asarray(np.linalg.lstsq(C @ S @ C.T + R, left.T, rcond=None)[0].T, dtype=np.float64)
    return gain


def predictor_covariance(A: Array, C: Array, Q: Array, R: Array, cross: Array | None = None) -> Array:
    """The stationary covariance S of the Kalman predictor for a stable A, by Newton's method on the gain.

    S = A S Aᵀ + Q - L (C S Cᵀ + R) Lᵀ; each step solves S = (A - L C) S (A - L C)ᵀ + Q + L R Lᵀ - L crossᵀ - cross Lᵀ.
    RunError where A is not stable.
    """
    L = np.zeros((len(A), len(C)))
    last: Array | None = None
    for _ in range(NEWTON_STEPS):
        mixed = 0.0 if cross is None else L @ cross.T + cross @ L.T
        S = lyapunov(A - L @ C, Q + L @ R @ L.T - mixed)
        if last is not None and np.abs(S - last).max() <= NEWTON_CONVERGED * np.abs(S).max():
            return S
        last, L = S, predictor_gain(A, C, S, R, cross)
    return S


def riccati_step(A: Array, C: Array, Q: Array, R: Array, S: Array) -> Array:
    """A (S - S Cᵀ (C S Cᵀ + R)⁺ C S) Aᵀ + Q: one step of the Kalman predictor."""
    L = predictor_gain(A, C, S, R)
    following = A @ S @ A.T - L @ C @ S @ A.T + Q
    return 0.5 * (following + following.T)
