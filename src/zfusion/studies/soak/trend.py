"""A trend that single outliers do not bend: the median of the slopes between all pairs of points.

Sources: H. Theil, Proc. Kon. Ned. Akad. Wetensch. A 53 (1950); P. K. Sen, J. Amer. Statist. Assoc. 63 (1968) 1379-1389.
"""

from __future__ import annotations

from math import floor, sqrt
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from zfusion.model.types import Array

MOST_POINTS = 300
"""Points between which slopes are taken; of more, medians over as many equal blocks: pairs grow with the square."""

CONFIDENCE = 0.95


class Trend(NamedTuple):
    """A slope and its interval, in units of y over units of x."""

    slope: float
    low: float
    high: float


def theil_sen(x: Array, y: Array) -> Trend:
    """The trend of y, (n,), over ascending x, (n,), n >= 2, with Sen's interval by Kendall's statistic.

    The interval is that of independent errors about the line. Of errors that hang together it is too narrow: what is
    decided by it needs a tolerance of its own. ValueError for less than two points.
    """
    if len(x) < 2:
        raise ValueError(f"a trend takes two points, not {len(x)}")
    x, y = _medians(x), _medians(y)
    n = len(x)
    first, second = np.triu_indices(n, 1)
    apart = x[second] - x[first]
    slopes = np.sort((y[second] - y[first])[apart > 0] / apart[apart > 0])
    if not len(slopes):
        raise ValueError("a trend takes two points at different x")
    half = NormalDist().inv_cdf(0.5 + CONFIDENCE / 2) * sqrt(n * (n - 1) * (2 * n + 5) / 18)
    low = max(0, floor((len(slopes) - half) / 2))
    return Trend(float(np.median(slopes)), float(slopes[low]), float(slopes[len(slopes) - 1 - low]))


def _medians(values: Array) -> Array:
    if len(values) <= MOST_POINTS:
        return values
    return np.array([float(np.median(block)) for block in np.array_split(values, MOST_POINTS)])
