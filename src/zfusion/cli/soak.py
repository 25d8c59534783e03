"""The command soak: a long run, watched for anything that grows."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zfusion.cli.common import (
    FreeRun,
    Json,
    Links,
    MethodName,
    NoRecord,
    Rate,
    Restart,
    RunName,
    ScenarioFile,
    Seed,
    err,
    finish,
    load,
    out,
    recording_path,
    run_name,
)
from zfusion.errors import InputError
from zfusion.model.scenario import Overrides, Scenario, load_scenario
from zfusion.model.types import NodeId

if TYPE_CHECKING:
    from zfusion.studies.soak.growth import Growth
    from zfusion.swarm.child import Child
    from zfusion.swarm.launch import Launcher
    from zfusion.swarm.watch import Watch

SAMPLES = "samples.csv"

SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}

FOREVER = 10**12
"""Steps of a free-running swarm that is stopped when its time is over."""

HEALTH_PART = 0.5
"""How often nodes tell of their health, in parts of the interval: what a sample has is not older than that."""


def duration_s(text: str) -> float:
    """``1h``, ``10m``, ``90s``, ``1.5h`` or a number of seconds; BadParameter for anything else."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(d|h|min|m|s|)", text.strip())
    seconds = float(found[1]) * SECONDS[found[2]] if found else 0.0
    if not 0 < seconds < math.inf:
        raise typer.BadParameter(f"expected a duration like 1h, 10m or 90s (is {text!r})")
    return seconds


def soak(
    scenario: ScenarioFile,
    for_s: Annotated[
        float | None,
        typer.Option(
            "--for", metavar="TIME", parser=duration_s, help="How long: 1h, 10m, 90s.", show_default="its steps"
        ),
    ] = None,
    interval_s: Annotated[
        float, typer.Option("--interval", metavar="TIME", parser=duration_s, help="From one sample to the next.")
    ] = "10s",  # type: ignore[assignment]
    warm_up: Annotated[
        float | None,
        typer.Option(
            "--warm-up", metavar="TIME", parser=duration_s, help="What is not judged.", show_default="1/4, up to 10m"
        ),
    ] = None,
    rate: Rate = None,
    free_run: FreeRun = False,
    seed: Seed = None,
    method: MethodName = None,
    links: Links = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Directory to write.", show_default="soak-<run>")
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", help="Recording to write.", show_default="<run>.mcap in the directory")
    ] = None,
    no_record: NoRecord = False,
    restart: Restart = False,
    run: RunName = None,
    as_json: Json = False,
) -> None:
    """Run a swarm for long, watch every process of it, and say whether anything grows."""
    from zfusion.report.extras import check_extras
    from zfusion.swarm.watch import check_watching

    check_watching()
    check_extras()
    paced = load_scenario(scenario, **Overrides(rate_hz=rate, free_run=free_run or None))
    loaded = load(scenario, _steps(paced, for_s), rate, free_run, seed, method, links)
    name = run_name(run, loaded)
    directory = (output or Path(f"soak-{name}")).absolute()
    _make(directory)
    if record is None and not no_record and loaded.recording.enabled:
        record = directory / f"{name}.mcap"
    recording = recording_path(loaded, name, record, no_record, (scenario, links))
    told = _soaked(loaded, name, directory, recording, interval_s, for_s, warm_up, restart=restart, quiet=as_json)
    finish(told, as_json, lambda: _show(told))
    if told["verdict"] in {"grows", "failed"}:
        raise typer.Exit(1)


def _steps(scenario: Scenario, for_s: float | None) -> int | None:
    if for_s is None:
        return None
    period_ns = scenario.timing.period_ns
    return FOREVER if period_ns is None else max(1, math.ceil(for_s * 1e9 / period_ns))


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from None


