"""The method `l2_linf` at its nodes: exact covariances, switching, misses, and the systems that it refuses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmi_examples import GRAPHS, IDS, MISSING, PAIRS, SURE, filters, run, switching, system
from zfusion.methods.convex import DesignError
from zfusion.methods.l2_linf import Design, L2Linf, L2LinfOptions, make_design, problem_of
from zfusion.methods.l2_linf.design import fingerprint
from zfusion.methods.protocol import Outcome, Setting
from zfusion.model.checks import ModelError
from zfusion.model.distributions import Bernoulli, Normal
from zfusion.model.matrices import Schedule, Terms
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array

CHAIN = ((0.7, 0.3), (0.4, 0.6))
MODES = [Network.from_matrix(IDS, matrix.tolist()) for matrix in (GRAPHS["RING"], PAIRS)]
UNION = Network.from_matrix(IDS, np.maximum(GRAPHS["RING"], PAIRS).tolist())
MEAN, P0 = [4.0, -2.0], np.diag([2.0, 0.5])


def misses(C: Array, chance: float) -> Terms:
    """θ C with a Bernoulli θ."""
    return Terms(((np.atleast_2d(C), ("theta",)),), {"theta": Bernoulli(chance)})


def example(arrival: tuple[float, ...] | None, **more: Any) -> System:
    """The example of `l2_linf` as a system, its disturbances white noises of unit variance."""
    p = switching(MISSING)
    H = p.C if arrival is None else [misses(c, chance) for c, chance in zip(p.C, arrival, strict=True)]
    return system(p.A, p.B @ p.B.T, H, [d @ d.T for d in p.D], mean=MEAN, P0=P0, **more)


@pytest.fixture(scope="module")
def sure() -> Design:
    return filters(SURE, "general")


@pytest.fixture(scope="module")
def missing() -> Design:
    return filters(MISSING, "general")


def mode_of(step: int) -> int:
    """Some modes."""
    return (step // 2) % 2


def nodes(design: Design, known: System, born: Mapping[int, int] | None = None) -> dict[int, L2Linf]:
    lives = born or {}
    return {i: L2Linf(Setting(i, known, UNION, lives.get(i, 1), design=design, mode=mode_of)) for i in IDS}


def test_a_system_becomes_the_problem_of_the_specification(sure: Design, missing: Design) -> None:
    """And that of the example's scenario, for which the fixtures were designed."""
    for arrival, design in ((None, sure), (MISSING, missing)):
        problem = problem_of(example(arrival), MODES, CHAIN, M=[[1.0, 0.0]])
        assert fingerprint(IDS, problem) == design.fingerprint == fingerprint(IDS, switching(arrival or SURE))
    np.testing.assert_allclose(missing.problem.arrival, MISSING, rtol=1e-12)
    np.testing.assert_allclose(missing.problem.C[2], switching(MISSING).C[2], rtol=1e-12)


def test_covariance_is_exact_from_the_first_step_on(sure: Design) -> None:
    """From the response to each noise alone: nothing but the model is used."""
    p, steps = switching(MISSING), 7
    columns = 2 + 5 * steps
    errors = np.zeros((columns + 1, steps, 4, 2))
    told: list[dict[int, Outcome]] = []
    for column in range(columns + 1):  # the last one is without any noise
        noise = np.eye(columns + 1)[column][:-1]
        x, w = np.array(MEAN) + np.sqrt(P0) @ noise[:2], noise[2:].reshape(steps, 5)
        states, readings = [], []
        for k in range(steps):
            x = p.A @ x + p.B @ np.eye(5)[0] * w[k, 0]
            states.append(x)
            readings.append({i: p.C[i - 1] @ x + p.D[i - 1] @ np.array([0, *w[k, 1:]]) for i in IDS})
        told = run(nodes(sure, example(None)), readings)
        errors[column] = [[states[k] - told[k][i].x for i in IDS] for k in range(steps)]
    assert np.abs(errors[-1]).max() < 2e-6  # the gains of a design are no observer's: unbiased by deviations
    for k, i in product(range(steps), IDS):
        found = errors[:-1, k, i - 1].T @ errors[:-1, k, i - 1]
        np.testing.assert_allclose(told[k][i].P, found, rtol=0, atol=1e-11)
        here = MODES[mode_of(k + 1)].neighbours(i)
        assert told[k][i].used == here


