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

from zfusion.methods.consensus.mixing import Mixing, Spectrum
from zfusion.methods.gramians import lyapunov, predictor_by_doubling, sylvester
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

Complex = NDArray[np.complex128]

NO_LEAK = 1e-12
"""Signal that leaks into the disagreement, in parts of the whole, below which it is rounding."""

GRID = 40
"""Step sizes that are tried at first: what is least of them is near the best one, as the errors vary slowly."""

NARROWED = 24
"""Golden sections of the interval around it: to a hundred thousandth of its length."""


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
    S = predictor_by_doubling(A, C, W, R)
    K: Array = np.linalg.solve(C @ S @ C.T + R, C @ S).T.astype(np.float64, copy=False)
    P = (np.eye(len(A)) - K @ C) @ S
    return K, 0.5 * (P + P.T)


def alone(observed: Observed) -> Array:
    """Stationary filtered covariance of each node with its own measurements only, (N, nx, nx)."""
    return np.array([steady_filter(observed.A, observed.C, observed.Wp, Q)[1] for Q in observed.Q])


def error_covariances(observed: Observed, mixing: Mixing) -> Array:
    """Σ_i, the stationary covariance of s - ŝ_i at each node, (N, nx, nx).

    What the nodes disagree in, z = [α; ε_s; p], drives the error of each: with n = [w; v], cov n = Qn,
    z <- F z + G n and e_i <- B e_i + C_i z + G_i n. Their covariances solve
        Z = F Z Fᵀ + G Qn Gᵀ,    Y_i = F Y_i Bᵀ + F Z C_iᵀ + G Qn G_iᵀ,
        Σ_i = B Σ_i Bᵀ + C_i Z C_iᵀ + C_i Y_i Bᵀ + (C_i Y_i Bᵀ)ᵀ + G_i Qn G_iᵀ.

    ModelError where the nodes' noises differ and the process drifts so that the lag error grows without bound.
    """
    F, G, C, G_nodes, B = _system(observed, mixing)
    noise = _joined(observed.Wp, observed.Q)
    Z = lyapunov(F, G @ noise @ G.T)
    Y = sylvester(F, B, F @ Z @ C.transpose(0, 2, 1) + G @ noise @ G_nodes.transpose(0, 2, 1))
    crossed = C @ Y @ B.T
    entering = C @ Z @ C.transpose(0, 2, 1) + crossed + crossed.transpose(0, 2, 1)
    found = sylvester(B, B, entering + G_nodes @ noise @ G_nodes.transpose(0, 2, 1))
    return np.asarray(0.5 * (found + found.transpose(0, 2, 1)))


def _system(observed: Observed, mixing: Mixing) -> tuple[Array, Array, Array, Array, Array]:
    """F, G, C_i, G_i and B of `error_covariances`; with N nodes in the first axis of C and G_i."""
    A, C, nx, (N, m) = observed.A, observed.C, len(observed.A), observed.Q.shape[:2]
    size, K = N * m, observed.centralised[0]
    vectors, factors = mixing.spectrum.vectors[:, 1:], mixing.factors[1:]
    disagree: Array = np.kron((vectors * factors) @ vectors.T, np.eye(m)).astype(np.float64)  # W~, (N m, N m)
    D = _block_diagonal(observed.information)
    weighed = D @ np.tile(C, (N, 1))
    leak = disagree @ weighed
    leaks = bool(np.abs(leak).max() > NO_LEAK * np.abs(weighed).max())
    basis, moving, change = _increments(A) if leaks else (np.zeros((nx, 0)), np.zeros((0, 0)), np.zeros((0, nx)))
    r = basis.shape[1]
    lagging = size if leaks else 0
    a, s, p = slice(0, r), slice(r, r + lagging), slice(r + lagging, r + lagging + size)
    F, G = np.zeros((p.stop, p.stop)), np.zeros((p.stop, nx + size))
    F[a, a], G[a, :nx] = moving, change
    F[p, p], G[p, nx:] = disagree, disagree @ (disagree - np.eye(size)) @ D
    corrected = np.eye(nx) - K @ C
    shares = np.einsum("ab,jbc->ajc", observed.pooled, observed.information).reshape(m, size)
    gain = K @ (N * observed.pooled)  # K Mbar^-1

    def of_nodes(rows: Array) -> Array:
        """-K Mbar^-1 times each node's m rows, (N, nx, ...)."""
        return np.asarray(-gain @ rows.reshape(N, m, -1))

    C_nodes, G_nodes = np.zeros((N, nx, p.stop)), np.zeros((N, nx, nx + size))
    C_nodes[:, :, p] = of_nodes(np.eye(size))
    G_nodes[:, :, :nx] = corrected
    G_nodes[:, :, nx:] = of_nodes(disagree @ D) - K @ shares
    if leaks:
        F[s, a], F[s, s], G[s, :nx] = leak @ basis, disagree, leak
        C_nodes[:, :, a], C_nodes[:, :, s] = of_nodes(leak @ basis), of_nodes(disagree)
        G_nodes[:, :, :nx] += of_nodes(leak)
    return F, G, C_nodes, G_nodes, corrected @ A


def tuned_step(observed: Observed, spectrum: Spectrum, rounds: int) -> float:
    """The step size in (0, 2/λ_N) for which the mean of tr Σ_i over the nodes is least: a grid, then golden sections.

    ModelError as for `error_covariances`.
    """

    def cost(step: float) -> float:
        return float(np.einsum("iaa->", error_covariances(observed, Mixing(spectrum, rounds, step))))

    width = spectrum.largest_step / GRID
    tried = [cost((n + 0.5) * width) for n in range(GRID)]
    best = int(np.argmin(tried))
    low, high = max(best - 0.5, 0.0) * width, min(best + 1.5, float(GRID)) * width
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    inner = [high - golden * (high - low), low + golden * (high - low)]
    costs = [cost(step) for step in inner]
    for _ in range(NARROWED):
        if costs[0] <= costs[1]:
            high, inner[1], costs[1] = inner[1], inner[0], costs[0]
            inner[0] = high - golden * (high - low)
            costs[0] = cost(inner[0])
        else:
            low, inner[0], costs[0] = inner[0], inner[1], costs[1]
            inner[1] = low + golden * (high - low)
            costs[1] = cost(inner[1])
    return float(inner[int(costs[1] < costs[0])])


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
