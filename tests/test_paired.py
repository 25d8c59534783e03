"""Paired differences: intervals that hold, and a test that knows when not to trust a mean."""

from __future__ import annotations

import numpy as np
import pytest

from zfusion.studies.paired import MEAN, MEDIAN, paired

ZEROS = [0.0] * 10


def test_by_hand() -> None:
    """Differences 1, 2, 3, 4: mean 2.5 ± t(0.975, 3) sqrt(5/3) / 2."""
    one = paired([1.0, 1.0, 1.0, 1.0], [2.0, 3.0, 4.0, 5.0], 0.95)
    assert (one.n, one.a, one.b, one.mean, one.median) == (4, 1.0, 3.5, 2.5, 2.5)
    assert one.mean_high - one.mean == pytest.approx(3.182446305 * np.sqrt(5 / 3) / 2)
    assert one.mean_low < one.mean < one.mean_high
    assert (one.above, one.below, one.sign_p) == (4, 0, 2 / 16)
    assert (one.median_low, one.median_high) == (None, None)  # 2 / 16 is more than 5 %
    assert one.basis == MEAN
    assert one.told_apart == (one.mean_low > 0)


def test_the_median_is_between_order_statistics() -> None:
    """P(Bin(10, 1/2) <= 1) = 11 / 1024: the second and the ninth of ten."""
    one = paired(ZEROS, [float(n) for n in range(1, 11)], 0.95)
    assert (one.median_low, one.median_high, one.median) == (2.0, 9.0, 5.5)


def test_one_pair_that_outweighs_all_others_is_not_averaged() -> None:
    values = [-1.0, -1.1, -0.9, -1.2, -0.8, -1.05, -0.95, -1.15, -0.85, 300.0]
    one = paired(ZEROS, values, 0.95)
    assert one.mean > 0
    assert one.heavy_tailed
    assert (one.basis, one.difference) == (MEDIAN, one.median)
    assert one.interval == (-1.15, -0.8)  # the second and the ninth
    assert one.told_apart
    assert not paired(ZEROS, [*values[:9], -1.0], 0.95).heavy_tailed


def test_few_pairs_of_heavy_tails_tell_nothing() -> None:
    one = paired([0.0] * 5, [1.0, 1.0, 1.0, 1.0001, 1e6], 0.95)
    assert one.heavy_tailed
    assert one.interval is None
    assert not one.told_apart


def test_ties_are_on_neither_side() -> None:
    one = paired(ZEROS, [0.0] * 8 + [1.0, -1.0], 0.95)
    assert (one.above, one.below, one.sign_p) == (1, 1, 1.0)
    assert not paired(ZEROS, ZEROS, 0.95).told_apart
    assert not paired(ZEROS, ZEROS, 0.95).heavy_tailed


def test_the_intervals_hold_as_often_as_they_say() -> None:
    """4000 times 12 pairs: 95 % within 5 standard errors, sqrt(0.95 * 0.05 / 4000) = 0.0034; the median's at least."""
    rng = np.random.default_rng(5)
    a, normal = rng.normal(size=(4000, 12)), rng.normal(size=(4000, 12))
    means = [paired(x.tolist(), (x + d).tolist(), 0.95) for x, d in zip(a, normal, strict=True)]
    held = np.mean([one.mean_low < 0 < one.mean_high for one in means])
    assert abs(held - 0.95) < 0.0172
    assert abs(np.mean([one.heavy_tailed for one in means]) - 0.01) < 0.0079  # 5 sqrt(0.01 * 0.99 / 4000)
    cauchy = [paired([0.0] * 12, d.tolist(), 0.95) for d in rng.standard_cauchy(size=(4000, 12))]
    medians = [one.median_low is not None and one.median_low < 0 < (one.median_high or 0) for one in cauchy]
    exact = 1 - 2 * (1 + 12 + 66) / 2**12  # the third to the tenth of twelve
    assert abs(np.mean(medians) - exact) < 5 * np.sqrt(exact * (1 - exact) / 4000)


def test_what_cannot_be_compared() -> None:
    with pytest.raises(ValueError, match="two pairs"):
        paired([1.0], [2.0], 0.95)
    with pytest.raises(ValueError, match="shorter"):
        paired([1.0, 2.0], [2.0], 0.95)
