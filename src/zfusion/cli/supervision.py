"""What supervisors are told, systemd and the probes of containers: by the commands that run, and by health."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zfusion.cli.common import Json, finish, out, plain
from zfusion.errors import InputError

if TYPE_CHECKING:
    from zfusion.drivers.notify import Supervisor


def supervised(control: Any = None) -> Supervisor:
    """The supervisor that this process' environment names; nobody where a launcher has started it, which supervises."""
    from zfusion.drivers.notify import Supervisor

    return Supervisor.of(os.environ if control is None else {})


def teller(control: Any, supervisor: Supervisor, told: Callable[[Any], None]) -> Callable[[Any], None] | None:
    """Who is to be told how a process is doing: its launcher, or `told` of its supervisor; None where there is none."""
    if control is not None:
        return lambda status: control.tell(status=plain(asdict(status)))
    return told if supervisor.there else None


def health(
    file: Annotated[
        Path | None, typer.Argument(help="Health file.", show_default="what ZFUSION_HEALTH_FILE says")
    ] = None,
    alive: Annotated[bool, typer.Option("--alive", help="It need not be ready: joining and leaving is well.")] = False,
    within: Annotated[float, typer.Option(help="Seconds since its last sign of life, at most.", min=0.1)] = 30.0,
    as_json: Json = False,
) -> None:
    """Whether a process on this machine is well: for probes. Exit code 1 where it is not."""
    from zfusion.drivers.notify import HEALTH_FILE, Health, verdict

    path = file or (Path(os.environ[HEALTH_FILE]) if os.environ.get(HEALTH_FILE) else None)
    if path is None:
        raise InputError(f"expected a health file, as an argument or in {HEALTH_FILE}")
    well, told = verdict(Health.read(path), alive=alive, within_s=within)
    finish(told, as_json, lambda: out.print(f"{told['status']} ({told['age_s']:.1f} s ago)", soft_wrap=True))
    if not well:
        raise typer.Exit(1)
