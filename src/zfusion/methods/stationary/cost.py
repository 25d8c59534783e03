"""The true cost of a network of estimators, its gradients, and what does not depend on coordinates.

η = [x; ξ],   A_e = [A 0; G C F],   B_e = [B W^½ 0; 0 G D V^½],   C_e = [E -H],   error e = C_e η
P = A_e P A_eᵀ + B_e B_eᵀ,   J = tr C_e P C_eᵀ = Σ_i E |e_i|²;     Q = A_eᵀ Q A_e + C_eᵀ C_e,   J = tr B_eᵀ Q B_e
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zfusion.methods.convex import DesignError
from zfusion.methods.gramians import lyapunov, spectral_radius
from zfusion.methods.stationary.problem import Plant, Problem, block_diagonal
from zfusion.model.types import Array

CUTOFF = 1e-11
"""Directions of the ξ with less than this part of the largest variance tell nothing (`best_output`)."""

FLOOR = 1e-12
"""Directions of a ξ_i with less than this part of its largest variance are scaled as if they had it (`rescaled`)."""


class Gains(NamedTuple):
    """The estimators, as whole matrices with exact zeros where a node must not know anything."""

    F: Array
    """(N, N)."""
    G: Array
    """(N, p)."""
    H: Array
    """(N, N)."""


@dataclass(frozen=True, eq=False)
class Cost:
    """What the estimators really do in stationary operation."""

    J: float
    """Σ_i weights_i E |e_i|²."""
    mse: Array
    """E |e_i|² of each node, (n,)."""
    covariances: Array
    """Cov[e_i], (n, nx, nx)."""
    P: Array
    """Cov[η], (nx + N, nx + N)."""
    radius: float
    """Spectral radius of A_e."""


def extended(plant: Plant, F: Array, G: Array) -> tuple[Array, Array]:
    """A_e, (nx + N, nx + N), and B_e."""
    A_e = np.block([[plant.A, np.zeros((plant.nx, len(F)))], [G @ plant.stacked_C, F]])
    return A_e, block_diagonal([plant.process_root, G @ plant.sensor_root])


def output(problem: Problem, H: Array) -> Array:
    """C_e = [E -H], each node's rows times the root of its weight, (N, nx + N)."""
    weighted: Array = np.hstack((problem.E, -H)) * row_weights(problem)[:, None]
    return weighted


def row_weights(problem: Problem) -> Array:
    """The roots of the nodes' weights by rows, (N,)."""
    return np.repeat(np.sqrt(problem.weights), problem.nominal.nx)


def evaluate(problem: Problem, gains: Gains, plant: Plant | None = None) -> Cost:
    """The true cost of the estimators on a plant, by default the nominal one; DesignError if they are unstable."""
    plant = problem.nominal if plant is None else plant
    A_e, B_e = extended(plant, gains.F, gains.G)
    radius = spectral_radius(A_e)
    if not radius < 1:
        raise DesignError(f"numerical trouble: the estimators are not stable (spectral radius {radius:.6g})")
    P = lyapunov(A_e, B_e @ B_e.T)
    C = np.hstack((problem.E, -gains.H))
    errors = C @ P @ C.T
    n, nx = plant.n, plant.nx
    covariances = np.array([errors[i * nx : (i + 1) * nx, i * nx : (i + 1) * nx] for i in range(n)])
    mse = np.trace(covariances, axis1=1, axis2=2)
    return Cost(float(problem.weights @ mse), mse, covariances, P, radius)


def best_output(problem: Problem, P: Array) -> Array:
    """The H that is best for given ξ: row i is P_{x,N_i} P_{N_i,N_i}⁺, zero elsewhere, (N, N)."""
    nx, n = problem.nominal.nx, problem.nominal.n
    H = np.zeros((problem.size, problem.size))
    for i in range(n):
        known = np.flatnonzero(problem.blocks.H[i * nx])
        at = nx + known
        H[i * nx : (i + 1) * nx, known] = regression(P[:nx][:, at], P[np.ix_(at, at)])
    return H


def regression(cross: Array, covariance: Array) -> Array:
    """cross covariance⁺, the linear least-squares estimate, for a covariance that may be singular in any units."""
    scale = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    scale[scale == 0] = 1.0
    unit = covariance / np.multiply.outer(scale, scale)
    weights: Array = (cross / scale) @ np.linalg.pinv(unit, rcond=CUTOFF, hermitian=True) / scale
    return weights


def gradients(problem: Problem, plant: Plant, gains: Gains, P: Array) -> tuple[float, Gains]:
    """J and its derivatives by the entries of F, G and H, P being the covariance of η; zero where nothing is free.

    dJ/dF = [2 Q A_e P]_22,  dJ/dG = [2 Q A_e P]_21 Cᵀ + [2 Q B_e]_{2,v} (D V^½)ᵀ,  dJ/dH = -2 [weights C_e P]_2
    """
    nx = plant.nx
    A_e, B_e = extended(plant, gains.F, gains.G)
    C_e = output(problem, gains.H)
    Q = lyapunov(A_e.T, C_e.T @ C_e)
    slope = 2 * Q @ A_e @ P
    CP = C_e @ P
    J = float(np.sum(CP * C_e))
    by_noise = (2 * Q @ B_e)[nx:, plant.process_root.shape[1] :]
    dG = slope[nx:, :nx] @ plant.stacked_C.T + by_noise @ plant.sensor_root.T
    dH = -2 * row_weights(problem)[:, None] * CP[:, nx:]
    free = problem.blocks
    return J, Gains(slope[nx:, nx:] * free.F, dG * free.G, dH * free.H)


def rescaled(problem: Problem, gains: Gains, P: Array) -> Gains:
    """The same estimators in coordinates in which every ξ_i has the covariance I: ξ_i -> Cov[ξ_i]^-½ ξ_i."""
    nx, n = problem.nominal.nx, problem.nominal.n
    scale, back = [], []
    for i in range(1, n + 1):
        at = slice(i * nx, (i + 1) * nx)
        values, vectors = np.linalg.eigh(P[at, at])
        roots = np.sqrt(np.maximum(values, FLOOR * max(values[-1], np.finfo(float).tiny)))
        scale.append(vectors / roots @ vectors.T)
        back.append(vectors * roots @ vectors.T)
    T, inverse = block_diagonal(scale), block_diagonal(back)
    return masked(problem, Gains(T @ gains.F @ inverse, T @ gains.G, gains.H @ inverse))


def masked(problem: Problem, gains: Gains) -> Gains:
    """With exact zeros wherever nothing may be."""
    free = problem.blocks
    return Gains(np.where(free.F, gains.F, 0.0), np.where(free.G, gains.G, 0.0), np.where(free.H, gains.H, 0.0))
