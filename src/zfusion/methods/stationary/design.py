"""A design of the method `stationary`: made off-line, checked against its own promise, kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zfusion.methods import design_files
from zfusion.methods.convex import DesignError
from zfusion.methods.family import Forecast
from zfusion.methods.stationary.cost import Cost, Gains, evaluate, rescaled
from zfusion.methods.stationary.limits import (
    centralized_mse,
    information_limit,
    local_predictors,
    neighbourhood_mse,
    own_sensor_mse,
)
from zfusion.methods.stationary.lmi import Choice
from zfusion.methods.stationary.lmi import design as convex_design
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.methods.stationary.refine import refine as refine_gains
from zfusion.model.types import Array, NodeId, sorted_ids

METHOD = "stationary"

LARGEST_CONVEX = 40
"""n nx up to which the convex design takes minutes at most; beyond it descends from the local predictors."""

DOUBT = 0.003
"""Of a descent from the local predictors: it costs less than a per cent where nothing is lost, and bears losses."""

TOLERANCE = 1e-5
"""By how much of itself a cost may exceed its bound: what the solver's own accuracy makes of a tight one."""


PREDICTORS = "errors are those of the one-step predictors, which do not know y(k) yet"

ROBUST = (
    "bounds hold for every system of the polytope; the worst vertex aside, all else is for the scenario's own system"
)


@dataclass(frozen=True, eq=False)
class Design(design_files.Stored):
    """The gains of all nodes, what was promised, and what they really do.

    What no convex design was made for has no bound; what is no descent has no iterations.
    """

    ids: tuple[NodeId, ...]
    """The nodes, sorted: the order of all rows and columns."""
    problem: Problem
    gains: Gains
    J: float
    """The weighted sum of the mean squared errors; for a polytope, the largest of its vertices."""
    mse: Array
    """Of each node, (n,), with the nominal plant."""
    information_limit: Array
    """What no estimator of this structure can beat, (n,), with the nominal plant."""
    neighbourhood_mse: Array
    """Of the Kalman predictors with the neighbourhoods' measurements, (n,)."""
    centralized_mse: float
    """Of the Kalman predictor with all measurements."""
    bound: float | None = None
    """Of J, certified; after a descent on a polytope none."""
    node_bounds: Array | None = None
    """Of each node's mean squared error, (n,), certified by the controllability design; after a descent none."""
    solver: str = ""
    """Which one, and its verdict."""
    solver_seconds: float = 0.0
    """What it said that it took."""
    iterations: int = 0
    """Of the descent."""

    def edge(self, receiver: NodeId, sender: NodeId) -> tuple[Array, Array, Array]:
        """F_ij (nx, nx), G_ij (nx, p_j), H_ij (nx, nx); ValueError for an unknown node."""
        i, j, plant = self.ids.index(receiver), self.ids.index(sender), self.problem.nominal
        end = int(np.cumsum(plant.ny)[j])
        rows, states = slice(i * plant.nx, (i + 1) * plant.nx), slice(j * plant.nx, (j + 1) * plant.nx)
        F, G, H = self.gains
        return F[rows, states], G[rows, end - plant.ny[j] : end], H[rows, states]

    @property
    def forecast(self) -> Forecast:
        """Of the one-step predictors; sums over the nodes are weighted as the design's."""
        nodes = {"mse": self.mse, "bound": self.node_bounds, "information_limit": self.information_limit}
        nodes |= {"neighbourhood": self.neighbourhood_mse, "own_sensor": own_sensor_mse(self.problem.nominal)}
        known = {name: values.tolist() for name, values in nodes.items() if values is not None}
        cost = float(self.problem.weights @ self.mse)
        totals: dict[str, float | str | None] = {"bound": self.bound, "true_cost": cost}
        corners, remarks = len(self.problem.vertices), [PREDICTORS]
        if corners > 1:
            totals |= {"vertices": float(corners), "worst_vertex_cost": self.J}
            remarks.append(ROBUST)
        totals |= {
            f"{name}_sum": float(self.problem.weights @ values)
            for name, values in nodes.items()
            if values is not None and name not in ("mse", "bound")
        }
        totals |= {"centralized_mse": self.centralized_mse, "solver": self.solver or "descent only"}
        totals |= {"solver_seconds": self.solver_seconds, "descent_iterations": float(self.iterations)}
        return Forecast(totals, known, tuple(remarks))

    @property
    def fingerprint(self) -> str:
        """Of the problem that it solves: the system, the graph and the weights."""
        return fingerprint(self.ids, self.problem)

    def packed(self) -> bytes:
        """See `Stored`."""
        arrays: dict[str, Any] = {
            "ids": design_files.stored_ids(self.ids),
            **self.gains._asdict(),
            **_stored(self.problem),
        }
        for name in SCALARS:
            arrays[name] = getattr(self, name)
        for name in OPTIONAL:
            if (value := getattr(self, name)) is not None:
                arrays[name] = value
        return design_files.packed(METHOD, self.fingerprint, arrays)

    @classmethod
    def unpack(cls, content: design_files.Content, made_for: str | None = None) -> Self:
        """See `Stored`."""
        arrays: dict[str, Any] = design_files.unpack(content, METHOD, made_for)
        gains = Gains(arrays["F"], arrays["G"], arrays["H"])
        told = {name: arrays[name].tolist() if arrays[name].ndim == 0 else arrays[name] for name in SCALARS}
        told |= {
            name: arrays[name].tolist() if arrays[name].ndim == 0 else arrays[name]
            for name in OPTIONAL
            if name in arrays
        }
        return cls(tuple(arrays["ids"].tolist()), _restored(arrays), gains, **told)


