"""The report of a long run: the verdict, figures over time, and what every process used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from zfusion.model.types import Array
from zfusion.report.figures import soak as figure
from zfusion.report.figures.quantities import shown
from zfusion.report.figures.style import Picture
from zfusion.report.page import Page, Section, Table
from zfusion.studies.soak.growth import HOUR_S, LOGS, QUANTITIES, Growth
from zfusion.studies.soak.samples import Course
from zfusion.swarm.watch import LAUNCHER, NODE, RECORDER, ROUND

REPORT = "report.html"

MIB = 2.0**20

RATES = {"missed": "missed", "late": "late", "lost": "lost", "refused": "refused", "skipped": "skipped steps"}
"""Counters whose growth per second is drawn, and their labels."""


def write_report(
    directory: Path, told: Mapping[str, Any], courses: Sequence[Course], growth: Sequence[Growth], stages: Sequence[str]
) -> Path:
    """Write report.html in `directory`, of what `zfusion soak --json` tells; its path. InputError where that fails."""
    sections = [_in_short(told), _judged(told, growth), _over_time(told, courses, stages), _all(growth), _run(told)]
    summary = (
        f"{len(told['nodes'])} nodes for {_duration(told['elapsed_s'])}, looked at every {shown(told['interval_s'])} s."
    )
    kept = [section for section in sections if section.tables or section.pictures or section.paragraphs]
    return Page(f"Soak {told['run']}", summary, kept).write(directory / REPORT)


def _in_short(told: Mapping[str, Any]) -> Section:
    counts = told["counters"]
    rows = [
        ("verdict", told["verdict"]),
        ("steps", f"{counts['completed']} completed by all nodes together, {counts['skipped']} skipped"),
        ("messages between nodes", f"{counts['received']} in time, {counts['missed']} not there at a deadline"),
        ("of these", f"{counts['late']} late, {counts['lost']} lost on the way, {counts['refused']} refused"),
        ("samples", f"{told['samples']} of {told['processes']} processes"),
    ]
    if told["recording"] is not None:
        rows.append(
            (
                "recording",
                f"{told['recording_bytes'] / MIB:.1f} MiB, {told['recorded']} messages, {counts['unrecorded']} missing",
            )
        )
    if told["unwritten"]:
        rows.append(("samples not written", str(told["unwritten"])))
    return Section("short", "In short", tables=[Table(("", ""), rows)], warnings=list(told["failures"]))


def _judged(told: Mapping[str, Any], growth: Sequence[Growth]) -> Section:
    """Of every quantity the process that grows fastest."""
    worst = []
    for quantity in QUANTITIES:
        of_it = [g for g in growth if g.quantity is quantity]
        worst += sorted(of_it, key=lambda g: (g.grows, g.per_hour.slope), reverse=True)[:1]
    text = (
        f"The first {_duration(told['warm_up_s'])} are not judged. A trend is the median of the slopes between all "
        "pairs of samples (Theil, Sen), with its 95 % interval. A quantity grows where all of that interval lies above "
        "what is tolerated, and what it rose by in the time that is judged is more than chance does."
    )
    table = _growth_table(worst, "Of each quantity, the process in which it grew fastest.")
    return Section("verdict", "Does anything grow?", [text], [table] if worst else [])


def _all(growth: Sequence[Growth]) -> Section:
    return Section("all", "All processes", tables=[_growth_table(growth, "")] if growth else [])


def _growth_table(growth: Sequence[Growth], caption: str) -> Table:
    headings = ("quantity", "of", "start", "end", "per hour", "from", "to", "tolerated", "")
    rows = []
    for g in growth:
        trend, quantity = g.per_hour, g.quantity
        name = f"{quantity.name} [{quantity.unit}]" if quantity.unit else quantity.name
        numbers = (g.start, g.end, trend.slope, trend.low, trend.high, quantity.tolerance)
        rows.append((name, g.process, *(f"{n:.3g}" for n in numbers), "grows" if g.grows else ""))
    return Table(headings, rows, frozenset(range(2, 8)), caption)


def _over_time(told: Mapping[str, Any], courses: Sequence[Course], stages: Sequence[str]) -> Section:
    pictures = [
        Picture(name, title, f"{reading} What is shaded is not judged.", figure.draw(list(panels), told["warm_up_s"]))
        for name, title, reading, panels in _pictures(courses, stages)
    ]
    return Section("time", "Over time", pictures=pictures)


def _pictures(
    courses: Sequence[Course], stages: Sequence[str]
) -> Iterator[tuple[str, str, str, Sequence[figure.Panel]]]:
    band = "Of the nodes the median, and the range from the least to the most."
    memory = [_panel(f"{name} [MiB]", courses, f"{column}_bytes", 1 / MIB) for name, column in _MEMORY]
    yield "memory", "Memory", f"{band} Above, what no file backs; RSS is all that is resident.", memory
    handles = [_panel("descriptors", courses, "fds"), _panel("threads", courses, "threads")]
    yield "handles", "Descriptors and threads", band, handles
    yield "cpu", "Processor", band, [_rates_of_processes("CPU [%]", courses, "cpu_s", 100.0)]
    nodes = [course for course in courses if course.kind == NODE]
    queues = [_line(name, nodes, lambda c, n=name: c.columns[n]) for name in ("ahead", "held", "posted", "notices")]
    yield "queues", "Queues of the nodes", band, [figure.Panel("messages", [q for q in queues if q])]
    yield (
        "lateness",
        "Lateness",
        f"{band} Medians and 99 % quantiles of each interval.",
        [figure.Panel(f"{name} [ms]", _quantiles(nodes, name), logarithmic=True) for name in (ROUND, *stages)],
    )
    rates = [_total(label, nodes, name) for name, label in RATES.items()]
    yield "trouble", "What went wrong", "All nodes together.", [figure.Panel("per second", [r for r in rates if r])]
    disk = [(unit, _of_one(LAUNCHER, courses, column, scale, label)) for column, label, unit, scale in _DISK]
    yield "disk", "Written", "Recording and logs.", [figure.Panel(unit, [line]) for unit, line in disk if line]


_MEMORY = (("memory", "anonymous"), ("RSS", "rss"))

_DISK = (("recording_bytes", "recording", "MiB", 1 / MIB), ("logs_bytes", LOGS.name, "KiB", 1 / 1024))


def _panel(y: str, courses: Sequence[Course], column: str, scale: float = 1.0) -> figure.Panel:
    return figure.Panel(y, _by_kind(courses, lambda course: scale * course.columns[column]))


def _rates_of_processes(y: str, courses: Sequence[Course], column: str, scale: float) -> figure.Panel:
    return figure.Panel(y, _by_kind(courses, lambda course: scale * course.rate(column)))


def _by_kind(courses: Sequence[Course], of: Any) -> list[figure.Line]:
    kinds = ((NODE, "nodes"), (RECORDER, RECORDER), (LAUNCHER, LAUNCHER))
    lines = [_line(label, [course for course in courses if course.kind == kind], of) for kind, label in kinds]
    return [line for line in lines if line]


def _quantiles(nodes: Sequence[Course], name: str) -> list[figure.Line]:
    columns = [(f"{name}_{q}_us", label) for q, label in (("p50", "median"), ("p99", "99 %"))]
    lines = [_line(label, nodes, lambda c, n=column: c.columns[n] / 1000) for column, label in columns]
    return [line for line in lines if line]


def _line(label: str, courses: Sequence[Course], of: Any) -> figure.Line | None:
    """The median over courses, at all times at which any was looked at, with the range."""
    t_s, table = _table(courses, of)
    known = np.isfinite(table).any(axis=0) if len(table) else np.zeros(0, dtype=bool)
    if not known.any():
        return None
    table = table[:, known]
    low, high = (np.nanmin(table, axis=0), np.nanmax(table, axis=0)) if len(table) > 1 else (None, None)
    return figure.Line(label, t_s[known], np.nanmedian(table, axis=0), low, high)


def _total(label: str, courses: Sequence[Course], counter: str) -> figure.Line | None:
    t_s, table = _table(courses, lambda course: course.rate(counter))
    return figure.Line(label, t_s, np.nansum(table, axis=0)) if len(table) else None


def _of_one(kind: str, courses: Sequence[Course], column: str, scale: float, label: str) -> figure.Line | None:
    return _line(label, [c for c in courses if c.kind == kind], lambda course: scale * course.columns[column])


def _table(courses: Sequence[Course], of: Any) -> tuple[Array, Array]:
    """(times, (courses, times)): NaN where a course was not looked at."""
    if not courses:
        return np.zeros(0), np.zeros((0, 0))
    t_s = np.unique(np.concatenate([course.t_s for course in courses]))
    table = np.full((len(courses), len(t_s)), np.nan)
    for row, course in zip(table, courses, strict=True):
        row[np.searchsorted(t_s, course.t_s)] = of(course)
    return t_s, table


def _run(told: Mapping[str, Any]) -> Section:
    text = f"The samples are in {Path(told['samples_file']).name}, the logs in {Path(told['logs']).name}."
    return Section("run", "The run", [text])


def _duration(seconds: float) -> str:
    """``1 h 5 min``, ``90 s``."""
    if not isfinite(seconds) or seconds < 2 * 60:
        return f"{shown(seconds)} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if seconds >= HOUR_S else f"{minutes} min"
