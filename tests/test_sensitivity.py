"""What delay and loss do to the errors, by theory: against the nodes, against enumeration, against squared errors."""

from __future__ import annotations

import itertools
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
import pytest

from oracles import brute_force
from simulations import four_sensor, walk
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError
from zfusion.methods.prediction import predict
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.stages import Message
from zfusion.studies import sensitivity
from zfusion.studies.certainty import certainty
from zfusion.studies.enumeration import exact_means
from zfusion.studies.fates import fate_of, method_network
from zfusion.studies.sensitivity import Moments, covariances, under_links

SLOW = {"distribution": "exponential", "mean": 0.02}
REVISE = {"rate_hz": 20.0, "late": "revise", "window": 4}
FAULTS: list[dict[str, Any]] = [
    {"kind": "kill", "node": 2, "step": 10, "restart_after": 5},
    {"kind": "stop", "node": 3, "step": 20, "steps": 4},
    {"kind": "partition", "groups": [[1, 2]], "step": 26, "steps": 3},
]


@pytest.fixture
def hardly_exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few combinations, which take no time: for tests of what is sampled."""
    monkeypatch.setattr(sensitivity, "exact_means", partial(exact_means, limit=16))


def four(steps: int = 40, **changes: Any) -> Scenario:
    return Scenario.model_validate(four_sensor(steps=steps)._document() | changes)


def reported(scenario: Scenario) -> dict[tuple[NodeId, int], Array]:
    """P of every estimate in a simulation."""
    found: dict[tuple[NodeId, int], Any] = {}

    def observe(message: Message, _now: int) -> None:
        if message.stage == "estimate":
            found[message.node, message.step] = message.fields["P"]

    Simulation(scenario, observe=observe).run()
    return found


@pytest.mark.parametrize(
    "changes",
    [
        {"links": {"loss": 0.3}},
        {"links": {"loss": 0.8}},
        {"links": {"loss": {"gilbert_elliott": {"to_bad": 0.1, "to_good": 0.3}}, "duplicate": 0.2}},
        {"links": {"delay": SLOW}},
        {"links": {"delay": SLOW, "loss": 0.1}, "timing": REVISE},
        {"links": {"delay": SLOW, "loss": 0.1}, "timing": {"rate_hz": 20.0, "late": "wait"}},
        {"links": {"delay": SLOW, "loss": 0.05}, "timing": {"free_run": True}},
        {"links": {"loss": 0.1}, "faults": FAULTS},
        {"links": {"delay": SLOW, "reorder": True}, "timing": REVISE, "faults": FAULTS[:1]},
        {"links": {"loss": 0.3}, "method": "centralized"},
    ],
    ids=str,
)
def test_what_is_predicted_for_a_fate_is_what_the_nodes_report(changes: dict[str, Any]) -> None:
    """Node by node and step by step: loss, lateness, policies, crashes; nothing is said of steps without estimate."""
    scenario = four(**changes)
    told, fate = reported(scenario), fate_of(scenario)
    for k, (_, distributed) in enumerate(covariances(scenario, [fate]), start=1):
        for n, i in enumerate(method_network(scenario).ids):
            assert ((i, k) in told) == fate.made[k - 1, n]
            if (i, k) in told:
                np.testing.assert_allclose(distributed[0, n], told[i, k], rtol=1e-10)


def test_the_samples_are_the_seeds_of_simulations() -> None:
    scenario = four(20, links={"loss": 0.3, "delay": {"distribution": "uniform", "low": 0.0, "high": 0.04}})
    under = under_links(scenario, 4)
    told = [reported(scenario.with_overrides(seed=scenario.seed + n)) for n in range(4)]
    traces = np.array([[[np.trace(of[i, k]) for i in scenario.ids] for k in range(1, 21)] for of in told])
    assert (under.samples, under.exact) == (4, False)
    np.testing.assert_allclose(np.einsum("kmaa->km", under.distributed.covariance)[1:], traces.mean(0), rtol=1e-10)
    margin = 3.182446305 * traces.std(0, ddof=1) / 2  # Student's t, 3 degrees of freedom
    np.testing.assert_allclose(under.distributed.high[1:], traces.mean(0) + margin, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(under.distributed.low[1:], traces.mean(0) - margin, rtol=1e-8, atol=1e-9)


def test_other_seeds_agree_within_the_interval(hardly_exact: None) -> None:
    """Of 4 nodes x 12 steps at most as many means may lie outside 99.99 % as chance allows: none."""
    scenario = four(12, links={"loss": 0.2})
    under = under_links(scenario, 60)
    told = [reported(scenario.with_overrides(seed=1000 + n)) for n in range(12)]
    traces = np.array([[[np.trace(of[i, k]) for i in scenario.ids] for k in range(1, 13)] for of in told])
    mean = np.einsum("kmaa->km", under.distributed.covariance)[1:]
    own = (under.distributed.high - under.distributed.low)[1:] / (2 * 2.001)
    error = np.sqrt(own**2 + traces.var(0, ddof=1) / len(told))
    assert (np.abs(traces.mean(0) - mean) < 4.5 * error + 1e-12).all()


def test_squared_errors_agree_with_the_prediction(hardly_exact: None) -> None:
    """Gaussian throughout: over 30 seeds, the mean of |x̂ - x|² is the predicted one within 5 standard errors."""
    scenario = walk(steps=6).with_overrides(loss=0.25)
    wanted = float(np.mean(np.einsum("kmaa->km", under_links(scenario, 40).distributed.covariance)[1:]))
    found = []
    for seed in range(500, 530):
        chosen, squared = scenario.with_overrides(seed=seed), []
        path = SamplePath(chosen.system(), seed)

        def observe(message: Message, _now: int, path: SamplePath = path, squared: list[float] = squared) -> None:
            if message.stage == "estimate":
                squared.append(float(np.sum((message.fields["x"] - path.truth(message.step)) ** 2)))  # type: ignore[operator]

        Simulation(chosen, observe=observe).run()
        found.append(np.mean(squared))
    assert abs(np.mean(found) - wanted) < 5 * np.std(found, ddof=1) / sqrt(len(found))
    ideal = predict(scenario.system(), scenario.network, 6).distributed
    assert wanted > 1.03 * np.mean(np.einsum("kmaa->km", ideal)[1:])


def test_enumeration_is_the_sum_over_everything_that_can_happen() -> None:
    """Two nodes, two steps, brute-force projection of each of 2^4 histories and 2 messages of the last stage."""
    loss = {(1, 2): 0.3, (2, 1): 0.6}
    scenario = Scenario.model_validate(
        {
            "steps": 2,
            "network": {"generator": "complete"},
            "system": {"F": 0.9, "Q": 0.5, "initial_covariance": 2.0, "initial_mean": 1.0},
            "sensors": [{"id": 1, "H": 1.0, "R": 1.0}, {"id": 2, "H": 0.5, "R": 0.3}],
            "links": {"edges": [{"from": j, "to": i, "loss": p} for (j, i), p in loss.items()]},
        }
    )
    stacked = brute_force.stack(scenario.system(), 2)
    intermediate, distributed = np.zeros((2, 2)), np.zeros((2, 2))
    for lost in itertools.product((False, True), repeat=6):
        heard = {(j, i, k): lost[2 * k + n] for n, (j, i) in enumerate(loss) for k in range(3)}
        weight = np.prod([loss[j, i] if gone else 1 - loss[j, i] for (j, i, _), gone in heard.items()])
        used: dict[tuple[NodeId, int], tuple[NodeId, ...]] = {(1, 0): (), (2, 0): ()}
        for i, j in ((1, 2), (2, 1)):
            used |= {(i, k + 1): (i,) if heard[j, i, k] else (1, 2) for k in range(2)}
        estimates = {i: brute_force.intermediate(stacked, i, used) for i in (1, 2)}
        for i, j in ((1, 2), (2, 1)):
            told = {(i, k): () if heard[j, i, 2] else (j,) for k in range(3)}
            fused = brute_force.fused(stacked, estimates, i, told)
            intermediate[:, i - 1] += weight * estimates[i].covariance[1:, 0, 0]
            distributed[:, i - 1] += weight * fused.covariance[1:, 0, 0]
    known = certainty(scenario)
    assert known is not None
    exact = exact_means(scenario, known)
    np.testing.assert_allclose(np.array(exact[0])[:, :, 0, 0].T, intermediate, rtol=1e-9)
    np.testing.assert_allclose(np.array(exact[1])[:, :, 0, 0].T, distributed, rtol=1e-9)


def test_where_there_is_too_much_to_enumerate_nothing_is_exact() -> None:
    scenario = four(3, links={"loss": 0.2})
    known = certainty(scenario)
    assert known is not None
    assert [len(of) for part in exact_means(scenario, known, limit=1) for of in part] == [0] * 8


def test_the_first_steps_are_exact_and_what_is_sampled_agrees_with_them() -> None:
    scenario = four(8, links={"loss": 0.2, "delay": 0.004})
    under = under_links(scenario, 20)
    assert under.distributed.exact_steps == (2, 2, 2, 2)
    assert under.intermediate.exact_steps == (6, 6, 6, 6)
    assert (under.intermediate.low[:7] == under.intermediate.high[:7]).all()
    assert (under.intermediate.low[7] < under.intermediate.high[7]).all()
    bursty = {"gilbert_elliott": {"to_bad": 0.2, "to_good": 0.8, "loss_bad": 1.0}}
    assert certainty(four(8, links={"loss": bursty})) is None
    parts = [fate_of(scenario.with_overrides(seed=seed)) for seed in range(100, 200)]
    moments = Moments((9, 4, 1, 1))
    for k, (P, _) in enumerate(covariances(scenario, parts), start=1):
        moments.add(k, P, np.ones((100, 4), dtype=np.bool_))
    sampled = moments.mean((0,) * 4)
    half = (sampled.high - sampled.low) / 2
    off = np.abs(np.einsum("kmaa->km", sampled.covariance - under.intermediate.covariance))[1:7]
    assert (off <= 4.5 / 1.984 * half[1:7] + 1e-12).all()


@pytest.mark.parametrize(
    ("links", "timing"),
    [
        ({"delay": 0.01}, {}),
        ({"delay": 0.03}, {}),
        ({"loss": 1.0}, {}),
        ({"delay": {"distribution": "uniform", "low": 0.0, "high": 0.02}}, {}),
        ({"delay": {"distribution": "uniform", "low": 0.03, "high": 0.04}, "reorder": True}, {}),
        ({"edges": [{"from": 1, "to": 3, "loss": 1.0}]}, {"late": "wait"}),
        ({"topology": {"modes": [{"generator": "ring"}], "schedule": [{"step": 1, "mode": 0}]}}, {}),
    ],
    ids=str,
)
def test_what_is_certain_needs_one_realisation(links: dict[str, Any], timing: dict[str, Any]) -> None:
    scenario = Scenario.model_validate(
        walk(12)._document() | {"links": links, "timing": {"rate_hz": 20.0, **timing}}
        if "topology" in links
        else four(12)._document() | {"links": links, "timing": {"rate_hz": 20.0, **timing}}
    )
    under = under_links(scenario, 50)
    assert under.exact
    assert (under.distributed.low == under.distributed.high).all()
    for seed in (1, 2):
        for (i, k), P in reported(scenario.with_overrides(seed=seed)).items():
            np.testing.assert_allclose(under.distributed.covariance[k, scenario.ids.index(i)], P, rtol=1e-10)


@pytest.mark.parametrize(
    "links",
    [
        {"delay": {"distribution": "uniform", "low": 0.0, "high": 0.06}},
        {"delay": SLOW},
        {"loss": 0.01},
        {"edges": [{"from": 1, "to": 3, "stages": "intermediate", "loss": 0.5}]},
        {"delay": {"mixture": [{"weight": 9, "delay": 0.0}, {"weight": 1, "delay": 0.2}]}},
    ],
    ids=str,
)
def test_what_is_left_to_chance_is_sampled(links: dict[str, Any]) -> None:
    known = certainty(four(10, links=links))
    assert known is None or not known.complete


def test_named_messages_are_certain_in_a_network_of_chance() -> None:
    links = {"loss": 0.5, "messages": [{"from": 2, "to": 1, "stage": "measurement", "steps": [1, 3], "delay": 0.0}]}
    known = certainty(four(3, links=links))
    assert known is not None
    arc = [
        at
        for at, pair in enumerate((i, j) for i in (1, 2, 3, 4) for j in four().network.neighbours(i))
        if pair == (1, 2)
    ]
    np.testing.assert_array_equal(known.used[:, arc[0]], [1.0, 0.5, 1.0])


def test_processes_add_up_to_the_same_bits(monkeypatch: pytest.MonkeyPatch, hardly_exact: None) -> None:
    scenario = four(8, links={"loss": 0.4})
    monkeypatch.setattr(sensitivity, "TOGETHER", 8)
    alone = under_links(scenario, 20)
    monkeypatch.setattr(sensitivity, "WORTH_PROCESSES", 0)
    steps: list[int] = []
    shared = under_links(scenario, 20, jobs=2, progress=steps.append)
    assert sum(steps) == 20
    np.testing.assert_array_equal(alone.distributed.covariance, shared.distributed.covariance)
    np.testing.assert_array_equal(alone.distributed.high, shared.distributed.high)


def test_a_node_that_is_dead_has_no_error(hardly_exact: None) -> None:
    scenario = four(8, links={"loss": 0.2}, faults=[{"kind": "kill", "node": 2, "step": 3, "restart_after": 3}])
    under = under_links(scenario, 5)
    assert np.isnan(under.distributed.covariance[3:6, 1]).all()
    assert not np.isnan(under.distributed.covariance[[2, 6], 1]).any()


def test_one_sample_is_not_enough() -> None:
    with pytest.raises(InputError, match="samples"):
        under_links(four(3), 1)
