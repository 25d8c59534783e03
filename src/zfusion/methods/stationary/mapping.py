"""From a system and a network to what the method is designed for; refuses what it cannot stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zfusion.methods.constant_system import graph_matrix, known, separate_noises
from zfusion.methods.stationary.design import METHOD
from zfusion.methods.stationary.polytope import Vertex, plants_of
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.model.network import Network
from zfusion.model.system import System


def problem_of(
    system: System, network: Network, *, exchange_measurements: bool = True, vertices: Sequence[Vertex] = ()
) -> Problem:
    """The problem, with nodes in the order of their ids; of a polytope, the system itself is the center.

    ModelError for vertices that do not fit. DesignError unless all matrices are constant and known, all noises white,
    constant and uncorrelated with one another, and the system, at all vertices, is stable.
    """
    A = known(METHOD, "F", system.F)
    C = tuple(known(METHOD, f"H of sensor {s.id!r}", s.H) for s in system.sensors)
    Q, R = separate_noises(METHOD, system)
    D = tuple(np.eye(s.ny) for s in system.sensors)
    plant = Plant(A, np.eye(system.nx), C, D, Q, tuple(R[i] for i in system.ids))
    graph = graph_matrix(network)
    if not vertices:
        return Problem.of(plant, graph, exchange_measurements=exchange_measurements)
    corners = plants_of(plant, system.ids, vertices, "method.options.vertices")
    return Problem.of(corners, graph, exchange_measurements=exchange_measurements, center=plant)
