"""What the method promises before anything runs: the error covariances of all estimates when every message arrives.

Source: the modules `covariances` and `fusion`, over the whole network at once. Only pairs of nodes with a common
listener are tracked, which on a graph of degree d makes it O(m d²).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from zfusion.methods.covariances import State, advance, prior
from zfusion.methods.fusion import fusion_weights, joint_index
from zfusion.methods.layout import Ints, Layout
from zfusion.model.network import Network
from zfusion.model.statistics import StepModel, prior_moments, step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

RECYCLED_BYTES = (32 << 20) - (64 << 10)
"""Largest memory block, of those that glibc's malloc keeps when they are freed, once one of this size has been freed.

Smaller ones it would give back to the system at every step, and fetch again page by page: that takes as long as all
the arithmetic of a network of 64 nodes."""


@dataclass(frozen=True)
class Prediction:
    """Error covariances Cov[x_k - x̂_k] for k = 0..K; at k = 0 all of them are Cov[x_0]."""

    ids: tuple[NodeId, ...]
    """The nodes, sorted."""
    local: Array
    """From the node's own measurements, (K+1, m, nx, nx)."""
    intermediate: Array
    """From the measurements of its neighbourhood, (K+1, m, nx, nx)."""
    distributed: Array
    """From the intermediate estimates of its neighbourhood, (K+1, m, nx, nx)."""
    centralized: Array
    """From all measurements, (K+1, nx, nx)."""


def predict(system: System, network: Network, steps: int) -> Prediction:
    """The error covariances of steps 0..`steps` if every message arrives.

    Raises RunError where the state outgrows what can be computed with (`step_models`).
    """
    ids = network.ids
    local = Filters(system, {i: (i,) for i in ids})
    intermediate = Filters(system, network.neighbourhoods, with_common_listener(network))
    centralized = Filters(system, {ids[0]: ids})
    fusion = Fusions(network, intermediate.layout, system.nx)
    shape = (steps + 1, len(ids), system.nx, system.nx)
    prediction = Prediction(ids, np.empty(shape), np.empty(shape), np.empty(shape), np.empty((shape[0], *shape[2:])))
    moments, models = prior_moments(system), step_models(system, ids)
    for k in range(steps + 1):
        if k > 0:
            model, moments = next(models)
            for filters in (local, intermediate, centralized):
                filters.advance(model)
        prediction.local[k] = local.covariances
        prediction.intermediate[k] = intermediate.covariances
        prediction.distributed[k] = fusion.covariances(intermediate.state, moments.covariance)
        prediction.centralized[k] = centralized.covariances[0]
    return prediction


class Filters:
    """The filters of several nodes, of which each uses all measurements of its neighbourhood at every step."""

    def __init__(
        self,
        system: System,
        neighbourhoods: Mapping[NodeId, tuple[NodeId, ...]],
        pairs: Iterable[tuple[NodeId, NodeId]] = (),
    ) -> None:
        np.empty(RECYCLED_BYTES, dtype=np.uint8)  # and free it
        self.layout = Layout.build(neighbourhoods, {sensor.id: sensor.ny for sensor in system.sensors}, pairs)
        self.state = prior(self.layout, system.initial_covariance)
        self._used = self.layout.used(neighbourhoods)

    def advance(self, model: StepModel) -> None:
        """To the next step, whose statistics are those of all sensors."""
        self.state = advance(self.layout, self.state, model, self._used)

    @property
    def covariances(self) -> Array:
        """P^(ll) of all nodes, (n, nx, nx)."""
        return self.layout.in_order(self.layout.own(self.state.P))


class Fusions:
    """Stage 2 at every node, nodes of one degree together."""

    def __init__(self, network: Network, layout: Layout, nx: int) -> None:
        by_degree: dict[int, list[tuple[int, Ints]]] = defaultdict(list)
        for position, i in enumerate(layout.nodes):
            others = [j for j in network.neighbours(i) if j != i]
            by_degree[len(others)].append((position, joint_index(layout, [i, *others], nx)))
        self._shape = (len(layout.nodes), nx, nx)
        self._groups = [
            ([position for position, _ in rows], np.array([where for _, where in rows])) for rows in by_degree.values()
        ]
        self._latest: tuple[State, Array, Array] | None = None

    def covariances(self, state: State, prior_covariance: Array) -> Array:
        """Σ^i of all nodes, (n, nx, nx), given Cov[x_k]."""
        latest = self._latest
        if latest is not None and latest[0] is state and np.array_equal(latest[1], prior_covariance):
            return latest[2]
        fused = np.empty(self._shape)
        flat = state.P.flat
        for positions, where in self._groups:
            fused[positions] = fusion_weights(flat.take(where), prior_covariance)[1]
        self._latest = state, prior_covariance, fused
        return fused


def with_common_listener(network: Network) -> Iterator[tuple[NodeId, NodeId]]:
    """The pairs of nodes whose estimates somebody fuses; some of them more than once."""
    for i in network.ids:
        yield from combinations(network.neighbours(i), 2)
