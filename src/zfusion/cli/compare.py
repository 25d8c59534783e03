"""Commands that set one against another: compare, worst."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from zfusion.cli.common import Json, Links, Loss, Seed, Steps, err, finish, load, out
from zfusion.cli.progress import progress, waiting
from zfusion.errors import InputError
from zfusion.model.scenario import load_scenario

if TYPE_CHECKING:
    from zfusion.model.scenario import Overrides, Scenario
    from zfusion.model.types import NodeId
    from zfusion.recording import Recording
    from zfusion.studies.compare import Comparison, Configuration, Metric

MetricName = Annotated[
    Literal["mse", "nees", "disagreement"], typer.Option(help="What is compared.", case_sensitive=False)
]
Settings = list[str] | None
SEEDS = 20


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Scenario (TOML) or recording (MCAP).", show_default=False)],
    b: Annotated[
        Path | None, typer.Argument(metavar="B", help="The same, to compare with A.", show_default="A")
    ] = None,
    a_settings: Annotated[
        Settings, typer.Option("--a", help="key=value for A, as timing.late=drop; repeatable.")
    ] = None,
    b_settings: Annotated[Settings, typer.Option("--b", help="The same for B.")] = None,
    methods: Annotated[
        str | None,
        typer.Option(help="Compare methods instead: names with commas, options after colons, as consensus:rounds=8."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="With --methods: directory for figures.")
    ] = None,
    metric: MetricName = "mse",
    seeds: Annotated[int | None, typer.Option(help="Seeds.", min=2, show_default=str(SEEDS))] = None,
    seed: Seed = None,
    steps: Steps = None,
    links: Links = None,
    loss: Loss = None,
    as_json: Json = False,
) -> None:
    """Compare two configurations, or methods, on the same measurements: which is better, by how much, how surely."""
    from zfusion.model.scenario import Overrides
    from zfusion.report.compare import show_comparisons

    if methods is not None:
        if b is not None or a_settings or b_settings or metric != "mse":
            raise InputError("--methods compares methods on one scenario or recording: no B, --a, --b, --metric")
        overrides = Overrides(steps=steps, seed=seed, links=links, loss=loss)
        _methods(a, [label.strip() for label in methods.split(",")], overrides, seeds, output, as_json)
        return
    if output is not None:
        raise InputError("--output goes with --methods")
    paths = (a, b or a)
    recorded = [path.suffix == ".mcap" for path in paths]
    if any(recorded):
        others = (a_settings, b_settings, seeds, seed, steps, links, loss)
        if not all(recorded) or b is None or any(other is not None for other in others):
            raise InputError("recordings are compared with recordings, as they are: expected two and no settings")
        comparisons = _recordings(paths, metric)
    else:
        overrides = Overrides(steps=steps, seed=seed, links=links, loss=loss)
        chosen = [
            _configuration(path, name, settings or [], overrides)
            for path, name, settings in zip(paths, ("--a", "--b"), (a_settings, b_settings), strict=True)
        ]
        comparisons = _simulations(chosen, seeds or SEEDS, metric)
    finish(comparisons[0].as_dict(), as_json, lambda: show_comparisons(out, comparisons))


def _methods(
    path: Path, labels: list[str], overrides: Overrides, seeds: int | None, output: Path | None, as_json: bool
) -> None:
    from zfusion.report.extras import check_extras
    from zfusion.report.method_comparison import save_figures, show_methods
    from zfusion.studies.contestants import field_of, field_of_recording
    from zfusion.studies.method_comparison import compare_methods

    if output is not None:
        check_extras()
    with TemporaryDirectory(prefix="zfusion-") as designs:
        if path.suffix == ".mcap":
            if seeds is not None or any(overrides.get(name) is not None for name in ("steps", "seed")):
                raise InputError("a recording has its own measurements: no --seeds, --seed, --steps")
            with _opened(path) as recording, waiting("designing, where methods are designed"):
                field = field_of_recording(recording, labels, Path(designs), overrides)
            first, count = 0, 1
        else:
            loaded = load_scenario(path, **overrides)
            with waiting("designing, where methods are designed"):
                field = field_of(loaded, labels, Path(designs))
            first, count = loaded.seed, seeds or SEEDS
        with progress("seeds", count) as done:
            compared = compare_methods(field, range(first, first + count), jobs=os.cpu_count() or 1, progress=done)
    figures = [] if output is None else save_figures(compared, output)
    told = {**compared.as_dict(), "figures": [str(figure) for figure in figures]}
    finish(told, as_json, lambda: show_methods(out, compared, figures))


def _opened(path: Path) -> Recording:
    from zfusion.recording import Recording

    return Recording.open(path)


def _configuration(path: Path, option: str, settings: list[str], overrides: Overrides) -> Configuration:
    from zfusion.studies.compare import Configuration
    from zfusion.studies.settings import parse_settings, with_settings

    given = parse_settings(settings, option)
    label = " ".join((str(path), *settings))
    return Configuration(label, with_settings(load(path).with_overrides(**overrides), given, label))


def _simulations(chosen: list[Configuration], seeds: int, metric: Metric) -> list[Comparison]:
    from zfusion.studies.compare import compare as compared

    first = chosen[0].scenario.seed
    with progress("seeds", seeds) as done:
        return compared(chosen, range(first, first + seeds), metric, jobs=os.cpu_count() or 1, progress=done)


def _recordings(paths: tuple[Path, ...], metric: Metric) -> list[Comparison]:
    from zfusion.recording import Recording
    from zfusion.studies.compare import compare_recordings

    with ExitStack() as stack, err.status("reading"):
        recordings = [stack.enter_context(Recording.open(path)) for path in paths]
        return compare_recordings(recordings, metric)


def worst(
    scenario: Annotated[
        Path, typer.Argument(metavar="SCENARIO", help="Scenario (TOML), or a recording (MCAP).", show_default=False)
    ],
    budget: Annotated[float, typer.Option(help="Part of all messages that may be chosen.", min=0, max=1)] = 0.05,
    delay: Annotated[
        float | None, typer.Option(help="Seconds by which they are late.", min=0, show_default="they are lost")
    ] = None,
    lose: Annotated[bool, typer.Option("--lose", help="They are lost (the default).")] = False,
    objective: Annotated[
        Literal["predicted", "measured"], typer.Option(help="Mean squared error as predicted, or of the measurements.")
    ] = "predicted",
    nodes: Annotated[
        list[str] | None, typer.Option(help="Node whose errors count; repeatable.", show_default="all")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File of links to write.")] = None,
    limit: Annotated[float, typer.Option(help="Seconds that the search may take.", min=0.1)] = 60.0,
    steps: Steps = None,
    seed: Seed = None,
    links: Links = None,
    as_json: Json = False,
) -> None:
    """Search for the messages whose loss or lateness hurts most, and write them down as links to replay."""
    from zfusion.report.compare import show_worst
    from zfusion.studies.worst import worst_network, write_witness

    if lose and delay is not None:
        raise InputError("--lose and --delay exclude each other")
    loaded = _searched(scenario).with_overrides(steps=steps, seed=seed, links=links)
    counted = None if nodes is None else [_node(loaded, text) for text in nodes]
    with err.status(f"searching, for up to {limit:g} s"):
        report = worst_network(loaded, budget, objective=objective, nodes=counted, delay_s=delay, limit_s=limit)
    if output is not None:
        _write_text(output, write_witness(report))
    told = {**report.as_dict(), "witness": None if output is None else str(output)}
    finish(told, as_json, lambda: show_worst(out, report, output))


def _searched(path: Path) -> Scenario:
    from zfusion.drivers.rerun import on_recording
    from zfusion.recording import Recording

    if path.suffix != ".mcap":
        return load(path)
    with Recording.open(path) as recording:
        return on_recording(recording)


def _node(scenario: Scenario, text: str) -> NodeId:
    try:
        return scenario.node_id(text)
    except KeyError:
        known = ", ".join(str(i) for i in scenario.ids)
        raise InputError(f"--nodes: expected a node of the scenario: {known} (is {text!r})") from None


def _write_text(path: Path, text: str) -> None:
    """Write a file; InputError where that is not possible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
