"""The wire format: messages to bytes and back.

A payload is one msgpack map with names as keys (docs/messages.md): the header

    v       version of this format: 1            step    k >= 1
    node    the sender's id                      born    first step of the sender's present life, <= step
    t_ns    the sender's clock, nanoseconds      seq     messages it had put on this key in that life before this one

and the fields of its stage, as the stage's table says. Floats are float64 and arrive bit for bit. A reader skips
names that it does not know, so that a field may be added without a new version.

What comes in is not trusted: a `Decoder` knows what one sender may say on one key, and refuses everything else with
one kind of error, MessageError, whose `reason` is one of `Reason`. Sizes are bounded before anything is unpacked.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from enum import StrEnum
from math import isfinite, prod
from operator import lt
from struct import Struct
from typing import Any, NamedTuple

import msgpack
import numpy as np

from zfusion.errors import MessageError
from zfusion.model.types import Array, NodeId
from zfusion.stages import HEADER, Kind, Message, Stage

VERSION = 1

MAX_STEP = 2**53 - 1
"""Highest step and counter: the integers that every JSON and JavaScript reader of a recording holds exactly."""

MAX_TIME_NS = 2**63 - 1
"""Latest time stamp, in the year 2262: what a signed 64-bit reader holds."""

MAX_MESSAGE_BYTES = 1 << 20
"""Largest payload that is looked into without knowing its sender: room for the P of a state of 340 components."""

MAX_HISTORY_RUNS = 256
"""Most runs of a history: a sender's own choice is far below; what is above is somebody's attempt to keep us busy."""

MAX_TEXT = 200
"""Most characters of a text: one line of a log."""

MAX_MAP_BYTES = 1 << 16
"""Most bytes of a free map: the particulars of an event, not a data channel."""

MAX_DEPTH = 8
"""Most levels of nesting in what nobody's table describes: no reader's stack is to depend on a sender."""

EXTRA_BYTES = 1024
"""What a payload may have beyond its table's fields, for names that this version does not know."""

_MAX_STRING_BYTES = 4 * MAX_TEXT
_NUMBER_BYTES = 9
"""The most that msgpack needs for an integer or a float."""
_HEAD_BYTES = 5
"""The most that msgpack needs to begin a list, map or string."""


class Reason(StrEnum):
    """Why bytes are not a legal message; what a node counts them under."""

    TOO_LARGE = "too_large"
    """More bytes, runs or characters than the sender's messages can have."""
    NOT_MSGPACK = "not_msgpack"
    """Not one msgpack value, though perhaps a map's beginning: cut off, followed by something, with what no map has."""
    NOT_JSON = "not_json"
    """A reading that is not JSON text."""
    NOT_A_MAP = "not_a_map"
    """Does not begin as a map in msgpack: another value, text, noise."""
    VERSION = "version"
    """Of a version of the format that this zfusion does not read."""
    MISSING_FIELD = "missing_field"
    WRONG_TYPE = "wrong_type"
    WRONG_SHAPE = "wrong_shape"
    """A vector or matrix of another size than the sender's."""
    NOT_FINITE = "not_finite"
    """NaN or infinity in a vector or matrix."""
    OUT_OF_RANGE = "out_of_range"
    """A step, counter or time that cannot be, or a life that begins after the step."""
    WRONG_NODE = "wrong_node"
    """From another node than the one whose key it came on."""
    UNKNOWN_ID = "unknown_id"
    """Names a node that the sender cannot have heard."""
    NOT_SORTED = "not_sorted"
    """Node ids that are not ascending, each once."""
    BAD_HISTORY = "bad_history"
    """Runs that are not ascending, or not between the sender's first step and this one."""
    TOO_DEEP = "too_deep"
    UNKNOWN_KEY = "unknown_key"
    """On a key that is none of zfusion's."""


class Stamp(NamedTuple):
    """What a recorder needs to know of a message of whatever stage."""

    born: int
    seq: int
    t_ns: int
    step: int


