"""What must agree between the pieces of a scenario: shapes, names, and one description of each noise.

Every check works on whatever pieces could be read, so that one mistake does not hide the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

from zfusion.errors import Problem
from zfusion.model.checks import ModelError, covariance_matrix
from zfusion.model.schema.base import shortest
from zfusion.model.schema.faults import Timeline, fault_problems
from zfusion.model.schema.links import LinksSpec, link_problems
from zfusion.model.schema.matrices import items_of, shape_of, shape_problems
from zfusion.model.schema.network import Graph
from zfusion.model.schema.numeric import size_of
from zfusion.model.schema.problems import NOT_GIVEN, below
from zfusion.model.schema.run import CsvSource, Source, TimingSpec, TransportSpec
from zfusion.model.schema.system import NoiseSpec, SensorSpec, SystemSpec, Taps, is_by_parts
from zfusion.model.types import NodeId, sorted_ids

MAX_PORT = 65535


@dataclass(frozen=True)
class Parts:
    """The pieces of a scenario; None for one that could not be read."""

    system: SystemSpec | None
    sensors: tuple[SensorSpec | None, ...]
    noise: NoiseSpec | None
    network: Graph | None
    source: Source | None
    transport: TransportSpec | None
    timing: TimingSpec | None
    links: LinksSpec | None
    faults: Timeline | None

    @property
    def nx(self) -> int | None:
        """Size of the state, if it is known: if F is square."""
        shape = (0, 1) if self.system is None else shape_of(items_of(self.system.F)[0])
        return shape[0] if shape[0] == shape[1] else None

    @property
    def readable_sensors(self) -> list[tuple[str, SensorSpec]]:
        """The sensors that could be read, each with its place."""
        return [(f"sensors[{n}]", sensor) for n, sensor in enumerate(self.sensors) if sensor is not None]

    @property
    def sizes(self) -> dict[NodeId, int] | None:
        """Size of each sensor's measurement in the order in which they are listed, if all of them are known."""
        if None in self.sensors:
            return None
        return {i: size_of(sensor.H) for _, sensor in self.readable_sensors for i in sensor.members}

    @property
    def by_covariance(self) -> bool:
        """Whether the correlations of noises are given by their covariances."""
        return self.noise is not None and bool(self.noise.by_covariance)


def problems_between(parts: Parts) -> Iterator[Problem]:
    """All disagreements between the pieces."""
    yield from _id_problems(parts)
    yield from _system_problems(parts)
    for place, sensor in parts.readable_sensors:
        yield from _sensor_problems(place, sensor, parts)
    yield from _white_problems(parts)
    if parts.noise is not None:
        yield from _covariance_problems(parts.noise, parts)
    sizes = parts.sizes
    if sizes is not None and _are_ids(sizes):
        if parts.network is not None:
            yield from (below("network", problem) for problem in parts.network.problems(tuple(sizes)))
        if parts.transport is not None:
            yield from _endpoint_problems(parts.transport, sorted_ids(sizes))
        yield from _network_event_problems(parts, tuple(sizes))


def _network_event_problems(parts: Parts, ids: tuple[NodeId, ...]) -> Iterator[Problem]:
    graph = parts.network
    network = graph.network(ids) if graph is not None and not any(graph.problems(ids)) else None
    if parts.links is not None:
        yield from link_problems(parts.links, ids, network)
    if parts.faults is not None and parts.timing is not None:
        yield from fault_problems(parts.faults, ids, network, parts.timing.period_ns)


def _are_ids(ids: Iterable[NodeId]) -> bool:
    return len({type(i) for i in ids}) == 1


def _id_problems(parts: Parts) -> Iterator[Problem]:
    ids = [(place, i) for place, sensor in parts.readable_sensors for i in sensor.members]
    seen = set[NodeId]()
    for place, i in ids:
        if i in seen:
            yield Problem(place, i, "expected each id once only")
        elif type(i) is not type(ids[0][1]):
            yield Problem(place, i, f"expected ids that are all numbers or all names, and {ids[0][1]!r} is first")
        seen.add(i)


def _system_problems(parts: Parts) -> Iterator[Problem]:
    system, nx = parts.system, parts.nx
    if system is None:
        return
    size = size_of(system.F)
    yield from shape_problems("system.F", system.F, (size, size))
    if nx is None:
        return
    mean = system.initial_mean
    if mean is not None and len(mean) != nx:
        yield Problem("system.initial_mean", list(mean), f"expected {nx} numbers, as F is {nx} x {nx}")
    yield from shape_problems("system.initial_covariance", system.initial_covariance, (nx, nx))
    if system.Q is not None:
        yield from shape_problems("system.Q", system.Q, (nx, nx))
    elif system.noise is None or parts.by_covariance:
        yield Problem(
            "system.Q", NOT_GIVEN, "required: the covariance of the process noise, even if it is zero, or else noise"
        )
    yield from _tap_problems("system.noise", system.noise, nx, parts)


