"""One specification says it all: what is observed, by whom, who talks to whom, how it is estimated and run.

    scenario = load_scenario("examples/four_sensor.toml", steps=500)
    scenario.system()                # what the numerics work with
    scenario.network.neighbours(1)   # whose messages node 1 receives

The same is built by hand from the pieces in `schema`, and written back as TOML. A `Scenario` that exists is complete
and consistent: everything is checked when it is made, and all that is wrong is said at once.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self, TypedDict, TypeVar, Unpack

import tomli_w
from pydantic import Field, PrivateAttr, TypeAdapter, ValidationInfo, model_validator

from zfusion.errors import Problem, ScenarioError
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.schema.base import Count, Name, Natural, Reading, Spec
from zfusion.model.schema.consistency import Parts, problems_between
from zfusion.model.schema.faults import LinksFile, Timeline
from zfusion.model.schema.links import LinksSpec
from zfusion.model.schema.network import AnyGraph
from zfusion.model.schema.numeric import numeric_system
from zfusion.model.schema.problems import Located, without
from zfusion.model.schema.run import (
    AnyMethod,
    MethodSpec,
    RecordingSpec,
    SimulationSource,
    Source,
    TimingSpec,
    TransportSpec,
)
from zfusion.model.schema.system import NoiseSpec, SensorSpec, SystemSpec
from zfusion.model.system import System
from zfusion.model.types import NodeId, sorted_ids

T = TypeVar("T")

FINGERPRINT_VERSION = 2
"""Of what a fingerprint is made of; scenarios of different versions never look alike."""

ITEMS_ON_LINES = re.compile(r'\[\n((?:\s*(?:"(?:[^"\\\n]|\\.)*"|[^\[\]{}"\n]+),\n)+)\s*\]')
"""An array of numbers and texts as tomli_w writes it, each on a line of its own."""

ROW_ON_LINE = re.compile(r'\[\n\s*(\[[^\[\]{}"\n]*\]),\n\s*\]')
"""A matrix of one row, the row on a line of its own."""


class Overrides(TypedDict, total=False):
    """What a command may set in the place of what the scenario says; None changes nothing.

    A rate ends free running and the other way round; another method does not inherit the options of the first. What a
    file of links and faults holds of the two stands in the place of the scenario's; `loss` and `delay`, in seconds, are
    the `[links]`' own.
    """

    steps: int | None
    seed: int | None
    rate_hz: float | None
    free_run: bool | None
    method: str | None
    links: str | Path | None
    loss: float | None
    delay: float | None
    zenoh_config: str | Path | None


class Scenario(Spec):
    """A complete scenario. Its keys in a file are its fields here, without the `_spec`."""

    name: Name = "scenario"
    description: str = ""
    seed: Natural = 0
    steps: Count = 100
    method: AnyMethod = MethodSpec()
    timing: TimingSpec = TimingSpec()
    network_spec: AnyGraph = Field(alias="network")
    system_spec: SystemSpec = Field(alias="system")
    sensors: Annotated[tuple[SensorSpec, ...], Field(min_length=1)]
    noise: NoiseSpec = NoiseSpec()
    source: Source = SimulationSource()
    transport: TransportSpec = TransportSpec()
    recording: RecordingSpec = RecordingSpec()
    links: LinksSpec = LinksSpec()
    faults: Timeline = ()

    _directory: Path = PrivateAttr(default_factory=Path.cwd)
    _origin: str = PrivateAttr(default="scenario")
    _design: bytes | None = PrivateAttr(default=None)

    @classmethod
    def from_toml(cls, text: str, source: str = "scenario", directory: Path | None = None) -> Self:
        """The scenario that `text` is; paths in it are relative to `directory`, by default the current one.

        Raises ScenarioError, which names `source`, with everything that is wrong.
        """
        return cls._from_document(_parsed(text, source), source, directory)

    @classmethod
    def _from_document(cls, document: Mapping[str, Any], source: str, directory: Path | None) -> Self:
        scenario = cls._read(document, source)
        scenario._origin = source
        if directory is not None:
            scenario._directory = directory.absolute()
        return scenario

    @model_validator(mode="after")
    def _check(self, info: ValidationInfo) -> Self:
        origin = info.context.source if isinstance(info.context, Reading) else self._origin
        parts = Parts(
            system=self.system_spec,
            sensors=self.sensors,
            noise=self.noise,
            network=self.network_spec,
            source=self.source,
            transport=self.transport,
            timing=self.timing,
            links=self.links,
            faults=self.faults,
        )
        problems = list(problems_between(parts))
        if not problems:
            try:
                self.system()
            except ModelError as error:
                problems = [_of_noise(error.problem)]
        if problems:
            raise ScenarioError(origin, problems)
        return self

    @classmethod
    def _all_problems(cls, document: Any, found: list[Located]) -> list[Problem]:
        """Those found so far, and what the pieces that are well-formed have against each other."""
        problems = [located.problem for located in found]
        if isinstance(document, Mapping):
            problems += problems_between(_readable(document, found))
        return problems

    def system(self) -> System:
        """What is observed and measured, as the numerics need it."""
        return self._system

    @cached_property
    def _system(self) -> System:
        return numeric_system(self.system_spec, self.sensors, self.noise)

    @cached_property
    def ids(self) -> tuple[NodeId, ...]:
        """All sensors' ids, sorted."""
        return tuple(sorted_ids(self._entries))

    @cached_property
    def network(self) -> Network:
        """Who receives from whom, as the scenario says; the method may use another graph."""
        return self.network_spec.network(tuple(self._entries))

    @cached_property
    def _entries(self) -> dict[NodeId, SensorSpec]:
        """Each sensor's entry, in the order in which they are listed."""
        return {i: sensor for sensor in self.sensors for i in sensor.members}

    def node_id(self, text: str) -> NodeId:
        """The id that is written as `text` in a key expression or on a command line; KeyError if there is none."""
        return self._ids_by_text[text]

    @cached_property
    def _ids_by_text(self) -> dict[str, NodeId]:
        return {str(i): i for i in self._entries}

    def source_of(self, i: NodeId) -> Source:
        """Where sensor i's measurements come from: paths absolute, "{id}" filled in."""
        source = self._entries[i].source or self.source
        return source.with_paths(lambda path: str(self.absolute(path))).for_sensor(i)

    def files_read(self) -> list[Path]:
        """The files that it names for nodes and links to read: recordings, tables, code, traces, designs, keys."""
        pieces = (*map(self.source_of, self.ids), self.transport, self.links, self.method)
        return [self.absolute(path) for piece in pieces for path in piece.paths()]

    @property
    def truth_known(self) -> bool:
        """Whether the state itself is known: where every sensor is simulated."""
        return all(isinstance(s.source or self.source, SimulationSource) for s in self.sensors)

    def endpoint(self, i: NodeId) -> str:
        """Where node i listens."""
        given = self.transport.endpoints.get(i)
        return given or f"tcp/127.0.0.1:{self.transport.base_port + self._ranks[i]}"

    @property
    def zenoh_config(self) -> Path | None:
        """The Zenoh configuration that its processes use, if it names one."""
        named = self.transport.zenoh_config
        return self.absolute(named) if named else None

    @cached_property
    def _ranks(self) -> dict[NodeId, int]:
        return {i: rank for rank, i in enumerate(self.ids)}

    def absolute(self, path: str) -> Path:
        """A path of the scenario, which is relative to the directory of its file."""
        return self._directory / path

    def anchored(self) -> Self:
        """The same scenario with absolute paths, to be written to another directory."""
        return self.with_paths(lambda path: str(self.absolute(path)))

    def with_paths(self, changed: Callable[[str], str]) -> Self:
        """The same with every path in it replaced by what `changed` makes of it."""
        sensors = tuple(
            sensor.model_copy(update={"source": sensor.source.with_paths(changed)}) if sensor.source else sensor
            for sensor in self.sensors
        )
        pieces = {
            name: getattr(self, name).with_paths(changed)
            for name in ("source", "transport", "recording", "links", "method")
        }
        others = {name: piece for name, piece in pieces.items() if piece != getattr(self, name)}
        document = self._document() | others | {"sensors": sensors}
        return self._from_document(document, self._origin, self._directory)

    def carrying(self, design: bytes | None) -> Self:
        """The same scenario with the content of its design file, which then is read nowhere; None: without."""
        scenario = self._from_document(self._document(), self._origin, self._directory)
        scenario._design = design
        return scenario

    @property
    def carried_design(self) -> bytes | None:
        """What `carrying` gave it; what is made of it by other means carries nothing."""
        return self._design

    def with_overrides(self, **overrides: Unpack[Overrides]) -> Self:
        """The scenario with these in the place of what it says; ScenarioError if that cannot be."""
        origin = _origin_of(self._origin, overrides)
        return self._from_document(_overridden(self._document(), overrides), origin, self._directory)

    def _document(self) -> dict[str, Any]:
        """What was set, as a TOML file holds it."""
        document: dict[str, Any] = _without_none(self.model_dump(by_alias=True, exclude_unset=True))
        return document

    def to_toml(self) -> str:
        """The text of a file with what was set, which `from_toml` reads as an equal scenario."""
        text = tomli_w.dumps(self._document())
        text = ITEMS_ON_LINES.sub(_on_one_line, text)
        return ROW_ON_LINE.sub(r"[\1]", text)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 in hex of all that defines the mathematics and the timing of a run, however it is written.

        Nodes of one run must agree in it. Names, endpoints, where files are kept and the number of steps do not matter.
        A design file counts by its content, where it can be read.
        """
        sensors = {str(i): self._sensor_facts(i) for i in self.ids}
        facts = {
            "version": FINGERPRINT_VERSION,
            "ids": self.ids,
            "system": self.system_spec.model_dump(exclude_none=True),
            "sensors": sensors,
            "noise": self.noise.model_dump(exclude_none=True),
            "network": [(i, self.network.neighbours(i)) for i in self.ids],
            "weights": sorted(self.network.weights.items()),
            "method": self._method_facts(),
            "timing": self.timing.facts,
            "links": self.links.with_paths(_file_name).facts,
            "faults": [fault.model_dump(exclude_none=True) for fault in self.faults],
            "seed": self.seed,
        }
        text = json.dumps(facts, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def _method_facts(self) -> dict[str, Any]:
        """Of a design what is in it, wherever it lies: what nodes tell each other means something within one only."""
        facts = self.method.with_paths(_file_name).model_dump(exclude_none=True)
        if self.method.design is not None:
            with suppress(OSError):  # whoever reads it as a design says so
                carried = self._design
                content = self.absolute(self.method.design).read_bytes() if carried is None else carried
                facts["design"] = hashlib.sha256(content).hexdigest()
        return facts

    def _sensor_facts(self, i: NodeId) -> dict[str, Any]:
        entry = self._entries[i]
        source = (entry.source or self.source).with_paths(_file_name)
        facts = entry.model_dump(include={"H", "R", "noise"}, exclude_none=True)
        return facts | {"source": source.for_sensor(i).model_dump(exclude_none=True)}

    def __eq__(self, other: object) -> bool:
        """Whether all fields agree; where the files lie does not matter."""
        if not isinstance(other, Scenario):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in type(self).model_fields)

    def __hash__(self) -> int:
        return hash(self.fingerprint)


def load_scenario(path: str | Path, **overrides: Unpack[Overrides]) -> Scenario:
    """The scenario in the file at `path`, with the overrides in the place of what it says.

    A scenario without a name has that of its file. Raises ScenarioError with everything that is wrong.
    """
    path = Path(path)
    text = _text_of(path, "a scenario file")
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem).lstrip(".-") or "scenario"
    document = {"name": name, **_parsed(text, str(path))}
    return Scenario._from_document(_overridden(document, overrides), _origin_of(str(path), overrides), path.parent)


def _text_of(path: Path, what: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        expected = f"expected {what} that can be read: {reason}"
        raise ScenarioError(str(path), [Problem("file", str(path), expected)]) from None


def _links_file(path: Path) -> dict[str, Any]:
    """The links and faults that a file holds, as a scenario in any directory may have them."""
    read = LinksFile._read(_parsed(_text_of(path, "a file of links"), str(path)), str(path))
    directory = path.parent.absolute()
    anchored = read.with_paths(lambda name: str(directory / name))
    return anchored.model_dump(by_alias=True, exclude_unset=True)


def _origin_of(origin: str, overrides: Overrides) -> str:
    """What errors name: with a file of links, it may be that file's fault."""
    links = overrides.get("links")
    return origin if links is None else f"{origin} with {links}"