def encode(message: Message, sent_ns: int | None = None) -> bytes:
    """The payload of `message`, as sent then. Its arrays must be float64: it is the node's own word, unchecked."""
    payload: dict[str, object] = {
        "v": VERSION,
        "node": message.node,
        "step": message.step,
        "t_ns": message.t_ns if sent_ns is None else sent_ns,
        "seq": message.seq,
        "born": message.born,
    }
    for name, value in message.fields.items():
        if type(value) is not np.ndarray:
            payload[name] = value
        elif value.ndim == 1:
            payload[name] = value.tolist()
        else:
            payload["shape"] = value.shape
            payload[name] = value.ravel().tolist()
    return _pack(payload)


def encode_any(payload: Mapping[str, object]) -> bytes:
    """The bytes of a map that is no stage's message: the answer to a query."""
    return _pack(payload)


class Decoder:
    """Reads what one sender publishes on one key.

    `sizes` gives the lengths that the stage's table has names for (``{"nx": 4, "ny": 2}``), `ids` the nodes that the
    sender can name: its neighbourhood. `beside`: whether the messages may hold any other fields, as those of another
    method's stage of that name do. Raises KeyError for a size that is not given.
    """

    __slots__ = ("_most_bytes", "_most_elements", "_node", "_node_type", "_readers", "_stage")

    def __init__(
        self,
        stage: Stage,
        node: NodeId,
        *,
        sizes: Mapping[str, int] | None = None,
        ids: Iterable[NodeId] = (),
        beside: bool = False,
    ) -> None:
        legal = frozenset(ids)
        self._stage = stage.name
        self._node = node
        self._node_type = type(node)
        self._most_bytes, self._most_elements = _ANY if beside else _limits(stage, node, sizes or {}, legal)
        self._readers = [(f.name, _READERS[f.kind](f.name, f.lengths(sizes or {}), legal)) for f in stage.fields]

    def decode(self, data: bytes) -> Message:
        """The message in `data`; MessageError, with one of `Reason`, if it is not a legal one of this sender."""
        raw = _unpack(data, self._most_bytes, self._most_elements)
        try:
            version, node, step = raw["v"], raw["node"], raw["step"]
            seq, born, t_ns = raw["seq"], raw["born"], raw["t_ns"]
            if type(version) is not int or version != VERSION:
                raise MessageError(Reason.VERSION, "{}, expected {}", version, VERSION)
            if type(node) is not self._node_type or node != self._node:
                raise MessageError(Reason.WRONG_NODE, "{} on the key of {}", node, self._node)
            _check_counters(step, seq, born, t_ns)
            fields: dict[str, object] = {}
            for name, read in self._readers:
                fields[name] = read(raw[name], raw)
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, "{}", missing.args[0]) from None
        return Message(node, step, self._stage, seq, born, t_ns, fields)


def read_stamp(data: bytes) -> Stamp:
    """The counters and the time of a message of any stage and version; MessageError if it has none."""
    raw = _unpack(data, *_ANY)
    try:
        step, seq, born, t_ns = raw["step"], raw["seq"], raw["born"], raw["t_ns"]
    except KeyError as missing:
        raise MessageError(Reason.MISSING_FIELD, str(missing)) from None
    _check_counters(step, seq, born, t_ns)
    return Stamp(born, seq, t_ns, step)


def decode_any(data: bytes) -> dict[str, Any]:
    """The map in `data` as it is, for tools that show things: str keys, and values that JSON can say.

    Nothing is checked but that; a float may be NaN or infinite. MessageError if it is not such a map.
    """
    raw = _unpack(data, *_ANY)
    _check_plain(raw)
    return raw


