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

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zfusion.model.statistics import StepModel
from zfusion.model.types import Array, NodeId, sorted_ids

SETTLED = 1e-14
"""A covariance is settled when no entry moves by more than this in a step, relative to its standard deviations.

What remains to its limit is then about SETTLED / (1 - rate), far below any figure we report."""

SMALLEST_PIVOT = 1e-11
"""An innovation whose variance, given those before it, is below this fraction of its own is predictable.

Below it the covariance of the innovations is treated as the singular matrix that it is (`_inverse`)."""

SMALLEST_VARIANCE = 1e-290
"""A variance below this is zero: its inverse could not be represented."""

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Layout:
    """Which nodes and pairs are tracked, and where each node's measurements stand in the stacked vector Y.

    A *slot* is one component of one measurement that a node may use; every node has `size` of them. The matrices of
    the r pairs (l, j) of a node l stand side by side, in arrays (n, rows, r, columns), so that one product with a
    matrix of l serves them all.
    """

    nodes: tuple[NodeId, ...]
    slots: Ints
    """Row of Y behind each slot, (n, size); 0 at padding."""
    sensor: tuple[tuple[NodeId | None, ...], ...]
    """Sensor behind each slot, (n, size); None at padding."""
    partners: Ints
    """Positions in `nodes` of the j that l makes a pair with, (n, r): l itself first, and again as padding."""
    back: Ints
    """Where l stands among the partners of each of its partners, (n, r)."""
    ny: int
    """Size of Y."""
    _place: tuple[Mapping[int, int], ...] = field(repr=False)
    _indices: dict[tuple[int, int], Ints] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def build(
        cls,
        neighbourhoods: Mapping[NodeId, Collection[NodeId]],
        sizes: Mapping[NodeId, int],
        pairs: Iterable[tuple[NodeId, NodeId]] | None = None,
    ) -> Layout:
        """Layout for the nodes of `neighbourhoods`, their used sets drawn from those neighbourhoods.

        `sizes` gives the measurement size of every sensor in the stack (sorted ids). Without `pairs` all
        pairs of the nodes are tracked; the pairs (l, l) always are.
        """
        nodes = tuple(sorted_ids(neighbourhoods))
        first: dict[NodeId, int] = {}
        ny = 0
        for s in sorted_ids(sizes):
            first[s], ny = ny, ny + sizes[s]
        rows = [[(s, first[s] + c) for s in sorted_ids(neighbourhoods[i]) for c in range(sizes[s])] for i in nodes]
        size = max((len(row) for row in rows), default=0)
        partners = _partners(nodes, pairs)
        place = tuple({q: at for at, q in reversed(list(enumerate(row)))} for row in partners.tolist())
        back = [[place[q][p] for q in row] for p, row in enumerate(partners.tolist())]
        return cls(
            nodes=nodes,
            slots=np.array([[at for _, at in row] + [0] * (size - len(row)) for row in rows], dtype=np.intp),
            sensor=tuple((*(s for s, _ in row), *([None] * (size - len(row)))) for row in rows),
            partners=partners,
            back=np.array(back, dtype=np.intp),
            ny=ny,
            _place=place,
        )

    def used(self, used: Mapping[NodeId, Collection[NodeId]]) -> Bools:
        """Which slots each node used, (n, size), from the ids whose measurements it used; absent = none."""
        empty: tuple[NodeId, ...] = ()
        rows = [[s in used.get(node, empty) for s in row] for node, row in zip(self.nodes, self.sensor, strict=True)]
        return np.array(rows, dtype=np.bool_).reshape(self.slots.shape)

    def places(self, positions: Sequence[int]) -> Ints:
        """Where each of these nodes stands among the partners of each, (c, c); KeyError where two make no pair."""
        return np.array([[self._place[p][q] for q in positions] for p in positions], dtype=np.intp)

    def flip(self, X: Array) -> Array:
        """Xᶠ: every pair the other way round, X^(jl)ᵀ in the place of (l, j); from (n, a, r, b) to (n, b, r, a)."""
        _, rows, r, columns = X.shape
        index = self._indices.get((rows, columns))
        if index is None:
            start = self.partners * (rows * r * columns) + self.back * columns
            steps = np.arange(columns)[:, None, None] + np.arange(rows) * (r * columns)
            index = self._indices[rows, columns] = start[:, None, :, None] + steps
        return X.reshape(-1).take(index)

    def pick(self, matrix: Array) -> Array:
        """Blocks of a matrix over Y, (ny, ny): the rows of l's slots, the columns of j's, (n, size, r, size)."""
        index = self._indices.get((0, 0))
        if index is None:
            columns = self.slots[self.partners]
            index = self._indices[0, 0] = self.slots[:, :, None, None] * self.ny + columns[:, None, :, :]
        return matrix.reshape(-1).take(index)


