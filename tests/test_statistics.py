"""What filters are fed with: the defining equations, one at a time, and what happens in the long run."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from oracles.paper import paper_system
from oracles.random_systems import by_covariances, random_system
from zfusion.errors import RunError
from zfusion.model.distributions import Normal
from zfusion.model.matrices import Fixed, Schedule, Terms
from zfusion.model.noise import CovarianceNoise
from zfusion.model.statistics import PriorMoments, StepModel, prior_moments, step_models
from zfusion.model.system import Sensor, System


def take(system: System, steps: int, ids: Any = None) -> list[tuple[StepModel, PriorMoments]]:
    return list(islice(step_models(system, system.ids if ids is None else ids), steps))


def scalar(F: Any, H: Any, mean: float = 0.0, variance: float = 1.0, noise: float = 1.0) -> System:
    """One state, one sensor, white noises of one variance."""
    return System(
        1,
        [mean],
        [[variance]],
        F if isinstance(F, Schedule) else Schedule.constant(F),
        (Sensor(1, 1, H if isinstance(H, Schedule) else Schedule.constant(H, 1)),),
        CovarianceNoise(Schedule.constant(np.array([[noise]])), {(1, 1): Schedule.constant(np.array([[noise]]))}),
    )


def number(value: float, spread: float = 0.0) -> Terms | Fixed:
    if spread == 0:
        return Fixed([[value]])
    return Terms((([[value]], ()), ([[spread]], ("e",))), {"e": Normal()})


@pytest.mark.parametrize("seed", range(6))
def test_every_statistic_is_its_equation(seed: int) -> None:
    """The specification's formulas term by term, sensor by sensor, for constant and varying systems."""
    system = random_system(np.random.default_rng(seed), varying=seed % 2 == 1)
    noise, ids = system.noise, system.ids
    covariance, mean = system.initial_covariance, system.initial_mean
    for k, (model, moments) in enumerate(take(system, 9), 1):
        now, last = noise.covariances(k, ids), noise.covariances(k - 1, ids)
        F, H = system.F.at(k - 1), [s.H.at(k) for s in system.sensors]
        zero_w, zero_v = np.zeros_like(last.S0), np.zeros_like(now.R)
        Q = last.Q + F.second_moment(covariance + np.outer(mean, mean))
        covariance = F.mean @ covariance @ F.mean.T + Q + F.mean @ last.Q1.T + last.Q1 @ F.mean.T
        mean = F.mean @ mean
        D = covariance + np.outer(mean, mean)
        R, row = now.R.copy(), 0
        for s, h in zip(system.sensors, H, strict=True):
            R[row : row + s.ny, row : row + s.ny] += h.second_moment(D)
            row += s.ny
        if k == 1:
            W, V, B, Q1 = zero_w, zero_v, last.S1, np.zeros_like(Q)
        else:
            before = np.vstack([s.H.at(k - 1).mean for s in system.sensors])
            S2 = noise.covariances(k - 2, ids).S2
            Q1 = last.Q1
            W, V, B = Q1 @ before.T + last.S0, S2.T @ before.T + now.R1, F.mean @ S2 + last.S1
        wanted = StepModel(F.mean, Q, Q1, W, V, B, np.vstack([h.mean for h in H]), R)
        for name in StepModel._fields:
            assert np.allclose(getattr(model, name), getattr(wanted, name), rtol=1e-12, atol=1e-13), (k, name)
        assert np.allclose(moments.mean, mean, rtol=1e-12, atol=1e-14)
        assert np.allclose(moments.covariance, covariance, rtol=1e-12)


def test_the_published_example_moments() -> None:
    """D_{k+1} = (0.95² + 0.2²) D_k + 0.36 + 2·0.95·0.18, except at the beginning."""
    D = [1.0, (0.95**2 + 0.04) + 0.36]
    for _ in range(20):
        D.append((0.95**2 + 0.04) * D[-1] + 0.36 + 0.342)
    found = take(paper_system(), 20)
    assert [m.covariance[0, 0] for _, m in found] == pytest.approx(D[1:21], rel=1e-13)
    assert [m.Q[0, 0] for m, _ in found] == pytest.approx([0.36 + 0.04 * d for d in D[:20]], rel=1e-13)
    variances = np.array([0.82**2 * 0.4**2 / 12, 0.75**2 * 0.0775, 0.74**2 * 0.21])
    variances[1] = 0.75**2 * (0.5 * 0.25 + 0.4 - 0.65**2)
    assert np.diag(found[4][0].R)[:3] == pytest.approx(np.array([1, 0.25, 0.5625]) + variances * D[5], rel=1e-12)


def test_chosen_sensors_get_their_part_of_the_whole() -> None:
    system = random_system(np.random.default_rng(8), ids=[1, 2, 3, 4], varying=True)
    rows, _ = system.noise.rows(system.ids)
    at = np.r_[rows[2], rows[4]]
    for (whole, moments), (part, same) in zip(take(system, 6), take(system, 6, (2, 4)), strict=True):
        assert np.allclose(part.V, whole.V[np.ix_(at, at)], atol=1e-14)
        assert np.allclose(part.R, whole.R[np.ix_(at, at)], atol=1e-14)
        assert np.allclose(part.W, whole.W[:, at], atol=1e-14)
        assert np.array_equal(moments.covariance, same.covariance)
    with pytest.raises(KeyError):
        take(system, 1, (9,))


