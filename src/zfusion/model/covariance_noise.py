"""Noises of which nothing but the covariances is known."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import chain, islice
from math import inf
from typing import NamedTuple

import numpy as np

from zfusion.errors import RunError
from zfusion.model.banded import SLACK, Indefinite, RootRow, root_rows, spectral_floor
from zfusion.model.checks import ModelError, covariance_matrix
from zfusion.model.matrices import Schedule
from zfusion.model.noise_model import NoiseCovariances, NoiseModel, checked_schedule
from zfusion.model.streams import BLOCK, Recent, Seeds
from zfusion.model.types import Array, NodeId, sorted_ids

FACTORED_STEPS = 64
"""Steps beyond the first period for which covariances that vary with time must prove to be legal."""

Pair = tuple[NodeId, NodeId]
BySensor = Mapping[NodeId, Schedule[Array]]
ByPair = Mapping[Pair, Schedule[Array]]


class Component(NamedTuple):
    """Noises that are uncorrelated with all others, and cannot be divided further."""

    process: bool
    """Whether w is among them."""
    ids: tuple[NodeId, ...]
    """The sensors whose noise is among them."""

    @property
    def name(self) -> str:
        """Unique among the components of one model."""
        return "process" if self.process else f"sensor/{self.ids[0]}"


class Partner(NamedTuple):
    """The other of a pair of sensors, and the covariance with it."""

    id: NodeId
    schedule: Schedule[Array]
    transposed: bool


@dataclass(frozen=True, eq=False)
class CovarianceNoise(NoiseModel):
    """The noises by their covariances alone; drawn, they are Gaussian. What is not given is zero.

    Q_k = Cov[w_k, w_k], Q1_k = Cov[w_k, w_{k-1}];  R[i,j]_k = Cov[v^i_k, v^j_k], with all (i, i), and (i, j) in one
    order only;  R1[i,j]_k = Cov[v^i_k, v^j_{k-1}], where (i, j) and (j, i) are two things;  S0[i]_k, S1[i]_k,
    S2[i]_k = Cov[w_k, v^i_k], Cov[w_k, v^i_{k+1}], Cov[w_k, v^i_{k+2}].  All schedules begin at step 0.

    ModelError unless shapes agree and all noises at all steps together have a positive semi-definite covariance.
    """

    Q: Schedule[Array]
    R: ByPair
    Q1: Schedule[Array] | None = None
    R1: ByPair = field(default_factory=dict)
    S0: BySensor = field(default_factory=dict)
    S1: BySensor = field(default_factory=dict)
    S2: BySensor = field(default_factory=dict)
    _settled: dict[tuple[NodeId, ...], NoiseCovariances] = field(default_factory=dict, init=False, repr=False)
    _roots: dict[Component, _RootBlocks] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "Q", _checked_covariance("Q", self.Q))
        variances = {(i, j): _checked_covariance(f"R[{i!r}, {j!r}]", s) for (i, j), s in self.R.items() if i == j}
        object.__setattr__(self, "R", {**self.R, **variances})
        checked = {
            "Q1": self.Q1 and checked_schedule("Q1", self.Q1, (self.nx, self.nx)),
            "R": {pair: self._checked_pair("R", pair, s) for pair, s in self.R.items()},
            "R1": {pair: self._checked_pair("R1", pair, s) for pair, s in self.R1.items()},
            "S0": {i: self._checked_sensor("S0", i, s) for i, s in self.S0.items()},
            "S1": {i: self._checked_sensor("S1", i, s) for i, s in self.S1.items()},
            "S2": {i: self._checked_sensor("S2", i, s) for i, s in self.S2.items()},
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for component in self.components:
            self._check_definite(component)

    @property
    def nx(self) -> int:
        """Size of w_k."""
        return len(self.Q.items[0])

    @cached_property
    def sizes(self) -> Mapping[NodeId, int]:
        """Size of v^i_k for each sensor, sorted by id."""
        return {i: len(self.R[i, i].items[0]) for i in sorted_ids({i for i, j in self.R if i == j})}

    @property
    def schedules(self) -> list[Schedule[Array]]:
        """All covariances."""
        given = [self.Q] if self.Q1 is None else [self.Q, self.Q1]
        return given + [s for group in (self.R, self.R1, self.S0, self.S1, self.S2) for s in group.values()]

    def sampler(self, seeds: Seeds) -> CovarianceSampler:
        """What draws these noises."""
        return CovarianceSampler(self, seeds)

    def _covariances(self, k: int, ids: tuple[NodeId, ...]) -> NoiseCovariances:
        rows, ny = self.rows(ids)
        Q = np.array(self.Q.at(k))
        Q1 = np.zeros_like(Q) if self.Q1 is None else np.array(self.Q1.at(k))
        R, R1 = np.zeros((ny, ny)), np.zeros((ny, ny))
        for total, partners in ((R, self._partners), (R1, self._partners_before)):
            for i in ids:
                for j, schedule, transposed in partners[i]:
                    if j in rows:
                        block = schedule.at(k)
                        total[rows[i], rows[j]] = block.T if transposed else block
        cross = [np.zeros((self.nx, ny)) for _ in range(3)]
        for total, given in zip(cross, (self.S0, self.S1, self.S2), strict=True):
            for i in ids:
                if i in given:
                    total[:, rows[i]] = given[i].at(k)
        return NoiseCovariances(Q, Q1, R, R1, *cross)

    @cached_property
    def _partners(self) -> dict[NodeId, list[Partner]]:
        """For each i, the j with a Cov[v^i_k, v^j_k], in whichever order it was given."""
        partners: dict[NodeId, list[Partner]] = {i: [] for i in self.sizes}
        for (i, j), schedule in self.R.items():
            partners[i].append(Partner(j, schedule, False))
            if i != j:
                partners[j].append(Partner(i, schedule, True))
        return partners

    @cached_property
    def _partners_before(self) -> dict[NodeId, list[Partner]]:
        """For each i, the j with a Cov[v^i_k, v^j_{k-1}]."""
        partners: dict[NodeId, list[Partner]] = {i: [] for i in self.sizes}
        for (i, j), schedule in self.R1.items():
            partners[i].append(Partner(j, schedule, False))
        return partners

    @cached_property
    def components(self) -> list[Component]:
        """The noises in groups that are uncorrelated with one another; that of w first."""
        linked: dict[NodeId | None, set[NodeId | None]] = defaultdict(set)  # None stands for w
        pairs = [pair for group in (self.R, self.R1) for pair, s in group.items() if _occurs(s)]
        pairs_with_w = [(None, i) for group in (self.S0, self.S1, self.S2) for i, s in group.items() if _occurs(s)]
        for i, j in [*pairs, *pairs_with_w]:
            linked[i].add(j)
            linked[j].add(i)
        seen: set[NodeId | None] = set()
        components = []
        for start in (None, *self.sizes):
            if start in seen:
                continue
            group = _reached(start, linked)
            seen |= group
            components.append(Component(None in group, tuple(i for i in self.sizes if i in group)))
        return components

    def blocks(self, component: Component, k: int) -> tuple[Array, Array]:
        """Γ0_k = Cov[z_k, z_k] and Γ1_k = Cov[z_k, z_{k-1}] of the component's part of z_k = (w_{k-1}; v_k), k >= 1.

        Paired like this, nothing is correlated more than one step apart. Γ1_1 is without meaning.
        """
        now, before = self.covariances(k, component.ids), self.covariances(k - 1, component.ids)
        earlier = self.covariances(max(k - 2, 0), component.ids)
        G0 = np.block([[before.Q, before.S1], [before.S1.T, now.R]])
        G1 = np.block([[before.Q1, before.S0], [earlier.S2.T, now.R1]])
        return (G0, G1) if component.process else (G0[self.nx :, self.nx :], G1[self.nx :, self.nx :])

    def root_rows(self, component: Component) -> Iterator[RootRow]:
        """Rows k = 1, 2, ... of a square root of the joint covariance of all z_k; raises Indefinite."""
        constant = None if self.constant_from is None else self.constant_from + 2
        return root_rows(partial(self.blocks, component), constant)

    def root(self, component: Component) -> _RootBlocks:
        """The same by blocks of steps, made as they are asked for; one for all samplers."""
        if component not in self._roots:
            size = sum(self.sizes[i] for i in component.ids) + (self.nx if component.process else 0)
            self._roots[component] = _RootBlocks(partial(self.root_rows, component), size)
        return self._roots[component]

    def _checked_pair(self, name: str, pair: Pair, schedule: Schedule[Array]) -> Schedule[Array]:
        where = f"{name}[{pair[0]!r}, {pair[1]!r}]"
        for i in pair:
            if i not in self.sizes:
                raise ModelError(where, i, f"expected sensors with an R[i, i]: {list(self.sizes)}")
        if name == "R" and pair[0] != pair[1] and pair[::-1] in self.R:
            raise ModelError(where, pair, "expected each pair in one order only")
        return checked_schedule(where, schedule, (self.sizes[pair[0]], self.sizes[pair[1]]))

    def _checked_sensor(self, name: str, i: NodeId, schedule: Schedule[Array]) -> Schedule[Array]:
        if i not in self.sizes:
            raise ModelError(f"{name}[{i!r}]", i, f"expected a sensor with an R[i, i]: {list(self.sizes)}")
        return checked_schedule(f"{name}[{i!r}]", schedule, (self.nx, self.sizes[i]))

    def _check_definite(self, component: Component) -> None:
        members = ", ".join((["w"] if component.process else []) + [f"v^{i}" for i in component.ids])
        expected = f"expected a positive semi-definite joint covariance of {members} over all steps"
        if self.constant_from is not None:
            floor = spectral_floor(*self.blocks(component, self.constant_from + 2))
            if floor < -SLACK:
                raise ModelError("noise", floor, f"{expected}; this is its spectral density's lowest eigenvalue")
        if self.constant_from != 0:
            self._check_first_rows(component, expected)

    def _check_first_rows(self, component: Component, expected: str) -> None:
        rows = self.root_rows(component)
        try:
            for _ in range(self.repeats_after + FACTORED_STEPS):
                next(rows)
        except Indefinite as reason:
            raise ModelError("noise", str(reason), expected) from None


class _RootBlocks:
    """A square root of one component's joint covariance by blocks of steps, k = 0 with a row of zeros.

    It is the same for all seeds. Going far back means to begin again.
    """

    def __init__(self, rows: Callable[[], Iterator[RootRow]], size: int) -> None:
        self._begin = rows
        self.size = size
        self._rows: Iterator[RootRow] = iter(())
        self._next: float = inf
        """The block that `_rows` comes to next."""
        self.block = Recent(self._make)
        """The rows of a block's steps: A and B are (BLOCK, n, n), or (n, n) where all are the same."""

    def _make(self, block: int) -> RootRow:
        if block < self._next:
            zero = np.zeros((self.size, self.size))
            self._rows = chain([RootRow(zero, zero)], self._begin())
            self._next = 0
        skipped = (block - int(self._next)) * BLOCK
        self._next = block + 1
        try:
            rows = list(islice(self._rows, skipped, skipped + BLOCK))
        except Indefinite as reason:
            self._next = inf
            raise RunError(f"the covariances of the noises contradict one another: {reason}") from None
        if rows[0] is rows[-1]:
            return rows[0]
        return RootRow(np.array([row.A for row in rows]), np.array([row.B for row in rows]))


