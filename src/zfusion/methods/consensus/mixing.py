"""Mixing: what n exchanges with the neighbours do to values that are spread over a network.

    v <- (I - γ L) v,  n times;      L the Laplacian of the weighted undirected graph

In the eigenvectors of L, mode l is multiplied by p_n(λ_l): (1 - γ λ_l)^n, or a scaled Chebyshev polynomial. Mode 1,
the average, is kept; the others are what the nodes disagree in.

Source: Spanos, Olfati-Saber, Murray, "Approximate distributed Kalman filtering in sensor networks with quantifiable
performance", IPSN 2005, eq. (1). The Chebyshev semi-iteration is that of Golub and Van Loan, "Matrix Computations",
4th ed., Section 11.2.8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, log, sin

import numpy as np

from zfusion.model.checks import ModelError
from zfusion.model.types import Array

SYMMETRIC = 1e-12
"""Relative difference of a_ij and a_ji that counts as none."""

CONNECTED = 1e-9
"""λ_2, in parts of max(1, λ_N), below which a network falls apart."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The Laplacian of a connected undirected network, (N, N), and its eigenvalues and orthonormal eigenvectors."""

    weights: Array
    """a_ij = a_ji >= 0, a_ii = 0, (N, N)."""
    values: Array
    """0 = λ_1 < λ_2 <= ... <= λ_N, (N,)."""
    vectors: Array
    """In columns, (N, N); the first is constant."""

    @classmethod
    def of(cls, weights: Array, names: Sequence[object] | None = None) -> Spectrum:
        """From the weights a_ij; what stands on the diagonal does not matter.

        Raises ModelError, with nodes by their `names`, unless they are finite, >= 0, symmetric, and connect all nodes.
        """
        a = np.array(weights, dtype=np.float64)
        named: list[object] = list(range(len(a)) if names is None else names)
        _check(a, named)
        np.fill_diagonal(a, 0.0)
        values, vectors = np.linalg.eigh(np.diag(a.sum(axis=1)) - a)
        if not values[1] > CONNECTED * max(1.0, values[-1]):
            raise ModelError("network", _components(a), "consensus needs a connected network: expected one component")
        values[0], vectors[:, 0] = 0.0, 1.0 / np.sqrt(len(a))
        return cls(a, values, vectors)

    @property
    def largest_step(self) -> float:
        """2 / λ_N: with this step size or a larger one, disagreement does not die out."""
        return float(2.0 / self.values[-1])

    @property
    def fastest_step(self) -> float:
        """γ* = 2 / (λ_2 + λ_N), for which the slowest mode dies out as fast as it can."""
        return float(2.0 / (self.values[1] + self.values[-1]))

    @property
    def fastest_rate(self) -> float:
        """ρ* = (λ_N - λ_2) / (λ_N + λ_2), what is left of the disagreement after an exchange with γ*."""
        return float((self.values[-1] - self.values[1]) / (self.values[-1] + self.values[1]))


def _check(a: Array, names: list[object]) -> None:
    if a.ndim != 2 or a.shape[0] != a.shape[1] or len(a) < 2:
        raise ModelError("network", a.shape, "consensus needs two nodes or more: expected a square matrix of weights")
    off = a[~np.eye(len(a), dtype=bool)]
    if not np.isfinite(off).all() or (off < 0).any():
        raise ModelError("network", a.tolist(), "expected finite weights >= 0")
    wrong = np.argwhere(np.abs(a - a.T) > SYMMETRIC * np.abs(a).max())
    if len(wrong):
        i, j = (int(n) for n in wrong[0])
        even = np.allclose(a.sum(axis=0), a.sum(axis=1))
        balance = "balanced" if even else "unbalanced: not even the average is preserved"
        expected = (
            f"directed graph not supported: weight {names[j]}->{names[i]} is {a[i, j]:g}, "
            f"{names[i]}->{names[j]} is {a[j, i]:g} ({balance})"
        )
        raise ModelError("network", f"{names[j]}->{names[i]}", expected)


def _components(a: Array) -> str:
    left, count = set(range(len(a))), 0
    while left:
        edge = {left.pop()}
        count += 1
        while edge:
            edge = {j for i in edge for j in np.flatnonzero(a[i]).tolist()} & left
            left -= edge
    return f"{count} components"


@dataclass(frozen=True, eq=False)
class Mixing:
    """n exchanges with step size γ, or with γ* and Chebyshev's weights."""

    spectrum: Spectrum
    rounds: int
    step: float
    """γ; the Chebyshev iteration uses γ* whatever this says."""
    chebyshev: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.rounds, bool) or not isinstance(self.rounds, int) or self.rounds < 1:
            raise ModelError("rounds", self.rounds, "expected a whole number >= 1")
        limit = self.spectrum.largest_step
        if not 0.0 < self.step < limit:
            raise ModelError("step_size", self.step, f"expected 0 < step size < 2 / λ_N = {limit:.10g}")

    @cached_property
    def relaxations(self) -> tuple[float, ...]:
        """ω_1 .. ω_n of v_{k+1} = ω_{k+1} (I - γ L) v_k + (1 - ω_{k+1}) v_{k-1}; all 1 without Chebyshev."""
        if not self.chebyshev:
            return (1.0,) * self.rounds
        squared = self.spectrum.fastest_rate**2
        omegas = [1.0, 1.0 / (1.0 - squared / 2.0)]
        while len(omegas) < self.rounds:
            omegas.append(1.0 / (1.0 - squared * omegas[-1] / 4.0))
        return tuple(omegas[: self.rounds])

    @cached_property
    def gamma(self) -> float:
        """The step size that is really used."""
        return self.spectrum.fastest_step if self.chebyshev else self.step

    @cached_property
    def factors(self) -> Array:
        """a_l = p_n(λ_l), what is left of each mode after all n exchanges, (N,); a_1 = 1."""
        once = 1.0 - self.gamma * self.spectrum.values
        earlier, now = np.ones_like(once), once
        for omega in self.relaxations[1:]:
            earlier, now = now, omega * once * now + (1.0 - omega) * earlier
        return now

    @property
    def slowest(self) -> float:
        """max over l >= 2 of |a_l|: what is left, at worst, of the disagreement after all n exchanges."""
        return float(np.abs(self.factors[1:]).max())

    @property
    def matrix(self) -> Array:
        """p_n(L), (N, N)."""
        vectors = self.spectrum.vectors
        return np.asarray((vectors * self.factors) @ vectors.T)


def rounds_needed(rate: float, frequency: float, tolerance: float) -> int:
    """The n from which |T_l(e^{jω})| <= tolerance for all modes and all ω <= frequency (rad a sample).

    n >= ln(1 + 2 sin(ω/2) / ε) / (-ln ρ), for ρ = `rate` an exchange. ValueError unless 0 < rate < 1, tolerance > 0.
    """
    if not 0.0 < rate < 1.0 or not tolerance > 0.0:
        raise ValueError(f"expected 0 < rate < 1 and tolerance > 0, got {rate} and {tolerance}")
    return max(1, ceil(log(1.0 + 2.0 * sin(frequency / 2.0) / tolerance) / -log(rate)))
