"""Long runs: what is watched, what counts as growth, and that nothing grows with the number of steps."""

from __future__ import annotations

import csv
import gc
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import typer

from swarms import EXAMPLE, run_name, zfusion
from zfusion import gaps, used_sets
from zfusion.cli.soak import duration_s
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError
from zfusion.gaps import LIVES_WITH_HOLES, MAX_HOLES, GapCounter
from zfusion.links.chain import Chain
from zfusion.methods import neighbourhood
from zfusion.model import streams
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import load_scenario
from zfusion.model.streams import BLOCK, Seeds
from zfusion.studies.soak.growth import MEMORY, judge
from zfusion.studies.soak.samples import Course, read_samples
from zfusion.studies.soak.trend import MOST_POINTS, theil_sen
from zfusion.swarm.watch import NODE

OF_MEMORY = ("anonymous_bytes", "uss_bytes", "pss_bytes", "rss_bytes")

LEAK = """
kept = []

def leak(step, t_ns, sensor):
    kept.append(bytearray(b"x" * 300_000))
    return 0.0
"""

SMALL: dict[str, Any] = {
    "name": "pair",
    "network": {"generator": "complete"},
    "system": {"F": [[0.9]], "Q": [[0.1]], "initial_covariance": [[1.0]]},
    "sensors": [{"id": 1, "H": [[1.0]], "R": 0.5}, {"id": 2, "H": [[1.0]], "R": 0.5}],
    "timing": {"rate_hz": 20.0, "late": "wait"},
}


def written(directory: Path, name: str, **tables: Any) -> Path:
    path = directory / f"{name}.toml"
    path.write_text(tomli_w.dumps({**SMALL, "name": name, **tables}))
    return path


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1h", 3600), ("10m", 600), ("10min", 600), ("90s", 90), ("1.5h", 5400), ("7", 7), ("1d", 86400)],
)
def test_durations(text: str, seconds: float) -> None:
    assert duration_s(text) == seconds


@pytest.mark.parametrize("text", ["", "0s", "h", "1w", "-3s", "1h30"])
def test_no_durations(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="1h, 10m or 90s"):
        duration_s(text)


def test_a_trend_is_the_line_whatever_a_quarter_of_the_points_say() -> None:
    x = np.arange(40.0)
    y = 3.0 + 2.0 * x
    y[::4] = 1e6  # less than 29 %, the share that Theil and Sen's median stands
    assert theil_sen(x, y).slope == pytest.approx(2.0)


def test_a_trends_interval_holds_the_slope_as_often_as_it_says() -> None:
    random, x, runs = np.random.default_rng(5), np.linspace(0.0, 1.0, 30), 400
    found = [theil_sen(x, 2.0 * x + random.standard_normal(30)) for _ in range(runs)]
    held = sum(trend.low <= 2.0 <= trend.high for trend in found)
    sigma = np.sqrt(runs * 0.95 * 0.05)
    assert abs(held - 0.95 * runs) < 5 * sigma


def test_long_courses_are_thinned() -> None:
    x = np.arange(50.0 * MOST_POINTS)
    assert theil_sen(x, 0.5 * x).slope == pytest.approx(0.5)


def test_growth_is_what_is_surely_more_than_is_tolerated() -> None:
    def course(mib_per_hour: float) -> Course:
        t_s = np.arange(0.0, 3600.0, 10.0)
        nothing = np.zeros(len(t_s))
        columns = dict.fromkeys(COLUMNS, nothing) | {"anonymous_bytes": (40 + mib_per_hour * t_s / 3600) * 2**20}
        return Course(NODE, "1", t_s, columns)

    COLUMNS = (
        "fds", "threads", "cpu_s", "ahead", "held", "posted", "notices", "missed", "received", "skipped", "completed",
        "round_p50_us",
    )  # fmt: skip
    for rate, grows in ((0.0, False), (0.9 * MEMORY.tolerance, False), (1.5 * MEMORY.tolerance, True)):
        [memory] = [g for g in judge([course(rate)], 600.0, 0.1) if g.quantity is MEMORY]
        assert memory.grows is grows
        assert memory.per_hour.slope == pytest.approx(rate, abs=1e-9)


def test_a_run_that_leaks_is_told_from_one_that_does_not(tmp_path: Path) -> None:
    (tmp_path / "leak.py").write_text(LEAK)
    leaky = {**SMALL["sensors"][0], "source": {"kind": "python", "function": "leak.py:leak"}}
    path = written(tmp_path, "leaking", sensors=[leaky, SMALL["sensors"][1]])
    result = zfusion(
        tmp_path, "soak", path, "--for", "5s", "--interval", "0.2s", "--warm-up", "1s", "-o", "out", "--json",
        "--no-record", "--run", run_name("soak"),
    )  # fmt: skip
    assert result.code == 1, result.err
    told = result.summary
    assert told["verdict"] == "grows"
    assert [(g["process"], g["quantity"]) for g in told["growth"] if g["grows"]] == [("node 1", "memory")]
    [leak] = [g for g in told["growth"] if g["grows"]]
    assert leak["end"] - leak["start"] > 4.0  # MiB


