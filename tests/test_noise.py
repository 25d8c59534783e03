"""Noises: covariances from taps, what is refused, and draws that have the covariances."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from oracles.paper import paper_system
from oracles.random_systems import by_covariances, random_system
from zfusion.errors import InputError
from zfusion.model.distributions import Bernoulli, Exponential, Normal
from zfusion.model.matrices import Schedule
from zfusion.model.noise import CovarianceNoise, MovingAverageNoise, NoiseModel, Tap, WhiteNoise
from zfusion.model.streams import BLOCK, Seeds

C = np.array([1, 0.5, 0.75, 0.85])


def constant(*rows: Any) -> Schedule:
    return Schedule.constant(np.array(rows, float))


def tap(source: str, lag: int, *values: float) -> Tap:
    """A 1x1 tap with these values in turn."""
    return Tap(source, lag, Schedule(tuple(np.array([[value]]) for value in values), after="cycle"))


def one_sensor(process: tuple[Tap, ...], sensor: tuple[Tap, ...]) -> MovingAverageNoise:
    white = {name: WhiteNoise(np.eye(1)) for name in ("a", "b")}
    return MovingAverageNoise(white, process, {1: sensor})


def scalar_covariances(**given: Any) -> CovarianceNoise:
    """One state, sensors 1 and 2, all of variance 1 and whatever else is given as numbers."""
    parts: dict[str, Any] = {"Q": 1.0, "R": {(1, 1): 1.0, (2, 2): 1.0}} | given
    return CovarianceNoise(
        **{
            name: {key: _schedule(value) for key, value in part.items()} if isinstance(part, dict) else _schedule(part)
            for name, part in parts.items()
        }
    )


def _schedule(value: Any) -> Schedule:
    if isinstance(value, tuple):
        return Schedule(tuple(np.array([[v]]) for v in value[1:]), 0, value[0])
    return constant([value])


def test_the_published_example() -> None:
    noise = paper_system().noise.covariances(7, (1, 2, 3, 4))
    assert noise.Q[0, 0] == pytest.approx(0.36)
    assert noise.Q1[0, 0] == pytest.approx(0.18)
    for value, wanted in (
        (noise.R, np.outer(C, C)),
        (noise.R1, 0.5 * np.outer(C, C)),
        (noise.S0, 0.3 * C[None]),
        (noise.S1, 0.6 * C[None]),
        (noise.S2, 0.3 * C[None]),
    ):
        assert np.allclose(value, wanted, rtol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_covariances_are_those_of_the_taps_written_out(seed: int) -> None:
    """Against matrices over all values of all white noises, one column block per (source, time)."""
    system = random_system(np.random.default_rng(seed), varying=seed % 2 == 1)
    noise = system.noise
    assert isinstance(noise, MovingAverageNoise)
    times, offsets, width = range(-1, 9), {}, 0
    for t in times:
        for name, white in noise.white.items():
            offsets[name, t] = slice(width, width + white.size)
            width += white.size
    covariance = np.zeros((width, width))
    for (name, _), at in offsets.items():
        covariance[at, at] = noise.white[name].covariance

    def written_out(taps: tuple[Tap, ...], k: int) -> np.ndarray:
        rows = np.zeros((taps[0].shape[0], width))
        for t in taps:
            rows[:, offsets[t.source, k + t.lag]] += t.matrix.at(k)
        return rows

    for k in range(6):
        w = {n: written_out(noise.process, n) for n in (k - 1, k) if n >= 0}
        v = {n: np.vstack([written_out(noise.sensors[i], n) for i in system.ids]) for n in range(max(k - 1, 1), k + 3)}
        zero = np.zeros_like(w[k]), np.zeros((sum(noise.sizes.values()), width))
        before_w, now_v, before_v = w.get(k - 1, zero[0]), v.get(k, zero[1]), v.get(k - 1, zero[1])
        wanted = (
            w[k] @ covariance @ w[k].T,
            w[k] @ covariance @ before_w.T,
            now_v @ covariance @ now_v.T,
            now_v @ covariance @ before_v.T,
            w[k] @ covariance @ now_v.T,
            w[k] @ covariance @ v[k + 1].T,
            w[k] @ covariance @ v[k + 2].T,
        )
        for value, exact in zip(noise.covariances(k, system.ids), wanted, strict=True):
            assert np.allclose(value, exact, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_both_descriptions_agree_for_any_choice_of_sensors(seed: int) -> None:
    system = random_system(np.random.default_rng(seed), varying=seed % 2 == 1, ids=[1, 2, 3, 4, 5])
    other = by_covariances(system).noise
    for k in range(6):
        whole = system.noise.covariances(k, system.ids)
        chosen = system.noise.covariances(k, (2, 5))
        rows, _ = system.noise.rows(system.ids)
        at = np.r_[rows[2], rows[5]]
        assert np.allclose(chosen.R1, whole.R1[np.ix_(at, at)], atol=1e-14)
        assert np.allclose(chosen.S2, whole.S2[:, at], atol=1e-14)
        for ids in (system.ids, (2, 5), (3,)):
            for a, b in zip(system.noise.covariances(k, ids), other.covariances(k, ids), strict=True):
                assert np.allclose(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("noise", [paper_system().noise, scalar_covariances(Q=("hold", 2.0, 3.0))])
def test_settled_covariances_are_one_object_that_cannot_be_changed(noise: NoiseModel) -> None:
    settled = noise.covariances(3, (1, 2))
    assert noise.covariances(4, (1, 2)) is settled
    assert noise.covariances(1, (1, 2)) is not settled
    for matrix in settled:
        with pytest.raises(ValueError, match="read-only"):
            matrix[:] = 0


def test_unknown_sensors_are_not_invented() -> None:
    for noise in (paper_system().noise, scalar_covariances()):
        with pytest.raises(KeyError):
            noise.covariances(3, (1, 9))


@pytest.mark.parametrize(
    ("process", "sensor", "named"),
    [
        ((tap("a", 0, 1), tap("a", 2, 1)), (tap("b", 0, 1),), r"Cov\[w_k, w_{k\+2}\]"),
        ((tap("b", 0, 1),), (tap("a", -1, 1), tap("a", 1, 1)), r"Cov\[v\^1_k, v\^1_{k\+2}\]"),
        ((tap("a", 0, 1),), (tap("a", 1, 1),), r"Cov\[w_k, v\^1_{k-1}\]"),
        ((tap("a", 3, 1),), (tap("a", 0, 1),), r"Cov\[w_k, v\^1_{k\+3}\]"),
        ((tap("a", 3, 0, 0, 0, 1),), (tap("a", 0, 0, 0, 1, 0),), r"Cov\[w_k, v\^1_{k\+3}\]"),
    ],
)
def test_taps_that_correlate_too_far_are_refused_by_name(process, sensor, named) -> None:
    with pytest.raises(InputError, match=f"^{named}: expected zero.*contain a"):
        one_sensor(process, sensor)


def test_far_taps_whose_covariances_cancel_or_never_meet_are_legal() -> None:
    """w_k = a_k + b_k, v_k = a_{k+1} - b_{k+1}; taps of which one is always zero when the other is not."""
    cancelling = one_sensor((tap("a", 0, 1), tap("b", 0, 1)), (tap("a", 1, 1), tap("b", 1, -1)))
    assert not cancelling.covariances(5, (1,)).S0.any()
    one_sensor((tap("a", 3, 0, 1),), (tap("a", 0, 0, 1),))  # odd w, even v would be needed


def test_correlation_of_two_sensors_too_far_apart_names_both() -> None:
    white = {"a": WhiteNoise(np.eye(1))}
    with pytest.raises(InputError, match=r"Cov\[v\^right_k, v\^left_{k\+2}\]"):
        MovingAverageNoise(
            white | {"b": white["a"]}, (tap("b", 0, 1),), {"left": (tap("a", -1, 1),), "right": (tap("a", 1, 1),)}
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WhiteNoise([[-1.0]]), "covariance: expected a positive semi-definite"),
        (lambda: WhiteNoise([[1.0]], Bernoulli(1.0)), "distribution: expected one with a variance"),
        (lambda: tap("a", True, 1), "lag: expected an integer"),
        (lambda: Tap("a", 0, Schedule.constant(np.eye(1), 1)), "matrix: expected a schedule that begins at step 0"),
        (lambda: Tap("a", 0, Schedule((np.eye(1), np.eye(2)))), r"matrix\[1\]: expected an array of shape \(1, 1\)"),
        (lambda: one_sensor((), (tap("b", 0, 1),)), "process: expected at least one tap"),
        (lambda: one_sensor((tap("c", 0, 1),), (tap("b", 0, 1),)), r"process\[0\].source: expected one of .*'c'"),
        (
            lambda: one_sensor((tap("a", 0, 1),), (Tap("b", 0, constant([1, 2])),)),
            r"sensors\[1\]\[0\].matrix: expected shape \(1, 1\)",
        ),
        (lambda: scalar_covariances(Q=-1.0), "Q: expected a positive semi-definite"),
        (lambda: scalar_covariances(R={(1, 1): 1.0, (2, 3): 0.0}), r"R\[2, 3\]: expected sensors with an R\[i, i\]"),
        (
            lambda: scalar_covariances(R={(1, 1): 1, (2, 2): 1, (1, 2): 0, (2, 1): 0}),
            r"R\[1, 2\]: expected each pair in one order only",
        ),
        (lambda: scalar_covariances(S0={3: 0.0}), r"S0\[3\]: expected a sensor with"),
        (lambda: replace(scalar_covariances(), Q1=constant([1, 0])), r"Q1: expected an array of shape \(1, 1\)"),
        (lambda: scalar_covariances(Q1=0.51), "noise: expected .* joint covariance of w over all steps"),
        (lambda: scalar_covariances(R1={(1, 1): 0.6}), r"noise: expected .* joint covariance of v\^1 over"),
        (lambda: scalar_covariances(S1={2: 1.1}), r"noise: expected .* joint covariance of w, v\^2 over"),
        (lambda: scalar_covariances(S0={2: 0.6}, S1={2: 0.7}), r"noise: .* of w, v\^2 over"),
        (lambda: scalar_covariances(Q=("cycle", 1.0, 0.2), Q1=0.4), "noise: .* of w over"),
        (lambda: scalar_covariances(Q1=("hold", 0.0, 0.0, 0.51)), "noise: .* of w over"),
        (lambda: scalar_covariances(Q=0.0, S1={1: 0.1}), r"noise: .* of w, v\^1 over"),
        (
            lambda: scalar_covariances(Q=("cycle", *[1.0] * 101), R={(1, 1): ("cycle", *[1.0] * 103)}),
            "noise: expected schedules that repeat together within 10000 steps",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, message) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        make()


def test_covariances_on_the_edge_are_legal() -> None:
    scalar_covariances(Q1=0.5, R1={(1, 1): -0.5})
    scalar_covariances(S1={2: 1.0})
    scalar_covariances(R={(1, 1): 1.0, (2, 2): 1.0, (1, 2): 1.0})
    scalar_covariances(Q=0.0, R={(1, 1): 0.0, (2, 2): 0.0})


def test_uncorrelated_noises_are_apart() -> None:
    noise = scalar_covariances(
        R={(i, i): 1.0 for i in range(1, 6)} | {(5, 3): 0.2}, R1={(2, 4): 0.1, (1, 3): 0.0}, S2={4: 0.1}
    )
    assert [(c.process, c.ids) for c in noise.components] == [(True, (2, 4)), (False, (1,)), (False, (3, 5))]


STEPS = 4
PATHS = 2500


def draws(noise: NoiseModel) -> dict[tuple[str, int], np.ndarray]:
    """("w" or "v", step) -> draws of many seeds, (PATHS, size), for the first steps and around a block's end."""
    steps = [*range(1, STEPS + 1), *range(BLOCK - 2, BLOCK + 2)]
    found: dict[tuple[str, int], list[np.ndarray]] = {(kind, k): [] for kind in "wv" for k in steps}
    for seed in range(PATHS):
        sampler = noise.sampler(Seeds(seed))
        for block in (0, 1):
            w = sampler.process(block)
            v = np.hstack([sampler.sensor(i, block) for i in noise.sizes])
            for k in steps:
                if 0 <= k - BLOCK * block < BLOCK:
                    found["v", k].append(v[k - BLOCK * block])
                if 0 <= k + 1 - BLOCK * block < BLOCK:
                    found["w", k].append(w[k + 1 - BLOCK * block])
    return {key: np.array(values) for key, values in found.items()}


