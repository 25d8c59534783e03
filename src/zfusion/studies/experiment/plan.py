"""From the experiment file to the runs: every point a scenario that is checked before anything runs."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import tomli_w

from zfusion.errors import Problem, ScenarioError
from zfusion.methods.check import check_method
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.schema.problems import Faults
from zfusion.studies.experiment.axes import Block, Choice, Label, choices, keys_of, paths_of, quoted, with_values
from zfusion.studies.experiment.catalogue import ALL, METRICS_VERSION
from zfusion.studies.experiment.spec import Experiment

THEORY = "theory"
"""The "world" of what is predicted and not run."""

THEORY_FACTS = ("system", "sensors", "noise", "network", "steps")
"""All of a scenario that the prediction for a perfect network depends on."""

NOT_DEFINING = ("name", "description", "seed")
"""What of a scenario's document does not define a run; the seed is the run's own."""


@dataclass(frozen=True)
class Task:
    """One run, or one prediction: plain data that can be sent to another process or machine."""

    hash: str
    """Of all that defines its result."""
    world: str
    scenario: str
    """As TOML, with absolute paths."""
    seed: int
    burn_in: int


@dataclass(frozen=True)
class Point:
    """One combination of the axes' values."""

    number: int
    labels: Mapping[str, Label]
    """By axis."""
    scenario: Scenario
    seeds: tuple[Task, ...]
    """One run for each seed."""
    theory: Task

    @property
    def text(self) -> str:
        """The point in words."""
        return ", ".join(f"{path} = {label}" for path, label in self.labels.items()) or "the scenario as it is"


@dataclass(frozen=True)
class Plan:
    """All points of an experiment."""

    experiment: Experiment
    axes: tuple[str, ...]
    points: tuple[Point, ...]

    @cached_property
    def tasks(self) -> dict[str, Task]:
        """All that is to be done, each once, by hash: the predictions first."""
        theory = {point.theory.hash: point.theory for point in self.points}
        return theory | {task.hash: task for point in self.points for task in point.seeds}


def plan(experiment: Experiment) -> Plan:
    """The plan of an experiment; ScenarioError with all that is wrong with any of its points."""
    base = _base(experiment)
    points: list[Point] = []
    problems: dict[str, Problem] = {}
    for choice in choices(experiment.blocks):
        try:
            scenario = _scenario(experiment, base, choice)
            _check_run(experiment, scenario)
        except ScenarioError as error:
            for problem in error.problems:
                told = _told(experiment, choice, problem)
                problems.setdefault(str(told), told)
        else:
            points.append(_point(experiment, len(points), choice, scenario))
    if problems:
        raise ScenarioError(experiment.source, problems.values())
    return Plan(experiment, paths_of(experiment.blocks), tuple(points))


def _base(experiment: Experiment) -> dict[str, Any]:
    """The base scenario's document."""
    try:
        return tomllib.loads(load_scenario(experiment.scenario).to_toml())
    except ScenarioError as error:
        if [problem.field for problem in error.problems] == ["file"]:
            [problem] = error.problems
            raise ScenarioError(
                experiment.source, [Problem("experiment.scenario", experiment.spec.scenario, problem.expected)]
            ) from None
        raise


def _scenario(experiment: Experiment, base: Mapping[str, Any], choice: Choice) -> Scenario:
    """The scenario of a point."""
    try:
        document = with_values(base, experiment.spec.set)
        document = with_values(document, {path: value.value for path, value in choice})
    except Faults as faults:
        raise ScenarioError(experiment.source, faults.problems) from None
    scenario = Scenario.from_toml(tomli_w.dumps(document), experiment.source, experiment.scenario.parent)
    check_method(scenario, experiment.source)
    return scenario


def _check_run(experiment: Experiment, scenario: Scenario) -> None:
    """What the scenario must be for the experiment."""
    if scenario.steps <= experiment.spec.burn_in:
        expected = f"expected more steps than the {experiment.spec.burn_in} of burn_in"
        raise ScenarioError(experiment.source, [Problem("steps", scenario.steps, expected)])
    if ALL in scenario.ids:
        expected = "expected another name: in the tables it stands for the network as a whole"
        raise ScenarioError(experiment.source, [Problem("sensors", ALL, expected)])


def _told(experiment: Experiment, choice: Choice, problem: Problem) -> Problem:
    """A problem of a point's scenario, at its place in the experiment's file where that can be said."""
    keys = keys_of(problem.field)
    values = dict(choice)
    for path, block, column in _columns(experiment.blocks):
        if _related(keys, keys_of(path)):
            row = [values[path] == line[column] for line in block.rows].index(True)
            place = f"axes.{block.places[column]}[{row}]"
            return Problem(place, values[path].label, f"{problem.field}: {problem.expected}")
    for path, value in experiment.spec.set.items():
        if _related(keys, keys_of(path)):
            return Problem(f"experiment.set.{quoted(path)}", value, f"{problem.field}: {problem.expected}")
    where = "; ".join(f"{path} = {value.label}" for path, value in choice)
    return Problem(problem.field, problem.value, problem.expected + (f", at the point {where}" if where else ""))


def _columns(blocks: Iterable[Block]) -> Iterator[tuple[str, Block, int]]:
    for block in blocks:
        for column, path in enumerate(block.paths):
            yield path, block, column


def _related(field: list[str | int], path: list[str | int]) -> bool:
    """Whether a field is what a path sets, part of it, or (as with a table that should not be there) around it."""
    return field[: len(path)] == path or path[: len(field)] == field


def _point(experiment: Experiment, number: int, choice: Choice, scenario: Scenario) -> Point:
    spec = experiment.spec
    document, files = tomllib.loads(scenario.to_toml()), _files(scenario)
    text = scenario.anchored().to_toml()
    facts = {
        "metrics": METRICS_VERSION,
        "world": spec.world,
        "burn_in": spec.burn_in,
        "scenario": {key: value for key, value in document.items() if key not in NOT_DEFINING},
        "files": files,
    }
    seeds = tuple(Task(_hash({**facts, "seed": seed}), spec.world, text, seed, spec.burn_in) for seed in spec.seeds)
    known = {key: document[key] for key in THEORY_FACTS if key in document}
    theory = {**facts, "world": THEORY, "scenario": known, "files": []}
    labels = {path: value.label for path, value in choice}
    return Point(number, labels, scenario, seeds, Task(_hash(theory), THEORY, text, 0, spec.burn_in))


def _hash(facts: Mapping[str, Any]) -> str:
    """The first 16 hex digits of SHA-256: among a million runs, two alike have a probability of 3e-8."""
    text = json.dumps(facts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _files(scenario: Scenario) -> list[tuple[str, str]]:
    """Names and SHA-256 of the files that a scenario reads, in its order; where they are does not matter."""
    pieces = (*map(scenario.source_of, scenario.ids), scenario.links, scenario.method)
    files = [scenario.absolute(path) for piece in pieces for path in piece.paths()]
    return [(file.name, hashlib.sha256(file.read_bytes()).hexdigest()) for file in files if file.is_file()]
