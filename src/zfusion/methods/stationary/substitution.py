"""What a node does when something is missing: it takes the conditional mean of it, given what is there.

Designed is the network in which every message arrives. Where ξ_j or y_j is missing at node i at a step, its linear
least-squares estimate from what node i has at that step, under the stationary covariance of the design, takes its
place. That is zero-mean, never larger (in variance) than what it stands for, and a function of the step's messages
alone: nothing is held over, so a replay has all that it needs. For each set of what is there the node then has
constant gains, which are kept once computed.

The estimate doubts what is there a little (DOUBT): the ξ of neighbours can be so alike that tiny differences
between them would be multiplied, and after losses those differences are no longer what the design says. Without
doubt some good designs become unstable at any rate of loss.

How well the network does with losses is no longer what the design promised: `losses` computes it. It is a matter of
the design, not of the substitute: those of the descent are fragile, those of the matrix inequalities are not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from zfusion.methods.stationary.cost import Gains, regression
from zfusion.methods.stationary.limits import sensor_rows
from zfusion.methods.stationary.problem import Problem
from zfusion.model.types import Array

DOUBT = 0.01
"""Part of its variance by which each component of what is there is taken to be wrong when it stands in for another."""

KEPT = 4096
"""Sets of what is there whose gains a node keeps; with more of them the oldest is forgotten."""

There = tuple[tuple[int, ...], tuple[int, ...]]
"""Whose ξ and whose y are there, each ascending, by position."""


class NodeGains(NamedTuple):
    """For one set of what is there, stacked as z = (ξ there; y there)."""

    state: Array
    """ξ_i(k+1) = state z, (nx, size)."""
    output: Array
    """x̂_i(k) = output z, (nx, size)."""
    known: list[int]
    """Where z is in the node's whole stack (ξ_{N_i}; y_{N_i})."""


@dataclass(eq=False)
class Substitution:
    """The gains of node `i` (a position) for whatever is there."""

    problem: Problem
    gains: Gains
    covariance: Array
    """Stationary Cov[η], (nx + N, nx + N)."""
    i: int
    filtered: bool = False
    """Whether the estimate uses the step's measurements too: x̂_{k/k} in the place of the method's x̂_{k/k-1}."""
    _kept: dict[There, NodeGains] = field(default_factory=dict)

    def __post_init__(self) -> None:
        plant, i = self.problem.nominal, self.i
        nx = plant.nx
        self.states = np.flatnonzero(self.problem.F[i] | self.problem.H[i]).tolist()
        self.sensors = np.flatnonzero(self.problem.G[i]).tolist()
        rows = sensor_rows(plant, self.sensors)
        columns = [nx * j + a for j in self.states for a in range(nx)]
        at = slice(i * nx, (i + 1) * nx)
        self._whole = np.hstack((self.gains.F[at, columns], self.gains.G[at, rows]))
        self._output = np.hstack((self.gains.H[at, columns], np.zeros((nx, len(rows)))))
        self._select = np.zeros((nx + len(columns) + len(rows), nx + self.problem.size))
        self._select[:nx, :nx] = np.eye(nx)
        self._select[range(nx, nx + len(columns)), [nx + c for c in columns]] = 1.0
        self._select[nx + len(columns) :, :nx] = plant.stacked_C[rows]
        self._noise = np.zeros((len(self._select),) * 2)
        self._noise[nx + len(columns) :, nx + len(columns) :] = plant.R[np.ix_(rows, rows)]
        self._joint = self.joint(self.covariance)

    def joint(self, P: Array) -> Array:
        """Covariance of (x; ξ_{N_i}; y_{N_i}), given that of η."""
        return self._select @ P @ self._select.T + self._noise

    def of(self, there: There) -> NodeGains:
        """The gains for what is there; the node's own ξ always is."""
        found = self._kept.get(there)
        if found is None:
            if len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]
            found = self._kept[there] = self._made(there)
        return found

    def error_covariance(self, gains: NodeGains, joint: Array) -> Array:
        """Cov[x - x̂_i], (nx, nx), of this step's estimate, given the covariance of (x; ξ_{N_i}; y_{N_i})."""
        nx = self.problem.nominal.nx
        at = [nx + k for k in gains.known]
        T, cross = gains.output, joint[:nx][:, at]
        mixed = T @ cross.T
        error: Array = joint[:nx, :nx] - mixed - mixed.T + T @ joint[np.ix_(at, at)] @ T.T
        return 0.5 * (error + error.T)

    def _made(self, there: There) -> NodeGains:
        plant = self.problem.nominal
        nx, first = plant.nx, plant.nx * len(self.states)
        ends = first + np.cumsum([plant.ny[j] for j in self.sensors])
        heard = [nx * n + a for n, j in enumerate(self.states) if j in there[0] for a in range(nx)]
        seen = [r for e, j in zip(ends, self.sensors, strict=True) if j in there[1] for r in range(e - plant.ny[j], e)]
        known = heard + seen
        state = self._completed(self._whole, known)
        if self.filtered:
            at = [nx + k for k in known]
            return NodeGains(state, regression(self._joint[:nx][:, at], self._joint[np.ix_(at, at)]), known)
        predicted = self._completed(self._output, heard)
        return NodeGains(state, np.hstack((predicted, np.zeros((nx, len(seen))))), known)

    def _completed(self, gain: Array, known: list[int]) -> Array:
        """gain @ E[whole stack | the known part], as a matrix on the known part."""
        nx = self.problem.nominal.nx
        missing = sorted(set(range(gain.shape[1])) - set(known))
        if not missing or not gain[:, missing].any():
            return gain[:, known]
        at, gone = [nx + k for k in known], [nx + k for k in missing]
        told = self._joint[np.ix_(at, at)]
        substitute = regression(self._joint[np.ix_(gone, at)], told + np.diag(DOUBT * told.diagonal()))
        return gain[:, known] + gain[:, missing] @ substitute
