"""Who is compared: methods made ready for one scenario, and those that cannot stand it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zfusion.drivers.designs import handed_on, with_design
from zfusion.drivers.rerun import on_recording, read_recorded
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError, ZfusionError
from zfusion.methods import METHODS
from zfusion.methods.check import check_method
from zfusion.model.scenario import Overrides, Scenario
from zfusion.model.types import Array
from zfusion.recording.reader import Recording
from zfusion.studies.settings import parse_settings, with_settings


@dataclass(frozen=True)
class Contestant:
    """A method that can run: under the scenario's links, and, where it has any, on the ideal network too."""

    label: str
    scenario: Scenario
    ideal: Scenario | None


@dataclass(frozen=True)
class Field:
    """All that are compared, and who could not be."""

    contestants: Sequence[Contestant]
    refused: Mapping[str, str]
    """By label the reason, in one line."""
    truths: Mapping[int, Array] | None = None
    """By step, of a recording; None where each seed draws its own."""


def field_of(scenario: Scenario, labels: Sequence[str], designs: Path) -> Field:
    """The methods that can stand the scenario, and the reasons of those that cannot; designs go into `designs`.

    A label is a method's name, with options after colons: ``consensus:rounds=8:step_size=fastest``. InputError for a
    name that is no method's or comes twice, and where nobody is left.
    """
    if len(set(labels)) != len(labels):
        raise InputError(f"--methods: expected every method once (is {', '.join(labels)})")
    contestants, refused = [], {}
    for number, label in enumerate(labels):
        try:
            contestants.append(_contestant(scenario, label, designs / f"{number}.npz"))
        except UnknownMethodError:
            raise
        except ZfusionError as error:
            refused[label] = _one_line(error, label)
    if not contestants:
        told = "; ".join(f"{label}: {reason}" for label, reason in refused.items())
        raise InputError(f"no method can stand {scenario.name}: {told}")
    return Field(contestants, refused)


def field_of_recording(
    recording: Recording, labels: Sequence[str], designs: Path, overrides: Overrides | None = None
) -> Field:
    """The same for the measurements on a recording, under its scenario's links or others.

    InputError also where the truth is not on it.
    """
    recorded = on_recording(recording)
    scenario = handed_on(recorded, recorded.with_overrides(**(overrides or {})))
    truths = read_recorded(recording, scenario).truths
    if not truths:
        raise InputError(f"{recording.path}: the true state is not on it: there is nothing to set estimates beside")
    field = field_of(scenario, labels, designs)
    return Field(field.contestants, field.refused, truths)


class UnknownMethodError(InputError):
    """A name that is no method's."""


def _contestant(scenario: Scenario, label: str, design: Path) -> Contestant:
    name, *settings = label.split(":")
    if name not in METHODS:
        raise UnknownMethodError(f"--methods: expected some of {', '.join(METHODS)} (is {name!r})")
    if settings:
        changed = {"name": name, "options": parse_settings(settings, "--methods")}
        wanted = with_settings(scenario, {"method": changed}, label)
    else:
        wanted = scenario.with_overrides(method=name)
        check_method(wanted, label)
    scenario = _ready(handed_on(scenario, wanted), design)
    ideal = _without_links(scenario)
    return Contestant(label, scenario, None if ideal is None else _ready(ideal, design.with_suffix(".ideal.npz")))


def _ready(scenario: Scenario, design: Path) -> Scenario:
    """With its design in a file, and known to start."""
    scenario = with_design(scenario, design)
    Simulation(scenario).close()
    return scenario


def _without_links(scenario: Scenario) -> Scenario | None:
    """The scenario on an ideal network; None where it has that anyway."""
    if not scenario.links.model_fields_set and not scenario.faults:
        return None
    document = tomllib.loads(scenario.anchored().to_toml())
    if scenario.links.topology is not None and isinstance(document.get("method"), dict):
        document["method"].pop("design", None)  # it is one for those topologies
    kept = {key: value for key, value in document.items() if key not in ("links", "faults")}
    return Scenario.model_validate(kept)


def _one_line(error: ZfusionError, label: str) -> str:
    lines = [line.removeprefix(f"{label}: ").removesuffix(" (is None)") for line in str(error).splitlines()]
    return "; ".join(line.removeprefix(f"method {label.partition(':')[0]}: ") for line in lines)
