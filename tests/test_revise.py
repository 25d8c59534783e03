"""Nodes that revise: what comes late is taken in, and afterwards all is as if it had been in time.

Whatever the network does, the estimates that are published, corrected ones included, are the least-squares ones for
what was used, with the right covariances; and a replay of what was told gives the same bits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from random import Random

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bad_weather import (
    IDS,
    NEIGHBOURS,
    NETWORK,
    TWINS,
    WAIT,
    Climate,
    Lockstep,
    Swarm,
    Weather,
    bits,
    make,
    path,
    stages,
    told,
)
from simulations import MS, by_rule, walk
from zfusion import node as node_module
from zfusion.drivers.account import patience_of
from zfusion.drivers.simulated import Simulation
from zfusion.errors import ScenarioError
from zfusion.links import Edge, Link
from zfusion.methods import neighbourhood as neighbourhood_module
from zfusion.methods.check import check_method
from zfusion.methods.two_stage import Centralized, TwoStage
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.schema.run import TimingSpec
from zfusion.model.types import NodeId
from zfusion.node import Effect, Node, Patience
from zfusion.stages import Message
from zfusion.used_sets import Run

STEPS = 12

weathers = st.builds(
    Weather,
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    loss_of=st.sampled_from([("", 0.0), ("measurement", 0.6), ("intermediate", 0.6), ("intermediate", 1.0)]),
    duplicate=st.sampled_from([0.0, 0.2]),
    patience=st.sampled_from([0.01, 0.05, 0.3, 0.6]),
    crash=st.sampled_from([0.0, 0.0, 0.005, 0.03]),
    skip=st.sampled_from([0.0, 0.1]),
    deaf=st.sampled_from([(), [(2, 1)], [(1, 3), (4, 2), (2, 4)]]),
    no_reading=st.sampled_from([0.0, 0.2]),
    unanswered=st.sampled_from([0.0, 0.5]),
    slow_answers=st.sampled_from([0.0, 0.95]),
)
climates = st.builds(
    Climate,
    late=st.sampled_from([0.05, 0.2, 0.4]),
    later=st.sampled_from([0.3, 0.6, 0.8]),
    burst=st.builds(
        lambda measurement, intermediate: {"measurement": measurement, "intermediate": intermediate},
        st.sampled_from([0.0, 0.05, 0.2]),
        st.sampled_from([0.0, 0.05, 0.2]),
    ),
    length=st.sampled_from([2.0, 4.0, 8.0]),
    duplicate=st.sampled_from([0.0, 0.2]),
    crash=st.sampled_from([0.0, 0.0, 0.01, 0.05]),
    sleep=st.sampled_from([0.0, 0.05]),
    no_reading=st.sampled_from([0.0, 0.1]),
    answered=st.sampled_from([0.1, 0.4, 1.0]),
)
methods: st.SearchStrategy[type[Centralized]] = st.sampled_from([TwoStage, TwoStage, TwoStage, Centralized])
networks = st.sampled_from([NETWORK, TWINS])
slow = settings(derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@contextmanager
def little_room(runs: int, memory: int = 1 << 26) -> Iterator[None]:
    """Short histories, so that gaps stay open and are asked about, and few states to go back to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node_module, "HISTORY_RUNS", runs)
        patch.setattr(node_module, "ASK_AGAIN", 2)
        patch.setattr(node_module, "NAMED", 3)
        patch.setattr(neighbourhood_module, "WINDOW_BYTES", memory)
        yield


def check(swarm: Swarm) -> Counter[str]:
    seen = swarm.assert_estimates_are_least_squares()
    swarm.assert_every_message_is_accounted_for()
    swarm.assert_a_node_is_a_function_of_its_inputs()
    swarm.assert_a_replay_of_what_was_used_gives_the_same_bits()
    for node in swarm.lives:
        seen["fallbacks"] += node.fallbacks
        for edge in node.counters.values():
            for kind in ("revised", "too_late", "stale"):
                seen.update({f"{kind} {stage}": count for stage, count in getattr(edge, kind).items()})
    events = (event for by in swarm.events.values() for told_at in by.values() for event in told_at)
    seen["histories"] = sum(event.fields["kind"] == "history" for event in events)
    return seen


@settings(slow, max_examples=15)
@given(
    st.integers(0, 10**6),
    weathers,
    st.booleans(),
    st.sampled_from([1, 2, 16]),
    st.sampled_from([1, 2, 4, 8, 15]),
    networks,
    methods,
)
def test_whatever_the_network_does_the_estimates_are_right(
    seed: int, weather: Weather, paced: bool, runs: int, window: int, network: Network, method: type[Centralized]
) -> None:
    with little_room(runs):
        swarm = Swarm(Random(seed), weather, paced, STEPS, window=window, network=network, method=method)
        swarm.run()
        check(swarm)


