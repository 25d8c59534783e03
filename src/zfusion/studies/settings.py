"""Settings by path, as a command line gives them: ``timing.late=revise`` in the place of what a scenario says."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

import tomli_w

from zfusion.errors import InputError, ScenarioError
from zfusion.methods.check import check_method
from zfusion.model.scenario import Scenario
from zfusion.model.schema.problems import Faults
from zfusion.studies.experiment.axes import is_path, with_values


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """``path=value`` each, the value as in TOML, or a plain text; InputError, which names the option, for any other."""
    settings = {}
    for text in texts:
        path, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not is_path(path):
            raise InputError(f"{option}: expected a setting like timing.late=drop (is {text!r})")
        settings[path] = _value(value)
    return settings


def with_settings(scenario: Scenario, settings: Mapping[str, Any], source: str) -> Scenario:
    """The scenario with these settings; ScenarioError, which names `source`, if that cannot be.

    Another policy for what is late does not inherit what only goes with the one before.
    """
    if not settings:
        return scenario
    document = tomllib.loads(scenario.anchored().to_toml())
    timing, late = document.get("timing", {}), settings.get("timing.late")
    if late is not None and late != "revise":
        timing.pop("window", None)
    if late == "wait":
        timing.pop("deadlines", None)
    try:
        changed = with_values(document, settings)
    except Faults as faults:
        raise ScenarioError(source, faults.problems) from None
    made = Scenario.from_toml(tomli_w.dumps(changed), source)
    check_method(made, source)
    return made


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
