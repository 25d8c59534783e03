"""How an experiment went, for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from zfusion.studies.experiment.run import Outcome

SHOWN_POINTS = 40
"""Points that the table on a terminal has; all are in the files."""

SHOWN_FAILURES = 10

SHOWN = {"mse": "mse", "predicted_mse": "predicted", "nees": "nees", "fallbacks": "fallbacks"}
"""Metrics of the final estimates that the table has, and their headings."""


class ProgressBar:
    """A bar that shows how many runs are done and how long the others will take."""

    def __init__(self, console: Console, name: str, *, enabled: bool) -> None:
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
            TextColumn("{task.fields[failed]}"), TimeElapsedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        self._bar = Progress(*columns, console=console, disable=not enabled)
        self._task = self._bar.add_task(escape(name), total=None, failed="")
        self._failed = 0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def begin(self, total: int, done: int) -> None:
        """See `studies.experiment.run.Progress`."""
        self._bar.update(self._task, total=total, completed=done)

    def advance(self, failed: bool) -> None:
        """See `studies.experiment.run.Progress`."""
        self._failed += failed
        told = f"[red]{self._failed} failed[/]" if self._failed else ""
        self._bar.update(self._task, advance=1, failed=told)


def show_outcome(console: Console, outcome: Outcome, report: Path | None) -> None:
    """How it went, what came out at every point, and where all of it is."""
    if outcome.headlines:
        console.print(_table(outcome))
        if len(outcome.headlines) > SHOWN_POINTS:
            console.print(f"... and {len(outcome.headlines) - SHOWN_POINTS} more points")
    missing = outcome.runs - outcome.reused - outcome.done
    console.print(
        f"{outcome.runs} runs of {outcome.points} points: {outcome.done} done in {outcome.elapsed_s:.1f} s, "
        f"{outcome.reused} done before" + (f", {missing} missing" if missing else "")
    )
    if outcome.headlines and not _any(outcome, "fallbacks"):
        console.print("0 fallbacks: no neighbour's estimate was left out because its history was unknown")
    for failure in outcome.failed[:SHOWN_FAILURES]:
        seed = "" if failure["seed"] is None else f", seed {failure['seed']}"
        told = escape(f"{failure['point']}{seed}: {failure['error']}")
        console.print(f"[bold red]failed:[/] {told} (runs/{failure['run']}.failed.json)", soft_wrap=True)
    if len(outcome.failed) > SHOWN_FAILURES:
        console.print(f"... and {len(outcome.failed) - SHOWN_FAILURES} more failures")
    if outcome.interrupted:
        console.print("[bold]interrupted:[/] what was done is kept; the same command goes on from there")
    elif outcome.tables:
        console.print(f"tables: {outcome.directory}" + (f"   report: {report}" if report else ""), soft_wrap=True)


def _table(outcome: Outcome) -> Table:
    table = Table(title="final estimates, mean over the seeds", title_justify="left", padding=(0, 1, 0, 0))
    for path in outcome.headlines[0]["labels"]:
        table.add_column(path.rpartition(".")[2], overflow="fold")
    shown = [name for name in SHOWN if name != "fallbacks" or _any(outcome, name)]
    for name in shown:
        table.add_column(SHOWN[name], justify="right", no_wrap=True)
    for headline in outcome.headlines[:SHOWN_POINTS]:
        cells = [_interval(headline["metrics"].get(name)) for name in shown]
        table.add_row(*(escape(str(label)) for label in headline["labels"].values()), *cells)
    return table


def _any(outcome: Outcome, metric: str) -> bool:
    """Whether there was any of it at all."""
    return any((headline["metrics"].get(metric) or [None])[0] for headline in outcome.headlines)


def _interval(told: Sequence[float | None] | None) -> str:
    if told is None or told[0] is None:
        return "-"
    mean, low, high = told
    return f"{mean:.3g}" if low is None or high is None or low == high else f"{mean:.3g} ± {(high - low) / 2:.1g}"
