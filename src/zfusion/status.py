"""What a node answers when it is asked: how it is doing, and what its used sets were."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from importlib.metadata import version
from math import isfinite
from typing import Any

from zfusion.errors import MessageError
from zfusion.messages import MAX_STEP, MAX_TIME_NS, VERSION, Reason, decode_any, encode_any
from zfusion.model.types import NodeId, sorted_ids
from zfusion.used_sets import Run

BIN = re.compile(r"[0-9]{1,4}")
"""The number of a histogram's bin, as text."""


class Phase(StrEnum):
    """Where a node is in its life."""

    JOINING = "joining"
    """Waiting for its neighbours and for the recorder."""
    RUNNING = "running"
    DONE = "done"
    """Has taken its last step and stays until its neighbours have its last messages."""


@dataclass(frozen=True, slots=True)
class Counts:
    """What a node has counted so far in its present life; told to those who ask for it."""

    host: str
    skipped: int
    elapsed_s: float
    """From the start of its first step to the end of its last."""
    cpu_s: float
    """Of its process, since that was started."""
    sent: Mapping[str, int]
    """By stage."""
    edges: Mapping[str, Mapping[str, Mapping[str, int]]]
    """Neighbour -> received, late, missed, lost, refused, ... -> by stage or reason."""
    overheard: Mapping[str, int]
    """What was not a legal message, and other trouble, by reason."""
    incidents: Mapping[str, int]
    waits: Mapping[str, Mapping[str, int]]
    """Stage -> how long it was open, as `Latencies.told`."""
    clocks: Mapping[str, Mapping[str, float]]
    """Neighbour -> offset_us, uncertainty_us: how far its clock is ahead of this node's, where that is known."""
    queues: Mapping[str, int]

    def total(self, kind: str) -> int:
        """Over all neighbours and stages."""
        return sum(sum(edge.get(kind, {}).values()) for edge in self.edges.values())

    @classmethod
    def from_map(cls, raw: Mapping[str, Any]) -> Counts:
        """From a map; KeyError or MessageError if it is not such a one."""
        return cls(
            host=_typed(raw, "host", str),
            skipped=_typed(raw, "skipped", int),
            elapsed_s=_typed(raw, "elapsed_s", float),
            cpu_s=_typed(raw, "cpu_s", float),
            sent=_numbers(raw, "sent", int),
            edges={j: {kind: _numbers(edge, kind, int) for kind in edge} for j, edge in _maps(raw, "edges").items()},
            overheard=_numbers(raw, "overheard", int),
            incidents=_numbers(raw, "incidents", int),
            waits={stage: _bins(waits) for stage, waits in _maps(raw, "waits").items()},
            clocks={j: _all(clock, float) for j, clock in _maps(raw, "clocks").items()},
            queues=_numbers(raw, "queues", int),
        )


