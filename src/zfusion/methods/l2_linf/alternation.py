"""Better filters from any: the Lyapunov function for fixed filters, then the filters for a fixed Lyapunov function."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from zfusion.methods.convex import DesignError, block_variable, cvxpy, positive, solve
from zfusion.methods.l2_linf.lmi import Form
from zfusion.methods.l2_linf.problem import Gains, Problem, closed, normalised
from zfusion.methods.l2_linf.verify import Certificate, certify, proves, unknown_proof
from zfusion.model.types import Array

ROUNDS = 100
"""Most rounds of the alternation; it takes about ten from a design with slack, up to sixty from one without."""

ROOM = 1e-3
"""By how much of itself δ may exceed the least that can be proved where filters are sought.

The P of the least δ are at the edge of what proves anything, and leave the filters next to no room to move: the
alternation creeps, and where to is a matter of rounding.
"""

GAIN = 3e-5
"""Relative improvement of γ a round, on average over the last PATIENCE rounds, below which it ends."""

PATIENCE = 6
"""Single rounds gain more or less, now and then nothing at all, by the precision of the solver."""


class Alternated(NamedTuple):
    """The best filters of the alternation, and what proves their γ."""

    gains: Gains
    certificate: Certificate
    rounds: int


def alternate(problem: Problem, start: Gains, form: Form = Form.GENERAL) -> Alternated:
    """Begin with given filters; γ is the least of all rounds. DesignError if the start itself has no certificate."""
    scaled, unit = normalised(problem)
    rounds = [Alternated(start, certify(scaled, start), 0)]
    with suppress(DesignError):  # a round that the solvers do not master is the last: what was found by then is proved
        while len(rounds) <= ROUNDS and not _settled(rounds):
            filters = _best_filters(scaled, _centred(scaled, rounds[-1]), form)
            rounds.append(Alternated(filters, certify(scaled, filters), len(rounds)))
    best, proof, _ = min(rounds, key=_gamma)
    return Alternated(best, Certificate(unit * proof.gamma, tuple(P / unit**2 for P in proof.P)), len(rounds) - 1)


def _gamma(found: Alternated) -> float:
    return found.certificate.gamma


def _settled(rounds: list[Alternated]) -> bool:
    if len(rounds) <= PATIENCE:
        return False
    return 1 - _gamma(rounds[-1]) / _gamma(rounds[-1 - PATIENCE]) <= PATIENCE * GAIN


def _centred(problem: Problem, found: Alternated) -> tuple[Array, ...]:
    """Of all P that prove (1 + ROOM) δ of the filters, those that prove it with the largest margin."""
    Ps, delta = unknown_proof(problem)
    margin = cvxpy().Variable()
    constraints = proves(problem, closed(problem, found.gains), Ps, delta, margin)
    constraints.append(delta <= (1 + ROOM) * found.certificate.gamma**2)
    solve(-margin, constraints, "no other proof of the filters found")
    return tuple(P.value for P in Ps)


def _best_filters(problem: Problem, Ps: tuple[Array, ...], form: Form) -> Gains:
    """Mode by mode: min β such that [A B]ᵀ P̄ [A B] + Σ A_iᵀ P̄ A_i <= diag(P, β I)."""
    solved = [_best_filter(problem, Ps, form, s) for s in range(len(problem.masks))]
    return Gains(np.array([K for K, _ in solved]), np.array([H for _, H in solved]))


def _best_filter(problem: Problem, Ps: tuple[Array, ...], form: Form, s: int) -> tuple[Array, Array]:
    cp = cvxpy()
    nx, N, nw, E = problem.nx, problem.size, problem.nw, problem.E
    states, mask = [nx] * problem.n, problem.masks[s]
    K, H = block_variable(mask, states, states), block_variable(mask, states, problem.ny)
    mean = np.tensordot(problem.transition[s], np.array(Ps), 1)
    root = np.linalg.cholesky(mean).T
    by_state = E @ problem.A - K @ E - H @ problem.expected_C
    A = root @ cp.bmat([[problem.A, np.zeros((nx, N))], [by_state, K]])
    B = root @ cp.vstack([problem.B, E @ problem.B - H @ problem.stacked_D])
    beta = cp.Variable()
    e_w, zero, one = np.zeros((nw, nx + N)), np.zeros((nx + N, nx + N)), np.eye(nx + N)
    rows: list[list[Any]] = [[Ps[s]], [e_w, beta * np.eye(nw)], [A, B, one]]
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
