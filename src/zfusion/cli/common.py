"""What the commands share: options, the shapes of output, and what ends them."""

from __future__ import annotations

import json
import re
import signal
import sys
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from glob import escape
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from zfusion.cli import logs
from zfusion.errors import InputError, ZfusionError
from zfusion.keys import check_run
from zfusion.methods.check import check_method
from zfusion.model.scenario import Overrides, Scenario, load_scenario
from zfusion.model.types import NodeId

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)

ScenarioFile = Annotated[Path, typer.Argument(metavar="SCENARIO", help="Scenario file (TOML).", show_default=False)]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (MCAP).", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Steps = Annotated[int | None, typer.Option(help="Steps to take.", min=1, show_default="the scenario's")]
Seed = Annotated[int | None, typer.Option(help="Seed of all that is random.", min=0, show_default="the scenario's")]
Rate = Annotated[float | None, typer.Option("--rate", help="Steps a second.", min=1e-6, show_default="the scenario's")]
FreeRun = Annotated[bool, typer.Option("--free-run", help="Each step as soon as the one before is done.")]
MethodName = Annotated[
    str | None, typer.Option("--method", help="Method of estimation.", show_default="the scenario's")
]
Links = Annotated[
    Path | None,
    typer.Option("--links", help="File of links and faults (TOML).", show_default="the scenario's"),
]
Loss = Annotated[
    float | None,
    typer.Option(help="Probability that a message is lost on a link.", min=0, max=1, show_default="the scenario's"),
]
Record = Annotated[
    Path | None, typer.Option("--record", help="Recording to write.", show_default="recordings/<run>.mcap")
]
NoRecord = Annotated[bool, typer.Option("--no-record", help="Write no recording.")]
Restart = Annotated[bool, typer.Option("--restart", help="Start a node that dies again.")]
RunName = Annotated[str | None, typer.Option("--run", help="Name of the run.", show_default="made up")]
Connect = Annotated[list[str] | None, typer.Option(help="Zenoh endpoint to dial; may be repeated.")]
Listen = Annotated[list[str] | None, typer.Option(help="Zenoh endpoint to listen on; may be repeated.")]
ZenohConfig = Annotated[
    Path | None,
    typer.Option("--zenoh-config", help="This process' Zenoh configuration.", show_default="the scenario's"),
]
ControlFd = Annotated[int | None, typer.Option(hidden=True)]


def load(
    path: Path,
    steps: int | None = None,
    rate: float | None = None,
    free_run: bool = False,
    seed: int | None = None,
    method: str | None = None,
    links: Path | None = None,
    loss: float | None = None,
    delay: float | None = None,
    zenoh_config: Path | None = None,
) -> Scenario:
    """The scenario of a file with what the command line says instead; InputError for what is wrong with it.

    Says so where a fault is planned for steps that are not taken.
    """
    from zfusion.links import Timeline, links_of

    overrides = Overrides(
        steps=steps,
        rate_hz=rate,
        free_run=True if free_run else None,
        seed=seed,
        method=method,
        links=links,
        loss=loss,
        delay=delay,
        zenoh_config=zenoh_config,
    )
    loaded = load_scenario(path, **overrides)
    check_method(loaded, str(path))
    links_of(loaded)
    for n in Timeline(loaded).beyond(loaded.steps):
        said = f"faults[{n}] begins after the last step, {loaded.steps}: it will not happen"
        if logs.as_json():
            logs.log.warning(said)
        else:
            err.print(said)
    return loaded


def run_name(given: str | None, scenario: Scenario) -> str:
    """The run's name: given, or made of the scenario's and the time."""
    return check_run(given or f"{scenario.name}-{datetime.now(UTC):%Y%m%d-%H%M%S}")


def given_run(given: str | None, scenario: Scenario) -> str:
    """Processes that are started by hand must agree on the run's name: by default it is the scenario's."""
    return check_run(given or scenario.name)


