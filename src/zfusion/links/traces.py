"""Delays that were measured: read from a file before anything starts."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

import numpy as np

from zfusion.errors import InputError
from zfusion.model.types import Array


def read_trace(path: str, column: str | None) -> Array:
    """The delays in a file, in seconds, (n,), n >= 1: one a line, or those of a column of a CSV file with a header.

    Lines that are empty or begin with "#" are left out. InputError, naming file and line, for a file that cannot be
    read or holds nothing, a column that is not there, and what is not a number >= 0.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            cells = list(_lines(file) if column is None else _cells(file, path, column))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is not text in UTF-8, one value a line or CSV: {error}") from None
    if not cells:
        raise InputError(f"{path}: expected delays, one a line at least")
    return np.array([_seconds(path, line, cell) for line, cell in cells])


def _lines(file: Iterator[str]) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(file, 1):
        text = line.strip()
        if text and not text.startswith("#"):
            yield number, text


def _cells(file: Iterator[str], path: str, column: str) -> Iterator[tuple[int, str]]:
    reader = csv.DictReader((line for line in file if not line.startswith("#")), restval="", skipinitialspace=True)
    names = reader.fieldnames or ()
    if column not in names:
        raise InputError(f"{path}: has no column {column!r}; it has {', '.join(names) or 'nothing'}")
    for row in reader:
        yield reader.line_num, row[column].strip()


def _seconds(path: str, line: int, cell: str) -> float:
    try:
        seconds = float(cell)
    except ValueError:
        seconds = -1.0
    if not isfinite(seconds) or seconds < 0:
        raise InputError(f"{path}, line {line}: expected a delay, a number of seconds >= 0 (is {cell!r})")
    return seconds
