"""Stage 2: the best affine combination of the neighbours' intermediate estimates.

Source: Caballero-Águila et al., Information Fusion 45 (2019) 324-332, Theorem 2, in error form: the own estimate is the
reference, z_j = x̂^j - x̂^i for the neighbours and z_0 = m - x̂^i for the prior mean, which is free information;

    x̂_fused = x̂^i + c Z⁺ z,   Σ = P^(ii) - c Z⁺ cᵀ
    c_j = P^(ii) - P^(ij),    Z_jl = P^(ii) - P^(il) - P^(ji) + P^(jl)
    prior: P^(0l) = P^(l0) = P^(ll), so c_0 = 0 and Z_0l = P^(ll) - P^(il);   Z_00 = Cov[x_k] - P^(ii)

It is Theorem 2 exactly where m = 0, never worse elsewhere, and does not depend on where the origin lies.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zfusion.methods.covariances import SMALLEST_VARIANCE
from zfusion.model.types import Array

TWIN = 1e-13
"""A difference of estimates whose variance is below this fraction of the own error's variance is rounding.

Two neighbours that used the same measurements have the same estimate; its difference carries no weight."""

SMALLEST_EIGENVALUE = 1e-10
"""Eigenvalues of Z, scaled to a unit diagonal, below this are zero: those differences determine each other.

The estimates of nodes that lost a few of each other's messages converge, and their differences become so small that
Z is mostly rounding: with 1e-12 that costs up to 1e-5 of Σ, with 1e-10 less than 1e-7, all that it can lose."""


def fusion_weights(own: Array, cross: Array, among: Array, prior: Array) -> tuple[Array, Array]:
    """Weights of the differences z = (z_0, z_1, ...) and the covariance of the fused error.

    Args:
        own: P^(ii), (..., nx, nx).
        cross: P^(ij) for the d neighbours j that are fused, (..., d, nx, nx).
        among: P^(jl) of those neighbours, (..., d, d, nx, nx).
        prior: Cov[x_k], (nx, nx). Where it is not finite (an unstable system, long after its start) the prior
            knows nothing and has no weight.

    Returns:
        (weights, Σ): (..., nx, (1 + d) nx), the prior's columns first, and (..., nx, nx).
    """
    *batch, d, nx, _ = cross.shape
    n = (1 + d) * nx
    c = np.zeros((*batch, nx, 1 + d, nx))
    c[..., 1:, :] = (own[..., None, :, :] - cross).swapaxes(-3, -2)
    Z = np.zeros((*batch, 1 + d, 1 + d, nx, nx))
    Z[..., 1:, 1:, :, :] = (
        own[..., None, None, :, :] - cross[..., None, :, :, :] - cross.swapaxes(-1, -2)[..., None, :, :] + among
    )
    if np.isfinite(prior).all():
        each = np.arange(d)
        Z[..., 0, 0, :, :] = prior - own
        Z[..., 0, 1:, :, :] = among[..., each, each, :, :] - cross
        Z[..., 1:, 0, :, :] = Z[..., 0, 1:, :, :].swapaxes(-1, -2)
    Z = Z.swapaxes(-3, -2).reshape(*batch, n, n)
    c = c.reshape(*batch, nx, n)
    variances = np.einsum("...aa->...a", own)
    weights: Array = c @ _pseudo_inverse(Z, np.concatenate((variances,) * (1 + d), axis=-1))
    gained = weights @ c.swapaxes(-1, -2)
    return weights, own - 0.5 * (gained + gained.swapaxes(-1, -2))


def fuse(own: Array, others: Sequence[Array], mean: Array, weights: Array) -> Array:
    """x̂^i + c Z⁺ z: own (nx,), others (nx,) each in the order of the weights, prior mean (nx,)."""
    z = np.concatenate((mean, *others)).reshape(-1, len(own)) - own
    fused: Array = own + weights @ z.reshape(-1)
    return fused


def _pseudo_inverse(Z: Array, reference: Array) -> Array:
    """Z⁺ on the unit-diagonal scaling; rows of variance below TWIN times `reference` have no part in it."""
    variance = np.einsum("...aa->...a", Z)
    alive = variance > np.maximum(TWIN * reference, SMALLEST_VARIANCE)
    scale = alive / np.sqrt(np.where(alive, variance, 1.0))
    scales = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(Z * scales)
    kept = values > SMALLEST_EIGENVALUE
    scaled: Array = vectors * (kept / np.where(kept, values, 1.0))[..., None, :]
    pseudo: Array = scaled @ vectors.swapaxes(-1, -2) * scales
    return pseudo
