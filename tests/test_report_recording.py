"""Reports of recordings: what arrived when, how far off the estimates were, and who sent what to whom."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.artist import Artist
from typer.testing import CliRunner

from reports import Page
from simulations import MS, by_rule, four_sensor, walk
from zfusion import keys
from zfusion.cli import app
from zfusion.drivers.simulated import simulate
from zfusion.errors import InputError, RecordingError, RunError
from zfusion.messages import encode
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording, RecordingWriter
from zfusion.recording.info import info
from zfusion.report.figures.space_time import Fate
from zfusion.report.recording_report import _budget, _page, write_report
from zfusion.report.run_facts import RunFacts
from zfusion.stages import TRUTH_SENDER, Message

EPOCH = 1_790_000_000_000_000_000
PERIOD = 50 * MS
SAMPLE = Path(__file__).parents[1] / "recordings" / "sample.mcap"


def by_hand(
    path: Path, said: list[tuple[Any, int, str, int, dict[str, Any]]], scenario: Scenario | None = None
) -> Path:
    """A recording of (node, step, stage, sent ns, fields) in order; it comes to the recorder 1 ms later."""
    counters: dict[tuple[Any, str], int] = {}
    scenario = scenario or four_sensor()
    with RecordingWriter(path, scenario_toml=scenario.to_toml(), run="r", method="two_stage", seed=1) as writer:
        for node, step, stage, sent, fields in said:
            seq = counters[node, stage] = counters.get((node, stage), -1) + 1
            topic = keys.truth_key("r") if stage == "truth" else keys.stage_key("r", node, stage)
            writer.write(topic, encode(Message(node, step, stage, seq, 1, sent, fields)), sent + MS)
    return path


def story(latencies: bool) -> Iterator[tuple[Any, int, str, int, dict[str, Any]]]:
    """Step 1 as seen by node 1, that hears 2 and 3: 2's measurement is late, and 3's intermediate estimate lost."""
    due = EPOCH + PERIOD
    yield 1, 1, "event", EPOCH, {"kind": "started", "data": {"epoch_ns": EPOCH}}
    yield TRUTH_SENDER, 1, "truth", due, {"x": np.array([1.0])}
    for node in (1, 2, 3):
        yield node, 1, "measurement", due, {"y": np.array([0.5])}
    for node in (1, 2, 3):
        used = (1, 3) if node == 1 else (node,)
        yield node, 1, "intermediate", due + 22 * MS, {"x": np.array([0.9]), "used": used, "history": ()}
    P = np.array([[0.25]])
    yield 1, 1, "estimate", due + 45 * MS, {"x": np.array([1.5]), "P": P, "used": (1, 2), "excluded": ()}
    yield 1, 2, "event", due + 60 * MS, {"kind": "revised", "data": {"taken": [[1, [2]]]}}
    if latencies:
        measured = {"from": 3, "stage": "measurement", "steps": [[1, 1]], "latency_ns": [7 * MS]}
        late = {"from": 2, "stage": "measurement", "steps": [[1, 1]], "latency_ns": [30 * MS]}
        used = {"from": 2, "stage": "intermediate", "steps": [[1, 1]], "latency_ns": [2 * MS]}
        yield 1, 2, "arrivals", due + 70 * MS, {"data": {"edges": [measured, late, used]}}


def facts_of(path: Path) -> tuple[RunFacts, Recording]:
    recording = Recording.open(path)
    return RunFacts(recording), recording


def test_the_fate_of_every_message(tmp_path: Path) -> None:
    facts, recording = facts_of(by_hand(tmp_path / "r.mcap", list(story(latencies=True))))
    with recording:
        flights = {(f.sender, f.stage): f for f in facts.flights(range(1, 2)) if f.receiver == 1}
    due = EPOCH + PERIOD
    assert {edge: (f.fate, f.arrived_ns) for edge, f in flights.items()} == {
        (3, "measurement"): (Fate.USED, due + 7 * MS),
        (2, "measurement"): (Fate.REVISED, due + 30 * MS),
        (2, "intermediate"): (Fate.USED, due + 24 * MS),
        (3, "intermediate"): (Fate.LOST, None),
    }
    assert {f.sent_ns for f in flights.values()} == {due, due + 22 * MS}
    channel = facts.channels[(2, 1), "measurement"]
    assert (channel.expected, channel.used, channel.latencies_ns) == (1, 0, {1: 30 * MS})


def test_a_message_that_was_late_and_not_revised(tmp_path: Path) -> None:
    said = [line for line in story(latencies=True) if line[4].get("kind") != "revised"]
    facts, recording = facts_of(by_hand(tmp_path / "r.mcap", said))
    with recording:
        [late] = [f for f in facts.flights(range(1, 2)) if f.fate is Fate.LATE]
    assert (late.sender, late.receiver, late.arrived_ns) == (2, 1, EPOCH + PERIOD + 30 * MS)


def test_without_measured_latencies_the_recorders_times_stand_in(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "r.mcap", [line for line in story(latencies=False) if line[4].get("kind") != "revised"])
    facts, recording = facts_of(path)
    with recording:
        flights = {(f.sender, f.stage): f for f in facts.flights(range(1, 2)) if f.receiver == 1}
    assert not facts.has_latencies
    assert flights[3, "measurement"].arrived_ns == EPOCH + PERIOD + MS
    assert {edge for edge, f in flights.items() if f.fate is Fate.UNUSED} == {(2, "measurement"), (3, "intermediate")}
    page = Page(write_report(path, tmp_path / "r.html"))
    page.check()
    assert "The nodes did not tell when messages came" in page.words
    assert "Latency to the recorder, by sender" in page.words


def test_rounds_and_their_deadlines(tmp_path: Path) -> None:
    facts, recording = facts_of(by_hand(tmp_path / "r.mcap", list(story(latencies=True))))
    with recording:
        [this] = facts.rounds(range(1, 2), [])
    assert this.due_ns == EPOCH + PERIOD
    assert this.deadlines_ns == {"measurement": this.due_ns + 22_500_000, "intermediate": this.due_ns + 45 * MS}


def test_errors_and_counts_are_those_of_the_run(tmp_path: Path) -> None:
    """A simulation with losses: its own reports say the same as what the report finds on the recording."""
    scenario = walk(40)
    lost = by_rule(lambda edge, message: None if (message.step + edge[0]) % 5 == 0 else 2 * MS)  # type: ignore[operator]
    reports = simulate(scenario, run="r", output=tmp_path / "r.mcap", link=lost)
    facts, recording = facts_of(tmp_path / "r.mcap")
    with recording:
        page = _page(facts, info(recording), None)
    for node, [report] in reports.items():
        errors = facts.errors[node]
        assert float(errors.squared.mean()) == pytest.approx(report.errors["estimate"]["mse"], rel=1e-12)
        assert float(errors.predicted.mean()) == pytest.approx(report.errors["estimate"]["predicted_mse"], rel=1e-12)
        assert errors.nees == pytest.approx(report.errors["estimate"]["nees"] / 2, rel=1e-9)
        for sender, counters in report.edges.items():
            for stage, received in counters["received"].items():
                channel = facts.channels[(scenario.node_id(sender), node), stage]
                assert (channel.used, channel.expected) == (received, 40)
    pictures = {picture.name: picture for picture in page.pictures}
    artists = {gid: a for a in pictures["error-over-time"].figure.findobj(Artist) if (gid := a.get_gid())}
    mean = np.sqrt(np.mean([e.squared for e in facts.errors.values()], axis=0))
    assert np.allclose(artists["measured"].get_ydata(), mean)
    assert {"network", "space-time", "error-components"} <= set(pictures)
    nodes = next(a for a in pictures["network"].figure.findobj(Artist) if a.get_gid() == "nodes")
    assert len(nodes.get_offsets()) == 5


def test_the_steps_with_the_most_trouble_are_shown(tmp_path: Path) -> None:
    trouble = by_rule(lambda _, message: None if message.step in (31, 33) else 0)
    simulate(walk(60), run="r", output=tmp_path / "r.mcap", link=trouble)
    facts, recording = facts_of(tmp_path / "r.mcap")
    with recording:
        chosen = facts.interesting(12)
        lost = [f for f in facts.flights(chosen) if f.fate is not Fate.USED]
    assert len(chosen) == 12
    assert {31, 33} <= set(chosen)
    assert {f.step for f in lost} == {31, 33}


def test_without_trouble_the_largest_error_is_shown(tmp_path: Path) -> None:
    simulate(walk(60), run="r", output=tmp_path / "r.mcap")
    facts, recording = facts_of(tmp_path / "r.mcap")
    with recording:
        squared = {int(k): v for e in facts.errors.values() for k, v in zip(e.steps, e.squared, strict=True)}
        largest = max(float(e.squared.max()) for e in facts.errors.values())
        worst = [int(e.steps[e.squared.argmax()]) for e in facts.errors.values() if e.squared.max() == largest]
        assert worst[0] in facts.interesting(12)
        assert facts.interesting(500) == range(1, 61)
    assert len(squared) == 60


def test_what_the_time_of_a_round_goes_into(tmp_path: Path) -> None:
    budget = {"rounds": 4, "edges": {"2": {"measurement": [0, 4000, 8000, 0, 0, 0, 0, 0],
                                           "intermediate": [0, 0, 4000, 0, 0, 0, 0, 4000]}}}  # fmt: skip
    said = [
        *story(latencies=True),
        (1, 3, "event", EPOCH + 9 * PERIOD, {"kind": "stopped", "data": {"budget": budget}}),
    ]
    facts, recording = facts_of(by_hand(tmp_path / "r.mcap", said))
    with recording:
        [(edge, parts)] = _budget(facts).items()
    assert edge == "2 → 1"
    assert {part: us for part, us in parts.items() if us} == {"behind": 1.0, "wire": 3.0, "finished": 1.0}


def test_the_report_is_one_file_that_needs_nothing_else(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "r.mcap", list(story(latencies=True)), four_sensor().model_copy(update={"name": "four"}))
    page = Page(write_report(path, tmp_path / "deep" / "r.html", figures=tmp_path / "figures"))
    page.check()
    for words in ("Run r", "revised step 1", "4 of 6 messages", "2 → 1", "scenario.toml", "one-way latency [ms]"):
        assert words in page.words, words
    arrived = {(row[0], row[1]): row[2:6] for row in page.rows("edge", "stage")}
    assert arrived["2 → 1", "measurement"] == ["1", "0", "0.00%", "1"]
    assert arrived["2 → 1", "intermediate"] == ["1", "1", "100.00%", "0"]
    [errors] = page.rows("node", "estimates")[:1]
    assert errors == ["1", "1", "0.5", "0.5", "1.000", "1.000"]
    names = {i for i in page.ids if f'<figure id="{i}"' in page.html}
    assert {file.name for file in (tmp_path / "figures").iterdir()} == {
        f"{n}.{e}" for n in names for e in ("svg", "png")
    }


def test_names_are_escaped_and_garbage_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    scenario = walk(5, names=True)
    with RecordingWriter(path, scenario_toml=scenario.to_toml(), run="r", method="two_stage", seed=1) as writer:
        event = Message("ada", 1, "event", 0, 1, EPOCH, {"kind": "<b>odd</b>", "data": {"x": "</style><script>"}})
        writer.write(keys.stage_key("r", "ada", "event"), encode(event), EPOCH)
        writer.write(keys.stage_key("r", "bob", "measurement"), b"\xc1", EPOCH)
        writer.write("weather/<wind>", b"\x80", EPOCH)
    page = Page(write_report(path, tmp_path / "r.html"))
    page.check()
    assert "<b>odd</b>" in page.words
    assert "1 unreadable" in page.words
    assert "No node sent anything." in page.words


def test_a_recording_that_was_broken_off(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "r.mcap", list(story(latencies=True)))
    path.write_bytes(path.read_bytes()[:-2000])
    page = Page(write_report(path, tmp_path / "r.html"))
    page.check()
    assert "broken off" in page.words


def test_the_command(tmp_path: Path) -> None:
    output = tmp_path / "r.html"
    result = CliRunner().invoke(app, ["report", str(SAMPLE), "-o", str(output), "--steps", "3:5", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"report": str(output), "figures": None}
    page = Page(output)
    page.check()
    assert "Messages of steps 3 to 5" in page.words
    assert "The steps were asked for." in page.words


@pytest.mark.parametrize("steps", [range(51, 60), range(1000, 10**15)])
def test_steps_that_are_not_there(tmp_path: Path, steps: range) -> None:
    with pytest.raises(InputError, match=r"expected some of steps 1 to 50") as error:
        write_report(SAMPLE, tmp_path / "r.html", steps)
    assert error.value.exit_code == 2
    assert not (tmp_path / "r.html").exists()


def test_steps_beyond_the_end_are_left_out(tmp_path: Path) -> None:
    page = Page(write_report(SAMPLE, tmp_path / "r.html", range(48, 10**15)))
    assert "Messages of steps 48 to 50" in page.words


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        write_report(tmp_path / "none.mcap", tmp_path / "r.html")
    with pytest.raises(RecordingError, match="is not an MCAP file"):
        write_report(Path(__file__), tmp_path / "r.html")
    with pytest.raises(InputError, match="is one of the recordings that are read"):
        write_report(SAMPLE, SAMPLE)
    if Path("/dev/full").exists():
        with pytest.raises(RunError, match="/dev/full: writing failed: No space left"):
            write_report(SAMPLE, Path("/dev/full"))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_report(SAMPLE, tmp_path / "file" / "r.html")


def test_what_a_dead_node_did_not_say_is_nobodys_loss(tmp_path: Path) -> None:
    said = [line for line in story(latencies=True) if line[:3] not in ((3, 1, "measurement"), (3, 1, "intermediate"))]
    facts, recording = facts_of(by_hand(tmp_path / "r.mcap", said))
    with recording:
        assert not [f for f in facts.flights(range(1, 2)) if f.sender == 3]
    assert facts.channels[(3, 1), "intermediate"].expected == 0
    assert facts.channels[(2, 1), "measurement"].unused == {1}
