"""The design that the nodes of a run share, where their method is designed off-line: read, or made once a process."""

from __future__ import annotations

import hashlib
import json
import tomllib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zfusion.methods import chosen
from zfusion.methods.design_files import Content, read, write
from zfusion.methods.family import Design, Modes
from zfusion.model.scenario import Scenario

KEPT = 16
"""Designs that a process keeps: simulations of one scenario after another."""


@dataclass(frozen=True)
class _Wanted:
    """What a design is of: scenarios that differ in seeds or sources only share it."""

    facts: str
    scenario: Scenario = field(compare=False)


class _Made(NamedTuple):
    design: Design
    content: bytes
    """What its file holds."""


def design_of(scenario: Scenario) -> Any:
    """The design of the scenario's method, None where there is no such thing.

    InputError where it cannot be made, or the scenario's file is none for this system, network and options.
    """
    if chosen(scenario).family.designer is None:
        return None
    return _designed(_wanted(scenario)).design


def content_of(scenario: Scenario) -> bytes | None:
    """What a file of that design holds, None where there is none: for recordings. InputError as `design_of`."""
    if chosen(scenario).family.designer is None:
        return None
    return _designed(_wanted(scenario)).content


@lru_cache(maxsize=KEPT)
def _designed(wanted: _Wanted) -> _Made:
    """From its content in every case, so that the numbers are the same to the last bit wherever it comes from."""
    scenario = wanted.scenario
    method, designer = chosen(scenario), chosen(scenario).family.designer
    assert designer is not None  # the caller has looked
    if scenario.carried_design is not None:
        content = Content("the recording's design", scenario.carried_design)
    elif scenario.method.design is not None:
        content = read(scenario.absolute(scenario.method.design))
    else:
        content = Content("the design", make(scenario).packed())
    network = method.network(scenario.network)
    design = designer.unpack(content, method.options, scenario.system(), network, modes_of(scenario))
    return _Made(design, content.data)


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
    content = content_of(scenario)
    if content is None or (scenario.method.design is not None and scenario.carried_design is None):
        return scenario
    write(path, content)
    document = tomllib.loads(scenario.anchored().to_toml())
    method = document["method"] if isinstance(document["method"], dict) else {"name": document["method"]}
    document["method"] = method | {"design": str(path.absolute())}
    return Scenario.model_validate(document)


def handed_on(old: Scenario, new: Scenario) -> Scenario:
    """`new`, made of `old`, with the design that `old` carries where that is one for both."""
    if old.carried_design is None or _purpose(old) != _purpose(new):
        return new
    return new.carrying(old.carried_design)


def _wanted(scenario: Scenario) -> _Wanted:
    return _Wanted(json.dumps(_purpose(scenario) | {"file": _origin(scenario)}), scenario)


def _origin(scenario: Scenario) -> object:
    """What tells one design for the same from another."""
    if scenario.carried_design is not None:
        return hashlib.sha256(scenario.carried_design).hexdigest()
    file = None if scenario.method.design is None else scenario.absolute(scenario.method.design)
    state = file.stat() if file is not None and file.exists() else None
    return None if state is None else (str(file), state.st_mtime_ns, state.st_size)


def _purpose(scenario: Scenario) -> dict[str, Any]:
    """All that a scenario's design depends on, as plain data."""
    sensors = [s.model_dump(include={"H", "R", "noise"}, exclude_none=True) for s in scenario.sensors]
    topology, method = scenario.links.topology, scenario.method.with_paths(lambda path: str(scenario.absolute(path)))
    return {
        "method": method.model_dump(),
        "system": scenario.system_spec.model_dump(),
        "sensors": [(s.members, told) for s, told in zip(scenario.sensors, sensors, strict=True)],
        "noise": scenario.noise.model_dump(),
        "network": [(i, scenario.network.neighbours(i)) for i in scenario.ids],
        "weights": sorted(scenario.network.weights.items()),
        "topology": None if topology is None else topology.model_dump(),
    }


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
