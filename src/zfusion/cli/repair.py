"""Commands that make recordings of recordings: recover, merge, cut."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zfusion.cli.common import Json, RecordingFile, finish, interrupted_by_signals, out, steps_range
from zfusion.cli.progress import progress

Made = Annotated[Path, typer.Option("--output", "-o", help="Recording to write.", show_default=False)]


def recover(recording: RecordingFile, output: Made, as_json: Json = False) -> None:
    """Save what can be saved of a damaged recording. Exit code 1 if something on it could not be."""
    from zfusion.recording.recover import recover as save
    from zfusion.report.recording import show_recovery

    size = recording.stat().st_size if recording.is_file() else 0
    interrupted_by_signals()
    with progress("recovering", 2 * size) as advance:
        told = save(recording, output, advance)
    finish(told.as_dict(), as_json, lambda: show_recovery(out, told))
    if told.lossy:
        raise typer.Exit(1)


def merge(
    recordings: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings.", show_default=False)],
    output: Made,
    as_json: Json = False,
) -> None:
    """Put recordings of one run together: segments, or what recorders in different places heard."""
    from zfusion.recording.merge import merge as put_together
    from zfusion.report.recording import show_merged

    interrupted_by_signals()
    with progress("merging", None) as advance:
        told = put_together(recordings, output, advance)
    finish(told.as_dict(), as_json, lambda: show_merged(out, told))
    if told.conflicts:
        raise typer.Exit(1)


def cut(
    recording: RecordingFile,
    output: Made,
    steps: Annotated[str | None, typer.Option(metavar="A:B", help="Steps, both included.", show_default="all")] = None,
    nodes: Annotated[str | None, typer.Option(metavar="A,B", help="Nodes.", show_default="all")] = None,
    as_json: Json = False,
) -> None:
    """Copy some steps, or some nodes' messages, to a recording of their own."""
    from zfusion.recording.cut import cut as copy
    from zfusion.report.recording import show_cut

    chosen = None if nodes is None else [node.strip() for node in nodes.split(",")]
    interrupted_by_signals()
    with progress("cutting", None) as advance:
        told = copy(recording, output, steps=steps_range(steps), nodes=chosen, advance=advance)
    finish(told.as_dict(), as_json, lambda: show_cut(out, told))
