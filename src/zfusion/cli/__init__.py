"""The command line: every command a few lines over the library.

All commands: exit code 0 on success, 1 on a failed run or check, 2 on bad usage or input; with ``--json`` one JSON
object on standard output, everything else on standard error.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer
from rich.markup import escape

from zfusion import __version__
from zfusion.cli import (
    compare,
    deploy,
    doctor,
    experiment,
    library,
    live,
    logs,
    models,
    observe,
    recordings,
    repair,
    report,
    soak,
    supervision,
)
from zfusion.cli.common import err, out
from zfusion.cli.output import checked_output
from zfusion.errors import ZfusionError

app = typer.Typer(
    name="zfusion",
    help="Peer-to-peer state estimation in sensor networks, on Eclipse Zenoh.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS: dict[str, Sequence[Callable[..., None]]] = {
    "Run a swarm": (live.launch, live.simulate, live.node, live.record, soak.soak),
    "Look at it": (observe.status, observe.top, observe.echo, observe.hz, observe.metrics),
    "On many machines": (deploy.deploy, deploy.router, supervision.health, doctor.doctor),
    "Predict and compare": (
        models.design,
        compare.compare,
        compare.worst,
        experiment.experiment,
    ),
    "Recordings": (
        recordings.replay,
        recordings.info,
        report.report,
        recordings.export,
        repair.recover,
        repair.merge,
        repair.cut,
    ),
}
for panel, commands in COMMANDS.items():
    for command in commands:
        app.command(rich_help_panel=panel)(command)
app.command(hidden=True)(live.network)
app.add_typer(library.app, name="library", rich_help_panel="Studies")


def run() -> None:
    """Run the command line and exit."""
    try:
        with checked_output():
            app()
    except ZfusionError as error:
        if logs.as_json():
            logs.log.error("%s", error)
        else:
            err.print(f"[bold red]error:[/] {escape(str(error))}", soft_wrap=True)
        sys.exit(error.exit_code)


def _tell_version(wanted: bool) -> None:
    if wanted:
        out.print(f"zfusion {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell more.")] = False,
    log_format: Annotated[
        logs.LogFormat, typer.Option(envvar=logs.VARIABLE, help="How logs are written.", show_envvar=True)
    ] = logs.LogFormat.TEXT,
    version: Annotated[  # noqa: ARG001 - its callback has told it by now
        bool, typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_tell_version)
    ] = False,
) -> None:
    logs.configure(log_format, err, verbose=verbose)
