"""--links and --loss on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from test_cli import FOUR, ROOT, told, zfusion

WIFI = str(ROOT / "examples" / "links" / "wifi.toml")
MISHAPS = str(ROOT / "examples" / "links" / "mishaps.toml")


def test_links_are_simulated_told_recorded_and_proved(tmp_path: Path) -> None:
    arguments = ("simulate", FOUR, "--steps", "100", "--links", WIFI, "--run", "w", "--record", "w.mcap")
    summary = told(*arguments, cwd=tmp_path)
    assert summary["late"] > 10
    assert sum(edge.get("lost", 0) for edge in summary["emulated"]) == summary["lost"] > 0
    assert told("replay", "w.mcap", "--verify", cwd=tmp_path)["different"] == 0
    again = told("replay", "w.mcap", "-o", "again.mcap", cwd=tmp_path)  # under the recorded scenario's links
    assert {change["rms"] for change in again["nodes"].values()} == {0.0}
    other = told("replay", "w.mcap", "--loss", "0.5", "-o", "other.mcap", cwd=tmp_path)
    assert all(change["rms"] > 0 for change in other["nodes"].values())


def test_faults_that_are_planned_for_later_are_named(tmp_path: Path) -> None:
    done = zfusion("simulate", FOUR, "--steps", "120", "--links", MISHAPS, "--no-record", "--json", cwd=tmp_path)
    assert "faults[4] begins after the last step, 120: it will not happen" in done.stderr
    assert "faults[3]" not in done.stderr


@pytest.mark.parametrize(
    ("command", "text", "expected"),
    [
        ("simulate", "[links]\nloss = 2\n", "links.toml: links.loss: expected a number <= 1 (is 2)"),
        ("launch", "[links]\ndelay = { trace = 'rtt.csv' }\n", "rtt.csv: cannot be read: No such file or directory"),
        (
            "simulate",
            "[[links.edges]]\nstages = 'measurment'\nloss = 0.1\n",
            "links.edges[0].stages: expected a stage: measurement, intermediate (is 'measurment')",
        ),
        (
            "launch",
            "[[faults]]\nkind = 'kill'\nnode = 5\nstep = 3\n",
            "faults[0].node: expected the id of a sensor (is 5)",
        ),
    ],
)
def test_what_is_wrong_is_said_before_anything_runs(tmp_path: Path, command: str, text: str, expected: str) -> None:
    (tmp_path / "links.toml").write_text(text)
    done = zfusion(command, FOUR, "--links", "links.toml", "--record", "r.mcap", cwd=tmp_path, code=2)
    assert expected in " ".join(done.stderr.split())
    assert not done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["links.toml"]
