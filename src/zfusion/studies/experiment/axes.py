"""What an experiment varies: axes, their values, and the points that come of them.

An axis is a dotted path into the scenario's document ("links.delay", "sensors[2].R") and a list of values. Axes form a
grid; those of a `zip` group go together, value by value; `points` lists combinations one by one. Order is that of the
file, with the last axis varying fastest.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from typing import Any

from zfusion.errors import Problem
from zfusion.model.schema.problems import Faults

Label = str | int | float | bool
"""What stands for a value in tables and figures: the value itself, or the name of a table or list."""

ZIP, POINTS = "zip", "points"
"""Keys among the axes that are none."""

LABEL = "label."
"""What begins so sets nothing: a column of the tables that says in a number or word what a point is."""

PATH = re.compile(r"[^.\[\]]+(\.[^.\[\]]+|\[\d+\])*")


@dataclass(frozen=True, slots=True)
class Value:
    """One value of an axis, and the label that stands for it."""

    label: Label
    value: Any


@dataclass(frozen=True, slots=True)
class Block:
    """Axes that vary together: one, a zip group, or the list of points."""

    paths: tuple[str, ...]
    rows: tuple[tuple[Value, ...], ...]
    places: tuple[str, ...]
    """Where in the file each path's values are, to say what is wrong with one."""


Choice = tuple[tuple[str, Value], ...]
"""A value for every axis, in the order of the axes."""


def blocks_of(axes: Mapping[str, Any]) -> tuple[Block, ...]:
    """The axes that a table `[axes]` describes. Raises Faults with all that is wrong, relative to that table."""
    problems: list[Problem] = []
    blocks: list[Block] = []
    for name, content in axes.items():
        if name == POINTS:
            blocks += _points(content, problems)
        elif name == ZIP:
            blocks += _zipped(content, problems)
        else:
            blocks += (
                Block((path,), tuple((value,) for value in values), (quoted(path),))
                for path, values in _listed(name, content, "", problems)
            )
    problems += _clashes(blocks)
    problems += (problem for block in blocks for problem in _twice(block))
    if problems:
        raise Faults(problems)
    return tuple(blocks)


def paths_of(blocks: Iterable[Block]) -> tuple[str, ...]:
    """All axes, in order."""
    return tuple(path for block in blocks for path in block.paths)


def choices(blocks: Sequence[Block]) -> Iterator[Choice]:
    """A value for every axis, for every point: one point without any where there are no axes."""
    for rows in product(*(block.rows for block in blocks)):
        yield tuple(
            (path, value)
            for block, row in zip(blocks, rows, strict=True)
            for path, value in zip(block.paths, row, strict=True)
        )


