"""Commands on recordings: replay, info, export."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zfusion.cli.common import (
    Connect,
    Json,
    Listen,
    Loss,
    MethodName,
    RecordingFile,
    RunName,
    Seed,
    err,
    finish,
    interrupted_by_signals,
    load,
    on_signals,
    out,
)
from zfusion.cli.progress import design_first
from zfusion.methods.check import check_method
from zfusion.model.scenario import Overrides, Scenario

if TYPE_CHECKING:
    from zfusion.drivers.playback import Extent
    from zfusion.recording import Recording

WORTH_PROCESSES = 100_000
"""Messages from which on verifying is shared among the machine's cores: starting their processes takes a second."""

RECORDED = "recorded"
"""In the place of a file of links: those that the recording itself measured."""

POLL_S = 0.02
"""How often a player that waits for a consumer looks for one."""

DEFAULT_PLAYER = ("tcp/127.0.0.1:7449",)
"""Where a player listens, for consumers to connect to."""

FromStep = Annotated[int | None, typer.Option(help="First step to play.", min=0)]


def replay(
    recording: RecordingFile,
    verify: Annotated[bool, typer.Option("--verify", help="Recompute every estimate and compare every bit.")] = False,
    publish: Annotated[bool, typer.Option("--publish", help="Publish the messages again, on the same keys.")] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Run the measurements again, and record that here.")
    ] = None,
    method: MethodName = None,
    scenario: Annotated[
        Path | None, typer.Option(help="Run the measurements through this scenario.", show_default="the recorded one")
    ] = None,
    links: Annotated[
        str | None,
        typer.Option(
            help="File of links and faults, or 'recorded': the latencies that were measured.",
            show_default="the scenario's",
        ),
    ] = None,
    loss: Loss = None,
    late: Annotated[
        str | None,
        typer.Option(help="What becomes of late messages: drop, revise, wait.", show_default="the scenario's"),
    ] = None,
    window: Annotated[int | None, typer.Option(help="Steps that they may be late, if revised.", min=1)] = None,
    seed: Seed = None,
    speed: Annotated[float, typer.Option(help="How many times as fast; 0: as fast as possible.", min=0)] = 1.0,
    start: Annotated[float | None, typer.Option(help="Seconds from the beginning to start at.", min=0)] = None,
    end: Annotated[float | None, typer.Option(help="Seconds from the beginning to end at.", min=0)] = None,
    first_step: FromStep = None,
    last_step: Annotated[int | None, typer.Option(help="Last step to play.", min=0)] = None,
    await_consumer: Annotated[
        bool, typer.Option("--await-consumer", help="Begin when somebody subscribes to what is played.")
    ] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end.")] = False,
    topic: Annotated[
        list[str] | None, typer.Option(help="Only topics that match, like '*/estimate'; repeatable.")
    ] = None,
    node: Annotated[list[str] | None, typer.Option(help="Only this node's; repeatable.")] = None,
    stage: Annotated[list[str] | None, typer.Option(help="Only this stage's; repeatable.")] = None,
    run: RunName = None,
    listen: Listen = None,
    connect: Connect = None,
    as_json: Json = False,
) -> None:
    """Prove a recording (--verify), play it again (--publish), or run its measurements otherwise (-o)."""
    from zfusion.drivers.playback import Extent
    from zfusion.recording import Recording
    from zfusion.recording.paths import refuse_to_replace

    if verify + publish + (output is not None) != 1:
        raise typer.BadParameter("expected one of --verify, --publish and --output")
    with Recording.open(recording) as opened:
        if verify:
            _verify(opened, as_json)
        elif output is not None:
            given = {"timing.late": late, "timing.window": window}
            settings = {path: value for path, value in given.items() if value is not None}
            files = (scenario, Path(links) if links is not None and links != RECORDED else None)
            refuse_to_replace(output, filter(None, files), "one of the files that are read")
            other = _other(opened, scenario, links, Overrides(method=method, seed=seed, loss=loss), settings)
            _rerun(opened, other, output, run, as_json)
        else:
            extent = Extent(start, end, first_step, last_step)
            chosen = (node, stage, topic)
            _publish(opened, extent, chosen, speed, loop, await_consumer, (listen, connect), as_json)


