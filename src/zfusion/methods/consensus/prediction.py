"""How good the estimates are that come of n exchanges a sample: error covariances, transfer functions, noise gains.

    s(t+1) = A s(t) + w(t),  cov w = Wp;      y_i(t) = C s(t) + v_i(t),  cov v_i = Q_i,  i = 1..N

Node i follows x_i(t), its share of Σ Q_j^-1 y_j(t), by adding the change of Q_i^-1 y_i and then mixing n times; mode l
of what the nodes disagree in passes through T_l(z) = a_l (z - 1) / (z - a_l). Constant Q_i, and M_i settled.

Source: the setting is that of Spanos, Olfati-Saber, Murray, IPSN 2005; for the formulas see docs/methods/consensus.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from zfusion.methods.consensus.mixing import Mixing
from zfusion.methods.gramians import lyapunov
from zfusion.methods.riccati import predictor
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

Complex = NDArray[np.complex128]

NO_LEAK = 1e-12
"""Signal that leaks into the disagreement, in parts of the whole, below which it is rounding."""


@dataclass(frozen=True, eq=False)
class Observed:
    """One quantity C s of a process, measured by all N nodes with noises of their own."""

    A: Array
    """(nx, nx)."""
    C: Array
    """(m, nx)."""
    Wp: Array
    """(nx, nx)."""
    Q: Array
    """Covariance of each node's noise, positive definite, (N, m, m)."""

    @cached_property
    def information(self) -> Array:
        """Q_i^-1, (N, m, m)."""
        return np.asarray(np.linalg.inv(self.Q), dtype=np.float64)

    @cached_property
    def pooled(self) -> Array:
        """Q_LS = (Σ Q_i^-1)^-1, (m, m): the noise of the best weighted mean of all measurements."""
        return np.asarray(np.linalg.inv(self.information.sum(axis=0)))

    @cached_property
    def centralised(self) -> tuple[Array, Array]:
        """Steady gain K, (nx, m), and filtered covariance, (nx, nx), of the Kalman filter that has all measurements."""
        return steady_filter(self.A, self.C, self.Wp, self.pooled)


def steady_filter(A: Array, C: Array, W: Array, R: Array) -> tuple[Array, Array]:
    """K = S Cᵀ (C S Cᵀ + R)^-1 and (I - K C) S, for S the stationary covariance of the prediction."""
    S = predictor(A, C, W, R)
    K: Array = np.linalg.solve(C @ S @ C.T + R, C @ S).T.astype(np.float64, copy=False)
    P = (np.eye(len(A)) - K @ C) @ S
    return K, 0.5 * (P + P.T)


def alone(observed: Observed) -> Array:
    """Stationary filtered covariance of each node with its own measurements only, (N, nx, nx)."""
    return np.array([steady_filter(observed.A, observed.C, observed.Wp, Q)[1] for Q in observed.Q])


def error_covariances(observed: Observed, mixing: Mixing) -> Array:
    """Σ_i, the stationary covariance of s - ŝ_i at each node, (N, nx, nx).

    The state [α; ε_s; p; e_i] of the disagreement and the errors is a linear system driven by w and v; its stationary
    covariance solves X = F X Fᵀ + G Qn Gᵀ.

    ModelError where the nodes' noises differ and the process drifts so that the lag error grows without bound.
    """
    A, C, Wp = observed.A, observed.C, observed.Wp
    nx, (N, m) = len(A), observed.Q.shape[:2]
    K, _ = observed.centralised
    vectors, factors = mixing.spectrum.vectors[:, 1:], mixing.factors[1:]
    disagree = np.kron((vectors * factors) @ vectors.T, np.eye(m))  # W~, (N m, N m)
    D = _block_diagonal(observed.information)
    stacked = np.tile(np.eye(m), (N, 1))
    leak = disagree @ D @ stacked @ C
    if np.abs(leak).max() <= NO_LEAK * np.abs(D @ stacked @ C).max():
        B, moving, entering = np.zeros((nx, 0)), np.zeros((0, 0)), np.zeros((0, nx))
    else:
        B, moving, entering = _increments(A)
    noise = _joined(Wp, observed.Q)
    r, size = B.shape[1], N * m
    lagging = size if r or np.abs(leak).max() > NO_LEAK else 0
    total = r + lagging + size
    F, G = np.zeros((total, total)), np.zeros((total, nx + size))
    a, s, p = slice(0, r), slice(r, r + lagging), slice(r + lagging, total)
    F[a, a], G[a, :nx] = moving, entering
    if lagging:
        F[s, a], F[s, s], G[s, :nx] = leak @ B, disagree, leak
    F[p, p], G[p, nx:] = disagree, disagree @ (disagree - np.eye(size)) @ D
    corrected = np.eye(nx) - K @ C
    inverse = np.linalg.inv(D.reshape(N, m, N, m).sum(axis=(0, 2)) / N)  # Mbar^-1 = N Q_LS
    shares = np.einsum("ab,jbc->ajc", observed.pooled, observed.information).reshape(m, size)
    covariances = []
    for i in range(N):
        rows = slice(i * m, (i + 1) * m)
        gain = K @ inverse
        Fi, Gi = np.zeros((nx, total + nx)), np.zeros((nx, nx + size))
        Fi[:, total:] = corrected @ A
        if lagging:
            Fi[:, a], Fi[:, s] = -gain @ (leak @ B)[rows], -gain @ disagree[rows]
        Fi[:, p] = -gain @ np.eye(size)[rows]
        Gi[:, :nx] = corrected - gain @ leak[rows]
        Gi[:, nx:] = -K @ shares - gain @ (disagree @ D)[rows]
        F_all = np.block([[F, np.zeros((total, nx))], [Fi]])
        G_all = np.vstack((G, Gi))
        covariances.append(lyapunov(F_all, G_all @ noise @ G_all.T)[total:, total:])
    return np.array(covariances)


