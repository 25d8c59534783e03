"""The method `stationary` at its nodes: exact covariances, losses, restarts, and the systems that it refuses."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmi_examples import GRAPHS, IDS, Arrives, designed, plant, run, stationary_system, system
from simulations import losing, record, walk
from zfusion.drivers.replayed import verify
from zfusion.methods.convex import DesignError
from zfusion.methods.protocol import Outcome, Setting
from zfusion.methods.stationary import Design, Stationary, StationaryOptions, problem_of
from zfusion.methods.stationary.cost import Gains
from zfusion.methods.stationary.design import fingerprint
from zfusion.methods.stationary.limits import own_sensor_mse
from zfusion.methods.stationary.losses import under_loss
from zfusion.model.checks import ModelError
from zfusion.model.distributions import Bernoulli
from zfusion.model.matrices import Fixed, Schedule, Terms
from zfusion.model.network import Network
from zfusion.model.noise import CovarianceNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array
from zfusion.recording import Recording

RING = Network.from_matrix(IDS, GRAPHS["RING"].tolist())
MEAN = [5.0, -3.0, 2.0]
P0 = np.diag([2.0, 1.0, 0.5])


def nodes(design: Design, *, filtered: bool = False, born: Mapping[int, int] | None = None) -> dict[int, Stationary]:
    known = stationary_system(mean=MEAN, P0=P0)
    lives, options = born or {}, StationaryOptions(filtered=filtered)
    return {i: Stationary(Setting(i, known, RING, lives.get(i, 1), options=options, design=design)) for i in IDS}


def by_impulses(design: Design, steps: int, arrives: Arrives, filtered: bool) -> tuple[list[dict[int, Array]], Any]:
    """Cov[x_k - x̂_k] of every node and step, from the response to each noise alone: nothing but the model is used."""
    p = plant()
    columns = 3 + 3 * steps + 4 * steps
    roots = np.sqrt(
        np.concatenate([P0.diagonal(), *[p.Q.diagonal()] * steps, *[[float(v[0, 0]) for v in p.V]] * steps])
    )
    errors = np.zeros((columns + 1, steps, 4, 3))
    outcomes: list[dict[int, Outcome]] = []
    for column in range(columns + 1):  # the last one is without any noise
        noise = np.zeros(columns)
        if column < columns:
            noise[column] = roots[column]
        w, v = noise[3 : 3 + 3 * steps].reshape(steps, 3), noise[3 + 3 * steps :].reshape(steps, 4)
        x, states = np.array(MEAN) + noise[:3], []
        for k in range(steps):
            x = p.A @ x + w[k]
            states.append(x)
        readings = [{i: p.C[i - 1] @ states[k] + v[k, i - 1] for i in IDS} for k in range(steps)]
        outcomes = run(nodes(design, filtered=filtered), readings, arrives)
        errors[column] = [[states[k] - outcomes[k][i].x for i in IDS] for k in range(steps)]
    assert np.abs(errors[-1]).max() < 1e-12  # unbiased, whatever the prior mean
    found = [{i: errors[:-1, k, i - 1].T @ errors[:-1, k, i - 1] for i in IDS} for k in range(steps)]
    return found, outcomes


@pytest.mark.parametrize("filtered", [False, True])
def test_covariance_is_exact_from_the_first_step_on(filtered: bool) -> None:
    found, outcomes = by_impulses(designed("RING"), 6, lambda i, j, k: True, filtered)
    for covariances, told in zip(found, outcomes, strict=True):
        for i in IDS:
            np.testing.assert_allclose(told[i].P, covariances[i], rtol=0, atol=1e-11)
            assert told[i].used == RING.neighbours(i)


@pytest.mark.parametrize("filtered", [False, True])
def test_covariance_counts_what_is_missing_at_the_step_itself(filtered: bool) -> None:
    found, outcomes = by_impulses(designed("RING"), 4, lambda i, j, k: k < 4, filtered)
    whole = run(nodes(designed("RING"), filtered=filtered), noisy(4, 1)[1])
    for i in IDS:
        np.testing.assert_allclose(outcomes[-1][i].P, found[-1][i], rtol=0, atol=1e-11)
        assert outcomes[-1][i].used == (i,)
        assert outcomes[-1][i].P.trace() > whole[-1][i].P.trace()


def noisy(steps: int, seed: int) -> tuple[Array, list[dict[int, Array]]]:
    """States of steps 1, 2, ... and all readings."""
    p, rng = plant(), np.random.default_rng(seed)
    x = np.array(MEAN) + np.sqrt(P0) @ rng.standard_normal(3)
    states, readings = [], []
    for _ in range(steps):
        x = p.A @ x + np.sqrt(p.Q) @ rng.standard_normal(3)
        states.append(x)
        noises = [float(np.sqrt(v[0, 0])) * rng.standard_normal(1) for v in p.V]
        readings.append({i: p.C[i - 1] @ x + noises[i - 1] for i in IDS})
    return np.array(states), readings


def test_settled_errors_are_those_of_the_design() -> None:
    outcomes = run(nodes(designed("RING")), noisy(400, 1)[1])
    for i in IDS:
        assert outcomes[-1][i].P.trace() == pytest.approx(designed("RING").mse[i - 1], rel=1e-9)
    better = run(nodes(designed("RING"), filtered=True), noisy(400, 1)[1])
    assert all(better[-1][i].P.trace() < outcomes[-1][i].P.trace() for i in IDS)


def test_errors_under_loss_are_those_that_are_computed() -> None:
    """Mean over 20 stretches of 200 steps each, far longer than errors remember: 6 sigma of the stretches' means."""
    loss, steps, stretches = 0.3, 200, 20
    rng = np.random.default_rng(3)
    lost = rng.random((stretches * steps + 1, 5, 5)) < loss
    states, readings = noisy(stretches * steps, 7)
    outcomes = run(nodes(designed("RING")), readings, lambda i, j, k: not lost[k, i, j])
    predicted = under_loss(designed("RING"), loss).mse
    for i in IDS:
        squares = ((states - np.array([told[i].x for told in outcomes])) ** 2).sum(axis=1)
        means = squares.reshape(stretches, steps).mean(axis=1)
        assert abs(means.mean() - predicted[i - 1]) < 6 * means.std(ddof=1) / np.sqrt(stretches)
        assert outcomes[-1][i].P.trace() < predicted[i - 1]  # what the node says is optimistic, as it is documented


