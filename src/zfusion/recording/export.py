"""Taking the numbers out of a recording, for other tools: CSV, JSON lines, NumPy.

csv     tidy: one row per message and component; all that is not a vector or matrix is one row, as JSON
jsonl   one JSON object per message, as it was on the wire
npz     one array per topic and numeric field, (messages, ...), named <node>/<stage>/<field>; NaN where a
        measurement was nil. What is not numbers is left out.
"""

from __future__ import annotations

import csv
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from zfusion import keys
from zfusion.errors import InputError, MessageError
from zfusion.messages import decode_any
from zfusion.recording.paths import refuse_to_replace, written_whole
from zfusion.recording.reader import Recording
from zfusion.stages import BUILT_IN, HEADER, Kind, Stage

CSV_COLUMNS = (
    "log_time_ns", "t_ns", "node", "stage", "step", "born", "seq", "field", "row", "column", "value",
)  # fmt: skip

_NOT_COMPONENTS = frozenset((*HEADER, "shape"))


@dataclass(frozen=True, slots=True)
class Exported:
    """What an export did."""

    messages: int
    """Messages that were exported."""
    unreadable: int
    """Messages that were left out, because they are not maps that JSON can say."""
    left_out: tuple[str, ...] = ()
    """Fields (<node>/<stage>/<field>) that the format has no place for."""


class _Decoded(NamedTuple):
    topic: str
    node: str
    stage: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    payload: dict[str, Any]


def export(
    recording: Recording,
    target: str | os.PathLike[str],
    format: str,
    *,
    topics: Iterable[str] | None = None,
    start_ns: int = 0,
    end_ns: int = 2**64,
    stages: Iterable[Stage] = (),
) -> Exported:
    """Write the messages of `recording`, or those chosen as in `Recording.records`, to `target`; replaces it.

    `stages` are the method's beside the built-in ones: they say which fields are matrices. InputError for a format
    that is not one of `FORMATS`, if `target` is the recording itself, and if it cannot be written; RunError if not to
    its end: nothing is left of it then.
    """
    if format not in FORMATS:
        raise InputError(f"export format {format!r}: expected one of {', '.join(FORMATS)}")
    refuse_to_replace(Path(target), recording.not_to_replace)
    source = _Source(recording, topics, start_ns, end_ns)
    matrices = {
        (stage.name, field.name)
        for stage in (*BUILT_IN, *stages)
        for field in stage.fields
        if field.kind is Kind.MATRIX
    }
    with written_whole(Path(target)) as half:
        left_out = FORMATS[format](source, half, matrices)
    return Exported(source.messages, source.unreadable, left_out)


class _Source:
    """The decoded messages, counted as they go by."""

    def __init__(self, recording: Recording, topics: Iterable[str] | None, start_ns: int, end_ns: int) -> None:
        self._records = recording.records(topics, start_ns, end_ns)
        self.messages = 0
        self.unreadable = 0

    def __iter__(self) -> Iterator[_Decoded]:
        names: dict[str, tuple[str, str]] = {}
        for topic, data, log_time_ns, publish_time_ns, sequence in self._records:
            try:
                payload = decode_any(data)
            except MessageError:
                self.unreadable += 1
                continue
            self.messages += 1
            if topic not in names:
                names[topic] = _names(topic)
            node, stage = names[topic]
            yield _Decoded(topic, node, stage, log_time_ns, publish_time_ns, sequence, payload)


def _names(topic: str) -> tuple[str, str]:
    """(node, stage) of a topic; of one that is none of zfusion's: nobody, and the topic."""
    try:
        key = keys.parse(topic)
    except MessageError:
        return "", topic
    return key.node or "", key.stage


_Matrices = set[tuple[str, str]]


