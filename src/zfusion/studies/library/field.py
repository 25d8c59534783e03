"""A simple model of the temperature field, identified from a training part of the readings.

State x = (ℓ, ℓ', c_1 .. c_r, d_i of every mote i in the swarm):

    ℓ   common temperature, °C about the training's mean      ℓ_{k+1}  = ℓ_k + ℓ'_k
    ℓ'  its trend, °C a minute                                ℓ'_{k+1} = φ_0 ℓ'_k + w
    c_m spatial modes: what else the motes have in common     c_{k+1}  = φ_m c_k + w
    d_i the mote's own level: its mean, which wanders         d_{k+1}  = d_k + w

    mote i reads       y_i = b_i ℓ + Σ_m g_im c_m + d_i + v_i
    one held out, j    y_j = b_j ℓ + Σ_m g_jm c_m + mean_j,     its mean in the training in the place of d_j

Loadings b, g: principal components of the training. Everything else: moments of the training, matched by least squares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from zfusion.errors import InputError
from zfusion.model.types import Array
from zfusion.studies.library.data import Readings

RESOLUTION = 0.01
"""°C between neighbouring readings; a mote's noise has at least the variance of rounding to it."""

TREND_LAGS = range(2, 31)
"""Minutes over which the autocovariance of ℓ_{k+1} - ℓ_k is matched. White noise in ℓ reaches to lag 1 only."""

MODE_LAGS = range(1, 11)

MAX_PHI = 0.9999
"""A factor of decay of one would be a state without a variance of its own."""

MIN_TRAINING = 2 * TREND_LAGS[-1]


@dataclass(frozen=True, eq=False)
class FieldModel:
    """The model above in numbers; nx = 2 + modes + members."""

    members: tuple[int, ...]
    """Motes in the swarm, ascending."""
    F: Array
    Q: Array
    initial_mean: Array
    initial_covariance: Array
    """Of the state in the last round of the training, x_0."""
    H: Mapping[int, Array]
    """Of every mote, held out or not, (nx,)."""
    R: Mapping[int, float]
    """Variance of the noise of every member."""
    offset: Mapping[int, float]
    """What is to be added to H_j x: the mean of a mote that is held out, 0 for a member."""

    def reading(self, mote: int, x: Array) -> Array:
        """What `mote` is expected to read in the states x, (..., nx) -> (...)."""
        expected: Array = x @ self.H[mote] + self.offset[mote]
        return expected

    def variance(self, mote: int, P: Array) -> Array:
        """How uncertain that is where the states' errors have covariances P, (..., nx, nx) -> (...)."""
        variance: Array = P @ self.H[mote] @ self.H[mote]
        return variance


def identify(readings: Readings, members: Sequence[int], modes: int, rounds: int) -> FieldModel:
    """The model of the first `rounds` rounds, with `modes` spatial modes; deterministic.

    InputError where the training is too short, a mote hardly in it, or `modes` are more than the motes allow.
    """
    if rounds < MIN_TRAINING:
        raise InputError(f"a training of {rounds} rounds: expected at least {MIN_TRAINING}")
    if modes > len(readings.motes) - 2:
        raise InputError(f"{modes} spatial modes: expected at most {len(readings.motes) - 2}, two less than motes")
    training = readings.celsius[:rounds]
    for mote, count in zip(readings.motes, (~np.isnan(training)).sum(axis=0), strict=True):
        if count < rounds / 2:
            raise InputError(
                f"mote {mote} has {count} readings in a training of {rounds} rounds: expected at least half"
            )
    filled = without_gaps(training)
    mean = filled.mean(axis=0)
    loadings, scores = principal_components(filled - mean, 1 + modes)
    residuals = filled - mean - scores @ loadings.T
    trend_phi, trend_variance = damped(np.diff(scores[:, 0]), TREND_LAGS)
    spatial = [damped(score, MODE_LAGS) for score in scores[:, 1:].T]
    own = dict(zip(readings.motes, map(wandering, residuals.T), strict=True))
    means = dict(zip(readings.motes, mean.tolist(), strict=True))
    scatter = residuals.var(axis=0)
    F = np.diag([1.0, trend_phi, *(phi for phi, _ in spatial), *np.ones(len(members))])
    F[0, 1] = 1.0
    decay = [0.0, trend_variance * (1 - trend_phi**2), *(v * (1 - phi**2) for phi, v in spatial)]
    own_scatter = [scatter[readings.motes.index(mote)] for mote in members]
    return FieldModel(
        members=tuple(members),
        F=F,
        Q=np.diag([*decay, *(own[mote][0] for mote in members)]),
        initial_mean=np.array([scores[-1, 0], 0.0, *scores[-1, 1:], *(means[mote] for mote in members)]),
        initial_covariance=np.diag([scatter.mean(), trend_variance, *[scatter.mean()] * modes, *own_scatter]),
        H={mote: _row(mote, row, members) for mote, row in zip(readings.motes, loadings, strict=True)},
        R={mote: own[mote][1] for mote in members},
        offset={mote: 0.0 if mote in members else means[mote] for mote in readings.motes},
    )


def _row(mote: int, loadings: Array, members: Sequence[int]) -> Array:
    return np.array([loadings[0], 0.0, *loadings[1:], *(float(mote == member) for member in members)])


def without_gaps(values: Array) -> Array:
    """Missing entries of each column interpolated in time; a column must have some."""
    filled = values.copy()
    for column in filled.T:
        missing = np.isnan(column)
        column[missing] = np.interp(np.flatnonzero(missing), np.flatnonzero(~missing), column[~missing])
    return filled


def principal_components(centred: Array, count: int) -> tuple[Array, Array]:
    """Loadings (motes, count) and scores (rounds, count) of the leading components, so that
    centred ≈ scores @ loadings.T.

    The loadings of the first have mean 1, so that its score is a temperature; of each of the others mean square 1, and
    the largest is positive.
    """
    _, _, vectors = np.linalg.svd(centred, full_matrices=False)
    loadings = vectors[:count].T.copy()
    loadings[:, 0] /= loadings[:, 0].mean()
    others = loadings[:, 1:]
    others *= np.sqrt(len(others)) * np.sign(others[np.abs(others).argmax(axis=0), np.arange(count - 1)])
    return loadings, np.linalg.lstsq(loadings, centred.T, rcond=None)[0].T


def autocovariance(series: Array, lag: int) -> float:
    """Of a series, (n,), about its mean."""
    deviation = series - series.mean()
    return float(np.mean(deviation[lag:] * deviation[: len(deviation) - lag]))


def damped(series: Array, lags: range) -> tuple[float, float]:
    """φ and variance of an AR(1) process seen through white noise: γ(lag) = variance φ^lag at these lags.

    Least squares twice: φ from γ(lag + 1) = φ γ(lag), then the variance. White noise is in γ(0) only.
    """
    gamma = np.array([autocovariance(series, lag) for lag in lags])
    phi = float(np.clip(gamma[1:] @ gamma[:-1] / (gamma[:-1] @ gamma[:-1]), 0.0, MAX_PHI))
    powers = phi ** np.array(lags)
    return phi, max(float(gamma @ powers / (powers @ powers)), 0.0) if powers.any() else 0.0


def wandering(series: Array) -> tuple[float, float]:
    """Variances (q, r) of a random walk's steps and of the white noise through which it is seen.

    Its differences have the autocovariances γ(0) = q + 2 r, γ(1) = -r.
    """
    steps = np.diff(series)
    r = max(-autocovariance(steps, 1), RESOLUTION**2 / 12)
    return max(autocovariance(steps, 0) - 2 * r, 0.0), r
