"""Error covariances of many least-squares filters at once, and the cross-covariances between them.

Each tracked node l filters with the measurements of its own neighbourhood, of which it used some at each step
(its *used set*). This module carries, for the tracked pairs (l, j), the covariance P^(lj) of the errors e = x - x̂ and
what the next step needs of the innovations μ; the nodes' own filters are the pairs (l, l). Nothing here depends
on data.

Source: Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332, Theorem 1
and Lemmas 1-3, in *error form*: covariances of errors instead of second moments of estimates, so that a state
far from the origin costs no digits, and every pair kept symmetric, so that rounding does not grow.

Notation, as in the paper: C_l picks what l used; F̄, Q, Q1, W, V, B, H̄, R are those of the `StepModel` of step k;
ᶠ is the pair the other way round, (Xᶠ)^(lj) = X^(jl)ᵀ. Of step k-1, with A_l = Π^(l)⁻¹ and the gain K_l = X_l A_l,

    E^(lj) = E[e^l_{k-1/k-1} μ^jᵀ] = G^(lj) - K_l Π^(lj), zero for l = j
    w_l = W C_lᵀ A_l, T_l = C_{l,k} V C_lᵀ A_l      what μ^l_{k-1} tells about the noises w_{k-1} and C_l V_k to come

The errors and innovations of the filters follow

    e^l_{k/k-1} = F̄ e^l_{k-1/k-1} + w_{k-1} - w_l μ^l_{k-1},    n^l = C_l (V_k + H̃ x_k) - T_l μ^l_{k-1}
    μ^l_k = H_l e^l_{k/k-1} + n^l,                              e^l_{k/k} = e^l_{k/k-1} - K_l μ^l_k

and so do their second moments, each the sum of a half and of the same half the other way round: every pair is
symmetric to the last bit.

    M_w     = (F̄ E - ½ w_l Π)ᶠ + C_l Wᵀ,   M_v = (-½ T_l Π)ᶠ + C_l Vᵀ C_{j,k}ᵀ        (E and Π of step k-1)
    P⁻      = ½ F̄ P F̄ᵀ + ½ Q + F̄ Q1ᵀ - w_l M_w - F̄ K_l C_l Wᵀ  + (...)ᶠ               E[e^l_{k/k-1} e^j_{k/k-1}ᵀ]
    N^(lj)  = B C_jᵀ - w_l M_v - F̄ K_l C_l Vᵀ C_{j,k}ᵀ - (T_l M_w)ᶠ                     E[e^l_{k/k-1} n^jᵀ]
    G^(lj)  = P⁻ H_jᵀ + N,   X_l = G^(ll)                                             E[e^l_{k/k-1} μ^j_kᵀ]
    Π^(lj)  = H_l (½ P⁻ H_jᵀ + N) + ½ C_l R C_jᵀ - T_l M_v  + (...)ᶠ                   E[μ^l_k μ^j_kᵀ]
    P^(lj)  = P⁻ - (K_l (G - ½ K Π)ᶠ  + (...)ᶠ)                                       E[e^l_{k/k} e^j_{k/k}ᵀ]

With white noises w_l, T_l and N are zero. What l did not use needs no zeros in G, Π or E: whatever they are multiplied
by on that side comes from A_l, which has them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from zfusion.methods.layout import Blocks, Bools, ByClass, Layout, Used
from zfusion.model.statistics import StepModel
from zfusion.model.types import Array, NodeId

SETTLED = 1e-14
"""A covariance is settled when no entry moves by more than this in a step, relative to its standard deviations.

What remains to its limit is then about SETTLED / (1 - rate), far below any figure we report."""

SMALLEST_PIVOT = 1e-11
"""An innovation whose variance, given those before it, is below this fraction of its own is predictable.

