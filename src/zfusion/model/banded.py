"""Covariances of one-step correlated sequences: are they legal, and a square root that can be drawn from.

A sequence z_1, z_2, ... of vectors (n,) with Cov[z_k, z_k] = Γ0_k, Cov[z_k, z_{k-1}] = Γ1_k and nothing further apart
has a block-tridiagonal covariance. Its Cholesky factor has two blocks a row, found one row after the other:

    z_k = A_k u_k + B_k u_{k-1},   u white of unit covariance
    B_k = Γ1_k A_{k-1}^{-T},   A_k A_kᵀ = Γ0_k - B_k B_kᵀ

Common noise makes such covariances singular: then the A_k are, and what is to be inverted is decided by rounding. No
threshold on the rank helps (the error of a pseudo-inverse grows from row to row, to a lost run within twenty). What
does is to take variances SLACK larger than they are, by an independent noise too small for anybody to notice: that is
positive definite, and Cholesky factorisation of such a matrix is as exact as its numbers are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count
from typing import NamedTuple

import numpy as np

from zfusion.model.types import Array

SLACK = 1e-12
"""Part of each variance that a legal covariance may lack, and that is added to it: 1e-6 of the standard deviation."""

SETTLED = 1e-14
"""Change of an entry of A_k or B_k, relative to its component's standard deviation, that counts as none."""

SETTLED_EVERY = 16
"""Whether rows have settled is looked at every so many steps: a look costs as much as half a row."""

FREQUENCIES = 129
"""Grid points from 0 to π on which a spectral density is examined, before its minima are refined."""

REFINEMENTS = 4
"""Times that the neighbourhoods of the lowest points are examined sixteen times finer."""


class Indefinite(ValueError):
    """No sequence of random vectors has these covariances."""


class RootRow(NamedTuple):
    """One row of the square root: z_k = A u_k + B u_{k-1}, both (n, n)."""

    A: Array
    B: Array


Blocks = Callable[[int], tuple[Array, Array]]
"""Γ0_k and Γ1_k for k >= 1, both (n, n); Γ1_1 is not used."""


def root_rows(blocks: Blocks, constant_from: int | None) -> Iterator[RootRow]:
    """Rows k = 1, 2, ... of a square root, without end; raises Indefinite at the first row that cannot be.

    From step `constant_from` on `blocks` is taken to stay the same (None: never). Once rows have settled, which those
    of singular covariances may never do, the same object comes again and again.
    """
    scale, G0, G1 = _scaled(*blocks(1), None)
    root = _cholesky(G0, 1)
    row = RootRow(scale * root, np.zeros_like(root))
    yield row
    for k in count(2):
        if constant_from is None or k <= constant_from + 1:
            scale, G0, G1 = _scaled(*blocks(k), scale)
        mixed = np.linalg.solve(root, G1.T).T
        root = _cholesky(G0 - mixed @ mixed.T, k)
        before, row = row, RootRow(scale * root, scale * mixed)
        yield row
        if constant_from is not None and k > constant_from and k % SETTLED_EVERY == 0 and _settled(before, row, scale):
            break
    while True:
        yield row


def _scaled(G0: Array, G1: Array, scale_before: Array | None) -> tuple[Array, Array, Array]:
    """Standard deviations as a column, and both blocks in units of them, Γ0 with SLACK on its diagonal."""
    scale = np.sqrt(np.maximum(np.diag(G0), 0.0))[:, None]
    before = scale if scale_before is None else scale_before
    now_dead, before_dead = scale[:, 0] == 0, before[:, 0] == 0
    if G0[now_dead].any() or (scale_before is not None and (G1[now_dead].any() or G1[:, before_dead].any())):
        raise Indefinite("a component without variance is correlated")
    unit, unit_before = np.where(scale > 0, scale, 1.0), np.where(before > 0, before, 1.0)
    return scale, G0 / (unit * unit.T) + SLACK * np.eye(len(G0)), G1 / (unit * unit_before.T)


def _cholesky(matrix: Array, k: int) -> Array:
    try:
        root: Array = np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        raise Indefinite(f"a variance given the past is negative at step {k}") from None
    return root


def _settled(before: RootRow, row: RootRow, scale: Array) -> bool:
    return all((np.abs(now - then) <= SETTLED * scale).all() for now, then in zip(row, before, strict=True))


def spectral_floor(G0: Array, G1: Array) -> float:
    """Lowest eigenvalue over all frequencies θ of Γ0 + Γ1 e^{-iθ} + Γ1ᵀ e^{iθ}, in units of the variances.

    For covariances that do not change with time: they are legal if and only if it is not negative. -inf where a
    component without variance is correlated.
    """
    live = np.diag(G0) > 0
    if (np.diag(G0) < 0).any() or G0[~live].any() or G1[~live].any() or G1[:, ~live].any():
        return -np.inf
    if not live.any():
        return 0.0
    at = np.ix_(live, live)
    scale = np.sqrt(np.outer(G0.diagonal()[live], G0.diagonal()[live]))

    def floor(theta: Array) -> Array:
        turn = np.exp(-1j * theta)[:, None, None]
        eigenvalues: Array = np.linalg.eigvalsh((G0[at] + G1[at] * turn + G1[at].T / turn) / scale)
        return eigenvalues[:, 0]

    if not G1.any():
        return float(floor(np.zeros(1))[0])
    theta = np.linspace(0, np.pi, FREQUENCIES)
    width = theta[1]
    lowest = floor(theta)
    for _ in range(REFINEMENTS):
        theta = (theta[np.argsort(lowest)[:4], None] + np.linspace(-width, width, 33)).ravel()
        width /= 16
        lowest = floor(theta)
    return float(lowest.min())
