"""Noises made of white ones that several of them share: how correlation comes about in practice."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import product
from math import inf, sqrt

import numpy as np

from zfusion.model.checks import ModelError, covariance_matrix, semidefinite_factor
from zfusion.model.distributions import Distribution, Normal
from zfusion.model.matrices import Schedule
from zfusion.model.noise_model import NoiseCovariances, NoiseModel, checked_schedule
from zfusion.model.streams import BLOCK, Recent, Seeds
from zfusion.model.types import Array, NodeId, sorted_ids

CANCELLED = 1e-12
"""A sum of products counts as zero below this part of the sum of their magnitudes."""


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """White noise of zero mean: independent over steps, defined at all of them, negative ones too.

    Its values are a square root of the covariance times independent components with the shape of `distribution`,
    whose own mean and variance do not matter.
    """

    covariance: Array
    distribution: Distribution = field(default_factory=Normal)
    _factor: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", covariance_matrix("covariance", self.covariance))
        object.__setattr__(self, "_factor", semidefinite_factor(self.covariance))
        if self.distribution.central_moment(2) <= 0:
            raise ModelError("distribution", self.distribution, "expected one with a variance > 0")

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.covariance)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Independent draws, (count, size)."""
        rank = self._factor.shape[1]
        drawn = self.distribution.sample(rng, count * rank).reshape(count, rank)
        standard = (drawn - self.distribution.moment(1)) / sqrt(self.distribution.central_moment(2))
        coloured: Array = standard @ self._factor.T
        return coloured


@dataclass(frozen=True, eq=False)
class Tap:
    """One term of a moving average: at step k, matrix_k η_{k+lag}, η the white noise called `source`."""

    source: str
    lag: int
    matrix: Schedule[Array]

    def __post_init__(self) -> None:
        if isinstance(self.lag, bool) or not isinstance(self.lag, int):
            raise ModelError("lag", self.lag, "expected an integer")
        object.__setattr__(self, "matrix", checked_schedule("matrix", self.matrix, (None, None)))

    @property
    def shape(self) -> tuple[int, int]:
        """Of the matrix."""
        rows, columns = self.matrix.items[0].shape
        return rows, columns


Taps = tuple[Tap, ...]
ByLag = dict[int, list[tuple[str, Tap]]]
"""The taps of one white noise by their lags, each with the name of its target."""