def _sensor_problems(place: str, sensor: SensorSpec, parts: Parts) -> Iterator[Problem]:
    ny = size_of(sensor.H)
    yield from shape_problems(f"{place}.H", sensor.H, (ny, parts.nx))
    noise = parts.noise
    elsewhere = noise is not None and noise.R is not None and not is_by_parts(noise.R)
    if sensor.R is not None:
        yield from shape_problems(f"{place}.R", sensor.R, (ny, ny))
        if elsewhere:
            yield Problem(f"{place}.R", _shown(sensor.R), "expected either this or the whole noise.R, not both")
    elif not elsewhere and (sensor.noise is None or parts.by_covariance) and noise is not None:
        yield Problem(f"{place}.R", NOT_GIVEN, "required: the covariance of the measurement noise, or else noise")
    yield from _tap_problems(f"{place}.noise", sensor.noise, ny, parts)
    source = sensor.source or parts.source
    if isinstance(source, CsvSource) and len(source.columns) != ny:
        where = f"{place}.source.columns" if sensor.source else "source.columns"
        yield Problem(where, list(source.columns), f"expected {ny} columns, as {place}.H has {ny} rows")


def _tap_problems(place: str, taps: Taps | None, size: int, parts: Parts) -> Iterator[Problem]:
    if parts.noise is None:
        return
    for n, tap in enumerate(taps or ()):
        source = parts.noise.white.get(tap.source)
        if source is None:
            known = ", ".join(parts.noise.white) or "(there is none)"
            yield Problem(f"{place}[{n}].source", tap.source, f"expected a noise of noise.white: {known}")
        elif tap.matrix is not None:
            wanted = size, len(source.covariance)
            yield from shape_problems(f"{place}[{n}].matrix", tap.matrix, wanted)
        elif size != len(source.covariance):
            wanted_text = f"{size} x {len(source.covariance)}"
            yield Problem(f"{place}[{n}].matrix", NOT_GIVEN, f"required here: a {wanted_text} matrix")


def _white_problems(parts: Parts) -> Iterator[Problem]:
    """White noises that nobody uses, or that stand beside covariances."""
    noise, system = parts.noise, parts.system
    if noise is None or system is None or None in parts.sensors:
        return
    taps = [*(system.noise or ()), *chain(*(sensor.noise or () for _, sensor in parts.readable_sensors))]
    for name in sorted(noise.white.keys() - {tap.source for tap in taps}):
        yield Problem(f"noise.white.{name}", name, "expected a white noise that some noise has as a source")
    if parts.by_covariance and (taps or noise.white):
        given = ", ".join(noise.by_covariance)
        yield Problem("noise", given, "expected either covariances or white noises and their taps, not both")


def _covariance_problems(noise: NoiseSpec, parts: Parts) -> Iterator[Problem]:
    nx, sizes = parts.nx, parts.sizes
    if noise.Q1 is not None:
        yield from shape_problems("noise.Q1", noise.Q1, (nx, nx))
    if sizes is None:
        return
    total = sum(sizes.values())
    in_order = _are_ids(sizes) and list(sizes) == sorted_ids(sizes)
    for name, value in noise.by_covariance.items():
        place, rows = f"noise.{name}", total if name.startswith("R") else nx
        if name == "Q1":
            continue
        if is_by_parts(value):
            yield from _part_problems(place, value, nx, sizes)
        elif not in_order:
            expected = "expected a list of blocks, as the sensors are not listed in the order of their ids"
            yield Problem(place, _shown(value), expected)
        else:
            shapes = list(shape_problems(place, value, (rows, total)))
            yield from shapes or (_definiteness_problems(place, value) if name == "R" else ())


def _definiteness_problems(place: str, value: Any) -> Iterator[Problem]:
    for item in items_of(value):
        try:
            covariance_matrix("", item)
        except ModelError as error:
            yield below(place, error.problem)


def _part_problems(
    place: str, parts: Collection[Any], nx: int | None, sizes: Mapping[NodeId, int]
) -> Iterator[Problem]:
    """Blocks that are there twice, or of sensors that do not exist, or of the wrong shape."""
    is_symmetric, seen = place == "noise.R", Counter[Any]()
    for n, part in enumerate(parts):
        here = f"{place}[{n}]"
        ids = part.sensors if hasattr(part, "sensors") else (part.sensor,)
        key = frozenset(ids) if is_symmetric else ids
        seen[key] += 1
        unknown = [i for i in ids if i not in sizes]
        if unknown:
            yield Problem(here, unknown[0], "expected the id of a sensor")
        elif is_symmetric and len(key) == 1:
            yield Problem(here, list(ids), "expected two sensors; a sensor's own covariance is its R")
        elif seen[key] > 1:
            yield Problem(here, list(ids), "expected each block once only")
        else:
            rows = sizes[ids[0]] if len(ids) == 2 else nx
            yield from shape_problems(f"{here}.value", part.value, (rows, sizes[ids[-1]]))


def _endpoint_problems(transport: TransportSpec, ids: list[NodeId]) -> Iterator[Problem]:
    users: dict[str, NodeId] = {}
    for i, endpoint in transport.endpoints.items():
        if i not in ids:
            yield Problem(f"transport.endpoints.{i}", endpoint, "expected the id of a sensor")
        elif endpoint in users:
            expected = f"expected an endpoint of its own, this is node {users[endpoint]}'s"
            yield Problem(f"transport.endpoints.{i}", endpoint, expected)
        users[endpoint] = i
    if len(transport.endpoints) < len(ids) and transport.base_port + len(ids) - 1 > MAX_PORT:
        expected = f"expected at most {MAX_PORT + 1 - len(ids)}, as each of {len(ids)} nodes has a port of its own"
        yield Problem("transport.base_port", transport.base_port, expected)


def _shown(value: Any) -> object:
    items = items_of(value)
    return shortest(items[0]) if len(items) == 1 else [shortest(item) for item in items]
