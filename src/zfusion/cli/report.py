"""The command report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, err, finish, interrupted_by_signals, out, steps_range


def report(
    source: Annotated[
        Path,
        typer.Argument(metavar="FILE|DIR", help="Recording, or an experiment's directory.", show_default=False),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="HTML file to write.", show_default="beside what it is of")
    ] = None,
    steps: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Steps whose messages are drawn.", show_default="those with the most trouble"),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Directory for the figures of a recording as SVG and PNG.", show_default="none")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a report with figures, as one HTML file, of a recording or of an experiment's results."""
    from zfusion.report.extras import check_extras

    check_extras()
    interrupted_by_signals()
    pictures: Path | None
    if source.is_dir():
        if steps is not None or figures is not None:
            raise typer.BadParameter(
                "--steps and --figures are for recordings; an experiment has its figures beside it"
            )
        with err.status("drawing"):
            written, pictures = _of_experiment(source, output)
    else:
        with err.status("drawing"):
            written, pictures = _of_recording(source, output, steps, figures), figures
    told = {"report": str(written), "figures": None if pictures is None else str(pictures)}
    finish(told, as_json, lambda: out.print(f"report: {written}", soft_wrap=True))


def _of_experiment(directory: Path, output: Path | None) -> tuple[Path, Path]:
    from zfusion.report.experiment_report import FIGURES, write_report

    return write_report(directory, output), directory / FIGURES


def _of_recording(recording: Path, output: Path | None, steps: str | None, figures: Path | None) -> Path:
    from zfusion.report.recording_report import write_report

    return write_report(recording, output or recording.with_suffix(".html"), steps_range(steps), figures)