@dataclass(frozen=True, eq=False)
class MovingAverageNoise(NoiseModel):
    """w_k = Σ_t M_t η_{k+lag_t} over `process`, and v^i_k likewise over `sensors[i]`, of the noises in `white`.

    ModelError if the taps correlate what the model takes as uncorrelated: w with w or v with v more than one step
    apart, or w_k with a v other than v_k, v_{k+1}, v_{k+2}. A noise that is absent has a tap with a zero matrix.
    """

    white: Mapping[str, WhiteNoise]
    process: Taps
    sensors: Mapping[NodeId, Taps]
    _settled: dict[tuple[NodeId, ...], NoiseCovariances] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "white", dict(self.white))
        object.__setattr__(self, "process", tuple(self.process))
        object.__setattr__(self, "sensors", {i: tuple(self.sensors[i]) for i in sorted_ids(self.sensors)})
        self._check_taps("process", self.process)
        for i, taps in self.sensors.items():
            self._check_taps(f"sensors[{i!r}]", taps)
        self._check_structure()

    @property
    def nx(self) -> int:
        """Size of w_k."""
        return self.process[0].shape[0]

    @cached_property
    def sizes(self) -> Mapping[NodeId, int]:
        """Size of v^i_k for each sensor, sorted by id."""
        return {i: taps[0].shape[0] for i, taps in self.sensors.items()}

    @property
    def schedules(self) -> list[Schedule[Array]]:
        """The taps' matrices."""
        return [tap.matrix for taps in (self.process, *self.sensors.values()) for tap in taps]

    def sampler(self, seeds: Seeds) -> MovingAverageSampler:
        """What draws these noises."""
        return MovingAverageSampler(self, seeds)

    def _covariances(self, k: int, ids: tuple[NodeId, ...]) -> NoiseCovariances:
        """Cov[z_k, z_{k-d}] = Σ_lag L_k[lag] C L_{k-d}[lag + d]ᵀ, with z = (w, v) and L_k[lag] the stacked taps."""
        columns, covariance = self._selected_white(ids)
        now = self._loadings(k, ids, columns)
        nx = self.nx

        def lagged(d: int) -> Array:
            then = now if d == 0 or k - d < 0 else self._loadings(k - d, ids, columns)
            total = np.zeros((len(next(iter(now.values()))),) * 2)
            for lag, loading in now.items():
                if lag + d in then:
                    total += loading @ covariance @ then[lag + d].T
            return total

        same, before, after, later = (lagged(d) for d in (0, 1, -1, -2))
        return NoiseCovariances(
            Q=same[:nx, :nx],
            Q1=before[:nx, :nx],
            R=same[nx:, nx:],
            R1=before[nx:, nx:],
            S0=same[:nx, nx:],
            S1=after[:nx, nx:],
            S2=later[:nx, nx:],
        )

    def _selected_white(self, ids: tuple[NodeId, ...]) -> tuple[dict[str, slice], Array]:
        """The white noises in w and the chosen v^i: where each is in their stack, and the stack's covariance."""
        sources = {tap.source for taps in (self.process, *(self.sensors[i] for i in ids)) for tap in taps}
        columns, end = {}, 0
        for source in sorted(sources):
            columns[source] = slice(end, end + self.white[source].size)
            end += self.white[source].size
        covariance = np.zeros((end, end))
        for source, at in columns.items():
            covariance[at, at] = self.white[source].covariance
        return columns, covariance

    def _loadings(self, k: int, ids: tuple[NodeId, ...], columns: Mapping[str, slice]) -> dict[int, Array]:
        """For each lag the matrix L with (w_k; chosen v_k) = Σ_lag L η_{k+lag}, η the stack of white noises."""
        rows, ny = self.rows(ids)
        width = sum(self.white[source].size for source in columns)
        loadings: dict[int, Array] = defaultdict(lambda: np.zeros((self.nx + ny, width)))
        for tap in self.process:
            loadings[tap.lag][: self.nx, columns[tap.source]] += tap.matrix.at(k)
        for i in ids:
            at = slice(self.nx + rows[i].start, self.nx + rows[i].stop)
            for tap in self.sensors[i]:
                loadings[tap.lag][at, columns[tap.source]] += tap.matrix.at(k)
        return loadings

    def _check_taps(self, where: str, taps: Taps) -> None:
        if not taps:
            raise ModelError(where, taps, "expected at least one tap")
        for n, tap in enumerate(taps):
            if tap.source not in self.white:
                raise ModelError(f"{where}[{n}].source", tap.source, f"expected one of {sorted(self.white)}")
            wanted = taps[0].shape[0], self.white[tap.source].size
            if tap.shape != wanted:
                raise ModelError(f"{where}[{n}].matrix", tap.shape, f"expected shape {wanted}")

    def _check_structure(self) -> None:
        """Refuse a covariance outside the model's structure: the contributions to it must cancel."""
        for (left, right, d), pairs in self._outside_structure().items():
            first = 0 if left == "w" else 1
            for k in range(max(first, 1 - d), self.repeats_after + abs(d) + 1):
                products = [(a.matrix.at(k), self.white[a.source].covariance, b.matrix.at(k + d)) for a, b in pairs]
                value = sum(A @ C @ B.T for A, C, B in products)
                size = sum(np.abs(A) @ np.abs(C) @ np.abs(B).T for A, C, B in products)
                if (np.abs(value) > CANCELLED * size).any():
                    sources = sorted({a.source for a, _ in pairs})
                    raise ModelError(
                        f"Cov[{left}_k, {right}_{{k{d:+d}}}]",
                        np.asarray(value).tolist(),
                        f"expected zero, the model has no such correlation; both contain {', '.join(sources)}",
                    )

    def _outside_structure(self) -> dict[tuple[str, str, int], list[tuple[Tap, Tap]]]:
        """Pairs of taps that correlate their targets too far apart, by (first, second, d) for first_k and second_{k+d}.

        Taps of one white noise correlate their targets lag - lag' steps apart. Lags are compared first: a common
        noise has few of them and thousands of targets.
        """
        w: dict[str, ByLag] = {source: defaultdict(list) for source in self.white}
        v: dict[str, ByLag] = {source: defaultdict(list) for source in self.white}
        for tap in self.process:
            w[tap.source][tap.lag].append(("w", tap))
        for i, taps in self.sensors.items():
            for tap in taps:
                v[tap.source][tap.lag].append((f"v^{i}", tap))
        outside: dict[tuple[str, str, int], list[tuple[Tap, Tap]]] = defaultdict(list)
        for source in self.white:
            for left, right, nearest, farthest in ((w, w, -inf, 1), (v, v, -inf, 1), (w, v, 0, 2)):
                for a, b in product(left[source], right[source]):
                    if not nearest <= a - b <= farthest:
                        for (one, tap), (other, second) in product(left[source][a], right[source][b]):
                            outside[one, other, a - b].append((tap, second))
        return outside


class MovingAverageSampler:
    """Draws the white noises by blocks, and from them whichever noise is asked for."""

    def __init__(self, noise: MovingAverageNoise, seeds: Seeds) -> None:
        self._noise = noise
        self._seeds = seeds
        self._white = {name: Recent(partial(self._draw, name)) for name in noise.white}

    def process(self, block: int) -> Array:
        """w_{k-1} for the steps k of the block, (BLOCK, nx)."""
        return self._sum(self._noise.process, block * BLOCK - 1)

    def sensor(self, i: NodeId, block: int) -> Array:
        """v^i_k for the steps k of the block, (BLOCK, ny_i)."""
        return self._sum(self._noise.sensors[i], block * BLOCK)

    def _sum(self, taps: Taps, first: int) -> Array:
        """Σ_t M_t η_{k+lag_t} for the BLOCK steps from `first` on."""
        return sum((self._term(tap, first) for tap in taps[1:]), self._term(taps[0], first))

    def _term(self, tap: Tap, first: int) -> Array:
        block, offset = divmod(first + tap.lag, BLOCK)
        eta = self._white[tap.source](block)
        if offset:
            eta = np.concatenate([eta[offset:], self._white[tap.source](block + 1)[:offset]])
        if len(tap.matrix.items) == 1:
            return eta @ tap.matrix.items[0].T
        matrices = np.array(tap.matrix.items)[tap.matrix.indices(first, BLOCK)]
        term: Array = np.einsum("kij,kj->ki", matrices, eta)
        return term

    def _draw(self, name: str, block: int) -> Array:
        return self._noise.white[name].sample(self._seeds.generator("white", name, block=block), BLOCK)
