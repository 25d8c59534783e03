"""The timeline of faults in the simulated world: who does what when, and what stays true all the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oracles import brute_force
from simulations import MS, payloads, record, records, walk
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import FREE_STEP_NS, simulate
from zfusion.links.protocol import EPOCH_NS
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording import Recording
from zfusion.stages import Message

PERIOD = 20 * MS
FREE = {"free_run": True, "timeout_s": 0.5}
IDS = (10, 20, 30, 40, 50)

Seen = list[tuple[Message, int]]


def run(*faults: dict[str, Any], steps: int = 12, **more: Any) -> tuple[dict[NodeId, list[Any]], Seen]:
    """The reports, and all that was published, with times from the epoch on."""
    seen: Seen = []
    scenario = walk(steps=steps, faults=list(faults), **more)
    reports = simulate(scenario, run="r", observe=lambda message, now: seen.append((message, now - EPOCH_NS)))
    return reports, seen


def times(seen: Seen, node: NodeId, stage: str = "measurement") -> dict[int, float]:
    """When the node published a stage, by step, in periods from the epoch on."""
    return {message.step: now / PERIOD for message, now in seen if (message.node, message.stage) == (node, stage)}


def used(seen: Seen, node: NodeId, stage: str = "intermediate") -> dict[int, Any]:
    return {m.step: m.fields["used"] for m, _ in seen if (m.node, m.stage) == (node, stage)}


def told(seen: Seen, kind: str = "fault") -> list[Any]:
    """(node, step, phase, time in periods) of the events."""
    events = [(m, m.fields["data"], now) for m, now in seen if m.stage == "event" and m.fields["kind"] == kind]
    return [(m.node, data.get("step"), data.get("phase"), now / PERIOD) for m, data, now in events]


# --- death ---


def test_a_node_dies_and_lives_again() -> None:
    kill = {"kind": "kill", "node": 20, "step": 4, "restart_after": 3}
    reports, seen = run(kill)
    assert [(r.born, r.step, r.completed) for r in reports[20]] == [(1, 3, 3), (7, 12, 6)]
    assert set(times(seen, 20)) == {1, 2, 3, *range(7, 13)}
    assert times(seen, 20)[7] == 7
    assert told(seen) == [(20, 4, "begins", 4), (20, 7, "ends", 7)]
    assert [(node, now) for node, *_, now in told(seen, "gone")] == [(10, 4), (30, 4)]
    assert used(seen, 10) == {k: (10, 50) if 4 <= k <= 7 else (10, 20, 50) for k in range(1, 13)}  # then heard of
    assert times(seen, 10, "intermediate") == {k: k for k in range(1, 13)}  # nobody waits for the dead


def test_the_truth_is_told_whoever_is_dead(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(steps=8, faults=[{"kind": "kill", "node": 10, "step": 3}]))
    assert [truth["step"] for truth in payloads(path, "truth")] == list(range(1, 9))


def test_a_node_that_stays_dead() -> None:
    reports, _ = run({"kind": "kill", "node": 20, "step": 4})
    assert [(r.born, r.step) for r in reports[20]] == [(1, 3)]
    assert all(reports[i][0].completed == 12 for i in (10, 30, 40, 50))
    late = {"kind": "kill", "node": 20, "step": 11, "restart_after": 5}
    assert [(r.born, r.step) for r in run(late)[0][20]] == [(1, 10)]  # the run is over by then


def test_a_node_that_dies_before_its_first_step() -> None:
    reports, _ = run({"kind": "kill", "node": 20, "step": 1, "restart_after": 2})
    assert [(r.born, r.completed) for r in reports[20]] == [(1, 0), (3, 10)]
    assert all(report.completed == 12 for report in (reports[10][0], reports[30][0]))


def test_everybody_dies_and_lives_again() -> None:
    kills = [{"kind": "kill", "node": i, "step": 5, "restart_after": 3} for i in IDS]
    for more in ({}, {"timing": FREE}):
        reports, seen = run(*kills, **more)
        for i in IDS:
            first, second = reports[i]
            assert (first.step, second.step) == (4, 12)
            assert second.born >= 8
        assert not [m for m, _ in seen if m.stage == "measurement" and 5 <= m.step < 8]


def test_a_free_running_node_lives_again_when_the_others_are_there() -> None:
    reports, seen = run({"kind": "kill", "node": 20, "step": 4, "restart_after": 3}, timing=FREE)
    assert [(r.born, r.step) for r in reports[20]] == [(1, 3), (8, 12)]
    assert max(now for _, now in seen) < 12 * FREE_STEP_NS + 500 * MS
    reports, seen = run({"kind": "kill", "node": 20, "step": 11, "restart_after": 1}, timing=FREE)
    assert len(reports[20]) == 1  # there is no step left that nobody has begun
    assert max(m.step for m, _ in seen) == 12


# --- standing still ---


def test_a_node_that_stands_still_skips_its_steps() -> None:
    reports, seen = run({"kind": "stop", "node": 20, "step": 4, "steps": 3})
    [report] = reports[20]
    assert (report.completed, report.skipped, report.step) == (9, 3, 12)
    assert times(seen, 20) == {k: k for k in (1, 2, 3, *range(7, 13))}
    assert told(seen) == [(20, 4, "begins", 4), (20, 7, "ends", 7)]
    assert {k for k, ids in used(seen, 10).items() if 20 not in ids} == {4, 5, 6}
    assert times(seen, 10, "intermediate")[5] == 5.45  # they wait for it until the deadline
    assert {j: edge["late"]["measurement"] for j, edge in report.edges.items()} == {"10": 3, "30": 3}


def test_a_free_running_node_that_stands_still_is_late_instead() -> None:
    reports, seen = run({"kind": "stop", "node": 20, "step": 4, "steps": 3}, timing=FREE)
    assert (reports[20][0].completed, reports[20][0].skipped) == (12, 0)
    assert set(times(seen, 20)) == set(range(1, 13))
    begun = [(m.node, m.step) for m, _ in seen if m.stage == "measurement"]
    assert begun.index((20, 4)) > min(begun.index((i, 7)) for i in IDS if i != 20)


def test_who_waits_is_late_and_skips_nothing() -> None:
    """20 stands still for 3 steps, all wait for it; then they catch up, as computing takes no time here."""
    timing = {"rate_hz": 50.0, "late": "wait"}
    reports, seen = run({"kind": "stop", "node": 20, "step": 4, "steps": 3}, timing=timing)
    assert all((report.completed, report.skipped) == (12, 0) for lives in reports.values() for report in lives)
    assert all(ids == used(seen, 10)[1] for ids in used(seen, 10).values())
    assert times(seen, 20) == {k: 7 if 4 <= k < 7 else k for k in range(1, 13)}


def test_a_stop_beyond_the_end() -> None:
    for more in ({}, {"timing": FREE}):
        reports, _ = run({"kind": "stop", "node": 20, "step": 10, "steps": 9}, **more)
        assert reports[20][0].completed + reports[20][0].skipped == 12
        assert all(reports[i][0].completed == 12 for i in IDS if i != 20)


def test_who_stands_still_hears_of_a_death_afterwards() -> None:
    stop, kill = {"kind": "stop", "node": 10, "step": 4, "steps": 3}, {"kind": "kill", "node": 20, "step": 5}
    _, seen = run(stop, kill)
    assert [(node, now) for node, *_, now in told(seen, "gone")] == [(30, 5), (10, 7)]
    assert used(seen, 10)[7] == (10, 50)


def test_what_happens_in_steps_that_are_skipped_to_the_end_is_told() -> None:
    stop = {"kind": "stop", "node": 20, "step": 8, "steps": 9}
    _, seen = run(stop, {"kind": "slow", "node": 20, "step": 11, "delay_s": 0.001})
    assert told(seen) == [(20, 8, "begins", 8), (20, 11, "begins", 17)]


# --- slowness and clocks ---


def test_a_slow_node_takes_longer_for_every_message() -> None:
    """3 ms each: measurement at 3, intermediate at 6, estimate at 9 of 20 ms; its neighbours wait for it."""
    reports, seen = run({"kind": "slow", "node": 20, "step": 4, "steps": 2, "delay_s": 0.003})
    for stage, taken in (("measurement", 0.15), ("intermediate", 0.3), ("estimate", 0.45)):
        assert times(seen, 20, stage) == pytest.approx({k: k + (taken if k in (4, 5) else 0) for k in range(1, 13)})
    assert times(seen, 10, "intermediate")[4] == pytest.approx(4.15)
    assert all(used(seen, i)[4] == used(seen, i)[3] for i in IDS)
    assert all(m.t_ns - EPOCH_NS == now for m, now in seen)
    assert reports[20][0].completed == 12


def test_what_came_in_time_is_in_time_however_late_it_is_looked_at() -> None:
    """12 ms each: when it has published its measurement, its deadline of 9 ms has passed; what came by then is used."""
    _, seen = run({"kind": "slow", "node": 20, "step": 4, "steps": 1, "delay_s": 0.012}, links={"delay": 0.002})
    assert used(seen, 20)[4] == (10, 20, 30)
    assert used(seen, 20, "estimate")[4] == (10, 20, 30)  # theirs came at 11 ms, until 18 is time
    assert used(seen, 10)[4] == (10, 50)
    late = {"delay": 0.002, "edges": [{"from": 10, "stages": "measurement", "delay": 0.0095}]}
    _, seen = run({"kind": "slow", "node": 20, "step": 4, "steps": 1, "delay_s": 0.012}, links=late)
    assert used(seen, 20)[4] == (20, 30)


def test_who_goes_on_takes_what_came_before_it_looks_at_the_clock() -> None:
    """20 publishes at 3.5 and 7 ms. Its alarm of 4 ms waits, and so do the intermediates that come at 5.5 of 6 ms."""
    timing = {"rate_hz": 50.0, "deadlines": {"measurement": 0.2, "intermediate": 0.3}}
    slow = {"kind": "slow", "node": 20, "step": 4, "steps": 1, "delay_s": 0.0035}
    _, seen = run(slow, timing=timing, links={"delay": 0.0015})
    assert times(seen, 20, "intermediate")[4] == pytest.approx(4 + 7 / 20)
    assert used(seen, 20, "estimate")[4] == (10, 20, 30)


def test_a_node_that_is_too_slow_is_not_waited_for_for_ever() -> None:
    """30 ms each: it misses the others' deadlines and every second step, and is itself again afterwards."""
    reports, seen = run({"kind": "slow", "node": 20, "step": 4, "steps": 2, "delay_s": 0.03})
    assert reports[20][0].skipped > 0
    assert reports[20][0].completed + reports[20][0].skipped == 12
    assert 20 not in used(seen, 10)[4]
    assert used(seen, 10)[11] == (10, 20, 50)


