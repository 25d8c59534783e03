"""The design that the nodes of a run share, where their method is designed off-line: read, or made once a process."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from zfusion.methods import chosen
from zfusion.methods.family import Modes
from zfusion.model.scenario import Scenario

KEPT = 8
"""Designs that a process keeps: simulations of one scenario after another."""


def design_of(scenario: Scenario) -> Any:
    """The design of the scenario's method, None where there is no such thing.

    InputError where it cannot be made, or the scenario's file is none for this system, network and options.
    """
    return _designed(scenario) if chosen(scenario).family.designer is not None else None


@lru_cache(maxsize=KEPT)
def _designed(scenario: Scenario) -> Any:
    method, designer = chosen(scenario), chosen(scenario).family.designer
    assert designer is not None  # the caller has looked
    network, modes = method.network(scenario.network), modes_of(scenario)
    if scenario.method.design is not None:
        path = scenario.absolute(scenario.method.design)
        return designer.load(path, method.options, scenario.system(), network, modes)
    return designer.make(method.options, scenario.system(), network, modes)


def modes_of(scenario: Scenario) -> Modes:
    """The graphs between which the scenario's topology switches; by schedule: as if all were as likely as any."""
    topology = scenario.links.topology
    if topology is None:
        return Modes((scenario.network,), np.ones((1, 1)))
    ids = tuple(i for sensor in scenario.sensors for i in sensor.members)
    networks = tuple(graph.network(ids) for graph in topology.modes)
    count = len(networks)
    if topology.markov is None:
        return Modes(networks, np.full((count, count), 1.0 / count))
    return Modes(networks, np.array(topology.markov.transition))