@settings(slow, max_examples=15)
@given(
    st.integers(0, 10**6),
    climates,
    st.sampled_from([1, 2, 16]),
    st.sampled_from([1, 1 << 26]),
    st.sampled_from([1, 1, 2, 3, 6]),
    networks,
    methods,
)
def test_after_long_gaps_and_late_answers_too(
    seed: int, climate: Climate, runs: int, memory: int, window: int, network: Network, method: type[Centralized]
) -> None:
    with little_room(runs, memory):
        swarm = Lockstep(Random(seed), climate, 20, window=window, network=network, method=method)
        swarm.run()
        check(swarm)


def test_the_worst_has_everything_in_it() -> None:
    """What the tests above can meet, they meet."""
    seen: Counter[str] = Counter()
    climate = Climate(
        late=0.3, later=0.5, burst={"intermediate": 0.1}, crash=0.04, sleep=0.03, no_reading=0.1, duplicate=0.1
    )
    with little_room(1):
        for seed in range(4):
            swarm = Lockstep(Random(seed), climate, 16, window=1 + seed)
            swarm.run()
            seen += check(swarm)
            for node in swarm.lives:
                for edge in node.counters.values():
                    seen.update(edge.refused)
            seen["lives"] += len(swarm.lives) - len(IDS)
    assert min(seen[f"{kind} measurement"] for kind in ("revised", "too_late")) > 10
    assert min(seen[f"{kind} intermediate"] for kind in ("revised", "too_late", "stale")) > 10
    assert min(seen[kind] for kind in ("revised", "fused", "histories", "fallbacks", "duplicate", "lives")) > 3


@pytest.mark.parametrize("seed", range(6))
def test_when_the_network_recovers_so_do_the_nodes(seed: int) -> None:
    """Nothing is lost for good: one step after everything arrives again, everybody's estimate is used by all."""
    burst = {"measurement": 0.1, "intermediate": 0.15}
    climate = Climate(late=0.3, later=0.5, burst=burst, sleep=0.05, crash=0.02, answered=0.2, calm_from=20)
    with little_room(1 + seed % 2):
        swarm = Lockstep(Random(seed), climate, 24, window=1 + seed)
        swarm.run()
    for i, node in swarm.nodes.items():
        said = swarm.said[i, node.born]["estimate"]
        assert [said[k].fields["used"] for k in (22, 23, 24)] == [NEIGHBOURS[i]] * 3


@pytest.mark.parametrize("window", [2, 4, 8])
@pytest.mark.parametrize("method", [TwoStage, Centralized])
def test_once_all_is_there_it_is_as_if_it_had_been_in_time(window: int, method: type[Centralized]) -> None:
    """Bit for bit."""
    last = 16

    def run(late: float) -> Lockstep:
        climate = Climate(late=late, later=1 - 1 / window, calm_from=last - window)
        swarm = Lockstep(Random(5), climate, last, window=window, method=method, at_most=window - 1)
        swarm.run()
        return swarm

    revised, in_time = run(0.5), run(0.0)
    assert sum(edge.revised["measurement"] for node in revised.lives for edge in node.counters.values()) > 10
    assert not any(edge.too_late for node in revised.lives for edge in node.counters.values())
    changed = 0
    for life, by in revised.said.items():
        wanted = in_time.said[life]
        changed += sum(bits([by["estimate"][k]])[0][6] != bits([wanted["estimate"][k]])[0][6] for k in range(1, last))
        assert bits([by["estimate"][last]])[0][6] == bits([wanted["estimate"][last]])[0][6]
        if method is TwoStage:
            assert bits([by["intermediate"][last]])[0][6]["x"] == bits([wanted["intermediate"][last]])[0][6]["x"]
    assert changed > 10


def test_with_everything_lost_there_is_nothing_to_revise() -> None:
    swarm = Swarm(Random(2), Weather(loss=1.0), paced=False, steps=6, window=4)
    swarm.run()
    assert check(swarm)["fused"] == 0
    assert not any(swarm.corrections.values())
    assert not any(event for by in swarm.events.values() for event in by.values())


# --- one node, input by input


def y(i: NodeId, k: int) -> Message:
    return Message(i, k, "measurement", k - 1, 1, 0, {"y": path().measurement(i, k)})


def x(i: NodeId, k: int, used: tuple[NodeId, ...], history: Sequence[Run] = ()) -> Message:
    return Message(i, k, "intermediate", k - 1, 1, 0, {"x": np.ones(2), "used": used, "history": history})


