"""Process and measurement noises: correlated with themselves one step apart, with one another up to two.

    w_k enters x_{k+1},  k >= 0;     v^i_k is in y^i_k,  k >= 1;     all of zero mean

This module knows what all descriptions of them have in common; see `noise` for the descriptions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from functools import cached_property
from math import lcm
from typing import NamedTuple, Protocol

import numpy as np

from zfusion.model.checks import ModelError, finite_array
from zfusion.model.matrices import Schedule, constant_from
from zfusion.model.streams import Seeds
from zfusion.model.types import Array, NodeId

MAX_CHECKED_STEPS = 10_000
"""Schedules that only repeat together after more steps than this are refused: nobody could check them."""

SETTLED_CACHE = 64
"""Selections of sensors whose settled covariances are remembered, per noise."""


class NoiseCovariances(NamedTuple):
    """Covariances at step k, the chosen sensors stacked in the order they were asked for; ny: all their rows.

    There is no w_{-1} and no v_0: covariances with them are zero.
    """

    Q: Array
    """Cov[w_k, w_k], (nx, nx)."""
    Q1: Array
    """Cov[w_k, w_{k-1}], (nx, nx)."""
    R: Array
    """Cov[v_k, v_k], (ny, ny)."""
    R1: Array
    """Cov[v_k, v_{k-1}], (ny, ny)."""
    S0: Array
    """Cov[w_k, v_k], (nx, ny)."""
    S1: Array
    """Cov[w_k, v_{k+1}], (nx, ny)."""
    S2: Array
    """Cov[w_k, v_{k+2}], (nx, ny)."""


class NoiseSampler(Protocol):
    """Draws of all noises of one seed, by blocks of BLOCK steps; block b begins with step k = b BLOCK."""

    def process(self, block: int) -> Array:
        """The noises w_{k-1} that enter the states of the block's steps, (BLOCK, nx); that of k = 0 means nothing."""

    def sensor(self, i: NodeId, block: int) -> Array:
        """The noises v^i_k of the block's steps, (BLOCK, ny_i); that of k = 0 means nothing."""


class NoiseModel(ABC):
    """Joint second-order statistics of w_k and all v^i_k."""

    _settled: dict[tuple[NodeId, ...], NoiseCovariances]

    @property
    @abstractmethod
    def nx(self) -> int:
        """Size of w_k."""

    @property
    @abstractmethod
    def sizes(self) -> Mapping[NodeId, int]:
        """Size of v^i_k for each sensor, sorted by id."""

    @property
    @abstractmethod
    def schedules(self) -> list[Schedule[Array]]:
        """All that may vary with time."""

    @abstractmethod
    def _covariances(self, k: int, ids: tuple[NodeId, ...]) -> NoiseCovariances:
        """The covariances at step k, computed afresh; those with w_{-1} or v_0 may be anything."""

    @abstractmethod
    def sampler(self, seeds: Seeds) -> NoiseSampler:
        """What draws these noises, exactly with these covariances."""

    @cached_property
    def constant_from(self) -> int | None:
        """First step from which on nothing in the description changes; None if it never settles."""
        return constant_from(self.schedules)

    def covariances(self, k: int, ids: Iterable[NodeId]) -> NoiseCovariances:
        """Covariances at step k >= 0 of w and the v^i of the chosen sensors, at a cost independent of the others.

        Once nothing changes any more, the same object each time. KeyError for an unknown sensor.
        """
        ids = tuple(ids)
        settled = self.constant_from is not None and k >= self.constant_from + 2
        if settled and ids in self._settled:
            return self._settled[ids]
        result = self._covariances(k, ids)
        absent = {0: ("Q1", "R", "R1", "S0"), 1: ("R1",)}.get(k, ())
        result = result._replace(**{name: np.zeros_like(getattr(result, name)) for name in absent})
        for matrix in result:
            matrix.setflags(write=False)
        if settled:
            if len(self._settled) >= SETTLED_CACHE:
                del self._settled[next(iter(self._settled))]
            self._settled[ids] = result
        return result

    def rows(self, ids: tuple[NodeId, ...]) -> tuple[dict[NodeId, slice], int]:
        """Where each of the chosen sensors is in their stack, and the stack's size."""
        rows, end = {}, 0
        for i in ids:
            rows[i] = slice(end, end + self.sizes[i])
            end += self.sizes[i]
        return rows, end

    @cached_property
    def repeats_after(self) -> int:
        """Number of steps in which everything has occurred that ever does; ModelError if that is too many."""
        steps = max(s.periodic_from for s in self.schedules) + lcm(*(s.period for s in self.schedules))
        if steps > MAX_CHECKED_STEPS:
            raise ModelError(
                "noise", steps, f"expected schedules that repeat together within {MAX_CHECKED_STEPS} steps"
            )
        return steps


def checked_schedule(field: str, schedule: Schedule[Array], shape: tuple[int | None, int | None]) -> Schedule[Array]:
    """The schedule with its matrices as read-only arrays; ModelError unless it begins at step 0 and they fit.

    None in the shape: any size, but the same for all items.
    """
    if schedule.first != 0:
        raise ModelError(field, schedule.first, "expected a schedule that begins at step 0")
    items = []
    for n, item in enumerate(schedule.items):
        array = finite_array(field if len(schedule.items) == 1 else f"{field}[{n}]", item, shape)
        shape = array.shape[0], array.shape[1]
        items.append(array)
    return Schedule(tuple(items), 0, schedule.after)