@pytest.mark.parametrize("offset_s", [0.006, -0.006])
def test_a_wrong_clock_moves_the_steps_and_the_stamps(offset_s: float) -> None:
    reports, seen = run({"kind": "clock", "node": 20, "step": 4, "steps": 2, "offset_s": offset_s})
    moved = {k: k - offset_s / 0.02 if k in (4, 5) else k for k in range(1, 13)}
    assert times(seen, 20) == pytest.approx(moved)
    for message, now in seen:
        if (message.node, message.stage) == (20, "measurement"):
            assert message.t_ns == EPOCH_NS + message.step * PERIOD  # by its own clock it is in time
            assert (message.t_ns - EPOCH_NS != now) == (message.step in (4, 5))
    assert used(seen, 10) == dict.fromkeys(range(1, 13), (10, 20, 50))  # 6 ms are within the deadline
    assert reports[20][0].skipped == 0


def test_a_clock_far_behind_is_late_for_everybody() -> None:
    reports, seen = run({"kind": "clock", "node": 20, "step": 4, "offset_s": -0.1})
    assert times(seen, 20)[6] == 11
    assert reports[10][0].edges["20"]["missed"]["measurement"] == 9
    assert reports[20][0].completed == 12


def test_deadlines_go_by_the_own_clock() -> None:
    """20's clock is 6 ms ahead, and 10 is silent: 20 waits until 9 ms by its clock, which is 3 ms after the step."""
    clock = {"kind": "clock", "node": 20, "step": 4, "offset_s": 0.006}
    _, seen = run(clock, {"kind": "cut", "from": 10, "to": 20, "step": 5, "steps": 1})
    assert times(seen, 20, "intermediate")[5] == pytest.approx(5 + 0.45 - 0.3)