def json_schema(stage: Stage) -> dict[str, object]:
    """A JSON Schema (draft 2020-12) of the stage's payloads."""
    properties: dict[str, object] = {
        "v": {"const": VERSION},
        "node": {**_ID_SCHEMA, "description": "the sender"},
        "step": {"type": "integer", "minimum": 1, "maximum": MAX_STEP},
        "t_ns": {"type": "integer", "minimum": 0, "description": "the sender's clock when it sent"},
        "seq": {"type": "integer", "minimum": 0, "description": "messages on this key in this life before this one"},
        "born": {"type": "integer", "minimum": 1, "description": "first step of the sender's present life"},
    }
    for field in stage.fields:
        properties[field.name] = {**_SCHEMAS[field.kind], "description": field.meaning}
        if field.kind is Kind.MATRIX:
            axis = {"type": "integer", "minimum": 0}
            properties["shape"] = {"type": "array", "items": axis, "minItems": 2, "maxItems": 2}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": stage.name,
        "description": stage.meaning,
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }


def decode_reading(data: bytes, packed: bool, ny: int) -> Array:
    """A sensor program's reading, (ny,): a number or a list of numbers, in msgpack if `packed`, else in JSON.

    MessageError if it is anything else.
    """
    if len(data) > EXTRA_BYTES + ny * 4 * _NUMBER_BYTES:
        raise MessageError(Reason.TOO_LARGE, f"{len(data)} bytes")
    try:
        value = _unpackb(data) if packed else json.loads(data)
        values = [float(v) if type(v) is int else v for v in (value if type(value) is list else [value])]
    except (ValueError, RecursionError, OverflowError, msgpack.UnpackException) as error:
        raise MessageError(Reason.NOT_MSGPACK if packed else Reason.NOT_JSON, str(error)) from None
    reading: Array = _vector("reading", (ny,), frozenset())(values, {})  # type: ignore[assignment]
    return reading


_NUMBERS: dict[str, object] = {"type": "array", "items": {"type": "number"}}
_ID_SCHEMA: dict[str, object] = {"type": ["integer", "string"]}
_IDS_SCHEMA: dict[str, object] = {"type": "array", "items": _ID_SCHEMA, "uniqueItems": True}
_RUN_SCHEMA: dict[str, object] = {
    "type": "array",
    "prefixItems": [{"type": "integer"}, _IDS_SCHEMA],
    "minItems": 2,
    "maxItems": 2,
}
_SCHEMAS: dict[Kind, dict[str, object]] = {
    Kind.VECTOR: _NUMBERS,
    Kind.OPTIONAL_VECTOR: {**_NUMBERS, "type": ["array", "null"]},
    Kind.MATRIX: _NUMBERS,
    Kind.IDS: _IDS_SCHEMA,
    Kind.STEP: {"type": "integer", "minimum": 1},
    Kind.HISTORY: {"type": "array", "items": _RUN_SCHEMA},
    Kind.TEXT: {"type": "string", "maxLength": MAX_TEXT},
    Kind.MAP: {"type": "object"},
}


