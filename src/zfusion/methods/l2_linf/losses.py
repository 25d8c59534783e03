"""What message loss does to the filters: exact second moments when every link loses messages independently.

A neighbour whose message is missing is taken to believe what the node does (module `filter`): K_ij and θ̄_j H_ij C_j
then act on the node's own x̂_i. Losses on the links into different nodes are independent, so beside the mean gains
only the diagonal blocks feel their spread, and that is uncorrelated with all else:

    X⁺ = [moments of the mean gains] + blockdiag_i Σ_S p_S (W_iS - W̄_i) E[z zᵀ] (W_iS - W̄_i)ᵀ,    z = (x̂; y)

for each mode, as in `verify.node_errors`. Misses of the sensors are common to all who hear them, losses are not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zfusion.methods.arrivals import arrivals
from zfusion.methods.l2_linf.design import Design
from zfusion.methods.l2_linf.problem import Gains, Problem, closed
from zfusion.methods.l2_linf.verify import next_moments
from zfusion.model.types import Array

SETTLED = 1e-12
"""Change of the moments in one step, relative to the largest, that counts as none."""

STEPS = 20_000
"""After so many they have either settled or never will."""


class _Spread(NamedTuple):
    """What the losses of one node's links do in one mode."""

    i: int
    mean: Array
    """W̄ = [K̄_i, H̄_i], (nx, N + p)."""
    sets: Sequence[tuple[Array, float]]
    """W_S - W̄ and the probability of S."""


def under_loss(design: Design, loss: float) -> Array:
    """Stationary E|x - x̂_i|² of each node, (n,), under the scenario's noises, when each message of the modes' graphs is
    lost with probability `loss`, all independent; infinite where nothing is stationary. InputError as `arrivals`.
    """
    problem, n, nx = design.problem, design.problem.n, design.problem.nx
    spreads = [[_spread(problem, design.gains, s, i, loss) for i in range(n)] for s in range(len(problem.masks))]
    whole = [np.vstack([one.mean for one in mode]) for mode in spreads]
    mean = Gains(np.array([W[:, : problem.size] for W in whole]), np.array([W[:, problem.size :] for W in whole]))
    motions, chances = closed(problem, mean), problem.stationary_modes
    noises = np.array([chance * motion.B @ motion.B.T for chance, motion in zip(chances, motions, strict=True)])
    X = np.zeros_like(noises)
    for _ in range(STEPS):
        spread = noises.copy()
        for s, mode in enumerate(spreads):
            joint = _joint(problem, X[s], chances[s])
            for i, _, sets in mode:
                at = slice((i + 1) * nx, (i + 2) * nx)
                spread[s][at, at] += sum(chance * W @ joint @ W.T for W, chance in sets)
        following = next_moments(problem, motions, X) + np.tensordot(problem.transition.T, spread, 1)
        change, X = np.abs(following - X).max(), following
        if not np.isfinite(change) or change <= SETTLED * np.abs(X).max():
            break
    if not change <= SETTLED * np.abs(X).max():
        return np.full(n, np.inf)
    return np.asarray(np.diagonal(X.sum(axis=0))[nx:].reshape(n, nx).sum(axis=1))


def _spread(problem: Problem, gains: Gains, s: int, i: int, loss: float) -> _Spread:
    nx, N = problem.nx, problem.size
    own = slice(i * nx, (i + 1) * nx)
    full = np.hstack((gains.K[s][own], gains.H[s][own]))
    linked = [int(j) for j in np.flatnonzero(problem.masks[s][i]) if j != i]
    made = []
    for arrived, chance in arrivals(linked, loss):
        W = full.copy()
        for j in set(linked) - set(arrived):
            columns, rows = slice(j * nx, (j + 1) * nx), problem.rows(j)
            measured = slice(N + rows.start, N + rows.stop)
            W[:, own] += full[:, columns] + full[:, measured] @ problem.expected_C[rows]
            W[:, columns], W[:, measured] = 0.0, 0.0
        made.append((W, chance))
    mean = sum((chance * W for W, chance in made), np.zeros_like(full))
    return _Spread(i, mean, [(W - mean, chance) for W, chance in made])


def _joint(problem: Problem, X: Array, chance: float) -> Array:
    """E[z zᵀ], z = (x̂; y), joint with the mode, given that of η = (x; e) and the mode's probability."""
    nx, C, D = problem.nx, problem.expected_C, problem.stacked_D
    of_state = np.zeros((len(C), len(X)))
    of_state[:, :nx] = C
    told = np.vstack((np.hstack((problem.E, -np.eye(problem.size))), of_state))
    joint = told @ X @ told.T
    joint[problem.size :, problem.size :] += chance * D @ D.T
    for j in problem.doubtful:
        at = slice(problem.size + problem.rows(j).start, problem.size + problem.rows(j).stop)
        missed = problem.spread(j) * problem.C[j]
        joint[at, at] += missed @ X[:nx, :nx] @ missed.T
    return np.asarray(joint)
