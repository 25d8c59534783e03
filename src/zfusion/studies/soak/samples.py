"""The samples of a long run, as they are on its CSV file."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zfusion.errors import InputError
from zfusion.model.types import Array
from zfusion.swarm.watch import NODE


@dataclass(frozen=True, slots=True)
class Course:
    """One life of one process."""

    kind: str
    process: str
    t_s: Array
    """When it was looked at, (n,)."""
    columns: Mapping[str, Array]
    """By column, (n,); NaN where nothing was told."""

    @property
    def name(self) -> str:
        """In words."""
        return f"node {self.process}" if self.kind == NODE else self.process

    def rate(self, column: str) -> Array:
        """How fast a counter grows, per second, from each sample to the next, (n,); NaN at the first."""
        rates = np.full(len(self.t_s), np.nan)
        rates[1:] = np.diff(self.columns[column]) / np.diff(self.t_s)
        return rates


def read_samples(path: Path) -> list[Course]:
    """The courses of all lives in a file that `Watch` wrote, the last line of which may be cut off.

    InputError where it cannot be read or is none.
    """
    lives: dict[tuple[str, str, str], list[list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(file)
            names = next(rows, [])
            if names[:4] != ["t_s", "kind", "process", "pid"]:
                raise InputError(f"{path}: are no samples of a soak")
            for row in rows:
                if len(row) == len(names):
                    lives.setdefault((row[1], row[2], row[3]), []).append([_number(c) for c in (row[0], *row[4:])])
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8: {error}") from None
    courses = []
    for (kind, process, _), found in lives.items():
        table = np.array(found)
        columns = dict(zip(names[4:], table[:, 1:].T, strict=True))
        courses.append(Course(kind, process, table[:, 0], columns))
    return courses


def longest_lives(courses: Iterable[Course]) -> list[Course]:
    """Of each process, the life with the most samples."""
    longest: dict[tuple[str, str], Course] = {}
    for course in courses:
        key = course.kind, course.process
        if key not in longest or len(course.t_s) > len(longest[key].t_s):
            longest[key] = course
    return list(longest.values())


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
