"""The true cost when messages are doubted: each comes multiplied by 1 + ζ, ζ of zero mean and variance `doubt`.

It is what message loss does, with doubt = p / (1 - p), to gains that make up for it by a factor. A descent on the
cost without doubt buys its last tenths of a per cent with differences of neighbours' ξ so fine that one lost message
undoes them; with a doubt of some thousandths it costs next to nothing more and bears losses.

With W = [F G] without the own blocks, Z the covariance of (ξ; y) and D the parts of a matrix that belong to one node:

    P = A_e P A_eᵀ + B_e B_eᵀ + doubt D(W D(Z) Wᵀ),    J = tr C_e P C_eᵀ + doubt Σ_{j != i} tr H_ij P_jj H_ijᵀ

and the adjoint for Q; the gradients are those of `cost`, and 2 doubt D(Q_22) W D(Z) for W.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zfusion.methods.gramians import CONVERGED, DOUBLINGS
from zfusion.methods.stationary.cost import Gains, extended, output, regression, row_weights
from zfusion.methods.stationary.problem import Problem, block_diagonal
from zfusion.model.types import Array

ROUNDS = 500
"""Most rounds of the fixed point; if it needs more, the network is about to lose its stability under doubt."""

DIVERGED = 1e8
"""Growth over the matrix without doubt from which on there is none with it."""

ACCURACY = 1e-11
"""Relative change in a round that counts as none: the descent asks for ten digits of the cost."""


class Doubted:
    """Cost and gradients for one plant, H being the best for the F and G asked about."""

    def __init__(self, problem: Problem, doubt: float) -> None:
        plant = problem.nominal
        nx, n, size = plant.nx, plant.n, problem.size
        self._problem, self._doubt = problem, doubt
        self._node = np.repeat(np.arange(n), nx)
        of_all = np.concatenate((self._node, np.repeat(np.arange(n), plant.ny)))
        self._same = (self._node[:, None] == self._node).astype(np.float64)
        self._same_of_all = (of_all[:, None] == of_all).astype(np.float64)
        self._others = (self._node[:, None] != of_all).astype(np.float64)
        self._seen = np.zeros((len(of_all), nx + size))
        self._seen[:size, nx:] = np.eye(size)
        self._seen[size:, :nx] = plant.stacked_C
        self._noise = block_diagonal([np.zeros((size, size)), plant.R])

    def cost(self, F: Array, G: Array) -> tuple[float, Gains] | None:
        """J and its derivatives by F and G (by H they are zero), or None where there is no stationary state."""
        problem, plant, doubt = self._problem, self._problem.nominal, self._doubt
        nx, size = plant.nx, problem.size
        A, B = extended(plant, F, G)
        W = np.hstack((F, G)) * self._others
        powers = _powers(A)
        P = _fixed_point(powers, B @ B.T, lambda P: self._scattered(W, P))
        if P is None:
            return None
        H = self.best_output(P)
        C = output(problem, H)
        H_others = row_weights(problem)[:, None] * H * self._others[:, :size]
        source = C.T @ C
        source[nx:, nx:] += doubt * self._same * (H_others.T @ H_others)
        Q = _fixed_point([power.T for power in powers], source, lambda Q: self._gathered(W, Q))
        if Q is None:
            return None
        J = float(np.sum(source * P))
        slope = 2 * Q @ A @ P
        by_noise = (2 * Q @ B)[nx:, plant.process_root.shape[1] :]
        dW = 2 * doubt * (Q[nx:, nx:] * self._same) @ W @ self._own_parts(P) * self._others
        dF = slope[nx:, nx:] + dW[:, :size]
        dG = slope[nx:, :nx] @ plant.stacked_C.T + by_noise @ plant.sensor_root.T + dW[:, size:]
        return J, Gains(dF * problem.blocks.F, dG * problem.blocks.G, np.zeros_like(H))

    def best_output(self, P: Array) -> Array:
        """Row i: P_{x,N_i} (P_{N_i,N_i} + doubt D(P_{N_i,N_i}) of the others)⁺, (N, N)."""
        problem, nx = self._problem, self._problem.nominal.nx
        H = np.zeros((problem.size, problem.size))
        doubted = P[nx:, nx:] * self._same
        for i in range(problem.nominal.n):
            known = np.flatnonzero(problem.blocks.H[i * nx])
            apart = self._doubt * doubted[np.ix_(known, known)] * (self._node[known] != i)
            at = nx + known
            H[i * nx : (i + 1) * nx, known] = regression(P[:nx][:, at], P[np.ix_(at, at)] + apart)
        return H

    def covariance(self, F: Array, G: Array) -> Array | None:
        """P, or None where there is none."""
        A, B = extended(self._problem.nominal, F, G)
        W = np.hstack((F, G)) * self._others
        return _fixed_point(_powers(A), B @ B.T, lambda P: self._scattered(W, P))

    def _own_parts(self, P: Array) -> Array:
        """D(Z): of each node the covariance of what it says, (N + p, N + p)."""
        parts: Array = (self._seen @ P @ self._seen.T + self._noise) * self._same_of_all
        return parts

    def _scattered(self, W: Array, P: Array) -> Array:
        """What the doubt adds to the covariance."""
        nx, added = self._problem.nominal.nx, np.zeros_like(P)
        added[nx:, nx:] = self._doubt * (W @ self._own_parts(P) @ W.T) * self._same
        return added

    def _gathered(self, W: Array, Q: Array) -> Array:
        """The adjoint of `_scattered`, but for the noise."""
        nx = self._problem.nominal.nx
        inner = (W.T @ (Q[nx:, nx:] * self._same) @ W) * self._same_of_all
        gathered: Array = self._doubt * self._seen.T @ inner @ self._seen
        return gathered


def _powers(A: Array) -> list[Array]:
    """A, A², A⁴, ... until nothing is left."""
    powers = [A]
    while np.abs(powers[-1]).max() > CONVERGED and len(powers) < DOUBLINGS:
        powers.append(powers[-1] @ powers[-1])
    return powers


def _fixed_point(powers: list[Array], source: Array, more: Callable[[Array], Array]) -> Array | None:
    """X = A X Aᵀ + source + more(X), with the powers of A; None if it does not settle."""

    def summed(X: Array) -> Array:
        for power in powers:
            X = X + power @ X @ power.T
        return 0.5 * (X + X.T)

    X = summed(source)
    largest = DIVERGED * np.abs(X).max()
    for _ in range(ROUNDS):
        following = summed(source + more(X))
        change, size = np.abs(following - X).max(), np.abs(following).max()
        if not size <= largest:
            return None
        X = following
        if change <= ACCURACY * size:
            return X
    return None