def recording_path(
    scenario: Scenario, run: str, record: Path | None, no_record: bool, files: Iterable[Path | None]
) -> Path | None:
    """Where the recording goes, None where there is to be none; InputError for a place that cannot be made.

    Nor may it be one of the `files` that the command was given, or of those that the scenario names.
    """
    if record is not None and no_record:
        raise typer.BadParameter("--record and --no-record exclude each other")
    if no_record or (record is None and not scenario.recording.enabled):
        return None
    if record is not None:
        path = record
    elif scenario.recording.path is not None:
        path = scenario.absolute(scenario.recording.path)
    else:
        path = default_directory(scenario) / f"{run}.mcap"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    keep_what_is_read(scenario, path, files)
    return path.absolute()


def keep_what_is_read(scenario: Scenario, output: Path, files: Iterable[Path | None]) -> None:
    """InputError if `output` is one of `files`, which the command was given, or of those that the scenario names."""
    from zfusion.recording.paths import refuse_to_replace

    refuse_to_replace(output, [*filter(None, files), *scenario.files_read()], "one of the files that are read")


def default_directory(scenario: Scenario) -> Path:
    """Where recordings and logs go unless something else is said."""
    directory = scenario.recording.directory
    return (scenario.absolute(directory) if directory else Path("recordings")).absolute()


def unused(path: Path) -> Path:
    """`path`, or the first of ``field-2.mcap``, ``field-3.mcap``, ... of which there is no file, nor a part of one."""
    names = chain((path.stem,), (f"{path.stem}-{n}" for n in count(2)))
    name = next(name for name in names if not any(path.parent.glob(f"{escape(name)}.*")))
    return path.with_name(f"{name}{path.suffix}")


def node_named(scenario: Scenario, text: str) -> NodeId:
    """The scenario's node of that id; InputError if there is none."""
    try:
        return scenario.node_id(text)
    except (KeyError, ValueError):
        known = ", ".join(str(i) for i in scenario.ids)
        raise InputError(f"--id: expected a node of the scenario: {known} (is {text!r})") from None


def epoch_ns(text: str) -> int:
    """An RFC 3339 time in nanoseconds since 1970; InputError if it is none."""
    try:
        epoch = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--epoch: expected a time like 2026-01-31T12:00:00Z (is {text!r})") from None
    if epoch.tzinfo is None:
        raise InputError(f"--epoch: expected a time with its offset, like 2026-01-31T12:00:00Z (is {text!r})")
    return round(epoch.timestamp() * 1000) * 1_000_000


def steps_range(text: str | None) -> range | None:
    """``A:B``, both included, or ``A``; InputError for anything else."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,15})(?::(\d{1,15}))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if not 1 <= first <= last:
        raise InputError(f"--steps: expected first:last, like 100:112 (is {text!r})")
    return range(first, last + 1)


def finish(result: Mapping[str, Any], as_json: bool, show: Callable[[], None]) -> None:
    """The result, for programs or for people."""
    if as_json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        show()


def on_signals(stop: Callable[[], None]) -> None:
    """Have `stop` called when somebody wants this process to end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop())


def interrupted_by_signals() -> None:
    """Have a signal that wants this process to end do what Ctrl-C does: what is half done is cleared away first."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


def control_of(descriptor: int | None, *, deadly: bool) -> Any:
    """The line to the launcher, in a process that one started."""
    if descriptor is None:
        return None
    from zfusion.swarm.control import ChildEnd, on_death_of_parent

    on_death_of_parent(signal.SIGKILL if deadly else signal.SIGCONT)
    return ChildEnd(descriptor)


class ToldTo:
    """Tells the launcher, too, why this process ends with an error."""

    def __init__(self, control: Any) -> None:
        self._control = control

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._control is not None and isinstance(error, ZfusionError):
            self._control.tell(error=str(error), exit_code=error.exit_code)


def plain(value: Any) -> Any:
    """Node ids as keys become text, as JSON has it."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    return value