def outcomes_of_chance(count: int, chances: tuple[float, ...]) -> Iterator[tuple[Array, float]]:
    """All the θ of `count` steps, (count, n), and their probabilities."""
    for theta in product((0.0, 1.0), repeat=count * len(chances)):
        table = np.array(theta).reshape(count, len(chances))
        yield table, float(np.prod(np.where(table == 1, chances, 1 - np.array(chances))))


def test_covariance_is_exact_with_misses() -> None:
    """Two nodes, two steps: the mean over all 16 patterns of misses, each from the response to each noise."""
    A, H = np.array([[0.9, 0.2], [0.0, 0.7]]), (np.array([[1.0, 0]]), np.array([[0.5, 1.0]]))
    chances, steps = (0.8, 0.6), 3
    given = {"mean": MEAN, "P0": P0}
    known = system(A, 0.1 * np.eye(2), [misses(h, c) for h, c in zip(H, chances, strict=True)], [0.5, 0.3], **given)
    network = Network.complete((1, 2))
    design = make_design((1, 2), problem_of(known, [network]))
    columns = 2 + 4 * steps
    roots = np.sqrt(np.concatenate([P0.diagonal(), *[[0.1, 0.1, 0.5, 0.3]] * steps]))
    second, told = np.zeros((2, 2, 2)), {}
    for theta, chance in outcomes_of_chance(steps - 1, chances):
        for column in range(columns + 1):  # the last one is the mean's response
            noise = np.zeros(columns)
            if column < columns:
                noise[column] = roots[column]
            x = noise[:2] + (np.array(MEAN) if column == columns else 0.0)
            fresh = {i: L2Linf(Setting(i, known, network, design=design)) for i in (1, 2)}
            mean, readings = np.array(MEAN), []
            for k in range(steps):
                w = noise[2 + 4 * k : 6 + 4 * k]
                x, mean = A @ x + w[:2], A @ mean
                gains = theta[k] if k < steps - 1 else np.ones(2)
                offset = 0.0 if column == columns else 1.0  # what the nodes subtract of the mean themselves
                readings.append(
                    {
                        i: gains[i - 1] * H[i - 1] @ x + w[1 + i] + offset * chances[i - 1] * H[i - 1] @ mean
                        for i in (1, 2)
                    }
                )
            told = run(fresh, readings)[-1]
            for i in (1, 2):
                error = x + offset * mean - told[i].x
                second[i - 1] += chance * np.outer(error, error)
    for i in (1, 2):
        np.testing.assert_allclose(told[i].P, second[i - 1], rtol=0, atol=1e-10)


def noisy(steps: int, seed: int) -> tuple[Array, list[dict[int, Array]]]:
    """States of steps 1, 2, ... and all readings, with misses."""
    p, rng = switching(MISSING), np.random.default_rng(seed)
    x, states, readings = np.array(MEAN), [], []
    for _ in range(steps):
        w = rng.standard_normal(5)
        x = p.A @ x + p.B @ w
        states.append(x)
        seen = rng.random(4) < p.arrival
        readings.append({i: seen[i - 1] * p.C[i - 1] @ x + p.D[i - 1] @ rng.standard_normal(5) for i in IDS})
    return np.array(states), readings


def test_errors_are_as_large_as_they_are_said_to_be(missing: Design) -> None:
    """Mean of eᵀP⁻¹e over 20 stretches of 100 steps, far longer than errors remember: 6 sigma of their means."""
    states, readings = noisy(2000, 3)
    told = run(nodes(missing, example(MISSING)), readings)
    for i in IDS:
        errors = states - np.array([step[i].x for step in told])
        P = np.array([step[i].P for step in told])
        nees = np.einsum("ka,ka->k", errors, np.linalg.solve(P, errors[:, :, None])[:, :, 0])
        means = nees.reshape(20, 100).mean(axis=1)
        assert abs(means.mean() - 2) < 6 * means.std(ddof=1) / np.sqrt(20)