Below it the covariance of the innovations is treated as the singular matrix that it is (`_inverse`)."""

SMALLEST_VARIANCE = 1e-290
"""A variance below this is zero: its inverse could not be represented."""


class Gains(NamedTuple):
    """What the filters need of step k to process data, a leading axis over the n nodes of one class.

    x̂_{k/k-1} = F x̂ + WA μ_{k-1};  μ_k = Z_k - H x̂_{k/k-1} - T μ_{k-1};  x̂_{k/k} = x̂_{k/k-1} + K μ_k.
    """

    F: Array
    """(nx, nx), the same for all nodes."""
    WA: Array
    """W C_lᵀ A_l, (n, nx, size)."""
    H: Array
    """H̄_k at all slots, used or not, (n, size, nx)."""
    T: Array
    """V C_{l,k-1}ᵀ A_l at all slots, (n, size, size)."""
    K: Array
    """(n, nx, size); zero in the columns of what was not used."""


class State(NamedTuple):
    """All covariances at one step; frozen, so that an older one can be kept and gone back to."""

    P: Blocks
    """P^(lj)_{k/k}, (nx, nx)."""
    E: Blocks
    """E[e^l_{k/k} μ^j_kᵀ], (nx, size)."""
    Pi: Blocks
    """Π^(lj)_k, (size, size)."""
    X: ByClass
    """E[e^l_{k/k-1} μ^l_kᵀ], (nx, size)."""
    A: ByClass
    """Inverse of Π^(ll)_k over the used slots, zero elsewhere, (size, size)."""
    K: ByClass
    """The gain X_l A_l, (nx, size)."""
    used: Used
    gains: tuple[Gains, ...] | None
    """By class; None before the first step."""
    picked: Picked | None
    """None before the first step."""
    settled: bool
    """The next step with the same model and used slots is this one again."""


def prior(layout: Layout, covariance: Array) -> State:
    """The state at step 0: nobody knows more than the prior, P^(lj) = Cov[x_0] for all pairs."""
    nx = len(covariance)
    pairs = [block.partners.shape for block in layout.blocks]
    sizes = [c.slots.shape for c in layout.classes]
    left = [sizes[block.left][1] for block in layout.blocks]
    right = [sizes[block.right][1] for block in layout.blocks]
    return State(
        P=Blocks(np.tile(covariance[:, None, :], (n, 1, r, 1)) for n, r in pairs),
        E=Blocks(np.zeros((n, nx, r, b)) for (n, r), b in zip(pairs, right, strict=True)),
        Pi=Blocks(np.zeros((n, a, r, b)) for (n, r), a, b in zip(pairs, left, right, strict=True)),
        X=tuple(np.zeros((n, nx, size)) for n, size in sizes),
        A=tuple(np.zeros((n, size, size)) for n, size in sizes),
        K=tuple(np.zeros((n, nx, size)) for n, size in sizes),
        used=tuple(np.zeros(shape, dtype=np.bool_) for shape in sizes),
        gains=None,
        picked=None,
        settled=False,
    )


def forget(layout: Layout, state: State, nodes: Collection[NodeId], covariance: Array) -> State:
    """The state in which some nodes know nothing but the prior, of covariance Cov[x_k].

    An estimate that is the prior mean has e^l = x - m, so P^(lj) = E[(x - m) e^jᵀ] = P^(jj) and
    E[e^l μ^jᵀ] = E[(x - m) μ^jᵀ] = X_j, both because e^j and μ^j are orthogonal to all that is known before.
    """
    lost = [np.array([i in nodes for i in c.members]) for c in layout.classes]
    own = layout.own(state.P)
    P_arrays, E_arrays = [], []
    for block, P_array, E_array in zip(layout.blocks, state.P.arrays, state.E.arrays, strict=True):
        one, other = lost[block.left][:, None], lost[block.right][block.partners]
        P, E = (by_pair.transpose(0, 2, 1, 3).copy() for by_pair in (P_array, E_array))
        P[one & ~other] = own[block.right][block.partners[one & ~other]]
        P[~one & other] = own[block.left][np.nonzero(~one & other)[0]]
        P[one & other] = covariance
        E[one & ~other] = state.X[block.right][block.partners[one & ~other]]
        P_arrays.append(np.ascontiguousarray(P.transpose(0, 2, 1, 3)))
        E_arrays.append(np.ascontiguousarray(E.transpose(0, 2, 1, 3)))
    X, A, K = (
        tuple(np.where(gone[:, None, None], 0.0, array) for gone, array in zip(lost, by_class, strict=True))
        for by_class in (state.X, state.A, state.K)
    )
    used = tuple(mask & ~gone[:, None] for gone, mask in zip(lost, state.used, strict=True))
    return state._replace(P=Blocks(P_arrays), E=Blocks(E_arrays), X=X, A=A, K=K, used=used, settled=False)


def advance(layout: Layout, state: State, model: StepModel, used: Used) -> State:
    """The state at step k from that at k-1, the statistics of step k, and the slots used at k.

    Returns `state` itself where it has settled and neither model nor used slots have changed: a
    time-invariant network without events costs nothing more.

    Source: module docstring.
    """
    before = state.picked
    same = before is not None and before.model is model and _equal(used, state.used)
    if same and state.settled:
        return state
    picked = Picked.of(layout, model, before)
    flip, H = layout.flip, picked.H
    P, N, TM, w, T = _predict(layout, state, picked)
    PH = flip(_rows(layout, H, P))
    if N is None or TM is None:
        G, half_Pi = PH, _rows(layout, H, 0.5 * PH)
    else:
        G, half_Pi = PH + N, _rows(layout, H, 0.5 * PH + N)
        half_Pi -= TM
    half_Pi += picked.half_R
    Pi = flip(half_Pi)
    Pi += half_Pi
    A = tuple(map(_inverse, layout.own(Pi), used))
    X = tuple([own.copy() for own in layout.own(G)])
    K = _products(X, A)
    KPi = _rows(layout, K, Pi)
    E = G - KPi
    for own in layout.own(E):
        own[...] = 0.0
    explained = _rows(layout, K, flip(G - 0.5 * KPi))
    explained += flip(explained)
    P -= explained
    settled = same and _settled(layout, state, P, Pi)
    gains = tuple([Gains(model.F, *parts) for parts in zip(w, H, T, K, strict=True)])
    return State(P, E, Pi, X, A, K, used, gains, picked, settled)


class Picked(NamedTuple):
    """The statistics of a step as a layout orders them."""

    model: StepModel
    H: ByClass
    """H̄_k at each node's slots, (size, nx)."""
    half_R: Blocks
    """½ C_l R C_jᵀ, (size, size)."""
    half_Q: Blocks
    """½ Q + F̄ Q1ᵀ for each pair of one node, (1, nx, r, nx)."""
    noise: PickedNoise | None
    """None where the noises are white."""

    @classmethod
    def of(cls, layout: Layout, model: StepModel, before: Picked | None) -> Picked:
        """Pick from `model` what has changed since the step before, and take the rest from there."""
        if before is not None:
            old = before.model
            if model is old:
                return before
            if model.H is old.H and model.W is old.W and model.V is old.V and model.B is old.B:
                half_R = before.half_R if model.R is old.R else layout.pick(0.5 * model.R)
                return before._replace(model=model, half_R=half_R, half_Q=_half_noise(layout, model))
        correlated = model.W.any() or model.V.any() or model.B.any()
        return cls(
            model=model,
            H=tuple(model.H[c.slots] for c in layout.classes),
            half_R=layout.pick(0.5 * model.R),
            half_Q=_half_noise(layout, model),
            noise=PickedNoise.of(layout, model) if correlated else None,
        )


