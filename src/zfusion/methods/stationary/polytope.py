"""A plant that is not known exactly: one of a polytope of plants, given by its vertices, constant in time.

A vertex says what of the system is otherwise there: F, the H of some sensors, the covariance Q, the R of some sensors.
All else is the system's own. Between the vertices F, H and the symmetric roots of Q and R mix linearly (standard
deviations, not variances): the matrix inequalities are linear in these, so one design is certified for all mixtures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zfusion.methods.convex import DesignError, cvxpy, solve
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.model.checks import ModelError, covariance_matrix, finite_array
from zfusion.model.types import Array, NodeId

KEYS = ("F", "Q", "H", "R")

OUTSIDE = 1e-6
"""How far the system may be from the polytope, relative to the largest entry: what is left of a solver's accuracy."""


@dataclass(frozen=True, eq=False)
class Vertex:
    """What of a system is otherwise at a vertex; None, or no entry: nothing."""

    F: Array | None = None
    Q: Array | None = None
    H: Mapping[str, Array] = field(default_factory=dict)
    """By sensor id, as text."""
    R: Mapping[str, Array] = field(default_factory=dict)


def vertices_of(given: object) -> tuple[Vertex, ...]:
    """The vertices that a scenario lists; ModelError for what is none."""
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) < 2:
        raise ModelError("vertices", given, "expected a list of two or more tables, each with some of F, Q, H, R")
    return tuple(_vertex(f"vertices[{v}]", table) for v, table in enumerate(given))


def plants_of(nominal: Plant, ids: Sequence[NodeId], vertices: Sequence[Vertex], where: str) -> tuple[Plant, ...]:
    """The plants at the vertices; ModelError, with fields below `where`, for what does not fit the nominal one."""
    known = [str(i) for i in ids]
    plants = []
    for v, vertex in enumerate(vertices):
        place = f"{where}[{v}]"
        for name, given in (("H", vertex.H), ("R", vertex.R)):
            for i in given:
                if i not in known:
                    raise ModelError(f"{place}.{name}", i, f"expected ids of sensors: {', '.join(known)}")
        F = nominal.A if vertex.F is None else finite_array(f"{place}.F", vertex.F, nominal.A.shape)
        Q = nominal.Q if vertex.Q is None else covariance_matrix(f"{place}.Q", vertex.Q, nominal.nx)
        H = [_of_sensor(f"{place}.H.{i}", vertex.H.get(i), C) for i, C in zip(known, nominal.C, strict=True)]
        R = [_noise(f"{place}.R.{i}", vertex.R.get(i), n, nominal) for n, i in enumerate(known)]
        ones = tuple(np.eye(len(r)) for r in R)
        plants.append(Plant(F, symmetric_root(Q), tuple(H), tuple(map(symmetric_root, R)), np.eye(len(Q)), ones))
    return tuple(plants)


def check_inside(problem: Problem) -> None:
    """DesignError unless the nominal plant is a mixture of the vertices; InputError without cvxpy."""
    cp = cvxpy()
    corners = np.array([_entries(plant) for plant in problem.vertices])
    wanted = _entries(problem.nominal)
    scale = max(np.abs(corners).max(), np.abs(wanted).max())
    shares, distance = cp.Variable(len(corners), nonneg=True), cp.Variable()
    off = (corners.T @ shares - wanted) / scale
    solve(distance, [cp.sum(shares) == 1, off <= distance, -off <= distance], "the polytope cannot be analysed")
    if distance.value > OUTSIDE:
        raise DesignError(
            "the scenario's own system is not in the polytope of method.options.vertices: entries of F, H or the roots "
            f"of Q and R are off by {float(distance.value * scale):.3g} or more from every mixture"
        )


def symmetric_root(matrix: Array) -> Array:
    """S = Sᵀ, positive semi-definite, with S S = matrix, (n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return root


def _entries(plant: Plant) -> Array:
    """What mixes linearly, in a row."""
    return np.concatenate([m.ravel() for m in (plant.A, plant.stacked_C, *map(symmetric_root, (plant.Q, plant.R)))])


def _vertex(place: str, table: object) -> Vertex:
    if not isinstance(table, Mapping) or not table or not set(table) <= set(KEYS):
        raise ModelError(place, table, f"expected a table with some of {', '.join(KEYS)}")
    return Vertex(
        F=_matrix(f"{place}.F", table["F"]) if "F" in table else None,
        Q=_matrix(f"{place}.Q", table["Q"]) if "Q" in table else None,
        H=_by_sensor(f"{place}.H", table.get("H", {})),
        R=_by_sensor(f"{place}.R", table.get("R", {})),
    )


def _by_sensor(place: str, table: object) -> dict[str, Array]:
    if not isinstance(table, Mapping):
        raise ModelError(place, table, "expected a table: matrices by sensor id")
    return {str(i): _matrix(f"{place}.{i}", value) for i, value in table.items()}


def _matrix(place: str, value: object) -> Array:
    """As elsewhere in a scenario: rows, a number for a 1 x 1 matrix, or {diagonal = numbers}."""
    if isinstance(value, Mapping):
        if set(value) != {"diagonal"}:
            raise ModelError(place, value, "expected rows of numbers, a number, or {diagonal = numbers}")
        return np.diag(finite_array(place, value["diagonal"], (None,)))
    rows: Any = value if isinstance(value, list | tuple) else [[value]]
    if _has_other(rows):
        raise ModelError(place, value, "expected rows of numbers, a number, or {diagonal = numbers}")
    return finite_array(place, rows, (None, None))


def _has_other(rows: object) -> bool:
    """Whether there is anything but numbers in it: numpy takes true and "1" for such."""
    if isinstance(rows, list | tuple):
        return any(_has_other(row) for row in rows)
    return isinstance(rows, bool) or not isinstance(rows, int | float)


def _of_sensor(place: str, given: Array | None, own: Array) -> Array:
    return own if given is None else finite_array(place, given, own.shape)


def _noise(place: str, given: Array | None, n: int, nominal: Plant) -> Array:
    if given is None:
        D, V = nominal.D[n], nominal.V[n]
        return D @ V @ D.T
    return covariance_matrix(place, given, nominal.ny[n])