def test_a_short_soak_leaves_samples_report_and_verdict(tmp_path: Path) -> None:
    path, run = written(tmp_path, "steady"), run_name("soak")
    result = zfusion(
        tmp_path, "soak", path, "--for", "4s", "--interval", "0.2s", "--warm-up", "1s",
        "-o", "out", "--json", "--run", run,
    )  # fmt: skip
    assert result.code == 0, result.err
    told, directory = result.summary, tmp_path / "out"
    assert told["verdict"] == "steady"
    assert (told["processes"], told["failures"], told["unwritten"]) == (4, [], 0)
    assert told["counters"]["completed"] == 2 * 80
    assert (directory / f"{run}.mcap").stat().st_size == told["recording_bytes"]
    with (directory / "samples.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["process"] for row in rows} == {"launcher", "recorder", "1", "2"}
    of_node = [row for row in rows if row["process"] == "1" and row["step"]]
    steps = [int(row["step"]) for row in of_node]
    assert steps == sorted(steps)
    assert int(of_node[-1]["received"]) == 2 * int(of_node[-1]["completed"])  # two stages, one neighbour
    assert all(2**20 < float(row[name]) < 2**30 for row in rows for name in OF_MEMORY)
    assert any(0 < float(row["round_p50_us"]) <= float(row["round_p99_us"]) for row in of_node if row["round_p50_us"])
    page = (directory / "report.html").read_text()
    assert "steady" in page
    assert page.count("<svg") == 7
    assert {course.name for course in read_samples(directory / "samples.csv")} == {
        "launcher",
        "recorder",
        "node 1",
        "node 2",
    }


def test_what_is_no_samples_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="no samples"):
        read_samples(tmp_path / "other.csv")


def test_nothing_in_a_swarm_grows_with_its_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Less than a number and a pointer to it a node and step: whatever is kept of a step takes that at least."""
    monkeypatch.setattr(used_sets, "KEPT_RUNS", 32)  # what is bounded is to reach its bounds before it is measured
    monkeypatch.setattr(neighbourhood, "COMBINATIONS", 16)
    monkeypatch.setattr(streams, "KEPT_ENDS", 2)
    monkeypatch.setattr(gaps, "MAX_HOLES", 8)
    scenario = load_scenario(written(tmp_path, "lossy", timing={"rate_hz": 20.0}), steps=1600, loss=0.1)
    warm, first, last = (
        20 + n * BLOCK for n in (1, 3, 6)
    )  # at the same place in a block: they fill, and are let go of
    tracemalloc.start()
    try:
        simulation, sizes = Simulation(scenario), []
        for step in (warm, first, last):
            simulation.run(simulation.epoch_ns + step * 50_000_000)
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert min(node.step for node in simulation.nodes.values()) >= last - 1
    assert sizes[2] - sizes[1] < len(scenario.ids) * (last - first) * (struct.calcsize("P") + sys.getsizeof(1.0))


def test_what_was_forgotten_of_a_path_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "KEPT_ENDS", 3)
    system = load_scenario(EXAMPLE).system()
    path, steps = SamplePath(system, 3), [1, 9 * BLOCK + 7, 3 * BLOCK, 20 * BLOCK, 5]
    found = [path.truth(k).tolist() for k in steps]
    assert len(path._entries._known) <= 3
    monkeypatch.setattr(streams, "KEPT_ENDS", 1000)
    whole = SamplePath(system, 3)
    assert found == [whole.truth(k).tolist() for k in steps]


def test_what_was_forgotten_of_a_chain_is_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds = Seeds(1)

    def chain() -> Chain:
        return Chain(
            (0.5, 0.5),
            ((0.9, 0.1), (0.2, 0.8)),
            lambda block: seeds.generator("test", block=block).random(BLOCK).tolist(),
        )

    whole = chain()
    wanted = {k: whole(k) for k in range(1, 12 * BLOCK)}
    monkeypatch.setattr(streams, "KEPT_ENDS", 3)
    forgetful, order = chain(), np.random.default_rng(0).permutation(np.arange(1, 12 * BLOCK, 97)).tolist()
    assert {k: forgetful(k) for k in order} == {k: wanted[k] for k in order}
    assert len(forgetful._before._known) <= 3


def test_holes_of_many_lives_are_not_all_remembered() -> None:
    counter, lives, each = GapCounter(), 50, 200
    for born in range(1, lives + 1):
        for n in range(each):
            counter.observe(born, 2 * n + 1)  # every other one is missing
    told = counter.gaps()
    assert (told.received, told.lost_before, told.lost_between) == (lives * each, lives, lives * (each - 1))
    kept = sum(len(life.holes) for life in counter._lives.values())
    assert kept == LIVES_WITH_HOLES * each
    assert kept <= LIVES_WITH_HOLES * MAX_HOLES
