"""From a system and its networks to what the method is designed for; refuses what it cannot stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from zfusion.methods.constant_system import constant, graph_matrix, known, white_noises
from zfusion.methods.convex import DesignError
from zfusion.methods.l2_linf.design import METHOD
from zfusion.methods.l2_linf.problem import Problem
from zfusion.model.checks import semidefinite_factor
from zfusion.model.matrices import RandomMatrix
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array

PROPORTIONAL = 1e-9
"""How far a random part of H may be from a multiple of its mean, relative to its largest entry."""


def problem_of(
    system: System, modes: Sequence[Network], transition: ArrayLike = ((1.0,),), M: ArrayLike | None = None
) -> Problem:
    """The problem, with nodes in the order of their ids; `M` (nz, nx) is by default the identity.

    The disturbance is in units of standard deviations: w = (w_k, v_k) made white. A measurement matrix θ C with a
    scalar θ that is random, a Bernoulli above all, is a sensor that misses; only mean and variance of θ matter.

    DesignError unless all else is constant and known, noises are white, and the system is stable.
    """
    A = known(METHOD, "F", system.F)
    Q, S, R = white_noises(METHOD, system)
    root = semidefinite_factor(np.block([[Q, S], [S.T, R]]))
    rows, _ = system.noise.rows(system.ids)
    C, D, arrival = [], [], []
    for sensor in system.sensors:
        what = f"H of sensor {sensor.id!r}"
        matrix = constant(METHOD, what, sensor.H)
        chance = _arrival(what, matrix)
        C.append(matrix.mean / chance)
        D.append(root[system.nx :][rows[sensor.id]])
        arrival.append(chance)
    graphs = np.array([graph_matrix(network) for network in modes])
    output = np.eye(system.nx) if M is None else np.asarray(M, dtype=np.float64)
    chain = np.asarray(transition, dtype=np.float64)
    return Problem(A, root[: system.nx], tuple(C), tuple(D), output, np.array(arrival), graphs, chain)


def _arrival(what: str, matrix: RandomMatrix) -> float:
    """θ̄ of the Bernoulli θ for which θ C has the mean and covariance of the matrix; DesignError if there is none."""
    if not matrix.is_random:
        return 1.0
    mean, size = matrix.mean, float(np.sum(matrix.mean**2))
    if size == 0:
        raise DesignError(
            f"the method {METHOD} needs measurement matrices whose mean is not zero; {what} has such a one"
        )
    ratios: Array = np.tensordot(matrix.factors, mean, 2) / size
    rest = matrix.factors - np.multiply.outer(ratios, mean)
    if np.abs(rest).max() > PROPORTIONAL * np.abs(matrix.factors).max():
        raise DesignError(
            f"the method {METHOD} needs measurement matrices that are random by a scalar factor only; not so {what}"
        )
    return float(1 / (1 + ratios @ ratios))