class CovarianceSampler:
    """Draws the noises of one component after the other, as they are asked for."""

    def __init__(self, noise: CovarianceNoise, seeds: Seeds) -> None:
        self._nx = noise.nx
        self._sequences: dict[NodeId | None, Recent[Array]] = {}  # None stands for w
        self._rows: dict[NodeId, slice] = {}
        for component in noise.components:
            sequence = Recent(_Sequence(component, noise.root(component), seeds).values)
            start = 0
            if component.process:
                self._sequences[None] = sequence
                start = noise.nx
            for i in component.ids:
                self._sequences[i] = sequence
                self._rows[i] = slice(start, start + noise.sizes[i])
                start += noise.sizes[i]

    def process(self, block: int) -> Array:
        """w_{k-1} for the steps k of the block, (BLOCK, nx)."""
        return self._sequences[None](block)[:, : self._nx]

    def sensor(self, i: NodeId, block: int) -> Array:
        """v^i_k for the steps k of the block, (BLOCK, ny_i)."""
        return self._sequences[i](block)[:, self._rows[i]]


class _Sequence:
    """The z_k of one component, all of it together: z_k = A_k u_k + B_k u_{k-1}, with white Gaussian u_k."""

    def __init__(self, component: Component, root: _RootBlocks, seeds: Seeds) -> None:
        self._name = component.name
        self._root = root
        self._seeds = seeds
        self._white = Recent(self._draw)

    def values(self, block: int) -> Array:
        """z_k for the steps k of a block, (BLOCK, n)."""
        A, B = self._root.block(block)
        now = self._white(block)
        before = np.concatenate([self._white(block - 1)[-1:], now[:-1]])
        if A.ndim == 2:
            return now @ A.T + before @ B.T
        values: Array = np.einsum("kij,kj->ki", A, now) + np.einsum("kij,kj->ki", B, before)
        return values

    def _draw(self, block: int) -> Array:
        size = self._root.size
        return self._seeds.generator("noise", self._name, block=block).standard_normal((BLOCK, size))


def _checked_covariance(where: str, schedule: Schedule[Array]) -> Schedule[Array]:
    checked = checked_schedule(where, schedule, (None, None))
    for n, item in enumerate(checked.items):
        covariance_matrix(where if len(checked.items) == 1 else f"{where}[{n}]", item)
    return checked


def _occurs(schedule: Schedule[Array]) -> bool:
    return any(item.any() for item in schedule.items)


def _reached(start: NodeId | None, linked: Mapping[NodeId | None, set[NodeId | None]]) -> set[NodeId | None]:
    reached, frontier = {start}, [start]
    while frontier:
        new = linked.get(frontier.pop(), set()) - reached
        reached |= new
        frontier.extend(new)
    return reached
