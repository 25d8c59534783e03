"""The method `l2_linf` at a node: one exchange a step, gains by mode, everything else done off-line.

At step k the nodes tell each other y_j(k) and x̂_j(k). The estimate of step k is the method's x̂_i(k), a *one-step
predictor*: it was made of what was exchanged up to step k-1, and what is exchanged at step k goes into x̂_i(k+1). So an
outcome's `used` says whose messages of its step went into the *next* estimate.

Everything is carried as deviation from the prior mean m_k = A^k m_0, which all nodes know.

A neighbour of the step's mode whose message is missing is taken to believe what the node itself does, and to have
measured what that makes it expect: x̂_i for x̂_j and θ̄_j C_j x̂_i for y_j. For filters of the observer form this
cancels the neighbour out. A reading that a message says is not there is what its sender expects, θ̄_j C_j x̂_j.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.design_files import Content
from zfusion.methods.family import Family, Modes
from zfusion.methods.gramians import lyapunov
from zfusion.methods.l2_linf.design import METHOD, Design
from zfusion.methods.l2_linf.mapping import problem_of
from zfusion.methods.l2_linf.options import L2LinfOptions
from zfusion.methods.l2_linf.problem import Problem, closed
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

PREDICTION = Stage(
    MEASUREMENT.name,
    (*MEASUREMENT.fields, Field("x", Kind.VECTOR, ("nx",), "what the sender expected of the state of this step")),
    "what a sensor measured, and what its node had expected of the state",
)
"""The stage of the measurements, for whoever records or scores them, with x̂ beside them."""

REMEMBERED = 2048
"""Steps before a node's birth of which it goes through the modes, to know P: a tenth of a second; older ones are
forgotten. (Filters are as quick as the state; where ρ(A) = 0.99, the factor is 0.99^4096.)"""


class L2Linf:
    """One node's filter.

    P is the covariance of the error under the system's own noises, given the modes so far and nothing of who missed
    what, exact from the first step on as long as every message of the modes' graphs arrives. It is not what the
    method promises, that is `Design.gamma`; under losses it is optimistic, as it is after a neighbour's restart.
    """

    name: ClassVar[str] = METHOD
    stages: ClassVar[tuple[Stage, ...]] = (PREDICTION,)

    def __init__(self, setting: Setting) -> None:
        """The setting's design must be the same at all nodes."""
        system, design, modes = setting.system, cast(Design, setting.design), setting.mode
        self._problem, self._modes = design.problem, modes
        self._position = {j: n for n, j in enumerate(design.ids)}
        self._neighbourhood = setting.network.neighbours(setting.node)
        i = self._position[setting.node]
        self._own = i
        nx, count = design.problem.nx, len(design.problem.masks)
        rows = slice(i * nx, (i + 1) * nx)
        self._K = [design.gains.K[s, rows].reshape(nx, -1, nx).transpose(1, 0, 2) for s in range(count)]
        """By mode the K_ij of all j, (n, nx, nx)."""
        self._linked = [np.flatnonzero(mask[i]).tolist() for mask in design.problem.masks]
        """By mode the positions of the neighbours, in the order of the ids, itself included."""
        self._expected = [chance * c for chance, c in zip(design.problem.arrival, design.problem.C, strict=True)]
        self._H = [
            [design.gains.H[s, rows, design.problem.rows(j)] for j in range(design.problem.n)] for s in range(count)
        ]
        self._x = np.zeros(nx)
        self._mean = np.linalg.matrix_power(self._problem.A, setting.born) @ system.initial_mean
        first = max(1, setting.born - REMEMBERED)
        self._covariance = _Moments(design, first, system.initial_mean, system.initial_covariance)
        for step in range(first, setting.born):
            self._covariance.advance(modes(step))
        if setting.born > 1:
            self._covariance.restart(i)

    def begin(self, step: int, y: Array | None) -> Fields:  # noqa: ARG002
        """The measurement, and what was expected of this step."""
        return {"y": y, "x": self._mean + self._x}

    def skip(self, step: int) -> None:
        """A step without any message, not even the own measurement."""
        self._move(step, {})

    def unheard(self, step: int) -> tuple[NodeId, ...]:
        """The neighbours that the mode of the step does not have."""
        linked = self._linked[self._modes(step)]
        return tuple(j for j in self._neighbourhood if self._position[j] not in linked)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """The estimate of this step, and the filter's move to the next."""
        linked = self._linked[self._modes(step)]
        used = tuple(j for j in self._neighbourhood if j in arrived and self._position[j] in linked)
        outcome = Outcome(self._mean + self._x, self._covariance.of(self._own), used)
        self._move(step, {self._position[j]: arrived[j] for j in used})
        return outcome

    def _move(self, step: int, there: Mapping[int, Fields]) -> None:
        s = self._modes(step)
        following = np.zeros_like(self._x)
        for j in self._linked[s]:
            fields = there.get(j)
            x = self._x if fields is None or j == self._own else cast(Array, fields["x"]) - self._mean
            y = None if fields is None else fields["y"]
            measured = self._expected[j]
            seen = measured @ x if y is None else cast(Array, y) - measured @ self._mean
            following += self._K[s][j] @ x + self._H[s][j] @ seen
        self._x = following
        self._mean = self._problem.A @ self._mean
        self._covariance.advance(s)


