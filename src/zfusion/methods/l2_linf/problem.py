"""What distributed l2-l∞ filters are designed for: a plant, sensors that miss measurements, a graph that switches.

    x(k+1) = A x(k) + B w(k),   z = M x,   y_i(k) = θ_i(k) C_i x(k) + D_i w(k),   P(θ_i = 1) = θ̄_i
    x̂_i(k+1) = Σ_j K_ij^s x̂_j(k) + H_ij^s y_j(k),   ẑ_i = M x̂_i,   s the mode of step k, which all nodes know

w is one disturbance of finite energy for all, process and sensors; the modes are a Markov chain.

Source: Zhu, Wen, Peng, Yang, Control and Decision 35 (2020) 1841-1848, whose formulas were reconstructed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zfusion.methods.convex import DesignError
from zfusion.methods.gramians import lyapunov, spectral_radius
from zfusion.methods.plant import Mask, Sensed
from zfusion.model.checks import ModelError, finite_array
from zfusion.model.types import Array

PROBABILITY_SUM = 1e-9
"""How far from 1 a row of transition probabilities may add up, for decimals typed by hand."""


class Gains(NamedTuple):
    """The filters of all nodes by mode, with exact zeros where there is no link."""

    K: Array
    """(modes, N, N)."""
    H: Array
    """(modes, N, p)."""


@dataclass(frozen=True, eq=False)
class Problem(Sensed):
    """Plant, sensors, modes. Refuses what no filters can be designed for (ModelError, DesignError)."""

    A: Array
    """(nx, nx)."""
    B: Array
    """(nx, nw)."""
    C: tuple[Array, ...]
    """Each (p_i, nx)."""
    D: tuple[Array, ...]
    """Each (p_i, nw)."""
    M: Array
    """(nz, nx)."""
    arrival: Array
    """θ̄, (n,): the probabilities that a measurement has the signal in it."""
    modes: Array
    """(modes, n, n): positive where node i (row) receives from j; the diagonal is 1. What counts is the pattern."""
    transition: Array
    """π_st = P(next mode t | mode s), (modes, modes)."""

    def __post_init__(self) -> None:
        A = finite_array("A", self.A, (None, None))
        nx = A.shape[0]
        finite_array("A", A, (nx, nx))
        B = finite_array("B", self.B, (nx, None))
        if not self.C or len(self.C) != len(self.D):
            raise ModelError("C", len(self.C), "expected one or more C, and as many D")
        C = tuple(finite_array(f"C[{i}]", c, (None, nx)) for i, c in enumerate(self.C))
        D = tuple(finite_array(f"D[{i}]", d, (len(C[i]), B.shape[1])) for i, d in enumerate(self.D))
        arrival = finite_array("arrival", self.arrival, (len(C),))
        if ((arrival < 0) | (arrival > 1)).any():
            raise ModelError("arrival", arrival.tolist(), "expected probabilities, from 0 to 1")
        modes = _checked_modes(self.modes, len(C))
        transition = _stochastic(self.transition, len(modes))
        radius = spectral_radius(A)
        if radius >= 1:
            raise DesignError(f"A is not Schur stable (spectral radius {radius:.6g})")
        checked = {"A": A, "B": B, "C": C, "D": D, "M": finite_array("M", self.M, (None, nx)), "arrival": arrival}
        for name, value in (checked | {"modes": modes, "transition": transition}).items():
            object.__setattr__(self, name, value)

    @property
    def nw(self) -> int:
        """Size of the disturbance."""
        return int(self.B.shape[1])

    @property
    def size(self) -> int:
        """N = n nx, of all estimates together."""
        return self.n * self.nx

    @cached_property
    def masks(self) -> tuple[Mask, ...]:
        """The patterns of the modes, each (n, n)."""
        return tuple(mode > 0 for mode in self.modes)

    @cached_property
    def E(self) -> Array:
        """col(I, ..., I), (N, nx)."""
        return np.tile(np.eye(self.nx), (self.n, 1))

    @cached_property
    def expected_C(self) -> Array:
        """Θ̄ C = col(θ̄_i C_i), (p, nx)."""
        return np.vstack([chance * c for chance, c in zip(self.arrival, self.C, strict=True)])

    @cached_property
    def stacked_D(self) -> Array:
        """col(D_i), (p, nw)."""
        return np.vstack(self.D)

    @cached_property
    def output(self) -> Array:
        """L_z = [0 M̄], M̄ = blkdiag(M, ..., M): the errors of all z from η, (n nz, nx + N)."""
        return np.hstack((np.zeros((self.n * len(self.M), self.nx)), np.kron(np.eye(self.n), self.M)))

    @cached_property
    def doubtful(self) -> tuple[int, ...]:
        """The sensors whose measurement may or may not have the signal in it."""
        return tuple(i for i, chance in enumerate(self.arrival) if 0 < chance < 1)

    def spread(self, i: int) -> float:
        """σ_i, the standard deviation of θ_i."""
        return float(np.sqrt(self.arrival[i] * (1 - self.arrival[i])))

    def rows(self, i: int) -> slice:
        """Where sensor i's measurement is in the stack of all."""
        end = int(np.cumsum(self.ny)[i])
        return slice(end - self.ny[i], end)

    @cached_property
    def stationary_modes(self) -> Array:
        """A stationary distribution of the modes, (modes,): their long-run average from equal chances."""
        lazy = 0.5 * (self.transition + np.eye(len(self.transition)))  # the same averages, and never periodic
        for _ in range(64):
            lazy = lazy @ lazy
            lazy /= lazy.sum(axis=1, keepdims=True)
        return np.asarray(lazy.mean(axis=0))


