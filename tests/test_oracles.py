"""The oracles are right: they agree with the definition, with one another, and with the published example."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from oracles import brute_force, paper, printed_form, random_systems
from oracles.brute_force import StackedSystem
from zfusion.model.distributions import Bernoulli
from zfusion.model.matrices import Schedule, Terms
from zfusion.model.noise import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId

STEPS = 10
NAMES: tuple[NodeId, ...] = ("attic", "cellar", "hall", "yard")
KINDS: list[dict[str, Any]] = [
    {"nx": 1},
    {"nx": 2, "ids": NAMES},
    {"nx": 3, "varying": True},
    {"nx": 2, "mean": 0.0},
    {"nx": 3, "noise": "white"},
    {"nx": 2, "radius": 1.2, "varying": True},
    {"nx": 2, "multiplicative": False},
    {},
]


def relative(value: Array, wanted: Array) -> float:
    """Largest difference, in parts of the largest number that is wanted."""
    return float(np.abs(value - wanted).max() / max(np.abs(wanted).max(), 1e-300))


@pytest.fixture(scope="module")
def predicted() -> brute_force.ErrorCovariances:
    return brute_force.error_covariances(paper.paper_system(), paper.NEIGHBOURS, 100)


# --- the published example


@pytest.mark.parametrize("k", paper.ERROR_VARIANCES)
def test_brute_force_gives_the_published_variances_to_all_digits(
    predicted: brute_force.ErrorCovariances, k: int
) -> None:
    for estimate, wanted in paper.ERROR_VARIANCES[k].items():
        np.testing.assert_allclose(getattr(predicted, estimate)[k].ravel(), wanted, rtol=0, atol=5e-11)


def test_before_any_measurement_the_error_is_the_states_own_deviation(
    predicted: brute_force.ErrorCovariances,
) -> None:
    for column in predicted:
        np.testing.assert_allclose(column[0].ravel(), 1.0, rtol=1e-14)


def test_printed_form_agrees_with_brute_force_on_the_published_example(
    predicted: brute_force.ErrorCovariances,
) -> None:
    printed = printed_form.network_recursion(paper.paper_system(), paper.NEIGHBOURS)
    for k in range(101):
        stage_1 = [printed.stage_1[i].P for i in paper.NEIGHBOURS]
        stage_2 = [printed.fused[i].P for i in paper.NEIGHBOURS]
        np.testing.assert_allclose(stage_1, predicted.intermediate[k], rtol=1e-12)
        np.testing.assert_allclose(stage_2, predicted.distributed[k], rtol=1e-11)
        printed.step()


# --- the projection against the definition


def test_stacked_moments_are_those_of_every_outcome_weighted_by_its_probability() -> None:
    """With a coin in F and one in H, every second moment is a finite sum over outcomes of the 2 K throws."""
    rng = np.random.default_rng(1)
    F0, F1, H0, H1, A, B, C, D = rng.normal(size=(8, 2, 2))
    steps, p, q, mean = 3, 0.3, 0.6, rng.normal(size=2)
    system = System(
        nx=2,
        initial_mean=mean,
        initial_covariance=np.eye(2),
        F=Schedule((Terms(((F0, ()), (F1, ("coin",))), {"coin": Bernoulli(p)}),)),
        sensors=(Sensor(1, 2, Schedule((Terms(((H0, ()), (H1, ("coin",))), {"coin": Bernoulli(q)}),), first=1)),),
        noise=MovingAverageNoise(
            white={"eta": WhiteNoise(np.eye(2))},
            process=(Tap("eta", 0, Schedule((A,))), Tap("eta", 1, Schedule((B,)))),
            sensors={1: (Tap("eta", -1, Schedule((C,))), Tap("eta", 0, Schedule((D,))))},
        ),
    )
    # rows over the constant 1, x_0 - E[x_0], η_0, ..., η_K
    one, deviation, *eta = np.split(np.eye(5 + 2 * steps), [1, *range(3, 5 + 2 * steps, 2)])
    moments = np.zeros((2 * (2 * steps + 1),) * 2)
    for coins in product((0, 1), repeat=2 * steps):
        f, h = coins[:steps], coins[steps:]
        states, readings = [mean[:, None] * one + deviation], []
        for k in range(1, steps + 1):
            states.append((F0 + f[k - 1] * F1) @ states[-1] + A @ eta[k - 1] + B @ eta[k])
            readings.append((H0 + h[k - 1] * H1) @ states[-1] + C @ eta[k - 1] + D @ eta[k])
        joint = np.vstack([*states, *readings])
        moments += np.prod(np.where(f, p, 1 - p)) * np.prod(np.where(h, q, 1 - q)) * joint @ joint.T

    stacked = brute_force.stack(system, steps)
    joint = np.vstack([*stacked.state, stacked.readings])
    means = np.concatenate([stacked.state_mean.ravel(), stacked.reading_mean])
    assert relative(joint @ joint.T + np.outer(means, means), moments) < 1e-13


def kalman(system: System, used: brute_force.Used, node: NodeId, stacked: StackedSystem, Y: Array) -> list[Array]:
    """The textbook filter for fixed matrices and white noises: x̂_k and P_k side by side, (nx, 1 + nx)."""
    x, P = system.initial_mean, system.initial_covariance
    found = [np.column_stack([x, P])]
    for k in range(1, stacked.steps + 1):
        F = system.F.at(k - 1).mean
        x, P = F @ x, F @ P @ F.T + system.noise.covariances(k - 1, stacked.ids).Q
        for sensor in system.sensors:
            if sensor.id in used[node, k]:
                H = sensor.H.at(k).mean
                gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + system.noise.covariances(k, (sensor.id,)).R)
                x = x + gain @ (Y[stacked.where[sensor.id, k]] - H @ x)
                P = P - gain @ H @ P
        found.append(np.column_stack([x, P]))
    return found


@pytest.mark.parametrize("radius", [0.9, 1.2])
def test_projection_is_the_kalman_filter_where_that_holds(radius: float) -> None:
    rng = np.random.default_rng(2)
    for _ in range(4):
        system = random_systems.random_system(rng, noise="white", multiplicative=False, varying=True, radius=radius)
        neighbours = random_systems.random_graph(rng, system.ids)
        used = random_systems.random_used_sets(rng, neighbours, STEPS)
        stacked = brute_force.stack(system, STEPS)
        Y = stacked.vector({(i, k): rng.normal(size=system.by_id[i].ny) for i, k in stacked.where})
        for node in neighbours:
            estimates = brute_force.intermediate(stacked, node, used)
            found = np.dstack([estimates.values(stacked, Y), estimates.covariance])
            wanted = kalman(system, used, node, stacked, Y)
            assert max(map(relative, found, wanted)) < 1e-12


def test_weights_and_errors_tell_the_same_story_also_with_losses() -> None:
    rng = np.random.default_rng(3)
    for kind in KINDS:
        system = random_systems.random_system(rng, **kind)
        neighbours = random_systems.random_graph(rng, system.ids)
        used = random_systems.random_used_sets(rng, neighbours, STEPS)
        heard = random_systems.random_used_sets(rng, neighbours, STEPS, blackout=0, late=0)
        stacked = brute_force.stack(system, STEPS)
        estimates = {i: brute_force.intermediate(stacked, i, used) for i in neighbours}
        for i in neighbours:
            best = brute_force.fused(stacked, estimates, i, heard)
            for e in (estimates[i], best):
                assert relative(e.errors, stacked.state - e.weights @ stacked.readings) < 1e-12
            gained = np.trace(estimates[i].covariance - best.covariance, axis1=1, axis2=2)
            assert gained.min() > -1e-12 * np.trace(best.covariance, axis1=1, axis2=2).max()
            unused = [stacked.where[j, k] for j, k in stacked.where if j not in used[i, k]]
            assert not any(estimates[i].weights[:, :, place].any() for place in unused)


# --- the printed recursion against the projection


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(3))
def test_printed_form_agrees_with_brute_force(kind: dict[str, Any], seed: int) -> None:
    rng = np.random.default_rng([4, seed])
    system = random_systems.random_system(rng, **kind)
    neighbours = random_systems.random_graph(rng, system.ids)
    stacked = brute_force.stack(system, STEPS)
    always = brute_force.always(neighbours, STEPS)
    estimates = {i: brute_force.intermediate(stacked, i, always) for i in neighbours}
    fused = {i: brute_force.fused_as_printed(stacked, estimates, i, always) for i in neighbours}
    Y = rng.normal(size=len(stacked.readings))
    values = {i: e.values(stacked, Y) for i, e in estimates.items()}

    printed = printed_form.network_recursion(system, neighbours)
    ny = len(Y) // STEPS
    for k in range(STEPS + 1):
        if k > 0:
            printed.step(Y[ny * (k - 1) : ny * k])
        for i, members in neighbours.items():
            assert relative(printed.stage_1[i].P, estimates[i].covariance[k]) < 1e-12
            assert relative(printed.stage_1[i].x, values[i][k]) < 1e-11
            # the second moments K are badly conditioned, hence the looser bounds on what is fused by them
            assert relative(printed.fused[i].P, fused[i].covariance[k]) < 1e-8
            wanted = fused[i].gains[k] @ np.concatenate([values[j][k] for j in members])
            assert relative(printed.fused[i].x, wanted) < 1e-8
        for (i, j), pair in printed.pairs.items():
            # E[x̂^i x̂^jᵀ] from the errors': E[x e^jᵀ] = P^(jj)
            P_i, P_j = estimates[i].covariance[k], estimates[j].covariance[k]
            K = printed.D - P_i - P_j + estimates[i].cross_covariance(estimates[j])[k]
            assert np.abs(pair.K - K).max() <= 1e-12 * np.abs(printed.D).max()


def test_a_node_finds_the_same_on_its_own_as_in_the_network() -> None:
    rng = np.random.default_rng(5)
    system = random_systems.random_system(rng, ids=range(8), nx=2)
    neighbours = random_systems.random_graph(rng, range(8), density=0.2)
    network = printed_form.network_recursion(system, neighbours)
    alone = {i: printed_form.node_recursion(system, neighbours, i) for i in neighbours}
    assert min(len(a.sensors) for a in alone.values()) < 8
    for _ in range(5):
        network.step()
        for i, recursion in alone.items():
            recursion.step()
            np.testing.assert_allclose(recursion.fused[i].P, network.fused[i].P, rtol=1e-9, atol=1e-12)


# --- what the estimates must be whatever the system


def test_the_best_affine_fusion_is_theorem_2_for_a_zero_mean_and_never_worse_otherwise() -> None:
    rng = np.random.default_rng(6)
    gains = []
    always = brute_force.always(paper.NEIGHBOURS, STEPS)
    for mean in (0.0, 2.0):
        system = random_systems.random_system(rng, nx=2, ids=paper.NEIGHBOURS, mean=mean)
        stacked = brute_force.stack(system, STEPS)
        estimates = {i: brute_force.intermediate(stacked, i, always) for i in system.ids}
        best = [brute_force.fused(stacked, estimates, i, always).covariance for i in system.ids]
        printed = [brute_force.fused_as_printed(stacked, estimates, i, always).covariance for i in system.ids]
        gains.append(np.trace(np.array(printed) - best, axis1=2, axis2=3))
    assert np.abs(gains[0]).max() < 1e-10
    assert gains[1].min() > -1e-10
    assert gains[1].max() > 1e-4


def test_complete_graph_is_centralised_and_no_links_is_local() -> None:
    """In a complete graph all intermediate estimates are the same vector: a legal singular fusion."""
    system = random_systems.random_system(np.random.default_rng(7), ids=NAMES)
    complete = brute_force.error_covariances(system, dict.fromkeys(NAMES, NAMES), STEPS)
    for m in range(len(NAMES)):
        np.testing.assert_allclose(complete.distributed[:, m], complete.centralized, rtol=1e-9, atol=1e-12)
    alone = brute_force.error_covariances(system, {i: (i,) for i in NAMES}, STEPS)
    np.testing.assert_allclose(alone.distributed, alone.local, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(alone.centralized, complete.centralized, rtol=1e-12)


@pytest.mark.parametrize("varying", [False, True])
def test_noise_by_covariances_is_the_same_system(varying: bool) -> None:
    system = random_systems.random_system(np.random.default_rng(8), ids=NAMES, varying=varying)
    neighbours = random_systems.random_graph(np.random.default_rng(9), NAMES)
    wanted = brute_force.error_covariances(system, neighbours, STEPS)
    found = brute_force.error_covariances(random_systems.by_covariances(system), neighbours, STEPS)
    assert max(map(relative, found, wanted)) < 1e-12


# --- the generators


def test_random_systems_exercise_what_the_model_can_express() -> None:
    rng = np.random.default_rng(10)
    system = random_systems.random_system(rng, ids=NAMES, radius=1.3, varying=True)
    assert all(np.abs(matrix).max() > 1e-3 for matrix in system.noise.covariances(5, NAMES))
    assert np.abs(np.linalg.eigvals(system.F.at(0).mean)).max() == pytest.approx(1.3)
    assert np.abs(system.F.at(0).mean - system.F.at(1).mean).max() > 1e-3
    assert np.abs(system.initial_mean).min() > 0
    for seed in range(20):
        R = random_systems.random_system(np.random.default_rng(seed), ids=NAMES).noise.covariances(5, NAMES).R
        assert np.linalg.eigvalsh(R)[0] > 0.05


def test_random_used_sets_hold_every_kind_of_event() -> None:
    rng = np.random.default_rng(11)
    neighbours = random_systems.random_graph(rng, range(6))
    assert all(i in members and list(members) == sorted(members) for i, members in neighbours.items())
    used = random_systems.random_used_sets(rng, neighbours, 40)
    assert all(
        set(members) <= set(neighbours[i]) and list(members) == sorted(members) for (i, _), members in used.items()
    )
    assert any(not any(used[i, k] for i in neighbours) for k in range(20, 41))
    assert any(not any(used[i, k] for k in range(1, 6)) and any(used[j, 1] for j in neighbours) for i in neighbours)
    assert any(used[i, k] == neighbours[i] for i, k in used)
