"""Random systems, graphs and used sets, of everything that the model can express and of moderate condition.

All draws come from the generator that is passed in: the same generator state gives the same system.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from itertools import combinations_with_replacement, product
from typing import Literal, TypeVar

import numpy as np

from zfusion.model.distributions import Bernoulli, Discrete, Normal, Uniform
from zfusion.model.matrices import ByMoments, Fixed, RandomMatrix, Schedule, Terms
from zfusion.model.noise import CovarianceNoise, MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId, sorted_ids

Noise = Literal["moving_average", "white"]
T = TypeVar("T")

PERIOD = 3
"""Steps after which what varies with time repeats itself."""


def random_system(
    rng: np.random.Generator,
    *,
    ids: Iterable[NodeId] | None = None,
    nx: int | None = None,
    noise: Noise = "moving_average",
    multiplicative: bool = True,
    mean: float = 1.0,
    radius: float = 0.9,
    varying: bool = False,
) -> System:
    """A system with 1..3 states (`nx`) and 2..6 sensors (`ids`) of 1..2 measurements each.

    noise           "moving_average": everything the model allows is correlated; "white": nothing is
    multiplicative  whether F and H are random matrices
    mean            standard deviation of the components of the initial mean
    radius          spectral radius of F̄; above 1, the system is unstable
    varying         whether F, H and the noises differ from step to step (with period `PERIOD`)
    """
    nx = int(rng.integers(1, 4)) if nx is None else nx
    ids = list(range(1, int(rng.integers(3, 8)))) if ids is None else sorted_ids(ids)
    sizes = {i: int(rng.integers(1, 3)) for i in ids}
    spread = 0.15 if multiplicative else 0.0
    period = PERIOD if varying else 1

    def sensor(i: NodeId, ny: int) -> Sensor:
        def make() -> RandomMatrix:
            return random_matrix(rng, rng.normal(size=(ny, nx)), 2 * spread)

        return Sensor(i, ny, _schedule(period, make, first=1))

    return System(
        nx=nx,
        initial_mean=mean * rng.normal(size=nx),
        initial_covariance=random_covariance(rng, nx),
        F=_schedule(period, lambda: random_matrix(rng, _dynamics(rng, nx, radius), spread)),
        sensors=tuple(sensor(i, ny) for i, ny in sizes.items()),
        noise=_noise(rng, nx, sizes, noise, period),
    )


def by_covariances(system: System) -> System:
    """The same system with its noise described by covariances; the noise must repeat after `PERIOD` steps."""
    ids = system.ids
    # from a period past the beginning, where covariances with w_{-1} or v_0 are zero for want of them
    periodic = [system.noise.covariances(k, ids) for k in range(PERIOD, 2 * PERIOD)]
    ends = np.cumsum([sensor.ny for sensor in system.sensors])
    rows = {s.id: slice(int(end) - s.ny, int(end)) for s, end in zip(system.sensors, ends, strict=True)}

    def schedule(blocks: Iterable[Array]) -> Schedule[Array]:
        return Schedule(tuple(blocks), after="cycle")

    noise = CovarianceNoise(
        Q=schedule(c.Q for c in periodic),
        Q1=schedule(c.Q1 for c in periodic),
        R={(i, j): schedule(c.R[rows[i], rows[j]] for c in periodic) for i, j in combinations_with_replacement(ids, 2)},
        R1={(i, j): schedule(c.R1[rows[i], rows[j]] for c in periodic) for i, j in product(ids, repeat=2)},
        S0={i: schedule(c.S0[:, rows[i]] for c in periodic) for i in ids},
        S1={i: schedule(c.S1[:, rows[i]] for c in periodic) for i in ids},
        S2={i: schedule(c.S2[:, rows[i]] for c in periodic) for i in ids},
    )
    return replace(system, noise=noise)


def random_covariance(rng: np.random.Generator, n: int) -> Array:
    """A covariance matrix with eigenvalues from 0.3 to 1.5, (n, n)."""
    vectors = np.linalg.qr(rng.normal(size=(n, n)))[0]
    covariance: Array = (vectors * rng.uniform(0.3, 1.5, n)) @ vectors.T
    return (covariance + covariance.T) / 2


def random_matrix(rng: np.random.Generator, mean: Array, spread: float) -> RandomMatrix:
    """A random matrix of that mean, entries of standard deviation about `spread`, of any of the model's kinds."""
    if spread == 0:
        return Fixed(mean)
    kind = rng.integers(3)
    if kind == 0:
        return ByMoments(mean, spread**2 * random_covariance(rng, mean.size))
    second, third = spread * rng.normal(size=(2, *mean.shape))
    if kind == 1:
        terms = ((mean - third, ()), (second, ("eps",)), (third, ("eps", "eps")))
        return Terms(terms, {"eps": Normal(0.0, 1.0)})
    first = (mean - 0.9 * 0.5 * second - 0.65 * third) / 0.9
    return Terms(
        ((first, ("lambda",)), (second, ("lambda", "zeta")), (third, ("level",))),
        {
            "lambda": Bernoulli(0.9),
            "zeta": Uniform(-1.0, 2.0),
            "level": Discrete((0.0, 0.5, 1.0), (0.1, 0.5, 0.4)),
        },
    )


