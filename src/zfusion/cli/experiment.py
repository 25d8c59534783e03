"""The command that runs sweeps: experiment."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, err, finish, interrupted_by_signals, out

ExperimentFile = Annotated[Path, typer.Argument(metavar="FILE", help="Experiment file (TOML).", show_default=False)]
Directory = Annotated[Path, typer.Option("--output", "-o", help="Directory for runs, tables and report.")]


def experiment(
    file: ExperimentFile,
    output: Directory = Path("out"),
    jobs: Annotated[
        int | None, typer.Option("--jobs", "-j", help="Runs at a time.", min=1, show_default="processors")
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="The small size that the file describes.")] = False,
    dask: Annotated[
        str | None, typer.Option(help="Dask scheduler to run on, or 'local': a cluster made for this.")
    ] = None,
    record: Annotated[bool, typer.Option("--record", help="Keep the recordings of live runs.")] = False,
    no_report: Annotated[bool, typer.Option("--no-report", help="Make tables only, no figures.")] = False,
    as_json: Json = False,
) -> None:
    """Run a sweep, in parallel, and make tables and a report of it; whatever is done already is not done again."""
    from zfusion.report.extras import check_extras

    check_extras()
    from zfusion.report.experiment import ProgressBar, show_outcome
    from zfusion.report.experiment_report import write_report
    from zfusion.studies.experiment.engines import engine_of
    from zfusion.studies.experiment.plan import plan
    from zfusion.studies.experiment.run import run_experiment
    from zfusion.studies.experiment.spec import load_experiment

    planned = plan(load_experiment(file, small=small))
    recordings = output.absolute() / "recordings" if record else None
    engine = engine_of(planned.experiment.spec.world, jobs or os.cpu_count() or 1, dask, recordings)
    interrupted_by_signals()
    with ProgressBar(err, planned.experiment.name, enabled=not as_json) as bar:
        outcome = run_experiment(planned, output, engine, bar)
        report = None if no_report or not outcome.tables else write_report(output)
    told = {**asdict(outcome), "report": None if report is None else str(report)}
    finish(told, as_json, lambda: show_outcome(out, outcome, report))
    if outcome.failed or outcome.interrupted:
        raise typer.Exit(1)
