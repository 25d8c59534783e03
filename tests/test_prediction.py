"""The predicted error covariances of whole networks."""

from __future__ import annotations

import resource
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest

from oracles import brute_force, paper, random_systems, tracking
from zfusion.methods import prediction
from zfusion.methods.prediction import Prediction, predict
from zfusion.model.network import Network
from zfusion.model.types import NodeId

STEPS = 8
KINDS: list[dict[str, Any]] = [
    {"nx": 1},
    {"nx": 2, "varying": True},
    {"nx": 3, "noise": "white"},
    {"nx": 2, "radius": 1.2},
    {"nx": 2, "ids": ("attic", "cellar", "hall", "yard")},
    {"mean": 10.0},
]
ESTIMATES = ("local", "intermediate", "distributed", "centralized")


def test_the_published_example() -> None:
    predicted = predict(paper.paper_system(), Network(paper.NEIGHBOURS, {}), 100)
    assert predicted.ids == (1, 2, 3, 4)
    for k, wanted in paper.ERROR_VARIANCES.items():
        for estimate in ESTIMATES:
            np.testing.assert_allclose(getattr(predicted, estimate)[k].ravel(), wanted[estimate], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_random_systems_on_random_graphs(kind: dict[str, Any], seed: int) -> None:
    rng = np.random.default_rng([1, seed])
    system = random_systems.random_system(rng, **kind)
    neighbours = random_systems.random_graph(rng, system.ids)
    predicted = predict(system, Network(neighbours, {}), STEPS)
    wanted = brute_force.error_covariances(system, neighbours, STEPS)
    for estimate in ESTIMATES:
        found, right = getattr(predicted, estimate), getattr(wanted, estimate)
        assert found.shape == right.shape
        for k in range(STEPS + 1):
            np.testing.assert_allclose(found[k], right[k], rtol=0, atol=1e-9 * np.abs(right[k]).max())


def test_step_0_is_the_prior() -> None:
    system = tracking.target({1: 1.0, 2: 2.0}, P0=7.0)
    predicted = predict(system, Network.complete((1, 2)), 0)
    for estimate in ESTIMATES:
        np.testing.assert_array_equal(getattr(predicted, estimate).reshape(-1, 2, 2)[0], system.initial_covariance)


@pytest.mark.parametrize(
    "network", [Network.complete, Network.isolated, Network.star, Network.line], ids=lambda n: n.__name__
)
def test_networks_of_every_shape(network: Any) -> None:
    system = tracking.target({i: 1.0 + 0.2 * i for i in range(7)})
    graph = network(system.ids)
    predicted = predict(system, graph, STEPS)
    wanted = brute_force.error_covariances(system, graph.neighbourhoods, STEPS)
    for estimate in ESTIMATES:
        np.testing.assert_allclose(getattr(predicted, estimate), getattr(wanted, estimate), rtol=1e-8, atol=1e-10)


def test_a_prior_that_stays_the_same() -> None:
    system = tracking.random_walk({1: 1.0, 2: 1.5, 3: 0.7}, F=0.5, Q=0.75, P0=1.0)
    neighbours: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2, 3), 2: (1, 2), 3: (2, 3)}
    predicted = predict(system, Network(neighbours, {}), STEPS)
    wanted = brute_force.error_covariances(system, neighbours, STEPS)
    np.testing.assert_allclose(predicted.distributed, wanted.distributed, rtol=1e-11)


def test_twins_that_know_a_million_times_less() -> None:
    """Nodes 2 and 3 are twins, and the rounding in their variances is as large as node 1's own variance."""
    system = tracking.random_walk({1: 1e6, 2: 1.0, 3: 0.7, 4: 1.0}, F=0.5, Q=0.75, P0=1.0)
    neighbours: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2, 3), 2: (2, 3, 4), 3: (2, 3, 4), 4: (4,)}
    predicted = predict(system, Network(neighbours, {}), STEPS)
    wanted = brute_force.error_covariances(system, neighbours, STEPS)
    assert wanted.distributed[-1, 0] < 2e-12
    np.testing.assert_allclose(predicted.distributed[:, 0], wanted.distributed[:, 0], rtol=1e-3)
    np.testing.assert_allclose(predicted.distributed[:, 1:], wanted.distributed[:, 1:], rtol=1e-10)


def test_hundreds_of_nodes() -> None:
    """Nothing of the size of all pairs of nodes: a few hundred megabytes would show it."""
    ids: list[NodeId] = list(range(300))
    system = tracking.target({i: 1.0 + i / 300 for i in ids}, correlated=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    predicted = predict(system, Network.random_regular(ids, 6, seed=1), 3)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000
    assert predicted.distributed.shape == (4, 300, 2, 2)
    traces = {name: np.einsum("...aa->...", getattr(predicted, name))[-1] for name in ESTIMATES}
    assert (traces["intermediate"] < traces["local"]).all()
    assert (traces["distributed"] < traces["intermediate"]).all()
    assert (traces["centralized"] < traces["distributed"]).all()


def test_a_settled_network_is_not_fused_again(monkeypatch: pytest.MonkeyPatch) -> None:
    fusions: list[int] = []
    fuse = prediction.fusion_weights
    monkeypatch.setattr(prediction, "fusion_weights", lambda *blocks: fusions.append(1) or fuse(*blocks))  # type: ignore[func-returns-value]
    settled: Prediction = predict(paper.paper_system(), Network(paper.NEIGHBOURS, {}), 1500)
    assert len(fusions) < 1400
    for array in astuple(settled)[1:]:
        np.testing.assert_array_equal(array[-1], array[-2])
