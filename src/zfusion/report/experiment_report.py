"""The report of an experiment: one HTML file with figures, tables, what was run and what failed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from zfusion.errors import InputError
from zfusion.report import experiment_figures as figures
from zfusion.report.figures.quantities import shown
from zfusion.report.figures.style import Picture
from zfusion.report.page import Page, Section, Table, save_pictures
from zfusion.report.results import NOTHING, Point, Results, Value, label_text
from zfusion.stages import ESTIMATE
from zfusion.studies.experiment.catalogue import METRICS

REPORT, FIGURES = "report.html", "figures"

COUNTS = ("missed", "late", "lost", "revised", "fallbacks", "skipped", "restarts")
"""Counters of what went wrong, in the order of their columns."""


def write_report(directory: Path, output: Path | None = None) -> Path:
    """Write the report of the experiment whose results are in `directory`; the path of the HTML file.

    By default that is report.html in the directory; the figures are in `figures` there, as SVG and PNG, in any case.
    InputError where there are no results, or what there is cannot be read, and for a place that cannot be written.
    """
    results = Results(directory)
    page = _page(results)
    save_pictures(page, directory / FIGURES)
    return page.write(output or directory / REPORT)


def _page(results: Results) -> Page:
    facts = results.facts
    sections = [
        _in_short(results),
        _what_was_run(results),
        Section("errors", "Errors", pictures=[*_error_pictures(results)], paragraphs=_no_truth(results)),
        Section("behaviour", "Consistency, use and cost", pictures=[*_other_pictures(results)]),
        Section("network", "Network and latencies", pictures=[*_network_pictures(results)]),
        _tables(results),
        _failures(results),
        _files(results),
    ]
    kept = [s for s in sections if s.pictures or s.tables or s.paragraphs or s.texts or s.warnings]
    size = f"{len(results.points)} conditions, {len(facts['seeds'])} seeds, {facts['runs']} runs"
    summary = f"{size} in the {facts['world']} world."
    return Page(f"Experiment {facts['name']}", f"{summary} {facts.get('description', '')}".strip(), kept)


def _no_truth(results: Results) -> list[str]:
    if results.values("rmse"):
        return []
    return ["There are no errors in the tables: the truth is not known, or the metric was not asked for."]


def _error_pictures(results: Results) -> Iterator[Picture]:
    measure = figures.error_measure(results)
    if measure is not None:
        yield from figures.against_axes(results, measure, figures.MOST_FIGURES)
        yield from figures.heat_maps(results, measure)
    over_time = figures.errors_over_time(results)
    if over_time is not None:
        yield over_time
    for stage in results.stages("rmse"):
        of_stage = figures.error_measure(results, stage)
        if stage != ESTIMATE.name and of_stage is not None:
            yield from figures.against_axes(results, of_stage)


def _other_pictures(results: Results) -> Iterator[Picture]:
    for measure in figures.other_measures(results):
        yield from figures.against_axes(results, measure)


def _network_pictures(results: Results) -> Iterator[Picture]:
    graphs = figures.networks(results)
    if graphs is not None:
        yield graphs
    yield from figures.latencies_by_edge(results)


def _in_short(results: Results) -> Section:
    """The main findings, in sentences."""
    errors = {p: v for p, v in results.values("rmse").items() if isfinite(v.mean)}
    points = {point.number: point for point in results.points}
    said = []
    if errors:
        best, worst = (choose(errors, key=lambda p: errors[p].mean) for choose in (min, max))
        said.append(
            "The root mean squared error of the final estimates, in units of the state, goes from "
            f"{_interval(errors[best])} ({_where(results, points[best])}) to {_interval(errors[worst])} "
            f"({_where(results, points[worst])})."
            if best != worst
            else f"The root mean squared error of the final estimates is {_interval(errors[best])} units of the state."
        )
    excess = [v for v in results.values("excess_mse").values() if isfinite(v.low)]
    if excess:
        agree = sum(v.low <= 0 <= v.high for v in excess)
        said.append(
            f"In {agree} of {len(excess)} conditions the mean squared error agrees with what the nodes predicted, "
            f"within the {results.facts['confidence']:.0%} interval over the seeds; by chance alone, about "
            f"{1 - results.facts['confidence']:.0%} of them would not."
        )
    fallbacks = sum(v.mean for v in results.total("fallbacks").values())
    if fallbacks:
        said.append(f"There were fallbacks, {shown(fallbacks)} in the mean over the seeds, all conditions together.")
    failed = results.facts["failed"]
    warnings = [f"Failed runs: {len(failed)} of {results.facts['runs']}; they are in no number here."] if failed else []
    return Section("short", "In short", said, warnings=warnings)


def _where(results: Results, point: Point) -> str:
    return point.words(results.axes) or "the scenario as it is"


def _what_was_run(results: Results) -> Section:
    facts = results.facts
    made_on = facts.get("made_on", {})
    seeds = facts["seeds"]
    rows = [
        ("experiment", facts["name"] + (", in its small size" if facts.get("small") else "")),
        ("world", facts["world"]),
        ("conditions", str(len(results.points))),
        ("seeds", _seeds(seeds)),
        ("runs", f"{facts['runs']}, of which {len(facts['failed'])} failed"),
        ("steps left out of averages", f"the first {facts.get('burn_in', 0)}"),
        ("intervals", f"{facts['confidence']:.0%}, Student's t over the seeds"),
        ("SHA-256 of the file", _hash(results.directory / "experiment.toml")),
        ("made with", ", ".join(f"{name} {value}" for name, value in made_on.items())),
    ]
    axes = Table(
        ("axis", "values", "follows"),
        [
            (a.path, ", ".join(map(label_text, a.labels)), ", ".join(results.follows.get(a.path, ())))
            for a in results.all_axes
        ],
        caption="What was varied",
    )
    return Section("run", "What was run", tables=[Table(("", ""), rows), *([axes] if results.all_axes else [])])


def _seeds(seeds: list[int]) -> str:
    if len(seeds) > 1 and seeds == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} to {seeds[-1]} ({len(seeds)})"
    return ", ".join(map(str, seeds))


def _hash(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return "the file is not there"


def _tables(results: Results) -> Section:
    """The main numbers of every condition."""
    axes = [axis.path for axis in results.all_axes]
    tables: list[Table] = []
    columns = [
        ("rmse", results.values("rmse")),
        ("predicted", figures.rooted(results.values("predicted_mse"))),
        ("mse − predicted mse", results.values("excess_mse")),
        ("centralised", figures.rooted(results.values("bound_centralized"))),
        ("no network", figures.rooted(results.values("bound_local"))),
        ("NEES", results.values("nees")),
        ("disagreement", results.values("disagreement")),
    ]
    tables += _table(results, axes, columns, "Errors of the final estimates: means and intervals over the seeds")
    used = [(f"used, {stage}", results.values("used_fraction", stage)) for stage in results.stages("used_fraction")]
    counts = [(name, results.total(name)) for name in COUNTS]
    caption = "What was used, and what went wrong: means over the seeds of the counts of a whole run"
    tables += _table(results, axes, [*used, *counts], caption)
    meanings = [(name, METRICS[name].unit, METRICS[name].meaning) for name in METRICS if _is_there(results, name)]
    glossary = Table(("metric", "unit", "meaning"), meanings, caption="What the metrics are")
    note = "All numbers by run, node and stage are in results.csv and results.parquet beside this file."
    return Section("tables", "Tables", [note], [*tables, glossary])


def _table(
    results: Results, axes: list[str], columns: list[tuple[str, figures.Values]], caption: str
) -> Iterator[Table]:
    columns = [(name, values) for name, values in columns if values]
    if not columns:
        return
    rows = [
        (
            *(label_text(point.labels[path]) for path in axes),
            *(_interval(values.get(point.number, NOTHING)) for _, values in columns),
        )
        for point in results.points
    ]
    headings = (*axes, *(name for name, _ in columns))
    yield Table(headings, rows, frozenset(range(len(axes), len(headings))), caption)


def _is_there(results: Results, metric: str) -> bool:
    return bool(results.stages(metric)) or (metric == "rounds_per_s" and bool(results.timings))


def _interval(value: Value) -> str:
    """``1.23 [1.2, 1.26]``."""
    if isfinite(value.low) and isfinite(value.high) and value.low < value.high:
        return f"{shown(value.mean)} [{shown(value.low)}, {shown(value.high)}]"
    return shown(value.mean)


def _failures(results: Results) -> Section:
    failed = results.facts["failed"]
    if not failed:
        return Section("failures", "Failed runs", ["No run failed."])
    rows = [
        (str(f.get("run", "")), str(f.get("point", "")), "theory" if f.get("seed") is None else str(f["seed"]),
         str(f.get("error", "")))
        for f in failed
    ]  # fmt: skip
    note = "They are in no mean and no interval. The same command tries them again."
    return Section("failures", "Failed runs", [note], [Table(("run", "condition", "seed", "why"), rows)])


def _files(results: Results) -> Section:
    path = results.directory / "experiment.toml"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    return Section("file", "The experiment's file", texts=[(path.name, text)])