def test_nodes_that_hear_nobody_and_sensors_that_are_silent_stay_stable() -> None:
    states, readings = noisy(800, 5)
    alone = run(nodes(designed("RING")), readings, lambda i, j, k: False)
    errors = np.array([[states[k] - alone[k][i].x for i in IDS] for k in range(len(states))])
    assert ((errors**2).sum(axis=2).mean(axis=0) < 2 * own_sensor_mse(plant())).all()
    silent: list[dict[int, Array | None]] = [{i: None if i != 2 else ys[2] for i in IDS} for ys in readings]
    assert all(np.isfinite(told[i].x).all() for told in run(nodes(designed("RING")), silent) for i in IDS)


def test_what_arrives_out_of_order_or_from_strangers_changes_nothing() -> None:
    readings = noisy(1, 2)[1]
    design, fields = designed("RING"), {}
    for order in ((1, 4, 3), (4, 3, 1)):
        fresh = nodes(design)
        said = {i: node.begin(1, readings[0][i]) for i, node in fresh.items()}
        node = fresh[1]
        node.advance(0, 1, {j: said[j] for j in order}, None)  # type: ignore[arg-type]
        fields[order] = node.begin(2, None)["xi"]
    first, second = fields.values()
    np.testing.assert_array_equal(first, second)


def test_a_restarted_node_begins_with_the_prior_and_says_so() -> None:
    steps, born = 60, 40
    readings = noisy(steps, 9)[1]
    design = designed("RING")
    told = run(nodes(design), readings)
    fresh = nodes(design, born={2: born})[2]
    outcome = fresh.advance(0, born, {2: fresh.begin(born, readings[born - 1][2])}, None)  # type: ignore[arg-type]
    assert isinstance(outcome, Outcome)
    A = np.linalg.matrix_power(plant().A, born)
    np.testing.assert_allclose(outcome.x, A @ MEAN, atol=1e-12)  # it knows nothing else yet
    prior = stationary_system(mean=MEAN, P0=P0).initial_covariance
    for _ in range(born):
        prior = plant().A @ prior @ plant().A.T + plant().Q
    np.testing.assert_allclose(outcome.P, prior, rtol=1e-10)
    assert outcome.P.trace() > told[born - 1][2].P.trace()


def test_steps_that_are_slept_through_are_steps_without_messages() -> None:
    readings: list[dict[int, Array | None]] = [dict(ys) for ys in noisy(5, 4)[1]]
    awake, asleep = nodes(designed("RING")), nodes(designed("RING"))
    readings[2] = {i: None if i == 3 else y for i, y in readings[2].items()}
    told = run(awake, readings, lambda i, j, k: k != 3 or 3 not in (i, j))
    for step, ys in enumerate(readings, 1):
        said = {i: asleep[i].begin(step, ys[i]) for i in IDS if (step, i) != (3, 3)}
        for i in IDS:
            if (step, i) == (3, 3):
                asleep[i].skip(3)
                continue
            outcome = asleep[i].advance(0, step, said, None)  # type: ignore[arg-type]
            assert isinstance(outcome, Outcome)
            np.testing.assert_array_equal(outcome.x, told[step - 1][i].x)


