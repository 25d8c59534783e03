"""Named scalar distributions, with their moments in closed form.

The random parameter matrices are polynomials in independent scalars that have one of these distributions; the
filters need exact means and covariances of such polynomials, hence moments of any order, and the simulation
needs draws. Covariances are built from *central* moments, so that nothing cancels when a mean is large beside
its spread.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import comb, factorial, prod, sqrt

import numpy as np
from numpy.typing import NDArray

from zfusion.model.checks import ModelError, finite_array, finite_number
from zfusion.model.types import Array

PROBABILITY_SUM = 1e-9
"""How far from 1 the probabilities of a discrete distribution may add up, for decimals typed by hand."""


class Distribution(ABC):
    """Law of a real random variable x all of whose moments are finite."""

    @abstractmethod
    def moment(self, n: int) -> float:
        """E[x^n], n >= 0."""

    @abstractmethod
    def central_moment(self, n: int) -> float:
        """E[(x - E[x])^n], n >= 0."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""

    def covariance(self, a: int, b: int) -> float:
        """Cov[x^a, x^b] = Σ_{i,j >= 1} C(a,i) C(b,j) E[x]^{a-i+b-j} (c_{i+j} - c_i c_j), c_n the central moments."""
        mean = self.moment(1)
        c = [self.central_moment(n) for n in range(a + b + 1)]
        return sum(
            comb(a, i) * comb(b, j) * mean ** (a - i + b - j) * (c[i + j] - c[i] * c[j])
            for i in range(1, a + 1)
            for j in range(1, b + 1)
        )

    def _moment_about(self, mean: float, n: int) -> float:
        """E[x^n] from the central moments, given E[x]."""
        return sum(comb(n, j) * mean ** (n - j) * self.central_moment(j) for j in range(n + 1))


@dataclass(frozen=True)
class Normal(Distribution):
    """Gaussian."""

    mean: float = 0.0
    variance: float = 1.0

    def __post_init__(self) -> None:
        finite_number("mean", self.mean)
        if finite_number("variance", self.variance) < 0:
            raise ModelError("variance", self.variance, "expected a number >= 0")

    def moment(self, n: int) -> float:
        """Σ_j C(n,j) mean^{n-j} E[(x - mean)^j]."""
        return self._moment_about(self.mean, n)

    def central_moment(self, n: int) -> float:
        """Zero for odd n, 1·3·5···(n-1) σ^n for even n."""
        return 0.0 if n % 2 else prod(range(1, n, 2)) * self.variance ** (n // 2)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""
        return self.mean + sqrt(self.variance) * rng.standard_normal(size)


@dataclass(frozen=True)
class Uniform(Distribution):
    """Uniform on the interval from `low` to `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if finite_number("low", self.low) > finite_number("high", self.high):
            raise ModelError("low", self.low, f"expected a number <= high = {self.high}")

    def moment(self, n: int) -> float:
        """Σ_j C(n,j) mean^{n-j} E[(x - mean)^j]."""
        return self._moment_about((self.low + self.high) / 2, n)

    def central_moment(self, n: int) -> float:
        """Zero for odd n, h^n / (n + 1) for even n, h half the interval's length."""
        return 0.0 if n % 2 else ((self.high - self.low) / 2) ** n / (n + 1)

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""
        return rng.uniform(self.low, self.high, size)


@dataclass(frozen=True)
class Bernoulli(Distribution):
    """1 with probability `p`, 0 otherwise."""

    p: float

    def __post_init__(self) -> None:
        if not 0 <= finite_number("p", self.p) <= 1:
            raise ModelError("p", self.p, "expected a probability, from 0 to 1")

    def central_moment(self, n: int) -> float:
        """Exactly p (1-p)^n + (1-p) (-p)^n."""
        return self.p * (1 - self.p) ** n + (1 - self.p) * (-self.p) ** n

    def moment(self, n: int) -> float:
        """Every moment is p: x^n = x."""
        return 1.0 if n == 0 else self.p

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""
        return (rng.random(size) < self.p).astype(np.float64)


@dataclass(frozen=True)
class Discrete(Distribution):
    """`values[n]` with probability `probabilities[n]`."""

    values: tuple[float, ...]
    probabilities: tuple[float, ...]

    def __post_init__(self) -> None:
        values = finite_array("values", self.values, (None,))
        chances = finite_array("probabilities", self.probabilities, (len(values),))
        if (chances < 0).any() or abs(chances.sum() - 1) > PROBABILITY_SUM:
            raise ModelError("probabilities", self.probabilities, "expected numbers >= 0 that add up to 1")
        object.__setattr__(self, "values", tuple(values.tolist()))
        object.__setattr__(self, "probabilities", tuple(chances.tolist()))

    def moment(self, n: int) -> float:
        """Σ p_n x_n^n."""
        return sum(p * x**n for x, p in zip(self.values, self.probabilities, strict=True))

    def central_moment(self, n: int) -> float:
        """Σ p_n (x_n - mean)^n."""
        mean = self.moment(1)
        return sum(p * (x - mean) ** n for x, p in zip(self.values, self.probabilities, strict=True))

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""
        edges = np.cumsum(self.probabilities)[:-1]
        drawn: NDArray[np.intp] = np.searchsorted(edges, rng.random(size), side="right")
        return np.array(self.values)[drawn]


@dataclass(frozen=True)
class Exponential(Distribution):
    """Exponential with the given mean (> 0)."""

    mean: float

    def __post_init__(self) -> None:
        if finite_number("mean", self.mean) <= 0:
            raise ModelError("mean", self.mean, "expected a number > 0")

    def moment(self, n: int) -> float:
        """Exactly n! mean^n."""
        return factorial(n) * self.mean**n

    def central_moment(self, n: int) -> float:
        """The number of derangements of n things, times mean^n."""
        derangements = 1
        for count in range(1, n + 1):
            derangements = count * derangements + (-1) ** count
        return derangements * self.mean**n

    def sample(self, rng: np.random.Generator, size: int) -> Array:
        """Independent draws, (size,)."""
        return rng.exponential(self.mean, size)