def step(node: Node, k: int, *between: Message) -> list[Message]:
    """A step in which nobody is heard in time; then the rest comes."""
    effects = node.begin(k, path().measurement(node.id, k), now=0)
    for now in (WAIT, 2 * WAIT):
        effects += node.tick(now)
    for message in between:
        assert node.receive(message, 2 * WAIT) == []
    return told(effects)


def revisions(effects: Sequence[Effect]) -> list[object]:
    events = [m for m in told(effects) if m.stage == "event"]
    assert all(event.fields["kind"] == "revised" for event in events)
    return [event.fields["data"] for event in events]


def test_what_is_late_within_the_window_is_taken_in_when_its_stage_closes_again() -> None:
    node = make(1, window=2)
    assert stages(step(node, 1, y(2, 1), y(3, 1))) == ["measurement", "intermediate", "estimate"]
    said = step(node, 2, y(2, 2))
    assert stages(said) == ["measurement", "event", "intermediate", "revised", "estimate"]
    assert revisions(said) == [{"stage": "measurement", "taken": [(1, (2, 3))]}]
    assert said[2].fields["history"] == ((1, (1, 2, 3)),)
    assert (said[3].step, said[3].fields["at"], said[3].fields["used"]) == (1, 2, (1,))
    step(node, 3)
    step(node, 4)
    node.begin(5, None, now=0)
    for k, j in ((2, 3), (3, 3), (4, 3), (4, 2)):
        node.receive(y(j, k), 0)
    (event, *_) = told(node.tick(WAIT))
    assert event.fields["data"] == {"stage": "measurement", "taken": [(3, (3,)), (4, (2, 3))]}
    assert node.counters[3].late == {"measurement": 4}
    assert node.counters[3].revised == {"measurement": 3}
    assert node.counters[3].too_late == {"measurement": 1}
    node.receive(y(3, 4), 0)
    assert node.counters[3].refused == {"duplicate": 1}


def test_without_a_window_nothing_is_taken_in() -> None:
    node = make(1)
    step(node, 1, y(2, 1))
    assert stages(step(node, 2)) == ["measurement", "intermediate", "estimate"]
    assert not node.counters[2].revised


def test_what_comes_while_the_first_stage_is_open_is_in_this_step_already() -> None:
    node = make(1, window=2)
    step(node, 1)
    node.begin(2, None, now=0)
    node.receive(y(2, 1), 0)
    said = told(node.tick(WAIT))
    assert revisions(said) == [{"stage": "measurement", "taken": [(1, (2,))]}]


def test_what_holds_no_reading_is_only_counted() -> None:
    node = make(1, window=2)
    step(node, 1, y(2, 1)._replace(fields={"y": None}))
    assert stages(step(node, 2)) == ["measurement", "intermediate", "estimate"]
    assert (node.counters[2].late, node.counters[2].revised) == ({"measurement": 1}, {})


def test_what_a_node_slept_through_is_taken_in_and_what_was_before_its_life_is_not() -> None:
    node = make(1, window=3, born=3, expected=())
    step(node, 3)
    for message in (y(2, 2), y(2, 4), y(3, 3)):
        node.receive(message, 0)
    said = step(node, 5)
    assert revisions(said) == [{"stage": "measurement", "taken": [(3, (3,)), (4, (2,))]}]
    assert (node.counters[2].late, node.counters[2].too_late) == ({"measurement": 2}, {})
    assert said[2].fields["history"] == ((3, (1, 3)), (4, (2,)))
    assert [m.step for m in said if m.stage == "revised"] == [3]  # of step 4 there was nothing to correct


def test_many_revisions_are_told_in_several_events(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, "NAMED", 3)
    node = make(1, window=4)
    for k in (1, 2, 3):
        step(node, k)
    for k in (1, 2, 3):
        node.receive(y(2, k), 0)
    assert revisions(step(node, 4)) == [
        {"stage": "measurement", "taken": [(1, (2,)), (2, (2,))]},
        {"stage": "measurement", "taken": [(3, (2,))]},
    ]


def test_a_late_intermediate_corrects_its_step_unless_its_sender_has_used_more_since() -> None:
    node = make(1, window=3)
    step(node, 1, x(2, 1, (2, 3)), x(3, 1, (3,)))
    node.begin(2, None, now=0)
    node.tick(WAIT)
    node.receive(x(2, 2, (2, 3), [(1, (2, 3))]), WAIT)
    said = told(node.receive(x(3, 2, (3,), [(1, (1, 3))]), WAIT))
    assert stages(said) == ["event", "revised", "estimate"]
    assert revisions(said) == [{"stage": "intermediate", "taken": [(1, (2, 3))]}]
    assert (said[1].fields["used"], said[1].fields["excluded"]) == ((1, 2), (3,))
    assert (node.counters[2].revised, node.counters[3].stale) == ({"intermediate": 1}, {"intermediate": 1})


