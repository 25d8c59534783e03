"""The methods at work: estimates from data, against projection and against what must hold whatever the system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from oracles import brute_force, paper, random_systems, tracking
from oracles.brute_force import Estimates, StackedSystem, Used
from zfusion.methods import METHODS, Fields, Outcome, Setting, covariances
from zfusion.methods.two_stage import Centralized, Local, TwoStage
from zfusion.model.network import Network
from zfusion.model.noise import MovingAverageNoise
from zfusion.model.sampling import SamplePath
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.used_sets import Ledger

STEPS = 12
KINDS: list[dict[str, Any]] = [
    {"nx": 1},
    {"nx": 2, "varying": True},
    {"nx": 3, "noise": "white"},
    {"nx": 2, "radius": 1.2},
    {"nx": 2, "multiplicative": False, "mean": 0.0},
    {"mean": 20.0},
]


class Exchange:
    """Methods at all nodes of a network, and what they tell one another, without nodes, clocks or drivers."""

    def __init__(
        self,
        system: System,
        network: Network,
        method: type[Centralized] = TwoStage,
        born: Mapping[NodeId, int] | None = None,
    ) -> None:
        self.network = method.network(network)
        self.born = {i: (born or {}).get(i, 1) for i in network.ids}
        self.methods = {i: method(Setting(i, system, self.network, self.born[i])) for i in network.ids}
        self.ledgers = {i: Ledger(i, self.born[i]) for i in network.ids}
        self.intermediate: dict[NodeId, Array] = {}
        self.outcomes: dict[NodeId, Outcome] = {}

    def step(self, k: int, y: Mapping[NodeId, Array], used: Used | None = None, heard: Used | None = None) -> None:
        """Step k with the measurements `y`, everybody having used and heard just these, or all."""
        alive = [i for i in self.methods if self.born[i] <= k]
        wanted = {i: set(self.network.neighbours(i)) if used is None else set(used.get((i, k), ())) for i in alive}
        told = {i: self.methods[i].begin(k, y.get(i)) for i in alive}
        results: dict[NodeId, Fields | Outcome] = {}
        for i in alive:
            results[i] = self.methods[i].advance(0, k, {j: told[j] for j in wanted[i] if j in told}, self.ledgers[i])
        if all(isinstance(result, Outcome) for result in results.values()):
            self.outcomes = cast("dict[NodeId, Outcome]", results)
            return
        fields = cast("dict[NodeId, Fields]", results)
        self.intermediate = {i: cast(Array, fields[i]["x"]) for i in alive}
        for i in alive:
            assert set(cast("tuple[NodeId, ...]", fields[i]["used"])) == {j for j in wanted[i] if j in y and j in told}
            others = set(self.network.neighbours(i) if heard is None else heard.get((i, k), ()))
            self._tell(i, k, {j: fields[j] for j in alive if j in others or j == i})

    def _tell(self, i: NodeId, k: int, fields: Mapping[NodeId, Fields]) -> None:
        for j in fields:
            own = self.ledgers[j].of(j)
            assert own is not None
            used = cast("tuple[NodeId, ...]", fields[j]["used"])
            self.ledgers[i].learn(j, self.born[j], k, used, own.runs(k - 1))
        self.outcomes[i] = cast(Outcome, self.methods[i].advance(1, k, fields, self.ledgers[i]))


def measurements(system: System, seed: int, steps: int) -> dict[tuple[NodeId, int], Array]:
    path = SamplePath(system, seed)
    return {(i, k): path.measurement(i, k) for k in range(1, steps + 1) for i in system.ids}


def at(readings: Mapping[tuple[NodeId, int], Array], k: int) -> dict[NodeId, Array]:
    return {i: y for (i, step), y in readings.items() if step == k}


def assert_best(exchange: Exchange, stacked: StackedSystem, best: Mapping[NodeId, Estimates], Y: Array, k: int) -> None:
    for i, outcome in exchange.outcomes.items():
        P = best[i].covariance[k]
        scale = np.abs(P).max()
        np.testing.assert_allclose(outcome.P, P, rtol=0, atol=1e-8 * scale)
        np.testing.assert_allclose(outcome.x, best[i].values(stacked, Y)[k], rtol=1e-11, atol=1e-8 * np.sqrt(scale))


# --- against projection


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_estimates_are_the_least_squares_ones_whatever_arrived(kind: dict[str, Any], seed: int) -> None:
    rng = np.random.default_rng([1, seed])
    system = random_systems.random_system(rng, **kind)
    if seed == 2:
        system = random_systems.by_covariances(system)
    neighbours = random_systems.random_graph(rng, system.ids)
    used = random_systems.random_used_sets(rng, neighbours, STEPS)
    heard = random_systems.random_used_sets(rng, neighbours, STEPS, blackout=0.05, late=0)
    stacked = brute_force.stack(system, STEPS)
    intermediate = {i: brute_force.intermediate(stacked, i, used) for i in neighbours}
    best = {i: brute_force.fused(stacked, intermediate, i, heard) for i in neighbours}
    readings = measurements(system, seed, STEPS)
    Y = stacked.vector(readings)

    exchange = Exchange(system, Network(neighbours, {}))
    for k in range(1, STEPS + 1):
        exchange.step(k, at(readings, k), used, heard)
        for i, x in exchange.intermediate.items():
            wanted = intermediate[i].values(stacked, Y)[k]
            size = np.sqrt(np.abs(intermediate[i].covariance[k]).max())
            np.testing.assert_allclose(x, wanted, rtol=1e-11, atol=1e-10 * size)
        assert_best(exchange, stacked, best, Y, k)
        assert not any(outcome.excluded or outcome.ask for outcome in exchange.outcomes.values())


def test_nodes_that_are_born_late_begin_from_the_prior() -> None:
    rng = np.random.default_rng(2)
    system = random_systems.random_system(rng, ids=range(5), nx=2, varying=True, mean=3.0)
    neighbours = random_systems.random_graph(rng, system.ids, density=0.6)
    born: dict[NodeId, int] = {1: 4, 3: 9}
    used = {
        (i, k): tuple(j for j in neighbours[i] if k >= born.get(j, 1))
        for i in neighbours
        for k in range(born.get(i, 1), STEPS + 1)
    }
    stacked = brute_force.stack(system, STEPS)
    intermediate = {i: brute_force.intermediate(stacked, i, used) for i in neighbours}
    best = {i: brute_force.fused(stacked, intermediate, i, used) for i in neighbours}
    readings = measurements(system, 2, STEPS)
    exchange = Exchange(system, Network(neighbours, {}), born=born)
    for k in range(1, STEPS + 1):
        exchange.step(k, at(readings, k))
        assert_best(exchange, stacked, best, stacked.vector(readings), k)


def test_a_step_that_was_slept_through_is_one_without_measurements() -> None:
    rng = np.random.default_rng(3)
    system = random_systems.random_system(rng, nx=2)
    readings = measurements(system, 3, STEPS)
    for name in ("two_stage", "local", "centralized"):
        method = METHODS[name].choose({})
        network = method.network(Network.complete(system.ids))
        sleeper, other = (method(Setting(system.ids[0], system, network)) for _ in range(2))
        ledger = Ledger(system.ids[0], 1)
        for k in range(1, STEPS + 1):
            everything = {j: {"y": y} for j, y in at(readings, k).items() if j in network.neighbours(system.ids[0])}
            if k in (3, 4, 7):
                sleeper.skip(k)
                other.begin(k, None)
                other.advance(0, k, {}, ledger)
            else:
                found, wanted = (m.advance(0, k, everything, ledger) for m in (sleeper, other))
                x, right = (r.x if isinstance(r, Outcome) else r["x"] for r in (found, wanted))
                np.testing.assert_array_equal(x, right)


@pytest.mark.parametrize("method", [TwoStage, Local, Centralized])
def test_the_published_example(method: type[Centralized]) -> None:
    system, network = paper.paper_system(), Network(paper.NEIGHBOURS, {})
    readings = measurements(system, 4, 100)
    exchange = Exchange(system, network, method)
    name = {TwoStage: "distributed", Local: "local", Centralized: "centralized"}[method]
    for k in range(1, 101):
        exchange.step(k, at(readings, k))
        if k in paper.ERROR_VARIANCES:
            found = [outcome.P[0, 0] for outcome in exchange.outcomes.values()]
            np.testing.assert_allclose(found, np.resize(paper.ERROR_VARIANCES[k][name], 4), rtol=0, atol=1e-9)


# --- special cases


def run(
    system: System, network: Network, method: type[Centralized], seed: int = 5, steps: int = STEPS
) -> list[dict[NodeId, Outcome]]:
    exchange, path, outcomes = Exchange(system, network, method), SamplePath(system, seed), []
    for k in range(1, steps + 1):
        exchange.step(k, {i: path.measurement(i, k) for i in system.ids})
        outcomes.append(dict(exchange.outcomes))
    return outcomes


def assert_same(found: list[dict[NodeId, Outcome]], wanted: list[dict[NodeId, Outcome]], tolerance: float) -> None:
    for one, other in zip(found, wanted, strict=True):
        for i, outcome in other.items():
            scale = np.abs(outcome.P).max()
            np.testing.assert_allclose(one[i].P, outcome.P, rtol=0, atol=tolerance * scale)
            np.testing.assert_allclose(one[i].x, outcome.x, rtol=tolerance, atol=tolerance * np.sqrt(scale))


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_in_a_complete_graph_it_is_the_centralized_filter(kind: dict[str, Any]) -> None:
    """All neighbours have the same estimate: a fusion of twins."""
    system = random_systems.random_system(np.random.default_rng(5), **kind)
    complete = Network.complete(system.ids)
    assert_same(run(system, complete, TwoStage), run(system, Network.isolated(system.ids), Centralized), 1e-11)


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_without_links_it_is_the_local_filter(kind: dict[str, Any]) -> None:
    system = random_systems.random_system(np.random.default_rng(6), **kind)
    isolated = Network.isolated(system.ids)
    assert_same(run(system, isolated, TwoStage), run(system, Network.complete(system.ids), Local), 1e-14)


def test_other_names_for_the_nodes_change_nothing_but_their_order() -> None:
    rng = np.random.default_rng(7)
    system = random_systems.random_system(rng, ids=range(5), nx=2)
    network = Network(random_systems.random_graph(rng, system.ids), {})
    name: dict[NodeId, NodeId] = dict(zip(system.ids, ("e", "a", "d", "b", "c"), strict=True))
    noise = cast(MovingAverageNoise, system.noise)
    renamed = replace(
        system,
        sensors=tuple(sorted((replace(s, id=name[s.id]) for s in system.sensors), key=lambda s: str(s.id))),
        noise=MovingAverageNoise(noise.white, noise.process, {name[i]: taps for i, taps in noise.sensors.items()}),
    )
    readings = measurements(system, 7, STEPS)
    one, other = Exchange(system, network), Exchange(renamed, network.relabelled(name))
    for k in range(1, STEPS + 1):
        one.step(k, at(readings, k))
        other.step(k, {name[i]: y for i, y in at(readings, k).items()})
        assert_same([{i: other.outcomes[name[i]] for i in system.ids}], [one.outcomes], 1e-9)


def test_neighbours_with_the_same_measurements_are_one_to_whom_hears_both() -> None:
    system = random_systems.random_system(np.random.default_rng(8), ids=(1, 2, 3), nx=2)
    with_twins = Network({1: (1, 2, 3), 2: (2, 3), 3: (2, 3)}, {})
    exchange, path = Exchange(system, with_twins), SamplePath(system, 8)
    for k in range(1, STEPS + 1):
        exchange.step(k, {i: path.measurement(i, k) for i in system.ids}, heard={(1, k): (1, 2, 3), (2, k): (2, 3)})
        assert exchange.outcomes[1].used == (1, 2, 3)
        np.testing.assert_allclose(exchange.outcomes[2].x, exchange.outcomes[3].x, rtol=1e-12)
        np.testing.assert_allclose(exchange.outcomes[2].x, exchange.intermediate[3], rtol=1e-9)


@pytest.mark.parametrize("case", ["all but the network is steady", "the prior is slower than the filters"])
def test_weights_are_those_of_the_moment(case: str) -> None:
    """They are kept as long as nothing changes: neither covariances, nor the prior, nor who is fused."""
    sensors: dict[NodeId, float] = {1: 1.0, 2: 1.5, 3: 0.7}
    steps, network = 60, Network({1: (1, 2, 3), 2: (1, 2), 3: (2, 3)}, {})
    if case == "all but the network is steady":
        system = tracking.random_walk(sensors, F=0.5, Q=0.75, P0=1.0)
        rng = np.random.default_rng(12)
        used = dict(random_systems.random_used_sets(rng, network.neighbourhoods, steps, loss=0.2, late=0))
        heard = dict(random_systems.random_used_sets(rng, network.neighbourhoods, steps, loss=0.3, late=0))
        for k in range(25, steps):  # long enough for the covariances to settle
            used |= {(i, k): network.neighbours(i) for i in sensors}
    else:
        system = tracking.random_walk(sensors, F=0.9999, Q=1.0, P0=0.0)
        used = heard = dict(brute_force.always(network.neighbourhoods, steps))
    stacked = brute_force.stack(system, steps)
    intermediate = {i: brute_force.intermediate(stacked, i, used) for i in sensors}
    best = {i: brute_force.fused(stacked, intermediate, i, heard) for i in sensors}
    readings = measurements(system, 12, steps)
    exchange = Exchange(system, network)
    for k in range(1, steps + 1):
        exchange.step(k, at(readings, k), used, heard)
        for i, outcome in exchange.outcomes.items():
            np.testing.assert_allclose(outcome.P, best[i].covariance[k], rtol=1e-11)
        assert_best(exchange, stacked, best, stacked.vector(readings), k)


def test_an_estimate_that_did_not_arrive_has_no_weight_although_all_is_known_of_it() -> None:
    """As where its used set came with the answer to a question, and the state is settled and the same as before."""
    system = tracking.random_walk({1: 1.0, 2: 1.5, 3: 0.7, 4: 1.0, 5: 1.0}, F=0.5, Q=0.75, P0=1.0)
    network = Network({1: (1, 2, 3), 2: (2, 4), 3: (3, 5), 4: (4,), 5: (5,)}, {})
    method, ledger = TwoStage(Setting(1, system, network)), Ledger(1, 1)
    outcomes = []
    for k in range(1, 60):
        told: dict[NodeId, Fields] = {i: {"y": np.ones(1)} for i in system.ids}
        said = {1: cast(Fields, method.advance(0, k, told, ledger)), 2: {"x": np.zeros(1)}, 3: {"x": np.ones(1)}}
        for i in network.neighbours(1):
            ledger.learn(i, 1, k, network.neighbours(i), [(1, network.neighbours(i))] if k > 1 else [])
        here = {1: said[1], 2: said[2]} if k % 2 else {1: said[1], 3: said[3]}
        outcomes.append(cast(Outcome, method.advance(1, k, here, ledger)))
    (one, other) = outcomes[-2:]
    assert (one.used, other.used) == ((1, 3), (1, 2))
    assert abs(one.x[0] - other.x[0]) > 1e-3


# --- in the long run


def test_settling_does_not_change_the_estimates(monkeypatch: pytest.MonkeyPatch) -> None:
    system, network = paper.paper_system(), Network(paper.NEIGHBOURS, {})
    settling = run(system, network, TwoStage, steps=600)
    monkeypatch.setattr(covariances, "_settled", lambda *_: False)
    assert_same(settling, run(system, network, TwoStage, steps=600), 1e-12)


def test_a_shift_of_the_origin_shifts_the_estimates_and_nothing_else() -> None:
    sensors: dict[NodeId, float] = {1: 1.0, 2: 1.5, 3: 2.0, 4: 0.5}
    network, shift = Network.ring(sensors), 1e6
    near, far = (Exchange(tracking.target(sensors, origin=origin), network) for origin in (0.0, shift))
    path = SamplePath(tracking.target(sensors), 9)
    for k in range(1, 150):
        y = {i: path.measurement(i, k) for i in sensors}
        near.step(k, y)
        far.step(k, {i: reading + shift for i, reading in y.items()})
        for i in sensors:
            np.testing.assert_array_equal(far.outcomes[i].P, near.outcomes[i].P)
            np.testing.assert_allclose(far.outcomes[i].x - [shift, 0.0], near.outcomes[i].x, rtol=0, atol=1e-8)


def test_a_far_target_is_tracked_for_a_hundred_thousand_steps() -> None:
    """1e6 m away: the covariances settle, nothing drifts, and the errors stay what they are predicted to be."""
    sensors: dict[NodeId, float] = {1: 1.0, 2: 1.5, 3: 2.0}
    steps, checked = 100_000, 2_000
    system = tracking.target(sensors, origin=1e6)
    network, path = Network({1: (1, 2), 2: (1, 2, 3), 3: (2, 3)}, {}), SamplePath(system, 10)
    methods = {i: TwoStage(Setting(i, system, network)) for i in sensors}
    ledger, squares, predicted = Ledger(2, 1), np.zeros(2), np.zeros((2, 2))
    for k in range(1, steps + 1):
        told: dict[NodeId, Fields] = {i: {"y": path.measurement(i, k)} for i in sensors}
        said: dict[NodeId, Fields] = {}
        for i, method in methods.items():
            heard = {j: told[j] for j in network.neighbours(i)}
            said[i] = cast(Fields, method.advance(0, k, heard, ledger))
            ledger.learn(i, 1, k, network.neighbours(i), [(1, network.neighbours(i))] if k > 1 else [])
        if k > steps - checked - 200:  # the covariances are caught up with in the first few of these
            outcome = cast(Outcome, methods[2].advance(1, k, said, ledger))
        if k == steps - checked:
            predicted = outcome.P
        if k > steps - checked:
            assert outcome.used == (1, 2, 3)
            np.testing.assert_allclose(outcome.P, predicted, rtol=1e-10)
            squares += (outcome.x - path.truth(k)) ** 2 / checked
    assert predicted[0, 0] < 0.1
    # of `checked` squares, correlated over about 1/|1 - eigenvalue| = 30 steps, to 6 standard deviations
    np.testing.assert_allclose(squares, np.diag(predicted), rtol=6 * np.sqrt(2 * 2 * 30 / checked))