class PickedNoise(NamedTuple):
    """What the measurements have to do with the noises to come."""

    WA: ByClass
    """W C_lᵀ, (nx, size): what has to be multiplied by A_l."""
    VA: ByClass
    """C_{l,k} V C_lᵀ, (size, size), likewise."""
    W: Blocks
    """C_l Wᵀ for each pair, (size, nx)."""
    V: Blocks
    """C_l Vᵀ C_{j,k}ᵀ, (size, size)."""
    B: Blocks
    """B C_jᵀ, (nx, size)."""

    @classmethod
    def of(cls, layout: Layout, model: StepModel) -> PickedNoise:
        """Pick from `model`."""
        slots = [c.slots for c in layout.classes]
        V = layout.pick(model.V.T)
        return cls(
            WA=tuple(model.W.T[at].transpose(0, 2, 1) for at in slots),
            VA=tuple(own.transpose(0, 2, 1) for own in layout.own(V)),
            W=Blocks(np.repeat(model.W.T[slots[b.left]][:, :, None, :], b.partners.shape[1], 2) for b in layout.blocks),
            V=V,
            B=Blocks(
                np.ascontiguousarray(model.B.T[slots[b.right][b.partners]].transpose(0, 3, 1, 2)) for b in layout.blocks
            ),
        )


def _half_noise(layout: Layout, model: StepModel) -> Blocks:
    half = 0.5 * model.Q + model.F @ model.Q1.T
    return Blocks([np.repeat(half[None, :, None, :], block.partners.shape[1], axis=2) for block in layout.blocks])


