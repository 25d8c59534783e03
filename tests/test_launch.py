"""Whole swarms: real processes on real Zenoh, launched, watched, stopped, recorded."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from mcap.reader import make_reader

from swarms import EXAMPLE, Result, estimates, launch, recorded, run_name, variant, zfusion
from zfusion.model.scenario import load_scenario
from zfusion.swarm.child import Child, bereft, latecomers
from zfusion.swarm.launch import Launcher, LaunchOptions

STEPS = 300
NODES = ["1", "2", "3", "4"]
STAGES = {"measurement", "intermediate", "estimate", "event", "arrivals", "truth"}


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("launch")


@pytest.fixture(scope="module")
def result(directory: Path) -> Result:
    """The example, free-running, recorded."""
    return launch(directory, EXAMPLE, "--free-run", "--steps", STEPS, "--record", "free.mcap", run=run_name("free"))


@pytest.fixture(scope="module")
def summary(result: Result) -> dict[str, Any]:
    return result.summary


def test_it_succeeds_and_says_nothing_but_one_json_object(result: Result) -> None:
    assert result.code == 0
    assert result.err == ""
    assert result.out.count("\n") == 1


def test_the_summary_keeps_the_contract(summary: dict[str, Any], directory: Path) -> None:
    assert summary["method"] == "two_stage"
    assert summary["nodes"] == [1, 2, 3, 4]
    assert summary["steps"] == STEPS
    assert summary["completed_steps"] == dict.fromkeys(NODES, STEPS)
    assert summary["run"].startswith("test-free-")
    assert Path(summary["recording"]) == directory / "free.mcap"
    assert summary["rounds_per_s"] > 0
    assert 0 < summary["latency_us"]["p50"] <= summary["latency_us"]["p99"]
    assert {name: summary[name] for name in ("lost", "late", "missed", "fallbacks", "skipped", "refused")} == {
        "lost": 0, "late": 0, "missed": 0, "fallbacks": 0, "skipped": 0, "refused": {}
    }  # fmt: skip
    assert summary["failures"] == []
    assert summary["restarts"] == 0
    assert not summary["interrupted"]


def test_the_errors_are_what_was_predicted(summary: dict[str, Any]) -> None:
    assert set(summary["rmse"]) == {"intermediate", "estimate"}
    for node in NODES:
        assert 0 < summary["rmse"]["estimate"][node] < 2 * summary["predicted_rmse"]["estimate"][node]


def test_everything_that_was_sent_is_recorded(summary: dict[str, Any]) -> None:
    sent = summary["messages"]["sent"]
    assert sent == summary["messages"]["recorded"]
    assert set(sent) == STAGES
    assert {stage: sent[stage] for stage in ("measurement", "intermediate", "estimate")} == dict.fromkeys(
        ("measurement", "intermediate", "estimate"), 4 * STEPS
    )
    assert sent["truth"] == STEPS
    assert summary["lost_on_recording"] == {}


def test_every_edge_is_accounted_for(summary: dict[str, Any]) -> None:
    edges = {(e["sender"], e["receiver"], e["stage"]): e for e in summary["edges"]}
    assert len(edges) == 8 * 2  # two in-neighbours each, two stages
    assert ("4", "1", "measurement") not in edges  # not of the graph
    for edge in edges.values():
        assert (edge["sent"], edge["received"], edge["recorded"]) == (STEPS, STEPS, STEPS)
        assert (edge["late"], edge["lost"], edge["missed"]) == (0, 0, 0)


def test_the_recording_is_read_by_the_stock_reader(summary: dict[str, Any]) -> None:
    run = summary["run"]
    expected = {f"zfusion/{run}/node/{i}/{stage}" for i in NODES for stage in STAGES - {"truth"}}
    with Path(summary["recording"]).open("rb") as file:
        reader = make_reader(file)
        told = reader.get_summary()
        assert told is not None
        assert {channel.topic for channel in told.channels.values()} == expected | {f"zfusion/{run}/truth"}
        assert {channel.message_encoding for channel in told.channels.values()} == {"msgpack"}
        schemas = {channel.topic: told.schemas[channel.schema_id] for channel in told.channels.values()}
        assert {schema.encoding for schema in schemas.values()} == {"jsonschema"}
        assert [attachment.name for attachment in reader.iter_attachments()] == ["scenario.toml"]
        facts = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
        assert facts["zfusion.recording"]["run"] == run
    validators = {topic: jsonschema.Draft202012Validator(json.loads(schema.data)) for topic, schema in schemas.items()}
    messages = recorded(Path(summary["recording"]))
    for message in messages[:: len(messages) // 200]:
        validators[message.topic].validate(message.payload)


def test_the_recording_keeps_order_counters_and_stamps(summary: dict[str, Any]) -> None:
    counts: Counter[str] = Counter()
    log_time = 0
    for message in recorded(Path(summary["recording"])):
        assert message.sequence == counts[message.topic] == message.payload["seq"]
        counts[message.topic] += 1
        assert message.publish_time == message.payload["t_ns"]
        assert message.log_time >= log_time
        log_time = message.log_time
    assert sum(counts.values()) == sum(summary["messages"]["recorded"].values())


def test_the_recording_proves_its_estimates(summary: dict[str, Any], directory: Path) -> None:
    verdict = zfusion(directory, "replay", summary["recording"], "--verify", "--json")
    assert verdict.code == 0
    assert verdict.summary["different"] == 0
    assert verdict.summary["identical"] >= 2 * 4 * STEPS


def test_the_recording_says_how_it_was_stopped(summary: dict[str, Any]) -> None:
    events = [m.payload for m in recorded(Path(summary["recording"])) if m.topic.endswith("/event")]
    kinds = Counter(event["kind"] for event in events)
    assert kinds["started"] == kinds["stopped"] == 4
    for event in events:
        if event["kind"] == "stopped":
            assert event["data"]["sent"]["estimate"] == STEPS


def test_the_same_seed_gives_the_same_estimates_whatever_the_pace(summary: dict[str, Any], directory: Path) -> None:
    paced = launch(directory, EXAMPLE, "--rate", 20, "--steps", 40, "--record", "paced.mcap").summary
    assert set(paced["completed_steps"]) == set(NODES)
    assert sum(paced["completed_steps"].values()) + paced["skipped"] == 4 * 40
    assert 10 < paced["rounds_per_s"] < 1.05 * 20
    assert paced["lost"] == 0
    if paced["missed"] == paced["skipped"] == 0:  # the machine was not too busy for the deadlines
        free = estimates(directory / "free.mcap")
        assert all(free[place] == estimate for place, estimate in estimates(directory / "paced.mcap").items())


def test_without_a_recording_none_is_written(directory: Path) -> None:
    scenario = variant(directory, "quiet", recording={"directory": "elsewhere"})
    summary = launch(directory, scenario, "--free-run", "--steps", 20, "--no-record").summary
    assert summary["recording"] is None
    assert summary["messages"]["recorded"] == {}
    assert summary["completed_steps"] == dict.fromkeys(NODES, 20)
    assert not list(directory.glob("elsewhere/*.mcap"))


@pytest.mark.parametrize(
    ("method", "stages", "edges"), [("local", {"measurement"}, 0), ("centralized", {"measurement"}, 12)]
)
def test_other_methods_run_live(directory: Path, method: str, stages: set[str], edges: int) -> None:
    result = launch(directory, EXAMPLE, "--free-run", "--steps", 50, "--method", method, "--record", f"{method}.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["method"] == method
    assert summary["completed_steps"] == dict.fromkeys(NODES, 50)
    assert set(summary["messages"]["sent"]) == stages | {"estimate", "event", "truth"} | (
        {"arrivals"} if edges else set()
    )
    assert summary["messages"]["sent"] == summary["messages"]["recorded"]
    assert len(summary["edges"]) == edges
    assert summary["lost"] == 0
    assert zfusion(directory, "replay", f"{method}.mcap", "--verify", "--json").code == 0


@pytest.mark.parametrize("transport", [{"preset": "lowlatency"}, {"mesh": "full"}], ids=["lowlatency", "full mesh"])
def test_other_transports(directory: Path, transport: dict[str, str], summary: dict[str, Any]) -> None:
    scenario = variant(directory, "other", transport=transport)
    path = directory / f"{next(iter(transport))}.mcap"
    other = launch(directory, scenario, "--free-run", "--steps", 50, "--record", path).summary
    assert other["completed_steps"] == dict.fromkeys(NODES, 50)
    assert (other["lost"], other["late"]) == (0, 0)
    assert other["messages"]["sent"] == other["messages"]["recorded"]
    ours, theirs = estimates(path), estimates(Path(summary["recording"]))
    assert all(theirs[place] == estimate for place, estimate in ours.items())


def test_ids_may_be_names(directory: Path) -> None:
    text = EXAMPLE.read_text().replace('name = "four_sensor"', 'name = "named"')
    for number, name in enumerate(("ada", "bob", "cyd", "dan"), start=1):
        text = text.replace(f"id = {number}\n", f'id = "{name}"\n')
    path = directory / "named.toml"
    path.write_text(text)
    summary = launch(directory, path, "--free-run", "--steps", 20, "--record", "named.mcap").summary
    assert summary["completed_steps"] == dict.fromkeys(("ada", "bob", "cyd", "dan"), 20)
    assert summary["lost"] == 0


CROWD = """
import os, sys
os.getpid = lambda: 4711  # as if they began at the same place
from zfusion.swarm.ports import free_endpoints
print(*(endpoint for _ in range(10) for endpoint in free_endpoints(15)), flush=True)
sys.stdin.read()
"""


def test_launchers_that_look_for_free_ports_at_the_same_time_find_different_ones() -> None:
    crowd = [
        subprocess.Popen([sys.executable, "-c", CROWD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    try:
        found = [process.stdout.readline().split() for process in crowd if process.stdout is not None]
    finally:
        for process in crowd:
            process.communicate(timeout=60)
    assert [len(set(endpoints)) for endpoints in found] == [150, 150]
    assert not {*found[0]} & {*found[1]}


def child(number: int, phase: str, *, exit_code: int | None = None, restarts: int = 0) -> Child:
    """A process of which its launcher knows that."""
    made = Child(f"node {number}", number, [], Path())
    made.process = subprocess.Popen(["true"])
    made.process.wait()
    made.note_status({"phase": phase, "epoch_ns": 1 if restarts or phase != "joining" else None})
    made.exit_code, made.restarts = exit_code, restarts
    return made


def test_who_finds_nobody_to_join_any_more_is_not_waited_for() -> None:
    through, late = child(1, "done", exit_code=0), child(2, "joining")
    assert latecomers([through, late]) == [late]
    assert latecomers([child(1, "joining"), late]) == []  # they wait for each other
    assert latecomers([late]) == []  # it waits for nobody
    assert latecomers([through, late, child(3, "running")]) == []
    assert latecomers([through, late, child(3, "done")]) == []  # which stays for whom it has not told all
    again = child(3, "joining", restarts=1)
    assert latecomers([through, again]) == [again]
    assert bereft([through, again]) == []
    assert latecomers([child(1, "running", exit_code=-9), late]) == [late]


def test_those_that_all_died_have_nobody_to_join_and_are_not_too_late() -> None:
    all_again = [child(number, "joining", restarts=1) for number in (1, 2, 3)]
    assert bereft(all_again) == all_again
    assert latecomers(all_again) == []
    dead = child(4, "running", exit_code=-9, restarts=10)
    assert bereft([*all_again, dead]) == all_again  # one that does not come back is not waited for
    for other in (child(4, "joining"), child(4, "running"), child(4, "running", restarts=1), child(4, "done")):
        assert bereft([*all_again, other]) == []  # who will begin, or can be joined
    assert bereft(all_again[:1]) == []  # it waits for nobody
    unbegun = [child(number, "joining") for number in (1, 2)]
    for node in unbegun:
        node.restarts = 1
    assert bereft(unbegun) == []  # they meet as they would have at first


def test_who_had_not_begun_when_the_swarm_was_stopped_has_not_failed(tmp_path: Path) -> None:
    options = LaunchOptions(run_name("stopped"), tmp_path / "logs", None)
    for stopped in (False, True):
        launcher = Launcher(load_scenario(EXAMPLE), options)
        through = {number: child(number, "done", exit_code=0) for number in (1, 3, 4)}
        launcher._nodes = through | {2: child(2, "joining")}
        if stopped:
            launcher._stop_nodes()
        launcher._help_who_finds_nobody()
        late = [] if stopped else ["node 2 had not begun when all others had ended"]
        assert launcher._failures == late
