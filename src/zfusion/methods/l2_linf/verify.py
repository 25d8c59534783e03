"""What given filters really do: a certificate, stability, the worst disturbance, and what nobody can beat."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zfusion.methods.convex import DesignError, cvxpy, positive, positive_matrix, solve
from zfusion.methods.gramians import predictor_covariance
from zfusion.methods.l2_linf.problem import Closed, Gains, Problem, closed, normalised
from zfusion.model.types import Array

HORIZON = 60
"""Steps of the worst disturbance; in the reference example a longer one changes nothing in six digits."""

FAILURE = "the filters have no certificate"

ACCURACY = 1e-7
"""By how much of itself an inequality may be missed: by the solver's rounding, no more."""

RADIUS_CONVERGED = 1e-10
RADIUS_STEPS = 20_000


class Certificate(NamedTuple):
    """A bound of the gain of given filters, and what proves it."""

    gamma: float
    P: tuple[Array, ...]
    """By mode, (nx + N, nx + N)."""


class WorstCase(NamedTuple):
    """The disturbance of unit energy, fixed beforehand, with the largest mean square error at the end."""

    gain: float
    """The root of that: a lower bound of the true gain."""
    disturbance: Array
    """w(0), ..., w(horizon - 1), (horizon, nw)."""


def certify(problem: Problem, gains: Gains) -> Certificate:
    """The smallest γ that a Lyapunov function with full P(s) proves; DesignError if none proves any.

    Usually some per cent below what a design with less freedom says.
    """
    problem, unit = normalised(problem)
    motions = closed(problem, gains)
    if not (size := radius(problem, gains)) < 1:
        raise DesignError(f"{FAILURE}: they are not stable in mean square (radius {size:.6g})")
    Ps, delta = unknown_proof(problem)
    solve(delta, proves(problem, motions, Ps, delta), FAILURE)
    _check(problem, motions, np.array([P.value for P in Ps]), float(delta.value))
    return Certificate(unit * float(np.sqrt(delta.value)), tuple(P.value / unit**2 for P in Ps))


def unknown_proof(problem: Problem) -> tuple[list[Any], Any]:
    """P(s) of each mode, (nx + N, nx + N), and δ = γ², to be solved for."""
    cp = cvxpy()
    extended = problem.nx + problem.size
    return [cp.Variable((extended, extended), symmetric=True) for _ in problem.masks], cp.Variable()


def proves(problem: Problem, motions: list[Closed], Ps: list[Any], delta: Any, margin: Any = 0.0) -> list[Any]:
    """The constraints under which the P(s) prove γ² = δ of given filters, the first of them with a margin.

    diag(P, I) - [A B]ᵀ P̄ [A B] - Σ_i [A_i 0]ᵀ P̄ [A_i 0] >= margin I,   [P, L_zᵀ; L_z, δ I] >= 0,   P̄ = Σ_t π_st P(t)
    """
    cp = cvxpy()
    constraints = []
    for s, motion in enumerate(motions):
        mean = sum(chance * P for chance, P in zip(problem.transition[s], Ps, strict=True) if chance > 0)
        left = cp.bmat(_dissipated(Ps[s], mean, motion))
        constraints.append(positive_matrix(left - margin * np.eye(left.shape[0])))
        constraints.append(positive([[Ps[s], None], [problem.output, delta * np.eye(len(problem.output))]]))
    return constraints


def _dissipated(P: Any, mean: Any, motion: Closed) -> list[list[Any]]:
    """diag(P, I) - [A B]ᵀ P̄ [A B] - Σ_i [A_i 0]ᵀ P̄ [A_i 0], by blocks; numbers or unknowns."""
    AA = motion.A.T @ mean @ motion.A + sum(noise.T @ mean @ noise for noise in motion.noises)
    AB, BB = motion.A.T @ mean @ motion.B, motion.B.T @ mean @ motion.B
    return [[P - AA, -AB], [-AB.T, np.eye(motion.B.shape[1]) - BB]]


def _check(problem: Problem, motions: list[Closed], Ps: Array, delta: float) -> None:
    """Whether the solver's numbers prove what they should; DesignError if not: solvers say so of others, too."""
    for s, motion in enumerate(motions):
        mean = np.tensordot(problem.transition[s], Ps, 1)
        peak = delta * Ps[s] - problem.output.T @ problem.output
        for matrix in (np.block(_dissipated(Ps[s], mean, motion)), peak):
            lowest = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])
            if not lowest > -ACCURACY * np.abs(matrix).max():
                raise DesignError(f"{FAILURE} (the solver's misses it by {-lowest:.3g})")