def test_nodes_that_hear_nobody_and_sensors_that_are_silent_stay_stable(missing: Design) -> None:
    states, readings = noisy(500, 5)
    silent: list[dict[int, Array | None]] = [{i: None if i == 2 else ys[i] for i in IDS} for ys in readings]
    for told in (
        run(nodes(missing, example(MISSING)), readings, lambda i, j, k: False),
        run(nodes(missing, example(MISSING)), silent, lambda i, j, k: (i + j + k) % 3 != 0),
    ):
        for i in IDS:
            errors = states - np.array([step[i].x for step in told])
            assert (errors**2).mean() < (states**2).mean()


def test_a_neighbour_of_another_mode_is_not_listened_to(sure: Design) -> None:
    readings = noisy(3, 1)[1]
    usual = run(nodes(sure, example(None)), readings)
    cut = run(nodes(sure, example(None)), readings, lambda j, i, k: j in MODES[mode_of(k)].neighbours(i))
    for k, i in product(range(3), IDS):
        np.testing.assert_array_equal(usual[k][i].x, cut[k][i].x)
        assert usual[k][i].used == cut[k][i].used


def test_an_observer_takes_an_absent_neighbour_as_agreeing() -> None:
    """With no neighbour and no reading it is just the prediction A x̂."""
    known = example(None)
    node = L2Linf(Setting(1, known, UNION, design=filters(SURE, "observer")))
    node.advance(0, 1, {1: node.begin(1, np.array([7.0]))}, None)  # type: ignore[arg-type]
    before = np.asarray(node.begin(2, None)["x"])
    node.skip(2)
    after = np.asarray(node.begin(3, None)["x"])
    np.testing.assert_allclose(after, known.F.items[0].mean @ before, atol=1e-6)


def test_a_restarted_node_begins_with_the_prior_and_says_so(sure: Design) -> None:
    known, born = example(None), 9
    told = run(nodes(sure, known), noisy(born, 2)[1])
    fresh = nodes(sure, known, {3: born})[3]
    outcome = fresh.advance(0, born, {3: fresh.begin(born, None)}, None)  # type: ignore[arg-type]
    assert isinstance(outcome, Outcome)
    A, P = known.F.items[0].mean, P0
    for _ in range(born):
        P = A @ P @ A.T + switching(MISSING).B @ switching(MISSING).B.T
    np.testing.assert_allclose(outcome.x, np.linalg.matrix_power(A, born) @ MEAN, atol=1e-12)
    np.testing.assert_allclose(outcome.P, P, atol=1e-12)
    assert outcome.P.trace() > told[-1][3].P.trace()


def test_a_late_birth_does_not_go_through_all_of_the_past(missing: Design, monkeypatch: pytest.MonkeyPatch) -> None:
    known, born = example(MISSING), 900
    covariances = []
    for remembered in (10**9, 300):  # errors shrink by 0.8 a step: 0.8^300 is nothing
        monkeypatch.setattr("zfusion.methods.l2_linf.filter.REMEMBERED", remembered)
        asked: list[int] = []

        def noted(step: int, asked: list[int] = asked) -> int:
            asked.append(step)
            return mode_of(step)

        node = L2Linf(Setting(1, known, UNION, born, design=missing, mode=noted))
        assert min(asked) == max(1, born - remembered)
        for step in range(born, born + 4):
            said = {1: node.begin(step, None)}
            outcome = node.advance(0, step, said, None)  # type: ignore[arg-type]
        assert isinstance(outcome, Outcome)
        covariances.append(outcome.P)
    np.testing.assert_allclose(covariances[0], covariances[1], rtol=1e-11)