def normalised(problem: Problem) -> tuple[Problem, float]:
    """The same in the unit of disturbance in which x̂ = 0 has a gain of about 1, and that unit.

    The filters are the same, and gains are to be multiplied with the unit. Solvers need numbers of about that size:
    with a γ of 10, one in two of the random examples fails.
    """
    X = lyapunov(problem.A, problem.B @ problem.B.T)
    unit = float(np.sqrt(problem.n * np.trace(problem.M @ X @ problem.M.T)))
    if not unit > 0:
        return problem, 1.0
    return replace(problem, B=problem.B / unit, D=tuple(d / unit for d in problem.D)), unit


class Closed(NamedTuple):
    """Motion of η = [x; e] in one mode: η⁺ = (A + Σ_i ζ_i noise_i) η + B w, with uncorrelated ζ_i of unit variance."""

    A: Array
    B: Array
    noises: tuple[Array, ...]


def closed(problem: Problem, gains: Gains) -> list[Closed]:
    """The motion in each mode; e_i = x - x̂_i."""
    nx, E = problem.nx, problem.E
    found = []
    for K, H in zip(gains.K, gains.H, strict=True):
        A = np.zeros((nx + problem.size,) * 2)
        A[:nx, :nx] = problem.A
        A[nx:, :nx] = E @ problem.A - K @ E - H @ problem.expected_C
        A[nx:, nx:] = K
        noises = []
        for i in problem.doubtful:
            noise = np.zeros_like(A)
            noise[nx:, :nx] = -problem.spread(i) * H[:, problem.rows(i)] @ problem.C[i]
            noises.append(noise)
        found.append(Closed(A, np.vstack((problem.B, E @ problem.B - H @ problem.stacked_D)), tuple(noises)))
    return found


def _checked_modes(modes: Array, n: int) -> Array:
    checked = finite_array("modes", modes, (None, n, n))
    if (checked < 0).any():
        raise ModelError("modes", checked.tolist(), "expected adjacency matrices without negative entries")
    if (np.diagonal(checked, axis1=1, axis2=2) != 1).any():
        raise ModelError("modes", checked.tolist(), "expected adjacency matrices with a diagonal of ones")
    return checked


def _stochastic(transition: Array, count: int) -> Array:
    checked = finite_array("transition", transition, (count, count))
    if (checked < 0).any() or (np.abs(checked.sum(axis=1) - 1) > PROBABILITY_SUM).any():
        raise ModelError("transition", checked.tolist(), "expected rows of numbers >= 0 that add up to 1")
    return checked
