"""Error covariances of many least-squares filters at once, and the cross-covariances between them.

Each tracked node l filters with the measurements of its own neighbourhood, of which it used some at each step
(its *used set*). This module carries, for every tracked pair (l, j), the covariance P^(lj) of the errors
e = x - x̂ and what the next step needs of the innovations μ; the nodes' own filters are the pairs (l, l).
Nothing here depends on data.

Source: Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332, Theorem 1
and Lemmas 1-3, in *error form*: covariances of errors instead of second moments of estimates, so that a state
far from the origin costs no digits, and each pair kept symmetric, so that rounding does not grow.

Notation, as in the paper, for nodes l and j at step k, with C_l the 0/1 matrix that picks what l used:

    A_l     Π^(l)^-1_{k-1}                              G^(lj)  E[e^l_{k/k-1} μ^j_kᵀ];  X^(l) = G^(ll)
    K_l     X^(l) Π^(l)^-1, the gain                    Π^(lj)  E[μ^l_k μ^j_kᵀ]
    J_l     F̄ K_l + W C_lᵀ A_l                          T_l     C_{l,k} V C_{l,k-1}ᵀ A_l
    G⁻      E[e^l_{k/k-1} μ^j_{k-1}ᵀ] = F̄ G^(lj) + W C_jᵀ - J_l Π^(lj)

With these the recursion of the error form reads

    P⁻^(lj) = F̄ P^(lj) F̄ᵀ + Q + F̄ Q1ᵀ + Q1 F̄ᵀ - F̄ K_l C_l Wᵀ - (F̄ K_j C_j Wᵀ)ᵀ
              - (G⁻^(lj) + W C_lᵀ A_l Π^(lj)) A_j C_j Wᵀ - W C_lᵀ A_l G⁻^(jl)ᵀ
    N^(lj)  = B C_jᵀ - J_l (C_j V C_lᵀ)ᵀ - G⁻^(lj) T_jᵀ
    G^(lj)  = P⁻^(lj) H_jᵀ + N^(lj)
    Π^(lj)  = H_l G^(lj) + N^(jl)ᵀ H_jᵀ + R_lj - C_l V C_jᵀ T_jᵀ - T_l (C_j V C_lᵀ)ᵀ + T_l Π^(lj)_{k-1} T_jᵀ
    P^(lj)  = P⁻^(lj) - G^(lj) K_jᵀ - K_l G^(jl)ᵀ + K_l Π^(lj) K_jᵀ

Pairs do not depend on one another except through the two nodes of each, so all are computed together on a
leading axis, measurements padded to a common size.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zfusion.model.statistics import Array, NodeId, StepModel

SETTLED = 1e-14
"""A covariance is settled when no entry moves by more than this in a step, relative to its standard deviations.

What remains to its limit is then about SETTLED / (1 - rate), far below any figure we report."""

SMALLEST_PIVOT = 1e-11
"""An innovation whose variance, given those before it, is below this fraction of its own is predictable.