def _verify(recording: Recording, as_json: bool) -> None:
    from zfusion.drivers.replayed import verify
    from zfusion.report.replay import show_verdict

    with err.status("recomputing"):
        jobs = (os.cpu_count() or 1) if recording.messages > WORTH_PROCESSES else 1
        verdict = verify(recording, jobs=jobs)
    finish(verdict.as_dict(), as_json, lambda: show_verdict(out, verdict))
    if not verdict.verified or verdict.unverifiable:
        raise typer.Exit(1)


def _other(
    recording: Recording, scenario: Path | None, links: str | None, overrides: Overrides, settings: Mapping[str, Any]
) -> Scenario:
    """What the measurements are to be run through: the recorded scenario or another one, changed as is said."""
    from zfusion.drivers.designs import handed_on
    from zfusion.drivers.replayed import recorded_scenario
    from zfusion.drivers.rerun import with_recorded_links
    from zfusion.studies.settings import with_settings

    other: Scenario = load(scenario) if scenario is not None else recorded_scenario(recording)
    begun = other
    if links == RECORDED:
        other = with_recorded_links(other, recording)
    elif links is not None:
        overrides["links"] = links
    other = with_settings(other.with_overrides(**overrides), settings, str(scenario or recording.path))
    other = handed_on(begun, other)
    check_method(other, str(scenario or recording.path))
    return other


def _rerun(recording: Recording, other: Scenario, output: Path, run: str | None, as_json: bool) -> None:
    from zfusion.drivers.rerun import rerun
    from zfusion.report.replay import show_rerun

    output.parent.mkdir(parents=True, exist_ok=True)
    design_first(other)
    with err.status("running the measurements again"):
        done = rerun(recording, other, output, run=run)
    finish({"recording": str(output), "nodes": done.as_dict()}, as_json, lambda: show_rerun(out, done, output))


def _publish(
    recording: Recording,
    extent: Extent,
    chosen: tuple[list[str] | None, list[str] | None, list[str] | None],
    speed: float,
    loop: bool,
    await_consumer: bool,
    endpoints: tuple[list[str] | None, list[str] | None],
    as_json: bool,
) -> None:
    from zfusion.drivers.endpoints import Endpoints
    from zfusion.drivers.playback import Player, choose_topics
    from zfusion.drivers.transport import Republisher, open_session

    nodes, stages, patterns = (tuple(of or ()) for of in chosen)
    topics = choose_topics(recording, nodes=nodes, stages=stages, patterns=patterns)
    listen, connect = (tuple(of or ()) for of in endpoints)
    with open_session(Endpoints(listen or DEFAULT_PLAYER, connect)) as session:
        onto = Republisher(session, topics)
        player = Player(recording, onto.put, speed=speed, extent=extent, topics=topics, loop=loop)
        stopped = threading.Event()

        def stop() -> None:
            stopped.set()
            player.stop()

        on_signals(stop)
        err.print(f"publishing {recording.metadata['run']} on {', '.join(listen or DEFAULT_PLAYER)}")
        while await_consumer and not onto.heard and not stopped.wait(POLL_S):
            pass
        played = player.run()
    finish({"played": played}, as_json, lambda: out.print(f"{played} messages published"))


def info(recording: RecordingFile, as_json: Json = False) -> None:
    """Tell what is on a recording, what is missing and what made it."""
    from zfusion.recording import Recording
    from zfusion.recording.info import info as information
    from zfusion.report.recording import show_info

    with Recording.open(recording) as opened:
        told = information(opened)
    finish(told.as_dict(), as_json, lambda: show_info(out, told))


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
    from zfusion.recording import Recording
    from zfusion.recording.export import export as write

    interrupted_by_signals()
    target = output or recording.with_suffix(f".{format}")
    with Recording.open(recording) as opened:
        done = write(opened, target, format, topics=topic)
    result = {"output": str(target), **asdict(done)}
    finish(result, as_json, lambda: out.print(f"{done.messages} messages in {target}", soft_wrap=True))
