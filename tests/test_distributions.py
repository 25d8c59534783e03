"""Moments in closed form agree with one another, with draws, and with what is known of these laws."""

from __future__ import annotations

import numpy as np
import pytest

from zfusion.errors import InputError
from zfusion.model.distributions import Bernoulli, Discrete, Distribution, Exponential, Normal, Uniform

LAWS: list[Distribution] = [
    Normal(0.3, 2.0),
    Normal(-1.0, 0.0),
    Uniform(0.3, 0.7),
    Uniform(-2.0, 5.0),
    Bernoulli(0.7),
    Bernoulli(0.0),
    Discrete((0.0, 0.5, 1.0), (0.1, 0.5, 0.4)),
    Discrete((-3.0, 2.0), (0.25, 0.75)),
    Exponential(1.7),
]
DRAWS = 200_000


@pytest.mark.parametrize("law", LAWS, ids=repr)
def test_draws_have_the_moments(law: Distribution) -> None:
    """Each estimated moment within six of its own standard deviations."""
    drawn = law.sample(np.random.default_rng(5), DRAWS)
    for n in range(1, 5):
        powers = drawn**n
        bound = 6 * powers.std() / np.sqrt(DRAWS) + 1e-12
        assert abs(powers.mean() - law.moment(n)) <= bound


@pytest.mark.parametrize("law", LAWS, ids=repr)
def test_raw_central_and_joint_moments_agree(law: Distribution) -> None:
    mean = law.moment(1)
    assert law.moment(0) == pytest.approx(1)
    assert law.central_moment(0) == pytest.approx(1)
    assert law.central_moment(1) == pytest.approx(0, abs=1e-15)
    assert law.central_moment(2) == pytest.approx(law.moment(2) - mean**2)
    assert law.central_moment(3) == pytest.approx(law.moment(3) - 3 * mean * law.moment(2) + 2 * mean**3)
    for a in range(4):
        for b in range(4):
            wanted = law.moment(a + b) - law.moment(a) * law.moment(b)
            assert law.covariance(a, b) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_known_values() -> None:
    assert [Normal(0, 4).moment(n) for n in range(1, 7)] == [0, 4, 0, 48, 0, 960]
    assert [Exponential(2).moment(n) for n in range(4)] == [1, 2, 8, 48]
    assert Exponential(1).central_moment(4) == 9
    assert Uniform(0, 1).moment(5) == pytest.approx(1 / 6)
    assert Bernoulli(0.3).moment(7) == 0.3


def test_a_spread_that_is_small_beside_the_mean_is_not_lost() -> None:
    """E[x²] - E[x]² would give 0 or 2 here."""
    assert Uniform(1e8, 1e8 + 1).covariance(1, 1) == 1 / 12
    assert Uniform(1e8, 1e8 + 1).covariance(1, 2) == pytest.approx(2 * (1e8 + 0.5) / 12, rel=1e-12)
    assert Normal(1e9, 1e-6).covariance(1, 1) == 1e-6


def test_discrete_and_bernoulli_draw_their_values_only() -> None:
    rng = np.random.default_rng(1)
    assert set(Discrete((-1.0, 7.0), (0.5, 0.5)).sample(rng, 200).tolist()) == {-1.0, 7.0}
    assert set(Discrete((-1.0, 7.0), (0.0, 1.0)).sample(rng, 200).tolist()) == {7.0}
    assert set(Bernoulli(1.0).sample(rng, 200).tolist()) == {1.0}


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Normal(0, -1), "variance"),
        (lambda: Normal(np.nan, 1), "mean"),
        (lambda: Normal("0", 1), "mean"),
        (lambda: Uniform(1, 0), "low"),
        (lambda: Uniform(0, np.inf), "high"),
        (lambda: Bernoulli(1.2), "p"),
        (lambda: Bernoulli(True), "p"),
        (lambda: Discrete((1.0,), (0.5, 0.5)), "probabilities"),
        (lambda: Discrete((1.0, 2.0), (0.5, 0.6)), "probabilities"),
        (lambda: Discrete((1.0, 2.0), (-0.5, 1.5)), "probabilities"),
        (lambda: Discrete((), ()), "values"),
        (lambda: Exponential(0), "mean"),
    ],
)
def test_impossible_parameters_are_refused_by_name(make, field) -> None:
    with pytest.raises(InputError, match=f"^{field}: expected"):
        make()