def random_graph(
    rng: np.random.Generator, ids: Iterable[NodeId], density: float = 0.4
) -> dict[NodeId, tuple[NodeId, ...]]:
    """A directed graph: i -> N_i (sorted, with i itself), each other node in it with probability `density`."""
    ids = sorted_ids(ids)
    return {i: tuple(j for j in ids if j == i or rng.random() < density) for i in ids}


def random_used_sets(
    rng: np.random.Generator,
    neighbours: Mapping[NodeId, tuple[NodeId, ...]],
    steps: int,
    *,
    loss: float = 0.35,
    blackout: float = 0.15,
    late: float = 0.25,
) -> dict[tuple[NodeId, int], tuple[NodeId, ...]]:
    """(node, step) -> the subset of N_i that the node used, for steps 1..K; it may be empty.

    loss      probability that a single measurement does not arrive (a node's own may be missing too)
    blackout  probability of a step at which nothing arrives anywhere
    late      probability that a node is born in the middle of the run and knows nothing before
    """
    dark = {k for k in range(1, steps + 1) if rng.random() < blackout}
    born = {i: int(rng.integers(2, steps // 2 + 2)) if rng.random() < late else 1 for i in neighbours}
    return {
        (i, k): tuple(j for j in members if rng.random() >= loss) if k >= born[i] and k not in dark else ()
        for i, members in neighbours.items()
        for k in range(1, steps + 1)
    }


def _schedule(period: int, make: Callable[[], T], first: int = 0) -> Schedule[T]:
    return Schedule(tuple(make() for _ in range(period)), first, after="hold" if period == 1 else "cycle")


def _dynamics(rng: np.random.Generator, nx: int, radius: float) -> Array:
    """F̄ of that spectral radius whose singular values are within a factor of 2."""
    left, right = (np.linalg.qr(rng.normal(size=(nx, nx)))[0] for _ in range(2))
    F: Array = (left * rng.uniform(0.5, 1.0, nx)) @ right
    F *= radius / np.abs(np.linalg.eigvals(F)).max()
    return F


def _noise(
    rng: np.random.Generator,
    nx: int,
    sizes: Mapping[NodeId, int],
    kind: Noise,
    period: int,
) -> MovingAverageNoise:
    """Private noises for the state and every sensor, and, unless white, a common η.

    w_k = A η_k + B η_{k+1} + ...,  v_k = C η_{k-1} + D η_k + ...: with the private noises' own lags, all of
    Q_{k,k-1}, R_{k,k-1}, S_k, S_{k,k+1}, S_{k,k+2} differ from zero.
    """
    common = int(rng.integers(1, 3))

    def tap(source: str, lag: int, rows: int, scale: float) -> Tap:
        columns = white[source].size
        return Tap(source, lag, _schedule(period, lambda: scale * rng.normal(size=(rows, columns))))

    def private(source: str, n: int, lag: int) -> tuple[Tap, ...]:
        own = Tap(source, 0, _schedule(period, lambda: np.diag(rng.uniform(0.7, 1.3, n))))
        return (own,) if kind == "white" else (own, tap(source, lag, n, 0.4))

    def shared(n: int, lags: tuple[int, int]) -> tuple[Tap, ...]:
        return () if kind == "white" else tuple(tap("eta", lag, n, 0.6) for lag in lags)

    white = {"state": WhiteNoise(random_covariance(rng, nx))}
    white |= {f"sensor {i}": WhiteNoise(random_covariance(rng, n)) for i, n in sizes.items()}
    if kind != "white":
        white["eta"] = WhiteNoise(random_covariance(rng, common))
    return MovingAverageNoise(
        white=white,
        process=(*private("state", nx, 1), *shared(nx, (0, 1))),
        sensors={i: (*private(f"sensor {i}", n, -1), *shared(n, (-1, 0))) for i, n in sizes.items()},
    )
