"""The pieces of a scenario that describe the observed system: state, sensors and their noises."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import Discriminator, Field, Tag, model_validator

from zfusion.model.schema.base import Count, Covariance, Id, Name, Natural, Spec, Vector
from zfusion.model.schema.matrices import CovarianceOverTime, MatrixOverTime, RandomOverTime, ShapeSpec
from zfusion.model.schema.run import Source
from zfusion.model.types import NodeId


class TapSpec(Spec):
    """A term of a moving average: at step k, `matrix` times the white noise `source` of step k + lag."""

    source: str
    lag: Annotated[int, Field(strict=True)] = 0
    matrix: MatrixOverTime | None = None
    """The identity if it is not given."""


Taps = Annotated[tuple[TapSpec, ...], Field(min_length=1)]


class SystemSpec(Spec):
    """x_{k+1} = F_k x_k + w_k, k >= 0, from x_0 with the initial mean (zero if not given) and covariance.

    w_k is the sum of an own white noise of covariance Q and of moving averages of the common white noises.
    """

    F: RandomOverTime
    initial_mean: Vector | None = None
    initial_covariance: Covariance
    Q: CovarianceOverTime | None = None
    noise: Taps | None = None


class SensorSpec(Spec):
    """y_k = H_k x_k + v_k, k >= 1: one sensor (`id`) or several that are alike (`ids`, or `count` from `first_id`).

    v_k is the sum of an own white noise of covariance R and of moving averages of the common white noises.
    """

    id: Id | None = None
    ids: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None
    count: Count | None = None
    first_id: Natural | None = None
    H: RandomOverTime
    R: CovarianceOverTime | None = None
    noise: Taps | None = None
    source: Source | None = None
    """Where this sensor's measurements come from, if not from the scenario's `source`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in ("id", "ids", "count") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected exactly one of id, ids and count, not {' and '.join(given) or 'none'}")
        if self.first_id is not None and self.count is None:
            raise ValueError("expected first_id only beside count")
        return self

    @property
    def members(self) -> tuple[NodeId, ...]:
        """The ids of the sensors that this entry stands for."""
        if self.id is not None:
            return (self.id,)
        if self.ids is not None:
            return self.ids
        first = 1 if self.first_id is None else self.first_id
        return tuple(range(first, first + (self.count or 0)))


class WhiteSpec(Spec):
    """A white noise that several noises share; only the shape of its distribution matters."""

    covariance: Covariance
    shape: ShapeSpec | None = None


class PairSpec(Spec):
    """The covariance of the noises of two sensors: Cov[v^i_k, v^j_k] or Cov[v^i_k, v^j_{k-1}], sensors = [i, j]."""

    sensors: tuple[Id, Id]
    value: MatrixOverTime


class CrossSpec(Spec):
    """The covariance of the process noise with one sensor's noise."""

    sensor: Id
    value: MatrixOverTime


def is_by_parts(covariance: object) -> bool:
    """Whether a covariance is a list of its blocks, and not one matrix over all sensors."""
    if not isinstance(covariance, list | tuple) or not covariance:
        return False
    return isinstance(covariance[0], Mapping | Spec)


def _form(covariance: object) -> str:
    return "<parts>" if is_by_parts(covariance) else "<whole>"


ByPair = Annotated[
    Annotated[MatrixOverTime, Tag("<whole>")] | Annotated[tuple[PairSpec, ...], Tag("<parts>")],
    Discriminator(_form),
]
BySensor = Annotated[
    Annotated[MatrixOverTime, Tag("<whole>")] | Annotated[tuple[CrossSpec, ...], Tag("<parts>")],
    Discriminator(_form),
]


class NoiseSpec(Spec):
    """What the noises have in common: white noises that they share, or else their covariances.

    Q1 = Cov[w_k, w_{k-1}], R = Cov[V_k, V_k], R1 = Cov[V_k, V_{k-1}], S0 = Cov[w_k, V_k], S1 = Cov[w_k, V_{k+1}],
    S2 = Cov[w_k, V_{k+2}], with V the stack of all v^i, each as a whole matrix or by its non-zero blocks.
    """

    white: dict[Name, WhiteSpec] = Field(default_factory=dict)
    Q1: MatrixOverTime | None = None
    R: ByPair | None = None
    R1: ByPair | None = None
    S0: BySensor | None = None
    S1: BySensor | None = None
    S2: BySensor | None = None

    @property
    def by_covariance(self) -> dict[str, Any]:
        """The covariances that are given, by name."""
        names = ("Q1", "R", "R1", "S0", "S1", "S2")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}
