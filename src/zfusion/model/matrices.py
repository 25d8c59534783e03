"""Random matrices F_k and H^i_k, and what varies with time.

A random matrix M = M̄ + M̃ matters to a filter only through its mean M̄ and the map G -> E[M̃ G M̃ᵀ]. Both kinds of
description, by distribution and by moments, are brought to one form: *factors* B_t such that M̃ has the second-order
statistics of Σ_t ξ_t B_t with uncorrelated ξ_t of unit variance, hence E[M̃ G M̃ᵀ] = Σ_t B_t G B_tᵀ.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import prod
from typing import Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from zfusion.model.checks import ModelError, covariance_matrix, finite_array, semidefinite_factor
from zfusion.model.distributions import Distribution
from zfusion.model.types import Array

T = TypeVar("T")

Streams = Callable[[str], np.random.Generator]
"""Gives the random generator of a named variable."""


@dataclass(frozen=True, eq=False)
class Schedule(Generic[T]):
    """Something for each step: item n for step `first` + n, and after the last item round again or the last for ever.

    A schedule of one item is a constant.
    """

    items: tuple[T, ...]
    first: int = 0
    after: Literal["cycle", "hold"] = "hold"

    def __post_init__(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        if not self.items:
            raise ModelError("items", self.items, "expected at least one item")
        if self.after not in ("cycle", "hold"):
            raise ModelError("after", self.after, "expected 'cycle' or 'hold'")

    @classmethod
    def constant(cls, item: T, first: int = 0) -> Schedule[T]:
        """The same at all steps from `first` on."""
        return cls((item,), first)

    def index(self, k: int) -> int:
        """Position in `items` of what holds at step k; ValueError before the first step."""
        n = k - self.first
        if n < 0:
            raise ValueError(f"step {k} is before the schedule's first step {self.first}")
        return n % len(self.items) if self.after == "cycle" else min(n, len(self.items) - 1)

    def at(self, k: int) -> T:
        """What holds at step k; ValueError before the first step."""
        return self.items[self.index(k)]

    def indices(self, first: int, count: int) -> NDArray[np.intp]:
        """Positions in `items` of what holds at `count` steps from `first` on; before the first step, item 0's."""
        n = np.maximum(np.arange(first, first + count) - self.first, 0)
        return n % len(self.items) if self.after == "cycle" else np.minimum(n, len(self.items) - 1)

    @property
    def period(self) -> int:
        """Steps after which it repeats itself, from `periodic_from` on; 1 if it then stays the same."""
        return len(self.items) if self.after == "cycle" else 1

    @property
    def periodic_from(self) -> int:
        """First step from which on it repeats itself with `period`."""
        return self.first if self.after == "cycle" else self.first + len(self.items) - 1

    @property
    def constant_from(self) -> int | None:
        """First step from which on it stays the same; None if it never does."""
        return self.periodic_from if self.period == 1 else None


def constant_from(schedules: Iterable[Schedule[T]]) -> int | None:
    """First step from which on all of them stay the same (0 if there are none); None if one never does."""
    steps = [schedule.constant_from for schedule in schedules]
    return None if None in steps else max((step for step in steps if step is not None), default=0)