@dataclass(frozen=True, slots=True)
class Status:
    """How a node is doing."""

    node: NodeId
    fingerprint: str
    """Of its scenario: nodes that differ in it are not of one swarm."""
    phase: Phase
    step: int
    born: int
    epoch_ns: int | None
    """When step 1 begins, on everybody's clock; None until it is agreed."""
    ready: Mapping[NodeId, int]
    """Who is known to have found all its neighbours, with the start of its process (ns): it tells lives apart."""
    completed: int = 0
    fallbacks: int = 0
    estimate: Mapping[str, list[float]] = field(default_factory=dict)
    """The last one, where there is one: x, and sd, the standard deviations of its errors. For people to look at."""
    machine: str | None = None
    """Nodes that tell the same here count the same time; None where nothing can be said."""
    line_ns: int = 0
    """Where the node's time line begins, on that count."""
    clock_jumps: int = 0
    """How often its machine's clock was seen to jump."""
    clock_offset_exceeded: int = 0
    """Readings of neighbours' clocks that were beyond what is allowed."""
    heard_ns: int = 0
    """When the question was heard that this answers, and when the answer was told, on the node's clock."""
    told_ns: int = 0
    holder_ns: int | None = None
    """Start of the process that this node knows under the asker's id, where that is another than the asker."""
    counts: Counts | None = None
    """Where they were asked for."""
    zfusion: str = version("zfusion")
    wire: int = VERSION

    @property
    def identity(self) -> tuple[str, int, str]:
        """What all nodes of a swarm must have in common: version, wire format, scenario."""
        return (self.zfusion, self.wire, self.fingerprint)

    def encode(self) -> bytes:
        """As bytes."""
        return encode_any({**asdict(self), "phase": str(self.phase), "ready": list(self.ready.items())})

    @classmethod
    def decode(cls, data: bytes) -> Status:
        """From bytes; MessageError if they are no status.

        Of another version's only the identity is read: the rest may be something else by then.
        """
        raw = decode_any(data)
        try:
            node, fingerprint = _id(raw["node"]), _typed(raw, "fingerprint", str)
            zfusion, wire = _typed(raw, "zfusion", str), _typed(raw, "wire", int)
            if (zfusion, wire) != (version("zfusion"), VERSION):
                return cls(node, fingerprint, Phase.JOINING, 0, 0, None, {}, zfusion=zfusion, wire=wire)
            status = cls(
                node=node,
                fingerprint=fingerprint,
                phase=Phase(_typed(raw, "phase", str)),
                step=_count(raw, "step", MAX_STEP),
                born=_count(raw, "born", MAX_STEP),
                epoch_ns=None if raw["epoch_ns"] is None else _count(raw, "epoch_ns"),
                ready={_id(i): _number(start, "ready", MAX_TIME_NS) for i, start in _typed(raw, "ready", list)},
                completed=_count(raw, "completed", MAX_STEP),
                fallbacks=_count(raw, "fallbacks", MAX_TIME_NS),
                estimate=_vectors(raw, "estimate"),
                machine=None if raw["machine"] is None else _typed(raw, "machine", str),
                line_ns=_signed(raw, "line_ns"),
                clock_jumps=_count(raw, "clock_jumps"),
                clock_offset_exceeded=_count(raw, "clock_offset_exceeded"),
                heard_ns=_count(raw, "heard_ns"),
                told_ns=_count(raw, "told_ns"),
                counts=Counts.from_map(raw["counts"]) if raw.get("counts") is not None else None,
                holder_ns=None if raw["holder_ns"] is None else _count(raw, "holder_ns"),
            )
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, str(missing)) from None
        except (TypeError, ValueError) as error:
            raise MessageError(Reason.WRONG_TYPE, str(error)) from None
        return status


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """How the recorder is doing."""

    messages: int
    """On the file."""
    foreign: int
    """What came and is not on the file: on keys that are none of the scenario's, or larger than any message is."""
    lost: int
    """Missing between the first and the last that came of every key."""
    waiting: int
    """Messages that had come and were not on the file yet when the question was heard."""
    path: str
    host: str
    unrecorded: int = 0
    """Messages that came and could not be written."""
    overrun: int = 0
    """Messages that came and were dropped unread, being too much at once."""
    stopped: str = ""
    """Why nothing is written any more, if that is so."""

    def encode(self) -> bytes:
        """As bytes."""
        return encode_any(asdict(self))

    @classmethod
    def decode(cls, data: bytes) -> RecorderStatus:
        """From bytes; MessageError if they are no such status."""
        raw = decode_any(data)
        try:
            counts = ("messages", "foreign", "lost", "waiting", "unrecorded", "overrun")
            words = {name: _typed(raw, name, str) for name in ("path", "host", "stopped")}
            return cls(**{name: _typed(raw, name, int) for name in counts}, **words)
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, str(missing)) from None