def _partners(nodes: tuple[NodeId, ...], pairs: Iterable[tuple[NodeId, NodeId]] | None) -> Ints:
    """`Layout.partners`."""
    position = {node: p for p, node in enumerate(nodes)}
    others: list[set[int]] = [set() for _ in nodes]
    if pairs is None:
        others = [set(range(len(nodes))) for _ in nodes]
    else:
        for a, b in pairs:
            others[position[a]].add(position[b])
            others[position[b]].add(position[a])
    rows = [[p, *sorted(row - {p})] for p, row in enumerate(others)]
    width = max(map(len, rows), default=0)
    return np.array([row + [p] * (width - len(row)) for p, row in enumerate(rows)], dtype=np.intp)


class Gains(NamedTuple):
    """What the filters need of step k to process data, a leading axis over the nodes.

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

    P: Array
    """P^(lj)_{k/k}, (n, nx, r, nx)."""
    E: Array
    """E[e^l_{k/k} μ^j_kᵀ], (n, nx, r, size)."""
    Pi: Array
    """Π^(lj)_k, (n, size, r, size)."""
    X: Array
    """E[e^l_{k/k-1} μ^l_kᵀ], (n, nx, size)."""
    A: Array
    """Inverse of Π^(ll)_k over the used slots, zero elsewhere, (n, size, size)."""
    used: Bools
    """(n, size)."""
    gains: Gains | None
    """None before the first step."""
    picked: Picked | None
    """None before the first step."""
    settled: bool
    """The next step with the same model and used slots is this one again."""


def prior(layout: Layout, covariance: Array) -> State:
    """The state at step 0: nobody knows more than the prior, P^(lj) = Cov[x_0] for all pairs."""
    (n, size), r, nx = layout.slots.shape, layout.partners.shape[1], len(covariance)
    return State(
        P=np.tile(covariance[:, None, :], (n, 1, r, 1)),
        E=np.zeros((n, nx, r, size)),
        Pi=np.zeros((n, size, r, size)),
        X=np.zeros((n, nx, size)),
        A=np.zeros((n, size, size)),
        used=np.zeros((n, size), dtype=np.bool_),
        gains=None,
        picked=None,
        settled=False,
    )


def forget(layout: Layout, state: State, rows: Collection[int], covariance: Array) -> State:
    """The state in which the nodes at `rows` know nothing but the prior, of covariance Cov[x_k].

    An estimate that is the prior mean has e^l = x - m, so P^(lj) = E[(x - m) e^jᵀ] = P^(jj) and
    E[e^l μ^jᵀ] = E[(x - m) μ^jᵀ] = X_j, both because e^j and μ^j are orthogonal to all that is known before.
    """
    lost = np.zeros(len(layout.nodes), dtype=np.bool_)
    lost[list(rows)] = True
    partners = layout.partners
    one, other = lost[:, None], lost[partners]
    P, E = (by_pair.transpose(0, 2, 1, 3).copy() for by_pair in (state.P, state.E))
    own = P[:, 0].copy()
    P[one & ~other] = own[partners[one & ~other]]
    P[~one & other] = own[np.nonzero(~one & other)[0]]
    P[one & other] = covariance
    E[one & ~other] = state.X[partners[one & ~other]]
    X, A, used = state.X.copy(), state.A.copy(), state.used.copy()
    X[lost], A[lost], used[lost] = 0.0, 0.0, False
    P, E = (np.ascontiguousarray(by_pair.transpose(0, 2, 1, 3)) for by_pair in (P, E))
    return state._replace(P=P, E=E, X=X, A=A, used=used, settled=False)


def advance(layout: Layout, state: State, model: StepModel, used: Bools) -> State:
    """The state at step k from that at k-1, the statistics of step k, and the slots used at k.

    Returns `state` itself where it has settled and neither model nor used slots have changed: a
    time-invariant network without events costs nothing more.

    Source: module docstring.
    """
    before = state.picked
    same = before is not None and before.model is model and (used is state.used or np.array_equal(used, state.used))
    if same and state.settled:
        return state
    picked = Picked.of(layout, model, before)
    P, N, TM, w, T = _predict(layout, state, picked)
    H, flip = picked.H, layout.flip
    PH = flip(_rows(H, P))
    half_Pi = _rows(H, 0.5 * PH + N) - TM + picked.half_R
    Pi = half_Pi + flip(half_Pi)
    A = _inverse(Pi[:, :, 0], used)
    G = PH + N
    X = G[:, :, 0].copy()
    K = X @ A
    KPi = _rows(K, Pi)
    E = G - KPi
    E[:, :, 0] = 0.0
    explained = _rows(K, flip(G - 0.5 * KPi))
    P = P - (explained + flip(explained))
    settled = same and _settled(layout, state, P, Pi)
    return State(P, E, Pi, X, A, used, Gains(model.F, w, H, T, K), picked, settled)


class Picked(NamedTuple):
    """The statistics of a step as a layout orders them."""

    model: StepModel
    H: Array
    """H̄_k at each node's slots, (n, size, nx)."""
    half_R: Array
    """½ C_l R C_jᵀ, (n, size, r, size)."""
    half_Q: Array
    """½ Q + F̄ Q1ᵀ, (nx, 1, nx)."""
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
                half_R = before.half_R if model.R is old.R else 0.5 * layout.pick(model.R)
                return before._replace(model=model, half_R=half_R, half_Q=_half_noise(model))
        correlated = model.W.any() or model.V.any() or model.B.any()
        noise = PickedNoise.of(layout, model) if correlated else None
        return cls(model, model.H[layout.slots], 0.5 * layout.pick(model.R), _half_noise(model), noise)


