"""Stage 2 against projection: the weights, the covariance, and the singular cases that a network is full of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from oracles import brute_force, random_systems
from oracles.brute_force import Estimates, StackedSystem
from zfusion.methods.covariances import advance, prior
from zfusion.methods.fusion import fuse, fusion_weights, joint_index
from zfusion.methods.layout import Layout
from zfusion.model.statistics import step_models
from zfusion.model.types import Array, NodeId

STEPS = 10
KINDS: list[dict[str, Any]] = [
    {"nx": 1},
    {"nx": 2, "varying": True},
    {"nx": 3},
    {"nx": 3, "noise": "white"},
    {"nx": 2, "radius": 1.2},
    {"nx": 2, "mean": 0.0},
    {"mean": 20.0},
]


def joint(estimates: Sequence[Estimates], k: int) -> Array:
    """What `fusion_weights` takes, for i's estimate, the first, and the others'."""
    errors = [estimates[0].errors[k], *(e.errors[k] for e in estimates)]  # the second stands for the prior
    P = np.block([[e @ f.T for f in errors] for e in errors])
    nx = len(errors[0])
    for at, e in enumerate(errors):
        row = slice(nx * at, nx * (at + 1))
        P[row, nx : 2 * nx] = P[nx : 2 * nx, row] = e @ e.T
    return P


def in_terms_of_measurements(weights: Array, estimates: Sequence[Estimates], k: int) -> Array:
    """The fused estimate's weights on Y - E[Y]: what `fuse` does to data, done to weights."""
    own = estimates[0].weights[k]
    z = np.vstack([np.zeros_like(own), *(e.weights[k] for e in estimates[1:])]) - np.tile(own, (len(estimates), 1))
    total: Array = own + weights @ z
    return total


def random_fusions(
    kind: dict[str, Any], seed: int
) -> tuple[StackedSystem, dict[NodeId, Estimates], brute_force.Used, dict[NodeId, Estimates]]:
    rng = np.random.default_rng([1, seed])
    system = random_systems.random_system(rng, **kind)
    neighbours = random_systems.random_graph(rng, system.ids)
    used = random_systems.random_used_sets(rng, neighbours, STEPS)
    heard = random_systems.random_used_sets(rng, neighbours, STEPS, blackout=0, late=0)
    stacked = brute_force.stack(system, STEPS)
    estimates = {i: brute_force.intermediate(stacked, i, used) for i in neighbours}
    return stacked, estimates, heard, {i: brute_force.fused(stacked, estimates, i, heard) for i in neighbours}


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_best_affine_combination_of_what_was_heard(kind: dict[str, Any], seed: int) -> None:
    stacked, estimates, heard, best = random_fusions(kind, seed)
    for i, wanted in best.items():
        for k in range(1, STEPS + 1):
            members = [estimates[j] for j in (i, *sorted(set(heard[i, k]) - {i}))]
            prior = stacked.state[k] @ stacked.state[k].T
            weights, covariance = fusion_weights(joint(members, k), prior)
            scale = np.abs(wanted.covariance[k]).max()
            np.testing.assert_allclose(covariance, wanted.covariance[k], rtol=0, atol=1e-8 * scale)
            difference = in_terms_of_measurements(weights, members, k) - wanted.weights[k]
            assert np.linalg.norm(difference @ stacked.readings) < 1e-8 * np.sqrt(scale)
            assert np.array_equal(covariance, covariance.T)