def test_designs_are_kept_in_files(tmp_path: Path) -> None:
    design = designed("RING")
    design.save(tmp_path / "d.npz")
    again = Design.load(tmp_path / "d.npz", design.fingerprint)
    for name in Gains._fields:
        np.testing.assert_array_equal(getattr(again.gains, name), getattr(design.gains, name))
    assert (again.ids, again.J, again.bound, again.solver) == (design.ids, design.J, design.bound, design.solver)
    assert again.node_bounds is None
    readings = noisy(20, 1)[1]
    first, second = run(nodes(design), readings), run(nodes(again), readings)
    for i in IDS:
        np.testing.assert_array_equal(first[-1][i].x, second[-1][i].x)
        np.testing.assert_allclose(first[-1][i].P, second[-1][i].P, rtol=1e-12)


def test_a_system_becomes_the_problem_of_its_design() -> None:
    problem = problem_of(stationary_system(), RING)
    np.testing.assert_array_equal(problem.F, GRAPHS["RING"] > 0)
    assert fingerprint(IDS, problem) == designed("RING").fingerprint


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"gramian": "gram"}, "gramian: expected one of"),
        ({"plain": 1}, "plain: expected true or false"),
        ({"refine": "yes"}, "refine: expected true or false"),
        ({"doubt": -0.1}, "doubt: expected a number >= 0"),
        ({"doubt": True}, "doubt: expected a number >= 0"),
    ],
)
def test_options_that_cannot_be_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        StationaryOptions(**given)


def test_options_say_what_is_designed() -> None:
    """Here: nothing of neighbours but their ξ, and the worst node as good as can be."""
    options = StationaryOptions(gramian="controllability", worst_node=True, exchange_measurements=False)
    design = options.design(stationary_system(), RING)
    assert design.node_bounds is not None
    assert np.ptp(design.node_bounds) < 1e-3
    assert not design.edge(1, 4)[1].any()
    limit = design.information_limit.sum()
    assert designed("RING").information_limit.sum() < limit <= design.J < own_sensor_mse(plant()).sum()


A, Q, C, V = plant().A, plant().Q, plant().C, plant().V
HALF = np.full((1, 1), 0.1)
RANDOM = Terms(((np.array([[1.0, 0, 0]]), ("t",)),), {"t": Bernoulli(0.8)})


def varying(**more: Any) -> System:
    known = stationary_system()
    given = {n: getattr(known, n) for n in ("nx", "initial_mean", "initial_covariance", "F", "sensors", "noise")}
    return System(**(given | more))


def sensors_with(H: Schedule[Any]) -> tuple[Sensor, ...]:
    return (Sensor(1, 1, H), *stationary_system().sensors[1:])


@pytest.mark.parametrize(
    ("unfit", "words"),
    [
        (lambda: varying(F=Schedule((Fixed(A), Fixed(A / 2)))), "needs constant matrices; F varies with time"),
        (lambda: varying(sensors=sensors_with(Schedule((Fixed(C[0]), Fixed(C[1])), 1))), "H of sensor 1 varies"),
        (lambda: system(A, Q, [RANDOM, *C[1:]], V), "needs matrices that are not random; H of sensor 1 is"),
        (lambda: stationary_system(Q1=Schedule.constant(0.1 * Q)), "needs white noises"),
        (lambda: stationary_system(R1={(1, 2): Schedule.constant(HALF)}), "needs white noises"),
        (lambda: stationary_system(S0={1: Schedule.constant(np.full((3, 1), 0.01))}), "uncorrelated with the measure"),
        (lambda: stationary_system(S1={1: Schedule.constant(np.full((3, 1), 0.01))}), "noises of later steps"),
        (lambda: stationary_system(correlated={(1, 2): Schedule.constant(HALF)}), "uncorrelated with one another"),
        (lambda: varying(noise=changing_noise()), "noises of constant covariance"),
        (lambda: system(1.2 * A, Q, C, V), r"A is not asymptotically stable \(spectral radius 1.12"),
    ],
)
def test_systems_that_the_method_cannot_stand_are_refused(unfit: Any, words: str) -> None:
    with pytest.raises(DesignError, match=words):
        problem_of(unfit(), RING)


def changing_noise() -> CovarianceNoise:
    return CovarianceNoise(Schedule((Q, 2 * Q)), {(i, i): Schedule.constant(v) for i, v in zip(IDS, V, strict=True)})


STABLE: dict[str, Any] = {
    "system": {
        "F": [[0.9, 0.1], [0.0, 0.95]],
        "Q": [[0.02, 0.01], [0.01, 0.1]],
        "initial_mean": [3.0, -1.0],
        "initial_covariance": [[2.0, 0.3], [0.3, 1.0]],
    }
}


def test_a_simulated_swarm_is_replayed_bit_for_bit(tmp_path: Path) -> None:
    scenario = walk(40, method={"name": "stationary"}, **STABLE)
    path = record(tmp_path / "run.mcap", scenario, losing(0.2, 1))
    with Recording.open(path) as recording:
        verdict = verify(recording)
    assert verdict.verified
    assert (verdict.identical, verdict.unverifiable) == (5 * 40 * 2, 0)