def exact(noise: NoiseModel, first: tuple[str, int], second: tuple[str, int]) -> np.ndarray | float:
    """Covariance of two noises at two steps, zero where the model has none."""
    (kind, k), (other, n) = first, second
    ids = tuple(noise.sizes)
    if kind == other:
        now, before = ("Q", "Q1") if kind == "w" else ("R", "R1")
        if k == n:
            return getattr(noise.covariances(k, ids), now)
        if abs(k - n) == 1:
            value = getattr(noise.covariances(max(k, n), ids), before)
            return value if k > n else value.T
        return 0.0
    if kind == "v":
        value = exact(noise, second, first)
        return value.T if isinstance(value, np.ndarray) else value
    return getattr(noise.covariances(k, ids), f"S{n - k}") if 0 <= n - k <= 2 else 0.0


def singular_noise() -> CovarianceNoise:
    """Five components that one white noise drives, two of which are its delayed copies."""
    return by_covariances(paper_system()).noise


@pytest.mark.parametrize(
    "noise",
    [
        random_system(np.random.default_rng(3), nx=2, ids=[1, 2, 3]).noise,
        by_covariances(random_system(np.random.default_rng(4), nx=2, ids=[1, 2], varying=True)).noise,
        singular_noise(),
        scalar_covariances(Q1=0.3, S0={2: 0.5}, R1={(1, 2): 0.0, (1, 1): -0.3}),
        MovingAverageNoise(
            {"a": WhiteNoise([[2.0, 1], [1, 1]], Exponential(3.0)), "b": WhiteNoise([[1.0]], Bernoulli(0.2))},
            (Tap("a", 0, Schedule((np.eye(2), 2 * np.eye(2)), 0, "cycle")), Tap("b", 1, constant([1], [0]))),
            {1: (Tap("a", -2, Schedule((np.array([[1.0, 0]]), np.array([[0.0, 3]])))), tap("b", 0, 1))},
        ),
    ],
    ids=["taps", "covariances", "singular", "components", "skewed"],
)
def test_draws_have_the_covariances_and_no_others(noise: NoiseModel) -> None:
    """Every pair of noises of nearby steps, each estimate within six of its own standard deviations."""
    drawn = draws(noise)
    for first, a in drawn.items():
        assert (np.abs(a.mean(axis=0)) <= 6 * a.std(axis=0) / np.sqrt(PATHS) + 1e-12).all()
        for second, b in drawn.items():
            if first <= second and abs(first[1] - second[1]) <= 4:
                products = a[:, :, None] * b[:, None, :]
                bound = 6 * products.std(axis=0) / np.sqrt(PATHS) + 1e-9
                assert (np.abs(products.mean(axis=0) - exact(noise, first, second)) <= bound).all(), (first, second)


def test_white_noise_keeps_the_shape_of_its_distribution() -> None:
    coin = WhiteNoise([[4.0]], Bernoulli(0.5)).sample(np.random.default_rng(0), 100)
    assert set(np.round(coin.ravel(), 12).tolist()) == {-2.0, 2.0}
    assert WhiteNoise(np.ones((3, 3)), Normal(7, 9)).sample(np.random.default_rng(0), 5).shape == (5, 3)


@pytest.mark.parametrize("noise", [paper_system().noise, singular_noise()], ids=["taps", "covariances"])
def test_blocks_can_be_had_in_any_order(noise: NoiseModel) -> None:
    forwards, other = noise.sampler(Seeds(1)), noise.sampler(Seeds(1))
    wanted = [(forwards.process(b), forwards.sensor(3, b)) for b in range(7)]
    for b in (5, 1, 6, 0):
        assert np.array_equal(other.sensor(3, b)[1:], wanted[b][1][1:])
        assert np.array_equal(other.process(b)[1:], wanted[b][0][1:])
