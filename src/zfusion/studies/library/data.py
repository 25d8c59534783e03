"""The readings of the library's motes and the quality of their links, from the published data."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zfusion.errors import InputError
from zfusion.model.types import Array

READINGS = "readings.csv"
LINKS = "links.csv"

PUBLISHED = (
    "the study needs readings.csv and links.csv made of 'Library 1', one of the sensor network data sets that the "
    "Machine Learning Group of the Université Libre de Bruxelles (ULB) has published; docs/library.md says how"
)


@dataclass(frozen=True, eq=False)
class Readings:
    """Temperatures by round (one a minute, the first is number 1) and mote."""

    motes: tuple[int, ...]
    """Ascending."""
    celsius: Array
    """(rounds, motes); NaN where a mote's packet was lost."""

    @property
    def rounds(self) -> int:
        """How many there are."""
        return len(self.celsius)

    def of(self, motes: Sequence[int]) -> Array:
        """The readings of some motes, (rounds, len(motes))."""
        return self.celsius[:, [self.motes.index(mote) for mote in motes]]


@dataclass(frozen=True, slots=True)
class Link:
    """What `node` told of hearing `heard`."""

    node: int
    heard: int
    reports: int
    """How often it told."""
    mean_lqi: float
    """On the scale of the data's publisher, a cost: the less the better (docs/library.md)."""


def load_readings(directory: Path) -> Readings:
    """The readings in `directory`; of a packet that came twice in a round the first counts.

    InputError, naming file and line, for files that are missing or hold something else.
    """
    first: dict[tuple[int, int], float] = {}
    for row in _rows(directory / READINGS, ("node", "sequence", "temperature_c")):
        first.setdefault((row.integer("sequence"), row.integer("node")), row.number("temperature_c"))
    if not first or min(first)[0] < 1:
        raise InputError(f"{directory / READINGS}: expected readings of rounds 1, 2, ... in the column 'sequence'")
    motes = tuple(sorted({mote for _, mote in first}))
    celsius = np.full((max(first)[0], len(motes)), np.nan)
    for (number, mote), temperature in first.items():
        celsius[number - 1, motes.index(mote)] = temperature
    return Readings(motes, celsius)


def load_links(directory: Path) -> list[Link]:
    """The links in `directory`; InputError as in `load_readings`."""
    return [
        Link(row.integer("node"), row.integer("heard_node"), row.integer("reports"), row.number("mean_lqi"))
        for row in _rows(directory / LINKS, ("node", "heard_node", "reports", "mean_lqi"))
    ]


@dataclass(frozen=True, slots=True)
class _Row:
    path: Path
    line: int
    cells: dict[str, str]

    def integer(self, column: str) -> int:
        try:
            return int(self.cells[column])
        except ValueError:
            raise self._wrong(column, "a whole number") from None

    def number(self, column: str) -> float:
        try:
            number = float(self.cells[column])
        except ValueError:
            number = float("nan")
        if not np.isfinite(number):
            raise self._wrong(column, "a number")
        return number

    def _wrong(self, column: str, expected: str) -> InputError:
        return InputError(f"{self.path}, line {self.line}, {column}: expected {expected}, is {self.cells[column]!r}")


def _rows(path: Path, columns: Sequence[str]) -> Iterator[_Row]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, restval="")
            missing = [column for column in columns if column not in (reader.fieldnames or ())]
            if missing:
                raise InputError(f"{path}: has no column {missing[0]!r}: {PUBLISHED}")
            yield from (_Row(path, reader.line_num, cells) for cells in reader)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}: {PUBLISHED}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is not a CSV file in UTF-8: {error}") from None
