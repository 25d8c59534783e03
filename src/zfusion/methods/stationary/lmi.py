"""The two convex designs of a network of estimators, for one plant or for a polytope of plants.

With a slack matrix X = [X11 X12; Λ E, Λ], Λ block diagonal, and F̂ = Λᵀ F, Ĝ = Λᵀ G, the products XᵀA_e and XᵀB_e are
linear in the unknowns. Minimise tr Z subject to, for every vertex with its own Q and Z,

    observability     [Q XA'; XA X+X'-Q] with C_e bordering Q > 0,   [Z XB'; XB X+X'-Q] > 0
    controllability   [Q XA XB; · X+X'-Q 0; · 0 I] > 0,              [Z C_e; C_e' X+X'-Q] > 0

X + X' - Q <= X' Q⁻¹ X makes Q, or X⁻ᵀQX⁻¹, a bound of the Gramian, and tr Z one of the cost, for the whole polytope.
The only thing given away is that Λ is block diagonal, which keeps the graph's zeros in F = Λ⁻ᵀ F̂ and G = Λ⁻ᵀ Ĝ.

Source: in the spirit of de Souza, Coutinho, Kinnaert, Automatica 72 (2016) 108-114, derived anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from zfusion.errors import InputError
from zfusion.methods.convex import Solved, block_variable, cvxpy, positive, solve
from zfusion.methods.stationary.cost import Gains, masked, row_weights
from zfusion.methods.stationary.limits import neighbourhood_mse
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.model.types import Array

FAILURE = "LMI problem infeasible"


class Gramian(Enum):
    """Which of the two designs."""

    OBSERVABILITY = "observability"
    """Never worse than the Kalman predictors of the neighbourhoods."""
    CONTROLLABILITY = "controllability"
    """Gives a bound for each node, and can minimise the largest."""


@dataclass(frozen=True)
class Choice:
    """What is asked of the convex design. InputError for what does not go together."""

    gramian: Gramian = Gramian.OBSERVABILITY
    plain: bool = False
    """One quadratic Lyapunov function and no slack: the textbook design, worse; for comparison."""
    worst_node: bool = False
    """Minimise the largest weighted mean squared error of a node, not their sum (controllability only)."""
    observer: bool = False
    """ξ_i estimates x itself, unbiased whatever x does: the consensus type (observability, one plant only)."""

    def __post_init__(self) -> None:
        if self.worst_node and self.gramian is not Gramian.CONTROLLABILITY:
            raise InputError("stationary: the worst node can be minimised by the controllability design only")
        if self.observer and self.gramian is not Gramian.OBSERVABILITY:
            raise InputError("stationary: the observer type is designed by the observability design only")


class Designed(NamedTuple):
    """What the convex design says."""

    gains: Gains
    bound: float
    """Of the weighted sum, for every plant of the polytope."""
    node_bounds: Array | None
    """Of each node's mean squared error, (n,); controllability only."""
    solved: Solved


class _Unknowns(NamedTuple):
    """What all vertices share."""

    X11: Any
    X12: Any
    Lam: Any
    F: Any
    """Λᵀ F."""
    G: Any
    """Λᵀ G."""
    H: Any


def design(problem: Problem, choice: Choice) -> Designed:
    """Solve the linear matrix inequalities; DesignError where they are infeasible, InputError without cvxpy."""
    if choice.observer and len(problem.vertices) > 1:
        raise InputError("stationary: the observer type is designed for one plant, not for a polytope")
    cp = cvxpy()
    problem, unit = _normalised(problem)
    unknowns = _unknowns(problem, choice)
    mu = cp.Variable()
    constraints, Zs = [], []
    for plant in problem.vertices:
        made, Z = _vertex(problem, plant, unknowns, choice)
        constraints += made
        Zs.append(Z)
        traces = _node_traces(problem, Z) if choice.worst_node else [cp.trace(Z)]
        constraints += [trace <= mu for trace in traces]
    if choice.observer:
        plant = problem.nominal
        constraints.append(
            unknowns.F @ problem.E - unknowns.G @ plant.stacked_C == unknowns.Lam.T @ problem.E @ plant.A
        )
    solved = solve(mu, constraints, FAILURE)
    node_bounds = None
    if choice.gramian is Gramian.CONTROLLABILITY:
        nodes = [[float(trace.value) for trace in _node_traces(problem, Z)] for Z in Zs]
        node_bounds = unit * np.max(nodes, axis=0) / problem.weights
    bound = unit * max(float(np.trace(Z.value)) for Z in Zs)
    return Designed(_recovered(problem, unknowns), bound, node_bounds, solved)


