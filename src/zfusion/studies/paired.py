"""Paired differences and what may be concluded from them.

d_n = b_n - a_n, n = 1..N independent pairs. Two intervals:

- of the mean, by Student's t: mean(d) ± t s / √N;
- of the median, from the order statistics d_(k)..d_(N+1-k), 2 P(Bin(N, ½) < k) <= 1 - confidence: right for
  differences of any distribution, since each lies above its median with probability ½.

The first one is what one wants, and is not to be trusted where single pairs outweigh all others. Whether that is so
is Grubbs' test's to say: is the largest |d_n - mean| more than N normal values would have but once in a hundred times?

References: F. E. Grubbs, Procedures for detecting outlying observations in samples, Technometrics 11 (1969);
W. J. Conover, Practical Nonparametric Statistics, 3.2 (order statistics), 3.4 (sign test).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from zfusion.studies.intervals import mean_interval, t_quantile

OUTLYING = 0.01
"""Grubbs' test errs that often on normal differences."""

MEAN, MEDIAN = "mean", "median"


@dataclass(frozen=True)
class Paired:
    """How b differs from a."""

    n: int
    a: float
    b: float
    """Means over the pairs."""
    mean: float
    mean_low: float
    mean_high: float
    median: float
    median_low: float | None
    median_high: float | None
    """None where there are too few pairs for an interval of that confidence."""
    above: int
    below: int
    """Pairs in which b is more than a, and less."""
    sign_p: float
    """Probability of as uneven a count, or more so, if b were as often above as below."""
    heavy_tailed: bool
    """Whether single pairs outweigh all others, so that the interval of the median is the one to go by."""
    confidence: float

    @property
    def basis(self) -> str:
        """Whose interval counts: that of the mean or that of the median."""
        return MEDIAN if self.heavy_tailed else MEAN

    @property
    def difference(self) -> float:
        """The difference that counts."""
        return self.median if self.heavy_tailed else self.mean

    @property
    def interval(self) -> tuple[float, float] | None:
        """The interval that counts; None where there is none."""
        if not self.heavy_tailed:
            return self.mean_low, self.mean_high
        return None if self.median_low is None or self.median_high is None else (self.median_low, self.median_high)

    @property
    def told_apart(self) -> bool:
        """Whether 0 is not in it."""
        return self.interval is not None and (self.interval[0] > 0 or self.interval[1] < 0)

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return {**asdict(self), "basis": self.basis, "told_apart": self.told_apart}


def paired(a: Sequence[float], b: Sequence[float], confidence: float) -> Paired:
    """Compare pairs of values; ValueError for less than two pairs, or unequal numbers."""
    differences = [after - before for before, after in zip(a, b, strict=True)]
    n = len(differences)
    if n < 2:
        raise ValueError("an interval needs two pairs or more")
    mean = mean_interval(differences, confidence)
    assert mean.low is not None  # there are two or more
    assert mean.high is not None
    ordered = sorted(differences)
    k = _order(n, confidence)
    above, below = sum(d > 0 for d in differences), sum(d < 0 for d in differences)
    return Paired(
        n=n,
        a=math.fsum(a) / n,
        b=math.fsum(b) / n,
        mean=mean.mean,
        mean_low=mean.low,
        mean_high=mean.high,
        median=(ordered[(n - 1) // 2] + ordered[n // 2]) / 2,
        median_low=ordered[k - 1] if k else None,
        median_high=ordered[n - k] if k else None,
        above=above,
        below=below,
        sign_p=min(1.0, 2 * _at_most(min(above, below), above + below)),
        heavy_tailed=_outlying(differences),
        confidence=confidence,
    )


def _order(n: int, confidence: float) -> int:
    """The largest k with 2 P(Bin(n, ½) < k) <= 1 - confidence; 0 where there is none."""
    k = 0
    while 2 * _at_most(k, n) <= 1 - confidence:
        k += 1
    return k


def _at_most(k: int, n: int) -> float:
    """P(Bin(n, ½) <= k)."""
    return math.fsum(math.comb(n, i) / 2**n for i in range(k + 1))


def _outlying(values: Sequence[float]) -> bool:
    """Grubbs' two-sided test; False for fewer than three values."""
    n = len(values)
    mean = math.fsum(values) / n
    scatter = math.fsum((value - mean) ** 2 for value in values)
    if n < 3 or not scatter:
        return False
    largest = max(abs(value - mean) for value in values)
    t = t_quantile(1 - OUTLYING / (2 * n), n - 2)
    critical = (n - 1) / math.sqrt(n) * math.sqrt(t * t / (n - 2 + t * t))
    return largest > critical * math.sqrt(scatter / (n - 1))
