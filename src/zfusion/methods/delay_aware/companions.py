"""Two Kalman filters for the same model, on the state together with the last measurements, ζ = [x; y_k; ..; y_{k-L}].

`Augmented` is the linear least-squares estimate from what the filter of the source has, too: it is never worse.
`Stamped` knows how old each message is, and takes all that come: whoever has time stamps should use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zfusion.methods.delay_aware.joint import (
    Joints,
    Reception,
    Settling,
    delay_noise,
    gain,
    measured,
    predicted,
    received,
    starting,
)
from zfusion.model.types import Array


class Packet(NamedTuple):
    """Some rows of a measurement that was `age` steps old when it came."""

    age: int
    rows: slice
    y: Array


class Gain(NamedTuple):
    """What does not depend on what is received."""

    K: Array
    """(n + (L+1) m, m)."""
    error: Array
    """Covariance of the error of ζ after it, square."""


class Augmented(Settling[Gain]):
    """Least squares from r_0, ..., r_k, whose delays are not seen. `receive` and `move` as for `Filter`."""

    def __init__(self, mean: Array, covariance: Array, steps: int, m: int) -> None:
        """As for `Filter`."""
        second = covariance + np.outer(mean, mean)
        super().__init__(Joints(starting(covariance, steps, m), starting(second, steps, m)))
        self._n, self._m = len(mean), m
        self._mean = np.concatenate((mean, np.zeros((steps + 1) * m)))
        self._received: tuple[Gain, Reception] | None = None

    @property
    def x(self) -> Array:
        """The estimate of x_k, (n,), with what was received at step k once that is there."""
        return self._mean[: self._n]

    @property
    def P(self) -> Array:
        """Its error covariance, (n, n)."""
        error = self._joints.error if self._received is None else self._received[0].error
        return error[: self._n, : self._n]

    def receive(self, r: Array, given: Reception) -> None:
        """Take in what is received at step k, (m,): zero where nothing is."""
        n, found = self._n, self._receive(self._n, given)
        mean = self._mean.copy()
        mean[n : n + self._m] = given.H @ self.x
        expected = (given.p * mean[n:].reshape(given.p.shape)).sum(axis=0)
        self._mean = mean + found.K @ (r - expected)
        self._received = found, given

    def move(self, A: Array, Q: Array) -> None:
        """To the next step. ValueError before anything was received."""
        if self._received is None:
            raise ValueError("nothing was received at this step")
        self._move(self._n, self._received[1], A, Q)
        self._mean = _mean_moved(self._mean, self._n, self._m, A)
        self._received = None

    def _gains(self, measured: Joints, given: Reception) -> Gain:
        n = self._n
        row, spread = received(measured.error, n, given.p)
        S = 0.5 * (spread + spread.T) + delay_noise(measured.signal, n, given)
        return Gain(*_updated(measured.error, row.T, S))

    def _following(self, measured: Joints, found: Gain, A: Array, Q: Array, L: Array | None) -> Joints:  # noqa: ARG002
        return Joints(*(predicted(J, self._n, self._m, A, Q) for J in (found.error, measured.signal)))


class Stamped:
    """Least squares from messages with time stamps; each measurement is taken in once."""

    def __init__(self, mean: Array, covariance: Array, steps: int, m: int) -> None:
        """As for `Filter`."""
        self._n, self._m = len(mean), m
        self._mean = np.concatenate((mean, np.zeros((steps + 1) * m)))
        self._covariance = starting(covariance, steps, m)

    @property
    def x(self) -> Array:
        """As for `Augmented`."""
        return self._mean[: self._n]

    @property
    def P(self) -> Array:
        """Its error covariance, (n, n)."""
        return self._covariance[: self._n, : self._n]

    def receive(self, packets: Sequence[Packet], given: Reception) -> None:
        """Take in what is received at step k; of `given`, p does not matter."""
        n = self._n
        self._mean = self._mean.copy()
        self._mean[n : n + self._m] = given.H @ self.x
        self._covariance = measured(self._covariance, n, given.H, given.R)
        if not packets:
            return
        own = np.concatenate([np.arange(packet.rows.start, packet.rows.stop) for packet in packets])
        ages = np.repeat([packet.age for packet in packets], [len(packet.y) for packet in packets])
        index = n + ages * self._m + own
        S = self._covariance[np.ix_(index, index)] + given.N[np.ix_(own, own)]
        e = np.concatenate([packet.y for packet in packets]) - self._mean[index]
        K, self._covariance = _updated(self._covariance, self._covariance[:, index], S)
        self._mean = self._mean + K @ e

    def move(self, A: Array, Q: Array) -> None:
        """To the next step."""
        self._mean = _mean_moved(self._mean, self._n, self._m, A)
        self._covariance = predicted(self._covariance, self._n, self._m, A, Q)


def _updated(covariance: Array, cross: Array, S: Array) -> tuple[Array, Array]:
    """The gain, and the covariance after it."""
    K = gain(cross, S)
    P = covariance - K @ cross.T
    return K, 0.5 * (P + P.T)


def _mean_moved(mean: Array, n: int, m: int, A: Array) -> Array:
    return np.concatenate((A @ mean[:n], np.zeros(m), mean[n:-m]))
