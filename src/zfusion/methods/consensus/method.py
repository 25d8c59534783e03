"""Consensus on measurements, on-line: every node runs a Kalman filter on its share of everybody's measurements.

    x_i <- x_i + u_i - u_i^old,   M_i <- M_i + U_i - U_i^old            u_i = C_iᵀ Q_i^-1 y_i,   U_i = C_iᵀ Q_i^-1 C_i
    n times:  x_i <- x_i + γ Σ_j a_ij (x_j - x_i),   M_i likewise
    P_i^-1 <- P_i^-1 + N M_i,     P_i^-1 ŝ_i <- P_i^-1 ŝ_i + N x_i

Σ_i x_i = Σ_i C_iᵀ Q_i^-1 y_i holds at all times, and with it the estimates' being right in the end. A message that is
lost one way only breaks it for good: what one node took, the other did not give. So does a node that leaves or begins
anew. Losses on both directions of an edge at once only slow it down. Without a reading a node's input is none: u_i = 0,
U_i = 0. P_i is what the node believes; `prediction` has the covariance of its errors.

Source: Spanos, Olfati-Saber, Murray, "Approximate distributed Kalman filtering in sensor networks with quantifiable
performance", IPSN 2005; the input-difference form and the information form are derived in docs/methods/consensus.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Literal, cast

import numpy as np

from zfusion.errors import RunError
from zfusion.methods.consensus.forecast import forecast_of, observed_of
from zfusion.methods.consensus.mixing import Mixing, Spectrum
from zfusion.methods.consensus.prediction import tuned_step
from zfusion.methods.convex import DesignError
from zfusion.methods.family import Family, Forecast
from zfusion.methods.packing import IMPOSSIBLE, LARGEST, packed, too_large, unpacked
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, absorb, check_white
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger, UsedSet

MOST_ROUNDS = 64
"""Exchanges a step; each is a round trip of the whole swarm."""

NAMED_STEPS = ("fastest", "careful", "tuned")

DIGITS = 12
"""Of a step size that is computed: so many come out the same on all machines, and all nodes must use the same."""

KEPT = 16
"""Step sizes that a process keeps: all nodes of a simulation share one."""

SHARE = (
    Field("x", Kind.VECTOR, ("nx",), "the node's share of everybody's measurements, as information"),
    Field("M", Kind.VECTOR, ("nxx",), "its weight, the lower triangle row by row"),
)


@dataclass(frozen=True)
class ConsensusOptions:
    """What a scenario may say of the method."""

    rounds: int = 4
    """n, exchanges with the neighbours at every step."""
    step_size: float | Literal["fastest", "careful", "tuned"] = "careful"
    """γ; "fastest": 2 / (λ_2 + λ_N), best for many rounds; "careful": 1 / λ_N, which no few rounds make worse; "tuned":
    with which the predicted errors are least."""
    chebyshev: bool = False
    """Chebyshev's weights: faster for many rounds."""

    def __post_init__(self) -> None:
        if isinstance(self.rounds, bool) or not isinstance(self.rounds, int) or not 1 <= self.rounds <= MOST_ROUNDS:
            raise ModelError("rounds", self.rounds, f"expected a whole number from 1 to {MOST_ROUNDS}")
        if not isinstance(self.chebyshev, bool):
            raise ModelError("chebyshev", self.chebyshev, "expected true or false")
        number = isinstance(self.step_size, int | float) and not isinstance(self.step_size, bool)
        if not (number and self.step_size > 0) and self.step_size not in NAMED_STEPS:  # type: ignore[operator]
            raise ModelError("step_size", self.step_size, f"expected a number > 0, or one of {', '.join(NAMED_STEPS)}")
        if self.chebyshev and self.step_size not in ("fastest", "careful"):
            raise ModelError("step_size", self.step_size, "expected none: Chebyshev's weights go with 'fastest'")

    def mixing(self, network: Network, system: System) -> Mixing:
        """How values are mixed on a network; ModelError where consensus cannot be had on it, or not be tuned."""
        weights = _weights(network)
        try:
            return _mixing(self, weights.tobytes(), network.ids, system)
        except ModelError as error:
            problem = error.problem
            if problem.field not in ("rounds", "step_size"):
                raise
            raise ModelError(f"method.options.{problem.field}", problem.value, problem.expected) from None


def stages(options: ConsensusOptions) -> tuple[Stage, ...]:
    """One for each exchange; with the first comes the measurement itself, for whoever records."""
    first = Stage(MEASUREMENT.name, (*MEASUREMENT.fields, *SHARE), "what a sensor measured, and its node's share")
    later = (*SHARE, Field("used", Kind.IDS, (), "whose shares of the exchange before were mixed in"))
    return (first, *(Stage(f"mix{n}", later, f"exchange {n} of a step") for n in range(2, options.rounds + 1)))


def _weights(network: Network) -> Array:
    place = {node: n for n, node in enumerate(network.ids)}
    a = np.zeros((len(place), len(place)))
    for i in network.ids:
        for j in network.neighbours(i):
            a[place[i], place[j]] = network.weights.get((i, j), 1.0)
    return a


