"""Hybrid consensus on measurements and information: the nodes average what they believe and what they have measured.

    δΩ_i, δq_i = H_iᵀ R_i^-1 H_i, H_iᵀ R_i^-1 y_i;     Ω_i, q_i = P_i^-1, P_i^-1 x̄_i                    (prior)
    L times, with each of the four:   z_i <- Σ_{j in N_i} π_ij z_j,           π_ij >= 0, Σ_j π_ij = 1
    P_i^-1 = Ω_i + N δΩ_i,    P_i^-1 x̂_i = q_i + N δq_i                                                (posterior)

The priors are averaged, which never trusts twice what two nodes have in common, the measurements are averaged apart
and count in full. Of a common process noise the average of priors knows nothing, so that P_i is on the safe side for
many L, where N δΩ_i is the sum of all; for few, a node may count its own measurement N times: then it is not.

Source: Battistelli, Chisci, Mugnai, Farina, Graziano, "Consensus-based linear and nonlinear filtering", IEEE Trans.
Automatic Control 60 (2015) 1410-1415, Algorithm HCMCI; Battistelli, Chisci, "Kullback-Leibler average, consensus on
probability densities, and distributed state estimation with guaranteed stability", Automatica 50 (2014) 707-718.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.family import Family
from zfusion.methods.packing import IMPOSSIBLE, is_definite, is_semidefinite, packed, too_large, unpacked
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, check_white, inverse
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger, UsedSet

MOST_ROUNDS = 64
"""Exchanges a step; each is a round trip of the whole swarm."""

PRIOR = (
    Field("q", Kind.VECTOR, ("nx",), "information vector of the prior"),
    Field("omega", Kind.VECTOR, ("nxx",), "information matrix of the prior, its lower triangle row by row"),
)
NEWS = (
    Field("dq", Kind.VECTOR, ("nx",), "information vector of the measurements"),
    Field("domega", Kind.VECTOR, ("nxx",), "information matrix of the measurements, likewise"),
)


@dataclass(frozen=True)
class HybridOptions:
    """What a scenario may say of the method."""

    rounds: int = 1
    """L, exchanges with the neighbours at every step."""

    def __post_init__(self) -> None:
        if isinstance(self.rounds, bool) or not isinstance(self.rounds, int) or not 1 <= self.rounds <= MOST_ROUNDS:
            raise ModelError("rounds", self.rounds, f"expected a whole number from 1 to {MOST_ROUNDS}")


def stages(options: HybridOptions) -> tuple[Stage, ...]:
    """One for each exchange; in the first the measurement itself, from which the neighbours see its information."""
    later = (*PRIOR, *NEWS, Field("used", Kind.IDS, (), "whose values of the exchange before went in"))
    first = Stage(MEASUREMENT.name, (*MEASUREMENT.fields, *PRIOR), "what a sensor measured and a node believes")
    return (first, *(Stage(f"mix{n}", later, f"exchange {n} of a step") for n in range(2, options.rounds + 1)))


def metropolis(network: Network, node: NodeId) -> dict[NodeId, float]:
    """π_ij = 1 / (1 + max(d_i, d_j)) for the neighbours j of i, and the rest for i itself; d without the node itself.

    On an undirected graph they are doubly stochastic, and repeated averaging tends to the mean.
    """
    degree = {j: len(network.neighbours(j)) - 1 for j in network.neighbours(node)}
    weights = {j: 1.0 / (1 + max(degree[node], degree[j])) for j in degree if j != node}
    return weights | {node: 1.0 - sum(weights.values())}


class Hybrid:
    """One node of hybrid consensus, with Metropolis weights; whose message is not there, for him it counts itself."""

    name: ClassVar[str] = "hybrid_consensus"

    def __init__(self, setting: Setting) -> None:
        options = cast(HybridOptions, setting.options)
        self.stages = stages(options)
        self._node, self._rounds = setting.node, options.rounds
        self._neighbourhood = setting.network.neighbours(setting.node)
        self._weights = metropolis(setting.network, setting.node)
        self._count = len(setting.network.ids)
        self._model = White(setting.system, self._neighbourhood)
        self._x, self._P = self._model.before(setting.born)
        self._incidents: list[str] = []

    def refuses(self, stage: int, fields: Fields) -> str | None:
        """Information that is none: averages of priors are positive definite, those of measurements not negative."""
        wrong = (
            too_large(fields, "q", "omega", *(("y",) if stage == 0 else ("dq", "domega")))
            or not is_definite(unpacked(cast(Array, fields["omega"])))
            or (stage > 0 and not is_semidefinite(unpacked(cast(Array, fields["domega"]))))
        )
        return IMPOSSIBLE if wrong else None

    def begin(self, step: int, y: Array | None) -> Fields:
        """The own measurement, and the information in the prediction; in that of the prior, where P is singular."""
        self.skip(step)
        self._incidents = []
        if not is_definite(self._P):
            self._incidents.append("started_again")
            self._x, self._P = self._model.before(step + 1)
        prior = inverse(self._P)
        return {"y": y, "q": prior @ self._x, "omega": packed(prior)}

    def skip(self, step: int) -> None:
        """Predict only."""
        self._x, self._P = self._model.predict(step, self._x, self._P)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Mix; after the last exchange, the posterior."""
        if stage == 0:
            arrived = {j: self._with_news(step, j, fields) for j, fields in arrived.items()}
        own = arrived[self._node]
        here = [(self._weights[j], arrived.get(j, own)) for j in self._neighbourhood]
        used: UsedSet = tuple(j for j in self._neighbourhood if j in arrived)
        mixed = {
            field.name: np.sum([weight * cast(Array, fields[field.name]) for weight, fields in here], axis=0)
            for field in (*PRIOR, *NEWS)
        }
        if stage + 1 < self._rounds:
            return {**mixed, "used": used}
        information = unpacked(mixed["omega"] + self._count * mixed["domega"])
        if is_definite(information):
            self._P = inverse(information)
            self._x = self._P @ (mixed["q"] + self._count * mixed["dq"])
        else:
            self._incidents.append("without_update")
        return Outcome(self._x, self._P, used, incidents=tuple(self._incidents))

    def _with_news(self, step: int, j: NodeId, fields: Fields) -> Fields:
        """A first message with the information in its measurement: none where there is no measurement."""
        y, sensor = cast("Array | None", fields["y"]), self._model.information(step)[j]
        if y is None:
            dq, weight = np.zeros(len(sensor.gain)), np.zeros_like(sensor.weight)
        else:
            dq, weight = sensor.gain @ y, 0.5 * (sensor.weight + sensor.weight.T)
        return {**fields, "dq": dq, "domega": packed(weight)}


def _check(_: object, system: System, __: Network) -> None:
    check_white(system, invertible=True)


HYBRID = Family(Hybrid.name, Hybrid, stages=stages, options=HybridOptions, check=_check)
