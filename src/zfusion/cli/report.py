"""The command report."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, err, finish, out
from zfusion.errors import InputError


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

    return write_report(recording, output or recording.with_suffix(".html"), _range(steps), figures)


def _range(text: str | None) -> range | None:
    """``A:B``, both included, or ``A``; InputError for anything else."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,15})(?::(\d{1,15}))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if not 1 <= first <= last:
        raise InputError(f"--steps: expected first:last, like 100:112 (is {text!r})")
    return range(first, last + 1)
