"""What message loss does to a design: exact second moments when every link loses messages independently.

Given what arrived, η moves linearly; losses on the links into different nodes are independent, so only the diagonal
blocks feel their spread:  P⁺ = Ā P Āᵀ + B̄ B̄ᵀ + blockdiag_i Σ_S p_S (M_iS - M̄_i) Cov[z] (M_iS - M̄_i)ᵀ.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zfusion.methods.arrivals import arrivals
from zfusion.methods.stationary.cost import evaluate, extended
from zfusion.methods.stationary.design import Design
from zfusion.methods.stationary.substitution import Substitution
from zfusion.model.types import Array

SETTLED = 1e-12
"""Change of the covariance in one step, relative to its largest entry, that counts as none."""

STEPS = 20_000
"""After so many the covariance has either settled or never will."""

DIVERGED = 1e12
"""Growth of the covariance over that of the design, beyond which the network counts as unstable."""


class UnderLoss(NamedTuple):
    """Stationary operation when links lose messages."""

    mse: Array
    """Of each node, (n,); infinite where the network is not stable in mean square."""
    covariances: Array
    """Cov[e_i], (n, nx, nx)."""


def under_loss(design: Design, loss: float) -> UnderLoss:
    """Mean squared errors when each message is lost with probability `loss`, all independent; else InputError."""
    problem, plant = design.problem, design.problem.nominal
    nominal = evaluate(problem, design.gains).P
    nodes = [_Node(Substitution(problem, design.gains, nominal, i), loss) for i in range(plant.n)]
    nx, n = plant.nx, plant.n
    F, G = np.vstack([node.mean[0] for node in nodes]), np.vstack([node.mean[1] for node in nodes])
    A, B = extended(plant, F, G)
    noise = B @ B.T
    P = nominal
    limit = DIVERGED * np.abs(nominal).max()
    for _ in range(STEPS):
        following = A @ P @ A.T + noise
        for i, node in enumerate(nodes):
            at = slice((i + 1) * nx, (i + 2) * nx)
            following[at, at] += node.spread(P)
        change, P = np.abs(following - P).max(), 0.5 * (following + following.T)
        size = np.abs(P).max()
        if size > limit or change <= SETTLED * size:
            break
    if not change <= SETTLED * size:
        return UnderLoss(np.full(n, np.inf), np.full((n, nx, nx), np.inf))
    covariances = np.array([node.error(P) for node in nodes])
    return UnderLoss(np.trace(covariances, axis1=1, axis2=2), covariances)


class _Node:
    """One node's gains over all sets of arrivals."""

    def __init__(self, substitution: Substitution, loss: float) -> None:
        self._substitution = substitution
        neighbours = [j for j in range(substitution.problem.nominal.n) if substitution.problem.F[substitution.i, j]]
        others = [j for j in neighbours if j != substitution.i]
        self._sets = []
        for arrived, chance in arrivals(others, loss):
            there = tuple(sorted((substitution.i, *arrived)))
            seen = tuple(j for j in there if j in substitution.sensors)
            self._sets.append((substitution.of((there, seen)), chance))
        plant = substitution.problem.nominal
        self._states = plant.nx * len(substitution.states)
        width = self._states + sum(plant.ny[j] for j in substitution.sensors)
        self._wide = []
        for gains, chance in self._sets:
            wide = np.zeros((plant.nx, width))
            wide[:, gains.known] = gains.state
            self._wide.append((wide, chance))
        self._mean: Array = sum((chance * wide for wide, chance in self._wide), np.zeros((plant.nx, width)))

    @property
    def mean(self) -> tuple[Array, Array]:
        """Rows of the mean F, (nx, N), and of the mean G, (nx, p)."""
        problem, substitution = self._substitution.problem, self._substitution
        plant, i = problem.nominal, substitution.i
        F, G = np.zeros((plant.nx, problem.size)), np.zeros((plant.nx, len(plant.stacked_C)))
        columns = [plant.nx * j + a for j in substitution.states for a in range(plant.nx)]
        rows = np.flatnonzero(problem.blocks.G[i * plant.nx])
        F[:, columns], G[:, rows] = self._mean[:, : self._states], self._mean[:, self._states :]
        return F, G

    def spread(self, P: Array) -> Array:
        """Σ_S p_S (M_S - M̄) Cov[z] (M_S - M̄)ᵀ, (nx, nx)."""
        nx = self._substitution.problem.nominal.nx
        joint = self._substitution.joint(P)[nx:, nx:]
        total = np.zeros((nx, nx))
        for wide, chance in self._wide:
            apart = wide - self._mean
            total += chance * apart @ joint @ apart.T
        return total

    def error(self, P: Array) -> Array:
        """Cov[e_i] over all sets of arrivals, (nx, nx)."""
        nx = self._substitution.problem.nominal.nx
        joint = self._substitution.joint(P)
        total = np.zeros((nx, nx))
        for gains, chance in self._sets:
            total += chance * self._substitution.error_covariance(gains, joint)
        return total
