"""Covariance intersection of the neighbours' local estimates: safe whatever is correlated with what.

    local:  Kalman filter with the own measurements: x^j, P^j
    fused:  P^-1 = Σ_j ω_j (P^j)^-1,    P^-1 x̂ = Σ_j ω_j (P^j)^-1 x^j,      ω_j >= 0, Σ ω_j = 1, trace P least

P is an upper bound of the error covariance if each P^j is one. The fused estimate is not fed back.

Source: Julier, Uhlmann, "A non-divergent estimation algorithm in the presence of unknown correlations", Proc. American
Control Conference (1997) 2369-2373; of more than two estimates: Niehsen, "Information fusion based on fast covariance
intersection filtering", 5th Int. Conf. Information Fusion (2002) 901-904.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.family import Family
from zfusion.methods.packing import IMPOSSIBLE, is_definite, too_large
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, check_white, inverse, kalman_update
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

ITERATIONS = 200
"""Of the search for the weights; it stops long before in ordinary cases, and all weights give a bound."""

BISECTED = 1e-9
"""Part of a step's largest length to which it is found."""

GAP = 1e-6
"""Part of the trace that better weights could save at most, at which the search ends."""

LOCAL = Stage(
    MEASUREMENT.name,
    (
        *MEASUREMENT.fields,
        Field("x", Kind.VECTOR, ("nx",), "the estimate from the own measurements"),
        Field("P", Kind.MATRIX, ("nx", "nx"), "its error covariance"),
    ),
    "what a sensor measured, and what its node knows by itself",
)


def intersection(covariances: Array) -> tuple[Array, Array]:
    """The weights ω, (n,), that make the trace of P = (Σ ω_j P_j^-1)^-1 least, and P; for (n, nx, nx).

    The trace is convex in ω, with the gradient -g_j = -tr(P P_j^-1 P) and Σ ω_j g_j = tr P. So no weights whatever
    give less than 2 tr P - max g_j, which says when to stop. A step takes weight from the j with the least g_j and
    gives it to that with the largest, as much as is best; the first estimate is the best of the given ones.
    """
    information = np.array([inverse(covariance) for covariance in covariances])
    weights = np.zeros(len(covariances))
    weights[np.argmin(np.trace(covariances, axis1=1, axis2=2))] = 1.0
    for _ in range(ITERATIONS):
        P = inverse(np.tensordot(weights, information, 1))
        pull = np.tensordot(information, P @ P, 2)
        to = int(np.argmax(pull))
        if pull[to] <= (1.0 + GAP) * P.trace():
            break
        here = np.flatnonzero(weights)
        away = int(here[np.argmin(pull[here])])
        moved = _best_step(P, information[to] - information[away], float(weights[away]))
        weights[to] += moved
        weights[away] = 0.0 if moved == weights[away] else weights[away] - moved
    return weights, inverse(np.tensordot(weights, information, 1))


def _best_step(P: Array, change: Array, limit: float) -> float:
    """The t in [0, limit] for which the trace of (P^-1 + t change)^-1 is least.

    For P = L Lᵀ and Lᵀ change L = V Λ Vᵀ it is Σ_k c_k / (1 + t Λ_k), where c_k = |L V_k|².
    """
    L = np.linalg.cholesky(P)
    values, vectors = np.linalg.eigh(L.T @ change @ L)
    sizes = ((L @ vectors) ** 2).sum(axis=0)

    def falls(t: float) -> bool:
        return float((sizes * values / (1.0 + t * values) ** 2).sum()) > 0

    if falls(limit * (1.0 - BISECTED)):
        return limit
    low, high = 0.0, limit
    while high - low > BISECTED * limit:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if falls(middle) else (low, middle)
    return low


class Intersection:
    """One node of the covariance intersection of local estimates."""

    name: ClassVar[str] = "covariance_intersection"
    stages: ClassVar[tuple[Stage, ...]] = (LOCAL,)

    def __init__(self, setting: Setting) -> None:
        self._node, self._neighbourhood = setting.node, setting.network.neighbours(setting.node)
        self._model = White(setting.system, (setting.node,))
        self._x, self._P = self._model.before(setting.born)
        self._fused = np.zeros(0)
        self._kept = (self._fused, self._fused)

    def refuses(self, stage: int, fields: Fields) -> str | None:  # noqa: ARG002
        """What is no estimate with a positive definite covariance."""
        wrong = too_large(fields, "y", "x", "P") or not is_definite(cast(Array, fields["P"]))
        return IMPOSSIBLE if wrong else None

    def begin(self, step: int, y: Array | None) -> Fields:
        """The local Kalman filter."""
        self.skip(step)
        if y is not None:
            self._x, self._P = kalman_update(self._x, self._P, y, *self._model.observation(step, self._node))
        return {"y": y, "x": self._x, "P": self._P}

    def skip(self, step: int) -> None:
        """Predict only."""
        self._x, self._P = self._model.predict(step, self._x, self._P)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Fuse what arrived; the own estimate alone, where its covariance is singular to working precision."""
        here = tuple(j for j in self._neighbourhood if j in arrived)
        if len(here) == 1:
            return Outcome(self._x, self._P, here)
        if not is_definite(self._P):
            others = tuple(j for j in here if j != self._node)
            return Outcome(self._x, self._P, (self._node,), others, incidents=("not_fused",))
        covariances = np.array([cast(Array, arrived[j]["P"]) for j in here])
        weights, P = self._fusion(covariances)
        told = [
            weight * (inverse(covariance) @ cast(Array, arrived[j]["x"]))
            for weight, covariance, j in zip(weights, covariances, here, strict=True)
        ]
        return Outcome(P @ np.sum(told, axis=0), P, here)

    def _fusion(self, covariances: Array) -> tuple[Array, Array]:
        """`intersection`, computed once while the covariances stay the same, as they do once they have settled."""
        if not np.array_equal(covariances, self._fused):
            self._fused, self._kept = covariances, intersection(covariances)
        return self._kept


def _check(_: object, system: System, __: Network) -> None:
    check_white(system, invertible=True)


INTERSECTION = Family(Intersection.name, Intersection, stages=lambda _: Intersection.stages, check=_check)
