"""The simulated world: the same nodes, virtual time, and nothing that depends on anything but scenario and seed."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from oracles import brute_force
from simulations import MS, by_rule, four_sensor, payloads, record, record_story, records, walk
from zfusion.drivers.simulated import EPOCH_NS, FREE_STEP_NS, Simulation, simulate
from zfusion.drivers.sources import TableSource
from zfusion.errors import InputError
from zfusion.links import Edge
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording import Recording
from zfusion.stages import Message


def test_the_same_scenario_and_seed_give_the_same_recording(tmp_path: Path) -> None:
    one = record(tmp_path / "1.mcap", walk(links={"loss": 0.2}))
    two = record(tmp_path / "2.mcap", walk(links={"loss": 0.2}))
    assert records(one) == records(two)


def test_another_seed_gives_another(tmp_path: Path) -> None:
    one = record(tmp_path / "1.mcap", walk(links={"loss": 0.2}))
    two = record(tmp_path / "2.mcap", walk(links={"loss": 0.2}, seed=5))
    for stage in ("measurement", "intermediate"):
        first, second = ([(p["node"], p.get("y"), p.get("used")) for p in payloads(path, stage)] for path in (one, two))
        assert first != second


def test_what_is_on_the_recording(tmp_path: Path) -> None:
    scenario = four_sensor(steps=7)
    with Recording.open(record(tmp_path / "r.mcap", scenario)) as recording:
        topics = {
            f"zfusion/r/node/{i}/{stage}" for i in scenario.ids for stage in ("measurement", "intermediate", "estimate")
        }
        assert {topic: n for topic, n in recording.topics.items() if "event" not in topic} == {
            **dict.fromkeys(topics, 7),
            **{f"zfusion/r/node/{i}/arrivals": 1 for i in scenario.ids},
            "zfusion/r/truth": 7,
        }
        assert recording.complete
        assert recording.statistics is not None
        assert not any(account.lost for account in recording.statistics.values())
        assert Scenario.from_toml(recording.scenario_toml) == scenario
        assert recording.metadata["run"] == "r"
        assert recording.metadata["method"] == "two_stage"
    events = payloads(tmp_path / "r.mcap", "event", 2)
    assert [event["kind"] for event in events] == ["started", "stopped"]
    assert events[0]["data"] == {"epoch_ns": EPOCH_NS}
    assert events[1]["data"]["sent"] == {
        "event": 1, "measurement": 7, "intermediate": 7, "estimate": 7, "arrivals": 1
    }  # fmt: skip
    assert events[1]["data"]["completed"] == 7


def test_a_paced_step_begins_at_its_time(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(steps=5))
    for payload in payloads(path, "measurement"):
        assert payload["t_ns"] == EPOCH_NS + payload["step"] * 20 * MS
    assert all(r.log_time_ns == r.publish_time_ns for r in records(path))


def test_a_free_running_step_begins_when_the_one_before_is_done(tmp_path: Path) -> None:
    slow: Edge = (20, 10)
    scenario = walk(steps=4, timing={"free_run": True})
    path = record(tmp_path / "r.mcap", scenario, by_rule(lambda edge, _: 3 * MS if edge == slow else 0))
    begun = [payload["t_ns"] - EPOCH_NS for payload in payloads(path, "measurement", 10)]
    assert begun == [0, 3 * MS, 6 * MS, 9 * MS]
    quick = record(tmp_path / "q.mcap", scenario)
    assert [p["t_ns"] - EPOCH_NS for p in payloads(quick, "measurement", 10)] == [k * FREE_STEP_NS for k in range(4)]


def test_the_epoch_is_the_scenarios_where_it_has_one(tmp_path: Path) -> None:
    timing = {"rate_hz": 50.0, "epoch": "2020-01-01T00:00:00Z"}
    first = payloads(record(tmp_path / "r.mcap", walk(steps=1, timing=timing)), "measurement")[0]
    assert first["t_ns"] == 1_577_836_800_000_000_000 + 20 * MS


def test_a_message_that_misses_the_deadline_is_not_used(tmp_path: Path) -> None:
    late: Edge = (20, 10)

    def rule(edge: Edge, message: Message) -> int:
        return 15 * MS if edge == late and message.stage == "measurement" and message.step == 3 else 0

    path = tmp_path / "r.mcap"
    reports = simulate(walk(steps=6), run="r", output=path, link=by_rule(rule))
    used = {payload["step"]: payload["used"] for payload in payloads(path, "intermediate", 10)}
    assert used == {k: [10, 50] if k == 3 else [10, 20, 50] for k in range(1, 7)}
    sent = {payload["step"]: payload["t_ns"] for payload in payloads(path, "intermediate", 10)}
    assert sent[3] == EPOCH_NS + 3 * 20 * MS + 9 * MS  # 0.45 of the period: the deadline
    edge = reports[10][0].edges["20"]
    assert edge["late"] == {"measurement": 1}
    assert edge["missed"] == {"measurement": 1}
    assert edge["received"] == {"measurement": 5, "intermediate": 6}


def test_order_and_time_of_arrival_change_no_bit_of_the_results(tmp_path: Path) -> None:
    """Every message arrives in time: so the estimates are those of ideal links."""
    scenario, random = four_sensor(steps=20), Random(3)
    ragged = by_rule(lambda edge, message: random.randrange(20 * MS))
    paths = [record(tmp_path / "1.mcap", scenario), record(tmp_path / "2.mcap", scenario, ragged)]
    for stage in ("intermediate", "estimate"):
        for i in scenario.ids:
            one, two = ([{**p, "t_ns": 0} for p in payloads(path, stage, i)] for path in paths)
            assert one == two
    assert records(paths[0]) != records(paths[1])


@pytest.mark.parametrize(("scenario", "loss"), [(four_sensor(7), 0.3), (walk(7), 0.3), (walk(5, names=True), 0.0)])
def test_estimates_are_those_of_brute_force(tmp_path: Path, scenario: Scenario, loss: float) -> None:
    """Whatever was lost: the projection on what the messages say was used."""
    path = record(tmp_path / "r.mcap", scenario.with_overrides(loss=loss))
    stacked = brute_force.stack(scenario.system(), scenario.steps)
    measured = {(p["node"], p["step"]): np.array(p["y"]) for p in payloads(path, "measurement")}
    Y = stacked.vector(measured)
    used, heard = (
        {(p["node"], p["step"]): tuple(p["used"]) for p in payloads(path, stage)}
        for stage in ("intermediate", "estimate")
    )
    expected = {i: brute_force.intermediate(stacked, i, used) for i in scenario.ids}
    for p in payloads(path, "intermediate"):
        assert np.allclose(p["x"], expected[p["node"]].values(stacked, Y)[p["step"]], rtol=1e-8, atol=1e-9)
    for i in scenario.ids:
        fused = brute_force.fused(stacked, expected, i, heard)
        for p in payloads(path, "estimate", i):
            k = p["step"]
            assert np.allclose(p["x"], fused.values(stacked, Y)[k], rtol=1e-8, atol=1e-9)
            assert np.allclose(np.reshape(p["P"], p["shape"]), fused.covariance[k], rtol=1e-8, atol=1e-10)
    everything = sum(len(scenario.network.neighbours(i)) for i in scenario.ids) * scenario.steps
    assert (sum(map(len, used.values())) < everything) == (loss > 0)


def test_reports_count_what_happened() -> None:
    scenario = walk(steps=40, links={"loss": 0.25})
    reports = simulate(scenario, run="r")
    lost = 0
    for i in scenario.ids:
        [report] = reports[i]
        assert (report.node, report.born, report.step, report.completed, report.skipped) == (i, 1, 40, 40, 0)
        assert report.elapsed_s == pytest.approx(40 * 0.02, abs=0.02)
        assert report.errors["estimate"]["count"] == 40
        for edge in report.edges.values():
            assert edge["received"]["measurement"] + edge["missed"]["measurement"] == 40
            lost += edge["missed"]["measurement"]
    assert 0 < lost < 400


def test_a_sensor_without_a_reading_says_so(tmp_path: Path) -> None:
    scenario = walk(steps=3)
    readings = {i: {k: np.ones(s.ny) for k in (1, 3)} for i, s in scenario.system().by_id.items()}
    sources = {i: TableSource(readings[i], {1: np.zeros(2)}) for i in scenario.ids}
    path = tmp_path / "r.mcap"
    reports = simulate(scenario, run="r", output=path, sources=sources)
    assert [p["y"] for p in payloads(path, "measurement", 10)] == [[1.0], None, [1.0]]
    assert [p["used"] for p in payloads(path, "intermediate", 10)] == [[10, 20, 50], [], [10, 20, 50]]
    assert [p["step"] for p in payloads(path, "truth")] == [1]
    assert reports[10][0].errors["estimate"]["count"] == 1


def test_a_node_that_dies_and_comes_back(tmp_path: Path) -> None:
    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 5 * 20 * MS + 10 * MS)
        simulation.kill(20)
        simulation.run(EPOCH_NS + 8 * 20 * MS + 10 * MS)
        simulation.revive(20)

    scenario = walk(steps=12)
    simulation = record_story(tmp_path / "r.mcap", scenario, tell)
    used = {p["step"]: p["used"] for p in payloads(tmp_path / "r.mcap", "intermediate", 10)}
    assert used == {k: [10, 50] if 6 <= k <= 9 else [10, 20, 50] for k in range(1, 13)}  # waited for once heard of
    first, second = simulation.reports[20]
    assert (first.born, first.step, second.born, second.step) == (1, 5, 9, 12)
    gone = [p["data"] for p in payloads(tmp_path / "r.mcap", "event", 10) if p["kind"] == "gone"]
    assert [data["of"] for data in gone] == [20]
    assert [(m["node"], m["step"], "y" in m) for m in gone[0]["last"]] == [(20, 5, True), (20, 5, False)]
    sent = {p["t_ns"] for p in payloads(tmp_path / "r.mcap", "intermediate", 10) if p["step"] == 7}
    assert sent == {EPOCH_NS + 7 * 20 * MS}  # nobody waits for a node that is known to be gone
    with pytest.raises(KeyError):
        simulation.kill(99)


def test_a_free_running_node_comes_back_at_the_others_step() -> None:
    simulation = Simulation(walk(steps=12, timing={"free_run": True}))
    simulation.run(EPOCH_NS + 4 * FREE_STEP_NS + 1)
    simulation.kill(20)
    simulation.run(EPOCH_NS + 8 * FREE_STEP_NS + 1)
    simulation.revive(20)
    with pytest.raises(KeyError):
        simulation.revive(20)
    simulation.run()
    assert [(r.born, r.step) for r in simulation.reports[20]] == [(1, 5), (10, 12)]
    assert [(r.born, r.step) for r in simulation.reports[10]] == [(1, 12)]


def test_free_running_nodes_wait_no_longer_than_their_timeout(tmp_path: Path) -> None:
    scenario = walk(steps=3, timing={"free_run": True, "timeout_s": 0.5})
    path = record(tmp_path / "r.mcap", scenario, by_rule(lambda edge, _: None if edge == (20, 10) else 0))
    assert [p["t_ns"] - EPOCH_NS for p in payloads(path, "intermediate", 10)] == [500 * MS, 1500 * MS, 2500 * MS]


def test_a_source_that_exists_in_a_live_run_only() -> None:
    with pytest.raises(InputError, match="live run"):
        simulate(walk(source={"kind": "zenoh", "key": "my/{id}"}), run="r")


@pytest.mark.parametrize("method", ["local", "centralized"])
def test_other_methods(tmp_path: Path, method: str) -> None:
    scenario = walk(steps=5, method=method)
    path = record(tmp_path / "r.mcap", scenario)
    used: dict[str, Any] = {
        "local": {i: [i] for i in scenario.ids},
        "centralized": {i: list(scenario.ids) for i in scenario.ids},
    }
    assert all(p["used"] == used[method][p["node"]] for p in payloads(path, "estimate"))
    assert not payloads(path, "intermediate")


def test_many_nodes() -> None:
    ids: list[NodeId] = list(range(48))
    sensors = [{"ids": ids, "H": [[1.0, 0.0]], "R": [[0.5]]}]
    scenario = walk(steps=3, sensors=sensors, network={"generator": "ring", "reach": 2})
    reports = simulate(scenario, run="r")
    assert [reports[i][0].completed for i in ids] == [3] * 48
