"""The Kalman consensus filter: a Kalman filter on the neighbourhood's measurements that also leans to its neighbours.

    M_i  = (P_i^-1 + Σ_{j in N_i} H_jᵀ R_j^-1 H_j)^-1
    x̂_i = x̄_i + M_i Σ_{j in N_i} H_jᵀ R_j^-1 (y_j - H_j x̄_i) + γ P_i Σ_{j in N_i} (x̄_j - x̄_i),   γ = ε / (1 + |P_i|)
    x̄_i <- F x̂_i,   P_i <- F M_i Fᵀ + Q            |.| Frobenius' norm

M_i is what the filter reports: the covariance of a filter without the last term, not of the error of this one.

Source: Olfati-Saber, "Kalman-consensus filter: optimality, stability, and performance", Proc. 48th IEEE CDC (2009)
7036-7042, Algorithm 1; the filter itself is from his "Distributed Kalman filtering for sensor networks", 46th CDC
(2007) 5492-5498.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.family import Family
from zfusion.methods.packing import IMPOSSIBLE, too_large
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, absorb, check_white
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

EXPECTATION = Stage(
    MEASUREMENT.name,
    (*MEASUREMENT.fields, Field("x", Kind.VECTOR, ("nx",), "the state as it was predicted before this reading")),
    "what a sensor measured, and what it had expected the state to be",
)


@dataclass(frozen=True)
class KalmanConsensusOptions:
    """What a scenario may say of the method."""

    epsilon: float = 0.05
    """ε >= 0: how much it leans to its neighbours; small beside the step, as the source has it."""

    def __post_init__(self) -> None:
        number = isinstance(self.epsilon, int | float) and not isinstance(self.epsilon, bool)
        if not number or not 0.0 <= self.epsilon < inf:
            raise ModelError("epsilon", self.epsilon, "expected a number >= 0")


class KalmanConsensus:
    """One node of the Kalman consensus filter: everything in one exchange."""

    name: ClassVar[str] = "kalman_consensus"
    stages: ClassVar[tuple[Stage, ...]] = (EXPECTATION,)

    def __init__(self, setting: Setting) -> None:
        self._neighbourhood = setting.network.neighbours(setting.node)
        self._model = White(setting.system, self._neighbourhood)
        self._x, self._P = self._model.before(setting.born)
        self._epsilon = cast(KalmanConsensusOptions, setting.options).epsilon

    def refuses(self, stage: int, fields: Fields) -> str | None:  # noqa: ARG002
        """Numbers that are too large to be computed with."""
        return IMPOSSIBLE if too_large(fields, "y", "x") else None

    def begin(self, step: int, y: Array | None) -> Fields:
        """The measurement and the prediction."""
        self.skip(step)
        return {"y": y, "x": self._x}

    def skip(self, step: int) -> None:
        """Predict only."""
        self._x, self._P = self._model.predict(step, self._x, self._P)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Update with all measurements that arrived, and lean to the predictions that did."""
        information = self._model.information(step)
        here = tuple(j for j in self._neighbourhood if j in arrived)
        x, P = self._x, self._P
        told, weight, pull = np.zeros_like(x), np.zeros_like(P), np.zeros_like(x)
        for j in here:
            y = cast("Array | None", arrived[j]["y"])
            if y is not None:
                told, weight = told + information[j].gain @ y, weight + information[j].weight
            pull = pull + (cast(Array, arrived[j]["x"]) - x)
        leaning = self._epsilon / (1.0 + float(np.linalg.norm(P))) * (P @ pull)
        updated = absorb(x, P, told, weight)
        assert updated is not None  # a sum of the model's own Hᵀ R^-1 H is no negative information
        self._x, self._P = updated[0] + leaning, updated[1]
        return Outcome(self._x, self._P, here)


def _check(_: object, system: System, __: Network) -> None:
    check_white(system)


KALMAN_CONSENSUS = Family(
    KalmanConsensus.name,
    KalmanConsensus,
    stages=lambda _: KalmanConsensus.stages,
    options=KalmanConsensusOptions,
    check=_check,
)
