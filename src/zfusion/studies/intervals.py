"""Confidence intervals: Student's t for means, chi-square for normalised squared errors.

Exact for whole degrees of freedom: the distribution functions are finite sums.

References: M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 26.4.4, 26.4.5 (chi-square), 26.7.3,
26.7.4 (t).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple


class Interval(NamedTuple):
    """A mean and the interval that holds the true one with the confidence that was asked for."""

    mean: float
    low: float | None
    """None where one value says nothing about its scatter."""
    high: float | None
    n: int


def mean_interval(values: Sequence[float], confidence: float) -> Interval:
    """Mean of independent values and its interval by Student's t: mean ± t s / √n. ValueError if there are none.

    Exact for normal values; for others the better, the more there are and the less skewed they are.
    """
    n = len(values)
    if not n:
        raise ValueError("the mean of nothing")
    mean = math.fsum(values) / n
    if n == 1:
        return Interval(mean, None, None, 1)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1))
    half = t_quantile((1 + confidence) / 2, n - 1) * deviation / math.sqrt(n)
    return Interval(mean, mean - half, mean + half, n)


def nees_band(dimension: int, runs: int, confidence: float) -> tuple[float, float]:
    """Where the mean over independent runs of a normalised squared error, chi-square of `dimension`, lies."""
    freedom = dimension * runs
    tail = (1 - confidence) / 2
    return chi_square_quantile(tail, freedom) / runs, chi_square_quantile(1 - tail, freedom) / runs


@cache
def t_quantile(p: float, freedom: int) -> float:
    """x with P(T <= x) = p, for 0 < p < 1 and `freedom` >= 1."""
    if p < 0.5:
        return -t_quantile(1 - p, freedom)
    high = 1.0
    while _t_cdf(high, freedom) < p:
        high *= 2
    return _bisected(lambda x: _t_cdf(x, freedom), p, 0.0, high)


@cache
def chi_square_quantile(p: float, freedom: int) -> float:
    """x with P(χ² <= x) = p, for 0 < p < 1 and `freedom` >= 1."""
    high = float(freedom)
    while _chi_square_cdf(high, freedom) < p:
        high *= 2
    return _bisected(lambda x: _chi_square_cdf(x, freedom), p, 0.0, high)


def _t_cdf(t: float, freedom: int) -> float:
    """P(T <= t), t >= 0: half of one plus A(t), a sum of powers of cos θ, θ = arctan(t / √freedom)."""
    theta = math.atan(t / math.sqrt(freedom))
    cosine = math.cos(theta)
    odd = freedom % 2
    term = total = cosine if odd else 1.0
    if freedom == 1:
        total = 0.0
    for n in range(3 if odd else 2, freedom - 1, 2):
        term *= cosine * cosine * (n - 1) / n
        total += term
    inside = 2 / math.pi * (theta + math.sin(theta) * total) if odd else math.sin(theta) * total
    return (1 + inside) / 2


def _chi_square_cdf(x: float, freedom: int) -> float:
    """P(χ² <= x), x >= 0, from the sum of its tail's terms (in logarithms: they would underflow)."""
    if x <= 0:
        return 0.0
    half = x / 2
    if freedom % 2:
        tail = math.erfc(math.sqrt(half))
        shapes = [n + 0.5 for n in range((freedom - 1) // 2)]
    else:
        tail = 0.0
        shapes = [float(n) for n in range(freedom // 2)]
    tail += math.fsum(math.exp(shape * math.log(half) - half - math.lgamma(shape + 1)) for shape in shapes)
    return 1 - tail


def _bisected(rising: Callable[[float], float], value: float, low: float, high: float) -> float:
    """Where a rising function takes a value, between two arguments, to the last bit."""
    while low < (middle := (low + high) / 2) < high:
        if rising(middle) < value:
            low = middle
        else:
            high = middle
    return (low + high) / 2
