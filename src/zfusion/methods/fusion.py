"""Stage 2: the best affine combination of the neighbours' intermediate estimates.

Source: Caballero-Águila et al., Information Fusion 45 (2019) 324-332, Theorem 2, in error form: the own estimate is the
reference, z_j = x̂^j - x̂^i for the neighbours and z_0 = m - x̂^i for the prior mean, which is free information;

    x̂_fused = x̂^i + c Z⁺ z,   Σ = P^(ii) - c Z⁺ cᵀ
    c_j = P^(ii) - P^(ij),    Z_jl = P^(ii) - P^(il) - P^(ji) + P^(jl)
    prior: P^(0l) = P^(l0) = P^(ll) and P^(00) = Cov[x_k], so that c_0 = 0

It is Theorem 2 exactly where m = 0, never worse elsewhere, and does not depend on where the origin lies.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from zfusion.methods.covariances import SMALLEST_VARIANCE
from zfusion.methods.layout import Ints, Layout
from zfusion.model.types import Array, NodeId

TWIN = 1e-13
"""A difference of estimates whose variance is below this fraction of the own error's variance is rounding.

Two neighbours that used the same measurements have the same estimate; its difference carries no weight."""

ROUNDING = 1e-14
"""Rounding in Z, in parts of P^(ii) or of itself, with a margin: an eigenvalue that does not stand out of it is zero.

Differences may determine each other. And the estimates of nodes that lost a few of each other's messages converge:
on their way through 1e-6 of a standard deviation their differences, scaled up, are mostly rounding, and weights made
of that would be anything."""

MARGIN = 300.0
"""A Z all of whose pivots stand out of the rounding this far has no eigenvalue near it: it is solved as it is."""


def joint_index(layout: Layout, nodes: Sequence[NodeId], nx: int) -> Ints:
    """Where in `State.P.flat` the matrix stands that `fusion_weights` takes, for the own node and then the others.

    In the place of P^(00) there is something else of the same size.
    """
    where = layout.among(nodes, nx)
    c = len(nodes)
    order = np.array([0, 0, *range(1, c)])  # the prior after the own node
    index = where[order[:, None], order]
    each = where[np.arange(c), np.arange(c)][order]
    index[1, :], index[:, 1] = each, each
    joint: Ints = index.swapaxes(1, 2).reshape((1 + c) * nx, (1 + c) * nx)
    return joint


def fusion_weights(joint: Array, prior: Array) -> tuple[Array, Array]:
    """Weights of the differences z = (z_0, z_1, ...) and the covariance of the fused error.

    Args:
        joint: covariances of the errors of x̂^i, of the prior mean and of the x̂^j of the d neighbours that are fused,
            (..., (2 + d) nx, (2 + d) nx), all but P^(00), in whose place there may be anything finite.
        prior: P^(00) = Cov[x_k], (nx, nx). Where it is not finite (an unstable system, long after its start) the
            prior knows nothing and has no weight.

    Returns:
        (weights, Σ): (..., nx, (1 + d) nx), the prior's columns first, and (..., nx, nx).
    """
    nx = len(prior)
    joint = joint.copy()
    joint[..., nx : 2 * nx, nx : 2 * nx] = prior if np.isfinite(prior).all() else 0.0  # then Z_00 is below any TWIN
    difference = _differences(joint.shape[-1] // nx - 1, nx)
    own = joint[..., :nx, :nx]
    c = joint[..., :nx, :] @ difference.T
    Z = difference @ joint @ difference.T
    reference = np.concatenate((own.diagonal(0, -2, -1),) * (Z.shape[-1] // nx), axis=-1)
    variance = Z.diagonal(0, -2, -1)
    alive = variance > np.maximum(TWIN * reference, SMALLEST_VARIANCE)
    scale = alive / np.sqrt(np.where(alive, variance, 1.0))
    unit = Z * (scale[..., :, None] * scale[..., None, :])
    np.einsum("...aa->...a", unit)[...] = 1.0
    rounding = np.sqrt(ROUNDING * np.maximum(reference, variance)) * scale
    weights = _solve(unit, c * scale[..., None, :], rounding) * scale[..., None, :]
    gained = weights @ c.swapaxes(-1, -2)
    return weights, own - 0.5 * (gained + gained.swapaxes(-1, -2))


def fuse(own: Array, others: Sequence[Array], mean: Array, weights: Array) -> Array:
    """x̂^i + c Z⁺ z: own (nx,), others (nx,) each in the order of the weights, prior mean (nx,)."""
    z = np.concatenate((mean, *others)).reshape(-1, len(own)) - own
    fused: Array = own + weights @ z.reshape(-1)
    return fused


@cache
def _differences(count: int, nx: int) -> Array:
    """(e^i - e^0; e^i - e^1; ...) in terms of (e^i; e^0; e^1; ...), (count nx, (1 + count) nx)."""
    matrix: Array = np.kron(np.hstack((np.ones((count, 1)), -np.eye(count))), np.eye(nx)).astype(np.float64)
    return matrix


def _solve(unit: Array, c: Array, rounding: Array) -> Array:
    """c Z⁺ for covariance matrices Z with unit diagonals, (..., n, n), and c (..., nx, n).

    `rounding` are the standard deviations, (..., n), of the rounding in each of the rows.
    """
    try:
        pivots = np.linalg.cholesky(unit).diagonal(0, -2, -1)
        regular = (pivots.min(-1) > MARGIN * rounding.sum(-1)).all()
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        return np.asarray(np.linalg.solve(unit, c.swapaxes(-1, -2)), dtype=np.float64).swapaxes(-1, -2)
    values, vectors = np.linalg.eigh(unit)
    kept = values > (rounding[..., None, :] @ np.abs(vectors))[..., 0, :] ** 2
    projected: Array = (c @ vectors) * (kept / np.where(kept, values, 1.0))[..., None, :]
    truncated: Array = projected @ vectors.swapaxes(-1, -2)
    return truncated