def radius(problem: Problem, gains: Gains) -> float:
    """Spectral radius of X(t) <- Σ_s π_st (A_s X(s) A_sᵀ + Σ_i A_s,i X(s) A_s,iᵀ): below 1, stable in mean square.

    By power iteration, shifted by 1: eigenvalues of the same modulus as the largest, which oscillate, then decay.
    """
    motions = closed(problem, gains)
    X = np.array([np.eye(len(motions[0].A))] * len(motions))
    last = 0.0
    for _ in range(RADIUS_STEPS):
        X = X / np.trace(X, axis1=1, axis2=2).sum()
        X = X + next_moments(problem, motions, X)
        size = float(np.trace(X, axis1=1, axis2=2).sum())
        if abs(size - last) <= RADIUS_CONVERGED:
            break
        last = size
    return size - 1.0


def next_moments(problem: Problem, motions: list[Closed], X: Array) -> Array:
    """Second moments of η joint with the mode, one step on without disturbance, (modes, nx + N, nx + N)."""
    moved = np.array([moment(motion, before) for motion, before in zip(motions, X, strict=True)])
    following: Array = np.tensordot(problem.transition.T, moved, 1)
    return following


def node_errors(problem: Problem, gains: Gains) -> Array:
    """Stationary mean squared errors E|x - x̂_i|² under white noise of unit variance, over misses and modes, (n,)."""
    motions, chances = closed(problem, gains), problem.stationary_modes
    noises = np.array([chance * motion.B @ motion.B.T for chance, motion in zip(chances, motions, strict=True)])
    entering: Array = np.tensordot(problem.transition.T, noises, 1)
    X = entering
    for _ in range(RADIUS_STEPS):
        following = next_moments(problem, motions, X) + entering
        settled = np.abs(following - X).max() <= RADIUS_CONVERGED * np.abs(following).max()
        X = following
        if settled:
            break
    errors = np.diagonal(X.sum(axis=0))[problem.nx :]
    return np.asarray(errors.reshape(problem.n, problem.nx).sum(axis=1))


def moment(motion: Closed, X: Array) -> Array:
    """A X Aᵀ + Σ_i A_i X A_iᵀ."""
    moved = motion.A @ X @ motion.A.T
    for noise in motion.noises:
        moved = moved + noise @ X @ noise.T
    return moved


def worst_disturbance(
    problem: Problem, gains: Gains, horizon: int = HORIZON, initial: Array | None = None
) -> WorstCase:
    """From E|z̃(horizon)|² = wᵀ W w, W block by block backwards.

    `initial`: the distribution of the first mode, by default the stationary one.
    """
    motions, nw = closed(problem, gains), problem.nw
    chances = [problem.stationary_modes if initial is None else np.asarray(initial, dtype=np.float64)]
    for _ in range(horizon - 1):
        chances.append(chances[-1] @ problem.transition)
    whole = np.zeros((horizon, nw, horizon, nw))
    S = np.array([problem.output.T @ problem.output] * len(motions))
    later = np.zeros((len(motions), len(S[0]), 0))
    """T_l of all k > l, side by side."""
    for k in range(horizon - 1, -1, -1):
        S_mean = np.tensordot(problem.transition, S, 1)
        later_mean = np.tensordot(problem.transition, later, 1)
        following, columns = [], []
        for s, motion in enumerate(motions):
            whole[k, :, k] += chances[k][s] * motion.B.T @ S_mean[s] @ motion.B
            if k + 1 < horizon:
                mixed = (chances[k][s] * motion.B.T @ later_mean[s]).reshape(nw, horizon - k - 1, nw)
                whole[k, :, k + 1 :] += mixed
            columns.append(np.hstack((motion.A.T @ S_mean[s] @ motion.B, motion.A.T @ later_mean[s])))
            following.append(moment(Closed(motion.A.T, motion.B, tuple(n.T for n in motion.noises)), S_mean[s]))
        S, later = np.array(following), np.array(columns)
    flat = whole.reshape(horizon * nw, horizon * nw)
    values, vectors = np.linalg.eigh(np.triu(flat) + np.triu(flat, 1).T)
    return WorstCase(float(np.sqrt(values[-1])), vectors[:, -1].reshape(horizon, nw))


def lower_bound(problem: Problem) -> float | None:
    """√(n M Σ Mᵀ), Σ of the centralised predictor: no linear filters do better. None with misses or several z."""
    if (problem.arrival != 1).any() or len(problem.M) != 1:
        return None
    B, D = problem.B, problem.stacked_D
    S = predictor_covariance(problem.A, np.vstack(problem.C), B @ B.T, D @ D.T, B @ D.T)
    return float(np.sqrt(problem.n * (problem.M @ S @ problem.M.T)[0, 0]))
