"""Many fates of one network side by side, against the brute-force projection of each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from oracles import brute_force, paper, random_systems
from zfusion.methods.ensemble import Arcs, Ensemble, copies_at_once
from zfusion.methods.layout import Bools
from zfusion.methods.prediction import predict
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.statistics import prior_moments, step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

STEPS, COPIES = 6, 5
KINDS: list[dict[str, Any]] = [{"nx": 1}, {"nx": 2, "varying": True}, {"nx": 2, "noise": "white", "mean": 10.0}]


def random_fates(rng: np.random.Generator, arcs: Arcs) -> tuple[Bools, Bools]:
    """Used and told, (COPIES, STEPS, arcs); now and then not even the own measurement is used."""
    shape = (COPIES, STEPS, len(arcs))
    used = (rng.random(shape) < 0.6) | (arcs.own & (rng.random(shape) < 0.7))
    return used, (rng.random(shape) < 0.6) | arcs.own


def by_step(arcs: Arcs, row: Bools) -> dict[tuple[NodeId, int], tuple[NodeId, ...]]:
    found: dict[tuple[NodeId, int], tuple[NodeId, ...]] = {}
    for (i, j), of in zip(arcs.pairs, row.T, strict=True):
        for k in range(1, STEPS + 1):
            found.setdefault((i, k), ())
            if of[k - 1]:
                found[i, k] += (j,)
        found.setdefault((i, 0), ())
    return found


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(2))
def test_each_copy_is_the_projection_on_what_it_used(kind: dict[str, Any], seed: int) -> None:
    rng = np.random.default_rng([7, seed])
    system = random_systems.random_system(rng, **kind)
    neighbours = random_systems.random_graph(rng, system.ids, 0.6)
    ensemble = Ensemble(system, neighbours, COPIES, fusing=system.ids)
    used, told = random_fates(rng, ensemble.arcs)
    path = SamplePath(system, 3)
    Y = [np.concatenate([path.measurement(i, k) for i in system.ids]) for k in range(1, STEPS + 1)]
    stacked = brute_force.stack(system, STEPS)
    rows = stacked.vector({(i, k): path.measurement(i, k) for i in system.ids for k in range(1, STEPS + 1)})
    wanted = []
    for copy in range(COPIES):
        sets, heard = by_step(ensemble.arcs, used[copy]), by_step(ensemble.arcs, told[copy])
        estimates = {i: brute_force.intermediate(stacked, i, sets) for i in system.ids}
        wanted.append((estimates, {i: brute_force.fused(stacked, estimates, i, heard) for i in system.ids}))
    known, models = ensemble.start(prior_moments(system).mean), step_models(system, system.ids)
    for k in range(1, STEPS + 1):
        model, moments = next(models)
        ensemble.advance(model, used[:, k - 1])
        known = ensemble.filtered(known, Y[k - 1])
        fused = ensemble.fused(told[:, k - 1], moments)
        x = ensemble.fused_estimates(told[:, k - 1], moments, known)
        for copy, (estimates, fusions) in enumerate(wanted):
            for n, i in enumerate(system.ids):
                close(ensemble.intermediate[copy, n], estimates[i].covariance[k])
                close(fused[copy, n], fusions[i].covariance[k])
                close(known.x[copy, n], estimates[i].values(stacked, rows)[k])
                close(x[copy, n], fusions[i].values(stacked, rows)[k])


def close(found: Array, wanted: Array) -> None:
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8 * max(1.0, float(np.abs(wanted).max())))


def test_copies_in_which_all_arrives_are_the_prediction() -> None:
    system, network = paper.paper_system(), Network(paper.NEIGHBOURS, {})
    predicted = predict(system, network, 20)
    ensemble, models = Ensemble(system, network.neighbourhoods, 3, network.ids), step_models(system, network.ids)
    everything = np.ones((3, len(ensemble.arcs)), dtype=np.bool_)
    for k in range(1, 21):
        model, moments = next(models)
        ensemble.advance(model, everything)
        np.testing.assert_allclose(ensemble.intermediate[1], predicted.intermediate[k], rtol=1e-12)
        np.testing.assert_allclose(ensemble.fused(everything, moments)[2], predicted.distributed[k], rtol=1e-12)


def test_a_copy_that_is_made_of_another_goes_on_as_that_one() -> None:
    system, network = paper.paper_system(), Network(paper.NEIGHBOURS, {})
    ensemble = Ensemble(system, network.neighbourhoods, 4, network.ids)
    used, told = random_fates(np.random.default_rng(1), ensemble.arcs)
    used[2] = used[0]
    models = step_models(system, network.ids)
    for k in range(STEPS):
        if k == 3:
            assert not np.array_equal(ensemble.intermediate[2], ensemble.intermediate[1])
            used[2, 3:], told[2, 3:] = used[1, 3:], told[1, 3:]
            ensemble.copy(1, [2, 3])
        model, moments = next(models)
        ensemble.advance(model, used[:4, k])
    np.testing.assert_array_equal(ensemble.intermediate[2], ensemble.intermediate[1])
    fused = ensemble.fused(told[:4, -1], moments)
    np.testing.assert_array_equal(fused[2], fused[1])


def test_a_hub_among_many_is_a_class_of_its_own_and_nothing_else_changes() -> None:
    """Nodes of very different degrees lie in several classes: copies must find each other in all of them."""
    ids: tuple[NodeId, ...] = tuple(range(60))
    network = Network.star(ids, hub=30)
    system = _walks(ids)
    ensemble, predicted = Ensemble(system, network.neighbourhoods, 3, network.ids), predict(system, network, 3)
    assert len(ensemble._layout.classes) > 1
    models, everything = step_models(system, ids), np.ones((3, len(ensemble.arcs)), dtype=np.bool_)
    for k in range(1, 4):
        model, moments = next(models)
        if k == 3:
            ensemble.copy(0, [2])
        ensemble.advance(model, everything)
        np.testing.assert_allclose(ensemble.intermediate[2], predicted.intermediate[k], rtol=1e-11)
        np.testing.assert_allclose(ensemble.fused(everything, moments)[2], predicted.distributed[k], rtol=1e-9)


def _walks(ids: tuple[NodeId, ...]) -> System:
    from oracles import tracking

    return tracking.random_walk({i: 1.0 + 0.01 * n for n, i in enumerate(ids)}, F=0.9, Q=0.5, P0=1.0)


def test_fewer_copies_at_once_of_a_larger_network() -> None:
    small = Network.ring(range(8))
    large = Network.complete(range(40))
    assert copies_at_once(_walks(tuple(range(8))), small.neighbourhoods) > 1000
    assert 2 <= copies_at_once(_walks(tuple(range(40))), large.neighbourhoods) < 20