# --- links ---


def test_a_partition_and_its_healing() -> None:
    _, seen = run({"kind": "partition", "groups": [[10, 20]], "step": 4, "steps": 2})
    assert used(seen, 10) == {k: (10, 20) if k in (4, 5) else (10, 20, 50) for k in range(1, 13)}
    assert used(seen, 40) == dict.fromkeys(range(1, 13), (30, 40, 50))
    assert sorted(told(seen)) == [
        (i, k, phase, k) for i in (10, 20, 30, 50) for k, phase in ((4, "begins"), (6, "ends"))
    ]


def test_a_topology_that_switches() -> None:
    topology = {
        "modes": [{"generator": "ring"}, {"generator": "ring", "directed": True}],
        "schedule": [{"step": 1, "mode": 0}, {"step": 5, "mode": 1}],
    }
    reports, seen = run(links={"topology": topology})
    assert used(seen, 20) == {k: (10, 20, 30) if k < 5 else (10, 20) for k in range(1, 13)}
    assert reports[20][0].emulated["30"] == {"cut": 16}


# --- what holds whatever happens ---

FAULTS = [
    {"kind": "kill", "node": 20, "step": 4, "restart_after": 3},
    {"kind": "stop", "node": 30, "step": 3, "steps": 2},
    {"kind": "slow", "node": 40, "step": 2, "steps": 5, "delay_s": 0.004},
    {"kind": "clock", "node": 50, "step": 6, "offset_s": 0.005},
    {"kind": "cut", "from": 10, "step": 5, "steps": 1},
    {"kind": "kill", "node": 10, "step": 9, "restart_after": 1},
]
LINKS = {
    "delay": {"distribution": "gamma", "shape": 2.0, "scale": 0.003},
    "loss": {"gilbert_elliott": {"to_bad": 0.1, "to_good": 0.5}},
    "duplicate": 0.05,
}


