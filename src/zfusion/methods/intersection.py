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
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, kalman_update
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

ITERATIONS = 200
"""Of the search for the weights; it stops long before in ordinary cases."""

CONVERGED = 1e-12
"""Relative change of the trace that counts as none."""

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

    The trace is convex in ω: multiplicative steps along its gradient g_j = -tr(P P_j^-1 P), ω_j <- ω_j sqrt(-g_j)
    scaled to sum one, go down at every step and end where all g_j with ω_j > 0 are the same.
    """
    information = np.linalg.inv(covariances)
    weights = 1.0 / np.trace(covariances, axis1=1, axis2=2)
    weights /= weights.sum()
    P = np.linalg.inv(np.tensordot(weights, information, 1))
    for _ in range(ITERATIONS):
        pull = np.einsum("ab,jbc,ca->j", P, information, P)
        following = weights * np.sqrt(pull)
        following /= following.sum()
        better = np.linalg.inv(np.tensordot(following, information, 1))
        done = P.trace() - better.trace() <= CONVERGED * P.trace()
        weights, P = following, better
        if done:
            break
    return weights, 0.5 * (P + P.T)


class Intersection:
    """One node of the covariance intersection of local estimates."""

    name: ClassVar[str] = "covariance_intersection"
    stages: ClassVar[tuple[Stage, ...]] = (LOCAL,)

    def __init__(self, setting: Setting) -> None:
        self._node, self._neighbourhood = setting.node, setting.network.neighbours(setting.node)
        self._model = White(setting.system, (setting.node,))
        self._x, self._P = self._model.before(setting.born)

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
        """Fuse what arrived."""
        here = tuple(j for j in self._neighbourhood if j in arrived)
        covariances = np.array([cast(Array, arrived[j]["P"]) for j in here])
        if len(here) == 1:
            return Outcome(self._x, self._P, here)
        weights, P = intersection(covariances)
        told = [
            weight * np.linalg.solve(covariance, cast(Array, arrived[j]["x"]))
            for weight, covariance, j in zip(weights, covariances, here, strict=True)
        ]
        return Outcome(P @ np.sum(told, axis=0), P, here)


INTERSECTION = Family(Intersection.name, Intersection, stages=lambda _: Intersection.stages)
