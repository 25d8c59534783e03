"""Who receives from whom: a directed graph on the sensors, whatever it was made from.

    a_ij > 0   node i receives from node j;   a_ii > 0 always
    N_i = {j : a_ij > 0}                      node i's closed neighbourhood, sorted by id

Everything here costs O(nodes + edges): a node asks for its neighbours, never for an m x m matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from math import ceil, isfinite, sqrt

import numpy as np

from zfusion.model.types import Array, NodeId, sorted_ids

Edge = tuple[NodeId, NodeId]
"""(from, to): the second node receives from the first."""

MAX_PAIRING_ATTEMPTS = 1000
"""A random pairing of a feasible degree succeeds within a few attempts; this only bounds the unlucky."""


@dataclass(frozen=True)
class Network:
    """A directed graph: `neighbourhoods` maps every node to its sorted N_i, the node itself included.

    `weights` holds the a_ij that are not 1, by (i, j). Most users build one with `from_matrix`,
    `from_edges` or a generator, which refuse what is not a graph; the constructor itself checks nothing.
    """

    neighbourhoods: Mapping[NodeId, tuple[NodeId, ...]]
    weights: Mapping[tuple[NodeId, NodeId], float]

    @classmethod
    def from_matrix(cls, ids: Iterable[NodeId], matrix: Sequence[Sequence[float]]) -> Network:
        """The graph of the adjacency matrix (a_ij), rows and columns in the order of `ids`.

        Raises ValueError unless it is square, finite, non-negative and has a positive diagonal.
        """
        ids = tuple(ids)
        for at, fault in matrix_faults(len(ids), matrix):
            raise ValueError(f"adjacency matrix, entry {list(at)}: {fault}" if at else f"adjacency matrix: {fault}")
        sources: dict[NodeId, list[NodeId]] = {}
        weights: dict[tuple[NodeId, NodeId], float] = {}
        for i, row in zip(ids, matrix, strict=True):
            sources[i] = [j for j, a in zip(ids, row, strict=True) if a > 0]
            weights |= {(i, j): float(a) for j, a in zip(ids, row, strict=True) if a > 0 and a != 1}
        return cls(_sorted(sources), weights)

    @classmethod
    def from_edges(cls, ids: Iterable[NodeId], edges: Iterable[Edge], undirected: bool = False) -> Network:
        """The graph with an arrow from -> to for each edge, and back again if `undirected`.

        Raises ValueError where an edge joins a node to itself, to an unknown node, or is there twice.
        """
        ids, edges = tuple(ids), tuple(edges)
        for index, fault in edge_faults(ids, edges, undirected):
            raise ValueError(f"edge {index}: {fault}")
        sources: dict[NodeId, list[NodeId]] = {i: [i] for i in ids}
        for sender, receiver in edges:
            sources[receiver].append(sender)
            if undirected:
                sources[sender].append(receiver)
        return cls(_sorted(sources), {})

    @classmethod
    def complete(cls, ids: Iterable[NodeId]) -> Network:
        """Everybody receives from everybody; the centralised estimate."""
        everybody = tuple(sorted_ids(ids))
        return cls(dict.fromkeys(everybody, everybody), {})

    @classmethod
    def isolated(cls, ids: Iterable[NodeId]) -> Network:
        """Nobody receives from anybody else; the local estimates."""
        return cls(_sorted({i: [i] for i in ids}), {})

    @classmethod
    def ring(cls, ids: Iterable[NodeId], reach: int = 1, directed: bool = False) -> Network:
        """Each node sends to the next `reach` nodes round the ring, and, unless `directed`, hears them too."""
        ids = tuple(sorted_ids(ids))
        edges = {(ids[i], ids[(i + step) % len(ids)]) for i in range(len(ids)) for step in range(1, reach + 1)}
        return cls._of_pairs(ids, edges, directed)

    @classmethod
    def line(cls, ids: Iterable[NodeId], directed: bool = False) -> Network:
        """Each node sends to the next one, and, unless `directed`, hears it too."""
        ids = tuple(sorted_ids(ids))
        return cls._of_pairs(ids, pairwise(ids), directed)

    @classmethod
    def star(cls, ids: Iterable[NodeId], hub: NodeId | None = None) -> Network:
        """The hub (by default the first node) and every other node hear each other."""
        ids = tuple(sorted_ids(ids))
        centre = ids[0] if hub is None else hub
        if centre not in ids:
            raise ValueError(f"the hub {centre!r} is not a node")
        return cls._of_pairs(ids, ((centre, i) for i in ids))

    @classmethod
    def grid(cls, ids: Iterable[NodeId], columns: int | None = None) -> Network:
        """Row by row on a grid (by default as square as can be); each hears those above, below and beside."""
        ids = tuple(sorted_ids(ids))
        width = ceil(sqrt(len(ids))) if columns is None else columns
        beside = ((a, b) for n, (a, b) in enumerate(pairwise(ids), 1) if n % width)
        return cls._of_pairs(ids, [*beside, *zip(ids, ids[width:], strict=False)])

    @classmethod
    def random_geometric(cls, ids: Iterable[NodeId], radius: float, seed: int) -> Network:
        """Nodes at random in the unit square; those at most `radius` apart hear each other."""
        ids = tuple(sorted_ids(ids))
        points = points_in_square(len(ids), seed)
        edges = []
        for i, point in enumerate(points):
            near = np.flatnonzero(((points[i + 1 :] - point) ** 2).sum(axis=1) <= radius**2)
            edges += [(ids[i], ids[i + 1 + int(j)]) for j in near]
        return cls._of_pairs(ids, edges)

    @classmethod
    def random_regular(cls, ids: Iterable[NodeId], degree: int, seed: int) -> Network:
        """An undirected graph drawn at random in which every node has exactly `degree` others.

        Raises ValueError unless 0 <= degree < m and m * degree is even.
        """
        ids = tuple(sorted_ids(ids))
        return cls._of_pairs(ids, ((ids[i], ids[j]) for i, j in _random_pairing(len(ids), degree, seed)))

    @classmethod
    def _of_pairs(cls, ids: Sequence[NodeId], pairs: Iterable[Edge], directed: bool = False) -> Network:
        """From pairs that may repeat or join a node to itself: what a generator makes on small graphs."""
        sources: dict[NodeId, set[NodeId]] = {i: {i} for i in ids}
        for sender, receiver in pairs:
            sources[receiver].add(sender)
            if not directed:
                sources[sender].add(receiver)
        return cls(_sorted(sources), {})

    @cached_property
    def ids(self) -> tuple[NodeId, ...]:
        """All nodes, sorted."""
        return tuple(self.neighbourhoods)

    def neighbours(self, i: NodeId) -> tuple[NodeId, ...]:
        """N_i: the nodes that i receives from and i itself, sorted."""
        return self.neighbourhoods[i]

    def listeners(self, i: NodeId) -> tuple[NodeId, ...]:
        """The nodes that receive from i, sorted, without i."""
        return self._listeners[i]

    def two_hop(self, i: NodeId) -> tuple[NodeId, ...]:
        """The union of N_l over l in N_i, sorted: the sensors whose statistics node i needs."""
        reached = {j for near in self.neighbours(i) for j in self.neighbours(near)}
        return tuple(sorted_ids(reached))

    def links(self) -> tuple[tuple[NodeId, NodeId], ...]:
        """The pairs (a, b), a < b, of which one receives from the other: one connection each."""
        if all(len(near) == len(self.ids) for near in self.neighbourhoods.values()):
            return tuple(combinations(self.ids, 2))
        rank = {i: n for n, i in enumerate(self.ids)}
        pairs = {
            (min(rank[i], rank[j]), max(rank[i], rank[j]))
            for i, near in self.neighbourhoods.items()
            for j in near
            if i != j
        }
        return tuple((self.ids[a], self.ids[b]) for a, b in sorted(pairs))

    def weight(self, i: NodeId, j: NodeId) -> float:
        """a_ij: 0 if i does not receive from j, 1 unless the adjacency matrix says otherwise."""
        return self.weights.get((i, j), 1.0) if j in self.neighbourhoods[i] else 0.0

    def matrix(self) -> Array:
        """The adjacency matrix (a_ij), rows and columns in the order of `ids`, (m, m)."""
        rank = {i: n for n, i in enumerate(self.ids)}
        a = np.zeros((len(rank), len(rank)))
        for i, near in self.neighbourhoods.items():
            a[rank[i], [rank[j] for j in near]] = 1.0
        for (i, j), weight in self.weights.items():
            a[rank[i], rank[j]] = weight
        return a

    def relabelled(self, new_id: Mapping[NodeId, NodeId]) -> Network:
        """The same graph under other names, `new_id[old]`, which must differ from each other."""
        if len({new_id[i] for i in self.ids}) != len(self.ids):
            raise ValueError("the new ids must differ from each other")
        sources = {new_id[i]: [new_id[j] for j in near] for i, near in self.neighbourhoods.items()}
        return Network(_sorted(sources), {(new_id[i], new_id[j]): a for (i, j), a in self.weights.items()})

    @cached_property
    def _listeners(self) -> dict[NodeId, tuple[NodeId, ...]]:
        receivers: dict[NodeId, list[NodeId]] = {i: [] for i in self.ids}
        for i, near in self.neighbourhoods.items():
            for j in near:
                if i != j:
                    receivers[j].append(i)
        return {i: tuple(them) for i, them in receivers.items()}


def points_in_square(count: int, seed: int) -> Array:
    """Where `random_geometric` puts its nodes, in the order of their ids: points in the unit square, (count, 2)."""
    return np.random.default_rng(seed).random((count, 2))


def matrix_faults(size: int, matrix: Sequence[Sequence[float]]) -> Iterator[tuple[tuple[()] | tuple[int, int], str]]:
    """What keeps `matrix` from being the adjacency of `size` nodes: pairs of (indices of the entry, why)."""
    if len(matrix) != size or any(len(row) != size for row in matrix):
        columns = "/".join(str(n) for n in sorted({len(row) for row in matrix}))
        yield (), f"expected {size} x {size}, a row and a column for each node, not {len(matrix)} x {columns}"
        return
    for i, row in enumerate(matrix):
        for j, a in enumerate(row):
            if not isfinite(a) or a < 0:
                yield (i, j), "expected 0 or a positive number"
            elif i == j and a == 0:
                yield (i, j), "expected a_ii > 0: every node uses its own measurement"


def edge_faults(ids: Iterable[NodeId], edges: Iterable[Edge], undirected: bool = False) -> Iterator[tuple[int, str]]:
    """What is wrong with a list of edges: pairs of (index of the edge, why)."""
    known, seen = set(ids), set[Edge]()
    for index, (sender, receiver) in enumerate(edges):
        unknown = [end for end in (sender, receiver) if end not in known]
        if unknown:
            yield index, f"there is no node {unknown[0]!r}"
        elif sender == receiver:
            yield index, "expected two different nodes; every node uses its own measurement anyway"
        elif (sender, receiver) in seen or (undirected and (receiver, sender) in seen):
            yield index, "expected each edge once only"
        seen.add((sender, receiver))


def _sorted(sources: Mapping[NodeId, Iterable[NodeId]]) -> dict[NodeId, tuple[NodeId, ...]]:
    return {i: tuple(sorted_ids(sources[i])) for i in sorted_ids(sources)}


def _random_pairing(size: int, degree: int, seed: int) -> set[tuple[int, int]]:
    """The edges of a random `degree`-regular graph on 0..size-1: Steger and Wormald's pairing of stubs.

    A. Steger, N. C. Wormald, Generating random regular graphs quickly, Combinatorics, Probability and
    Computing 8 (1999) 377-396.
    """
    if not 0 <= degree < size or size * degree % 2:
        raise ValueError(f"no graph of {size} nodes has degree {degree}: it must be below {size}, their product even")
    rng = np.random.default_rng(seed)
    for _ in range(MAX_PAIRING_ATTEMPTS):
        edges = _try_pairing(size, degree, rng)
        if edges is not None:
            return edges
    raise ValueError(f"no {degree}-regular graph of {size} nodes found with seed {seed}; try another")


def _try_pairing(size: int, degree: int, rng: np.random.Generator) -> set[tuple[int, int]] | None:
    """One attempt: pair the stubs at random, keep the legal pairs, pair the rest again until none is left."""
    edges: set[tuple[int, int]] = set()
    stubs = np.repeat(np.arange(size), degree)
    while stubs.size:
        rng.shuffle(stubs)
        left: list[int] = []
        before = len(edges)
        for a, b in stubs.reshape(-1, 2).tolist():
            edge = (min(a, b), max(a, b))
            if a == b or edge in edges:
                left += edge
            else:
                edges.add(edge)
        if len(edges) == before and _stuck(left, edges):
            return None
        stubs = np.array(left, dtype=int)
    return edges


def _stuck(stubs: Sequence[int], edges: set[tuple[int, int]]) -> bool:
    """Whether no two of the nodes that still have stubs could be joined."""
    return all(pair in edges for pair in combinations(sorted(set(stubs)), 2))
