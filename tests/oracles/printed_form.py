"""The recursion as the paper prints it: Theorem 1, Lemmas 1-3 and Theorem 2, one pair of nodes at a time.

Source: Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332. The
letters are the paper's; C_i is an explicit 0/1 matrix over the stacked measurements. Every ordered pair is
computed by the printed formulas, and nothing is done about their rounding: second moments of estimates cancel
against each other, and the antisymmetric part of a pair grows exponentially unless F is well damped. So: short
horizons, moderate states.

It uses the system's own moments, not the statistics that the library's filters are fed with.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from typing import NamedTuple

import numpy as np

from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

Neighbours = Mapping[NodeId, tuple[NodeId, ...]]

RANK = 1e-12
"""Eigenvalues of [K] below this fraction of the largest are zeros (k = 0, neighbours with the same data)."""


class Preliminaries(NamedTuple):
    """What every node needs to know of step k; nx = len(F), ny = all measurements of the chosen sensors."""

    k: int
    F: Array
    """F̄_{k-1}, (nx, nx)."""
    D: Array
    """D_k = E[x_k x_kᵀ], (nx, nx)."""
    W: Array
    """W_{k-1} = E[w_{k-1} Y_{k-1}ᵀ], (nx, ny); zero for k = 1."""
    V: Array
    """V_{k,k-1} = E[V_k Y_{k-1}ᵀ], (ny, ny); zero for k = 1."""
    B: Array
    """B_k = E[x_k V_kᵀ], (nx, ny)."""
    H: Array
    """H̄_k, (ny, nx)."""
    HDH: Array
    """E[H̃_k D_k H̃_kᵀ], (ny, ny)."""
    R: Array
    """R_k, (ny, ny)."""


def preliminaries(system: System, ids: tuple[NodeId, ...]) -> Iterator[Preliminaries]:
    """The statistics of steps 1, 2, ... for the chosen sensors, in the order of `ids` (sorted)."""
    sensors = system.chosen(ids)
    nx, ny = system.nx, sum(sensor.ny for sensor in sensors)
    D = system.initial_covariance + np.outer(system.initial_mean, system.initial_mean)
    H_before = np.zeros((ny, nx))
    before, last = None, system.noise.covariances(0, ids)
    k = 1
    while True:
        noise = system.noise.covariances(k, ids)
        F = system.F.at(k - 1).mean
        D_next = F @ D @ F.T + system.F.at(k - 1).second_moment(D) + last.Q
        W, V, B = np.zeros((nx, ny)), np.zeros((ny, ny)), last.S1
        if before is not None:
            D_next = D_next + F @ last.Q1.T + last.Q1 @ F.T
            W = last.Q1 @ H_before.T + last.S0
            V = before.S2.T @ H_before.T + noise.R1
            B = F @ before.S2 + last.S1
        D = D_next
        H = np.vstack([sensor.H.at(k).mean for sensor in sensors])
        HDH, start = np.zeros((ny, ny)), 0
        for sensor in sensors:
            end = start + sensor.ny
            HDH[start:end, start:end] = sensor.H.at(k).second_moment(D)
            start = end
        yield Preliminaries(k, F, D, W, V, B, H, HDH, noise.R)
        before, last, H_before, k = last, noise, H, k + 1


class Intermediate(NamedTuple):
    """Stage 1 of one node at step k; n = its number of scalar measurements."""

    C: Array
    """C_i, (n, ny)."""
    x: Array
    """x̂_{k/k}, (nx,)."""
    P: Array
    """Σ_{k/k}, (nx, nx)."""
    Xp: Array
    """X_{k,k-1}, (nx, n)."""
    X: Array
    """X_k, (nx, n)."""
    VC: Array
    """V_{k,k-1} C_iᵀ, (ny, n)."""
    WC: Array
    """W_{k-1} C_iᵀ, (nx, n)."""
    HC: Array
    """E[H̃_k D_k H̃_kᵀ] C_iᵀ, (ny, n)."""
    VV: Array
    """𝒱_k, (ny, n)."""
    Pi_inverse: Array
    """Π_k^{-1}, (n, n)."""
    Pi_inverse_before: Array
    """Π_{k-1}^{-1}, (n, n)."""
    X_before: Array
    """X_{k-1}, (nx, n)."""
    mu: Array
    """μ_k, (n,)."""


def theorem_1(s: Preliminaries, old: Intermediate, D_old: Array, Y: Array) -> Intermediate:
    """One step of a node's intermediate filter; D_old = D_{k-1}, Y = Y_k, (ny,).

    At k = 1 the terms with Π_0 are absent: `old` then has Π_0^{-1} = 0, X_0 = 0, μ_0 = 0 and Σ_{0/0} = Σ_0,
    with which the formulas for k >= 2 are those for k = 1.
    """
    C, A = old.C, old.Pi_inverse
    WC, VC, HC = s.W @ C.T, s.V @ C.T, s.HDH @ C.T
    x_prior = s.F @ old.x + WC @ A @ old.mu
    mu = C @ (Y - s.H @ x_prior - VC @ A @ old.mu)
    Xp = s.F @ old.X + WC
    P_prior = s.D + s.F @ (old.P - D_old) @ s.F.T - Xp @ A @ WC.T - WC @ A @ old.X.T @ s.F.T
    M = s.B - Xp @ A @ VC.T
    X = (P_prior @ s.H.T + M) @ C.T
    VV = (M.T @ s.H.T + s.R - VC @ A @ VC.T) @ C.T
    Pi_inverse = np.asarray(np.linalg.inv(C @ (s.H @ X + HC + VV)), dtype=np.float64)
    x = x_prior + X @ Pi_inverse @ mu
    P = P_prior - X @ Pi_inverse @ X.T
    return Intermediate(C, x, P, Xp, X, VC, WC, HC, VV, Pi_inverse, A, old.X, mu)


class Pair(NamedTuple):
    """What Lemmas 1-3 say of the ordered pair (l, j) at step k."""

    Kp: Array
    """K^(lj)_{k/k-1}, (nx, nx)."""
    K: Array
    """K^(lj)_{k/k}, (nx, nx)."""
    Lp: Array
    """L^(lj)_{k,k-1}, (nx, n_j)."""
    L: Array
    """L^(lj)_k, (nx, n_j)."""
    Pi: Array
    """Π^(lj)_k, (n_l, n_j)."""


Pairs = Mapping[tuple[NodeId, NodeId], Pair]


def lemmas(s: Preliminaries, nodes: Mapping[NodeId, Intermediate], old: Pairs) -> dict[tuple[NodeId, NodeId], Pair]:
    """All ordered pairs (l, j) from step k-1 to k, given stage 1 of step k; the set of pairs is symmetric.

    At k = 1, Π_0^{-1} = 0 and W_0 = V_{1,0} = 0 make L^(lj)_1 = 0 and K^(lj)_{1/0} = F̄_0 x̄_0 x̄_0ᵀ F̄_0ᵀ.
    The lemmas' l is `i` here, and `one`, `two` are the nodes of the pair.
    """
    Lp = {(i, j): s.F @ pair.L + nodes[i].Xp @ nodes[i].Pi_inverse_before @ pair.Pi for (i, j), pair in old.items()}
    Kp = {(i, j): _K_predicted(s, nodes[i], nodes[j], pair, Lp[j, i]) for (i, j), pair in old.items()}
    L = {(i, j): _L(s, nodes[i], nodes[j], Kp[i, i] - Kp[i, j], Lp[i, j]) for i, j in old}
    pairs = {}
    for i, j in old:
        Pi_one_apart = _Pi_one_apart(s, nodes[i], nodes[j], Lp[j, i], old[j, i].Pi)
        Pi = _Pi(s, nodes[i], nodes[j], L[i, j], Pi_one_apart)
        K = Kp[i, j] + _K_update(nodes[i], nodes[j], L[i, j], L[j, i], Pi)
        pairs[i, j] = Pair(Kp[i, j], K, Lp[i, j], L[i, j], Pi)
    return pairs


def _K_predicted(s: Preliminaries, one: Intermediate, two: Intermediate, old: Pair, Lp_jl: Array) -> Array:
    A_l, A_j = one.Pi_inverse_before, two.Pi_inverse_before
    return s.F @ old.K @ s.F.T + s.F @ (old.L + one.X_before @ A_l @ old.Pi) @ A_j @ two.WC.T + one.WC @ A_l @ Lp_jl.T


def _L(s: Preliminaries, one: Intermediate, two: Intermediate, K_ll_less_lj: Array, Lp: Array) -> Array:
    A_l, A_j = one.Pi_inverse_before, two.Pi_inverse_before
    return (K_ll_less_lj @ s.H.T + one.Xp @ A_l @ one.VC.T - Lp @ A_j @ two.VC.T) @ two.C.T


def _Pi_one_apart(s: Preliminaries, one: Intermediate, two: Intermediate, Lp_jl: Array, Pi_jl: Array) -> Array:
    """Π^(lj)_{k-1,k}, (n_l, n_j)."""
    return (s.H @ (one.Xp - Lp_jl) + one.VC - two.VC @ two.Pi_inverse_before @ Pi_jl).T @ two.C.T


def _Pi(s: Preliminaries, one: Intermediate, two: Intermediate, L: Array, Pi_one_apart: Array) -> Array:
    correction = one.VC @ one.Pi_inverse_before @ Pi_one_apart
    return one.C @ (s.H @ (two.X - L) + two.HC + two.VV - correction)


def _K_update(one: Intermediate, two: Intermediate, L: Array, L_jl: Array, Pi: Array) -> Array:
    A_l, A_j = one.Pi_inverse, two.Pi_inverse
    return L @ A_j @ two.X.T + one.X @ A_l @ L_jl.T + one.X @ A_l @ Pi @ A_j @ two.X.T


class Fused(NamedTuple):
    """Theorem 2 at one node and step, members in sorted order."""

    gain: Array
    """A^i_k, (nx, nx * |N_i|)."""
    x: Array
    """x̂^i_{k/k}, (nx,)."""
    P: Array
    """Σ^i_{k/k}, (nx, nx)."""


def theorem_2(members: tuple[NodeId, ...], pairs: Pairs, x: Mapping[NodeId, Array], D: Array) -> Fused:
    """Fusion of the members' intermediate estimates by the second moments K of estimates."""
    K = np.block([[pairs[i, j].K for j in members] for i in members])
    K_diagonal = np.hstack([pairs[j, j].K for j in members])
    gain = K_diagonal @ np.linalg.pinv(K, rcond=RANK, hermitian=True)
    return Fused(gain, gain @ np.concatenate([x[j] for j in members]), D - gain @ K_diagonal.T)


