"""The pieces of a scenario that say how it is run: method, time, where measurements come from, and where all goes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, PlainValidator, model_validator

from zfusion.errors import Problem
from zfusion.model.schema.base import Flag, Id, Natural, NotNegative, Number, Options, Positive, Spec
from zfusion.model.schema.problems import Faults
from zfusion.model.types import NodeId

DEFAULT_RATE_HZ = 10.0
LARGEST_WINDOW = 15
"""Steps that a message may be late under the policy "revise": a node keeps the states of so many."""
DEFAULT_DEADLINES: Mapping[str, float] = {"measurement": 0.45, "intermediate": 0.9}
"""Fractions of the period until which a stage's messages are waited for."""

LEAST_SEGMENT = 10_000
"""Bytes of a recording's file below which it would hold little but what it says of itself."""

NANOSECONDS = 1_000_000_000

CALLABLE = re.compile(r"([A-Za-z_][\w.]*|[^:]+\.py):[A-Za-z_]\w*")
ENDPOINT = re.compile(r"[a-z][a-z0-9_-]*/\S+")


class MethodSpec(Spec):
    """The method of estimation and what it takes; which methods there are is the methods' business."""

    PATHS = ("design",)

    name: str = "two_stage"
    options: Options = Field(default_factory=dict)
    design: str | None = None
    """A file that `zfusion design -o` wrote, for methods that are designed off-line; else it is made at the start."""


def _method(value: object) -> object:
    return {"name": value} if isinstance(value, str) else value


AnyMethod = Annotated[MethodSpec, BeforeValidator(_method)]
"""A method, or just its name."""

Fraction = Annotated[float, Field(strict=True, gt=0, le=1)]


def _epoch(value: object) -> datetime:
    try:
        moment = datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        moment = None
    if not isinstance(moment, datetime) or moment.tzinfo is None:
        raise ValueError("expected a date and time with its offset from UTC, like 2026-01-31T12:00:00Z")
    return moment


class TimingSpec(Spec):
    """When steps are made: `rate_hz` of them a second, or each as soon as the one before is done (`free_run`).

    `late` says what becomes of messages that are: they are not used (drop); they are not used in time, but taken in as
    long as they are within the `window` (revise); or there is no such thing, as a stage waits for all that it expects,
    for up to `timeout_s` (wait).

    The clocks of two neighbours may be `max_clock_offset_s` apart, by default a quarter of the shortest time that a
    stage is open; a node that finds more refuses to begin, or says so (`on_clock_offset`).
    """

    rate_hz: Positive | None = None
    free_run: Flag = False
    deadlines: dict[str, Fraction] = Field(default_factory=dict)
    timeout_s: Positive = 5.0
    late: Literal["drop", "revise", "wait"] = "drop"
    window: Annotated[int, Field(strict=True, ge=1, le=LARGEST_WINDOW)] = 8
    epoch: Annotated[datetime, PlainValidator(_epoch)] | None = None
    max_clock_offset_s: Positive | None = None
    on_clock_offset: Literal["refuse", "warn"] = "refuse"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.free_run and self.rate_hz is not None:
            raise ValueError("expected either rate_hz or free_run = true")
        if "window" in self.model_fields_set and self.late != "revise":
            raise Faults([Problem("window", self.window, 'expected late = "revise" with it: there is no window else')])
        if self.deadlines and self.late == "wait":
            expected = 'expected none, as late = "wait" knows no deadlines, only timeout_s'
            raise Faults([Problem("deadlines", dict(self.deadlines), expected)])
        waits = self.fractions
        if not waits["measurement"] < waits["intermediate"]:
            expected = "expected the deadline of measurement before that of intermediate"
            raise Faults([Problem("deadlines", dict(waits), expected)])
        return self

    @property
    def fractions(self) -> Mapping[str, float]:
        """Deadlines as fractions of the period: those that are given, and those of the two stages that most have."""
        return {**DEFAULT_DEADLINES, **self.deadlines}

    @property
    def period_ns(self) -> int | None:
        """Time from step to step; None in free-running mode."""
        return None if self.free_run else round(NANOSECONDS / (self.rate_hz or DEFAULT_RATE_HZ))

    @property
    def timeout_ns(self) -> int:
        """How long a free-running node waits for the messages of a stage."""
        return round(NANOSECONDS * self.timeout_s)

    @property
    def revised_steps(self) -> int:
        """How many steps late a message may be and still be taken in."""
        return self.window if self.late == "revise" else 0

    @property
    def epoch_ns(self) -> int | None:
        """The time of step 0 in nanoseconds since 1970, where the scenario fixes it."""
        if self.epoch is None:
            return None
        since = self.epoch - datetime.fromisoformat("1970-01-01T00:00:00+00:00")
        return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1000

    @property
    def facts(self) -> dict[str, Any]:
        """All that the nodes of a run must agree in."""
        return {
            "period_ns": self.period_ns,
            "timeout_ns": self.timeout_ns,
            "deadlines": dict(self.fractions),
            "epoch_ns": self.epoch_ns,
            "late": self.late,
            "window": self.revised_steps,
        }


class SourceSpec(Spec):
    """Any description of where measurements come from."""

    TAG = "kind"

    PER_SENSOR: ClassVar[tuple[str, ...]] = ()
    """The fields in which "{id}" stands for the sensor's id."""

    def for_sensor(self, i: NodeId) -> Self:
        """The same for sensor i: its id in the place of "{id}"."""

        def filled(value: Any) -> Any:
            return value.replace("{id}", str(i)) if isinstance(value, str) else tuple(map(filled, value))

        return self.model_copy(update={name: filled(getattr(self, name)) for name in self.PER_SENSOR})


