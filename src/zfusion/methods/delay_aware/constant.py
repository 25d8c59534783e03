"""One gain for all steps: that of the filter's own limit, or the best one.

The gain that is optimal at each step is not the best constant one: it does not reckon with what it does to later steps.
With a constant gain L the error ξ_k = [x_k - x̂_k; z_{k-1}; ..; z_{k-L}], z = y - H x̂, moves by a constant matrix:

    Ξ = Φ(L) Ξ Φ(L)ᵀ + W(L),     J(L) = tr of Ξ's first block

where Λ = Φᵀ Λ Φ + CᵀC has ∂J/∂L = -2 Eᵀ Λ (Φ Ξ Mᵀ + ...). For Λ, Ξ held fixed, it is zero for one L: a direction of
descent, along which J is made smaller until nothing changes (Anderson and Moore's method for constrained gains).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zfusion.errors import RunError
from zfusion.methods.convex import DesignError
from zfusion.methods.delay_aware.joint import Reception, delay_noise, gain, measured, predicted, starting
from zfusion.methods.delay_aware.recursion import Filter
from zfusion.methods.gramians import lyapunov, spectral_radius
from zfusion.model.types import Array

CONVERGED = 1e-12
"""Relative change of P, X and the gain from step to step that counts as none."""

LONGEST = 100_000
"""Steps in which that must come about; a radius of 0.9997 takes so many."""

DESCENTS = 500
"""Steps of the descent; it takes some tens."""

HALVINGS = 40
"""Of a step that does not make the cost smaller."""

GAINED = 1e-13
"""Relative gain of a step of the descent that counts as none."""


class Stationary(NamedTuple):
    """What does not change with time; a model with random matrices adds to Q and R what it adds in the long run."""

    A: Array
    Q: Array
    """Cov w, and what a random A adds: (n, n)."""
    given: Reception


class Best(NamedTuple):
    """A constant gain, and the trace of the error covariance of the one-step prediction that it leads to."""

    L: Array
    variance: float


def moment_radius(A: Array, factors: Array) -> float:
    """Spectral radius of X -> A X Aᵀ + Σ_t B_t X B_tᵀ for factors B, (count, n, n): E[x xᵀ] is bounded if below 1."""
    return spectral_radius(np.kron(A, A) + sum((np.kron(B, B) for B in factors), np.zeros((len(A) ** 2,) * 2)))


def limit_gain(model: Stationary) -> Array:
    """The gain that the filter itself tends to, (n, m). DesignError where it does not settle."""
    A, Q, given = model
    steps, m = given.p.shape[0] - 1, given.p.shape[1]
    n = len(A)
    running, old = Filter(np.zeros(n), lyapunov(A, Q), steps, m), (np.zeros((n, m)), np.zeros((n, n)))
    for k in range(LONGEST):
        now = A @ running.receive(np.zeros(m), given).K, running.P
        same = all(np.abs(a - b).max() <= CONVERGED * np.abs(a).max() for a, b in zip(now, old, strict=True))
        if same and k > steps:  # before that the oldest messages have not come, perhaps none
            return now[0]
        running.move(A, Q)
        old = now
    raise DesignError(f"the gains do not settle within {LONGEST} steps (radius {spectral_radius(A):.6g})")


def best_gain(model: Stationary) -> Best:
    """The constant gain of least stationary trace of P, found by descent from `limit_gain`.

    DesignError where the state is not stable, RunError where nothing is stationary.
    """
    loop = _Loop(model)
    L = limit_gain(model)
    cost = loop.cost(L)
    for _ in range(DESCENTS):
        step = loop.target(L) - L
        before = cost
        for _ in range(HALVINGS):
            tried = loop.cost(L + step)
            if tried < cost:
                L, cost = L + step, tried
                break
            step = step / 2
        if before - cost <= GAINED * cost:
            break
    return Best(L, cost)


class _Loop:
    """The error under a constant gain, as a linear system."""

    def __init__(self, model: Stationary) -> None:
        A, Q, given = model
        steps, m = given.p.shape[0] - 1, given.p.shape[1]
        n = self._n = len(A)
        if not spectral_radius(A) < 1:
            raise DesignError(f"a constant gain needs a stable state (spectral radius {spectral_radius(A):.6g})")
        signal = starting(lyapunov(A, Q), steps, m)
        for _ in range(steps):
            signal = predicted(measured(signal, n, given.H, given.R), n, m, A, Q)
        signal = measured(signal, n, given.H, given.R)
        size = n + steps * m
        newest = given.p[0][:, None]
        self._M = np.hstack((newest * given.H, *(np.diag(given.p[j]) for j in range(1, steps + 1))))
        self._S = newest * given.R * newest.T + delay_noise(signal, n, given)  # of what is new in e
        self._free = np.zeros((size, size))
        self._free[:n, :n] = A
        self._noise = np.zeros((size, size))
        self._noise[:n, :n] = Q
        self._mixed = np.zeros((size, m))  # with what is new in e
        if steps:
            self._free[n : n + m, :n] = given.H
            self._free[n + m :, n : size - m] = np.eye(size - n - m)
            self._noise[n : n + m, n : n + m] = given.R
            self._mixed[n : n + m] = given.R * newest.T

    def _closed(self, L: Array) -> tuple[Array, Array]:
        n = self._n
        Phi, W = self._free.copy(), self._noise.copy()
        Phi[:n] -= L @ self._M
        W[:n] -= L @ self._mixed.T
        W[:, :n] -= self._mixed @ L.T
        W[:n, :n] += L @ self._S @ L.T
        return Phi, W

    def cost(self, L: Array) -> float:
        """J, infinite where L makes it unstable."""
        Phi, W = self._closed(L)
        if not spectral_radius(Phi) < 1:
            return float("inf")
        return float(lyapunov(Phi, W)[: self._n, : self._n].trace())

    def target(self, L: Array) -> Array:
        """Where the gradient would vanish if Λ and Ξ stayed as they are."""
        n = self._n
        Phi, W = self._closed(L)
        weight = np.zeros_like(Phi)
        weight[:n, :n] = np.eye(n)
        Xi, Lambda = lyapunov(Phi, W), lyapunov(Phi.T, weight)
        XiM = Xi @ self._M.T
        forward = self._free @ XiM + self._mixed
        aimed = forward[:n] + np.linalg.solve(Lambda[:n, :n], Lambda[:n, n:] @ forward[n:])
        return gain(aimed, self._M @ XiM + self._S)


def settled(model: Stationary) -> Best:
    """The filter's own limit, and its cost: DesignError and RunError as `best_gain`."""
    L = limit_gain(model)
    cost = _Loop(model).cost(L)
    if not np.isfinite(cost):
        raise RunError("the filter's own limit is not stable")
    return Best(L, cost)
