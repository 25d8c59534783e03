"""Least-squares estimates by projection on the stacked measurements, with no recursion at all.

The state and the measurements are affine functions of x_0 and of two zero-mean sequences of known covariance,

    x_{k+1} = F̄_k x_k + u_k,    u_k = w_k + F̃_k x_k          Cov[u_k, u_k] = Q_k + E[F̃_k D_k F̃_kᵀ]
    Y_k     = H̄_k x_k + t_k,    t_k = V_k + H̃_k x_k          Cov[t_k, t_k] = R_k + E[H̃_k D_k H̃_kᵀ]

where every other covariance of (u, t) is that of (w, V), because F̃ and H̃ are independent, of zero mean, and
independent of all else. So with a square root of the covariance of (x_0, u_0.., t_1..), every x_k and y^j_k is
its mean plus a *row vector times white noise z* of unit covariance: E[a bᵀ] is the product of rows, a best
affine estimate is an orthogonal projection of rows, and the error covariance comes out as a sum of squares,
without cancellation. This is a square-root method: it loses eps * cond(rows), not eps * cond(covariance).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

Used = Mapping[tuple[NodeId, int], tuple[NodeId, ...]]
"""(node, step) -> the sensors (or nodes) whose message of that step the node had; an absent key is ()."""

RANK = 1e-9
"""Singular values below this fraction of the rows' scale are a legal rank deficiency, not information: rows
carry rounding errors of some 1e-15 of that scale, so that what is kept has a direction known to 1e-6 or better."""


@dataclass(frozen=True)
class StackedSystem:
    """x_0..x_K and Y = (Y_1; ...; Y_K) as rows over white noise z, with n = len(Y)."""

    ids: tuple[NodeId, ...]
    state_mean: Array
    """E[x_k], (K+1, nx)."""
    state: Array
    """x_k - E[x_k] = state[k] z, (K+1, nx, nz)."""
    reading_mean: Array
    """E[Y], (n,)."""
    readings: Array
    """Y - E[Y] = readings z, (n, nz)."""
    where: Mapping[tuple[NodeId, int], slice]
    """(sensor, step) -> its place in Y."""

    @property
    def steps(self) -> int:
        return len(self.state) - 1

    def scale(self, k: int) -> Array:
        """Standard deviations of x_k, (nx,)."""
        deviations: Array = np.linalg.norm(self.state[k], axis=1)
        return deviations

    def vector(self, measurements: Mapping[tuple[NodeId, int], Array]) -> Array:
        """Y, (n,), from (sensor, step) -> y; what is absent stands at its mean, and should be in no used set."""
        Y = self.reading_mean.copy()
        for key, y in measurements.items():
            Y[self.where[key]] = y
        return Y


@dataclass(frozen=True)
class Estimates:
    """Affine estimates of x_0..x_K: x̂_k = E[x_k] + weights[k] (Y - E[Y])."""

    weights: Array
    """(K+1, nx, n)."""
    errors: Array
    """x_k - x̂_k as rows over z, (K+1, nx, nz)."""

    @property
    def covariance(self) -> Array:
        """Error covariances, (K+1, nx, nx)."""
        return self.cross_covariance(self)

    def cross_covariance(self, other: Estimates) -> Array:
        """E[e_k e'_kᵀ] with the other's errors, (K+1, nx, nx)."""
        return self.errors @ other.errors.swapaxes(1, 2)

    def values(self, stacked: StackedSystem, Y: Array) -> Array:
        """The estimates, (K+1, nx), of measurements Y, (n,)."""
        values: Array = stacked.state_mean + self.weights @ (Y - stacked.reading_mean)
        return values


def stack(system: System, steps: int) -> StackedSystem:
    """The system over steps 0..K as rows over white noise."""
    nx, ids = system.nx, system.ids
    sizes = [sensor.ny for sensor in system.sensors]
    ny = sum(sizes)
    size = nx * (steps + 1) + ny * steps
    u = [slice(nx * (k + 1), nx * (k + 2)) for k in range(steps)]
    t = [slice(0, 0)] + [slice(nx * (steps + 1) + ny * k, nx * (steps + 1) + ny * (k + 1)) for k in range(steps)]

    covariance = _noise_covariance(system, steps, u, t)
    covariance[:nx, :nx] = system.initial_covariance
    mean, x = np.asarray(system.initial_mean, dtype=float), np.eye(nx, size)
    means, states, reading_means, readings = [mean], [x], [], []
    for k in range(steps + 1):
        D = x @ covariance @ x.T + np.outer(mean, mean)
        if k > 0:
            H = np.vstack([sensor.H.at(k).mean for sensor in system.sensors])
            covariance[t[k], t[k]] += _block_diagonal([s.H.at(k).second_moment(D) for s in system.sensors])
            reading_means.append(H @ mean)
            readings.append(H @ x + np.eye(size)[t[k]])
        if k < steps:
            F = system.F.at(k).mean
            covariance[u[k], u[k]] += system.F.at(k).second_moment(D)
            mean, x = F @ mean, F @ x + np.eye(size)[u[k]]
            means.append(mean)
            states.append(x)

    root = _square_root(covariance)
    ends = np.cumsum([0, *sizes])
    where = {
        (i, k): slice(ny * (k - 1) + int(ends[n]), ny * (k - 1) + int(ends[n + 1]))
        for k in range(1, steps + 1)
        for n, i in enumerate(ids)
    }
    return StackedSystem(
        ids=ids,
        state_mean=np.array(means),
        state=np.array(states) @ root,
        reading_mean=np.concatenate([np.zeros(0), *reading_means]),
        readings=np.vstack([np.zeros((0, size)), *readings]) @ root,
        where=where,
    )


def intermediate(stacked: StackedSystem, node: NodeId, used: Used) -> Estimates:
    """Node's best affine estimates of x_k from { y^j_s : j in used[node, s], 1 <= s <= k }, for k = 0..K.

    The measurements are orthonormalised step by step (twice, so that rounding does not add up); what depends
    linearly on the earlier ones adds nothing. ``combine`` holds the orthonormal rows in terms of Y.
    """
    n, nz = stacked.readings.shape
    basis, combine = np.zeros((0, nz)), np.zeros((0, n))
    weights, errors = [], []
    for k in range(stacked.steps + 1):
        for j in used.get((node, k), ()) if k > 0 else ():
            place = stacked.where[j, k]
            rows, terms = stacked.readings[place], np.eye(n)[place]
            scale = np.linalg.norm(rows, axis=1, keepdims=True)
            rows, terms = rows / np.where(scale > 0, scale, 1.0), terms / np.where(scale > 0, scale, 1.0)
            for _ in range(2):
                known = rows @ basis.T
                rows, terms = rows - known @ basis, terms - known @ combine
            left, values, right = np.linalg.svd(rows, full_matrices=False)
            kept = values > RANK
            basis = np.vstack([basis, right[kept]])
            combine = np.vstack([combine, (left.T[kept] / values[kept, None]) @ terms])
        known = stacked.state[k] @ basis.T
        weights.append(known @ combine)
        errors.append(stacked.state[k] - known @ basis)
    return Estimates(np.array(weights), np.array(errors))


def fused(stacked: StackedSystem, estimates: Mapping[NodeId, Estimates], node: NodeId, heard: Used) -> Estimates:
    """Best affine combination of the estimates of `node`, of the nodes heard[node, k], and of E[x_k].

    The node's own estimate always counts, whether heard[node, k] names it or not. Differences below `RANK` of
    the state's scale (twins: the same estimate twice) get weight 0.
    """
    own = estimates[node]
    weights, errors = own.weights.copy(), own.errors.copy()
    for k in range(stacked.steps + 1):
        others = [estimates[j] for j in sorted(set(heard.get((node, k), ())) - {node})]
        prior_weights, prior_error = np.zeros_like(own.weights[k]), stacked.state[k]
        differences = np.vstack([own.errors[k] - e for e in (*(j.errors[k] for j in others), prior_error)])
        gain = _projection(own.errors[k], differences, np.tile(stacked.scale(k), len(others) + 1))
        errors[k] -= gain @ differences
        weights[k] += gain @ np.vstack([w - own.weights[k] for w in (*(j.weights[k] for j in others), prior_weights)])
    return Estimates(weights, errors)


class PrintedFusion(NamedTuple):
    """Theorem 2 as printed: x̂_k = gains[k] (x̂^j_k)_j, with the node itself among the j, in sorted order."""

    gains: tuple[Array, ...]
    """K+1 times (nx, nx * number of estimates)."""
    covariance: Array
    """E[e_k e_kᵀ], (K+1, nx, nx)."""


def fused_as_printed(
    stacked: StackedSystem, estimates: Mapping[NodeId, Estimates], node: NodeId, heard: Used
) -> PrintedFusion:
    """Best *linear* combination A (x̂^j)_j of the same estimates: A = (E[x x̂^jᵀ])_j [E[x̂^l x̂^jᵀ]]⁺.

    It is `fused` where E[x_k] = 0 and never better elsewhere. Second moments about the origin, which the
    theorem works with, are those of rows with the mean as one more column.
    """
    gains, covariances = [], []
    for k in range(stacked.steps + 1):
        members = [estimates[j] for j in sorted({node, *heard.get((node, k), ())})]
        mean = stacked.state_mean[k][:, None]
        state = np.hstack([stacked.state[k], mean])
        rows = np.vstack([np.hstack([stacked.state[k] - j.errors[k], mean]) for j in members])
        gain = _projection(state, rows, np.tile(np.linalg.norm(state, axis=1), len(members)))
        error = state - gain @ rows
        gains.append(gain)
        covariances.append(error @ error.T)
    return PrintedFusion(tuple(gains), np.array(covariances))


class ErrorCovariances(NamedTuple):
    """Error covariances for k = 0..K; nodes in sorted order."""

    local: Array
    """From the node's own measurements, (K+1, m, nx, nx)."""
    intermediate: Array
    """From the measurements of N_i, (K+1, m, nx, nx)."""
    distributed: Array
    """From the intermediate estimates of N_i and the prior mean, (K+1, m, nx, nx)."""
    centralized: Array
    """From all measurements, (K+1, nx, nx)."""


def error_covariances(system: System, neighbours: Mapping[NodeId, tuple[NodeId, ...]], steps: int) -> ErrorCovariances:
    """What the method promises when every message arrives. `neighbours` maps i to N_i (with i)."""
    stacked = stack(system, steps)
    ids = stacked.ids
    heard = always(neighbours, steps)
    alone = always({i: (i,) for i in ids}, steps)
    everything = always({ids[0]: ids}, steps)
    estimates = {i: intermediate(stacked, i, heard) for i in ids}
    return ErrorCovariances(
        local=np.stack([intermediate(stacked, i, alone).covariance for i in ids], axis=1),
        intermediate=np.stack([estimates[i].covariance for i in ids], axis=1),
        distributed=np.stack([fused(stacked, estimates, i, heard).covariance for i in ids], axis=1),
        centralized=intermediate(stacked, ids[0], everything).covariance,
    )


def always(neighbours: Mapping[NodeId, Iterable[NodeId]], steps: int) -> Used:
    """The used sets of a run in which every message arrives: N_i at every step 0..K."""
    return {(i, k): tuple(sorted(members)) for i, members in neighbours.items() for k in range(steps + 1)}


def _noise_covariance(system: System, steps: int, u: list[slice], t: list[slice]) -> Array:
    """Covariance of (x_0, w_0..w_{K-1}, V_1..V_K) with x_0's block left at zero."""
    size = t[-1].stop if steps else system.nx
    covariance = np.zeros((size, size))

    def put(rows: slice, columns: slice, block: Array) -> None:
        covariance[rows, columns] = block
        covariance[columns, rows] = block.T

    ids = system.ids
    for k in range(steps + 1):
        noise = system.noise.covariances(k, ids)
        if k < steps:
            put(u[k], u[k], noise.Q)
            put(u[k], t[k + 1], noise.S1)
        if 0 < k < steps:
            put(u[k], u[k - 1], noise.Q1)
            put(u[k], t[k], noise.S0)
        if k + 2 <= steps:
            put(u[k], t[k + 2], noise.S2)
        if k > 0:
            put(t[k], t[k], noise.R)
        if k > 1:
            put(t[k], t[k - 1], noise.R1)
    return covariance


def _square_root(covariance: Array) -> Array:
    """L with L Lᵀ = covariance, which may be singular; scaled to unit diagonal first: units do not matter."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] < -1e-10:
        raise ValueError(f"the joint covariance of the noises is indefinite: smallest eigenvalue {values[0]:.3g}")
    root: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _projection(target: Array, rows: Array, scale: Array) -> Array:
    """Gain, (len(target), len(rows)), with the least |target - gain rows|; `scale` is each row's yardstick."""
    scale = np.where(scale > 0, scale, 1.0)
    left, values, right = np.linalg.svd(rows / scale[:, None], full_matrices=False)
    kept = values > RANK
    gain: Array = ((target @ right[kept].T) / values[kept]) @ left.T[kept] / scale
    return gain


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    stacked, start = np.zeros((size, size)), 0
    for block in blocks:
        end = start + len(block)
        stacked[start:end, start:end] = block
        start = end
    return stacked
