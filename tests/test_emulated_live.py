"""Live swarms under the links and faults of a scenario: real processes, and what the other worlds say of them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from swarms import Recorded, Result, launch, recorded, run_name, variant, zfusion
from zfusion.drivers.rerun import rerun
from zfusion.drivers.simulated import simulate
from zfusion.links import LinkNetwork, MeasuredLinks
from zfusion.links.measured import read_arrivals
from zfusion.methods.check import deadline_ns
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording
from zfusion.stages import Message

STEPS = 60
NODES = ["1", "2", "3", "4"]
MS = 1_000_000
PERIOD = 50 * MS

LINKS = {"delay": {"distribution": "lognormal", "median": 0.012, "sigma": 0.5}, "loss": 0.1, "reorder": True}


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture(scope="module")
def result(directory: Path) -> Result:
    """The example under links that lose and delay."""
    timing = {"rate_hz": 20.0, "deadlines": {"measurement": 0.4, "intermediate": 0.8}}
    scenario = variant(directory, "links", links=LINKS, timing=timing)
    return launch(directory, scenario, "--steps", STEPS, "--record", "links.mcap", run=run_name("links"))


@pytest.fixture(scope="module")
def summary(result: Result) -> dict[str, Any]:
    assert result.code == 0, result.err
    return result.summary


@pytest.fixture(scope="module")
def path(summary: dict[str, Any]) -> Path:
    return Path(summary["recording"])


def told(path: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """(topic's end, step) -> what every intermediate and final estimate says, times, counters and histories aside."""
    return {
        (m.topic.split("/", 3)[3], m.payload["step"]): {
            name: value for name, value in m.payload.items() if name not in {"t_ns", "seq", "history"}
        }
        for m in recorded(path)
        if m.topic.endswith(("/intermediate", "/estimate"))
    }


def test_what_the_links_lost_is_what_the_receivers_miss(summary: dict[str, Any]) -> None:
    lost = {(e["sender"], e["receiver"]): e["lost"] for e in summary["emulated"]}
    counted: Counter[tuple[str, str]] = Counter()
    for edge in summary["edges"]:
        counted[edge["sender"], edge["receiver"]] += edge["lost"]
        taken = sum(summary["completed_steps"].values())
        assert edge["received"] + edge["missed"] <= taken
        assert edge["used_fraction"] == pytest.approx(edge["received"] / summary["completed_steps"][edge["receiver"]])
    assert sum(lost.values()) > STEPS  # a tenth of 16 * 60
    assert counted == lost
    assert summary["late"] > 0
    assert summary["fallbacks"] == 0


def test_the_recording_proves_its_estimates(path: Path, directory: Path) -> None:
    verdict = zfusion(directory, "replay", path, "--verify", "--json")
    assert verdict.code == 0, verdict.out
    assert verdict.summary["different"] == 0
    assert verdict.summary["identical"] >= 2 * 3 * STEPS


def test_the_simulation_with_the_measured_arrivals_gives_the_live_estimates(path: Path, directory: Path) -> None:
    with Recording.open(path) as recording:
        rerun(recording, {}, directory / "again.mcap", link=MeasuredLinks.of(recording))
    live, simulated = told(path), told(directory / "again.mcap")
    assert len(live) > 2 * 3 * STEPS  # a busy machine may skip steps
    assert {place: simulated[place] for place in live} == live


def first_stage(messages: list[Recorded]) -> tuple[dict[int, int], dict[tuple[str, int], int], dict[Any, int]]:
    """Epochs; (sender, step) -> when its measurement was sent; (sender, receiver, step) -> its latency."""
    epochs, sent, latencies = {}, {}, {}
    for m in messages:
        node, stage = m.topic.split("/")[-2:]
        if stage == "measurement":
            sent[node, m.payload["step"]] = m.payload["t_ns"]
        elif stage == "event" and m.payload["kind"] == "started":
            epochs[m.payload["node"]] = m.payload["data"]["epoch_ns"]
        elif stage == "arrivals":
            for sender, of, step, latency in read_arrivals(m.payload["data"]):
                if of == "measurement":
                    latencies[str(sender), node, step] = latency
    return epochs, sent, latencies


def test_the_very_messages_are_late_that_the_simulation_says_but_for_the_time_that_computing_takes(
    path: Path, directory: Path
) -> None:
    """A message due at t in the simulation is due live at t + slack, the slack being measured: how late its sender
    began the step, and how much longer the wire took than the link holds a message. So used sets differ only by
    messages that are due within the slack before the deadline."""
    with Recording.open(path) as recording:
        scenario = Scenario.from_toml(recording.scenario_toml, "links", directory)
    simulate(scenario, run="same", output=directory / "same.mcap")
    live, simulated = told(path), told(directory / "same.mcap")
    epochs, sent, latencies = first_stage(recorded(path))
    [epoch] = set(epochs.values())
    network, deadline = LinkNetwork(scenario), deadline_ns(scenario, "measurement")
    differences, unexcused = 0, []
    for i in NODES:
        for place in ((f"{i}/intermediate", step) for step in range(1, STEPS + 1)):
            step = place[1]
            used = set(live[place]["used"] if place in live else simulated[place]["used"])
            for j in used ^ set(simulated[place]["used"]):
                if (str(j), step) not in sent:
                    continue  # a step that it skipped
                differences += 1
                message = Message(j, step, "measurement", 0, 1, 0, {})
                delay = network.injected_ns((j, int(i)), message)
                assert delay is not None, "what is lost is lost in both worlds"
                due = sent[str(j), step] - (epoch + step * PERIOD) + latencies.get((str(j), i, step), PERIOD)
                if not delay <= deadline < due:
                    unexcused.append((j, i, step, delay, due))
    assert unexcused == []
    assert differences < len(latencies) / 4


def test_latencies_and_budgets_are_told(summary: dict[str, Any]) -> None:
    by_receiver: dict[str, list[dict[str, float]]] = {}
    for edge in summary["edges"]:
        latency, budget = edge["latency_us"], edge["budget_us"]
        assert 3_000 < latency["p50"] <= latency["p90"] <= latency["p99"]  # a thousandth of the delays is shorter
        assert latency["clock_error_us"] == 0.0
        assert edge["clock"] == {"offset_us": 0.0, "uncertainty_us": 0.0}
        assert budget["injected"] > 1_000
        assert budget["missing"] > 0
        by_receiver.setdefault(edge["receiver"] + edge["sender"], []).append(budget)
    for ends, budgets in by_receiver.items():
        rounds = summary["rounds"][ends[0]]
        assert rounds["rounds"] == summary["completed_steps"][ends[0]]
        assert rounds["queues"]["held"] >= 1
        parts = sum(part for budget in budgets for part in budget.values())
        assert parts == pytest.approx(rounds["round_us"], abs=0.02)  # each is rounded to the nanosecond


def test_the_latencies_on_the_recording_are_those_of_the_summary(summary: dict[str, Any], path: Path) -> None:
    counted: Counter[tuple[str, str, str]] = Counter()
    for m in recorded(path):
        if m.topic.endswith("/arrivals"):
            for sender, stage, _, latency in read_arrivals(m.payload["data"]):
                counted[str(sender), str(m.payload["node"]), stage] += 1
                assert latency > 0
    for edge in summary["edges"]:
        came = edge["received"] + edge["late"]
        told = counted[edge["sender"], edge["receiver"], edge["stage"]]
        assert came - 2 <= told <= came  # the last may have come when all had been told


FAULTS = [
    {"kind": "kill", "node": 2, "step": 20, "restart_after": 10},
    {"kind": "stop", "node": 3, "step": 40, "steps": 4},
    {"kind": "slow", "node": 1, "step": 10, "steps": 5, "delay_s": 0.004},
    {"kind": "clock", "node": 4, "step": 5, "offset_s": -0.02},
    {"kind": "cut", "from": 1, "to": 3, "step": 50, "steps": 6},
]


@pytest.fixture(scope="module")
def faulty(directory: Path) -> Result:
    """The example, of which much goes wrong by plan."""
    scenario = variant(directory, "faults", faults=FAULTS, timing={"rate_hz": 20.0})
    return launch(directory, scenario, "--steps", 160, "--record", "faults.mcap", run=run_name("faults"))


def test_planned_deaths_are_no_failures(faulty: Result) -> None:
    assert faulty.code == 0, faulty.err
    assert "node 2 killed at step 20 until step 30, as planned" in faulty.err
    assert "node 3 stopped at step 40 until step 44, as planned" in faulty.err
    summary = faulty.summary
    assert summary["failures"] == []
    assert summary["restarts"] == 1
    assert [fault["kind"] for fault in summary["faults"]] == [fault["kind"] for fault in FAULTS]
    assert summary["skipped"] >= 3  # those that node 3 stood still through


def test_a_node_is_dead_and_stands_still_when_that_is_planned(faulty: Result, directory: Path) -> None:
    taken = {i: {m.payload["step"]: m.payload for m in messages(directory, f"/{i}/intermediate")} for i in NODES}
    assert max(step for step, payload in taken["2"].items() if payload["born"] == 1) in range(15, 20)
    assert min(step for step, payload in taken["2"].items() if payload["born"] > 1) >= 30
    assert not taken["3"].keys() & {40, 41, 42}
    assert 100 in taken["3"]
    assert zfusion(directory, "replay", faulty.summary["recording"], "--verify", "--json").code == 0


def messages(directory: Path, ending: str) -> list[Recorded]:
    return [m for m in recorded(directory / "faults.mcap") if m.topic.endswith(ending)]


def test_faults_are_told_by_those_concerned(faulty: Result, directory: Path) -> None:
    assert faulty.code == 0
    told = {
        (m.payload["node"], data["fault"]["kind"], data["phase"], data["step"])
        for m in messages(directory, "/event")
        if m.payload["kind"] == "fault"
        for data in [m.payload["data"]]
    }
    assert told == {
        (2, "kill", "begins", 20), (2, "kill", "ends", 30), (3, "stop", "begins", 40), (3, "stop", "ends", 44),
        (1, "slow", "begins", 10), (1, "slow", "ends", 15), (4, "clock", "begins", 5),
        (3, "cut", "begins", 50), (3, "cut", "ends", 56),
    }  # fmt: skip


def test_a_cut_link_carries_nothing_and_all_others_go_on(faulty: Result, directory: Path) -> None:
    assert [edge for edge in faulty.summary["emulated"] if edge.get("cut")] == [
        {"sender": "1", "receiver": "3", "cut": 12}
    ]
    for m in messages(directory, "/3/intermediate"):
        if 50 <= m.payload["step"] < 56:
            assert 1 not in m.payload["used"]


def test_a_wrong_clock_is_found_out(faulty: Result, directory: Path) -> None:
    stamps = {m.payload["step"]: m.payload["t_ns"] for m in messages(directory, "/4/measurement")}
    [epoch] = {m.payload["data"]["epoch_ns"] for m in messages(directory, "/event") if m.payload["kind"] == "started"}
    arrived = {m.payload["step"]: m.log_time for m in messages(directory, "/4/measurement")}
    wrong = [step for step in range(10, 20) if step in stamps]
    assert len(wrong) >= 5  # a busy machine may skip some
    assert min(arrived[step] - stamps[step] for step in wrong) >= 20 * MS  # it says that it is earlier
    assert min(arrived[step] - epoch - step * PERIOD for step in wrong) >= 20 * MS  # and so it is late
    [edge, *_] = [e for e in faulty.summary["edges"] if (e["sender"], e["receiver"]) == ("4", "2")]
    clock = edge["clock"]
    assert abs(clock["offset_us"] + 20_000) <= clock["uncertainty_us"] + 0.01
    assert edge["latency_us"]["clock_error_us"] > 15_000
    [edge, *_] = [e for e in faulty.summary["edges"] if (e["sender"], e["receiver"]) == ("1", "3")]
    assert edge["clock"] == {"offset_us": 0.0, "uncertainty_us": 0.0}


def test_only_a_launcher_can_set_a_stopped_node_going(directory: Path, faulty: Result) -> None:
    assert faulty.code == 0
    refused = zfusion(directory, "node", directory / "faults.toml", "--id", "3", "--run", "alone")
    assert refused.code == 2
    assert "only a launcher" in refused.error


def test_faults_of_a_free_running_swarm_last_as_many_steps(directory: Path) -> None:
    faults = [
        {"kind": "kill", "node": 3, "step": 30, "restart_after": 40},
        {"kind": "stop", "node": 2, "step": 200, "steps": 10},
    ]
    scenario = variant(directory, "free", faults=faults, links={"delay": 0.002})
    result = launch(directory, scenario, "--free-run", "--steps", 500, "--record", "free.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["failures"] == []
    assert summary["completed_steps"]["2"] == 500
    taken = [m.payload for m in recorded(directory / "free.mcap") if m.topic.endswith("/3/intermediate")]
    assert {payload["step"] for payload in taken if payload["born"] == 1} == set(range(1, 30))
    assert all(payload["step"] >= 70 for payload in taken if payload["born"] > 1)
    # What node 2 had said when the others gave it up may be missing; what is there is right.
    assert zfusion(directory, "replay", "free.mcap", "--verify", "--json").summary["different"] == 0


def test_a_node_that_comes_back_when_all_others_have_ended_is_let_go(directory: Path) -> None:
    scenario = variant(
        directory, "latecomer", timing={"rate_hz": 50.0}, faults=[{**FAULTS[0], "step": 28, "restart_after": 1}]
    )
    result = launch(directory, scenario, "--steps", 30, "--no-record")
    assert result.code == 0, result.err
    assert result.summary["failures"] == []
    assert result.summary["completed_steps"]["2"] in range(10, 30)  # a busy machine may skip some