def test_both_descriptions_of_the_noise_give_the_same() -> None:
    system = random_system(np.random.default_rng(2), varying=True)
    for (model, _), (other, _) in zip(take(system, 8), take(by_covariances(system), 8), strict=True):
        for a, b in zip(model, other, strict=True):
            assert np.allclose(a, b, rtol=1e-11, atol=1e-13)


def test_a_time_invariant_model_is_one_object_from_the_second_step_on() -> None:
    found = take(scalar(number(0.9), number(1.0)), 2000)
    assert all(model is found[1][0] for model, _ in found[1:])
    assert found[-1][1] is found[-2][1]
    assert found[-1][1].covariance[0, 0] == pytest.approx(1 / (1 - 0.81), rel=1e-14)


def test_a_random_model_settles_with_its_second_moment() -> None:
    found = take(paper_system(), 1000)
    assert found[-1][0] is found[-2][0]
    exact = 0.702 / (1 - 0.95**2 - 0.04)
    assert found[-1][1].covariance[0, 0] == pytest.approx(exact, rel=1e-12)
    assert found[-1][0].Q[0, 0] == pytest.approx(0.36 + 0.04 * exact, rel=1e-12)


def test_most_random_systems_settle() -> None:
    """Rounding alone must not keep the moments moving."""
    settled = 0
    for seed in range(20):
        found = take(random_system(np.random.default_rng(seed), radius=0.8), 600)
        settled += found[-1][0] is found[-2][0]
    assert settled == 20


def test_what_holds_in_the_end_is_one_object_again() -> None:
    """F changes at steps 0..2 and then stays, H until step 4: from step 5 on nothing changes."""
    F = Schedule(tuple(number(v) for v in (0.9, 0.8, 0.7)), 0, "hold")
    H = Schedule(tuple(number(v) for v in (1.0, 2.0, 3.0, 4.0)), 1, "hold")
    models = [model for model, _ in take(scalar(F, H), 9)]
    assert [m.H[0, 0] for m in models] == [1, 2, 3, 4, 4, 4, 4, 4, 4]
    assert [m.F[0, 0] for m in models] == [0.9, 0.8, 0.7, 0.7, 0.7, 0.7, 0.7, 0.7, 0.7]
    assert models[4] is models[8]
    assert models[3] is not models[4]  # V and W look back one step


def test_matrices_that_become_random_late_have_the_right_moments() -> None:
    F = Schedule((number(0.9), number(0.9), number(0.9, 0.5)), 0, "hold")
    D = 3.0 + 1.0
    for k, (model, _) in enumerate(take(scalar(F, number(1.0), mean=1.0, variance=3.0), 6), 1):
        spread = 0.25 * D if k > 2 else 0.0
        assert model.Q[0, 0] == pytest.approx(1 + spread)
        D = 0.81 * D + 1 + spread


@pytest.mark.parametrize("growth", [1.1, -1.3])
def test_an_unstable_system_outgrows_numbers_without_harm(growth: float) -> None:
    system = scalar(number(growth), number(1.0), mean=1.0)
    system = replace(
        system,
        nx=2,
        initial_mean=[1.0, 1.0],
        initial_covariance=np.eye(2),
        F=Schedule.constant(Fixed([[growth, 1.0], [0.0, 0.5]])),
        sensors=(Sensor(1, 1, Schedule.constant(Fixed([[1.0, 0.0]]), 1)),),
        noise=CovarianceNoise(Schedule.constant(np.eye(2)), {(1, 1): Schedule.constant(np.eye(1))}),
    )
    found = take(system, 12_000)
    assert all(model is found[1][0] for model, _ in found[2:])
    variances = [moments.covariance[0, 0] for _, moments in found]
    lost = variances.index(np.inf)
    assert variances[lost - 1] > 1e305
    for _, moments in found[lost:]:
        assert np.isposinf(moments.covariance).all()
        assert not np.isnan(moments.mean).any()
    assert np.isposinf(found[-1][1].mean).all()
    assert found[-1] == found[-2]


@pytest.mark.parametrize(
    "system",
    [
        scalar(number(1.1), number(1.0, 0.5)),
        scalar(number(0.9, 0.7), number(1.0)),
        scalar(number(1.1), number(1.0, 0.5), mean=1.0, variance=0.0, noise=0.0),
    ],
    ids=["H", "F", "mean"],
)
def test_an_unstable_system_with_random_matrices_says_when_it_is_lost(system: System) -> None:
    with pytest.raises(RunError, match=r"the state at step \d+ is too large for a model with random matrices"):
        take(system, 10_000)


def test_prior_moments_are_those_of_the_initial_state() -> None:
    system = random_system(np.random.default_rng(1))
    prior = prior_moments(system)
    assert np.array_equal(prior.mean, system.initial_mean)
    assert np.array_equal(prior.covariance, system.initial_covariance)


def test_nobody_can_change_what_all_share() -> None:
    for model, moments in take(paper_system(), 3):
        for matrix in (*model, *moments):
            with pytest.raises(ValueError, match="read-only"):
                matrix[:] = 0
