import math

import numpy as np
import pytest

from zfusion.studies.intervals import chi_square_quantile, mean_interval, nees_band, t_quantile


@pytest.mark.parametrize(
    ("p", "freedom", "value"),
    [
        (0.975, 1, 12.706),
        (0.975, 2, 4.303),
        (0.95, 5, 2.015),
        (0.995, 10, 3.169),
        (0.975, 30, 2.042),
        (0.975, 120, 1.980),
        (0.025, 30, -2.042),
    ],
)
def test_t_quantiles_are_those_of_the_tables(p: float, freedom: int, value: float) -> None:
    assert t_quantile(p, freedom) == pytest.approx(value, abs=6e-4)


@pytest.mark.parametrize(
    ("p", "freedom", "value"),
    [
        (0.95, 1, 3.841),
        (0.005, 2, 0.010),
        (0.99, 3, 11.345),
        (0.05, 10, 3.940),
        (0.995, 29, 52.336),
        (0.975, 100, 129.561),
        (0.01, 100, 70.065),
    ],
)
def test_chi_square_quantiles_are_those_of_the_tables(p: float, freedom: int, value: float) -> None:
    assert chi_square_quantile(p, freedom) == pytest.approx(value, abs=6e-4)


def test_many_degrees_of_freedom_are_near_the_normal_distribution() -> None:
    assert t_quantile(0.975, 5001) == pytest.approx(1.959964, abs=1e-3)
    n = 4000
    wilson_hilferty = n * (1 - 2 / (9 * n) + 2.575829 * math.sqrt(2 / (9 * n))) ** 3
    assert chi_square_quantile(0.995, n) == pytest.approx(wilson_hilferty, rel=1e-5)


def test_an_interval_holds_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    samples = rng.normal(3.0, 2.0, (4000, 5))
    held = [i.low <= 3.0 <= i.high for i in (mean_interval(row.tolist(), 0.9) for row in samples)]  # type: ignore[operator]
    assert abs(np.mean(held) - 0.9) < 6 * math.sqrt(0.9 * 0.1 / 4000)


def test_the_nees_of_gaussian_errors_is_in_its_band_as_often_as_it_says() -> None:
    rng = np.random.default_rng(2)
    low, high = nees_band(3, 20, 0.95)
    nees = (rng.standard_normal((4000, 20, 3)) ** 2).sum(axis=2).mean(axis=1)
    assert abs(((low <= nees) & (nees <= high)).mean() - 0.95) < 6 * math.sqrt(0.95 * 0.05 / 4000)


def test_one_value_has_no_interval_and_equal_ones_have_none_to_speak_of() -> None:
    assert mean_interval([2.0], 0.95) == (2.0, None, None, 1)
    assert mean_interval([2.0, 2.0, 2.0], 0.95) == (2.0, 2.0, 2.0, 3)
    with pytest.raises(ValueError, match="nothing"):
        mean_interval([], 0.95)
