"""The design that the nodes of a run share, where their method is designed off-line: read, or made once a process."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from zfusion.methods import chosen
from zfusion.methods.family import Design, Modes
from zfusion.model.scenario import Scenario

KEPT = 16
"""Designs that a process keeps: simulations of one scenario after another."""


@dataclass(frozen=True)
class _Wanted:
    """What a design is of: scenarios that differ in seeds or sources only share it."""

    facts: str
    scenario: Scenario = field(compare=False)


def design_of(scenario: Scenario) -> Any:
    """The design of the scenario's method, None where there is no such thing.

    InputError where it cannot be made, or the scenario's file is none for this system, network and options.
    """
    if chosen(scenario).family.designer is None:
        return None
    return _designed(_Wanted(_facts(scenario), scenario))


@lru_cache(maxsize=KEPT)
def _designed(wanted: _Wanted) -> Design:
    scenario = wanted.scenario
    if scenario.method.design is None:
        return make(scenario)
    method, designer = chosen(scenario), chosen(scenario).family.designer
    assert designer is not None  # the caller has looked
    network, path = method.network(scenario.network), scenario.absolute(scenario.method.design)
    return designer.load(path, method.options, scenario.system(), network, modes_of(scenario))


def make(scenario: Scenario) -> Design:
    """Design the scenario's method anew, whatever file it names. InputError where that cannot be done.

    ValueError for a method that is not designed off-line.
    """
    method, designer = chosen(scenario), chosen(scenario).family.designer
    if designer is None:
        raise ValueError(f"{method.name} is not designed off-line")
    return designer.make(method.options, scenario.system(), method.network(scenario.network), modes_of(scenario))


def with_design(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with its design in a file, for several processes: gains only mean something within one design.

    The file that it names is checked; where it names none, the design is made and written to `path`. InputError as
    `design_of`, and where it cannot be written. A method without a design has the scenario as it is.
    """
    design = design_of(scenario)
    if design is None or scenario.method.design is not None:
        return scenario
    design.save(path)
    document = tomllib.loads(scenario.anchored().to_toml())
    method = document["method"] if isinstance(document["method"], dict) else {"name": document["method"]}
    document["method"] = method | {"design": str(path.absolute())}
    return Scenario.model_validate(document)


def _facts(scenario: Scenario) -> str:
    """All that a design depends on, as text."""
    file = None if scenario.method.design is None else scenario.absolute(scenario.method.design)
    state = file.stat() if file is not None and file.exists() else None
    sensors = [s.model_dump(include={"H", "R", "noise"}, exclude_none=True) for s in scenario.sensors]
    topology = scenario.links.topology
    facts = {
        "method": scenario.method.model_dump(),
        "file": None if state is None else (str(file), state.st_mtime_ns, state.st_size),
        "system": scenario.system_spec.model_dump(),
        "sensors": [(s.members, told) for s, told in zip(scenario.sensors, sensors, strict=True)],
        "noise": scenario.noise.model_dump(),
        "network": [(i, scenario.network.neighbours(i)) for i in scenario.ids],
        "weights": sorted(scenario.network.weights.items()),
        "topology": None if topology is None else topology.model_dump(),
    }
    return json.dumps(facts)


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