def test_an_answer_says_only_what_is_final() -> None:
    node = make(1, window=2)
    assert node.tell_history() == (1, 0, [])
    for k in range(1, 6):
        step(node, k)
    assert node.tell_history() == (1, 3, [(1, (1,))])


# --- are errors as large as they are said to be?

RUNS, SIGMAS = 12, 4.5


def rough(seed: int) -> Link:
    """A tenth is lost, and three in ten come up to five steps of 20 ms late."""

    def fate(edge: Edge, message: Message) -> int | None:
        random = Random(f"{seed} {edge} {message.stage} {message.step}")
        chance = random.random()
        return None if chance < 0.1 else random.randrange(100 * MS) if chance < 0.4 else MS

    return by_rule(fate)


@pytest.mark.parametrize(
    "timing", [{"late": "drop"}, {"late": "revise", "window": 3}, {"late": "wait", "timeout_s": 0.05}]
)
def test_errors_are_as_large_as_predicted_whatever_becomes_of_what_is_late(timing: dict[str, object]) -> None:
    """NEES, with losses, lateness and a restart. What is published when depends on no data, so its mean is nx = 2.

    A run's mean over its nodes and steps is one sample; their mean may be off by 4.5 of its standard deviations.
    """
    nees: dict[str, list[float]] = {}
    for seed in range(RUNS):
        scenario = walk(25, seed=seed, timing={"rate_hz": 50.0, **timing})
        simulation = Simulation(scenario, link=rough(seed))
        simulation.run(simulation.epoch_ns + 9 * 20 * MS)
        simulation.kill(20)
        simulation.run(simulation.epoch_ns + 12 * 20 * MS)
        simulation.revive(20)
        simulation.run()
        reports = [report for lives in simulation.reports.values() for report in lives]
        for stage in ("estimate", "revised"):
            told = [report.errors[stage] for report in reports if report.errors.get(stage, {}).get("count")]
            if told:
                mean = sum(e["nees"] * e["count"] for e in told) / sum(e["count"] for e in told)
                nees.setdefault(stage, []).append(mean)
    assert set(nees) == ({"estimate", "revised"} if timing["late"] == "revise" else {"estimate"})
    for samples in nees.values():
        deviation = np.std(samples, ddof=1) / np.sqrt(len(samples))
        assert deviation < 0.25
        assert abs(np.mean(samples) - 2.0) < SIGMAS * deviation


# --- the scenario's part


def test_what_a_scenario_says_of_lateness() -> None:
    assert (TimingSpec().late, TimingSpec().revised_steps) == ("drop", 0)
    assert TimingSpec(late="revise").revised_steps == 8
    assert TimingSpec(late="revise", window=15).revised_steps == 15
    waiting = walk(timing={"rate_hz": 10.0, "late": "wait", "timeout_s": 2.0})
    assert patience_of(waiting) == Patience((2 * 10**9, 2 * 10**9), paced=False)
    texts = [
        walk(timing=timing) for timing in ({}, {"late": "wait"}, {"late": "revise"}, {"late": "revise", "window": 9})
    ]
    assert len({scenario.fingerprint for scenario in texts}) == 4
    assert [Scenario.from_toml(scenario.to_toml()).timing for scenario in texts] == [s.timing for s in texts]


@pytest.mark.parametrize(
    ("timing", "expected"),
    [
        ({"late": "never"}, "timing.late: expected"),
        ({"window": 4}, 'timing.window: expected late = "revise" with it'),
        ({"late": "wait", "window": 4}, "timing.window: expected late"),
        ({"late": "revise", "window": 16}, "timing.window: expected a number <= 15"),
        ({"late": "revise", "window": 0}, "timing.window: expected a number >= 1"),
        ({"late": "wait", "deadlines": {"measurement": 0.4}}, "timing.deadlines: expected none"),
    ],
)
def test_what_a_scenario_cannot_say_of_lateness(timing: dict[str, object], expected: str) -> None:
    with pytest.raises(ScenarioError, match=expected):
        walk(timing=timing)


def test_a_method_that_cannot_go_back_is_refused() -> None:
    check_method(walk(timing={"late": "revise"}), "here")
    with pytest.raises(ScenarioError, match=r"timing\.late: expected a method that can go back: two_stage, local, "):
        check_method(walk(timing={"late": "revise"}, method="diffusion"), "here")
