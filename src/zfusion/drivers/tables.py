"""Measurements that are kept in a file: a CSV table, or a recording. Read as a whole, by step."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import floor, isinf, isnan
from pathlib import Path
from typing import cast

import numpy as np

from zfusion import keys
from zfusion.errors import InputError, MessageError
from zfusion.messages import Decoder
from zfusion.model.schema.run import CsvSource
from zfusion.model.types import Array, NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import MEASUREMENT, TRUTH, TRUTH_SENDER

ByStep = dict[int, Array]


@dataclass(frozen=True, slots=True)
class _Row:
    """One row of a CSV file."""

    file: str
    line: int
    cells: dict[str, str]

    def wrong(self, column: str, expected: str) -> InputError:
        return InputError(f"{self.file}, line {self.line}, column {column}: {expected}, is {self.cells[column]!r}")


def csv_measurements(spec: CsvSource, node: NodeId) -> ByStep:
    """The sensor's measurements, (ny,), by step, from a file as `CsvSource` describes it.

    A row with an empty cell (or NaN) in one of the columns is no reading. InputError, naming file and line, for a
    file that cannot be read, a column that is not there, a cell that is no number, and two rows for one step.
    """
    step_of = _step_by_time(spec) if spec.time_column is not None else _step_by_row(spec)
    measurements: ByStep = {}
    lines: dict[int, int] = {}
    for row in _rows(spec, node):
        step = step_of(row)
        if step < 1:
            continue
        if step in lines and spec.time_column is None:
            raise InputError(f"{row.file}, line {row.line}: a second row for step {step}, after line {lines[step]}")
        lines[step] = row.line
        cells = [_number(row, column) for column in spec.columns]
        if not any(map(isnan, cells)):
            measurements[step] = np.array(cells)
    return measurements


def recorded_measurements(path: str, node: NodeId, ny: int, nx: int) -> tuple[ByStep, ByStep, int]:
    """The sensor's measurements, the true states, (nx,), where they are recorded, and how many messages were refused.

    Of two messages of one step the first counts, as it did for whoever heard them. RecordingError for a file that
    is no recording, InputError for one that has nothing of this sensor, or nothing that this sensor could measure.
    """
    with Recording.open(path) as recording:
        run = recording.metadata["run"]
        topic = keys.stage_key(run, node, MEASUREMENT.name)
        if topic not in recording.topics:
            raise InputError(f"{path}: has no measurements of sensor {node}: there is no topic {topic}")
        measurements, refusals = _decoded(
            recording, topic, Decoder(MEASUREMENT, node, sizes={"ny": ny}, beside=True), "y"
        )
        if refusals and not measurements:
            raise InputError(f"{path}: nothing on {topic} can be a measurement of sensor {node}: {refusals[0]}")
        # refused, all of it, where the recorded state has another size than ours
        truths, _ = _decoded(recording, keys.truth_key(run), Decoder(TRUTH, TRUTH_SENDER, sizes={"nx": nx}), "x")
    return measurements, truths, len(refusals)


def _rows(spec: CsvSource, node: NodeId) -> Iterator[_Row]:
    """The rows that are the sensor's, checked to have the columns that are asked for."""
    wanted = [*spec.columns, *filter(None, (spec.id_column, spec.step_column, spec.time_column))]
    try:
        with Path(spec.file).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restval="")
            missing = [column for column in wanted if column not in (reader.fieldnames or ())]
            if missing:
                has = ", ".join(reader.fieldnames or ()) or "nothing"
                raise InputError(f"{spec.file}: has no column {missing[0]!r}; it has {has}")
            for cells in reader:
                if spec.id_column is None or cells[spec.id_column].strip() == str(node):
                    yield _Row(spec.file, reader.line_num, cells)
    except OSError as error:
        raise InputError(f"{spec.file}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{spec.file}: is not a CSV file in UTF-8: {error}") from None


def _step_by_row(spec: CsvSource) -> Callable[[_Row], int]:
    """Step numbers from a column, or by counting the sensor's rows."""
    column, before, counted = spec.step_column, spec.first_step - 1, iter(range(1, 2**63))

    def step_of(row: _Row) -> int:
        if column is None:
            return next(counted) - before
        try:
            return int(row.cells[column]) - before
        except ValueError:
            raise row.wrong(column, "expected a whole number") from None

    return step_of


def _step_by_time(spec: CsvSource) -> Callable[[_Row], int]:
    """The step k with first_time + (k - 1) time_step <= time < first_time + k time_step."""
    column, first, length = cast(str, spec.time_column), cast(float, spec.first_time), cast(float, spec.time_step)

    def step_of(row: _Row) -> int:
        time = _number(row, column)
        if isnan(time):
            raise row.wrong(column, "expected a time")
        return floor((time - first) / length) + 1

    return step_of


def _number(row: _Row, column: str) -> float:
    """The number in a cell; NaN for an empty one."""
    cell = row.cells[column].strip()
    try:
        number = float(cell) if cell else float("nan")
    except ValueError:
        raise row.wrong(column, "expected a number or nothing") from None
    if isinf(number):
        raise row.wrong(column, "expected a finite number or nothing")
    return number


def _decoded(recording: Recording, topic: str, decoder: Decoder, field: str) -> tuple[ByStep, list[str]]:
    """A field of a topic's messages by step, and why messages were refused."""
    values: ByStep = {}
    refusals: list[str] = []
    for record in recording.records([topic]):
        try:
            message = decoder.decode(record.data)
        except MessageError as error:
            refusals.append(str(error))
            continue
        value = message.fields[field]
        if value is not None:
            values.setdefault(message.step, cast(Array, value))
    return values, refusals