def _normalised(problem: Problem) -> tuple[Problem, float]:
    """The same in the unit of mean square in which the neighbourhoods' predictors have about 1 on average.

    The estimators are the same, costs are to be multiplied with the unit: solvers need numbers of about that size.
    """
    local = neighbourhood_mse(problem.nominal, problem.G) * problem.weights
    unit = float(local.mean())
    if not unit > 0:
        return problem, 1.0

    def scaled(plant: Plant) -> Plant:
        return replace(plant, W=plant.W / unit, V=tuple(v / unit for v in plant.V))

    center = None if problem.center is None else scaled(problem.center)
    return replace(problem, vertices=tuple(map(scaled, problem.vertices)), center=center), unit


def _unknowns(problem: Problem, choice: Choice) -> _Unknowns:
    cp = cvxpy()
    n, nx, ny = problem.nominal.n, problem.nominal.nx, problem.nominal.ny
    states = [nx] * n
    if choice.plain:
        X11 = cp.Variable((nx, nx), symmetric=True)
        blocks = [cp.Variable((nx, nx), symmetric=True) for _ in range(n)]
        zero = np.zeros((nx, nx))
        Lam = cp.bmat([[blocks[i] if i == j else zero for j in range(n)] for i in range(n)])
        X12 = problem.E.T @ Lam
    else:
        X11, X12 = cp.Variable((nx, nx)), cp.Variable((nx, problem.size))
        Lam = block_variable(np.eye(n, dtype=bool), states, states)
    H = -np.eye(problem.size) if choice.observer else block_variable(problem.H, states, states)
    return _Unknowns(X11, X12, Lam, block_variable(problem.F, states, states), block_variable(problem.G, states, ny), H)


def _vertex(problem: Problem, plant: Plant, unknowns: _Unknowns, choice: Choice) -> tuple[list[Any], Any]:
    """The two inequalities of one plant, and its Z."""
    cp = cvxpy()
    X11, X12, Lam, F, G, H = unknowns
    E, C = problem.E, plant.stacked_C
    X = cp.bmat([[X11, X12], [Lam @ E, Lam]])
    measured, noise, pushed = G @ C, G @ plant.sensor_root, plant.process_root
    XA = cp.bmat([[X11.T @ plant.A + E.T @ measured, E.T @ F], [X12.T @ plant.A + measured, F]])
    XB = cp.bmat([[X11.T @ pushed, E.T @ noise], [X12.T @ pushed, noise]])
    weights = np.diag(row_weights(problem))
    C_e = cp.hstack([weights @ E, -weights @ H])
    extended, noises = plant.nx + problem.size, XB.shape[1]
    Q = X if choice.plain else cp.Variable((extended, extended), symmetric=True)
    S = X + X.T - Q
    if choice.gramian is Gramian.OBSERVABILITY:
        Z = cp.Variable((noises, noises), symmetric=True)
        zero = np.zeros((problem.size, extended))
        first = positive([[Q, None, None], [XA, S, None], [C_e, zero, np.eye(problem.size)]])
        return [first, positive([[Z, None], [XB, S]])], Z
    Z = cp.Variable((problem.size, problem.size), symmetric=True)
    zero = np.zeros((noises, extended))
    first = positive([[Q, None, None], [XA.T, S, None], [XB.T, zero, np.eye(noises)]])
    return [first, positive([[Z, None], [C_e.T, S]])], Z


def _node_traces(problem: Problem, Z: Any) -> list[Any]:
    """tr Z_ii of each node."""
    cp, nx = cvxpy(), problem.nominal.nx
    return [cp.trace(Z[i * nx : (i + 1) * nx, i * nx : (i + 1) * nx]) for i in range(problem.nominal.n)]


def _recovered(problem: Problem, unknowns: _Unknowns) -> Gains:
    """F = Λ⁻ᵀ F̂ and G = Λ⁻ᵀ Ĝ block row by block row, with exact zeros."""
    nx, n = problem.nominal.nx, problem.nominal.n
    Lam, F, G = unknowns.Lam.value, unknowns.F.value, unknowns.G.value
    H = unknowns.H if isinstance(unknowns.H, np.ndarray) else unknowns.H.value
    rows = [slice(i * nx, (i + 1) * nx) for i in range(n)]
    solved = [np.linalg.solve(Lam[at, at].T, np.hstack((F[at], G[at]))) for at in rows]
    whole = np.vstack(solved)
    return masked(problem, Gains(whole[:, : problem.size], whole[:, problem.size :], H))
