"""Where a sensor's measurements come from: the model, a table, a recording, or a function of the user's.

    source = open_source(scenario, node)
    y = source.read(step, t_ns)        # (ny,), or None: no reading in this step, which is nothing unusual
    source.close()

What is wrong with a source is found when it is opened (InputError), except what only a user's function can do
(RunError).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Protocol

from zfusion.drivers.callables import CallableSource
from zfusion.drivers.tables import csv_measurements, recorded_measurements
from zfusion.errors import InputError
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.schema.run import CsvSource, McapSource, PythonSource, SimulationSource, ZenohSource
from zfusion.model.types import Array, NodeId


class Source(Protocol):
    """The measurements of one sensor."""

    counters: Counter[str]
    """Readings that were there and could not be used, by reason; each counts as no reading."""

    def read(self, step: int, t_ns: int) -> Array | None:
        """The measurement of `step`, which is due at `t_ns`, (ny,); None where there is none. RunError if it fails."""

    def truth(self, step: int) -> Array | None:
        """The true state at `step`, (nx,); None where it is not known."""

    def close(self) -> None:
        """Let go of what the source holds."""


Subscribe = Callable[[NodeId, str, int], Source]
"""(node, Zenoh key, ny) -> the source of what is published on that key: the live world's to provide."""


def open_source(scenario: Scenario, node: NodeId, subscribe: Subscribe | None = None) -> Source:
    """The source that the scenario names for sensor `node`; KeyError for an unknown sensor.

    Raises InputError, naming the sensor, for a source that cannot be: files and functions that are missing or
    wrong, or a Zenoh key where `subscribe` is not given.
    """
    return open_sources(scenario, [node], subscribe)[node]


def open_sources(
    scenario: Scenario, nodes: Iterable[NodeId], subscribe: Subscribe | None = None
) -> dict[NodeId, Source]:
    """The sources of several sensors in one process; those that are simulated share the work of simulating."""
    opener = _Opener(scenario, subscribe)
    sources: dict[NodeId, Source] = {}
    try:
        for node in nodes:
            sources[node] = opener.open(node)
    except BaseException:
        for source in sources.values():
            source.close()
        raise
    return sources


class SimulatedSource:
    """What the model draws, and the truth that goes with it."""

    def __init__(self, path: SamplePath, node: NodeId) -> None:
        self.counters: Counter[str] = Counter()
        self._path, self._node = path, node

    def read(self, step: int, t_ns: int) -> Array | None:  # noqa: ARG002
        """See `Source`; RunError where an unstable state has left the range of floating-point numbers."""
        return self._path.measurement(self._node, step)

    def truth(self, step: int) -> Array | None:
        """See `Source`."""
        return self._path.truth(step)

    def close(self) -> None:
        """See `Source`."""


class TableSource:
    """Measurements that are all there before the run begins."""

    def __init__(
        self, measurements: Mapping[int, Array], truths: Mapping[int, Array] | None = None, refused: int = 0
    ) -> None:
        """By step; `refused` entries of the table were no measurements."""
        self.counters: Counter[str] = Counter(refused=refused) if refused else Counter()
        self._measurements, self._truths = measurements, truths or {}

    def read(self, step: int, t_ns: int) -> Array | None:  # noqa: ARG002
        """See `Source`."""
        return self._measurements.get(step)

    def truth(self, step: int) -> Array | None:
        """See `Source`."""
        return self._truths.get(step)

    def close(self) -> None:
        """See `Source`."""


class _Opener:
    """Opens the sources of one scenario."""

    def __init__(self, scenario: Scenario, subscribe: Subscribe | None) -> None:
        self._scenario, self._subscribe = scenario, subscribe

    @cached_property
    def _path(self) -> SamplePath:
        return SamplePath(self._scenario.system(), self._scenario.seed)

    def open(self, node: NodeId) -> Source:
        spec = self._scenario.source_of(node)
        try:
            return self._open(spec, node)
        except InputError as error:
            raise InputError(f"source of sensor {node}: {error}") from error

    def _open(
        self, spec: SimulationSource | CsvSource | McapSource | ZenohSource | PythonSource, node: NodeId
    ) -> Source:
        system = self._scenario.system()
        ny = system.by_id[node].ny
        match spec:
            case SimulationSource():
                return SimulatedSource(self._path, node)
            case CsvSource():
                return TableSource(csv_measurements(spec, node))
            case McapSource():
                return TableSource(*recorded_measurements(spec.recording, node, ny, system.nx))
            case PythonSource():
                return CallableSource(spec.function, node, ny, spec.options)
            case ZenohSource():
                if self._subscribe is None:
                    raise InputError(f"what is published on {spec.key!r} can be had in a live run only")
                return self._subscribe(node, spec.key, ny)
