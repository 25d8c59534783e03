"""One node's least-squares filter on the measurements that it used: stage 1 of the method.

Source: Caballero-Águila et al., Information Fusion 45 (2019) 324-332, Theorem 1, with a time-varying C_{i,k}:

    x̂_{k/k-1} = F̄ x̂ + W Cᵀ Π^-1_{k-1} μ_{k-1}
    μ_k       = C_k (Y_k - H̄ x̂_{k/k-1} - V Cᵀ Π^-1_{k-1} μ_{k-1})
    x̂_{k/k}   = x̂_{k/k-1} + X_k Π^-1_k μ_k

With its own measurement only it is the *local* filter, with everybody's the *centralised* one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from zfusion.methods.covariances import Bools, Layout, advance, prior
from zfusion.model.statistics import StepModel
from zfusion.model.types import Array, NodeId


class LeastSquaresFilter:
    """The filter of one node, from its prior at step `born` - 1 on."""

    def __init__(self, neighbourhood: Sequence[NodeId], sizes: Mapping[NodeId, int], mean: Array, covariance: Array):
        """Start from the prior moments of step `born` - 1, (nx,) and (nx, nx)."""
        self._neighbourhood = tuple(neighbourhood)
        self._layout = Layout.build({0: self._neighbourhood}, {j: sizes[j] for j in self._neighbourhood})
        self._state = prior(self._layout, covariance)
        self._x = mean
        self._innovation = np.zeros(self._layout.slots.shape[1])
        self._slots = self._layout.sensor[0]
        self._everything = self._layout.used({0: self._neighbourhood})

    @property
    def x(self) -> Array:
        """x̂_{k/k}, (nx,)."""
        return self._x

    @property
    def P(self) -> Array:
        """Covariance of its error, (nx, nx)."""
        covariance: Array = self._state.P[0]
        return covariance

    @property
    def settled(self) -> bool:
        """Whether the covariances need no more work while nothing changes."""
        return self._state.settled

    def step(self, model: StepModel, measurements: Mapping[NodeId, Array]) -> None:
        """Go to the next step with the measurements that arrived, each (ny_j,); an empty mapping is legal."""
        used, Z = self._gather(measurements)
        self._state = advance(self._layout, self._state, model, used)
        gains = self._state.gains
        assert gains is not None  # advance has just set them
        predicted = gains.F @ self._x + gains.WA[0] @ self._innovation
        self._innovation = Z - gains.H[0] @ predicted - gains.T[0] @ self._innovation
        self._x = predicted + gains.K[0] @ self._innovation

    def _gather(self, measurements: Mapping[NodeId, Array]) -> tuple[Bools, Array]:
        """Used slots, (1, size), and Z, (size,), zero where nothing was used."""
        if len(measurements) == len(self._neighbourhood):
            return self._everything, np.concatenate([measurements[j] for j in self._neighbourhood])
        Z = np.zeros(len(self._slots))
        for j, y in measurements.items():
            first = self._slots.index(j)
            Z[first : first + len(y)] = y
        return self._layout.used({0: measurements}), Z
