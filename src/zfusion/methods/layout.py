"""How the matrices of many pairs of filters lie in memory, so that few products serve all of them.

Nodes that may use about as many measurements form a *class* and are padded to a common size. The matrices of the
pairs (l, j) of a node l with the nodes of one class stand side by side, in an array (n, rows, r, columns) for the n
nodes of l's class: one product with a matrix of l serves them all. There is one such array, a *block*, for every two
classes. Nearly always there is one class, and one block; a hub that hears a hundred others is a class of its own.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from operator import add, sub

import numpy as np
from numpy.typing import NDArray

from zfusion.model.types import Array, NodeId, sorted_ids

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]

ByClass = tuple[Array, ...]
"""A matrix for each node: an array (n, rows, columns) for each class."""

Used = tuple[Bools, ...]
"""Which slots each node used: (n, size) for each class."""

WASTE = 200_000
"""Numbers of padding in one array that are put up with before nodes are told apart by their size: below that, the
calls cost more than the numbers do."""


class Blocks:
    """A matrix for each pair of nodes: one array (n, rows, r, columns) for every two classes.

    They are megabytes in a large network: `+=` and `-=` change the arrays that are there.
    """

    __slots__ = ("arrays",)

    def __init__(self, arrays: Iterable[Array]) -> None:
        """`arrays` in the order of `Layout.blocks`."""
        self.arrays = tuple(arrays)

    def __add__(self, other: Blocks) -> Blocks:
        return self._with(add, other)

    def __sub__(self, other: Blocks) -> Blocks:
        return self._with(sub, other)

    def __iadd__(self, other: Blocks) -> Blocks:
        for array, more in zip(self.arrays, other.arrays, strict=True):
            np.add(array, more, out=array)
        return self

    def __isub__(self, other: Blocks) -> Blocks:
        for array, less in zip(self.arrays, other.arrays, strict=True):
            np.subtract(array, less, out=array)
        return self

    def __rmul__(self, factor: float) -> Blocks:
        return Blocks([factor * array for array in self.arrays])

    def _with(self, operation: Callable[[Array, Array], Array], other: Blocks) -> Blocks:
        return Blocks(map(operation, self.arrays, other.arrays))

    @property
    def flat(self) -> Array:
        """All entries in a row, as `Layout.among` counts them."""
        rows = [array.reshape(-1) for array in self.arrays]
        return rows[0] if len(rows) == 1 else np.concatenate(rows)

    @property
    def nbytes(self) -> int:
        """What it takes in memory."""
        return sum(array.nbytes for array in self.arrays)


@dataclass(frozen=True, eq=False)
class NodeClass:
    """Nodes that are padded to a common size. A *slot* is one component of one measurement that a node may use."""

    members: tuple[NodeId, ...]
    slots: Ints
    """Row of Y behind each slot, (n, size); 0 at padding."""
    sensor: tuple[tuple[NodeId | None, ...], ...]
    """Sensor behind each slot, (n, size); None at padding."""


@dataclass(frozen=True, eq=False)
class Block:
    """The pairs of the nodes of one class, on the left, with those of another one or the same."""

    left: int
    right: int
    """Numbers of the classes."""
    mirror: int
    """Number of the block of the same pairs the other way round."""
    partners: Ints
    """Positions in the right class of the j that l makes a pair with, (n, r); l itself is its own first one.

    The rest of a short row is its first partner again.
    """
    back: Ints
    """Where l stands among the partners of each of its partners, (n, r)."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Which nodes and pairs are tracked, and where their matrices stand."""

    nodes: tuple[NodeId, ...]
    """All of them, sorted."""
    classes: tuple[NodeClass, ...]
    blocks: tuple[Block, ...]
    ny: int
    """Size of Y, the stack of all measurements."""
    _place: Mapping[NodeId, Mapping[NodeId, int]] = field(repr=False)
    """l -> j -> where j stands among l's partners in the block of their classes."""
    _flips: dict[tuple[int, int, int, int], Ints] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def build(
        cls,
        neighbourhoods: Mapping[NodeId, Collection[NodeId]],
        sizes: Mapping[NodeId, int],
        pairs: Iterable[tuple[NodeId, NodeId]] | None = None,
    ) -> Layout:
        """Layout for the nodes of `neighbourhoods`, their used sets drawn from those neighbourhoods.

        `sizes` gives the measurement size of every sensor in the stack (sorted ids). Without `pairs` all
        pairs of the nodes are tracked; the pairs (l, l) always are.
        """
        nodes = tuple(sorted_ids(neighbourhoods))
        slots = _slots(neighbourhoods, sizes)
        partners = _partners(nodes, pairs)
        groups = _groups({i: len(slots[i]) for i in nodes}, partners)
        for one, other in product(groups, repeat=2):
            _keep_company(partners, one, other)
        blocks, place = _blocks(groups, partners)
        return cls(nodes, tuple(_node_class(group, slots) for group in groups), blocks, sum(sizes.values()), place)

    def used(self, used: Mapping[NodeId, Collection[NodeId]]) -> Used:
        """Which slots each node used, from the ids whose measurements it used; absent = none."""
        nothing: tuple[NodeId, ...] = ()
        masks = []
        for c in self.classes:
            rows = [[s in used.get(i, nothing) for s in row] for i, row in zip(c.members, c.sensor, strict=True)]
            masks.append(np.array(rows, dtype=np.bool_).reshape(c.slots.shape))
        return tuple(masks)

    def own(self, X: Blocks) -> ByClass:
        """The matrices of the pairs (l, l)."""
        step = len(self.classes) + 1
        return tuple([array[:, :, 0] for array in X.arrays[::step]])

    def in_order(self, by_class: ByClass) -> Array:
        """The nodes' matrices in the order of `nodes`, (n, rows, columns); all of one shape."""
        if len(by_class) == 1:
            return by_class[0]
        members = [i for c in self.classes for i in c.members]
        order = sorted(range(len(members)), key=lambda at: members[at])
        return np.concatenate(by_class)[order]

    def among(self, nodes: Sequence[NodeId], nx: int) -> Ints:
        """Where in `P.flat` the P^(lj) of all pairs of some nodes stand, (c, c, nx, nx); KeyError for no pair."""
        home = {i: (number, at) for number, c in enumerate(self.classes) for at, i in enumerate(c.members)}
        widths = [block.partners.shape[1] for block in self.blocks]
        ends = np.cumsum([block.partners.size * nx * nx for block in self.blocks])
        first = np.zeros((len(nodes), len(nodes), 1, 1), dtype=np.intp)
        width = np.zeros_like(first)
        for (a, i), (b, j) in product(enumerate(nodes), repeat=2):
            (left, at), (right, _) = home[i], home[j]
            number = left * len(self.classes) + right
            start = int(ends[number]) - self.blocks[number].partners.size * nx * nx
            width[a, b] = widths[number]
            first[a, b] = start + (at * nx * widths[number] + self._place[i][j]) * nx
        return first + np.arange(nx)[:, None] * (width * nx) + np.arange(nx)

    def flip(self, X: Blocks, first: int = 0) -> Blocks:
        """Xᶠ: every pair the other way round, X^(jl)ᵀ in the place of (l, j); (n, a, r, b) becomes (n, b, r, a).

        With `first`, only of the rows of X from there on.
        """
        arrays = X.arrays
        return Blocks([self._flipped(number, arrays[b.mirror], first) for number, b in enumerate(self.blocks)])

    def _flipped(self, number: int, X: Array, first: int) -> Array:
        _, rows, r, columns = X.shape
        index = self._flips.get((number, rows, columns, first))
        if index is None:
            block = self.blocks[number]
            start = block.partners * (rows * r * columns) + block.back * columns
            steps = np.arange(columns)[:, None, None] + np.arange(first, rows) * (r * columns)
            index = self._flips[number, rows, columns, first] = start[:, None, :, None] + steps
        return X.reshape(-1).take(index, mode="wrap")  # the indices are right: the fastest of the modes

    def pick(self, matrix: Array) -> Blocks:
        """Parts of a matrix over Y, (ny, ny): for (l, j) the rows of l's slots and the columns of j's."""
        return Blocks([matrix.reshape(-1).take(index) for index in self._picks])

    @cached_property
    def _picks(self) -> list[Ints]:
        slots = [c.slots for c in self.classes]
        return [
            slots[block.left][:, :, None, None] * self.ny + slots[block.right][block.partners][:, None, :, :]
            for block in self.blocks
        ]