_ANY = (MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES // _NUMBER_BYTES)
"""Bytes and list elements of a payload whose sender is not known."""

_MAP_HEADS = frozenset({b"", *(bytes([head]) for head in (*range(0x80, 0x90), 0xDE, 0xDF))})
"""What a map can begin with, or be cut off to: looked at first, for it costs a third of having msgpack find out."""

_INTEGER = frozenset({int})
_FLOAT = frozenset({float})
_PLAIN = (str, int, float, bool, type(None))
_pack: Callable[[object], bytes] = msgpack.packb
"""(One Packer for all calls would be a third faster, but two threads must not use it at once.)"""
_unpackb = msgpack.unpackb

_Raw = dict[str, Any]
_Reader = Callable[[Any, _Raw], object]
"""(the field's value, the whole map) -> what the message holds."""


def _limits(stage: Stage, node: NodeId, sizes: Mapping[str, int], ids: frozenset[NodeId]) -> tuple[int, int]:
    """Bytes of the largest legal message of the stage, and elements of its longest list."""
    id_bytes = sum(len(_pack(i)) for i in ids) + _HEAD_BYTES
    size = EXTRA_BYTES + len(_pack(node)) + _HEAD_BYTES + len(HEADER) * (_HEAD_BYTES + _NUMBER_BYTES)
    # Never less than a history's, so that a list that is merely of the wrong length is refused as that.
    elements = max(MAX_HISTORY_RUNS, len(ids))
    for field in stage.fields:
        numbers = prod(field.lengths(sizes))
        elements = max(elements, numbers)
        size += _HEAD_BYTES + len(field.name)
        size += {
            Kind.VECTOR: _HEAD_BYTES + numbers * _NUMBER_BYTES,
            Kind.OPTIONAL_VECTOR: _HEAD_BYTES + numbers * _NUMBER_BYTES,
            Kind.MATRIX: 2 * _HEAD_BYTES + (numbers + 2) * _NUMBER_BYTES,
            Kind.IDS: id_bytes,
            Kind.STEP: _NUMBER_BYTES,
            Kind.HISTORY: _HEAD_BYTES + MAX_HISTORY_RUNS * (_HEAD_BYTES + _NUMBER_BYTES + id_bytes),
            Kind.TEXT: _HEAD_BYTES + _MAX_STRING_BYTES,
            Kind.MAP: MAX_MAP_BYTES,
        }[field.kind]
    return size, elements


def _unpack(data: bytes, most_bytes: int, most_elements: int) -> _Raw:
    if len(data) > most_bytes:
        raise MessageError(Reason.TOO_LARGE, "{} bytes, expected at most {}", len(data), most_bytes)
    if data[:1] not in _MAP_HEADS:
        raise MessageError(Reason.NOT_A_MAP, "expected a map, is {}", data)
    try:
        raw: _Raw = _unpackb(data, max_array_len=most_elements)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(Reason.NOT_MSGPACK, "{}", error) from None
    return raw


def _check_counters(step: Any, seq: Any, born: Any, t_ns: Any) -> None:
    if not type(step) is type(seq) is type(born) is type(t_ns) is int:
        raise MessageError(Reason.WRONG_TYPE, "step, seq, born and t_ns: expected integers")
    if not (1 <= born <= step <= MAX_STEP and 0 <= seq <= MAX_STEP and 0 <= t_ns <= MAX_TIME_NS):
        raise MessageError(Reason.OUT_OF_RANGE, "step={} seq={} born={} t_ns={}", step, seq, born, t_ns)


def _check_plain(root: object) -> None:
    """Refuse what JSON cannot say, and what is nested deeper than MAX_DEPTH."""
    level = [root]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for item in level:
            if type(item) is dict:
                if not all(type(key) is str for key in item):
                    raise MessageError(Reason.WRONG_TYPE, "expected text as the keys of a map")
                below.extend(item.values())
            elif type(item) is list:
                below.extend(item)
            elif type(item) not in _PLAIN:
                raise MessageError(Reason.WRONG_TYPE, "{}: expected what JSON can say", item)
        if not below:
            return
        level = below
    raise MessageError(Reason.TOO_DEEP, f"expected at most {MAX_DEPTH} levels")


def _wrong_type(name: str, value: object, expected: str) -> MessageError:
    return MessageError(Reason.WRONG_TYPE, f"{name}: expected {expected}, is {{}}", value)


def _vector(name: str, shape: tuple[int, ...], _legal: frozenset[NodeId]) -> _Reader:
    length = prod(shape)
    to_bytes = Struct(f"{length}d").pack
    dtype = np.dtype(np.float64)

    def read(values: Any, _raw: _Raw) -> Array:
        if type(values) is not list:
            raise _wrong_type(name, values, "a list of floats")
        if len(values) != length:
            raise MessageError(Reason.WRONG_SHAPE, name + ": {} elements, expected {}", len(values), length)
        if not _FLOAT.issuperset(map(type, values)):
            raise _wrong_type(name, values, "nothing but floats")
        # A finite sum has finite terms only; an infinite one may come of large terms, and is looked at closely.
        if not isfinite(sum(values)) and not all(map(isfinite, values)):
            raise MessageError(Reason.NOT_FINITE, name + ": {}", values)
        return np.ndarray(shape, dtype, to_bytes(*values))  # on bytes: read-only

    return read


def _optional_vector(name: str, shape: tuple[int, ...], legal: frozenset[NodeId]) -> _Reader:
    read_vector = _vector(name, shape, legal)

    def read(values: Any, raw: _Raw) -> object:
        return None if values is None else read_vector(values, raw)

    return read


def _matrix(name: str, shape: tuple[int, ...], legal: frozenset[NodeId]) -> _Reader:
    wanted, read_entries = list(shape), _vector(name, shape, legal)

    def read(values: Any, raw: _Raw) -> object:
        told = raw["shape"]
        if type(told) is not list or not _INTEGER.issuperset(map(type, told)):
            raise _wrong_type("shape", told, "a list of integers")
        if told != wanted:
            raise MessageError(Reason.WRONG_SHAPE, name + ": {}, expected {}", told, wanted)
        return read_entries(values, raw)

    return read


def _ids(name: str, _shape: tuple[int, ...], legal: frozenset[NodeId]) -> _Reader:
    types = frozenset(map(type, legal))

    def read(ids: Any, _raw: _Raw) -> tuple[NodeId, ...]:
        if type(ids) is not list or not types.issuperset(map(type, ids)):
            raise _wrong_type(name, ids, "a list of node ids")
        if not legal.issuperset(ids):
            raise MessageError(Reason.UNKNOWN_ID, name + ": {}", ids)
        if not all(map(lt, ids, ids[1:])):
            raise MessageError(Reason.NOT_SORTED, name + ": {}", ids)
        return tuple(ids)

    return read


def _step(name: str, _shape: tuple[int, ...], _legal: frozenset[NodeId]) -> _Reader:
    def read(step: Any, _raw: _Raw) -> int:
        if type(step) is not int:
            raise _wrong_type(name, step, "an integer")
        if not 1 <= step <= MAX_STEP:
            raise MessageError(Reason.OUT_OF_RANGE, name + ": {}", step)
        return step

    return read


def _history(name: str, shape: tuple[int, ...], legal: frozenset[NodeId]) -> _Reader:
    read_ids = _ids(name, shape, legal)

    def read(runs: Any, raw: _Raw) -> tuple[tuple[int, object], ...]:
        if type(runs) is not list:
            raise _wrong_type(name, runs, "a list of runs")
        if len(runs) > MAX_HISTORY_RUNS:
            raise MessageError(Reason.TOO_LARGE, name + ": {} runs, expected at most {}", len(runs), MAX_HISTORY_RUNS)
        step, previous = raw["step"], raw["born"] - 1
        history = []
        for run in runs:
            if type(run) is not list or len(run) != 2 or type(run[0]) is not int:
                raise _wrong_type(name, run, "[first step, node ids]")
            first, ids = run
            if not previous < first < step:
                raise MessageError(
                    Reason.BAD_HISTORY, name + ": a run from {} after {} at step {}", first, previous, step
                )
            history.append((first, read_ids(ids, raw)))
            previous = first
        return tuple(history)

    return read


def _text(name: str, _shape: tuple[int, ...], _legal: frozenset[NodeId]) -> _Reader:
    def read(text: Any, _raw: _Raw) -> str:
        if type(text) is not str:
            raise _wrong_type(name, text, "text")
        if len(text) > MAX_TEXT:
            raise MessageError(Reason.TOO_LARGE, name + ": {} characters, expected at most {}", len(text), MAX_TEXT)
        return text

    return read


def _map(name: str, _shape: tuple[int, ...], _legal: frozenset[NodeId]) -> _Reader:
    def read(value: Any, _raw: _Raw) -> dict[str, object]:
        if type(value) is not dict:
            raise _wrong_type(name, value, "a map")
        _check_plain(value)
        return value

    return read


_READERS: dict[Kind, Callable[[str, tuple[int, ...], frozenset[NodeId]], _Reader]] = {
    Kind.VECTOR: _vector,
    Kind.OPTIONAL_VECTOR: _optional_vector,
    Kind.MATRIX: _matrix,
    Kind.IDS: _ids,
    Kind.STEP: _step,
    Kind.HISTORY: _history,
    Kind.TEXT: _text,
    Kind.MAP: _map,
}
