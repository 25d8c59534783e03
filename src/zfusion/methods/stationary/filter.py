"""The method `stationary` at a node: one exchange a step, constant gains, everything else done off-line.

At step k the nodes tell each other y_j(k) and ξ_j(k). The estimate of step k is the method's x̂_i(k) = Σ_j H_ij ξ_j(k):
a *one-step predictor*, it uses measurements up to k-1 of the neighbours and older ones from further away. With
`filtered` it is the best linear estimate from the same exchange, measurements of step k included: what to compare
with the filters of other methods.

Everything is carried as deviation from the prior mean m_k = A^k m_0, which all nodes know: ξ_i begins at zero, the
estimate is unbiased from the first step on, and its covariance is known from there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.design_files import Content
from zfusion.methods.family import Family, Modes
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.stationary.cost import evaluate, extended
from zfusion.methods.stationary.design import METHOD, Design
from zfusion.methods.stationary.options import StationaryOptions
from zfusion.methods.stationary.substitution import NodeGains, Substitution, There
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

ESTIMATOR = Stage(
    MEASUREMENT.name,
    (
        *MEASUREMENT.fields,
        Field("xi", Kind.VECTOR, ("nx",), "the state of the estimator, in the design's coordinates"),
    ),
    "what a sensor measured, and the state of its node's estimator",
)
"""The stage of the measurements, for whoever records or scores them, with ξ beside them."""

SETTLED = 1e-13
"""Change of the covariance in one step, relative to its largest entry, that counts as none."""


class Stationary:
    """One node's estimator. What it reports as P is what the design predicts when every message has always arrived.

    P is right from the first step on, and counts what is missing at the step itself; what was missing at earlier
    steps it does not know, so it is optimistic under losses (`losses.under_loss` says by how much), and after a
    neighbour's restart until that is forgotten. Its own restart it counts.
    """

    name: ClassVar[str] = METHOD
    stages: ClassVar[tuple[Stage, ...]] = (ESTIMATOR,)

    def __init__(self, setting: Setting) -> None:
        """The setting's design must be the same at all nodes, to the last bit."""
        system, design = setting.system, cast(Design, setting.design)
        options = cast(StationaryOptions, setting.options)
        self._design, self._plant = design, design.problem.nominal
        self._position = {j: n for n, j in enumerate(design.ids)}
        self._neighbourhood = setting.network.neighbours(setting.node)
        i = self._position[setting.node]
        stationary = evaluate(design.problem, design.gains).P
        self._gains = Substitution(design.problem, design.gains, stationary, i, options.filtered)
        self._state = np.zeros(self._plant.nx)
        self._mean = np.linalg.matrix_power(self._plant.A, setting.born) @ system.initial_mean
        first = self._plant.A @ system.initial_covariance @ self._plant.A.T + self._plant.Q
        self._covariance = _Transient(design, first, i, setting.born, self._gains)
        self._alone: There = ((i,), ())

    def begin(self, step: int, y: Array | None) -> Fields:  # noqa: ARG002
        """The measurement, and the state of the estimator."""
        return {"y": y, "xi": self._state}

    def skip(self, step: int) -> None:  # noqa: ARG002
        """A step without any message, not even the own measurement."""
        self._move(self._gains.of(self._alone), self._state)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """The estimate of this step, and the estimator's move to the next."""
        used = tuple(j for j in self._neighbourhood if j in arrived)  # in sorted order, whatever the order of arrival
        states, readings, heard, seen = [], [], [], []
        for j in used:
            at, y = self._position[j], arrived[j]["y"]
            states.append(cast(Array, arrived[j]["xi"]))
            heard.append(at)
            if y is not None and at in self._gains.sensors:
                readings.append(cast(Array, y) - self._plant.C[at] @ self._mean)
                seen.append(at)
        there = tuple(heard), tuple(seen)
        gains, known = self._gains.of(there), np.concatenate((*states, *readings))
        outcome = Outcome(self._mean + gains.output @ known, self._covariance.of(there), used)
        self._move(gains, known)
        return outcome

    def _move(self, gains: NodeGains, known: Array) -> None:
        self._state = gains.state @ known
        self._mean = self._plant.A @ self._mean
        self._covariance.advance()


class _Transient:
    """Cov[η_k] from the prior on, as if every message arrived; ξ of the node itself begins at zero when it is born."""

    def __init__(self, design: Design, first: Array, i: int, born: int, gains: Substitution) -> None:
        plant = design.problem.nominal
        self._A, B = extended(plant, design.gains.F, design.gains.G)
        self._noise = B @ B.T
        self._P = np.zeros_like(self._noise)
        self._P[: plant.nx, : plant.nx] = first
        self._settled = False
        self._gains = gains
        self._joint: Array | None = None
        self._errors: dict[There, Array] = {}
        for _ in range(1, born):
            self.advance()
        own = slice((i + 1) * plant.nx, (i + 2) * plant.nx)
        if born > 1:
            self._P = self._P.copy()
            self._P[own], self._P[:, own] = 0.0, 0.0
            self._settled = False

    def of(self, there: There) -> Array:
        """Covariance of the error of this step's estimate, (nx, nx), given what was there."""
        found = self._errors.get(there)
        if found is None:
            if self._joint is None:
                self._joint = self._gains.joint(self._P)
            found = self._errors[there] = self._gains.error_covariance(self._gains.of(there), self._joint)
        return found

    def advance(self) -> None:
        """To the next step."""
        if self._settled:
            return
        moved = self._A @ self._P @ self._A.T
        following = 0.5 * (moved + moved.T) + self._noise
        self._settled = bool(np.abs(following - self._P).max() <= SETTLED * np.abs(following).max())
        self._P, self._joint, self._errors = following, None, {}


class _Designer:
    """See `Designer`; the topology does not matter: what does not come is made up for."""

    @staticmethod
    def make(options: StationaryOptions, system: System, network: Network, modes: Modes) -> Design:  # noqa: ARG004
        return options.design(system, network)

    @staticmethod
    def unpack(
        content: Content,
        options: StationaryOptions,
        system: System,
        network: Network,
        modes: Modes,  # noqa: ARG004
    ) -> Design:
        return Design.unpack(content, options.fingerprint(system, network))


def _check(options: StationaryOptions, system: System, network: Network) -> None:
    options.choice  # noqa: B018 - raises what does not go together
    options.problem(system, network)


STATIONARY = Family(
    Stationary.name,
    Stationary,
    stages=lambda _: Stationary.stages,
    options=StationaryOptions,
    designer=_Designer(),
    check=_check,
    note="stationary: without the option filtered, the estimate of a step does not use that step's measurements",
)
