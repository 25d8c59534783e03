"""Better filters from any: the Lyapunov function for fixed filters, then the filters for a fixed Lyapunov function."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zfusion.methods.convex import block_variable, cvxpy, positive, solve
from zfusion.methods.l2_linf.lmi import Form
from zfusion.methods.l2_linf.problem import Gains, Problem, normalised
from zfusion.methods.l2_linf.verify import Certificate, certify
from zfusion.model.types import Array

ROUNDS = 100
"""Most rounds of the alternation; it takes two to ten from a design with slack, up to seventy from one without."""

GAIN = 3e-5
"""Relative improvement of γ in a round that counts as none."""

PATIENCE = 2
"""Rounds in succession without any after which it ends: in the reference example within 1e-4 of where it leads."""


class Alternated(NamedTuple):
    """The best filters of the alternation, and what proves their γ."""

    gains: Gains
    certificate: Certificate
    rounds: int


def alternate(problem: Problem, start: Gains, form: Form = Form.GENERAL) -> Alternated:
    """Begin with given filters; γ never rises. DesignError if the start itself has no certificate."""
    scaled, unit = normalised(problem)
    best, proof, done, idle = start, certify(scaled, start), 0, 0
    while done < ROUNDS and idle < PATIENCE:
        candidate = _best_filters(scaled, proof, form)
        found = certify(scaled, candidate)
        improved = 1 - found.gamma / proof.gamma
        if improved > 0:
            best, proof = candidate, found
        idle = idle + 1 if improved <= GAIN else 0
        done += 1
    return Alternated(best, Certificate(unit * proof.gamma, tuple(P / unit**2 for P in proof.P)), done)


def _best_filters(problem: Problem, certificate: Certificate, form: Form) -> Gains:
    """Mode by mode: min β such that [A B]ᵀ P̄ [A B] + Σ A_iᵀ P̄ A_i <= diag(P, β I)."""
    solved = [_best_filter(problem, certificate, form, s) for s in range(len(problem.masks))]
    return Gains(np.array([K for K, _ in solved]), np.array([H for _, H in solved]))


def _best_filter(problem: Problem, certificate: Certificate, form: Form, s: int) -> tuple[Array, Array]:
    cp = cvxpy()
    nx, N, nw, E = problem.nx, problem.size, problem.nw, problem.E
    states, mask = [nx] * problem.n, problem.masks[s]
    K, H = block_variable(mask, states, states), block_variable(mask, states, problem.ny)
    mean = np.tensordot(problem.transition[s], np.array(certificate.P), 1)
    root = np.linalg.cholesky(mean).T
    by_state = E @ problem.A - K @ E - H @ problem.expected_C
    A = root @ cp.bmat([[problem.A, np.zeros((nx, N))], [by_state, K]])
    B = root @ cp.vstack([problem.B, E @ problem.B - H @ problem.stacked_D])
    beta = cp.Variable()
    e_w, zero, one = np.zeros((nw, nx + N)), np.zeros((nx + N, nx + N)), np.eye(nx + N)
    rows: list[list[Any]] = [[certificate.P[s]], [e_w, beta * np.eye(nw)], [A, B, one]]
    for i in problem.doubtful:
        lost = problem.spread(i) * H[:, problem.rows(i)] @ problem.C[i]
        noise = root[:, nx:] @ cp.hstack([lost, np.zeros((N, N))])
        rows.append([noise, e_w.T, *[zero] * (len(rows) - 2), one])
    constraints = [positive([row + [None] * (len(rows) - len(row)) for row in rows])]
    if form is Form.OBSERVER:
        constraints.append(by_state == 0)
    solve(beta, constraints, "no better filters found")
    blocks = np.repeat(mask, states, axis=0)
    return K.value * np.repeat(blocks, states, axis=1), H.value * np.repeat(blocks, problem.ny, axis=1)