Slots = Mapping[NodeId, Sequence[tuple[NodeId, int]]]
"""For each node, the sensor behind each slot and its row in Y."""


def _slots(neighbourhoods: Mapping[NodeId, Collection[NodeId]], sizes: Mapping[NodeId, int]) -> Slots:
    first: dict[NodeId, int] = {}
    end = 0
    for s in sorted_ids(sizes):
        first[s], end = end, end + sizes[s]
    return {
        i: [(s, first[s] + component) for s in sorted_ids(near) for component in range(sizes[s])]
        for i, near in neighbourhoods.items()
    }


def _partners(nodes: Sequence[NodeId], pairs: Iterable[tuple[NodeId, NodeId]] | None) -> dict[NodeId, set[NodeId]]:
    """The nodes that each makes a pair with, itself included."""
    if pairs is None:
        return {i: set(nodes) for i in nodes}
    partners = {i: {i} for i in nodes}
    for i, j in pairs:
        partners[i].add(j)
        partners[j].add(i)
    return partners


def _groups(sizes: Mapping[NodeId, int], partners: Mapping[NodeId, set[NodeId]]) -> list[list[NodeId]]:
    """The nodes by class: all in one, unless that would be mostly padding; then those within a factor of 2 in size."""
    needed = sum(sizes[i] * sizes[j] for i, others in partners.items() for j in others)
    widest = max(map(len, partners.values()), default=0)
    padded = len(sizes) * widest * max(sizes.values(), default=0) ** 2
    if padded - needed <= max(WASTE, needed):
        return [sorted_ids(sizes)]
    by_size: dict[int, list[NodeId]] = defaultdict(list)
    for i in sorted_ids(sizes):
        by_size[sizes[i].bit_length()].append(i)
    return [by_size[magnitude] for magnitude in sorted(by_size)]