class _Moments:
    """Cov[η_k] given the modes up to k-1, from the prior on, w being white with unit covariance."""

    def __init__(self, design: Design, first: int, mean: Array, covariance: Array) -> None:
        """At step `first`, when every x̂ is the prior mean; `mean` and `covariance` are those of x_0."""
        problem = design.problem
        self._problem: Problem = problem
        self._lost = [
            [problem.spread(i) * H[:, problem.rows(i)] @ problem.C[i] for i in problem.doubtful] for H in design.gains.H
        ]
        """By mode σ_i H(:, i) C_i of every sensor that may miss."""
        self._motions = closed(problem, design.gains)
        self._noises = [motion.B @ motion.B.T for motion in self._motions]
        power = np.linalg.matrix_power(problem.A, first)
        settled = lyapunov(problem.A, problem.B @ problem.B.T)
        both = np.vstack((np.eye(problem.nx), problem.E))
        self._mean = power @ mean
        self._P: Array = both @ (settled + power @ (covariance - settled) @ power.T) @ both.T

    def of(self, i: int) -> Array:
        """Cov[e_i], (nx, nx)."""
        nx = self._problem.nx
        at = slice((i + 1) * nx, (i + 2) * nx)
        return self._P[at, at].copy()

    def restart(self, i: int) -> None:
        """Node i expects the prior mean again: e_i is x."""
        nx = self._problem.nx
        at = slice((i + 1) * nx, (i + 2) * nx)
        self._P[at] = self._P[:nx]
        self._P[:, at] = self._P[:, :nx]

    def advance(self, s: int) -> None:
        """To the next step, in mode s."""
        problem, motion, nx = self._problem, self._motions[s], self._problem.nx
        moved = motion.A @ self._P @ motion.A.T + self._noises[s]
        seen = self._P[:nx, :nx] + np.multiply.outer(self._mean, self._mean)
        for lost in self._lost[s]:
            moved[nx:, nx:] += lost @ seen @ lost.T
        self._P = 0.5 * (moved + moved.T)
        self._mean = problem.A @ self._mean


class _Designer:
    """See `Designer`; what the modes join is what the network may be."""

    @staticmethod
    def make(options: L2LinfOptions, system: System, network: Network, modes: Modes) -> Design:  # noqa: ARG004
        return options.design(system, modes.networks, modes.transition)

    @staticmethod
    def unpack(
        content: Content,
        options: L2LinfOptions,
        system: System,
        network: Network,  # noqa: ARG004
        modes: Modes,
    ) -> Design:
        return Design.unpack(content, options.fingerprint(system, modes.networks, modes.transition))


def _check(options: L2LinfOptions, system: System, network: Network) -> None:
    problem_of(system, [network], ((1.0,),), options.output)


L2_LINF = Family(
    L2Linf.name,
    L2Linf,
    stages=lambda _: L2Linf.stages,
    options=L2LinfOptions,
    designer=_Designer(),
    check=_check,
    note="l2_linf: the estimate of a step does not use that step's measurements; what it bounds is the worst case",
)