@lru_cache(maxsize=KEPT)
def _mixing(options: ConsensusOptions, weights: bytes, ids: tuple[NodeId, ...], system: System) -> Mixing:
    spectrum = Spectrum.of(np.frombuffer(weights).reshape(len(ids), len(ids)), ids)
    if isinstance(options.step_size, str):
        step = float(f"{_step(options, spectrum, system):.{DIGITS}g}")
    else:
        step = float(options.step_size)
    return Mixing(spectrum, options.rounds, step, options.chebyshev)


def _step(options: ConsensusOptions, spectrum: Spectrum, system: System) -> float:
    if options.step_size != "tuned":
        return spectrum.fastest_step if options.step_size == "fastest" else 1.0 / float(spectrum.values[-1])
    try:
        return tuned_step(observed_of(system), spectrum, options.rounds)
    except (DesignError, RunError, ModelError) as error:
        raise ModelError("step_size", "tuned", f"expected another one, as no errors are predicted: {error}") from None


class Consensus:
    """One node of the consensus filter."""

    name: ClassVar[str] = "consensus"

    def __init__(self, setting: Setting) -> None:
        """ModelError for a network that is directed or falls apart."""
        options = cast(ConsensusOptions, setting.options)
        self.stages = stages(options)
        self._node = setting.node
        self._neighbourhood = setting.network.neighbours(setting.node)
        mixing = options.mixing(setting.network, setting.system)
        self._omegas, self._gamma = mixing.relaxations, mixing.gamma
        self._a = {j: setting.network.weights.get((self._node, j), 1.0) for j in self._neighbourhood}
        self._count = len(setting.network.ids)
        self._model = White(setting.system, (self._node,))
        self._s, self._P = self._model.before(setting.born)
        nx = len(self._s)
        self._size = nx + nx * (nx + 1) // 2
        self._share, self._earlier, self._old = np.zeros(self._size), np.zeros(self._size), np.zeros(self._size)
        self._incidents: list[str] = []

    def refuses(self, stage: int, fields: Fields) -> str | None:
        """Numbers that are too large to be computed with; a share's weight may be indefinite for a while."""
        return IMPOSSIBLE if too_large(fields, "x", "M", *(("y",) if stage == 0 else ())) else None

    def begin(self, step: int, y: Array | None) -> Fields:
        """The change of the own input into the own share; without a reading there is no input.

        A share that has grown beyond all belief is forgotten: the input alone is the share then.
        """
        self.skip(step)
        self._incidents = []
        new = np.zeros(self._size)
        if y is not None:
            sensor = self._model.information(step)[self._node]
            new = np.concatenate((sensor.gain @ y, packed(sensor.weight)))
        self._share, self._old = self._share + (new - self._old), new
        if not np.abs(self._share).max() <= LARGEST:
            self._share = new
            self._incidents.append("started_again")
        return {"y": y, **self._told()}

    def skip(self, step: int) -> None:
        """Predict only."""
        self._s, self._P = self._model.predict(step, self._s, self._P)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Mix with what arrived; after the last exchange, update."""
        own, moved = self._share, np.zeros(self._size)
        used: UsedSet = tuple(j for j in self._neighbourhood if j in arrived)
        for j in used:
            if j != self._node:
                theirs = np.concatenate((cast(Array, arrived[j]["x"]), cast(Array, arrived[j]["M"])))
                moved += self._a[j] * (theirs - own)
        mixed, omega = own + self._gamma * moved, self._omegas[stage]
        self._share = mixed if stage == 0 else omega * mixed + (1.0 - omega) * self._earlier
        self._earlier = own
        if stage + 1 < len(self._omegas):
            return {**self._told(), "used": used}
        self._update()
        return Outcome(self._s, self._P, used, incidents=tuple(self._incidents))

    def _told(self) -> dict[str, object]:
        nx = len(self._s)
        return {"x": self._share[:nx], "M": self._share[nx:]}

    def _update(self) -> None:
        """The Kalman filter with N times the share, unless the share's weight is indefinite.

        So it may be for a while where γ times a node's degree is above 1, or when an input becomes smaller.
        """
        nx = len(self._s)
        share = self._count * self._share
        updated = absorb(self._s, self._P, share[:nx], unpacked(share[nx:], nx))
        if updated is None:
            self._incidents.append("without_update")
        else:
            self._s, self._P = updated


def _check(options: ConsensusOptions, system: System, network: Network) -> None:
    options.mixing(network, system)
    check_white(system)


def _forecast(options: ConsensusOptions, system: System, network: Network) -> Forecast:
    return forecast_of(system, options.mixing(network, system))


CONSENSUS = Family(
    Consensus.name,
    Consensus,
    stages=stages,
    options=ConsensusOptions,
    forecast=_forecast,
    check=_check,
    note="consensus: a message that is lost one way only, or a node's restart, biases all estimates for good",
)