def _keep_company(partners: Mapping[NodeId, set[NodeId]], one: Sequence[NodeId], other: Sequence[NodeId]) -> None:
    """Give each node of one class a partner in the other, be it one that nobody asked for: no row is empty."""
    members = set(other)
    for number, i in enumerate(one):
        if partners[i].isdisjoint(members):
            j = other[number % len(other)]
            partners[i].add(j)
            partners[j].add(i)


def _node_class(members: Sequence[NodeId], slots: Slots) -> NodeClass:
    size = max(len(slots[i]) for i in members)
    padding = {i: size - len(slots[i]) for i in members}
    rows = [[row for _, row in slots[i]] + [0] * padding[i] for i in members]
    return NodeClass(
        members=tuple(members),
        slots=np.array(rows, dtype=np.intp).reshape(len(rows), size),
        sensor=tuple((*(s for s, _ in slots[i]), *[None] * padding[i]) for i in members),
    )


def _blocks(
    groups: Sequence[Sequence[NodeId]], partners: Mapping[NodeId, set[NodeId]]
) -> tuple[tuple[Block, ...], dict[NodeId, dict[NodeId, int]]]:
    """`Layout.blocks`, and `Layout._place`."""
    numbers = list(product(range(len(groups)), repeat=2))
    place: dict[NodeId, dict[NodeId, int]] = {i: {} for group in groups for i in group}
    rows: list[list[list[NodeId]]] = []
    for left, right in numbers:
        members = set(groups[right])
        ordered = [sorted_ids(partners[i] & members) for i in groups[left]]
        if left == right:
            ordered = [[i, *(j for j in row if j != i)] for i, row in zip(groups[left], ordered, strict=True)]
        for i, row in zip(groups[left], ordered, strict=True):
            place[i].update((j, at) for at, j in enumerate(row))
        width = max(map(len, ordered))
        rows.append([row + row[:1] * (width - len(row)) for row in ordered])
    blocks = []
    for (left, right), filled in zip(numbers, rows, strict=True):
        position = {j: at for at, j in enumerate(groups[right])}
        at = [[position[j] for j in row] for row in filled]
        back = [[place[j][i] for j in row] for i, row in zip(groups[left], filled, strict=True)]
        mirror = right * len(groups) + left
        blocks.append(Block(left, right, mirror, np.array(at, dtype=np.intp), np.array(back, dtype=np.intp)))
    return tuple(blocks), place
