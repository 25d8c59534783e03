"""From the data to a scenario: settings of the study, who hears whom, and the files that a swarm runs on."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Sequence
from math import floor
from pathlib import Path

import numpy as np

from zfusion.errors import InputError, Problem, ScenarioError
from zfusion.model.scenario import Scenario
from zfusion.model.schema.base import Count, Natural, Positive, Spec
from zfusion.studies.library.data import Link, Readings, load_links, load_readings
from zfusion.studies.library.field import FieldModel, identify

SCENARIO = "scenario.toml"
TABLE = "readings.csv"
ROUND = "round"
"""The column of the table that numbers the rounds."""


class Study(Spec):
    """Settings of the study; see examples/library.toml."""

    train_fraction: Positive
    """The part of the rounds, from the first on, that the model is identified from; the swarm runs on the rest."""
    held_out: tuple[Natural, ...]
    """Motes that are not in the swarm; it predicts them."""
    modes: Natural
    """Spatial modes beside the common temperature."""
    max_mean_lqi: Positive
    """A mote hears another if it told so often enough and with a mean link cost of at most this."""
    min_reports: Count


def load_study(path: str | Path) -> Study:
    """The settings in a TOML file; ScenarioError with all that is wrong."""
    try:
        document = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ScenarioError(str(path), [Problem("file", str(path), f"expected a TOML file: {error}")]) from None
    return Study._read(document, str(path))


def prepare(study: Study, data: str | Path, out: str | Path) -> Path:
    """Write the scenario and the table it reads into the directory `out`; the path of the scenario.

    Raises InputError for data that are missing or do not fit the study.
    """
    if study.train_fraction >= 1:
        raise InputError(
            f"train_fraction: expected less than 1, so that something is left to run on, not {study.train_fraction}"
        )
    readings, links = load_readings(Path(data)), load_links(Path(data))
    strangers = sorted(set(study.held_out) - set(readings.motes))
    if strangers:
        raise InputError(f"held_out: there is no mote {strangers[0]}; the data are of {list(readings.motes)}")
    members = [mote for mote in readings.motes if mote not in study.held_out]
    if not members:
        raise InputError("held_out: expected at least one mote to be left for the swarm")
    training = floor(study.train_fraction * readings.rounds)
    model = identify(readings, members, study.modes, training)
    scenario = scenario_of(model, hearing(links, members, study), training, readings.rounds - training)
    path = Path(out) / SCENARIO
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_table(path.parent / TABLE, readings, members, training)
    path.write_text(f"# Made by `zfusion library prepare`.\n\n{scenario.to_toml()}", encoding="utf-8")
    return path


def hearing(links: Sequence[Link], members: Sequence[int], study: Study) -> list[tuple[int, int]]:
    """The edges (from, to) between members: those links that the study's thresholds call good."""
    return sorted(
        (link.heard, link.node)
        for link in links
        if {link.heard, link.node} <= set(members)
        and link.reports >= study.min_reports
        and link.mean_lqi <= study.max_mean_lqi
    )


def scenario_of(model: FieldModel, edges: Sequence[tuple[int, int]], training: int, steps: int) -> Scenario:
    """The scenario in which step k is round `training` + k, read from the table beside it."""
    return Scenario.model_validate(
        {
            "name": "library",
            "description": f"Temperatures in a library from round {training + 1} on; the model is of the rounds before",
            "steps": steps,
            "timing": {"free_run": True},
            "network": {"edges": edges},
            "system": {
                "F": model.F,
                "Q": {"diagonal": np.diag(model.Q)},
                "initial_mean": model.initial_mean,
                "initial_covariance": {"diagonal": np.diag(model.initial_covariance)},
            },
            "sensors": [{"id": mote, "H": model.H[mote][np.newaxis], "R": model.R[mote]} for mote in model.members],
            "source": {
                "kind": "csv",
                "file": TABLE,
                "columns": ["{id}"],
                "step_column": ROUND,
                "first_step": training + 1,
            },
        }
    )


def _write_table(path: Path, readings: Readings, members: Sequence[int], training: int) -> None:
    """A row for each round after the training, a column for each member; empty where a reading is missing."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([ROUND, *members])
        for number, row in enumerate(readings.of(members)[training:].tolist(), start=training + 1):
            writer.writerow([number, *("" if np.isnan(celsius) else celsius for celsius in row)])