class PickedNoise(NamedTuple):
    """What the measurements have to do with the noises to come."""

    W: Array
    """C_l Wᵀ for each pair, (n, size, r, nx)."""
    V: Array
    """C_l Vᵀ C_{j,k}ᵀ, (n, size, r, size)."""
    B: Array
    """B C_jᵀ, (n, nx, r, size)."""

    @classmethod
    def of(cls, layout: Layout, model: StepModel) -> PickedNoise:
        """Pick from `model`."""
        slots, partners = layout.slots, layout.partners
        W = np.repeat(model.W.T[slots][:, :, None, :], partners.shape[1], axis=2)
        B = np.ascontiguousarray(model.B.T[slots[partners]].transpose(0, 3, 1, 2))
        return cls(W, layout.pick(model.V.T), B)


def _half_noise(model: StepModel) -> Array:
    half: Array = 0.5 * model.Q + model.F @ model.Q1.T
    return half[:, None, :]


def _predict(layout: Layout, state: State, picked: Picked) -> tuple[Array, Array | float, Array | float, Array, Array]:
    """P⁻, N, T_l M_v, w_l and T_l; 0.0 for N and T_l M_v where the noises are white."""
    F, noise, flip = picked.model.F, picked.noise, layout.flip
    half_P = _rows(0.5 * F, state.P) @ F.T + picked.half_Q
    if noise is None:
        return half_P + flip(half_P), 0.0, 0.0, np.zeros_like(state.X), np.zeros_like(state.A)
    w = noise.W[:, :, 0].transpose(0, 2, 1) @ state.A
    T = noise.V[:, :, 0].transpose(0, 2, 1) @ state.A
    FK = F @ (state.X @ state.A)
    told = _rows(np.concatenate((-0.5 * w, -0.5 * T), axis=1), state.Pi)
    nx = len(F)
    M_w = flip(_rows(F, state.E) + told[:, :nx]) + noise.W
    M_v = flip(told[:, nx:]) + noise.V
    half_P -= _rows(w, M_w) + _rows(FK, noise.W)
    N = noise.B - _rows(w, M_v) - _rows(FK, noise.V) - flip(_rows(T, M_w))
    return half_P + flip(half_P), N, _rows(T, M_v), w, T


def _rows(left: Array, X: Array) -> Array:
    """left_l X^(lj) for all pairs: (n, a, b), or (a, b) for all l, and (n, b, r, c) to (n, a, r, c)."""
    n, b, r, c = X.shape
    product: Array = left @ X.reshape(n, b, r * c)
    return product.reshape(n, left.shape[-2], r, c)


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


def _settled(layout: Layout, before: State, P: Array, Pi: Array) -> bool:
    """Whether no covariance moved by more than SETTLED of the standard deviations that belong to it."""
    for new, old in ((P, before.P), (Pi, before.Pi)):
        if new.size and abs(new.item(0) - old.item(0)) > SETTLED * new.item(0):
            return False  # one entry tells most of the time
        deviation = np.sqrt(np.maximum(new[:, :, 0].diagonal(0, 1, 2), 0.0))
        bound = deviation[:, :, None, None] * (SETTLED * deviation[layout.partners])[:, None]
        if (np.abs(new - old) > bound).any():
            return False
    return True