def test_a_batch_of_fusions_is_each_of_them() -> None:
    stacked, estimates, _, _ = random_fusions({"nx": 2}, 0)
    k, ids = 5, sorted(estimates)
    rows = [[estimates[j] for j in (i, *[j for j in ids if j != i][:2])] for i in ids]
    joints = np.array([joint(row, k) for row in rows])
    prior = stacked.state[k] @ stacked.state[k].T
    weights, covariances = fusion_weights(joints, prior)
    for n, alone in enumerate(joints):
        one, covariance = fusion_weights(alone, prior)
        np.testing.assert_allclose(weights[n], one, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(covariances[n], covariance, rtol=1e-12, atol=1e-14)


def test_fuse_applies_the_weights_to_the_differences() -> None:
    rng = np.random.default_rng(2)
    own, mean, a, b = rng.normal(size=(4, 2))
    W = rng.normal(size=(2, 6))
    wanted = own + W[:, :2] @ (mean - own) + W[:, 2:4] @ (a - own) + W[:, 4:] @ (b - own)
    np.testing.assert_allclose(fuse(own, [a, b], mean, W), wanted, rtol=1e-14)


def test_a_shift_of_the_origin_shifts_the_estimate_and_nothing_else() -> None:
    rng = np.random.default_rng(3)
    own, mean, a, b = rng.normal(size=(4, 2))
    W = rng.normal(size=(2, 6))
    shift = np.array([2.0**20, -(2.0**21)])
    shifted = fuse(own + shift, [a + shift, b + shift], mean + shift, W)
    np.testing.assert_allclose(shifted - shift, fuse(own, [a, b], mean, W), rtol=0, atol=1e-8)


# --- what is singular, and legal


def test_twins_have_no_weight_and_do_no_harm() -> None:
    stacked, estimates, _, _ = random_fusions({"nx": 3}, 1)
    k, (i, j, *_) = 6, sorted(estimates)
    prior = stacked.state[k] @ stacked.state[k].T
    _, wanted = fusion_weights(joint([estimates[i], estimates[j]], k), prior)
    for twins in ([i, j, j], [i, j, i], [i, i, j, j, i]):
        weights, covariance = fusion_weights(joint([estimates[t] for t in twins], k), prior)
        np.testing.assert_allclose(covariance, wanted, rtol=1e-9, atol=1e-12)
        assert np.isfinite(weights).all()
    weights, covariance = fusion_weights(joint([estimates[i], estimates[i]], k), prior)
    assert not weights[:, 3:].any()


def test_alone_the_own_estimate_is_the_best() -> None:
    rng = np.random.default_rng(4)
    P = random_systems.random_covariance(rng, 3)
    weights, covariance = fusion_weights(np.tile(P, (2, 2)), 7 * np.eye(3))
    assert weights.shape == (3, 3)
    assert not weights.any()
    np.testing.assert_array_equal(covariance, P)


def test_before_anything_arrived_everybody_has_the_prior() -> None:
    P = random_systems.random_covariance(np.random.default_rng(5), 2)
    weights, covariance = fusion_weights(np.tile(P, (4, 4)), P)
    assert not weights.any()
    np.testing.assert_array_equal(covariance, P)


def test_what_is_given_is_left_as_it_is() -> None:
    _, estimates, _, _ = random_fusions({"nx": 2}, 3)
    P = joint([estimates[i] for i in sorted(estimates)], 5)
    before = P.copy()
    fusion_weights(P, np.eye(2))
    np.testing.assert_array_equal(P, before)


def test_a_prior_that_is_infinite_knows_nothing() -> None:
    _, estimates, _, _ = random_fusions({"nx": 2}, 2)
    members = [estimates[i] for i in sorted(estimates)[:3]]
    weights, covariance = fusion_weights(joint(members, 5), np.full((2, 2), np.inf))
    assert not weights[:, :2].any()
    far, nearly = fusion_weights(joint(members, 5), 1e14 * np.eye(2))
    np.testing.assert_allclose(covariance, nearly, rtol=1e-8)
    np.testing.assert_allclose(weights, far, rtol=1e-6, atol=1e-8)


def test_errors_that_are_exactly_zero() -> None:
    P = np.zeros((6, 6))
    P[4:, 4:] = np.eye(2)
    weights, covariance = fusion_weights(P, 2 * np.eye(2))
    assert not weights.any()
    assert not covariance.any()


@pytest.mark.parametrize("seed", [7, 19, 67])
def test_estimates_that_all_but_agree(seed: int) -> None:
    """After losses the estimates of a complete graph's nodes converge: their differences sink into rounding.

    On the way, weights made of rounding could be millions, and what they do to the error nobody would know.
    """
    rng = np.random.default_rng([77, seed])
    system = random_systems.random_system(rng, nx=2 + (seed == 7), radius=1.2 if seed % 5 == 4 else 0.9)
    ids, steps = system.ids, 24
    used = {(i, k): tuple(j for j in ids if k > 4 or rng.random() > 0.3) for i in ids for k in range(1, steps + 1)}
    stacked = brute_force.stack(system, steps)
    estimates = {i: brute_force.intermediate(stacked, i, used) for i in ids}
    tracked = Layout.build(dict.fromkeys(ids, ids), {sensor.id: sensor.ny for sensor in system.sensors})
    state, models = prior(tracked, system.initial_covariance), step_models(system, ids)
    for k in range(1, steps + 1):
        model, moments = next(models)
        state = advance(tracked, state, model, tracked.used({i: used[i, k] for i in ids}))
        weights, covariance = fusion_weights(
            state.P.flat.take(joint_index(tracked, ids, system.nx)), moments.covariance
        )
        total = in_terms_of_measurements(weights, [estimates[i] for i in ids], k)
        error = stacked.state[k] - total @ stacked.readings
        np.testing.assert_allclose(error @ error.T, covariance, rtol=0, atol=3e-8 * np.abs(covariance).max())
        assert np.abs(weights).max() < 1e5
