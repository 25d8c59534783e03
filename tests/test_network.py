import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zfusion.model.network import Network


def neighbourhoods(network: Network) -> dict:
    return {i: network.neighbours(i) for i in network.ids}


def is_undirected(network: Network) -> bool:
    return (network.matrix() == network.matrix().T).all()


matrices = st.integers(1, 8).flatmap(
    lambda m: st.lists(st.lists(st.sampled_from([0.0, 1.0, 2.5]), min_size=m, max_size=m), min_size=m, max_size=m)
)


@given(matrices)
def test_all_views_of_a_graph_agree_with_its_matrix(matrix):
    a = np.array(matrix) + np.eye(len(matrix))
    ids = [10 * n for n in range(len(a))]
    network = Network.from_matrix(ids, a.tolist())
    assert (network.matrix() == a).all()
    for row, i in enumerate(ids):
        assert network.neighbours(i) == tuple(j for column, j in enumerate(ids) if a[row, column] > 0)
        assert network.listeners(i) == tuple(j for n, j in enumerate(ids) if a[n, row] > 0 and j != i)
        two_hop = (a @ a)[row] > 0
        assert network.two_hop(i) == tuple(j for n, j in enumerate(ids) if two_hop[n])
        assert [network.weight(i, j) for j in ids] == a[row].tolist()
    linked = [(i, j) for x, i in enumerate(ids) for y, j in enumerate(ids) if x < y and (a[x, y] or a[y, x])]
    assert network.links() == tuple(linked)


@given(matrices, st.randoms(use_true_random=False))
def test_relabelling_permutes_the_matrix(matrix, random):
    a = np.array(matrix) + np.eye(len(matrix))
    order = list(range(len(a)))
    random.shuffle(order)
    network = Network.from_matrix(range(len(a)), a.tolist()).relabelled(dict(enumerate(order)))
    assert (network.matrix()[np.ix_(order, order)] == a).all()
    assert network.ids == tuple(range(len(a)))


def test_relabelling_refuses_to_merge_nodes():
    with pytest.raises(ValueError, match="differ"):
        Network.complete([1, 2]).relabelled({1: 5, 2: 5})


def test_the_graph_of_the_papers_example():
    network = Network.from_matrix([1, 2, 3, 4], [[1, 1, 1, 0], [0, 1, 1, 1], [1, 0, 1, 1], [1, 1, 0, 1]])
    assert neighbourhoods(network) == {1: (1, 2, 3), 2: (2, 3, 4), 3: (1, 3, 4), 4: (1, 2, 4)}
    assert network.listeners(1) == (3, 4)
    assert network.two_hop(1) == (1, 2, 3, 4)
    assert len(network.links()) == 6


def test_an_edge_goes_from_sender_to_receiver():
    network = Network.from_edges(["a", "b", "c"], [("c", "a"), ("a", "b")])
    assert neighbourhoods(network) == {"a": ("a", "c"), "b": ("a", "b"), "c": ("c",)}
    assert network.listeners("c") == ("a",)
    both = Network.from_edges(["a", "b", "c"], [("c", "a"), ("a", "b")], undirected=True)
    assert neighbourhoods(both) == {"a": ("a", "b", "c"), "b": ("a", "b"), "c": ("a", "c")}


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        ([[1, 0]], "expected 2 x 2"),
        ([[1, 0], [0]], "expected 2 x 2"),
        ([[1, -1], [0, 1]], r"\[0, 1\]: expected 0 or a positive"),
        ([[1, float("nan")], [0, 1]], r"\[0, 1\]: expected 0 or a positive"),
        ([[1, 1], [1, 0]], r"\[1, 1\]: expected a_ii > 0"),
    ],
)
def test_what_is_no_adjacency_matrix_is_refused(matrix, fault):
    with pytest.raises(ValueError, match=fault):
        Network.from_matrix([1, 2], matrix)


@pytest.mark.parametrize(
    ("edges", "undirected", "fault"),
    [
        ([(1, 2), (2, 7)], False, "edge 1: there is no node 7"),
        ([(1, 1)], False, "edge 0: expected two different"),
        ([(1, 2), (1, 2)], False, "edge 1: expected each edge once"),
        ([(1, 2), (2, 1)], True, "edge 1: expected each edge once"),
    ],
)
def test_what_is_no_edge_is_refused(edges, undirected, fault):
    with pytest.raises(ValueError, match=fault):
        Network.from_edges([1, 2], edges, undirected)


def test_complete_and_isolated():
    assert neighbourhoods(Network.complete([3, 1, 2])) == dict.fromkeys((1, 2, 3), (1, 2, 3))
    assert Network.complete([3, 1, 2]).links() == ((1, 2), (1, 3), (2, 3))
    assert neighbourhoods(Network.isolated([3, 1, 2])) == {1: (1,), 2: (2,), 3: (3,)}
    assert Network.isolated([3, 1, 2]).links() == ()


def test_ring_line_and_star():
    ids = [1, 2, 3, 4, 5]
    assert Network.ring(ids).neighbours(1) == (1, 2, 5)
    assert Network.ring(ids, directed=True).neighbours(1) == (1, 5)
    assert Network.ring(ids, reach=2).neighbours(1) == (1, 2, 3, 4, 5)
    assert neighbourhoods(Network.ring([1])) == {1: (1,)}
    assert neighbourhoods(Network.ring([1, 2])) == {1: (1, 2), 2: (1, 2)}
    assert Network.line(ids).neighbours(1) == (1, 2)
    assert Network.line(ids, directed=True).neighbours(3) == (2, 3)
    assert Network.star(ids).links() == ((1, 2), (1, 3), (1, 4), (1, 5))
    assert Network.star(ids, hub=3).neighbours(5) == (3, 5)
    with pytest.raises(ValueError, match="hub 9"):
        Network.star(ids, hub=9)


def test_grid():
    network = Network.grid(range(8), columns=3)  # 0 1 2 / 3 4 5 / 6 7
    assert network.neighbours(0) == (0, 1, 3)
    assert network.neighbours(4) == (1, 3, 4, 5, 7)
    assert network.neighbours(5) == (2, 4, 5)
    assert network.neighbours(6) == (3, 6, 7)
    assert neighbourhoods(Network.grid(range(9))) == neighbourhoods(Network.grid(range(9), columns=3))
    assert neighbourhoods(Network.grid(range(4), columns=9)) == neighbourhoods(Network.line(range(4)))


def test_random_geometric_joins_exactly_those_within_the_radius():
    network = Network.random_geometric(range(30), radius=0.3, seed=5)
    points = np.random.default_rng(5).random((30, 2))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert (network.matrix() == (apart <= 0.3)).all()
    assert network == Network.random_geometric(range(30), radius=0.3, seed=5)
    assert network != Network.random_geometric(range(30), radius=0.3, seed=6)


@given(st.integers(1, 30), st.integers(0, 6), st.integers(0, 5))
def test_random_regular_has_the_degree(size, degree, seed):
    if degree >= size or size * degree % 2:
        with pytest.raises(ValueError, match=f"has degree {degree}"):
            Network.random_regular(range(size), degree, seed)
        return
    network = Network.random_regular(range(size), degree, seed)
    assert {len(network.neighbours(i)) for i in network.ids} == {degree + 1}
    assert is_undirected(network)
    assert network == Network.random_regular(range(size), degree, seed)


def test_thousands_of_nodes():
    network = Network.random_regular(range(5000), 6, seed=0)
    assert len(network.links()) == 15_000
    assert all(len(network.two_hop(i)) <= 43 for i in network.ids)
    assert len(Network.complete(range(5000)).neighbours(7)) == 5000