def test_designs_are_kept_in_files(tmp_path: Path, missing: Design) -> None:
    missing.save(tmp_path / "d.npz")
    again = Design.load(tmp_path / "d.npz", missing.fingerprint)
    np.testing.assert_array_equal(again.gains.K, missing.gains.K)
    np.testing.assert_array_equal(again.gains.H, missing.gains.H)
    assert again.fingerprint == missing.fingerprint
    assert (again.gamma, again.certified, again.form, again.tau) == (missing.gamma, missing.certified, "general", None)
    K, H = again.edge(1, 1, 2)
    assert K.shape == (2, 2)
    assert H.shape == (2, 1)
    assert not again.edge(1, 1, 4)[0].any()  # no link in the second mode
    assert again.edge(0, 1, 4)[0].any()


def test_correlated_noises_of_one_step_are_no_obstacle() -> None:
    shared = np.array([[0.0], [0.02]])
    known = example(None, S0={1: Schedule.constant(shared)}, correlated={(1, 2): Schedule.constant([[0.1]])})
    problem = problem_of(known, MODES, CHAIN)
    np.testing.assert_allclose(problem.B @ problem.D[0].T, shared, atol=1e-12)
    np.testing.assert_allclose(problem.D[0] @ problem.D[1].T, [[0.1]], atol=1e-12)


def test_any_scalar_factor_is_as_good_as_a_bernoulli() -> None:
    fading = Terms(((np.array([[2.0, 0.0]]), ("gain",)),), {"gain": Normal(0.5, 0.04)})
    p = switching(MISSING)
    known = system(p.A, p.B @ p.B.T, [fading, *p.C[1:]], [d @ d.T for d in p.D])
    problem = problem_of(known, MODES, CHAIN)
    chance = problem.arrival[0]
    np.testing.assert_allclose(chance * problem.C[0], [[1.0, 0.0]], rtol=1e-12)
    np.testing.assert_allclose(problem.spread(0) * problem.C[0], [[0.4, 0.0]], rtol=1e-12)


ONE = np.array([[1.0, 0.0]])
TWO = Terms(((ONE, ("a",)), (np.array([[0.0, 1.0]]), ("b",))), {"a": Bernoulli(0.5), "b": Bernoulli(0.5)})
NEVER = Terms(((ONE, ("a",)),), {"a": Normal(0.0, 1.0)})
FADING = Terms(((np.eye(2) * 0.9, ("a",)),), {"a": Bernoulli(0.9)})
SLOW = np.diag([0.1, 0.1])


@pytest.mark.parametrize(
    ("H", "noise", "words"),
    [
        (TWO, {}, "random by a scalar factor only; not so H of sensor 1"),
        (NEVER, {}, "mean is not zero; H of sensor 1"),
        (ONE, {"Q1": Schedule.constant(0.1 * SLOW)}, "needs white noises"),
        (ONE, {"S2": {1: Schedule.constant(np.full((2, 1), 0.01))}}, "noises of later steps"),
    ],
)
def test_systems_that_the_method_cannot_stand_are_refused(H: Any, noise: dict[str, Any], words: str) -> None:
    with pytest.raises(DesignError, match=words):
        problem_of(system(SLOW, SLOW, [H, ONE], [1.0, 1.0], **noise), [Network.complete((1, 2))])


def test_unstable_and_random_dynamics_are_refused() -> None:
    network = [Network.complete((1,))]
    with pytest.raises(DesignError, match="A is not Schur stable"):
        problem_of(system(2 * np.eye(2), SLOW, [ONE], [1.0]), network)
    known = system(SLOW, SLOW, [ONE], [1.0])
    random = System(2, np.zeros(2), np.eye(2), Schedule.constant(FADING), known.sensors, known.noise)
    with pytest.raises(DesignError, match="needs matrices that are not random; F is"):
        problem_of(random, network)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"form": "any"}, "form: expected one of"),
        ({"slack": 1}, "slack: expected true or false"),
        ({"output": [1.0]}, "output: expected an array"),
    ],
)
def test_options_that_cannot_be_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        L2LinfOptions(**given)
