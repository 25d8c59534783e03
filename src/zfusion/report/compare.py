"""What a comparison, and a search for the worst network, found, for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.studies.compare import ALL, MEANINGS, Comparison
from zfusion.studies.paired import MEDIAN, Paired
from zfusion.studies.worst import Report

SHOWN_NODES = 32

SAME = 1e-9
"""Numbers that differ by less, relative, differ by rounding."""


def show_comparisons(console: Console, comparisons: Sequence[Comparison]) -> None:
    """Print each: a table by node, and the verdict."""
    for comparison in comparisons:
        console.print(f"A: {escape(comparison.base)}\nB: {escape(comparison.other)}", soft_wrap=True)
        table = Table(title=MEANINGS[comparison.metric], title_justify="left")
        for heading in ("node", "A", "B", "B - A", "95 % CI", "B > A", "sign p"):
            table.add_column(heading, justify="left" if heading == "node" else "right")
        rows = [node for node in comparison.nodes if node != ALL]
        for node in [*rows[:SHOWN_NODES], ALL]:
            table.add_row(escape(node), *_cells(comparison.nodes[node]), end_section=node == rows[:SHOWN_NODES][-1])
        console.print(table)
        if len(rows) > SHOWN_NODES:
            console.print(f"... and {len(rows) - SHOWN_NODES} more nodes (--json has all)")
        if any(one.basis == MEDIAN for one in comparison.nodes.values()):
            console.print("m: of the median, as single pairs outweigh all others")
        console.print(f"[bold]{escape(comparison.verdict)}[/]", soft_wrap=True)


def _cells(one: Paired) -> tuple[str, ...]:
    mark = " m" if one.basis == MEDIAN else ""
    interval = "-" if one.interval is None else f"{one.interval[0]:.3g} .. {one.interval[1]:.3g}{mark}"
    return (
        f"{one.a:.5g}",
        f"{one.b:.5g}",
        f"{one.difference:.3g}",
        interval,
        f"{one.above}/{one.n}",
        f"{one.sign_p:.2g}",
    )


def show_worst(console: Console, report: Report, witness: Path | None) -> None:
    """Print what the worst network does, beside random ones and none."""
    console.print(f"[bold]{report.objective} mean squared error[/]   {report.chosen} of {report.sent} messages chosen")
    table = Table()
    for heading in ("network", "mean squared error", "more than nothing"):
        table.add_column(heading, justify="left" if heading == "network" else "right")
    random = f"random, mean of {report.repetitions}"
    rows = {"nothing chosen": report.nothing, random: report.random_mean, "random, worst": report.random_highest}
    for name, value in {**rows, "worst found": report.worst}.items():
        table.add_row(name, f"{value:.6g}", f"{value / report.nothing - 1:+.2%}")
    console.print(table)
    console.print("not reached: " + ", ".join(f"{node}: {n}" for node, n in report.by_receiver.items() if n))
    ended = "nothing can be worse: all choices were looked at" if report.exact else "there may be worse"
    out_of_time = ", the search ran out of time" if report.ran_out else ""
    console.print(f"{report.looked_at} choices looked at; {ended}{out_of_time}", soft_wrap=True)
    if abs(report.searched - report.worst) > SAME * report.worst:
        by_recursion = f"the search expected {report.searched:.6g}: what is waited for makes other messages late"
        console.print(by_recursion, soft_wrap=True)
    if witness is not None:
        console.print(f"witness: {witness}   (zfusion simulate ... --links {witness})", soft_wrap=True)
