"""The experiment file: a base scenario, what varies, how often it is repeated, and what is measured."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from zfusion.errors import Problem, ScenarioError
from zfusion.model.schema.base import Count, Name, Natural, Options, Spec
from zfusion.model.schema.problems import Faults, below
from zfusion.studies.experiment.axes import Block, blocks_of, is_path, quoted
from zfusion.studies.experiment.catalogue import METRICS

World = Literal["simulated", "live", "netns"]
"""Where runs take place: in virtual time, as processes of this machine, each of them in a network namespace."""


class SeedRange(Spec):
    """`count` seeds from `first` on."""

    first: Natural = 1
    count: Count


def _seeds(value: object) -> object:
    """A range as the list that it stands for."""
    if isinstance(value, Mapping):
        try:
            span = SeedRange.model_validate(value)
        except ScenarioError as error:
            raise Faults(error.problems) from None
        return list(range(span.first, span.first + span.count))
    return value


Seeds = Annotated[tuple[Natural, ...], BeforeValidator(_seeds), Field(min_length=1)]


def _confidence(value: object) -> object:
    if not isinstance(value, float) or not 0 < value < 1:
        raise ValueError("expected a number between 0 and 1")
    return value


Confidence = Annotated[float, BeforeValidator(_confidence)]


class SmallSpec(Spec):
    """What `--small` puts in the place of the rest of the file: for a first look, and for tests."""

    seeds: Seeds | None = None
    set: Options = Field(default_factory=dict)
    axes: Options = Field(default_factory=dict)
    """Axes by their paths, with fewer values."""
    burn_in: Natural | None = None


class ExperimentSpec(Spec):
    """The table `[experiment]`."""

    name: Name | None = None
    description: str = ""
    scenario: str
    """The base scenario's file, relative to this one."""
    world: World = "simulated"
    seeds: Seeds = tuple(range(1, 11))
    """Of measurements and network alike: points that differ in their axes only share them."""
    burn_in: Natural = 0
    """The first steps, which averages over time leave out."""
    confidence: Confidence = 0.95
    """Of the intervals over seeds."""
    metrics: tuple[str, ...] | None = None
    """Those that go into the tables; by default all."""
    series: Natural = 5
    """Seeds of which errors over time go into the tables one by one."""
    set: Options = Field(default_factory=dict)
    """What replaces values of the base scenario at every point, by path."""
    small: SmallSpec = SmallSpec()

    @model_validator(mode="after")
    def _check(self) -> Self:
        problems = [
            Problem(f"metrics[{number}]", name, f"expected one of {', '.join(METRICS)}")
            for number, name in enumerate(self.metrics or ())
            if name not in METRICS
        ]
        if len(set(self.seeds)) < len(self.seeds):
            problems.append(Problem("seeds", list(self.seeds), "expected seeds that differ"))
        for place, table in (("set", self.set), ("small.set", self.small.set)):
            problems += [
                Problem(f"{place}.{quoted(path)}", value, "expected a path like 'timing.rate_hz'")
                for path, value in table.items()
                if not is_path(path)
            ]
        if problems:
            raise Faults(problems)
        return self


def _axes(value: Any) -> Any:
    if isinstance(value, Mapping):
        blocks_of(value)
    return value


class ExperimentDocument(Spec):
    """The whole file."""

    experiment: ExperimentSpec
    axes: Annotated[Options, BeforeValidator(_axes)] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> Self:
        problems = [
            Problem(path, values, "expected an axis of [axes]")
            for path, values in self.experiment.small.axes.items()
            if path not in self.axes
        ]
        try:
            self.blocks(small=True)
        except Faults as faults:
            problems += faults.problems
        if problems:
            raise Faults(below("experiment.small.axes", problem) for problem in problems)
        return self

    def blocks(self, *, small: bool) -> tuple[Block, ...]:
        """The axes."""
        return blocks_of({**self.axes, **self.experiment.small.axes} if small else self.axes)


@dataclass(frozen=True, slots=True)
class Experiment:
    """An experiment as it is to be run, in its full or its small size."""

    name: str
    spec: ExperimentSpec
    blocks: tuple[Block, ...]
    source: str
    """The file's name, for messages."""
    text: str
    """The file itself."""
    directory: Path
    small: bool = False

    @property
    def scenario(self) -> Path:
        """The base scenario's file."""
        return self.directory / self.spec.scenario


def load_experiment(path: str | Path, *, small: bool = False) -> Experiment:
    """The experiment in a file; ScenarioError with all that is wrong with it. `small`: as `[experiment.small]` says."""
    path = Path(path)
    document, text = _read(path)
    try:
        whole = ExperimentDocument.model_validate(document)
    except ScenarioError as error:
        raise ScenarioError(str(path), error.problems) from None
    spec = whole.experiment
    blocks = whole.blocks(small=small)
    if small:
        less = spec.small
        changes: dict[str, Any] = {"set": {**spec.set, **less.set}}
        changes |= {} if less.seeds is None else {"seeds": less.seeds}
        changes |= {} if less.burn_in is None else {"burn_in": less.burn_in}
        spec = spec.model_copy(update=changes)
    return Experiment(spec.name or path.stem, spec, blocks, str(path), text, path.parent.absolute(), small)


def _read(path: Path) -> tuple[dict[str, Any], str]:
    try:
        text = path.read_text(encoding="utf-8")
        return tomllib.loads(text), text
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        problem = Problem("file", str(path), f"expected an experiment file that can be read: {reason}")
    except tomllib.TOMLDecodeError as error:
        problem = Problem("file", str(path), f"expected valid TOML: {error}")
    raise ScenarioError(str(path), [problem])
