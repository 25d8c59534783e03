"""Commands of the study on the library's motes (docs/library.md): prepare, run, score."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, RecordingFile, finish, load, out, run_name
from zfusion.cli.live import launched

app = typer.Typer(help="A study on real data: 19 motes in a library.", no_args_is_help=True)

StudyFile = Annotated[Path, typer.Argument(metavar="STUDY", help="Study file (TOML).", show_default=False)]
Data = Annotated[Path, typer.Option(help="Directory of the data.", show_default=False)]
Out = Annotated[Path, typer.Option("--output", "-o", help="Directory for the scenario, its table and the recording.")]
OUT = Path("out/library")


@app.command()
def prepare(study: StudyFile, data: Data, output: Out = OUT) -> None:
    """Identify a model from the first part of the data; write a scenario and the table that it reads."""
    from zfusion.studies.library.prepare import load_study
    from zfusion.studies.library.prepare import prepare as write

    out.print(f"scenario: {write(load_study(study), data, output)}", soft_wrap=True)


@app.command()
def run(study: StudyFile, data: Data, output: Out = OUT, as_json: Json = False) -> None:
    """Prepare, launch the swarm on the rest of the data as fast as it can, and score what it predicted."""
    from zfusion.report.summary import show_summary
    from zfusion.studies.library.prepare import load_study
    from zfusion.studies.library.prepare import prepare as write
    from zfusion.studies.library.score import score as scored
    from zfusion.studies.library.score import show_score

    scenario = load(write(load_study(study), data, output))
    name = run_name(None, scenario)
    recording = (output / f"{name}.mcap").absolute()
    summary = launched(scenario, name, recording, quiet=as_json)
    if summary["failures"]:
        finish(summary, as_json, lambda: show_summary(out, summary))
        raise typer.Exit(1)
    result = scored(recording, data)
    if not as_json:
        show_summary(out, summary)
    finish({**summary, "score": result.facts()}, as_json, lambda: show_score(out, result))


@app.command()
def score(recording: RecordingFile, data: Data, as_json: Json = False) -> None:
    """Score what the swarm of a recording predicted, beside simple baselines."""
    from zfusion.studies.library.score import score as scored
    from zfusion.studies.library.score import show_score

    result = scored(recording, data)
    finish(result.facts(), as_json, lambda: show_score(out, result))