def with_values(document: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a document with other values at these paths; tables that are not there are made.

    Raises Faults, with the path as field, for one that leads through something that is no table or list.
    """
    changed = deepcopy(dict(document))
    setting = {path: value for path, value in values.items() if not path.startswith(LABEL)}
    problems = [problem for path, value in setting.items() if (problem := _put(changed, path, value)) is not None]
    if problems:
        raise Faults(problems)
    return changed


def keys_of(path: str) -> list[str | int]:
    """``sensors[2].R`` and ``sensors.2.R`` as ["sensors", 2, "R"]: numbers are places in a list, from 0."""
    parts = re.split(r"[.\[]", path.replace("]", ""))
    return [int(part) if part.isdecimal() else part for part in parts]


def is_path(text: str) -> bool:
    """Whether it is written as a path."""
    return PATH.fullmatch(text) is not None


def _put(document: dict[str, Any], path: str, value: Any) -> Problem | None:
    place: Any = document
    *way, last = keys_of(path)
    for key in way:
        if isinstance(place, dict):
            place = place.setdefault(str(key), {})
        elif _holds(place, key):
            place = place[key]
        else:
            return Problem(path, value, f"names nothing: there is no {key!r} in a {_kind(place)}")
    if isinstance(place, dict):
        place[str(last)] = deepcopy(value)
    elif _holds(place, last):
        place[last] = deepcopy(value)
    else:
        return Problem(path, value, f"names nothing: there is no {last!r} in a {_kind(place)}")
    return None


def _holds(place: object, key: str | int) -> bool:
    return isinstance(place, list) and isinstance(key, int) and key < len(place)


def _kind(place: object) -> str:
    return f"list of {len(place)}" if isinstance(place, list) else f"value like {place!r}"


def _listed(name: str, content: Any, within: str, problems: list[Problem]) -> Iterator[tuple[str, tuple[Value, ...]]]:
    """The axes below a key: one, or, where somebody wrote ``links.delay`` without quotes, those of a table."""
    path = f"{within}.{name}" if within else name
    if isinstance(content, Mapping) and content:
        for key, inner in content.items():
            yield from _listed(key, inner, path, problems)
    elif not is_path(path):
        problems.append(Problem(quoted(path), content, "expected a path like 'links.delay' or 'sensors[2].R'"))
    elif not isinstance(content, list) or not content:
        problems.append(Problem(quoted(path), content, "expected a list of at least one value"))
    else:
        values = tuple(_value(item) for item in content)
        yield path, values


def _value(item: Any) -> Value:
    """A value as written: a table's `label` is not part of it, and {label, value} labels what is no table."""
    if isinstance(item, Mapping) and isinstance(item.get("label"), str):
        rest = {key: inner for key, inner in item.items() if key != "label"}
        return Value(item["label"], rest["value"] if set(rest) == {"value"} else rest)
    if isinstance(item, str | int | float | bool):
        return Value(item, item)
    return Value(json.dumps(item, separators=(", ", ": ")), item)


def _twice(block: Block) -> Iterator[Problem]:
    """Rows of which the tables could not tell one from the other."""
    seen: set[tuple[tuple[type, Label], ...]] = set()
    for number, row in enumerate(block.rows):
        labels = tuple((type(value.label), value.label) for value in row)
        if labels in seen:
            told = [value.label for value in row]
            expected = "expected values, or labels, that differ from those before"
            yield Problem(f"{block.places[0]}[{number}]", told[0] if len(told) == 1 else told, expected)
        seen.add(labels)


def _zipped(content: Any, problems: list[Problem]) -> Iterator[Block]:
    """The groups of `[[axes.zip]]`."""
    if not isinstance(content, list) or not all(isinstance(group, Mapping) for group in content):
        problems.append(Problem(ZIP, content, "expected tables: [[axes.zip]]"))
        return
    for number, group in enumerate(content):
        place, own = f"{ZIP}[{number}]", list[Problem]()
        axes = [axis for name, inner in group.items() for axis in _listed(name, inner, "", own)]
        lengths = {path: len(values) for path, values in axes}
        if not own and len(set(lengths.values())) != 1:
            own.append(Problem("", lengths, "expected lists that are equally long"))
        problems.extend(Problem(_below(place, p.field), p.value, p.expected) for p in own)
        if not own:
            paths = tuple(path for path, _ in axes)
            rows = tuple(zip(*(values for _, values in axes), strict=True))
            yield Block(paths, rows, tuple(_below(place, quoted(path)) for path in paths))


def _points(content: Any, problems: list[Problem]) -> Iterator[Block]:
    """The combinations of `[[axes.points]]`."""
    if not isinstance(content, list) or not content or not all(isinstance(p, Mapping) and p for p in content):
        problems.append(Problem(POINTS, content, "expected tables with a value for every axis: [[axes.points]]"))
        return
    paths = tuple(content[0])
    wrong = [Problem(f"{POINTS}[0].{quoted(path)}", path, "expected a path") for path in paths if not is_path(path)]
    for number, point in enumerate(content):
        if set(point) != set(paths):
            wrong.append(Problem(f"{POINTS}[{number}]", list(point), f"expected the axes {', '.join(paths)}"))
    problems.extend(wrong)
    if not wrong:
        rows = tuple(tuple(_value(point[path]) for path in paths) for point in content)
        yield Block(paths, rows, tuple(f"{POINTS}.{quoted(path)}" for path in paths))


def _clashes(blocks: Iterable[Block]) -> Iterator[Problem]:
    """Axes that set the same, or of which one sets part of what another does."""
    seen: dict[str, list[str | int]] = {}
    for block in blocks:
        for path, place in zip(block.paths, block.places, strict=True):
            keys = keys_of(path)
            for other, others in seen.items():
                if keys[: len(others)] == others or others[: len(keys)] == keys:
                    yield Problem(place, path, f"expected each thing to vary once: the axis {other} sets it, too")
            if path == "seed":
                yield Problem(place, path, "expected the seeds in [experiment], as every point is run with all of them")
            seen[path] = keys


def quoted(path: str) -> str:
    """The path as a key of a TOML file."""
    return path if "." not in path else f'"{path}"'


def _below(place: str, field: str) -> str:
    return f"{place}.{field}" if field else place
