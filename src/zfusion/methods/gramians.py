"""Stationary covariances: Lyapunov, Sylvester and Riccati equations, by iterations that converge quadratically.

Of the two ways to the stationary Kalman predictor, `predictor_covariance` stands noises that are correlated, or none at
all, but wants a stable A; `predictor_by_doubling` stands any A, but wants uncorrelated noises and a definite R.
"""

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

DOUBLING_CONVERGED = 1e-15
"""The same of the structured doubling algorithm, whose steps shrink faster still."""

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


def sylvester(A: Array, B: Array, C: Array) -> Array:
    """X = A X Bᵀ + C by doubling, for one C, (n, m), or many, (..., n, m).

    RunError unless A and B are stable enough for the sum to be representable.
    """
    X, left, right = C, A, B
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            added = left @ X @ right.T
            X = X + added
            size = np.abs(X).max(initial=0.0)
            if not np.isfinite(size):
                break
            if np.abs(added).max(initial=0.0) <= CONVERGED * size:
                return X
            left, right = left @ left, right @ right
    raise RunError(f"no stationary covariance: spectral radii {spectral_radius(A):.6g} and {spectral_radius(B):.6g}")


def predictor_by_doubling(A: Array, C: Array, Q: Array, R: Array) -> Array:
    """S = A (S - S Cᵀ (C S Cᵀ + R)^-1 C S) Aᵀ + Q, (nx, nx), for R > 0, and A stable or not.

    Source: the structured doubling algorithm of Chu, Fan, Lin, Wang, Int. J. Control 77 (2004) 767-788, eqs. (2.12).
    RunError where there is none: some part of the state grows and is never measured.
    """
    identity = np.eye(len(A))
    power, G, S = A.T, C.T @ np.linalg.solve(R, C), 0.5 * (Q + Q.T)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            half = np.linalg.solve(identity + G @ S, np.hstack((power, G)))
            moved, joined = half[:, : len(A)], half[:, len(A) :]
            added = power.T @ S @ moved
            G = G + power @ joined @ power.T
            S, power = S + 0.5 * (added + added.T), power @ moved
            G = 0.5 * (G + G.T)
            if not np.isfinite(S).all() or not np.isfinite(power).all():
                break
            if np.abs(added).max() <= DOUBLING_CONVERGED * np.abs(S).max():
                return S
    raise RunError("there is no stationary Kalman filter: a part of the state grows and is not measured")


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