@dataclass(frozen=True, slots=True)
class HistoryAnswer:
    """A node's used sets in its present life, up to `end`, as far back as it knows them."""

    born: int
    end: int
    runs: Sequence[Run]

    def encode(self) -> bytes:
        """As bytes."""
        return encode_any({"born": self.born, "end": self.end, "runs": list(self.runs)})

    @classmethod
    def decode(cls, data: bytes, legal: frozenset[NodeId]) -> HistoryAnswer:
        """From bytes; MessageError if they are no history whose used sets are drawn from `legal`."""
        return cls.from_map(decode_any(data), legal)

    @classmethod
    def from_map(cls, raw: Mapping[str, Any], legal: frozenset[NodeId]) -> HistoryAnswer:
        """From what `encode` put into a map; MessageError as `decode`."""
        try:
            born, end, told = _count(raw, "born", MAX_STEP), _count(raw, "end", MAX_STEP), _typed(raw, "runs", list)
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, str(missing)) from None
        runs: list[Run] = []
        previous = born - 1
        for run in told:
            if type(run) is not list or len(run) != 2 or type(run[0]) is not int or type(run[1]) is not list:
                raise MessageError(Reason.WRONG_TYPE, "runs: expected [first step, node ids]")
            first, used = run
            if not previous < first <= end:
                raise MessageError(Reason.BAD_HISTORY, f"a run from {first} after {previous}, up to {end}")
            if not legal.issuperset(map(_id, used)):
                raise MessageError(Reason.UNKNOWN_ID, f"{used!r:.80}")
            if used != sorted_ids(set(used)):
                raise MessageError(Reason.NOT_SORTED, f"{used!r:.80}")
            runs.append((first, tuple(used)))
            previous = first
        return cls(born, end, tuple(runs))


def _id(value: object) -> NodeId:
    if type(value) is int or type(value) is str:
        return value
    raise MessageError(Reason.WRONG_TYPE, f"{value!r} is no node id")


def _count(raw: Mapping[str, Any], name: str, most: int = MAX_TIME_NS) -> int:
    return _number(raw[name], name, most)


def _number(value: object, name: str, most: int) -> int:
    if type(value) is not int:
        raise MessageError(Reason.WRONG_TYPE, f"{name}: expected int, is {value!r:.80}")
    if not 0 <= value <= most:
        raise MessageError(Reason.OUT_OF_RANGE, f"{name}: {value}")
    return value


def _signed(raw: Mapping[str, Any], name: str) -> int:
    """A time of a clock that may be set to before 1970."""
    value: int = _typed(raw, name, int)
    if abs(value) > MAX_TIME_NS:
        raise MessageError(Reason.OUT_OF_RANGE, f"{name}: {value}")
    return value


def _typed(raw: Mapping[str, Any], name: str, expected: type) -> Any:
    value = raw[name]
    if type(value) is not expected:
        raise MessageError(Reason.WRONG_TYPE, f"{name}: expected {expected.__name__}, is {value!r:.80}")
    if isinstance(value, float) and not isfinite(value):
        raise MessageError(Reason.NOT_FINITE, f"{name}: {value}")
    return value


def _maps(raw: Mapping[str, Any], name: str) -> Mapping[str, Mapping[str, Any]]:
    """A map of maps."""
    maps: Mapping[str, Mapping[str, Any]] = _typed(raw, name, dict)
    return {key: _typed(maps, key, dict) for key in maps}


def _numbers(raw: Mapping[str, Any], name: str, kind: type) -> Mapping[str, Any]:
    """A map of numbers that are all of that kind."""
    return _all(_typed(raw, name, dict), kind)


def _all(numbers: Mapping[str, Any], kind: type) -> Mapping[str, Any]:
    return {key: _typed(numbers, key, kind) for key in numbers}


def _bins(raw: Mapping[str, Any]) -> Mapping[str, int]:
    """A histogram: counts by the numbers of their bins."""
    if not all(BIN.fullmatch(number) for number in raw):
        raise MessageError(Reason.WRONG_TYPE, "waits: expected the numbers of bins")
    return _all(raw, int)


def _vectors(raw: Mapping[str, Any], name: str) -> Mapping[str, list[float]]:
    """A map of lists of floats; empty where there is none."""
    vectors: Mapping[str, Any] = _typed({name: raw.get(name, {})}, name, dict)
    for key in vectors:
        if not {float}.issuperset(map(type, _typed(vectors, key, list))):
            raise MessageError(Reason.WRONG_TYPE, f"{name}: {key}: expected nothing but floats")
        if not all(map(isfinite, vectors[key])):
            raise MessageError(Reason.NOT_FINITE, f"{name}: {key}")
    return vectors