SCALARS = (
    "J",
    "mse",
    "information_limit",
    "neighbourhood_mse",
    "centralized_mse",
    "solver",
    "solver_seconds",
    "iterations",
)
OPTIONAL = ("bound", "node_bounds")


def make_design(
    ids: tuple[NodeId, ...],
    problem: Problem,
    choice: Choice | None = None,
    *,
    convex: bool | None = None,
    refine: bool | None = None,
    doubt: float | None = None,
) -> Design:
    """Design the network: by linear matrix inequalities, by descent on the true cost, or by one after the other.

    `convex` is by default whether n nx <= LARGEST_CONVEX; without it the descent begins at the local predictors.
    `refine` is by default what `convex` is not. A descent reaches the information limit or nearly so; on a polytope it
    has no certificate. `doubt` is how far it takes messages for unreliable (module `doubt`), by default DOUBT without a
    convex design and nothing after one, where the cost is then the lowest, but not under losses (`losses.under_loss`).

    DesignError where it is infeasible or breaks its promise; InputError without the packages it needs.
    """
    if list(ids) != sorted_ids(ids) or len(ids) != problem.nominal.n:
        raise ValueError(f"expected {problem.nominal.n} ids in sorted order: {ids}")
    choice = Choice() if choice is None else choice
    convex = problem.size <= LARGEST_CONVEX if convex is None else convex
    refine = not convex if refine is None else refine
    promised: dict[str, Any] = {}
    if convex:
        designed = convex_design(problem, choice)
        gains, worst = designed.gains, _worst(problem, designed.gains)
        _check_promise(worst.J, designed.bound)
        if not choice.observer:
            gains = rescaled(problem, gains, evaluate(problem, gains).P)
        promised = {
            "bound": designed.bound,
            "node_bounds": designed.node_bounds,
            "solver_seconds": designed.solved.seconds,
        }
        promised["solver"] = f"{designed.solved.solver}: {designed.solved.status}"
    else:
        gains = _as_observers(local_predictors(problem)) if choice.observer else local_predictors(problem)
        worst = _worst(problem, gains)
    if refine:
        certain = convex or choice.observer or len(problem.vertices) > 1
        doubt = (0.0 if certain else DOUBT) if doubt is None else doubt
        refined = refine_gains(problem, gains, doubt, observer=choice.observer)
        candidate = _worst(problem, refined.gains)
        if candidate.J < worst.J:
            gains = refined.gains
            if not choice.observer:
                gains = rescaled(problem, gains, evaluate(problem, gains).P)
            promised |= {"iterations": refined.iterations, "node_bounds": None}
            if len(problem.vertices) > 1:
                promised["bound"] = None
    return _told(ids, problem, gains, promised)