Below it the covariance of the innovations is treated as the singular matrix that it is (`_inverse`)."""

Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Layout:
    """Which nodes and pairs are tracked, and where each node's measurements stand in the stacked vector Y.

    A *slot* is one component of one measurement that a node may use; every node has `size` slots, those it
    does not need are padding. The first `len(nodes)` pairs are the diagonal ones (l, l).
    """

    nodes: tuple[NodeId, ...]
    slots: Ints
    """Row of Y behind each slot, (n, size); 0 at padding."""
    sensor: tuple[tuple[NodeId | None, ...], ...]
    """Sensor behind each slot, (n, size); None at padding."""
    left: Ints
    right: Ints
    """Positions in `nodes` of l and j of each pair, l <= j, (pairs,)."""

    @classmethod
    def build(
        cls,
        neighbourhoods: Mapping[NodeId, Collection[NodeId]],
        sizes: Mapping[NodeId, int],
        pairs: Iterable[tuple[NodeId, NodeId]] | None = None,
    ) -> Layout:
        """Layout for the nodes of `neighbourhoods`, their used sets drawn from those neighbourhoods.

        `sizes` gives the measurement size of every sensor in the stack (sorted ids). Without `pairs` all
        pairs of the nodes are tracked.
        """
        nodes = tuple(sorted(neighbourhoods))
        ids = sorted(sizes)
        first = dict(zip(ids, np.cumsum([0] + [sizes[i] for i in ids[:-1]]).tolist(), strict=True))
        rows = {
            node: [(s, first[s] + c) for s in sorted(neighbourhoods[node]) for c in range(sizes[s])]
            for node in nodes
        }
        size = max((len(r) for r in rows.values()), default=0)
        position = {node: p for p, node in enumerate(nodes)}
        if pairs is None:
            off = [(a, b) for a in range(len(nodes)) for b in range(a + 1, len(nodes))]
        else:
            off = sorted(
                {(min(p), max(p)) for p in ((position[a], position[b]) for a, b in pairs) if p[0] != p[1]}
            )
        every = [(p, p) for p in range(len(nodes))] + off
        return cls(
            nodes=nodes,
            slots=np.array(
                [[row for _, row in rows[n]] + [0] * (size - len(rows[n])) for n in nodes], dtype=np.intp
            ).reshape(len(nodes), size),
            sensor=tuple(tuple(s for s, _ in rows[n]) + (None,) * (size - len(rows[n])) for n in nodes),
            left=np.array([a for a, _ in every], dtype=np.intp),
            right=np.array([b for _, b in every], dtype=np.intp),
        )

    def used(self, used: Mapping[NodeId, Collection[NodeId]]) -> Bools:
        """Which slots each node used, (n, size), from the ids whose measurements it used; absent = none."""
        empty: tuple[NodeId, ...] = ()
        return np.array(
            [
                [s in used.get(node, empty) for s in row]
                for node, row in zip(self.nodes, self.sensor, strict=True)
            ],
            dtype=np.bool_,
        ).reshape(self.slots.shape)

    def pair(self, first: int, second: int) -> tuple[int, bool]:
        """Index of a pair given by positions in `nodes`, and whether it is stored the other way round."""
        flipped = first > second
        low, high = (second, first) if flipped else (first, second)
        found = np.flatnonzero((self.left == low) & (self.right == high))
        return int(found[0]), flipped


class Gains(NamedTuple):
    """What the filters need of step k to process data, a leading axis over the nodes.

    x̂_{k/k-1} = F x̂ + WA μ_{k-1};  μ_k = Z_k - H x̂_{k/k-1} - T μ_{k-1};  x̂_{k/k} = x̂_{k/k-1} + K μ_k.
    """

    F: Array
    """(nx, nx), the same for all nodes."""
    WA: Array
    """W C_lᵀ A_l, (n, nx, size)."""
    H: Array
    """C_l H̄_k, (n, size, nx)."""
    T: Array
    """C_{l,k} V C_{l,k-1}ᵀ A_l, (n, size, size)."""
    K: Array
    """(n, nx, size)."""


class State(NamedTuple):
    """All covariances at one step; frozen, so that an older one can be kept and gone back to."""

    P: Array
    """P^(lj)_{k/k}, (pairs, nx, nx)."""
    G: Array
    """G^(lj)_k and G^(jl)_k, (2, pairs, nx, size)."""
    Pi: Array
    """Π^(lj)_k, (pairs, size, size)."""
    A: Array
    """Inverse of Π^(ll)_k over the used slots, zero elsewhere, (n, size, size)."""
    used: Bools
    """(n, size)."""
    gains: Gains | None
    """None before the first step."""
    model: StepModel | None
    settled: bool
    """The next step with the same model and used slots is this one again."""


def prior(layout: Layout, covariance: Array) -> State:
    """The state at step 0: nobody knows more than the prior, P^(lj) = Cov[x_0] for all pairs."""
    (nodes, size), pairs, nx = layout.slots.shape, len(layout.left), len(covariance)
    return State(
        P=np.broadcast_to(covariance, (pairs, nx, nx)).copy(),
        G=np.zeros((2, pairs, nx, size)),
        Pi=np.zeros((pairs, size, size)),
        A=np.zeros((nodes, size, size)),
        used=np.zeros((nodes, size), dtype=np.bool_),
        gains=None,
        model=None,
        settled=False,
    )


def forget(layout: Layout, state: State, rows: Collection[int], covariance: Array) -> State:
    """The state in which the nodes at `rows` know nothing but the prior, of covariance Cov[x_k].

    An estimate that is the prior mean has e^l = x - m, so P^(lj) = E[(x - m) e^jᵀ] = P^(jj) and
    G^(lj) = E[(x - m) μ^jᵀ] = X^(j), both because e^j and μ^j are orthogonal to all that is known before.
    """
    gone = np.zeros(len(layout.nodes), dtype=np.bool_)
    gone[list(rows)] = True
    left, right = layout.left, layout.right
    lost_left, lost_right = gone[left], gone[right]
    P, G, Pi, A, used = state.P.copy(), state.G.copy(), state.Pi.copy(), state.A.copy(), state.used.copy()
    P[lost_left] = state.P[right[lost_left]]
    P[lost_right] = state.P[left[lost_right]]
    P[lost_left & lost_right] = covariance
    G[0, lost_left] = state.G[0, right[lost_left]]
    G[1, lost_right] = state.G[0, left[lost_right]]
    G[1, lost_left] = 0.0  # nothing used: no innovation of l to be correlated with
    G[0, lost_right] = 0.0
    Pi[lost_left | lost_right] = 0.0
    A[gone] = 0.0
    used[gone] = False
    return state._replace(P=P, G=G, Pi=Pi, A=A, used=used, settled=False)


def advance(layout: Layout, state: State, model: StepModel, used: Bools) -> State:
    """The state at step k from that at k-1, the statistics of step k, and the slots used at k.

    Returns `state` itself where it has settled and neither model nor used slots have changed: a
    time-invariant network without events costs nothing more.

    Source: module docstring.
    """
    same = model is state.model and np.array_equal(used, state.used)
    if same and state.settled:
        return state
    measured = _Measured.gather(layout, model, used)
    P, N, WA, T, R = _predict(layout, state, model, measured)
    left, right = layout.left, layout.right
    H = measured.H
    PH = np.stack((P @ H[right].transpose(0, 2, 1), P.transpose(0, 2, 1) @ H[left].transpose(0, 2, 1)))
    G = PH if N is None else PH + N
    Pi = H[left] @ G[0] + R
    if N is not None:
        Pi += N[1].transpose(0, 2, 1) @ H[right].transpose(0, 2, 1)
    nodes = len(layout.nodes)
    Pi[:nodes] = _symmetric(Pi[:nodes])
    A = _inverse(Pi[:nodes], used)
    K = G[0, :nodes] @ A
    K_left, K_right_T = K[left], K[right].transpose(0, 2, 1)
    P = P - G[0] @ K_right_T - K_left @ G[1].transpose(0, 2, 1) + K_left @ Pi @ K_right_T
    P[:nodes] = _symmetric(P[:nodes])
    settled = same and _settled(layout, state, P, Pi)
    return State(P, G, Pi, A, used, Gains(model.F, WA, H, T, K), model, settled)


class _Measured(NamedTuple):
    """The statistics of Y, picked for each node's or pair's used slots."""

    H: Array
    B: Array
    R: Array
    mask: Array

    @classmethod
    def gather(cls, layout: Layout, model: StepModel, used: Bools) -> _Measured:
        mask = used.astype(np.float64)
        left, right, slots = layout.left, layout.right, layout.slots
        return cls(
            H=model.H[slots] * mask[:, :, None],
            B=model.B.T[slots] * mask[:, :, None],
            R=model.R[slots[left][:, :, None], slots[right][:, None, :]]
            * (mask[left][:, :, None] * mask[right][:, None, :]),
            mask=mask,
        )


def _predict(
    layout: Layout, state: State, model: StepModel, measured: _Measured
) -> tuple[Array, Array | None, Array, Array, Array]:
    """P⁻, N for both orders (None where all noises are white), W C_lᵀ A_l, T_l, and R less what V explains."""
    F, nodes = model.F, len(layout.nodes)
    P = F @ state.P @ F.T + model.Q
    R = measured.R
    size, nx = layout.slots.shape[1], len(F)
    if not (model.W.any() or model.V.any() or model.B.any() or model.Q1.any()):
        P[:nodes] = _symmetric(P[:nodes])
        return P, None, np.zeros((nodes, nx, size)), np.zeros((nodes, size, size)), R
    left, right = layout.left, layout.right
    FK = F @ (state.G[0, :nodes] @ state.A)
    W = model.W.T[layout.slots].transpose(0, 2, 1) * state.used[:, None, :]
    WA = W @ state.A
    J = FK + WA
    Pi_T = state.Pi.transpose(0, 2, 1)
    G_pred = np.stack(
        (
            F @ state.G[0] + W[right] - J[left] @ state.Pi,
            F @ state.G[1] + W[left] - J[right] @ Pi_T,
        )
    )
    G_pred[:, :nodes] = 0.0  # e^l_{k/k-1} is orthogonal to μ^l_{k-1}
    FKW = FK @ W.transpose(0, 2, 1)
    P += F @ model.Q1.T + model.Q1 @ F.T
    P -= FKW[left] + FKW[right].transpose(0, 2, 1)
    P -= (G_pred[0] + WA[left] @ state.Pi) @ WA[right].transpose(0, 2, 1)
    P -= WA[left] @ G_pred[1].transpose(0, 2, 1)
    P[:nodes] = _symmetric(P[:nodes])
    B = measured.B.transpose(0, 2, 1)
    N = np.stack((B[right], B[left]))
    T = np.zeros((nodes, size, size))
    if model.V.any():
        slots, now, before = layout.slots, measured.mask, state.used.astype(np.float64)
        V_jl = model.V[slots[right][:, :, None], slots[left][:, None, :]]
        V_jl = V_jl * (now[right][:, :, None] * before[left][:, None, :])
        V_lj = model.V[slots[left][:, :, None], slots[right][:, None, :]]
        V_lj = V_lj * (now[left][:, :, None] * before[right][:, None, :])
        T = V_jl[:nodes] @ state.A
        T_left, T_right_T = T[left], T[right].transpose(0, 2, 1)
        N[0] -= J[left] @ V_jl.transpose(0, 2, 1) + G_pred[0] @ T_right_T
        N[1] -= J[right] @ V_lj.transpose(0, 2, 1) + G_pred[1] @ T_left.transpose(0, 2, 1)
        R = R - T_left @ V_jl.transpose(0, 2, 1) + (T_left @ state.Pi - V_lj) @ T_right_T
    return P, N, WA, T, R


def _symmetric(M: Array) -> Array:
    """The symmetric part: what keeps a diagonal pair's recursion from drifting apart."""
    return 0.5 * (M + M.swapaxes(-1, -2))


