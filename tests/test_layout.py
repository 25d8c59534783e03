"""Where the matrices of pairs stand: found again, turned round, picked; with one class of nodes and with several."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from zfusion.methods import layout
from zfusion.methods.layout import Blocks, Layout
from zfusion.model.types import NodeId

NEIGHBOURS: Mapping[NodeId, tuple[NodeId, ...]] = {
    "a": ("a", "b", "c", "d", "e"),
    "b": ("a", "b"),
    "c": ("c",),
    "d": ("a", "d"),
    "e": ("b", "d", "e"),
}
SIZES: Mapping[NodeId, int] = {"a": 1, "b": 2, "c": 1, "d": 3, "e": 1}
PAIRS = [("a", "b"), ("d", "a"), ("e", "b"), ("e", "b"), ("b", "d")]


@pytest.fixture(params=["one class", "several classes"])
def tracked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Layout:
    monkeypatch.setattr(layout, "WASTE", 0 if request.param == "several classes" else 10**9)
    built = Layout.build(NEIGHBOURS, SIZES, PAIRS)
    assert (len(built.classes) == 1) == (request.param == "one class")
    return built


def members(tracked: Layout, number: int) -> tuple[tuple[NodeId, ...], tuple[NodeId, ...]]:
    block = tracked.blocks[number]
    return tracked.classes[block.left].members, tracked.classes[block.right].members


def random_blocks(tracked: Layout, rows: int, columns: int) -> Blocks:
    rng = np.random.default_rng(1)
    shapes = [block.partners.shape for block in tracked.blocks]
    return Blocks(rng.normal(size=(n, rows, r, columns)) for n, r in shapes)


def test_nodes_are_in_order_and_each_has_the_slots_of_its_neighbourhood(tracked: Layout) -> None:
    assert tracked.nodes == ("a", "b", "c", "d", "e")
    assert tracked.ny == 8
    first = {"a": 0, "b": 1, "c": 3, "d": 4, "e": 7}
    for c in tracked.classes:
        for i, slots, sensors in zip(c.members, c.slots, c.sensor, strict=True):
            wanted = [(s, first[str(s)] + at) for s in NEIGHBOURS[i] for at in range(SIZES[s])]
            found = [(s, row) for s, row in zip(sensors, slots.tolist(), strict=True) if s is not None]
            assert found == wanted


def test_used_slots_are_those_of_the_sensors_named(tracked: Layout) -> None:
    used = tracked.used({"a": ("b", "e"), "d": (), "e": ("b", "d", "e")})
    for c, mask in zip(tracked.classes, used, strict=True):
        for i, row, sensors in zip(c.members, mask, c.sensor, strict=True):
            assert {s for s, yes in zip(sensors, row, strict=True) if yes} == {
                "a": {"b", "e"},
                "e": {"b", "d", "e"},
            }.get(str(i), set())


def test_every_pair_is_found_both_ways_round(tracked: Layout) -> None:
    """The block of (l, j) that `among` points at is the one whose partner is j; `flip` brings the other there."""
    X = random_blocks(tracked, 2, 2)
    flipped = tracked.flip(X)
    named = Blocks(np.full_like(array, number) for number, array in enumerate(X.arrays))
    for i, j in [*PAIRS, *((j, i) for i, j in PAIRS), *((i, i) for i in NEIGHBOURS)]:
        one, other = X.flat.take(tracked.among([i, j], 2))[0, 1], X.flat.take(tracked.among([j, i], 2))[0, 1]
        np.testing.assert_array_equal(flipped.flat.take(tracked.among([i, j], 2))[0, 1], other.T)
        assert i == j or not np.array_equal(one, other)
        left, right = members(tracked, int(named.flat.take(tracked.among([i, j], 2))[0, 1, 0, 0]))
        assert i in left
        assert j in right
    with pytest.raises(KeyError):
        tracked.among(["c", "a", "e", "b", "d"], 2)


def test_turned_round_twice_it_is_as_before_also_in_part(tracked: Layout) -> None:
    X = random_blocks(tracked, 3, 2)
    twice = tracked.flip(tracked.flip(X))
    for array, again, block in zip(X.arrays, twice.arrays, tracked.blocks, strict=True):
        for at, row in enumerate(block.partners.tolist()):
            for place in [row.index(j) for j in set(row)]:
                np.testing.assert_array_equal(again[at, :, place], array[at, :, place])
    part = Blocks([array[:, 1:] for array in X.arrays])
    for one, other in zip(
        tracked.flip(X, 1).arrays, tracked.flip(Blocks(map(np.copy, part.arrays))).arrays, strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_parts_of_a_matrix_are_those_of_the_nodes_slots(tracked: Layout) -> None:
    M = np.arange(64.0).reshape(8, 8)
    for block, picked in zip(tracked.blocks, tracked.pick(M).arrays, strict=True):
        left, right = tracked.classes[block.left], tracked.classes[block.right]
        for at, row in enumerate(block.partners):
            for place, j in enumerate(row):
                np.testing.assert_array_equal(picked[at, :, place], M[np.ix_(left.slots[at], right.slots[j])])


def test_a_nodes_own_matrices_come_in_the_order_of_the_nodes(tracked: Layout) -> None:
    X = random_blocks(tracked, 2, 2)
    own = tracked.in_order(tracked.own(X))
    for at, i in enumerate(tracked.nodes):
        np.testing.assert_array_equal(own[at], X.flat.take(tracked.among([i], 2))[0, 0])


def test_sums_of_blocks(tracked: Layout) -> None:
    X, Y = random_blocks(tracked, 2, 1), 3.0 * random_blocks(tracked, 2, 1)
    np.testing.assert_allclose((Y - X).flat, 2 * X.flat)
    np.testing.assert_allclose((X + Y).flat, 4 * X.flat)
    Z = X + Y
    Z -= X
    Z += Y
    np.testing.assert_allclose(Z.flat, 6 * X.flat)
    assert Z.nbytes == 8 * len(Z.flat)


def test_without_pairs_all_are_there() -> None:
    tracked = Layout.build(NEIGHBOURS, SIZES)
    assert tracked.blocks[0].partners.tolist()[2] == [2, 0, 1, 3, 4]
    assert tracked.among(tracked.nodes, 2).shape == (5, 5, 2, 2)


def test_a_hub_with_hundreds_of_leaves_is_not_padded_to_the_fourth_power() -> None:
    ids: list[NodeId] = list(range(301))
    neighbours = {0: tuple(ids), **{i: (0, i) for i in ids[1:]}}
    tracked = Layout.build(neighbours, dict.fromkeys(ids, 1))
    numbers = sum(
        b.partners.size * tracked.classes[b.left].slots.shape[1] * tracked.classes[b.right].slots.shape[1]
        for b in tracked.blocks
    )
    assert numbers < 1_000_000