def fingerprint(ids: tuple[NodeId, ...], problem: Problem) -> str:
    """Of a problem: what a design file must have been made for."""
    parts: list[tuple[str, object]] = [("ids", str(ids)), ("weights", problem.weights)]
    parts += [(name, getattr(problem, name)) for name in ("F", "G", "H")]
    for plant in _plants(problem).values():
        parts += [("A", plant.A), ("C", plant.stacked_C), ("Q", plant.Q), ("R", plant.R)]
    return design_files.fingerprint(parts)


def _told(ids: tuple[NodeId, ...], problem: Problem, gains: Gains, promised: dict[str, Any]) -> Design:
    plant = problem.nominal
    return Design(
        ids,
        problem,
        gains,
        J=_worst(problem, gains).J,
        mse=evaluate(problem, gains).mse,
        information_limit=information_limit(problem),
        neighbourhood_mse=neighbourhood_mse(plant, problem.G),
        centralized_mse=centralized_mse(plant),
        **promised,
    )


def _worst(problem: Problem, gains: Gains) -> Cost:
    """The true cost at the vertex where it is largest; DesignError where the estimators are not stable."""
    return max((evaluate(problem, gains, plant) for plant in problem.vertices), key=lambda cost: cost.J)


def _as_observers(predictors: Gains) -> Gains:
    """Kalman predictors, whose ξ is x̂, in the coordinates of the observer type: ξ = -x̂."""
    return Gains(predictors.F, -predictors.G, -predictors.H)


def _check_promise(J: float, bound: float) -> None:
    if not np.isfinite(J) or bound * (1 + TOLERANCE) < J:
        raise DesignError(f"numerical trouble: the design promised a cost of at most {bound:.6g}, and it costs {J:.6g}")


def _stored(problem: Problem) -> dict[str, Any]:
    """The problem as arrays: the plants' covariances Q = B W B' and R = D V D' say all that matters of the noises."""
    arrays: dict[str, Any] = {"vertices": len(problem.vertices), "ny": problem.nominal.ny, "weights": problem.weights}
    arrays |= {f"graph_{name}": getattr(problem, name) for name in ("F", "G", "H")}
    for name, plant in _plants(problem).items():
        arrays |= {
            f"{name}_A": plant.A,
            f"{name}_C": plant.stacked_C,
            f"{name}_Q": plant.Q,
            f"{name}_R": plant.R,
        }
    return arrays


def _plants(problem: Problem) -> dict[str, Plant]:
    """The vertices, and the center where there is one, by the names that they have in files."""
    plants = {f"plant{v}": plant for v, plant in enumerate(problem.vertices)}
    return plants if problem.center is None else plants | {"center": problem.center}


def _restored(arrays: dict[str, Any]) -> Problem:
    ends = np.cumsum(arrays["ny"]).tolist()
    rows = [slice(end - size, end) for end, size in zip(ends, arrays["ny"].tolist(), strict=True)]

    def plant(name: str) -> Plant:
        A, C, Q, R = (arrays[f"{name}_{matrix}"] for matrix in "ACQR")
        D = tuple(np.eye(at.stop - at.start) for at in rows)
        return Plant(A, np.eye(len(A)), tuple(C[at] for at in rows), D, Q, tuple(R[at, at] for at in rows))

    plants = tuple(plant(f"plant{v}") for v in range(int(arrays["vertices"])))
    F, G, H = (arrays[f"graph_{name}"] for name in "FGH")
    return Problem(plants, F, G, H, arrays["weights"], plant("center") if "center_A" in arrays else None)
