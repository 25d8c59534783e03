"""The command line: every command a few lines over the library.

All commands: exit code 0 on success, 1 on a failed run or check, 2 on bad usage or input; with ``--json`` one JSON
object on standard output, everything else on standard error.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler

from zfusion import __version__
from zfusion.errors import InputError, ZfusionError
from zfusion.model.scenario import Scenario, load_scenario

app = typer.Typer(
    name="zfusion",
    help="Peer-to-peer state estimation in sensor networks, on Eclipse Zenoh.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

err = Console(stderr=True, highlight=False)
out = Console(highlight=False)

ScenarioFile = Annotated[Path, typer.Argument(metavar="SCENARIO", help="Scenario file (TOML).", show_default=False)]
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (MCAP).", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]
Steps = Annotated[int | None, typer.Option(help="Steps to take.", min=1, show_default="the scenario's")]
Seed = Annotated[int | None, typer.Option(help="Seed of all that is random.", min=0, show_default="the scenario's")]
Rate = Annotated[
    float | None, typer.Option("--rate", help="Steps a second.", min=1e-6, show_default="the scenario's")
]
FreeRun = Annotated[bool, typer.Option("--free-run", help="Each step as soon as the one before is done.")]
MethodName = Annotated[
    str | None, typer.Option("--method", help="two_stage, local or centralized.", show_default="the scenario's")
]
RunName = Annotated[str | None, typer.Option("--run", help="Name of the run.", show_default="made up")]
Connect = Annotated[list[str] | None, typer.Option(help="Zenoh endpoint to dial; may be repeated.")]
Listen = Annotated[list[str] | None, typer.Option(help="Zenoh endpoint to listen on; may be repeated.")]
ControlFd = Annotated[int | None, typer.Option(hidden=True)]


def run() -> None:
    """Run the command line and exit."""
    try:
        app()
    except ZfusionError as error:
        err.print(f"[bold red]error:[/] {_escaped(str(error))}", soft_wrap=True)
        sys.exit(error.exit_code)


@app.callback()
def _options(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Tell more.")] = False,
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.", is_eager=True)] = False,
) -> None:
    if version:
        out.print(f"zfusion {__version__}")
        raise typer.Exit
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(message)s",
        handlers=[RichHandler(console=err, show_path=False, markup=False)],
    )


@app.command()
def launch(
    scenario: ScenarioFile,
    steps: Steps = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Recording to write.", show_default="recordings/<run>.mcap")
    ] = None,
    no_record: Annotated[bool, typer.Option("--no-record", help="Write no recording.")] = False,
    restart: Annotated[bool, typer.Option("--restart", help="Start a node that dies again.")] = False,
    run: RunName = None,
    as_json: Json = False,
) -> None:
    """Run a swarm on this machine: a process for every node, and the recorder."""
    from zfusion.report.summary import show_summary, summarize  # noqa: PLC0415
    from zfusion.report.table import LiveTable  # noqa: PLC0415
    from zfusion.swarm.launch import Launcher, LaunchOptions  # noqa: PLC0415

    loaded = _load(scenario, steps, rate, free_run, seed, method)
    name = _run_name(run, loaded)
    recording = _recording_path(loaded, name, record, no_record)
    directory = recording.parent if recording is not None else _default_directory(loaded)
    logs = directory / f"{name}.logs"
    with LiveTable(err, loaded, name, enabled=not as_json) as table:
        launcher = Launcher(
            loaded,
            LaunchOptions(name, logs, recording, restart, on_update=table.update, on_message=table.message),
        )
        _on_signals(launcher.interrupt)
        result = launcher.run()
    summary = summarize(
        name,
        loaded,
        result.reports,
        result.recorder,
        failures=result.failures,
        interrupted=result.interrupted,
        logs=str(result.logs),
    )
    _finish(summary, as_json, lambda: show_summary(out, summary))
    if summary["failures"]:
        raise typer.Exit(1)


@app.command()
def node(
    scenario: ScenarioFile,
    node_id: Annotated[str, typer.Option("--id", help="Which node of the scenario this is.")],
    steps: Steps = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    run: RunName = None,
    listen: Listen = None,
    connect: Connect = None,
    epoch: Annotated[str | None, typer.Option(help="When step 0 is (RFC 3339).", show_default="agreed on")] = None,
    await_recorder: Annotated[bool, typer.Option(help="Begin only when a recorder is there.")] = False,
    forever: Annotated[bool, typer.Option("--forever", help="Take steps until stopped.")] = False,
    as_json: Json = False,
    control_fd: ControlFd = None,
) -> None:
    """Run one node: the same swarm on many machines, without the launcher."""
    from zfusion.drivers.live import LiveNode, LiveOptions, endpoints_of  # noqa: PLC0415
    from zfusion.drivers.sources import open_source  # noqa: PLC0415
    from zfusion.report.summary import show_node_report  # noqa: PLC0415

    control = _control(control_fd, deadly=True)
    with _told_to(control):
        loaded = _load(scenario, steps, rate, free_run, seed, method)
        own = _node_id(loaded, node_id)
        options = LiveOptions(
            run=_given_run(run, loaded),
            endpoints=endpoints_of(loaded, own, listen, connect),
            recorder=await_recorder,
            epoch_ns=None if epoch is None else _epoch_ns(epoch),
            steps=None if forever else loaded.steps,
        )
        tell = None if control is None else lambda status: control.tell(status=_plain(asdict(status)))
        live = LiveNode(loaded, own, open_source(loaded, own), options, tell)
        _on_signals(live.stop)
        if control is not None:
            control.on_stop(live.stop)
        report = asdict(live.run())
    if control is not None:
        control.tell(report=report)
        return
    _finish(report, as_json, lambda: show_node_report(out, report))


@app.command()
def record(
    scenario: ScenarioFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Recording to write.", show_default=False)],
    run: RunName = None,
    connect: Connect = None,
    listen: Listen = None,
    as_json: Json = False,
    control_fd: ControlFd = None,
) -> None:
    """Record a run: the recorder alone, for swarms on many machines. Ends with Ctrl-C, or when all nodes have left."""
    from zfusion.drivers.live import recorder_endpoints  # noqa: PLC0415
    from zfusion.drivers.recorder import Recorder  # noqa: PLC0415
    from zfusion.methods import METHODS  # noqa: PLC0415
    from zfusion.recording.writer import RecordingWriter  # noqa: PLC0415

    control = _control(control_fd, deadly=False)
    with _told_to(control):
        loaded = load_scenario(scenario)
        name = _given_run(run, loaded)
        method = loaded.method.name
        output.parent.mkdir(parents=True, exist_ok=True)
        writer = RecordingWriter(
            output,
            scenario_toml=loaded.anchored().to_toml(),
            run=name,
            method=method,
            seed=loaded.seed,
            stages=METHODS[method].stages,
        )
        tell = None if control is None else lambda report: control.tell(status=asdict(report))
        recorder = Recorder(
            loaded, name, recorder_endpoints(loaded, connect, listen), writer, until_all_gone=control is None, tell=tell
        )
        _on_signals(recorder.stop)
        if control is not None:
            control.on_stop(recorder.stop)
        report = asdict(recorder.run())
    if control is not None:
        control.tell(report=report)
        return
    _finish(report, as_json, lambda: out.print(f"{report['messages']} messages in {report['path']}"))


@app.command()
def design(
    scenario: ScenarioFile,
    steps: Steps = None,
    as_json: Json = False,
) -> None:
    """Predict the error covariances of all estimates, without running anything."""
    from zfusion.methods.prediction import predict  # noqa: PLC0415
    from zfusion.report.design import as_json_object, show_prediction  # noqa: PLC0415

    loaded = load_scenario(scenario, steps=steps)
    prediction = predict(loaded.system(), loaded.network, loaded.steps)
    _finish(as_json_object(prediction), as_json, lambda: show_prediction(out, loaded.name, prediction))


@app.command()
def info(recording: RecordingFile, as_json: Json = False) -> None:
    """Tell what is on a recording, what is missing and what made it."""
    from zfusion.recording import Recording  # noqa: PLC0415
    from zfusion.recording.info import info as information  # noqa: PLC0415
    from zfusion.report.recording import show_info  # noqa: PLC0415

    with Recording.open(recording) as opened:
        told = information(opened)
    _finish(told.as_dict(), as_json, lambda: show_info(out, told))


@app.command()
def export(
    recording: RecordingFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write.", show_default="beside the recording")
    ] = None,
    format: Annotated[str, typer.Option("--format", "-f", help="csv, jsonl or npz.")] = "csv",
    topic: Annotated[list[str] | None, typer.Option(help="Only this topic; may be repeated.")] = None,
    as_json: Json = False,
) -> None:
    """Write a recording's numbers for other tools."""
    from zfusion.recording import Recording  # noqa: PLC0415
    from zfusion.recording.export import export as write  # noqa: PLC0415

    target = output or recording.with_suffix(f".{format}")
    with Recording.open(recording) as opened:
        done = write(opened, target, format, topics=topic)
    result = {"output": str(target), **asdict(done)}
    _finish(result, as_json, lambda: out.print(f"{done.messages} messages in {target}", soft_wrap=True))