@pytest.mark.parametrize(
    "timing",
    [{"rate_hz": 50.0}, {"rate_hz": 50.0, "late": "revise"}, {"rate_hz": 50.0, "late": "wait", "timeout_s": 0.1}, FREE],
)
def test_the_same_story_is_the_same_recording_and_proves_itself(tmp_path: Path, timing: dict[str, Any]) -> None:
    scenario = walk(steps=25, timing=timing, links=LINKS, faults=FAULTS)
    one, two = (record(tmp_path / f"{n}.mcap", scenario) for n in range(2))
    assert records(one) == records(two)
    with Recording.open(one) as recording:
        assert Scenario.from_toml(recording.scenario_toml) == scenario
        verdict = verify(recording)
    assert verdict.verified, verdict.first or verdict.missing
    assert verdict.identical > 0.9 * len(payloads(one, "estimate"))
    phases = [p["data"]["phase"] for p in payloads(one, "event") if p["kind"] == "fault"]
    assert phases.count("begins") >= len(FAULTS)


probability = st.floats(0, 0.6)
steps_in = st.integers(1, 6)
lasting = st.fixed_dictionaries({"step": steps_in, "steps": st.integers(1, 4)})
ends = st.sampled_from([(10, 20), (20, 10), (40, 50), (10, 50)])
fault = st.one_of(
    lasting.flatmap(lambda span: st.just({"kind": "stop", "node": 30, **span})),
    st.tuples(lasting, st.sampled_from(IDS), st.floats(0.001, 0.03)).map(
        lambda given: {"kind": "slow", "node": given[1], "delay_s": given[2], **given[0]}
    ),
    st.tuples(lasting, st.sampled_from(IDS), st.floats(-0.05, 0.05)).map(
        lambda given: {"kind": "clock", "node": given[1], "offset_s": given[2], **given[0]}
    ),
    st.tuples(lasting, ends).map(lambda given: {"kind": "cut", "from": given[1][0], "to": given[1][1], **given[0]}),
    lasting.map(lambda span: {"kind": "partition", "groups": [[10, 20], [40]], **span}),
)
links = st.fixed_dictionaries(
    {
        "loss": probability,
        "duplicate": probability,
        "delay": st.one_of(
            st.floats(0, 0.02),
            st.just({"distribution": "pareto", "minimum": 0.002, "shape": 1.1}),
            st.just({"distribution": "uniform", "low": 0.0, "high": 0.05}),
        ),
        "reorder": st.booleans(),
    }
)


@settings(max_examples=25, deadline=None)
@given(links, st.lists(fault, max_size=4), st.integers(0, 1000))
def test_estimates_are_the_least_squares_ones_of_what_was_used(links: Any, faults: list[Any], seed: int) -> None:
    """Projection on all measurements, without any recursion; at most one stop, which must not overlap another."""
    stops = [fault for fault in faults if fault["kind"] == "stop"]
    scenario = walk(steps=7, seed=seed, links=links, faults=[f for f in faults if f not in stops[1:]])
    seen: Seen = []
    simulate(scenario, run="r", observe=lambda message, now: seen.append((message, now)))
    check_against_projection(scenario, [message for message, _ in seen])


def check_against_projection(scenario: Scenario, messages: list[Message]) -> None:
    fields: dict[str, dict[tuple[NodeId, int], Any]] = {}
    for message in messages:
        fields.setdefault(message.stage, {})[message.node, message.step] = message.fields
    stacked = brute_force.stack(scenario.system(), scenario.steps)
    Y = stacked.vector({place: said["y"] for place, said in fields["measurement"].items()})
    used, heard = (
        {place: said["used"] for place, said in fields[stage].items()} for stage in ("intermediate", "estimate")
    )
    expected = {i: brute_force.intermediate(stacked, i, used) for i in scenario.ids}
    for (i, k), said in fields["intermediate"].items():
        assert np.allclose(said["x"], expected[i].values(stacked, Y)[k], rtol=1e-8, atol=1e-9)
    fused = {i: brute_force.fused(stacked, expected, i, heard) for i in scenario.ids}
    for (i, k), said in fields["estimate"].items():
        assert np.allclose(said["x"], fused[i].values(stacked, Y)[k], rtol=1e-8, atol=1e-9)
        assert np.allclose(said["P"], fused[i].covariance[k], rtol=1e-8, atol=1e-10)
