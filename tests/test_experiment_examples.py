"""The examples' experiments, in the small size that their files describe, and what they are said to show."""

import csv
from pathlib import Path

import pytest

from zfusion.studies.experiment.engines import one_by_one
from zfusion.studies.experiment.plan import plan
from zfusion.studies.experiment.run import run_experiment
from zfusion.studies.experiment.spec import load_experiment

EXAMPLES = Path(__file__).parents[1] / "examples"

Means = dict[tuple[str, ...], dict[str, float]]


def run_small(name: str, directory: Path) -> Means:
    """For every point, by its labels, the metrics of the network as a whole, "stage metric"."""
    made = plan(load_experiment(EXAMPLES / f"{name}.toml", small=True))
    outcome = run_experiment(made, directory, one_by_one)
    assert outcome.failed == []
    assert outcome.done == outcome.runs > 0
    with (directory / "summary.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["node"] == "all"]
    found: Means = {}
    for row in rows:
        of_point = found.setdefault(tuple(row[axis] for axis in made.axes), {})
        of_point[f"{row['stage']} {row['metric']}".strip()] = float(row["mean"])
    return found


def test_latency(tmp_path: Path) -> None:
    found = run_small("latency", tmp_path)
    assert len(found) == 10
    for policy in ("drop", "revise"):
        fast, slow = found["0.001", policy, "0.45"], found["0.02", policy, "0.45"]
        assert fast["measurement used_fraction"] > 0.9 > slow["measurement used_fraction"]
        assert slow["measurement used_fraction"] > found["0.02", policy, "0.2"]["measurement used_fraction"]
        assert fast["estimate predicted_mse"] < slow["estimate predicted_mse"]
    drop, revise = (found["0.02", policy, "0.45"] for policy in ("drop", "revise"))
    wait = found["0.02", "wait", "none"]
    assert revise["measurement revised"] > 0 == drop["measurement revised"]
    assert wait["estimate predicted_mse"] < revise["estimate predicted_mse"] < drop["estimate predicted_mse"]
    assert wait["measurement used_fraction"] == 1
    assert wait["estimate response_p99"] > 0.05 > drop["estimate response_p99"]


def test_loss(tmp_path: Path) -> None:
    found = run_small("loss", tmp_path)
    for kind, label in (("independent", "0.4"), ("bursts", "bursts 0.4")):
        lossy = found[kind, "0.4", label]
        assert 0.4 < lossy["measurement used_fraction"] < 0.8
        assert lossy["fallbacks"] == 0
    assert found["independent", "0.0", "0.0"]["estimate mse"] == found["bursts", "0.0", "no bursts"]["estimate mse"]
    ages = [found[kind, "0.4", label]["intermediate age"] for kind, label in (
        ("independent", "0.4"), ("bursts", "bursts 0.4"),
    )]  # fmt: skip
    assert ages[0] < ages[1]


def test_churn(tmp_path: Path) -> None:
    found = run_small("churn", tmp_path)
    assert [found["two_stage", who]["restarts"] for who in ("none", "one", "each in turn", "all")] == [0, 1, 4, 4]
    for who in ("one", "each in turn", "all"):
        assert found["two_stage", who]["estimate predicted_mse"] > found["two_stage", "none"]["estimate predicted_mse"]
        assert found["two_stage", who]["estimate predicted_mse"] < found["local", who]["estimate predicted_mse"]


def test_topology(tmp_path: Path) -> None:
    found = run_small("topology", tmp_path)
    ring, grid = found["ring",], found["grid",]
    assert ring["estimate predicted_mse"] > grid["estimate predicted_mse"] > grid["estimate bound_centralized"]
    assert ring["estimate predicted_mse"] == pytest.approx(ring["estimate design_mse"])