def _load(
    path: Path, steps: int | None, rate: float | None, free_run: bool, seed: int | None, method: str | None
) -> Scenario:
    from zfusion.methods import METHODS  # noqa: PLC0415

    loaded = load_scenario(
        path, steps=steps, rate_hz=rate, free_run=True if free_run else None, seed=seed, method=method
    )
    if loaded.method.name not in METHODS:
        raise InputError(f"{path}: method: expected one of {', '.join(METHODS)} (is {loaded.method.name!r})")
    return loaded


def _run_name(given: str | None, scenario: Scenario) -> str:
    from zfusion.keys import check_run  # noqa: PLC0415

    return check_run(given or f"{scenario.name}-{datetime.now(UTC):%Y%m%d-%H%M%S}")


def _given_run(given: str | None, scenario: Scenario) -> str:
    """Processes that are started by hand must agree on the run's name: by default it is the scenario's."""
    from zfusion.keys import check_run  # noqa: PLC0415

    return check_run(given or scenario.name)


def _recording_path(scenario: Scenario, run: str, record: Path | None, no_record: bool) -> Path | None:
    if record is not None and no_record:
        raise typer.BadParameter("--record and --no-record exclude each other")
    if no_record or (record is None and not scenario.recording.enabled):
        return None
    if record is not None:
        path = record
    elif scenario.recording.path is not None:
        path = scenario.absolute(scenario.recording.path)
    else:
        path = _default_directory(scenario) / f"{run}.mcap"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    return path.absolute()