class PrintedForm:
    """The recursion for chosen nodes, over the sensors that they use; `step` carries it from k-1 to k.

    Stage 1 is done once for every node whose intermediate estimate somebody fuses, stage 2 once for every
    ordered pair of them with a common listener.
    """

    def __init__(self, system: System, neighbours: Neighbours, nodes: Iterable[NodeId]) -> None:
        self.members = {i: tuple(sorted(neighbours[i])) for i in nodes}
        sources = sorted({j for members in self.members.values() for j in members})
        self.sensors = tuple(sorted({j for source in sources for j in neighbours[source]}))
        self._statistics = preliminaries(system, self.sensors)
        sizes = {sensor.id: sensor.ny for sensor in system.sensors}
        mean = np.asarray(system.initial_mean, dtype=float)
        self.k = 0
        self.D: Array = system.initial_covariance + np.outer(mean, mean)
        self.stage_1 = {
            j: _before_any_measurement(_selection(self.sensors, sizes, neighbours[j]), mean, system.initial_covariance)
            for j in sources
        }
        self.pairs = {
            (i, j): _before_any_estimate(mean, self.stage_1[i], self.stage_1[j])
            for i, j in sorted({pair for members in self.members.values() for pair in product(members, repeat=2)})
        }
        self.fused = self._fuse()

    def step(self, Y: Array | None = None) -> None:
        """From k-1 to k, with the measurements Y_k of `sensors`, (ny,), or for covariances and gains alone."""
        s = next(self._statistics)
        Y = np.zeros(len(s.H)) if Y is None else Y
        self.stage_1 = {j: theorem_1(s, old, self.D, Y) for j, old in self.stage_1.items()}
        self.pairs = lemmas(s, self.stage_1, self.pairs)
        self.k, self.D = s.k, s.D
        self.fused = self._fuse()

    def _fuse(self) -> dict[NodeId, Fused]:
        x = {j: node.x for j, node in self.stage_1.items()}
        return {i: theorem_2(members, self.pairs, x, self.D) for i, members in self.members.items()}


