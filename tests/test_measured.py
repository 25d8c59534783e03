"""A recording's own latencies as links: the run once more, arrival by arrival."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from simulations import MS, four_sensor, record, records, rewrite, walk
from zfusion.drivers.rerun import rerun
from zfusion.drivers.simulated import Simulation
from zfusion.links import MeasuredLinks
from zfusion.links.measured import Passage, read_arrivals
from zfusion.messages import decode_any
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording
from zfusion.stages import Message

LINKS: dict[str, Any] = {
    "delay": {"distribution": "lognormal", "median": 0.004, "sigma": 0.9},
    "loss": 0.15,
    "reorder": True,
}
FREE = {"timing": {"free_run": True, "timeout_s": 0.02}}


def estimates(path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """(topic, step) -> what every intermediate and final estimate says, its time aside."""
    found = {}
    with Recording.open(path) as recording:
        for topic, data, *_ in recording.records():
            node, stage = topic.split("/")[-2:]
            if stage in {"intermediate", "estimate"}:
                said = decode_any(data)
                del said["t_ns"]
                found[f"{node}/{stage}", said["step"]] = said
    return found


@pytest.mark.parametrize(
    "scenario",
    [
        walk(steps=60, links=LINKS),
        four_sensor(steps=60).with_overrides(rate_hz=50.0).model_copy(update={"links": walk(links=LINKS).links}),
    ],
    ids=["walk", "four_sensor"],
)
def test_a_run_with_its_own_measured_links_is_the_run(tmp_path: Path, scenario: Scenario) -> None:
    path = record(tmp_path / "a.mcap", scenario)
    with Recording.open(path) as recording:
        rerun(recording, {}, tmp_path / "b.mcap", link=MeasuredLinks.of(recording))
    assert estimates(tmp_path / "b.mcap") == estimates(path)
    used = [len(said["used"]) for (topic, _), said in estimates(path).items() if topic.endswith("intermediate")]
    assert min(used) < max(used)  # something was late or lost


def test_used_sets_are_right_where_latencies_were_not_told(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", walk(steps=60, links=LINKS))
    bare = rewrite(path, tmp_path / "bare.mcap", lambda old: [] if old.topic.endswith("/arrivals") else [old])
    with Recording.open(bare) as recording:
        rerun(recording, {}, tmp_path / "b.mcap", link=MeasuredLinks.of(recording))
    assert estimates(tmp_path / "b.mcap") == estimates(path)


def test_a_scenario_may_take_its_links_from_a_recording(tmp_path: Path) -> None:
    """Whatever else it does, it has the same latencies and losses."""
    path = record(tmp_path / "a.mcap", walk(steps=60, links=LINKS, seed=3))
    again = walk(steps=60, links={"recorded": {"recording": str(path)}}, seed=3)
    record(tmp_path / "b.mcap", again)
    assert estimates(tmp_path / "b.mcap") == estimates(path)
    other = Simulation(walk(steps=60, links={"recorded": {"recording": str(path)}}, seed=9))
    other.run()
    lost = sum(counts.get("lost", 0) for lives in other.reports.values() for counts in lives[-1].emulated.values())
    assert 0.1 < lost / (60 * 5 * 2 * 2) < 0.2


def test_every_message_arrives_as_long_after_its_step_was_due() -> None:
    links = MeasuredLinks(
        {((1, 2), "measurement"): {3: Passage(5 * MS, 9 * MS)}}, epoch_ns=1000 * MS, period_ns=50 * MS
    )
    message = Message(1, 3, "measurement", 0, 1, 0, {})
    assert links((1, 2), message, 1150 * MS) == (1159 * MS,)
    assert links((1, 2), message, 1170 * MS) == (1170 * MS,)  # not before it was sent
    assert links((1, 2), message._replace(step=4), 1200 * MS) == ()
    assert links((2, 1), message, 1150 * MS) == ()
    assert links.latency_ns((1, 2), "measurement", 3) == 5 * MS
    assert links.latency_ns((1, 2), "measurement", 4) is None
    assert MeasuredLinks(links.passages)((1, 2), message, 1150 * MS) == (1155 * MS,)


def test_what_is_not_written_like_arrivals_is_skipped() -> None:
    right = {"from": 1, "stage": "measurement", "steps": [[3, 2], [9, 1]], "latency_ns": [5, 6, 7]}
    told = [(1, "measurement", 3, 5), (1, "measurement", 4, 6), (1, "measurement", 9, 7)]
    assert list(read_arrivals({"edges": [right]})) == told
    wrong: list[Any] = [
        None, 7, {}, {**right, "from": None}, {**right, "steps": 5}, {**right, "steps": [[1], ["a", 2], None]},
        {**right, "latency_ns": None}, {**right, "latency_ns": ["x", None, 1.5]}, {**right, "steps": [[1, 10**15]]},
    ]  # fmt: skip
    assert len(list(read_arrivals({"edges": [*wrong, right]}))) == 3 + 3
    for data in ({}, {"edges": None}, {"edges": "x"}):
        assert list(read_arrivals(data)) == []


def test_free_running_nodes_hear_as_long_after_it_was_sent(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", walk(steps=40, links={"delay": 0.001}, **FREE))
    with Recording.open(path) as recording:
        links = MeasuredLinks.of(recording)
        assert {ns.latency_ns for passages in links.passages.values() for ns in passages.values()} == {MS}
        rerun(recording, {}, tmp_path / "b.mcap", link=links)
    assert estimates(tmp_path / "b.mcap") == estimates(path)
    assert len(records(path)) == len(records(tmp_path / "b.mcap"))
