"""The error covariances of one network under many fates of its messages, side by side.

Nothing in the filters' covariances depends on data: only on the model and on who used what. So each *fate*, the used
sets of all nodes in one realisation of a random network, has covariances of its own, and many fates at once are just a
larger network: many copies of it, and no pair of nodes across copies. One pass of the recursion serves all of them.

Source: the modules `covariances` and `fusion`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zfusion.methods.covariances import State, advance, forget, prior
from zfusion.methods.fusion import fusion_weights
from zfusion.methods.layout import Blocks, Bools, ByClass, Ints, Layout, Used
from zfusion.methods.prediction import RECYCLED_BYTES
from zfusion.model.statistics import PriorMoments, StepModel
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId, sorted_ids

Entry = TypeVar("Entry", bound=np.generic)

NUMBERS = 1 << 20
"""Numbers in the largest array of one pass, 8 MB: with more, the copies are no faster."""

FEWEST = 2
"""Copies that are made: where the matrices of two stand tells where those of all others do."""


class Arcs:
    """All pairs (receiver, sender) of a network in one order, each node with itself included.

    Who used what in one step is a row of truth values over them.
    """

    def __init__(self, neighbourhoods: Mapping[NodeId, Collection[NodeId]]) -> None:
        self.pairs = tuple((i, j) for i in sorted_ids(neighbourhoods) for j in sorted_ids(neighbourhoods[i]))
        """By receiver, then by sender."""
        self.place: Mapping[tuple[NodeId, NodeId], int] = {pair: at for at, pair in enumerate(self.pairs)}
        """Where each pair stands."""
        self.own: Bools = np.array([i == j for i, j in self.pairs])
        """Which of them are a node with itself."""

    def __len__(self) -> int:
        return len(self.pairs)


class Known(NamedTuple):
    """What the nodes of an ensemble know of the data."""

    x: Array
    """Intermediate estimates, (copies, m, nx)."""
    innovations: ByClass
    """Those of the last step at all slots, used or not, (n, size) for each class."""

    def copied(self, source: int, targets: Sequence[int]) -> Known:
        """As `Ensemble.copy`."""
        copies = len(self.x)

        def moved(array: Array) -> Array:
            by_copy = array.copy().reshape(copies, -1)
            by_copy[list(targets)] = by_copy[source]
            return by_copy.reshape(array.shape)

        return Known(moved(self.x), tuple(map(moved, self.innovations)))


class Ensemble:
    """The filters of a network in several copies, each with used sets of its own; the state is that of one step."""

    def __init__(
        self,
        system: System,
        neighbourhoods: Mapping[NodeId, Collection[NodeId]],
        copies: int,
        fusing: Collection[NodeId] = (),
    ) -> None:
        """At step 0. `neighbourhoods` are those of the nodes that are followed; `fusing`, those of them whose
        stage 2 is asked for: all their neighbours must be among the followed."""
        np.empty(RECYCLED_BYTES, dtype=np.uint8)  # and free it: see there
        self.copies, self.nodes, self.fusing = copies, tuple(sorted_ids(neighbourhoods)), tuple(sorted_ids(fusing))
        self.arcs = Arcs(neighbourhoods)
        """The order of used sets."""
        m = len(self.nodes)
        made = max(copies, FEWEST)
        rank = {i: at for at, i in enumerate(self.nodes)}
        near: dict[NodeId, Collection[NodeId]] = {
            c * m + rank[i]: neighbourhoods[i] for c in range(made) for i in self.nodes
        }
        pairs = {(rank[a], rank[b]) for i in self.fusing for a, b in combinations(sorted_ids(neighbourhoods[i]), 2)}
        sizes = {sensor.id: sensor.ny for sensor in system.sensors}
        self._layout = Layout.build(
            near, sizes, ((c * m + a, c * m + b) for c in range(made) for a, b in sorted(pairs))
        )
        self.state: State = prior(self._layout, system.initial_covariance)
        """May be kept, and put back later."""
        self._shape = (made, m, system.nx, system.nx)
        self._rows = [np.array(_numbers(c.members), dtype=np.intp) for c in self._layout.classes]
        self._order = np.argsort(np.concatenate(self._rows))
        self._slots = [self._arcs_of_slots(number) for number in range(len(self._layout.classes))]
        self._fusions = self._stage_2(neighbourhoods)

    def advance(self, model: StepModel, used: Bools) -> None:
        """To the next step, given whose measurements each node used in it, (copies, arcs)."""
        flat = np.pad(self._filled(used), ((0, 0), (0, 1))).reshape(-1)
        mask: Used = tuple([flat.take(arcs) for arcs in self._slots])
        self.state = advance(self._layout, self.state, model, mask)

    def forget(self, begins: Bools, moments: PriorMoments) -> None:
        """Some nodes, (copies, m), begin anew: they know nothing but the prior of the present step."""
        copy, position = np.nonzero(self._filled(begins))
        nodes = frozenset((copy * self._shape[1] + position).tolist())
        self.state = forget(self._layout, self.state, nodes, moments.covariance)

    @property
    def intermediate(self) -> Array:
        """P^(ll) of all nodes, (copies, m, nx, nx)."""
        own = self._layout.own(self.state.P)
        rows = own[0] if len(own) == 1 else np.concatenate(own)[self._order]
        return rows.reshape(self._shape)[: self.copies]

    def fused(self, told: Bools, moments: PriorMoments) -> Array:
        """Σ^i of the fusing nodes, (copies, fusing, nx, nx), given whose estimates each has, (copies, arcs)."""
        made, _, nx, _ = self._shape
        fused = np.empty((made, len(self.fusing), nx, nx))
        flat = self.state.P.flat
        told = self._filled(told)
        for fusion in self._fusions:
            fused[:, fusion.positions] = fusion_weights(flat.take(fusion.where(told)), moments.covariance)[1]
        return fused[: self.copies]

    def copy(self, source: int, targets: Sequence[int]) -> None:
        """Let the filters of some copies stand where those of another one do."""
        made, state = self._shape[0], self.state
        to = np.asarray(targets, dtype=np.intp)

        def copied(array: NDArray[Entry]) -> NDArray[Entry]:
            by_copy = array.copy().reshape(made, -1, *array.shape[1:])
            by_copy[to] = by_copy[source]
            return by_copy.reshape(array.shape)

        P, E, Pi = (Blocks(map(copied, blocks.arrays)) for blocks in (state.P, state.E, state.Pi))
        X, A, K = (tuple(map(copied, arrays)) for arrays in (state.X, state.A, state.K))
        used = tuple(map(copied, state.used))
        self.state = state._replace(P=P, E=E, Pi=Pi, X=X, A=A, K=K, used=used, settled=False)

    def start(self, mean: Array) -> Known:
        """What all nodes know of the data at step 0, given E[x_0], (nx,)."""
        made, m, *_ = self._shape
        innovations = tuple(np.zeros(c.slots.shape) for c in self._layout.classes)
        return Known(np.tile(mean, (made, m, 1)), innovations)

    def filtered(self, known: Known, Y: Array) -> Known:
        """The intermediate estimates of the step that was advanced to, given all its measurements, stacked (ny,).

        x̂_{k/k-1} = F x̂ + WA μ_{k-1};  μ_k = Z_k - H x̂_{k/k-1} - T μ_{k-1};  x̂_{k/k} = x̂_{k/k-1} + K μ_k.
        """
        made, m, nx, _ = self._shape
        assert self.state.gains is not None  # advance has set them
        x = known.x.reshape(made * m, nx)
        estimates, innovations = np.empty_like(x), []
        for c, rows, g, before in zip(
            self._layout.classes, self._rows, self.state.gains, known.innovations, strict=True
        ):
            predicted = x[rows] @ g.F.T + (g.WA @ before[:, :, None])[:, :, 0]
            told = (g.H @ predicted[:, :, None] + g.T @ before[:, :, None])[:, :, 0]
            innovation = Y[c.slots] - told
            estimates[rows] = predicted + (g.K @ innovation[:, :, None])[:, :, 0]
            innovations.append(innovation)
        return Known(estimates.reshape(made, m, nx), tuple(innovations))

    def fused_estimates(self, told: Bools, moments: PriorMoments, known: Known) -> Array:
        """x̂^i of the fusing nodes, (copies, fusing, nx), as for `fused`."""
        fused = np.empty((self._shape[0], len(self.fusing), self._shape[-1]))
        flat = self.state.P.flat
        told = self._filled(told)
        for fusion in self._fusions:
            weights, _ = fusion_weights(flat.take(fusion.where(told)), moments.covariance)
            own, others = known.x[:, fusion.own], known.x[:, fusion.others]
            prior_mean = np.broadcast_to(moments.mean, own.shape)[:, :, None]
            z = np.concatenate((prior_mean, others), axis=2) - own[:, :, None]
            size = z.shape[2] * z.shape[3]
            fused[:, fusion.positions] = own + (weights @ z.reshape(*z.shape[:2], size, 1))[..., 0]
        return fused[: self.copies]

    def _filled(self, by_copy: Bools) -> Bools:
        """The last copy again where there are fewer than are made."""
        missing = self._shape[0] - self.copies
        return np.concatenate((by_copy, by_copy[-1:].repeat(missing, axis=0))) if missing else by_copy

    def _arcs_of_slots(self, number: int) -> Ints:
        """For each node and slot of a class: where its arc stands among (copies, arcs + 1); the last one at padding."""
        c, width, m = self._layout.classes[number], len(self.arcs) + 1, len(self.nodes)
        place = self.arcs.place
        rows = [
            [
                node // m * width + (width - 1 if sensor is None else place[self.nodes[node % m], sensor])
                for sensor in sensors
            ]
            for node, sensors in zip(_numbers(c.members), c.sensor, strict=True)
        ]
        return np.array(rows, dtype=np.intp).reshape(c.slots.shape)

    def _stage_2(self, neighbourhoods: Mapping[NodeId, Collection[NodeId]]) -> list[_Fusion]:
        m, nx = len(self.nodes), self._shape[-1]
        rank = {i: at for at, i in enumerate(self.nodes)}
        by_degree: dict[int, list[int]] = defaultdict(list)
        for position, i in enumerate(self.fusing):
            by_degree[len(neighbourhoods[i])].append(position)
        fusions = []
        for positions in by_degree.values():
            members = [self.fusing[position] for position in positions]
            others = [[j for j in sorted_ids(neighbourhoods[i]) if j != i] for i in members]
            rows = [[rank[i], *(rank[j] for j in row)] for i, row in zip(members, others, strict=True)]
            first, second = (
                np.array([self._layout.among([c * m + at for at in row], nx) for row in rows]) for c in range(FEWEST)
            )
            arcs = [[self.arcs.place[i, j] for j in row] for i, row in zip(members, others, strict=True)]
            fusions.append(_Fusion(positions, np.array(rows), _integers(arcs), first, second))
        return fusions


class _Fusion:
    """Stage 2 at the nodes of one degree, in all copies."""

    def __init__(self, positions: Sequence[int], rows: Ints, arcs: Ints, first: Ints, second: Ints) -> None:
        """`positions` of the nodes among the fusing ones; `rows`, (g, 1 + d): of each and of its neighbours among the
        followed; `arcs`, (g, d): those that bring them their neighbours'
        estimates, by sender; `first` and `second`, (g, 1 + d, 1 + d, nx, nx): where the P^(lj) of the node and
        these neighbours stand in the first copy and in the second."""
        self.positions = list(positions)
        self.own, self.others = rows[:, 0], rows[:, 1:]
        self._arcs, self._first, self._stride = arcs, first, second - first
        c = first.shape[1]
        order = np.array([0, 0, *range(1, c)])  # the prior after the own node
        one, other = np.broadcast_arrays(order[:, None], order)
        self._one, self._other = one.copy(), other.copy()
        self._one[1, :] = self._other[1, :] = order  # P^(0l) = P^(ll)
        self._one[:, 1] = self._other[:, 1] = order
        self._known: tuple[Bools, Ints] | None = None

    def where(self, told: Bools) -> Ints:
        """Where the matrices stand that `fusion_weights` takes, (copies, g, (2 + d) nx, (2 + d) nx).

        In the place of a neighbour that was not heard stands the node itself: its own twin, which has no weight.
        """
        heard = told[:, self._arcs]
        if self._known is not None and np.array_equal(self._known[0], heard):
            return self._known[1]
        copies, g, d = heard.shape
        who = np.zeros((copies, g, 1 + d), dtype=np.intp)
        who[:, :, 1:] = heard * np.arange(1, 1 + d)
        rows, columns = who[:, :, self._one], who[:, :, self._other]
        node = np.arange(g)[:, None, None]
        copy = np.arange(copies)[:, None, None, None, None, None]
        index = self._first[node, rows, columns] + copy * self._stride[node, rows, columns]
        size = index.shape[2] * index.shape[-1]
        joint: Ints = index.swapaxes(3, 4).reshape(copies, g, size, size)
        self._known = heard, joint
        return joint


def copies_at_once(system: System, neighbourhoods: Mapping[NodeId, Collection[NodeId]]) -> int:
    """How many copies one pass should have, so that its largest arrays have about NUMBERS numbers."""
    near = neighbourhoods
    widest, ny = max(map(len, near.values())), max(sensor.ny for sensor in system.sensors)
    company: dict[NodeId, set[NodeId]] = {i: {i} for i in near}
    for row in near.values():
        for j in row:
            if j in company:
                company[j].update(row)
    pairs = len(near) * max(map(len, company.values()))
    largest = max(len(near) * ((1 + widest) * system.nx) ** 2, pairs * (widest * ny) ** 2)
    return max(FEWEST, NUMBERS // largest)


def _integers(rows: Sequence[Sequence[int]]) -> Ints:
    """As an array of two axes, of which the second may be empty."""
    return np.array(rows, dtype=np.intp).reshape(len(rows), -1)


def _numbers(members: Collection[NodeId]) -> list[int]:
    """Virtual nodes are numbers: the copy's times the size of the network, plus the position."""
    return [int(node) for node in members]
