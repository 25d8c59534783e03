"""Moments of the state and the last measurements together, one array for all: what the filters' recursions carry.

    J = E[ζ ζᵀ],    ζ_k = [a_k; b_k; b_{k-1}; ..; b_{k-L}],    a_k in R^n,    b_k = H a_k + η_k in R^m,  Cov η_k = R

a is the state, or the error of its estimate; η is uncorrelated with all that was before. Blocks of times before the
first are zero. J is square of size n + (L+1) m.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from zfusion.model.types import Array

RANK = 1e-12
"""Eigenvalues of a covariance scaled to unit diagonal that are so small beside the largest count as zero."""

SETTLED = 1e-14
"""Change in a step, relative to the largest entry, that counts as none."""

T = TypeVar("T")


class Reception(NamedTuple):
    """The statistics of what is received at a step: r = Σ_j Δ_j y_{k-j} + n, y_k = H x_k + η_k.

    Classes are the sensors that send together: they share the probabilities p_j = Prob{Δ_j = 1}.
    """

    H: Array
    """Mean of the measurement matrix, (m, n)."""
    R: Array
    """Cov η: measurement noise, and what a random matrix adds, (m, m)."""
    N: Array
    """Cov n, noise of the reception, (m, m)."""
    p: Array
    """p_j of the class of each row, (L+1, m)."""
    same: Array
    """1 where row and column are of one class, else 0, (m, m)."""


def starting(a: Array, steps: int, m: int) -> Array:
    """J before the first measurement, E[a aᵀ] = `a`, for measurements up to `steps` old."""
    n = len(a)
    J = np.zeros((n + (steps + 1) * m,) * 2)
    J[:n, :n] = a
    return J


def measured(J: Array, n: int, H: Array, R: Array) -> Array:
    """J with the newest measurement b_k = H a_k + η_k in its first block, which is free since `moved`."""
    J, new = J.copy(), slice(n, n + len(H))
    J[:n, new] = J[:n, :n] @ H.T
    row = H @ J[:n]
    row[:, new] = 0.5 * (row[:, new] + row[:, new].T) + R
    J[new], J[:, new] = row, row.T
    return J


def moved(J: Array, n: int, m: int, top: Array, corner: Array) -> Array:
    """J one step on, with room for the next measurement.

    `top` is E[a_{k+1} ζ_kᵀ], (n, n + (L+1) m), and `corner` E[a_{k+1} a_{k+1}ᵀ], (n, n).
    """
    following = np.zeros_like(J)
    following[:n, :n] = 0.5 * (corner + corner.T)
    following[:n, n + m :] = top[:, n : len(J) - m]
    following[n + m :, :n] = following[:n, n + m :].T
    following[n + m :, n + m :] = J[n : len(J) - m, n : len(J) - m]
    return following


def predicted(J: Array, n: int, m: int, A: Array, Q: Array) -> Array:
    """J one step on, where a_{k+1} = A a_k + w, Cov w = Q."""
    top = A @ J[:n]
    return moved(J, n, m, top, top[:, :n] @ A.T + Q)


def received(J: Array, n: int, p: Array) -> tuple[Array, Array]:
    """With b̄ = Σ_j P̄_j b_{k-j}: E[b̄ ζᵀ], (m, n + (L+1) m), and E[b̄ b̄ᵀ], (m, m)."""
    count, m = p.shape
    left = np.einsum("ja,jab->ab", p, J[n:].reshape(count, m, len(J)))
    return left, np.einsum("ajb,jb->ab", left[:, n:].reshape(m, count, m), p)


def delay_noise(J: Array, n: int, given: Reception) -> Array:
    """Cov of d = Σ_j (Δ_j - P̄_j) y_{k-j} + n, (m, m); J of the state itself, not of an error."""
    count, m = given.p.shape
    blocks = J[n:, n:].reshape(count, m, count, m)
    whole = np.einsum("ja,jajb->ab", given.p, blocks)
    D = given.N + given.same * (whole - received(J, n, given.p)[1])
    return np.asarray(0.5 * (D + D.T))


def gain(cross: Array, S: Array) -> Array:
    """cross S⁺, (n, m), for a covariance S, (m, m), that may be singular: rows of zero variance get gain zero."""
    variance = S.diagonal()
    scale = np.sqrt(np.where(variance > 0, variance, 1.0))
    values, vectors = np.linalg.eigh(S / np.outer(scale, scale))
    kept = values > RANK * max(values[-1], 0.0)
    basis = vectors[:, kept] / scale[:, None]
    found: Array = ((cross @ basis) / values[kept]) @ basis.T
    return found


class Joints(NamedTuple):
    """What a filter carries: J of its error, and of the state itself."""

    error: Array
    signal: Array


class Settling(ABC, Generic[T]):
    """A recursion for joints and gains, which do not depend on what is received: it rests once nothing changes."""

    def __init__(self, joints: Joints) -> None:
        self._joints = joints
        """Of the present step, with room for its measurement."""
        self._measured: Joints | None = None
        """The same with it; None before anything was received, and at rest."""
        self._found: T | None = None
        self._inputs: tuple[object, ...] = ()
        """Those of the last step."""
        self._at_rest = False

    @abstractmethod
    def _gains(self, measured: Joints, given: Reception) -> T:
        """What follows from the joints."""

    @abstractmethod
    def _following(self, measured: Joints, found: T, A: Array, Q: Array, L: Array | None) -> Joints:
        """The joints one step on."""

    def _receive(self, n: int, given: Reception) -> T:
        if self._at_rest and self._found is not None and _same(tuple(given), self._inputs[: len(given)]):
            return self._found
        self._at_rest = False
        self._measured = Joints(*(measured(J, n, given.H, given.R) for J in self._joints))
        self._found = self._gains(self._measured, given)
        return self._found

    def _move(self, n: int, given: Reception, A: Array, Q: Array, L: Array | None = None) -> None:
        inputs = (*given, A, Q, L)
        unchanged = _same(inputs, self._inputs)
        if self._at_rest and unchanged:
            return
        if self._at_rest:
            self._at_rest = False
            self._receive(n, given)
        assert self._measured is not None  # not at rest
        assert self._found is not None
        following = self._following(self._measured, self._found, A, Q, L)
        self._at_rest = unchanged and all(
            np.abs(new - old).max() <= SETTLED * np.abs(new).max()
            for new, old in zip(following, self._joints, strict=True)
        )
        self._joints, self._inputs = following, inputs


def _same(some: tuple[object, ...], others: tuple[object, ...]) -> bool:
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))
