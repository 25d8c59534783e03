"""The optimal unbiased filter under random gains, random delays and losses: the recursion.

    x_{k+1} = A x_k + w_k,  Cov w_k = Q              y_k = H x_k + η_k,  Cov η_k = R
    r_k     = Σ_{j=0..L} Δ_j y_{k-j} + n_k           Δ_j = 1 with probability p_j: not seen by the receiver

    x̂_{k+1} = A x̂_k + L_k e_k,   e_k = r_k - Σ_j P̄_j H_{k-j} x̂_{k-j}           L_k = G_k S_k⁺

Means are meant where matrices are random: what that adds to Q and R is in Q and R already. L_k is optimal at each step
given this structure and the earlier gains. P is exact for whatever gains.

Source: Liu, He, Wang, Zhou, Automatica 50 (2014) 1521-1525: the model and the structure. The gains and the covariances
are derived anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zfusion.methods.delay_aware.joint import (
    Joints,
    Reception,
    Settling,
    delay_noise,
    gain,
    moved,
    predicted,
    received,
    starting,
)
from zfusion.model.types import Array


class Innovation(NamedTuple):
    """What a reception brings."""

    e: Array
    """(m,)."""
    S: Array
    """Cov e, (m, m). e is not white where there are delays."""
    cross: Array
    """Cov[x_k - x̂_k, e_k], (n, m)."""
    K: Array
    """cross S⁺, (n, m): x̂_{k/k} = x̂_k + K e."""
    x: Array
    """x̂_{k/k}, (n,): not fed back into older innovations."""
    P: Array
    """Its error covariance P_{k/k}, (n, n)."""

    @property
    def normalised(self) -> float:
        """eᵀ S⁺ e: its mean is the rank of S."""
        return float(gain(self.e[None], self.S)[0] @ self.e)


class Gains(NamedTuple):
    """What does not depend on what is received; letters as in `Innovation`."""

    S: Array
    cross: Array
    K: Array
    P: Array
    row: Array
    """E[b̄ ζᵀ] of the error, (m, n + (L+1) m)."""


class Filter(Settling[Gains]):
    """The filter: `receive`, then `move`, and so on, or the other way round from the second step on.

    Inputs that are the same objects as at the step before count as unchanged.
    """

    def __init__(self, mean: Array, covariance: Array, steps: int, m: int) -> None:
        """E x and Cov x of the first step, (n,) and (n, n); messages are up to `steps` old; m rows are received."""
        second = covariance + np.outer(mean, mean)
        super().__init__(Joints(starting(covariance, steps, m), starting(second, steps, m)))
        self._n, self._m = len(mean), m
        self.x = mean
        """x̂_k from all that was received before step k, (n,)."""
        self._expected = np.zeros((steps + 1, m))
        """H_{k-j} x̂_{k-j}."""
        self._received: tuple[Innovation, Reception] | None = None

    @property
    def P(self) -> Array:
        """Cov[x_k - x̂_k], (n, n)."""
        return self._joints.error[: self._n, : self._n]

    @property
    def X(self) -> Array:
        """E[x_k x_kᵀ], (n, n)."""
        return self._joints.signal[: self._n, : self._n]

    def receive(self, r: Array, given: Reception) -> Innovation:
        """Take in what is received at step k, (m,): zero where nothing is."""
        gains = self._receive(self._n, given)
        self._expected[0] = given.H @ self.x
        e = r - (given.p * self._expected).sum(axis=0)
        found = Innovation(e, gains.S, gains.cross, gains.K, self.x + gains.K @ e, gains.P)
        self._received = found, given
        return found

    def move(self, A: Array, Q: Array, L: Array | None = None) -> None:
        """To the next step; `L`, (n, m), in the place of the optimal gain. ValueError before anything was received."""
        if self._received is None:
            raise ValueError("nothing was received at this step")
        found, given = self._received
        self._move(self._n, given, A, Q, L)
        self.x = A @ self.x + (A @ found.K if L is None else L) @ found.e
        self._expected = np.vstack((np.zeros(self._m), self._expected[:-1]))
        self._received = None

    def _gains(self, measured: Joints, given: Reception) -> Gains:
        n = self._n
        row, spread = received(measured.error, n, given.p)
        S = 0.5 * (spread + spread.T) + delay_noise(measured.signal, n, given)
        cross = row[:, :n].T
        K = gain(cross, S)
        P = self.P - K @ cross.T
        return Gains(S, cross, K, 0.5 * (P + P.T), row)

    def _following(self, measured: Joints, found: Gains, A: Array, Q: Array, L: Array | None) -> Joints:
        n, m = self._n, self._m
        L = A @ found.K if L is None else L
        G = A @ found.cross
        top = A @ measured.error[:n]
        corner = top[:, :n] @ A.T + Q - L @ G.T - G @ L.T + L @ found.S @ L.T
        return Joints(moved(measured.error, n, m, top - L @ found.row, corner), predicted(measured.signal, n, m, A, Q))