class RandomMatrix(ABC):
    """A matrix drawn afresh at each step, independently of everything else."""

    mean: Array
    """M̄, (rows, columns)."""

    factors: Array
    """B, (count, rows, columns), with Cov[M_pa, M_qb] = Σ_t B_tpa B_tqb; count = 0 if M is not random."""

    @abstractmethod
    def sample(self, streams: Streams, count: int) -> Array:
        """Independent draws, (count, rows, columns), each variable's from the stream of its name."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.mean.shape
        return rows, columns

    @property
    def is_random(self) -> bool:
        """Whether any entry has a variance."""
        return len(self.factors) > 0

    def second_moment(self, G: Array) -> Array:
        """E[M̃ G M̃ᵀ] = Σ_t B_t G B_tᵀ, (rows, rows), for a symmetric G, (columns, columns)."""
        return multiplicative_noise(self.factors, G)


def multiplicative_noise(factors: Array, G: Array) -> Array:
    """Σ_t B_t G B_tᵀ, (rows, rows), for factors B, (count, rows, columns), and G, (columns, columns)."""
    flat = factors.shape[1], factors.shape[0] * factors.shape[2]
    left = (factors @ G).transpose(1, 0, 2).reshape(flat)
    return left @ factors.transpose(1, 0, 2).reshape(flat).T


@dataclass(frozen=True, eq=False)
class Fixed(RandomMatrix):
    """A matrix that is not random."""

    mean: Array
    factors: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", finite_array("mean", self.mean, (None, None)))
        object.__setattr__(self, "factors", np.zeros((0, *self.mean.shape)))

    def sample(self, streams: Streams, count: int) -> Array:  # noqa: ARG002 - draws nothing
        """The matrix, `count` times."""
        return np.broadcast_to(self.mean, (count, *self.mean.shape))


@dataclass(frozen=True, eq=False)
class Terms(RandomMatrix):
    """Σ_s A_s p_s with known matrices A_s and p_s products of independent scalars.

    Each term is (A_s, names of its factors); a name given n times counts to the power n, one that several terms
    share is the same draw in each, and a term without names is constant. `variables` says how each is distributed.
    """

    terms: tuple[tuple[Array, tuple[str, ...]], ...]
    variables: Mapping[str, Distribution]
    mean: Array = field(init=False, repr=False)
    factors: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "variables", dict(sorted(self.variables.items())))
        object.__setattr__(self, "terms", self._checked_terms())
        powers = [Counter(names) for _, names in self.terms]
        means = [prod(law.moment(power[name]) for name, law in self.variables.items()) for power in powers]
        covariance = np.array([[self._covariance(a, b) for b in powers] for a in powers])
        matrices = np.array([matrix for matrix, _ in self.terms])
        mean = np.tensordot(means, matrices, 1)
        mean.setflags(write=False)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "factors", np.tensordot(semidefinite_factor(covariance).T, matrices, 1))

    def _checked_terms(self) -> tuple[tuple[Array, tuple[str, ...]], ...]:
        if not self.terms:
            raise ModelError("terms", self.terms, "expected at least one term")
        terms: list[tuple[Array, tuple[str, ...]]] = []
        shape: tuple[int | None, int | None] = (None, None)
        for n, (matrix, names) in enumerate(self.terms):
            array = finite_array(f"terms[{n}].matrix", matrix, shape)
            shape = array.shape[0], array.shape[1]
            for name in names:
                if name not in self.variables:
                    raise ModelError(f"terms[{n}].variables", name, f"expected one of {list(self.variables)}")
            terms.append((array, tuple(names)))
        unused = set(self.variables).difference(*(names for _, names in terms))
        if unused:
            raise ModelError("variables", sorted(unused), "expected variables that occur in a term")
        return tuple(terms)

    def _covariance(self, first: Mapping[str, int], second: Mapping[str, int]) -> float:
        """Covariance of two products, given by their powers, as a sum in which nothing cancels by itself.

        With α = E[x^{a+b}] and β = E[x^a] E[x^b] of each variable, α - β = Cov[x^a, x^b] is known directly, and
        Πα - Πβ = Σ_v (Π_{u<v} β_u) (α_v - β_v) (Π_{u>v} α_u).
        """
        difference, product = 0.0, 1.0  # Πα - Πβ and Πβ of the variables so far
        for name, law in self.variables.items():
            a, b = first[name], second[name]
            difference = difference * law.moment(a + b) + product * law.covariance(a, b)
            product *= law.moment(a) * law.moment(b)
        return difference

    def sample(self, streams: Streams, count: int) -> Array:
        """Independent draws, (count, rows, columns), each variable's from the stream of its name."""
        drawn = {name: law.sample(streams(name), count) for name, law in self.variables.items()}
        products = np.ones((count, len(self.terms)))
        for column, (_, names) in enumerate(self.terms):
            for name in names:
                products[:, column] *= drawn[name]
        return np.tensordot(products, np.array([matrix for matrix, _ in self.terms]), 1)


@dataclass(frozen=True, eq=False)
class ByMoments(RandomMatrix):
    """Known by the mean, (rows, columns), and the covariance of the entries in row-major order alone.

    Drawn, it is Gaussian.
    """

    mean: Array
    covariance: Array
    factors: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        mean = finite_array("mean", self.mean, (None, None))
        covariance = covariance_matrix("covariance", self.covariance, mean.size)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", covariance)
        object.__setattr__(self, "factors", semidefinite_factor(covariance).T.reshape(-1, *mean.shape))

    def sample(self, streams: Streams, count: int) -> Array:
        """Independent draws, (count, rows, columns), from the stream "entries"."""
        standard = streams("entries").standard_normal((count, len(self.factors)))
        return self.mean + np.tensordot(standard, self.factors, 1)