def _inverse(Pi: Array, used: Bools) -> Array:
    """Inverses of the innovation covariances over the used slots, zero elsewhere, (n, size, size).

    Where an innovation is a linear combination of the others (noise common to several sensors and nothing
    else between them, or a noise that can be predicted), Π is singular and legally so; the projection is then given by
    the pseudo-inverse, on the unit-diagonal scaling, with eigenvalues below SMALLEST_PIVOT taken as zero.
    """
    size = Pi.shape[-1]
    if size == 0:
        return Pi.copy()
    variance = np.where(used, np.einsum("nii->ni", Pi), 1.0)
    scale = np.where(used & (variance > 0.0), 1.0 / np.sqrt(np.where(variance > 0.0, variance, 1.0)), 0.0)
    unit = Pi * scale[:, :, None] * scale[:, None, :]
    padding = np.einsum("nii->ni", unit)
    padding[scale == 0.0] = 1.0
    try:
        lower = np.linalg.cholesky(unit)
        regular = bool(np.min(np.einsum("nii->ni", lower)) ** 2 > SMALLEST_PIVOT)
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        root = np.linalg.solve(lower, np.broadcast_to(np.eye(size), unit.shape))
        inverse = root.transpose(0, 2, 1) @ root
    else:
        values, vectors = np.linalg.eigh(unit)
        keep = np.where(values > SMALLEST_PIVOT, 1.0 / np.where(values > SMALLEST_PIVOT, values, 1.0), 0.0)
        inverse = (vectors * keep[:, None, :]) @ vectors.transpose(0, 2, 1)
    result: Array = inverse * scale[:, :, None] * scale[:, None, :]
    return result


def _settled(layout: Layout, before: State, P: Array, Pi: Array) -> bool:
    """Whether no covariance moved by more than SETTLED of the standard deviations that belong to it."""
    nodes, left, right = len(layout.nodes), layout.left, layout.right
    for new, old in ((P, before.P), (Pi, before.Pi)):
        deviation = np.sqrt(np.maximum(np.einsum("nii->ni", new[:nodes]), 0.0))
        bound = SETTLED * deviation[left][:, :, None] * deviation[right][:, None, :]
        if (np.abs(new - old) > bound).any():
            return False
    return True
