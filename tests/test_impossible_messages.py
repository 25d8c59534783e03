"""Messages that are well-formed and cannot be: counted, and left out by every method."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bad_weather import bits
from white_networks import Swarm, sampled, white_system
from zfusion.methods import METHODS
from zfusion.methods.packing import packed, unpacked
from zfusion.methods.protocol import Outcome, Setting, Wary
from zfusion.model.network import Network
from zfusion.model.types import Array
from zfusion.node import Node, Patience
from zfusion.stages import Kind, Message
from zfusion.used_sets import Ledger

SYSTEM = white_system(
    [[0.9, 0.2], [0, 0.8]],
    np.diag([0.1, 0.2]),
    [[[1.0, 0]], np.eye(2), [[1.0, 1.0]]],
    [1.0, np.eye(2), 0.5],
    P0=np.eye(2),
)
GRAPH = Network.complete(SYSTEM.ids)
READINGS = sampled(SYSTEM, 12, 1)[1]
ROUNDS = {"consensus": {"rounds": 2}, "hybrid_consensus": {"rounds": 2}}
WARY = ("consensus", "diffusion", "kalman_consensus", "hybrid_consensus", "covariance_intersection")
HUGE = np.array([1e300, -1e300])

CASES: list[tuple[str, int, dict[str, Any]]] = [
    ("two_stage", 0, {"y": np.array([1e300])}),
    ("centralized", 0, {"y": np.array([-1e300])}),
    ("consensus", 0, {"x": HUGE}),
    ("consensus", 1, {"M": np.array([1e300, 0, 1e300])}),
    ("diffusion", 0, {"y": np.array([1e300])}),
    ("diffusion", 1, {"x": HUGE}),
    ("kalman_consensus", 0, {"x": HUGE}),
    ("kalman_consensus", 0, {"y": np.array([-1e300])}),
    ("hybrid_consensus", 0, {"omega": packed(np.array([[1.0, 2.0], [2.0, 1.0]]))}),
    ("hybrid_consensus", 0, {"omega": packed(np.ones((2, 2)))}),
    ("hybrid_consensus", 0, {"omega": packed(1e-200 * np.eye(2))}),
    ("hybrid_consensus", 1, {"domega": packed(np.diag([1.0, -0.1]))}),
    ("hybrid_consensus", 1, {"q": HUGE}),
    ("covariance_intersection", 0, {"P": np.diag([1.0, 0.0])}),
    ("covariance_intersection", 0, {"P": np.diag([1.0, -1.0])}),
    ("covariance_intersection", 0, {"P": np.array([[1.0, 0.5], [0.4, 1.0]])}),
    ("covariance_intersection", 0, {"P": 1e300 * np.eye(2)}),
]


def make(name: str) -> Node:
    method = METHODS[name].choose(ROUNDS.get(name, {}))
    made = method(Setting(0, SYSTEM, method.network(GRAPH)))
    return Node(0, GRAPH.neighbours(0), made, Patience((10,) * len(method.stages), False))


def others(name: str) -> Swarm:
    return Swarm(name, SYSTEM, GRAPH, ROUNDS.get(name, {}))


def talk(name: str, change: Callable[[Any, int, int, dict[str, Any]], dict[str, Any] | None]) -> tuple[Node, list[Any]]:
    """A node among honest ones; what they say to it is changed, or, where None, is not said."""
    swarm, node, told = others(name), make(name), []
    stages = swarm.method.stages
    for k, ys in enumerate(READINGS, start=1):
        said: dict[Any, Any] = {i: swarm.nodes[i].begin(k, ys[i]) for i in SYSTEM.ids}
        told += node.begin(k, ys[0], now=100 * k)
        for n, stage in enumerate(stages):
            for j in (1, 2):
                fields = change(j, k, n, dict(said[j]))
                if fields is not None:
                    told += node.receive(Message(j, k, stage.name, k - 1, 1, 0, fields), now=100 * k + n)
            if node.stage == stage.name:
                told += node.tick(100 * k + 10 * n + 10)
            said = {i: swarm.nodes[i].advance(n, k, said, Ledger(i, 1)) for i in SYSTEM.ids}
    assert node.completed == len(READINGS)
    return node, told


@pytest.mark.parametrize(("name", "stage", "fields"), CASES)
def test_what_cannot_be_is_counted_and_does_nothing(name: str, stage: int, fields: dict[str, Any]) -> None:
    at = {2, 5, 6}
    node, told = talk(name, lambda j, k, n, said: said | fields if (j, n) == (1, stage) and k in at else said)
    _, missing = talk(name, lambda j, k, n, said: None if (j, n) == (1, stage) and k in at else said)
    assert node.counters[1].refused == {"impossible": 3}
    assert not node.counters[2].refused
    assert not node.counters[1].missed  # nobody waits for what has come
    same = [[(m[0], m[1], m[2], m[6]) for m in bits(effects)] for effects in (told, missing)]
    assert same[0] == same[1]  # as if it had not been said


@pytest.mark.parametrize("name", WARY)
def test_honest_messages_are_all_taken(name: str) -> None:
    node, _ = talk(name, lambda j, k, n, said: said)
    assert isinstance(node._method, Wary)
    assert not any(counters.refused for counters in node.counters.values())
    assert not node.incidents


EXPONENTS = st.sampled_from([-300, -150, -99, -20, -3, 0, 3, 20, 99, 100, 150, 300, 308])


@pytest.mark.parametrize("name", [*WARY, "two_stage", "local", "centralized"])
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32), exponents=st.lists(EXPONENTS, min_size=1, max_size=3))
def test_whatever_neighbours_say_no_node_falls_over(name: str, seed: int, exponents: list[int]) -> None:
    """Numbers of all sizes in all fields; estimates stay finite, and covariances are never negative."""
    random = Random(seed)
    kinds = {
        stage.name: {f.name: f.kind for f in stage.fields}
        for stage in METHODS[name].choose(ROUNDS.get(name, {})).stages
    }
    names = list(kinds)

    def change(j: Any, k: int, n: int, said: dict[str, Any]) -> dict[str, Any]:
        if random.random() < 0.4:
            for field, kind in kinds[names[n]].items():
                if kind in (Kind.VECTOR, Kind.OPTIONAL_VECTOR, Kind.MATRIX) and random.random() < 0.6:
                    value = np.array(said[field], dtype=float)
                    factors = [random.choice((-1, 1)) * 10.0 ** random.choice(exponents) for _ in range(value.size)]
                    with np.errstate(over="ignore"):
                        said[field] = np.clip(value * np.reshape(factors, value.shape), -1e308, 1e308)
        if name in ("two_stage",) and n == 1:
            said["history"] = ()
        return said

    _, told = talk(name, change)
    for message in told:
        if isinstance(message, Message) and message.stage == "estimate":
            x, P = message.fields["x"], message.fields["P"]
            assert isinstance(x, np.ndarray)
            assert isinstance(P, np.ndarray)
            assert np.isfinite(x).all()
            assert np.isfinite(P).all()
            assert np.linalg.eigvalsh(P)[0] >= -1e-9 * np.abs(P).max()


def test_packing() -> None:
    matrix: Array = np.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    assert packed(matrix).tolist() == [1, 2, 4, 3, 5, 6]
    np.testing.assert_array_equal(unpacked(packed(matrix)), matrix)


def test_a_share_beyond_belief_is_forgotten() -> None:
    node = others("consensus").nodes[0]
    node._share[:] = 1e101
    first: Any = node.begin(1, np.array([2.0]))
    np.testing.assert_allclose(first["x"], [2.0, 0.0])
    outcome: Any = node.advance(0, 1, {0: first}, Ledger(0, 1))
    outcome = node.advance(1, 1, {0: outcome}, Ledger(0, 1))
    assert isinstance(outcome, Outcome)
    assert outcome.incidents == ("started_again",)
