"""One node's least-squares filter on the measurements that it used: stage 1 of the method.

Source: Caballero-Águila et al., Information Fusion 45 (2019) 324-332, Theorem 1, with a time-varying C_{i,k}:

    x̂_{k/k-1} = F̄ x̂ + W Cᵀ Π^-1_{k-1} μ_{k-1}
    μ_k       = C_k (Y_k - H̄ x̂_{k/k-1} - V Cᵀ Π^-1_{k-1} μ_{k-1})
    x̂_{k/k}   = x̂_{k/k-1} + X_k Π^-1_k μ_k

With its own measurement only it is the *local* filter, with everybody's the *centralised* one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from zfusion.methods.covariances import Gains, State, advance, prior
from zfusion.methods.layout import Layout
from zfusion.model.statistics import StepModel
from zfusion.model.types import Array, NodeId


class Standing(NamedTuple):
    """Where a filter stands after a step; frozen, so that it can be gone back to."""

    state: State
    step: Array | None
    """(x̂, μ)_k = step (x̂_{k-1}, μ_{k-1}, Z_k); None before the first."""
    known: Array
    """(x̂, μ), (nx + size,)."""
    nx: int

    @property
    def x(self) -> Array:
        """x̂_{k/k}, (nx,)."""
        return self.known[: self.nx]

    @property
    def P(self) -> Array:
        """Covariance of its error, (nx, nx)."""
        covariance: Array = self.state.P.arrays[0][0, :, 0]
        return covariance


class LeastSquaresFilter:
    """The filter of one node, from its prior at step `born` - 1 on."""

    def __init__(
        self, neighbourhood: Sequence[NodeId], sizes: Mapping[NodeId, int], mean: Array, covariance: Array
    ) -> None:
        """Start from the prior moments of step `born` - 1, (nx,) and (nx, nx)."""
        self._neighbourhood = tuple(neighbourhood)
        self._layout = Layout.build({0: self._neighbourhood}, {j: sizes[j] for j in self._neighbourhood})
        self._state = prior(self._layout, covariance)
        self._everything = self._layout.used({0: self._neighbourhood})
        self._nx, self._size = len(mean), self._layout.classes[0].slots.shape[1]
        self._step: Array | None = None
        """(x̂, μ)_k = step (x̂_{k-1}, μ_{k-1}, Z_k)."""
        self._known = np.concatenate((mean, np.zeros(self._size)))
        """(x̂, μ), (nx + size,)."""

    @property
    def x(self) -> Array:
        """x̂_{k/k}, (nx,)."""
        return self._known[: self._nx]

    @property
    def P(self) -> Array:
        """Covariance of its error, (nx, nx)."""
        covariance: Array = self._state.P.arrays[0][0, :, 0]
        return covariance

    @property
    def standing(self) -> Standing:
        """Where it stands: to go back to, with `return_to`."""
        return Standing(self._state, self._step, self._known, self._nx)

    def return_to(self, standing: Standing) -> None:
        """Go on from there: the next step is the one after it, and comes out as if nothing had been between."""
        self._state, self._step, self._known = standing.state, standing.step, standing.known

    @property
    def settled(self) -> bool:
        """Whether the covariances need no more work while nothing changes."""
        return self._state.settled

    def step(self, model: StepModel, measurements: Mapping[NodeId, Array]) -> None:
        """Go to the next step with the measurements that arrived, each (ny_j,); an empty mapping is legal."""
        everything = len(measurements) == len(self._neighbourhood)
        used = self._everything if everything else self._layout.used({0: measurements})
        state = advance(self._layout, self._state, model, used)
        if self._step is None or state is not self._state:
            assert state.gains is not None  # advance has set them
            self._state, self._step = state, _one_step(state.gains[0])
        values = [measurements[j] for j in self._neighbourhood] if everything else [self._scattered(measurements)]
        self._known = self._step @ np.concatenate((self._known, *values))

    def _scattered(self, measurements: Mapping[NodeId, Array]) -> Array:
        """Z, (size,), zero where nothing was used."""
        Z = np.zeros(self._size)
        for j, y in measurements.items():
            first = self._layout.classes[0].sensor[0].index(j)
            Z[first : first + len(y)] = y
        return Z


def _one_step(gains: Gains) -> Array:
    """The three equations of a step as one matrix, (nx + size, nx + 2 size)."""
    F, WA, H, T, K = gains.F, gains.WA[0], gains.H[0], gains.T[0], gains.K[0]
    predicted = np.hstack((F, WA, np.zeros_like(K)))
    innovation = -H @ predicted
    nx, size = K.shape
    innovation[:, nx : nx + size] -= T
    innovation[:, nx + size :] = np.eye(size)
    return np.vstack((predicted + K @ innovation, innovation))