class SimulationSource(SourceSpec):
    """Drawn from the model, and so is the truth."""

    kind: Literal["simulation"] = "simulation"


class CsvSource(SourceSpec):
    """A row for each step, or, with `id_column`, for each step and sensor; an empty cell or no row is no reading.

    "{id}" in the file's and the columns' names stands for the sensor's id. With `time_column`, step k takes the last
    row of first_time + (k - 1) time_step <= time < first_time + k time_step.
    """

    PATHS = ("file",)
    PER_SENSOR = ("file", "columns")

    kind: Literal["csv"] = "csv"
    file: str
    columns: Annotated[tuple[str, ...], Field(min_length=1)]
    """One for each component of y."""
    id_column: str | None = None
    """Holds the id of the sensor whose row it is."""
    step_column: str | None = None
    """Holds a whole number that grows by one from step to step; without it the rows are steps 1, 2, ..."""
    first_step: Annotated[int, Field(strict=True)] = 1
    """What step_column says at step 1; without step_column, the row (from 1) of step 1."""
    time_column: str | None = None
    """Holds a time as a number."""
    first_time: Number | None = None
    """When step 1 begins, and how long a step is, in the unit of time_column."""
    time_step: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        by_time = {"time_column", "first_time", "time_step"}
        given = {name for name in by_time if getattr(self, name) is not None}
        if given and given != by_time:
            raise ValueError("expected time_column, first_time and time_step together")
        if given and self.model_fields_set & {"step_column", "first_step"}:
            raise ValueError("expected either step_column and first_step or time_column and what goes with it")
        return self


class McapSource(SourceSpec):
    """The measurements that a recording holds for the sensor."""

    PATHS = ("recording",)

    kind: Literal["mcap"] = "mcap"
    recording: str


class ZenohSource(SourceSpec):
    """What a program of the user's publishes on `key`, in which "{id}" stands for the sensor's id."""

    PER_SENSOR = ("key",)

    kind: Literal["zenoh"] = "zenoh"
    key: str


def _callable(value: str) -> str:
    if not CALLABLE.fullmatch(value):
        raise ValueError("expected 'module:function' or 'file.py:function'")
    return value


class PythonSource(SourceSpec):
    """What a function of the user's returns, "module:function" or "path/to/file.py:function"."""

    kind: Literal["python"] = "python"
    function: Annotated[str, AfterValidator(_callable)]
    options: Options = Field(default_factory=dict)

    def with_paths(self, changed: Callable[[str], str]) -> Self:
        """See `Spec`; a module's name is no path."""
        place, function = self.function.split(":")
        return self.model_copy(update={"function": f"{changed(place)}:{function}"}) if _is_file(place) else self


def _is_file(place: str) -> bool:
    return place.endswith(".py")


Source = Annotated[SimulationSource | CsvSource | McapSource | ZenohSource | PythonSource, Field(discriminator="kind")]


def _node_keys(value: object) -> object:
    """The keys of a table are always text: those that are numbers stand for ids that are numbers."""
    if not isinstance(value, Mapping):
        return value
    return {int(key) if isinstance(key, str) and key.isdecimal() else key: item for key, item in value.items()}


def _endpoint(value: str) -> str:
    if not ENDPOINT.fullmatch(value):
        raise ValueError("expected an endpoint like 'tcp/192.168.0.7:7447'")
    return value


Endpoints = Annotated[
    dict[Id, Annotated[str, AfterValidator(_endpoint)]],
    BeforeValidator(_node_keys),
    PlainSerializer(lambda endpoints: {str(i): endpoint for i, endpoint in endpoints.items()}),
]


class TransportSpec(Spec):
    """Where each node listens, and who is connected to whom."""

    PATHS = ("zenoh_config",)

    endpoints: Endpoints = Field(default_factory=dict)
    base_port: Annotated[int, Field(strict=True, ge=1, le=65535)] = 7450
    """Nodes without an endpoint listen on 127.0.0.1 at base_port plus their place among the sorted ids."""
    mesh: Literal["neighbours", "full"] = "neighbours"
    preset: Literal["default", "lowlatency"] = "default"
    zenoh_config: str | None = None


def _segment_bytes(value: int) -> int:
    if 0 < value < LEAST_SEGMENT:
        raise ValueError(f"expected {LEAST_SEGMENT} or more, or 0 for one file of any size")
    return value


class RecordingSpec(Spec):
    """What becomes of the run's messages: an MCAP file at `path`, or in `directory` under the run's name."""

    PATHS = ("path", "directory")

    enabled: Flag = True
    path: str | None = None
    directory: str | None = None
    flush_interval_s: Positive = 1.0
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    rotate_bytes: Annotated[Natural, AfterValidator(_segment_bytes)] = 1 << 30
    rotate_s: NotNegative = 3600.0
    max_files: Natural = 0
    min_free_bytes: Natural = 100_000_000
    fsync_interval_s: NotNegative = 5.0
    """Of these five, 0 means: not at all."""
    when_full: Literal["drop", "wait"] | None = None
    """Whether senders wait for a recorder that cannot follow. By default they do where the swarm runs freely only."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.path is not None and self.directory is not None:
            raise ValueError("expected either path or directory")
        return self