def node_recursion(system: System, neighbours: Neighbours, node: NodeId) -> PrintedForm:
    """What node i does on its own: the pairs in N_i x N_i over the sensors of its two-hop neighbourhood."""
    return PrintedForm(system, neighbours, [node])


def network_recursion(system: System, neighbours: Neighbours) -> PrintedForm:
    """All nodes at once, over all sensors; what several nodes need is computed once."""
    return PrintedForm(system, neighbours, neighbours)


def _before_any_measurement(C: Array, mean: Array, covariance: Array) -> Intermediate:
    (n, ny), nx = C.shape, len(mean)
    none = np.zeros((nx, n))
    return Intermediate(
        C=C,
        x=mean,
        P=covariance,
        Xp=none,
        X=none,
        VC=np.zeros((ny, n)),
        WC=none,
        HC=np.zeros((ny, n)),
        VV=np.zeros((ny, n)),
        Pi_inverse=np.zeros((n, n)),
        Pi_inverse_before=np.zeros((n, n)),
        X_before=none,
        mu=np.zeros(n),
    )


def _before_any_estimate(mean: Array, one: Intermediate, two: Intermediate) -> Pair:
    K, none = np.outer(mean, mean), np.zeros_like(two.X)
    return Pair(K, K, none, none, np.zeros((len(one.C), len(two.C))))


def _selection(sensors: tuple[NodeId, ...], sizes: Mapping[NodeId, int], chosen: Iterable[NodeId]) -> Array:
    """C with C Y = the chosen sensors' measurements in sorted order, (n, ny)."""
    chosen = set(chosen)
    picked = np.repeat([j in chosen for j in sensors], [sizes[j] for j in sensors])
    C: Array = np.eye(len(picked))[picked]
    return C
