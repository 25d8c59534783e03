"""One run of an experiment, in whichever world: from a task to its metrics. It runs in a process of its own."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from zfusion import keys
from zfusion.drivers.simulated import Simulation
from zfusion.errors import MessageError, RunError, ZfusionError
from zfusion.messages import Decoder
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording import Recording
from zfusion.stages import BUILT_IN, Message
from zfusion.studies.experiment.catalogue import ALL
from zfusion.studies.experiment.metrics import Reports, Row, metrics, theory_metrics
from zfusion.studies.experiment.observed import Observer
from zfusion.studies.experiment.plan import THEORY, Task
from zfusion.swarm.launch import Launcher, LaunchOptions

Result = dict[str, Any]
"""What is kept of a task: its rows and curves as plain lists, or `error` and `traceback`."""


def execute(task: Task, recordings: str | None = None) -> Result:
    """The result of a task: whatever goes wrong with it is part of that.

    `recordings` is where those of live runs are kept; by default they are thrown away once they have been read.
    """
    try:
        return _executed(task, recordings)
    except ZfusionError as error:
        return {"error": str(error), "traceback": ""}
    except Exception as error:  # one run that fails must not sink the others, whatever its reason
        return {"error": f"{type(error).__name__}: {error}", "traceback": traceback.format_exc()}


def _executed(task: Task, recordings: str | None) -> Result:
    scenario = Scenario.from_toml(task.scenario, source=f"run {task.hash}")
    began = time.perf_counter()
    if task.world == THEORY:
        rows, timings = theory_metrics(scenario, task.burn_in), []
        curves: list[Any] = []
    else:
        scenario = scenario.with_overrides(seed=task.seed)
        observer = Observer(scenario)
        if task.world == "simulated":
            reports = _simulated(scenario, observer)
        else:
            reports = _launched(scenario, task, observer, recordings)
        elapsed_s = time.perf_counter() - began
        rows, curves = metrics(observer, reports, task.burn_in)
        steps = min((sum(life.completed for life in lives) for lives in reports.values()), default=0)
        timings = [Row(ALL, "", "", "rounds_per_s", steps / elapsed_s)]
    timings = [*timings, Row(ALL, "", "", "wall_s", time.perf_counter() - began)]
    return {"rows": rows, "curves": curves, "timings": timings}


def _simulated(scenario: Scenario, observer: Observer) -> Reports:
    simulation = Simulation(scenario, observe=observer)
    try:
        simulation.run()
    finally:
        simulation.close()
    return simulation.reports


def _launched(scenario: Scenario, task: Task, observer: Observer, recordings: str | None) -> Reports:
    """A live swarm, and then what its recording holds."""
    with TemporaryDirectory() as temporary:
        directory = Path(recordings or temporary)
        path = directory / f"{task.hash}.mcap"
        options = LaunchOptions(
            run=f"experiment-{task.hash}",
            logs=directory / f"{task.hash}.logs",
            recording=path,
            netns="auto" if task.world == "netns" else None,
        )
        result = Launcher(scenario, options).run()
        if result.failures:
            raise RunError("; ".join(result.failures))
        with Recording.open(path) as recording:
            for message, size in _recorded(recording, scenario):
                observer.take(message, size)
    return result.reports


def _recorded(recording: Recording, scenario: Scenario) -> Iterator[tuple[Message, int]]:
    """All legal messages of the nodes, in order, and how large they are."""
    system, run = scenario.system(), recording.metadata["run"]
    stages = {stage.name: stage for stage in (*BUILT_IN, *chosen(scenario).stages)}
    decoders: dict[str, Decoder] = {}
    for topic in recording.topics:
        try:
            found, name, stage = keys.parse(topic)
        except MessageError:
            continue
        if found == run and name is not None and stage in stages:
            node: NodeId = scenario.node_id(name)
            sizes: Mapping[str, int] = system.sizes(node)
            decoders[topic] = Decoder(stages[stage], node, sizes=sizes, ids=scenario.ids)
    for topic, data, *_ in recording.records(decoders):
        try:
            yield decoders[topic].decode(data), len(data)
        except MessageError:
            continue  # nobody in the swarm took it for one