def _soaked(
    scenario: Scenario,
    run: str,
    directory: Path,
    recording: Path | None,
    interval_s: float,
    for_s: float | None,
    warm_up: float | None,
    *,
    restart: bool,
    quiet: bool,
) -> dict[str, Any]:
    """Run, judge, report."""
    from zfusion.cli.live import launched
    from zfusion.methods import chosen
    from zfusion.report.soak_report import write_report
    from zfusion.studies.soak.growth import begun_s, judge, warm_up_s
    from zfusion.studies.soak.samples import read_samples
    from zfusion.swarm.watch import Watch

    stages = [stage.name for stage in chosen(scenario).stages]
    samples, logs = directory / SAMPLES, directory / f"{run}.logs"
    with Watch(samples, stages, interval_s, recording=recording, logs=logs) as watch:
        alarm = _Alarm(watch, None if scenario.timing.period_ns else for_s)
        summary = launched(
            scenario, run, recording, restart=restart, quiet=quiet, directory=directory, watch=alarm.update,
            health_s=HEALTH_PART * interval_s,
        )  # fmt: skip
    period_ns = scenario.timing.period_ns
    with err.status("drawing"):
        courses = read_samples(samples)
        elapsed_s = max((float(course.t_s[-1]) for course in courses), default=0.0)
        began_s = begun_s(courses)
        not_judged_s = began_s + (warm_up_s(elapsed_s - began_s) if warm_up is None else warm_up)
        growth = judge(courses, not_judged_s, period_ns / 1e9 if period_ns else None)
        told = {
            "run": run,
            "verdict": _verdict(summary["failures"], growth),
            "failures": summary["failures"],
            "interrupted": summary["interrupted"] and not alarm.rang,
            "nodes": [str(i) for i in scenario.ids],
            "processes": len({(course.kind, course.process) for course in courses}),
            "elapsed_s": elapsed_s,
            "interval_s": interval_s,
            "warm_up_s": not_judged_s,
            "samples": watch.samples,
            "unwritten": watch.unwritten,
            "counters": _counters(summary),
            "recording": summary["recording"],
            "recording_bytes": watch.recorded_bytes(),
            "recorded": sum((summary["messages"]["recorded"] or {}).values()),
            "growth": [g.told() for g in growth],
            "directory": str(directory),
            "samples_file": str(samples),
            "logs": str(logs),
            "summary": summary,
        }
        told["report"] = str(write_report(directory, told, courses, growth, stages))
    return told


class _Alarm:
    """Has a launcher stop when the time is over, and samples taken meanwhile."""

    def __init__(self, watch: Watch, for_s: float | None) -> None:
        self.rang = False
        self._watch, self._for_s = watch, for_s

    def update(self, launcher: Launcher, nodes: Mapping[NodeId, Child], recorder: Child | None) -> None:
        """See `Watch.update`."""
        self._watch.update(nodes, recorder)
        if self._for_s is not None and not self.rang and self._watch.elapsed_s >= self._for_s:
            self.rang = True
            launcher.interrupt()


def _verdict(failures: Sequence[str], growth: Sequence[Growth]) -> str:
    """In one word, or two."""
    if failures:
        return "failed"
    if not growth:
        return "too short"
    return "grows" if any(g.grows for g in growth) else "steady"


def _counters(summary: Mapping[str, Any]) -> dict[str, int]:
    """Of the whole run and all nodes."""
    edges = summary["edges"]
    lost = sum(edge["lost"] for edge in edges)
    return {
        "completed": sum(summary["completed_steps"].values()),
        "skipped": summary["skipped"],
        "received": sum(edge["received"] for edge in edges),
        "missed": summary["missed"],
        "late": summary["late"],
        "lost": lost,
        "unrecorded": summary["lost"] - lost,
        "refused": sum(summary["refused"].values()),
        "fallbacks": summary["fallbacks"],
    }


def _show(told: Mapping[str, Any]) -> None:
    """What a person reads on a terminal."""
    colour = {"steady": "green", "too short": "yellow"}.get(told["verdict"], "red")
    ended = ", ended early" if told["interrupted"] else ""
    out.print(f"[bold {colour}]{told['verdict']}[/]  {told['samples']} samples in {told['elapsed_s']:.0f} s{ended}")
    for failure in told["failures"]:
        out.print(f"failed: {failure}", markup=False)
    for g in told["growth"]:
        if g["grows"]:
            out.print(
                f"{g['process']}: {g['quantity']} grows by {g['per_hour']:.3g} {g['unit']} an hour "
                f"(from {g['low']:.3g} to {g['high']:.3g}; {g['tolerance']:.3g} tolerated)",
                markup=False,
            )
    counts = told["counters"]
    out.print(", ".join(f"{count} {name}" for name, count in counts.items()), soft_wrap=True)
    out.print(f"report: {told['report']}", soft_wrap=True, markup=False)
