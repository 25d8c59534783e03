"""The diffusion Kalman filter: a Kalman filter on the neighbourhood's measurements, then a mean of the estimates.

    ψ_i   = Kalman update of x̂_i with y_j for all j in N_i, one after the other
    x̂_i  = Σ_{j in N_i} c_ij ψ_j                               Σ_j c_ij = 1
    P_i   is that of ψ_i: not the covariance of the error of x̂_i, which the method does not compute

Source: Cattivelli, Sayed, "Diffusion strategies for distributed Kalman filtering and smoothing", IEEE Trans. Automatic
Control 55 (2010) 2069-2084, Algorithm 1 (time- and measurement-update form).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.family import Family
from zfusion.methods.packing import IMPOSSIBLE, too_large
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.white import White, check_white, kalman_update
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import MEASUREMENT, Field, Kind, Stage
from zfusion.used_sets import Ledger

PSI = Stage(
    "psi",
    (
        Field("x", Kind.VECTOR, ("nx",), "the estimate from the neighbourhood's measurements, before the mean"),
        Field("used", Kind.IDS, (), "whose measurements of this step went in"),
    ),
    "the estimate of the diffusion filter before its neighbours' are mixed in",
)


class Diffusion:
    """One node of the diffusion Kalman filter, with equal weights c_ij for all whose estimates have arrived."""

    name: ClassVar[str] = "diffusion"
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT, PSI)

    def __init__(self, setting: Setting) -> None:
        self._neighbourhood = setting.network.neighbours(setting.node)
        self._model = White(setting.system, self._neighbourhood)
        self._x, self._P = self._model.before(setting.born)

    def refuses(self, stage: int, fields: Fields) -> str | None:
        """Numbers that are too large to be computed with."""
        return IMPOSSIBLE if too_large(fields, "y" if stage == 0 else "x") else None

    def begin(self, step: int, y: Array | None) -> Fields:
        """The measurement, as it is."""
        self._x, self._P = self._model.predict(step, self._x, self._P)
        return {"y": y}

    def skip(self, step: int) -> None:
        """Predict only."""
        self._x, self._P = self._model.predict(step, self._x, self._P)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Stage 0: the incremental update; stage 1: the diffusion update."""
        here = [j for j in self._neighbourhood if j in arrived]
        if stage == 0:
            used = []
            for j in here:
                y = cast("Array | None", arrived[j]["y"])
                if y is not None:
                    self._x, self._P = kalman_update(self._x, self._P, y, *self._model.observation(step, j))
                    used.append(j)
            return {"x": self._x, "used": tuple(used)}
        self._x = np.mean([cast(Array, arrived[j]["x"]) for j in here], axis=0)
        return Outcome(self._x, self._P, tuple(here))


def _check(_: object, system: System, __: Network) -> None:
    check_white(system)


DIFFUSION = Family(Diffusion.name, Diffusion, stages=lambda _: Diffusion.stages, check=_check)
