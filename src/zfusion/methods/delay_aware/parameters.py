"""The model of the source, with its random gains as scalars, checked: from its letters to those of the recursion.

x_{k+1} = (A + g Ah) x_k + w_k          y^i_k = f^i C^i x_k + v^i_k          r^i_k = Σ_j 1{τ^i = j} y^i_{k-j} + n^i_k
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zfusion.methods.delay_aware.joint import Reception
from zfusion.methods.delay_aware.recursion import Filter, Innovation
from zfusion.model.checks import ModelError, finite_array
from zfusion.model.types import Array

TOLERANCE = 1e-10
"""Of symmetry, relative, and of the lowest eigenvalue, relative to the largest entry or to 1."""

SUM = 1e-12
"""By how much probabilities may add up to more than 1."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """Those of step k. ModelError, which names k, for what cannot be.

    V and N are (m, m), or a list of blocks, one for each class.
    """

    k: int
    A: Array
    Ah: Array
    W: Array
    C: Sequence[Array]
    """One for each class, (m_i, n)."""
    V: Any
    N: Any
    p: Array
    """p_j of each class, (L+1, classes)."""
    gbar: float = 0.0
    g2: float = 0.0
    """E g²: the second moment, not the variance."""
    fbar: Any = None
    """E f of each class; all 1 unless given."""
    f2: Any = None
    """E f² of each class: the second moment; fbar² unless given."""
    f_range: tuple[float, float] = (0.0, 1.0)
    """Between which f is."""

    def __post_init__(self) -> None:
        n = len(np.atleast_2d(self.A))
        for name in ("A", "Ah"):
            self._set(name, self._array(name, getattr(self, name), (n, n)))
        self._set("W", self.checked_covariance("W", self.W, n))
        self._set("C", tuple(self._array(f"C[{i}]", C, (None, n)) for i, C in enumerate(self.C)))
        sizes = [len(C) for C in self.C]
        for name in ("V", "N"):
            self._set(name, self.checked_covariance(name, self._whole(name, sizes), sum(sizes)))
        count = len(sizes)
        self._set("fbar", self._array("fbar", np.ones(count) if self.fbar is None else self.fbar, (count,)))
        self._set("f2", self._array("f2", self.fbar**2 if self.f2 is None else self.f2, (count,)))
        self._set("p", self._array("p", self.p, (None, count)))
        self._check_probabilities()
        self._check_gains()

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _error(self, name: str, value: object, expected: str) -> ModelError:
        return ModelError(f"{name} at k = {self.k}", value, expected)

    def _array(self, name: str, value: Any, shape: tuple[int | None, ...]) -> Array:
        return finite_array(f"{name} at k = {self.k}", value, shape)

    def checked_covariance(self, name: str, value: Any, size: int, hint: str = "") -> Array:
        """Symmetric and positive semi-definite, (size, size)."""
        matrix = self._array(name, value, (size, size))
        if np.abs(matrix - matrix.T).max() > TOLERANCE * np.abs(matrix).max():
            raise self._error(name, matrix.tolist(), "expected a symmetric matrix")
        lowest = float(np.linalg.eigvalsh(matrix)[0])
        if lowest < -TOLERANCE * max(1.0, float(np.abs(matrix).max())):
            expected = f"expected a positive semi-definite matrix; its lowest eigenvalue is {lowest:.3g}{hint}"
            raise self._error(name, matrix.tolist(), expected)
        return matrix

    def _whole(self, name: str, sizes: Sequence[int]) -> Any:
        """A matrix as it is; a list of blocks, one for each class, as a block-diagonal matrix."""
        value = getattr(self, name)
        if not isinstance(value, list | tuple) or np.ndim(value[0]) != 2:
            return value
        if len(value) != len(sizes):
            raise self._error(name, len(value), f"expected {len(sizes)} blocks, one for each class")
        whole, end = np.zeros((sum(sizes),) * 2), 0
        for i, (block, size) in enumerate(zip(value, sizes, strict=True)):
            rows = slice(end, end + size)
            whole[rows, rows] = self._array(f"{name}[{i}]", block, (size, size))
            end += size
        return whole

    def _check_probabilities(self) -> None:
        if (self.p < 0).any() or (self.p > 1).any():
            raise self._error("p", self.p.tolist(), "expected probabilities, from 0 to 1")
        total = self.p.sum(axis=0)
        if (total > 1 + SUM).any():
            raise self._error("p", total.tolist(), "expected the probabilities of a class to add up to 1 or less")

    def _check_gains(self) -> None:
        if self.g2 < self.gbar**2 * (1 - TOLERANCE):
            raise self._error("g2", self.g2, f"expected gbar^2 = {self.gbar**2:g} or more{_SECOND}")
        low, high = self.f_range
        for i, (mean, second) in enumerate(zip(self.fbar.tolist(), self.f2.tolist(), strict=True)):
            if second < mean**2 * (1 - TOLERANCE):
                raise self._error(f"f2[{i}]", second, f"expected fbar^2 = {mean**2:g} or more{_SECOND}")
            if not low <= mean <= high:
                raise self._error(f"fbar[{i}]", mean, f"expected a mean of what is between {low:g} and {high:g}")
            most = (low + high) * mean - low * high
            if second > most + TOLERANCE:
                raise self._error(f"f2[{i}]", second, f"expected {most:g} or less for f between {low:g} and {high:g}")

    @cached_property
    def _owner(self) -> Any:
        return np.repeat(np.arange(len(self.C)), [len(C) for C in self.C])

    @property
    def mean(self) -> Array:
        """E[A + g Ah]."""
        return self.A + self.gbar * self.Ah

    def noise(self, X: Array) -> Array:
        """Q: W and what the random gain of the state adds, given E[x xᵀ] = X, (n, n)."""
        return self.W + max(self.g2 - self.gbar**2, 0.0) * self.Ah @ X @ self.Ah.T

    def reception(self, X: Array) -> Reception:
        """What the filter takes with a reception, given E[x xᵀ] = X, (n, n)."""
        owner, C = self._owner, np.vstack(self.C)
        same = (owner[:, None] == owner).astype(np.float64)
        spread = np.maximum(self.f2 - self.fbar**2, 0.0)[owner][:, None]
        R = self.V + same * spread * (C @ X @ C.T)
        return Reception(self.fbar[owner][:, None] * C, R, self.N, self.p[:, owner], same)

    def filter(self, mean: Any, second_moment: Any) -> Filter:
        """The filter that begins with E x_0, (n,), and E[x_0 x_0ᵀ], (n, n), the second moment."""
        n = len(self.A)
        x = self._array("x0", mean, (n,))
        X = self.checked_covariance("X00", second_moment, n)
        covariance = self.checked_covariance("X00 - x0 x0^T", X - np.outer(x, x), n, _SECOND)
        return Filter(x, covariance, len(self.p) - 1, len(self._owner))

    def step(self, running: Filter, r: Any, L: Array | None = None) -> Innovation:
        """Receive r, (m,), and move on; `L` as for `Filter.move`."""
        r = np.asarray(r, dtype=np.float64)
        if np.isnan(r).any():
            expected = (
                "expected no NaN: drop-outs are in the model, pass the received vector, zero when nothing arrived"
            )
            raise self._error("r", r.tolist(), expected)
        found = running.receive(self._array("r", r, (len(self._owner),)), self.reception(running.X))
        running.move(self.mean, self.noise(running.X), L)
        return found


_SECOND = "; is it a variance, where a second moment is meant?"
