"""The convex designs of distributed l2-l∞ filters.

With V = ηᵀ P(s) η and P̄(s) = Σ_t π_st P(t), filters have the gain γ if for all modes s

    [A_s B_s]ᵀ P̄(s) [A_s B_s] + Σ_i [A_s,i 0]ᵀ P̄(s) [A_s,i 0] < diag(P(s), I),    L_zᵀ L_z < γ² P(s)

`diagonal`: P(s) = diag{R, Q_1(s), ..., Q_n(s)}, in which X_s = Q̄(s) K_s and Y_s = Q̄(s) H_s make it linear and keep the
graph's zeros. `slack`: P(s) full, and X_s = [X11 X12; τ Λ_s E, Λ_s] with Λ_s block diagonal in the place of P̄(s).

Source: Zhu, Wen, Peng, Yang, Control and Decision 35 (2020) 1841-1848, Theorem 2, reconstructed; the slack is new.
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from zfusion.methods.convex import Solved, block_variable, cvxpy, positive, solve
from zfusion.methods.l2_linf.problem import Gains, Problem, normalised
from zfusion.methods.plant import Mask
from zfusion.model.types import Array

FAILURE = "no filter with P=diag(R,Q(s)) found"
SLACK_FAILURE = "no filter with a full P(s) and block-diagonal slack found"


class Form(Enum):
    """What the filters may be."""

    GENERAL = "general"
    """Any K and H with the graph's zeros: never worse."""
    OBSERVER = "observer"
    """K and H under which the mean error does not feel the state; bears a graph that it was not designed for."""


class Designed(NamedTuple):
    """What a convex design says."""

    gains: Gains
    gamma: float
    solved: Solved


class _Unknowns(NamedTuple):
    """One mode's X_s = Q̄ K and Y_s = Q̄ H, or with Λᵀ in the place of Q̄."""

    X: Any
    Y: Any


def diagonal_design(problem: Problem, form: Form = Form.GENERAL, gamma: float | None = None) -> Designed:
    """Minimise γ, or find filters for the one given; DesignError where there are none."""
    cp = cvxpy()
    problem, unit = normalised(problem)
    n, nx, E = problem.n, problem.nx, problem.E
    R = cp.Variable((nx, nx), symmetric=True)
    Qs = [[cp.Variable((nx, nx), symmetric=True) for _ in range(n)] for _ in problem.masks]
    delta: Any = cp.Variable() if gamma is None else (gamma / unit) ** 2
    means = [
        [sum(chance * Q[i] for chance, Q in zip(row, Qs, strict=True) if chance > 0) for i in range(n)]
        for row in problem.transition
    ]
    constraints, unknowns = [positive([[R]])], []
    for s, mask in enumerate(problem.masks):
        X, Y = _filter_variables(problem, mask)
        unknowns.append(_Unknowns(X, Y))
        Q, mean = _block_diagonal(Qs[s]), _block_diagonal(means[s])
        constraints.append(_diagonal_inequality(problem, R, Q, mean, unknowns[s]))
        constraints += [_peak(problem.M, block, delta) for block in Qs[s]]
        if form is Form.OBSERVER:
            constraints.append(mean @ (E @ problem.A) - X @ E - Y @ problem.expected_C == 0)
    solved = solve(0 if gamma is not None else delta, constraints, FAILURE)
    weights = [[block.value for block in mean] for mean in means]
    promised = unit * float(np.sqrt(delta.value)) if gamma is None else gamma
    return Designed(_recovered(problem, weights, unknowns), promised, solved)


def slack_design(problem: Problem, tau: float, form: Form = Form.GENERAL) -> Designed:
    """Minimise γ with a full P(s); `tau` is the part of the slack that has to be scanned. DesignError as above."""
    cp = cvxpy()
    problem, unit = normalised(problem)
    n, nx, E = problem.n, problem.nx, problem.E
    extended = nx + problem.size
    Ps = [cp.Variable((extended, extended), symmetric=True) for _ in problem.masks]
    delta = cp.Variable()
    constraints, unknowns, slacks = [], [], []
    for s, mask in enumerate(problem.masks):
        Lams = [cp.Variable((nx, nx)) for _ in range(n)]
        Lam = _block_diagonal(Lams)
        X, Y = _filter_variables(problem, mask)
        unknowns.append(_Unknowns(X, Y))
        slacks.append(Lams)
        mean = sum(chance * P for chance, P in zip(problem.transition[s], Ps, strict=True) if chance > 0)
        constraints.append(_slack_inequality(problem, Ps[s], mean, Lam, unknowns[s], tau))
        constraints.append(_peak(problem.output, Ps[s], delta))
        if form is Form.OBSERVER:
            constraints.append(Lam.T @ (E @ problem.A) - X @ E - Y @ problem.expected_C == 0)
    solved = solve(delta, constraints, SLACK_FAILURE)
    weights = [[block.value.T for block in Lams] for Lams in slacks]
    return Designed(_recovered(problem, weights, unknowns), unit * float(np.sqrt(delta.value)), solved)


