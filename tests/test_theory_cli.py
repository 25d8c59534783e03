"""design under links, what-if replays, compare and worst, as a user and a program meet them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from test_cli import FOUR, told, zfusion

SLOW = "[[links.edges]]\nfrom = 2\nto = 1\ndelay = 0.03\n"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a recording, and a file of links."""
    directory = tmp_path_factory.mktemp("theory")
    (directory / "slow.toml").write_text(SLOW)
    zfusion("simulate", FOUR, "--steps", "40", "--record", "run.mcap", "--run", "run", cwd=directory)
    return directory


def test_design_under_links(place: Path) -> None:
    design = told("design", FOUR, "--steps", "6", "--loss", "0.2", "--samples", "10", cwd=place)
    under, ideal = design["under_links"], design["error_covariance"]
    assert (under["samples"], under["exact"], under["confidence"]) == (10, False, 0.95)
    assert under["exact_steps"]["distributed"] == [2, 2, 2, 2]
    for stage in ("intermediate", "distributed"):
        mean, low, high = (np.array(under[kind][stage]) for kind in ("mean", "low", "high"))
        assert (mean.shape, low.shape) == ((7, 4, 1, 1), (7, 4))
        assert (low - 1e-12 <= mean[:, :, 0, 0]).all()
        assert (mean[:, :, 0, 0] <= high + 1e-12).all()
        assert (mean[1:] > np.array(ideal[stage])[1:]).all()
    shown = zfusion("design", FOUR, "--steps", "6", "--links", "slow.toml", cwd=place).stdout
    assert "exact, as nothing is left to chance" in shown
    shown = zfusion("design", FOUR, "--steps", "6", "--loss", "0.2", "--samples", "5", cwd=place).stdout
    assert "±" in shown
    assert "5 realisations" in shown
    assert "under_links" not in told("design", FOUR, "--steps", "2", cwd=place)


def test_what_if_a_link_had_been_slow(place: Path) -> None:
    done = told("replay", "run.mcap", "--links", "slow.toml", "-o", "slow.mcap", cwd=place)
    assert done["nodes"]["1"]["rms"] > 0
    assert done["nodes"]["2"]["rms"] == 0.0  # it hears neither 1 nor anybody who hears 1 in time for it
    assert done["nodes"]["1"]["before"]["rmse"] != done["nodes"]["1"]["after"]["rmse"]
    assert told("replay", "slow.mcap", "--verify", cwd=place)["different"] == 0
    revised = zfusion(
        "replay", "run.mcap", "--links", "slow.toml", "--late", "revise", "--window", "4", "-o", "re.mcap", cwd=place
    )
    assert "change" in revised.stdout
    again = told("replay", "slow.mcap", "--links", "recorded", "-o", "again.mcap", cwd=place)
    assert all(node["rms"] == 0.0 for node in again["nodes"].values())


def test_compare(place: Path) -> None:
    lossy = ("--steps", "10", "--seeds", "4", "--b", "links.loss=1.0")
    compared = told("compare", FOUR, *lossy, "--metric", "disagreement", cwd=place)
    assert compared["metric"] == "disagreement"
    assert set(compared["nodes"]) == {"1", "2", "3", "4"}
    assert compared["all"]["n"] == 4
    assert compared["all"]["above"] == 4
    assert compared["verdict"]
    recorded = zfusion("compare", "run.mcap", "slow.mcap", "--metric", "mse", cwd=place).stdout
    assert "stretches" in recorded


def test_a_witness_is_replayed(place: Path) -> None:
    found = told(
        "worst", "run.mcap", "--budget", "0.05", "--limit", "2", "-o", "w.toml", "--objective", "measured", cwd=place
    )
    assert found["worst"] > found["random_mean"]
    replayed = told("replay", "run.mcap", "--links", "w.toml", "-o", "worst.mcap", cwd=place)["nodes"]
    mean = np.mean([node["after"]["mse"] for node in replayed.values()])
    assert mean == pytest.approx(found["worst"], rel=1e-12)
    shown = zfusion("worst", FOUR, "--steps", "4", "--budget", "0.02", "--nodes", "3", cwd=place).stdout
    assert "nothing can be worse" in shown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("design", FOUR, "--samples", "1"), "--samples"),
        (("replay", "run.mcap", "--links", "none.toml", "-o", "x.mcap"), "none.toml"),
        (("replay", "run.mcap", "--late", "sloth", "-o", "x.mcap"), "timing.late"),
        (("compare", FOUR, "run.mcap"), "recordings are compared with recordings"),
        (("compare", FOUR, "--b", "timing.lat=3"), "timing.lat"),
        (("compare", FOUR, "--b", "nonsense"), "--b"),
        (("worst", FOUR, "--budget", "0.00001"), "budget"),
        (("worst", FOUR, "--nodes", "9"), "--nodes"),
        (("worst", FOUR, "--lose", "--delay", "1"), "--lose"),
        (("worst", FOUR, "--steps", "3", "--limit", "1", "-o", "/proc/nowhere/w.toml"), "/proc/nowhere"),
    ],
    ids=str,
)
def test_bad_usage(place: Path, arguments: tuple[str, ...], said: str) -> None:
    assert said in zfusion(*arguments, cwd=place, code=2).stderr