def _increments(A: Array) -> tuple[Array, Array, Array]:
    """B, Bᵀ A B and Bᵀ (A - I): how (A - I) s = B α moves on."""
    change = A - np.eye(len(A))
    left, sizes, _ = np.linalg.svd(change)
    B = left[:, sizes > 1e-12 * max(1.0, sizes[0])] if sizes[0] > 0 else left[:, :0]
    moving = B.T @ A @ B
    if B.shape[1] and np.abs(np.linalg.eigvals(moving)).max() >= 1.0 - 1e-12:
        radius = float(np.abs(np.linalg.eigvals(moving)).max())
        raise ModelError(
            "system.F",
            radius,
            "the nodes' noises differ, and a process whose changes do not die out makes their estimates lag without "
            "bound: expected the eigenvalues of its changes within the unit circle",
        )
    return B, moving, B.T @ change


def _joined(Wp: Array, Q: Array) -> Array:
    rest = _block_diagonal(Q)
    nx, size = len(Wp), len(rest)
    return np.block([[Wp, np.zeros((nx, size))], [np.zeros((size, nx)), rest]])


def _block_diagonal(blocks: Array) -> Array:
    N, m = blocks.shape[:2]
    joined = np.zeros((N, m, N, m))
    joined[np.arange(N), :, np.arange(N)] = blocks
    return joined.reshape(N * m, N * m)


def mode_response(mixing: Mixing, frequency: float) -> Complex:
    """T_l(e^{jω}) = a_l (z - 1) / (z - a_l) of the modes l >= 2, (N - 1,); ω in rad a sample."""
    z, a = np.exp(1j * frequency), mixing.factors[1:]
    return np.asarray(a * (z - 1.0) / (z - a))


def transfer(observed: Observed, mixing: Mixing, frequency: float) -> Complex:
    """H(e^{jω}), from all measurements to each node's M^-1 x, (N m, N m)."""
    N, m = observed.Q.shape[:2]
    vectors = mixing.spectrum.vectors[:, 1:]
    mixed = np.full((N, N), 1.0 / N) + (vectors * mode_response(mixing, frequency)) @ vectors.T
    blocks = np.einsum("ij,ab,jbc->iajc", mixed, N * observed.pooled, observed.information)
    return np.asarray(blocks.reshape(N * m, N * m))


def noise_gains(mixing: Mixing) -> Array:
    """c_ij: how much of the white noise of sensor j's u_j is in x_i, (N, N)."""
    vectors, a = mixing.spectrum.vectors[:, 1:], mixing.factors[1:]
    N = len(vectors)
    first = np.full((N, N), 1.0 / N) + (vectors * a) @ vectors.T
    pairs = np.einsum("il,jl->ijl", vectors, vectors)
    later = np.outer(a * (a - 1.0), a * (a - 1.0)) / (1.0 - np.outer(a, a))
    return np.asarray(first**2 + np.einsum("ijl,lq,ijq->ij", pairs, later, pairs))


def mean_noise(observed: Observed, mixing: Mixing) -> Array:
    """Covariance of the noise in each node's M^-1 x, (N, m, m): Q_LS for n -> infinity."""
    N = len(observed.Q)
    inner = np.einsum("ij,jab->iab", noise_gains(mixing), observed.information)
    return np.asarray(N**2 * observed.pooled @ inner @ observed.pooled)
