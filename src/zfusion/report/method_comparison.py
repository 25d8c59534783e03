"""Which method for this network: what a comparison of methods found, for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.errors import InputError
from zfusion.studies.compare import ALL
from zfusion.studies.intervals import Interval
from zfusion.studies.method_comparison import BELIEVED, MethodComparison, Standing

SHOWN_NODES = 8
"""Columns of a table that fit."""


def show_methods(console: Console, found: MethodComparison, figures: Sequence[Path] = ()) -> None:
    """Print the table of methods, errors by node, who could not stand the scenario, and what is to be known."""
    plural = {"seed": "seeds", "stretch": "stretches"}[found.unit]
    console.print(f"[bold]{escape(found.scenario)}[/]   {found.steps} steps, {found.units} {plural}")
    for table in (_errors(found), _costs(found), _by_node(found)):
        console.print(table)
    for label, reason in found.refused.items():
        console.print(f"cannot stand it: [bold]{escape(label)}[/]: {escape(reason)}", soft_wrap=True)
    for standing in found.standings:
        if standing.against is not None:
            console.print(f"{escape(standing.label)}: {escape(standing.against.verdict)}", soft_wrap=True)
    for note in dict.fromkeys(standing.note for standing in found.standings if standing.note):
        console.print(f"note: {escape(note)}", soft_wrap=True)
    how = "as predicted" if found.best == found.centralized else "on these measurements"
    console.print(
        f"above best: by how much the error exceeds that of a centre with all measurements, {found.best:.4g} {how}. "
        f"nees: 1 where P is right; believed if that is so within {BELIEVED:.0%}. CPU: on this machine, now.",
        soft_wrap=True,
    )
    if any(standing.heavy_tailed for standing in found.standings):
        console.print(
            "matrices are random: rare large errors make up much of the means, and few seeds miss them; "
            "go by the pairs, and by centralized among the methods",
            soft_wrap=True,
        )
    for figure in figures:
        console.print(f"figure: {escape(str(figure))}", soft_wrap=True)


def _errors(found: MethodComparison) -> Table:
    links = any(standing.ideal_mse is not None for standing in found.standings)
    headings = ["mse", "above best", *(["ideal network"] if links else []), "nees", "believed"]
    table = _table("mean squared error", headings)
    for one in found.standings:
        ideal = [] if not links else ["-" if one.ideal_mse is None else f"{one.ideal_mse.mean:.4g}"]
        above = f"{one.mse.mean / found.best - 1:+.0%}"
        nees = "-" if one.nees is None else f"{one.nees.mean:.3g}"
        table.add_row(escape(one.label), _with_margin(one.mse), above, *ideal, nees, one.believed)
    return table


def _costs(found: MethodComparison) -> Table:
    table = _table("what a step costs", ["rounds", "messages", "bytes", "CPU µs a node (timing)"])
    for one in found.standings:
        sent = (f"{one.messages:,.4g}", f"{one.bytes:,.0f}", f"{one.cpu_us:.0f}")
        table.add_row(escape(one.label), str(one.rounds), *sent)
    return table


def _by_node(found: MethodComparison) -> Table:
    nodes = [node for node in found.local if node != ALL]
    shown = nodes[:SHOWN_NODES]
    table = _table("mean squared error by node", [escape(node) for node in shown])
    for n, one in enumerate(found.standings):
        last = n == len(found.standings) - 1
        table.add_row(escape(one.label), *(_of_node(one, node) for node in shown), end_section=last)
    table.add_row("alone, predicted", *(f"{found.local[node]:.4g}" for node in shown))
    table.add_row("centre, predicted", *(f"{found.centralized:.4g}" for _ in shown))
    if len(shown) < len(nodes):
        table.caption = f"... and {len(nodes) - len(shown)} more nodes (--json has all)"
    return table


def _table(title: str, headings: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("method")
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def _of_node(one: Standing, node: str) -> str:
    return f"{one.by_node[node]:.4g}" if node in one.by_node else "-"


def _with_margin(interval: Interval) -> str:
    if interval.low is None or interval.high is None:
        return f"{interval.mean:.4g}"
    return f"{interval.mean:.4g} ± {(interval.high - interval.low) / 2:.1g}"


def save_figures(found: MethodComparison, directory: Path) -> list[Path]:
    """Draw the comparison into a directory, as SVG and PNG; the SVG files. InputError where it cannot be written."""
    from zfusion.report.figures.methods import pictures  # noqa: PLC0415 - matplotlib is an extra

    try:
        return [picture.save(directory)[0] for picture in pictures(found)]
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from None