def _predict(
    layout: Layout, state: State, picked: Picked
) -> tuple[Blocks, Blocks | None, Blocks | None, ByClass, ByClass]:
    """P⁻, N, T_l M_v, w_l and T_l; None for N and T_l M_v where the noises are white."""
    F, noise, flip = picked.model.F, picked.noise, layout.flip
    nx = len(F)
    half_P = Blocks([_side_by_side(0.5 * F, array) @ F.T for array in state.P.arrays])
    half_P += picked.half_Q
    if noise is None:
        return half_P + flip(half_P), None, None, tuple(map(np.zeros_like, state.X)), tuple(map(np.zeros_like, state.A))
    w, T = _products(noise.WA, state.A), _products(noise.VA, state.A)
    U = [np.concatenate(parts, axis=1) for parts in zip(w, T, strict=True)]
    FK = [F @ K for K in state.K]
    told = _rows(layout, [-0.5 * matrix for matrix in U], state.Pi)
    FE = Blocks([_side_by_side(F, array) for array in state.E.arrays])
    M_w, M_v = flip(FE + _upper(told, nx)), flip(told, nx)
    M_w += noise.W
    M_v += noise.V
    UM_w, UM_v = _rows(layout, U, M_w), _rows(layout, U, M_v)
    half_P -= _upper(UM_w, nx)
    half_P -= _rows(layout, FK, noise.W)
    half_P += flip(half_P)
    N = noise.B - _upper(UM_v, nx)
    N -= _rows(layout, FK, noise.V)
    N -= flip(UM_w, nx)
    return half_P, N, _lower(UM_v, nx), w, T


def _upper(X: Blocks, nx: int) -> Blocks:
    """The first `nx` rows of every matrix."""
    return Blocks([array[:, :nx] for array in X.arrays])


def _lower(X: Blocks, nx: int) -> Blocks:
    """The other rows."""
    return Blocks([array[:, nx:] for array in X.arrays])


def _rows(layout: Layout, left: Sequence[Array], X: Blocks) -> Blocks:
    """left_l X^(lj) for all pairs: (n, a, b) by class, and (n, b, r, c) to (n, a, r, c)."""
    return Blocks(
        [_side_by_side(left[block.left], array) for block, array in zip(layout.blocks, X.arrays, strict=True)]
    )


def _side_by_side(left: Array, X: Array) -> Array:
    """One product for each n of (n, a, b), or the same for all (a, b), with (n, b, r, c), to (n, a, r, c)."""
    n, b, r, c = X.shape
    product: Array = left @ X.reshape(n, b, r * c)
    return product.reshape(n, -1, r, c)


def _products(one: ByClass, other: ByClass) -> ByClass:
    return tuple([a @ b for a, b in zip(one, other, strict=True)])


def _equal(one: Used, other: Used) -> bool:
    return one is other or all(map(np.array_equal, one, other))


def _inverse(Pi: Array, used: Bools) -> Array:
    """Inverses of the innovation covariances over the used slots, zero elsewhere, (n, size, size).

    Where an innovation is a linear combination of the others (noise common to several sensors and nothing
    else between them, or a noise that can be predicted), Π is singular and legally so; the projection is then given by
    the pseudo-inverse, on the unit-diagonal scaling, with eigenvalues below SMALLEST_PIVOT taken as zero.
    """
    variance = Pi.diagonal(0, 1, 2)
    counted = used & (variance > SMALLEST_VARIANCE)
    scale = counted / np.sqrt(np.where(counted, variance, 1.0))
    scales = scale[:, :, None] * scale[:, None, :]
    unit = Pi * scales
    np.einsum("nii->ni", unit)[...] = 1.0
    inverse: Array = _unit_inverse(unit) * scales
    return inverse


def _unit_inverse(unit: Array) -> Array:
    """Inverses of covariance matrices with unit diagonals, pseudo-inverses where they are singular, (n, size, size)."""
    try:
        lower = np.linalg.cholesky(unit)
        regular = lower.diagonal(0, 1, 2).min(initial=1.0) ** 2 > SMALLEST_PIVOT
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        root = np.linalg.solve(lower, np.eye(unit.shape[-1]))
        inverse: Array = root.transpose(0, 2, 1) @ root
        return inverse
    values, vectors = np.linalg.eigh(unit)
    kept = values > SMALLEST_PIVOT
    weighted: Array = vectors * (kept / np.where(kept, values, 1.0))[:, None, :]
    pseudo: Array = weighted @ vectors.transpose(0, 2, 1)
    return pseudo


def _settled(layout: Layout, before: State, P: Blocks, Pi: Blocks) -> bool:
    """Whether no covariance moved by more than SETTLED of the standard deviations that belong to it."""
    for new, old in ((P, before.P), (Pi, before.Pi)):
        first = new.arrays[0]
        if first.size and abs(first.item(0) - old.arrays[0].item(0)) > SETTLED * first.item(0):
            return False  # one entry tells most of the time
        deviations = [np.sqrt(np.maximum(own.diagonal(0, 1, 2), 0.0)) for own in layout.own(new)]
        for block, now, then in zip(layout.blocks, new.arrays, old.arrays, strict=True):
            right = SETTLED * deviations[block.right][block.partners]
            bound = deviations[block.left][:, :, None, None] * right[:, None]
            if (np.abs(now - then) > bound).any():
                return False
    return True