def _to_csv(source: _Source, target: Path, matrices: _Matrices) -> tuple[str, ...]:
    with target.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(CSV_COLUMNS)
        for message in source:
            payload = message.payload
            counters = [payload.get(name) for name in ("step", "born", "seq")]
            head = [message.log_time_ns, message.publish_time_ns, message.node, message.stage, *counters]
            for name, value in payload.items():
                if name not in _NOT_COMPONENTS:
                    columns = _columns(payload) if (message.stage, name) in matrices else None
                    table.writerows([*head, name, *cell] for cell in _cells(value, columns))
    return ()


def _cells(value: object, columns: int | None) -> Iterator[tuple[object, object, object]]:
    """(row, column, value) of the components of a vector or, with so many columns, matrix; else of the whole."""
    if _is_vector(value):
        for number, entry in enumerate(value):
            yield (number // columns, number % columns, entry) if columns else (number, "", entry)
    elif value is None:
        yield "", "", ""
    else:
        yield "", "", value if isinstance(value, (str, int, float)) else _json(value)


def _columns(payload: Mapping[str, Any]) -> int | None:
    """The number of columns that a payload says its matrix has, if it says so."""
    match payload.get("shape"):
        case [int(), int(columns)] if columns > 0:
            return columns
    return None


def _is_vector(value: object) -> TypeGuard[list[float]]:
    return isinstance(value, list) and bool(value) and all(isinstance(entry, float) for entry in value)


def _to_jsonl(source: _Source, target: Path, _matrices: _Matrices) -> tuple[str, ...]:
    with target.open("w", encoding="utf-8") as file:
        for message in source:
            file.write(
                _json(
                    {
                        "topic": message.topic,
                        "log_time_ns": message.log_time_ns,
                        "publish_time_ns": message.publish_time_ns,
                        "sequence": message.sequence,
                        "message": message.payload,
                    }
                )
            )
            file.write("\n")
    return ()


def _json(value: object) -> str:
    """`value` as JSON, which has no NaN and no infinity: null stands for them."""
    try:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    except ValueError:
        return json.dumps(_without_nan(value), allow_nan=False, ensure_ascii=False)


def _without_nan(value: object) -> object:
    if isinstance(value, dict):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def _to_npz(source: _Source, target: Path, matrices: _Matrices) -> tuple[str, ...]:
    fields: dict[str, list[object]] = {}
    messages: Counter[str] = Counter()
    for message in source:
        prefix = f"{message.node}/{message.stage}" if message.node else message.stage
        messages[prefix] += 1
        for name, value in (*message.payload.items(), ("log_time_ns", message.log_time_ns)):
            if name not in ("v", "node", "shape"):
                columns = _columns(message.payload) if (message.stage, name) in matrices else None
                fields.setdefault(f"{prefix}/{name}", []).append(_as_array(value, columns))
    arrays = {name: _stack(values, messages[name.rpartition("/")[0]]) for name, values in fields.items()}
    kept: dict[str, Any] = {name: array for name, array in arrays.items() if array is not None}
    with target.open("wb") as file:
        np.savez(file, **kept)
    return tuple(name for name in arrays if name not in kept)


def _as_array(value: object, columns: int | None) -> object:
    """A vector as an array, with so many columns as a matrix; everything else as it is."""
    if not _is_vector(value):
        return value
    array = np.array(value)
    return array.reshape(-1, columns) if columns and array.size % columns == 0 else array


def _stack(values: list[Any], messages: int) -> np.ndarray[Any, Any] | None:
    """The values of a field, one from each message; None if they are not numbers of one shape."""
    if len(values) != messages:
        return None
    if all(type(value) is int and abs(value) < 2**63 for value in values):
        return np.array(values, dtype=np.int64)
    shapes = {value.shape for value in values if isinstance(value, np.ndarray)}
    if len(shapes) != 1 or not all(value is None or isinstance(value, np.ndarray) for value in values):
        return None
    missing = np.full(shapes.pop(), np.nan)
    return np.array([missing if value is None else value for value in values])


FORMATS: dict[str, Callable[[_Source, Path, _Matrices], tuple[str, ...]]] = {
    "csv": _to_csv,
    "jsonl": _to_jsonl,
    "npz": _to_npz,
}
"""The formats by name; each is also the usual suffix of its files."""