def _default_directory(scenario: Scenario) -> Path:
    directory = scenario.recording.directory
    return (scenario.absolute(directory) if directory else Path("recordings")).absolute()


def _node_id(scenario: Scenario, text: str) -> Any:
    try:
        return scenario.node_id(text)
    except (KeyError, ValueError):
        known = ", ".join(str(i) for i in scenario.ids)
        raise InputError(f"--id: expected a node of the scenario: {known} (is {text!r})") from None


def _epoch_ns(text: str) -> int:
    try:
        epoch = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--epoch: expected a time like 2026-01-31T12:00:00Z (is {text!r})") from None
    if epoch.tzinfo is None:
        raise InputError(f"--epoch: expected a time with its offset, like 2026-01-31T12:00:00Z (is {text!r})")
    return round(epoch.timestamp() * 1000) * 1_000_000


def _finish(result: Mapping[str, Any], as_json: bool, show: Callable[[], None]) -> None:
    """The result, for programs or for people."""
    if as_json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        show()


def _on_signals(stop: Callable[[], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stop())


def _control(descriptor: int | None, *, deadly: bool) -> Any:
    """The line to the launcher, in a process that one started."""
    if descriptor is None:
        return None
    from zfusion.swarm.control import ChildEnd, die_with_parent  # noqa: PLC0415

    if deadly:
        die_with_parent()
    return ChildEnd(descriptor)


class _told_to:
    """Tells the launcher, too, why this process ends with an error."""

    def __init__(self, control: Any) -> None:
        self._control = control

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._control is not None and isinstance(error, ZfusionError):
            self._control.tell(error=str(error), exit_code=error.exit_code)


def _plain(value: Any) -> Any:
    """Node ids as keys become text, as JSON has it."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return value


def _escaped(text: str) -> str:
    from rich.markup import escape  # noqa: PLC0415

    return escape(text)
