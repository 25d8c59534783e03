"""What the methods of constant gains ask of a system: that nothing varies, and that all noises are white and apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zfusion.methods.convex import DesignError
from zfusion.model.matrices import RandomMatrix, Schedule
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

SETTLED_STEP = 3
"""A step at which the covariances of a constant noise are all there; with the step before the first some are not."""


def constant(method: str, what: str, schedule: Schedule[RandomMatrix]) -> RandomMatrix:
    """The one matrix of a schedule; DesignError where it varies with time."""
    if schedule.constant_from != schedule.first:
        raise DesignError(f"the method {method} needs constant matrices; {what} varies with time")
    return schedule.items[0]


def known(method: str, what: str, schedule: Schedule[RandomMatrix]) -> Array:
    """The same; DesignError where it is random too."""
    matrix = constant(method, what, schedule)
    if matrix.is_random:
        raise DesignError(f"the method {method} needs matrices that are not random; {what} is")
    return matrix.mean


class WhiteNoises(NamedTuple):
    """Noises of which only those of one step are correlated."""

    Q: Array
    """Cov[w_k, w_k], (nx, nx)."""
    S: Array
    """Cov[w_k, v_k], (nx, ny), sensors in the order of their ids."""
    R: Array
    """Cov[v_k, v_k], (ny, ny)."""


def white_noises(method: str, system: System) -> WhiteNoises:
    """The covariances; DesignError where they vary with time, or noises of different steps are correlated."""
    if system.noise.constant_from != 0:
        raise DesignError(f"the method {method} needs noises of constant covariance; these vary with time")
    found = system.noise.covariances(SETTLED_STEP, system.ids)
    if found.Q1.any() or found.R1.any():
        raise DesignError(f"the method {method} needs white noises; these are correlated with themselves a step before")
    if found.S1.any() or found.S2.any():
        raise DesignError(
            f"the method {method} needs process noise uncorrelated with measurement noises of later steps"
        )
    return WhiteNoises(found.Q, found.S0, found.R)


def separate_noises(method: str, system: System) -> tuple[Array, dict[NodeId, Array]]:
    """Cov w, (nx, nx), and each sensor's Cov v^i, (ny_i, ny_i); DesignError where any two noises are correlated."""
    Q, S, R = white_noises(method, system)
    if S.any():
        raise DesignError(f"the method {method} needs process noise uncorrelated with the measurement noises")
    rows, _ = system.noise.rows(system.ids)
    apart = np.zeros_like(R)
    for at in rows.values():
        apart[at, at] = R[at, at]
    if not np.array_equal(apart, R):
        raise DesignError(f"the method {method} needs sensors whose noises are uncorrelated with one another")
    return Q, {i: R[at, at] for i, at in rows.items()}


def graph_matrix(network: Network) -> Array:
    """(n, n), 1 where the node of the row receives from that of the column, and on the diagonal."""
    return (network.matrix() > 0).astype(np.float64)