def _diagonal_inequality(problem: Problem, R: Any, Q: Any, mean: Any, unknowns: _Unknowns) -> Any:
    nx, N, nw, E = problem.nx, problem.size, problem.nw, problem.E
    X, Y = unknowns
    x_e, x_w, e_w = np.zeros((N, nx)), np.zeros((nw, nx)), np.zeros((nw, N))
    by_state = mean @ E @ problem.A - X @ E - Y @ problem.expected_C
    by_disturbance = mean @ E @ problem.B - Y @ problem.stacked_D
    rows: list[list[Any]] = [
        [R],
        [x_e, Q],
        [x_w, e_w, np.eye(nw)],
        [R @ problem.A, x_e.T, R @ problem.B, R],
        [by_state, X, by_disturbance, x_e, mean],
    ]
    noise = [x_e, np.zeros((N, N)), e_w.T, x_e, np.zeros((N, N))]
    for i in problem.doubtful:
        lost = problem.spread(i) * Y[:, problem.rows(i)] @ problem.C[i]
        rows.append([lost, *noise[1:], *[np.zeros((N, N))] * (len(rows) - 5), mean])
    return positive(_squared(rows))


def _slack_inequality(problem: Problem, P: Any, mean: Any, Lam: Any, unknowns: _Unknowns, tau: float) -> Any:
    cp = cvxpy()
    nx, N, nw, E = problem.nx, problem.size, problem.nw, problem.E
    X, Y = unknowns
    X11, X12 = cp.Variable((nx, nx)), cp.Variable((nx, N))
    slack = cp.bmat([[X11, X12], [tau * Lam @ E, Lam]])
    S = slack + slack.T - mean
    by_state = Lam.T @ E @ problem.A - X @ E - Y @ problem.expected_C
    by_disturbance = Lam.T @ E @ problem.B - Y @ problem.stacked_D
    A = cp.bmat([[X11.T @ problem.A + tau * E.T @ by_state, tau * E.T @ X], [X12.T @ problem.A + by_state, X]])
    B = cp.vstack([X11.T @ problem.B + tau * E.T @ by_disturbance, X12.T @ problem.B + by_disturbance])
    e_w, zero = np.zeros((nw, nx + N)), np.zeros((nx + N, nx + N))
    rows: list[list[Any]] = [[P], [e_w, np.eye(nw)], [A, B, S]]
    for i in problem.doubtful:
        lost = -problem.spread(i) * Y[:, problem.rows(i)] @ problem.C[i]
        noise = cp.bmat([[tau * E.T @ lost, np.zeros((nx, N))], [lost, np.zeros((N, N))]])
        rows.append([noise, e_w.T, zero, *[zero] * (len(rows) - 3), S])
    return positive(_squared(rows))


def _peak(output: Array, P: Any, delta: Any) -> Any:
    """[P Lᵀ; L δI] > 0: |L η|² <= δ ηᵀ P η."""
    return positive([[P, None], [output, delta * np.eye(len(output))]])


def _filter_variables(problem: Problem, mask: Mask) -> _Unknowns:
    states = [problem.nx] * problem.n
    return _Unknowns(block_variable(mask, states, states), block_variable(mask, states, problem.ny))


def _block_diagonal(blocks: list[Any]) -> Any:
    cp, zero = cvxpy(), np.zeros(blocks[0].shape)
    return cp.bmat([[block if i == j else zero for j in range(len(blocks))] for i, block in enumerate(blocks)])


def _squared(rows: list[list[Any]]) -> list[list[Any]]:
    """Lower triangle to whole rows, with None where the mirror image belongs."""
    return [row + [None] * (len(rows) - len(row)) for row in rows]


def _recovered(problem: Problem, weights: list[list[Array]], unknowns: list[_Unknowns]) -> Gains:
    """K = W⁻¹ X and H = W⁻¹ Y, node by node, with exact zeros."""
    nx, N = problem.nx, problem.size
    K, H = np.zeros((len(unknowns), N, N)), np.zeros((len(unknowns), N, sum(problem.ny)))
    for s, (mask, blocks, (X, Y)) in enumerate(zip(problem.masks, weights, unknowns, strict=True)):
        for i, block in enumerate(blocks):
            at = slice(i * nx, (i + 1) * nx)
            K[s, at], H[s, at] = np.linalg.solve(block, X.value[at]), np.linalg.solve(block, Y.value[at])
        rows, states = np.repeat(mask, nx, axis=0), [nx] * problem.n
        K[s] *= np.repeat(rows, states, axis=1)
        H[s] *= np.repeat(rows, problem.ny, axis=1)
    return Gains(K, H)