def _file_name(path: str) -> str:
    return Path(path).name


def _parsed(text: str, source: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.fullmatch(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", str(error))
        reason, line, column = found.groups() if found else (str(error), None, None)
        lines = text.splitlines() or [""]
        number = len(lines) if line is None else int(line)
        place = f"line {number}" + (f", column {column}" if column else "")
        problem = Problem(place, lines[min(number, len(lines)) - 1].strip(), f"expected valid TOML: {reason}")
    raise ScenarioError(source, [problem])


def _on_one_line(items: re.Match[str]) -> str:
    lines = [line.strip() for line in items[1].split("\n")]
    return f"[{' '.join(lines).strip().removesuffix(',')}]"


def _overridden(document: Mapping[str, Any], overrides: Overrides) -> dict[str, Any]:
    """The document with the overrides that are not None worked in."""
    given = {key: value for key, value in overrides.items() if value is not None}
    changed: dict[str, Any] = {**document, **{key: given[key] for key in ("steps", "seed") if key in given}}
    if "links" in given:
        changed |= _links_file(Path(str(given["links"])))
    of_links = {name: given[name] for name in ("loss", "delay") if name in given}
    links = changed.get("links", {})
    if of_links and isinstance(links, Mapping):
        changed["links"] = {**links, **of_links}
    transport = document.get("transport", {})
    if "zenoh_config" in given and isinstance(transport, Mapping):
        changed["transport"] = {**transport, "zenoh_config": str(Path(str(given["zenoh_config"])).absolute())}
    method = document.get("method")
    if "method" in given and given["method"] != (method.get("name") if isinstance(method, Mapping) else method):
        changed["method"] = {"name": given["method"]}
    timing = document.get("timing", {})
    if isinstance(timing, Mapping) and given.keys() & {"rate_hz", "free_run"}:
        kept = {key: value for key, value in timing.items() if key not in ("rate_hz", "free_run")}
        changed["timing"] = kept | {key: given[key] for key in ("rate_hz", "free_run") if key in given}
    return changed


def _readable(document: Mapping[str, Any], found: Iterable[Located]) -> Parts:
    """The pieces of a faulty document in which nothing is wrong but keys too many."""
    pruned = without(document, [fault.path for fault in found if fault.is_unknown_key])
    faulty = {fault.path[:depth] for fault in found if not fault.is_unknown_key for depth in (1, 2)}

    def piece(reader: TypeAdapter[T], name: str, default: T | None) -> T | None:
        if (name,) in faulty:
            return None
        return reader.validate_python(pruned[name]) if name in pruned else default

    all_are_faulty = any(fault.path == ("sensors",) for fault in found)
    entries = () if all_are_faulty else pruned["sensors"]
    return Parts(
        system=piece(TypeAdapter(SystemSpec), "system", None),
        sensors=tuple(
            None if ("sensors", n) in faulty else TypeAdapter(SensorSpec).validate_python(entry)
            for n, entry in enumerate(entries)
        ),
        noise=piece(TypeAdapter(NoiseSpec), "noise", NoiseSpec()),
        network=piece(TypeAdapter(AnyGraph), "network", None),
        source=piece(TypeAdapter(Source), "source", SimulationSource()),
        transport=piece(TypeAdapter(TransportSpec), "transport", TransportSpec()),
        timing=piece(TypeAdapter(TimingSpec), "timing", TimingSpec()),
        links=piece(TypeAdapter(LinksSpec), "links", LinksSpec()),
        faults=piece(TypeAdapter(Timeline), "faults", ()),
    )


def _of_noise(problem: Problem) -> Problem:
    """A problem that only the numerics can find: the noises are not possible, or not what the model provides for."""
    if problem.field == "noise":
        return problem
    return Problem("noise", problem.value, f"{problem.field}: {problem.expected}")


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value
