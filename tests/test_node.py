"""The node: wired to others by a network that does its worst, and on its own, input by input.

Whatever the network does, each estimate must be the least-squares one for what the nodes' own messages say was used;
and a node is a function of its inputs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from random import Random
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bad_weather import (
    IDS,
    NEIGHBOURS,
    STEPS,
    WAIT,
    Swarm,
    Weather,
    bits,
    make,
    stages,
    system_and_stack,
    told,
)
from oracles import paper
from zfusion import node as node_module
from zfusion.methods.two_stage import Centralized, Local
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.types import Array, NodeId
from zfusion.node import ASK_AGAIN, LOOKAHEAD, REMEMBERED, Ask, Effect, Node
from zfusion.stages import Message
from zfusion.used_sets import Run

# --- a network that does its worst


weathers = st.builds(
    Weather,
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    duplicate=st.sampled_from([0.0, 0.2]),
    patience=st.sampled_from([0.05, 0.3]),
    crash=st.sampled_from([0.0, 0.0, 0.005, 0.02]),
    skip=st.sampled_from([0.0, 0.1]),
    deaf=st.sampled_from([(), [(2, 1)], [(1, 3), (4, 2), (2, 4)]]),
    no_reading=st.sampled_from([0.0, 0.2]),
    unanswered=st.sampled_from([0.0, 0.5]),
)


@settings(derandomize=True, deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 10**6), weathers, st.booleans(), st.sampled_from([1, 2, 16]))
def test_whatever_the_network_does_the_estimates_are_right(seed: int, weather: Weather, paced: bool, runs: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node_module, "HISTORY_RUNS", runs)  # few, so that gaps stay open and are asked about
        patch.setattr(node_module, "ASK_AGAIN", 2)
        patch.setattr(node_module, "NAMED", 3)
        swarm = Swarm(Random(seed), weather, paced)
        swarm.run()
        swarm.assert_estimates_are_least_squares()
        swarm.assert_every_message_is_accounted_for()
        swarm.assert_a_node_is_a_function_of_its_inputs()
        swarm.assert_a_replay_of_what_was_used_gives_the_same_bits()


def test_the_worst_weather_has_everything_in_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test above can meet, it meets."""
    monkeypatch.setattr(node_module, "HISTORY_RUNS", 1)
    monkeypatch.setattr(node_module, "ASK_AGAIN", 2)
    seen: Counter[str] = Counter()
    for seed in range(12):
        weather = Weather(loss=0.2, duplicate=0.1, patience=0.1, crash=0.01, skip=0.05, no_reading=0.1)
        swarm = Swarm(Random(seed), weather, paced=seed % 2 == 0)
        swarm.run()
        seen["fused"] += swarm.assert_estimates_are_least_squares()["fused"]
        seen["lives"] += len(swarm.lives) - len(IDS)
        seen["histories"] += sum(len(events) for by in swarm.events.values() for events in by.values())
        seen["skipped"] += sum(n.step + 1 - n.born - len(swarm.said[n.id, n.born]["measurement"]) for n in swarm.lives)
        for node in swarm.lives:
            seen["fallbacks"] += node.fallbacks
            for edge in node.counters.values():
                seen.update(edge.refused)
                seen.update(late=edge.late.total(), missed=edge.missed.total(), received=edge.received.total())
    assert min(seen[kind] for kind in ("fused", "lives", "histories", "skipped", "fallbacks", "received")) > 10
    assert min(seen[kind] for kind in ("late", "missed", "duplicate", "former_life")) > 3


def test_with_a_perfect_network_nothing_is_missed() -> None:
    swarm = Swarm(Random(1), Weather(), paced=False)
    swarm.run()
    assert swarm.now < WAIT
    assert swarm.assert_estimates_are_least_squares()["fused"] == STEPS * sum(
        len(members) - 1 for members in NEIGHBOURS.values()
    )
    for node in swarm.lives:
        assert node.completed == STEPS
        assert not node.fallbacks
        assert dict(node.sent) == {"measurement": STEPS, "intermediate": STEPS, "estimate": STEPS}
        for edge in node.counters.values():
            assert dict(edge.received) == {"measurement": STEPS, "intermediate": STEPS}
            assert not edge.late
            assert not edge.missed
            assert not edge.refused


def test_with_everything_lost_each_node_is_on_its_own_and_gets_on() -> None:
    swarm = Swarm(Random(2), Weather(loss=1.0), paced=False)
    swarm.run()
    assert swarm.assert_estimates_are_least_squares()["fused"] == 0
    for node in swarm.lives:
        assert node.completed == STEPS
        for edge in node.counters.values():
            assert dict(edge.missed) == {"measurement": STEPS, "intermediate": STEPS}


def test_a_node_that_is_heard_and_hears_nobody() -> None:
    swarm = Swarm(Random(3), Weather(deaf=[(2, 1), (3, 1)]), paced=False)
    swarm.nodes[1] = make(1, expected=())  # it waits for nobody either, or the others would not wait so long for it
    swarm.run()
    assert swarm.assert_estimates_are_least_squares()["fused"] > 0
    assert {m.fields["used"] for m in swarm.said[1, 1]["estimate"].values()} == {(1,)}
    for i in (3, 4):
        assert {m.fields["used"] for m in swarm.said[i, 1]["estimate"].values()} == {NEIGHBOURS[i]}


# --- one node, input by input


def message(
    j: NodeId, step: int, stage: str = "measurement", born: int = 1, history: Sequence[Run] | None = None
) -> Message:
    """A message of a neighbour that always uses all that it can."""
    system = system_and_stack()[0]
    if stage == "measurement":
        return Message(j, step, stage, step - born, born, 0, {"y": np.full(system.by_id[j].ny, 0.5)})
    if history is None:
        history = [(born, NEIGHBOURS[j])] if step > born else []
    x = np.full(system.nx, 0.25)
    return Message(j, step, stage, step - born, born, 0, {"x": x, "used": NEIGHBOURS[j], "history": history})


def y1() -> Array:
    return np.ones(system_and_stack()[0].by_id[1].ny)


def complete_step(node: Node, k: int, others: Sequence[NodeId] = (2, 3), now: int = 0) -> list[Effect]:
    effects = node.begin(k, y1(), now)
    for stage in ("measurement", "intermediate"):
        for j in others:
            effects += node.receive(message(j, k, stage), now)
    return effects


def test_a_step_from_measurement_to_estimate() -> None:
    node = make(1)
    assert (node.step, node.stage, node.deadline, node.estimate) == (0, None, None, None)
    assert stages(node.begin(1, y1(), now=50)) == ["measurement"]
    assert (node.step, node.stage, node.deadline, node.awaiting) == (1, "measurement", 50 + WAIT, (2, 3))
    assert node.receive(message(3, 1), now=60) == []
    assert node.awaiting == (2,)
    (said,) = told(node.receive(message(2, 1), now=70))
    assert (said.node, said.step, said.stage, said.seq, said.born, said.t_ns) == (1, 1, "intermediate", 0, 1, 70)
    assert said.fields["used"] == (1, 2, 3)
    assert said.fields["history"] == ()
    assert (node.stage, node.deadline, node.awaiting) == ("intermediate", 70 + WAIT, (2, 3))
    assert node.receive(message(2, 1, "intermediate"), now=80) == []
    (said,) = told(node.receive(message(3, 1, "intermediate"), now=90))
    assert said.stage == "estimate"
    assert said.fields["used"] == (1, 2, 3)
    assert said.fields["excluded"] == ()
    assert (node.step, node.stage, node.deadline, node.completed) == (1, None, None, 1)
    assert node.estimate is not None
    assert node.estimate.x is said.fields["x"]


def test_the_bits_do_not_depend_on_the_order_of_arrival() -> None:
    one, other = make(1), make(1)
    for k in range(1, 6):
        assert bits(complete_step(one, k, (2, 3))) == bits(complete_step(other, k, (3, 2)))


def test_what_comes_early_is_kept_until_its_time() -> None:
    node = make(1)
    for j in (2, 3):
        for k, stage in ((1, "intermediate"), (2, "measurement"), (1, "measurement"), (2, "intermediate")):
            assert node.receive(message(j, k, stage), now=0) == []
    assert stages(node.begin(1, y1(), now=0)) == ["measurement", "intermediate", "estimate"]
    assert stages(node.begin(2, y1(), now=0)) == ["measurement", "intermediate", "estimate"]
    assert node.estimate is not None
    assert node.estimate.used == (1, 2, 3)
    assert node.counters[2].received == {"measurement": 2, "intermediate": 2}


def test_a_stage_ends_when_its_time_is_up() -> None:
    node = make(1)
    node.begin(1, y1(), now=100)
    node.receive(message(2, 1), now=200)
    assert node.tick(now=100 + WAIT - 1) == []
    (said,) = told(node.tick(now=100 + WAIT))
    assert said.fields["used"] == (1, 2)
    assert node.deadline == 100 + 2 * WAIT  # of the next stage, from now on
    assert node.tick(now=100 + 2 * WAIT - 1) == []
    assert stages(node.tick(now=100 + 2 * WAIT)) == ["estimate"]
    assert node.tick(now=10**9) == []
    assert node.counters[3].missed == {"measurement": 1, "intermediate": 1}
    assert node.counters[2].missed == {"intermediate": 1}


def test_a_paced_node_keeps_the_times_of_its_step() -> None:
    node = make(1, paced=True)
    node.begin(1, y1(), now=130, start=100)
    assert node.deadline == 100 + WAIT
    for j in (2, 3):
        node.receive(message(j, 1), now=140)
    assert node.deadline == 100 + 2 * WAIT
    late = make(1, paced=True)
    assert stages(late.begin(1, y1(), now=100 + 5 * WAIT, start=100)) == ["measurement", "intermediate", "estimate"]


def test_what_comes_late_is_counted_and_changes_nothing() -> None:
    node, other = make(1), make(1)
    for it in (node, other):
        it.begin(1, y1(), now=0)
        it.receive(message(2, 1), now=0)
        it.tick(now=WAIT)
    assert node.receive(message(3, 1), now=WAIT) == []
    assert node.counters[3].late == {"measurement": 1}
    for it in (node, other):
        it.tick(now=2 * WAIT)
    assert node.receive(message(3, 1, "intermediate"), now=2 * WAIT) == []
    assert node.counters[3].late == {"measurement": 1, "intermediate": 1}
    assert bits(complete_step(node, 2)) == bits(complete_step(other, 2))


def test_what_comes_twice_counts_once() -> None:
    node, other = make(1), make(1)
    for it in (node, other):
        it.begin(1, y1(), now=0)
        it.receive(message(2, 1), now=0)
    lie = message(2, 1)._replace(fields={"y": 99 + y1()})
    for copy in (message(2, 1), lie):
        assert node.receive(copy, now=0) == []
    assert node.counters[2].refused == {"duplicate": 2}
    assert bits(node.receive(message(3, 1), now=0)) == bits(other.receive(message(3, 1), now=0))
    node.receive(message(2, 1), now=0)
    node.receive(message(2, 1, "intermediate"), now=0)
    node.receive(message(2, 1, "intermediate"), now=0)
    assert node.counters[2].refused == {"duplicate": 4}
    assert node.counters[2].received == {"measurement": 1, "intermediate": 1}


def test_strangers_and_unknown_stages_are_counted_and_not_heard() -> None:
    node = make(1)
    node.begin(1, y1(), now=0)
    for stray in (
        message(4, 1),
        message(1, 1),
        message(2, 1)._replace(node="2"),
        message(2, 1)._replace(stage="estimate"),
        message(2, 1)._replace(stage="gossip"),
    ):
        assert node.receive(stray, now=0) == []
    assert node.strays == 5
    assert node.awaiting == (2, 3)


def test_only_so_much_of_the_future_is_kept() -> None:
    node = make(1)
    for step in (1, 1 + LOOKAHEAD, LOOKAHEAD, 10**12, 2**53):
        node.receive(message(2, step), now=0)
    assert node.counters[2].refused == {"too_early": 3}
    for k in range(1, 200):
        node.begin(k, y1(), now=k)
        for step in range(k, k + 100):
            for stage in ("measurement", "intermediate"):
                node.receive(message(2, step, stage), now=k)
        node.tick(now=10**6)
        node.tick(now=10**7)
    assert sum(map(len, node._early.values())) <= 2 * LOOKAHEAD
    assert len(node._seen) <= LOOKAHEAD + REMEMBERED + 1


def test_what_comes_long_after_is_late_each_time() -> None:
    node = make(1, expected=())
    for k in range(1, REMEMBERED + 3):
        node.begin(k, y1(), now=k)
    for _ in range(3):
        node.receive(message(2, 1), now=0)
        node.receive(message(2, REMEMBERED), now=0)
    assert node.counters[2].late == {"measurement": 4}
    assert node.counters[2].refused == {"duplicate": 2}


def test_a_neighbour_that_is_gone_is_not_waited_for() -> None:
    node = make(1)
    node.begin(1, y1(), now=0)
    node.receive(message(2, 1), now=0)
    assert stages(node.gone(3, now=5)) == ["intermediate"]
    assert node.awaiting == (2,)
    assert stages(node.receive(message(2, 1, "intermediate"), now=5)) == ["estimate"]
    assert not node.counters[3].missed
    assert node.silent == (3,)
    assert stages(complete_step(node, 2, (2,)))[-1] == "estimate"


def test_a_neighbour_that_is_back_is_waited_for_from_when_it_can_be_in_time() -> None:
    node = make(1)
    node.gone(3, now=0)
    node.back(3)
    complete_step(node, 1, (2,))
    assert node.completed == 1  # it is there, but was not heard of yet
    node.begin(2, y1(), now=0)
    node.receive(message(3, 4), now=0)
    assert node.awaiting == (2,)
    assert node.silent == (3,)
    for stage in ("measurement", "intermediate"):
        node.receive(message(2, 2, stage), now=0)
    complete_step(node, 3, (2,))
    assert node.completed == 3
    node.begin(4, y1(), now=0)
    assert node.awaiting == (2,)  # its measurement was there already
    node.receive(message(2, 4), now=0)
    assert node.awaiting == (2, 3)
    other = make(1, expected=())
    other.back(2)
    other.begin(1, y1(), now=0)
    other.begin(2, y1(), now=0)
    other.receive(message(2, 1), now=0)  # late: it is in time from the next step on
    other.begin(3, y1(), now=0)
    assert other.awaiting == (2,)
    third = make(1, expected=(3,))
    third.back(2)
    complete_step(third, 1, (3,))
    third.begin(2, y1(), now=0)
    third.receive(message(2, 1), now=0)
    third.receive(message(3, 2), now=0)
    assert (third.stage, third.awaiting) == ("intermediate", (3,))


def test_nobody_begins_a_new_life_without_having_been_gone() -> None:
    node = make(1)
    complete_step(node, 1)
    node.begin(2, y1(), now=0)
    assert node.receive(message(2, 2, born=2), now=0) == []
    assert node.counters[2].refused == {"unannounced_life": 1}
    node.gone(2, now=0)
    node.receive(message(2, 3), now=0)  # the former life's last words, which came after the news of its end
    node.back(2)
    node.receive(message(2, 2, born=2), now=0)
    assert node.counters[2].refused == {"unannounced_life": 1, "former_life": 1}  # what it had said in advance
    assert node.counters[2].received["measurement"] == 2
    node.receive(message(2, 2, "intermediate"), now=0)
    assert node.counters[2].refused["former_life"] == 2
    node.receive(message(2, 3, born=3), now=0)
    assert node.counters[2].refused["unannounced_life"] == 2


def test_the_last_words_of_a_former_life_are_not_taken_for_the_new_ones() -> None:
    """Node 2 had told step 3 in advance, died, and begins anew at step 2: what it says of step 3 now is what counts."""
    node = make(1)
    complete_step(node, 1)
    for stage in ("measurement", "intermediate"):
        node.receive(message(2, 3, stage), now=0)
    node.gone(2, now=0)
    node.back(2)
    node.begin(2, y1(), now=0)
    for k in (2, 3):
        for stage in ("measurement", "intermediate"):
            node.receive(message(2, k, stage, born=2), now=0)
    for stage in ("measurement", "intermediate"):
        node.receive(message(3, 2, stage), now=0)
    assert node.counters[2].refused == {"former_life": 2}
    node.begin(3, y1(), now=0)
    for stage in ("measurement", "intermediate"):
        node.receive(message(3, 3, stage), now=0)
    history = node.ledger.of(2)
    assert history is not None
    assert (history.born, history.at(1), history.at(3)) == (2, (), NEIGHBOURS[2])
    assert node.estimate is not None
    assert node.estimate.used == (1, 2, 3)


def test_what_a_former_life_had_said_of_its_own_steps_still_counts() -> None:
    node = make(1)
    for k in (1, 2):
        for stage in ("measurement", "intermediate"):
            node.receive(message(2, k, stage), now=0)
    node.gone(2, now=0)
    node.back(2)
    node.receive(message(2, 3, born=3), now=0)
    for k in (1, 2):
        complete_step(node, k, (3,))
        assert node.estimate is not None
        assert node.estimate.used == (1, 2, 3)
    assert not node.counters[2].refused
    node.begin(3, y1(), now=0)
    assert node.awaiting == (3,)


def test_nothing_was_used_in_steps_that_were_slept_through() -> None:
    node = make(1, expected=())
    node.begin(1, y1(), now=0)
    node.receive(message(2, 3), now=0)
    (_, said, _) = told(node.begin(5, y1(), now=0))
    assert said.fields["history"] == ((1, (1,)), (2, ()))
    assert node.counters[2].late == {"measurement": 1}
    assert node.completed == 2
    (_, said, _) = told(node.begin(6, y1(), now=0))
    assert said.fields["history"] == ((1, (1,)), (2, ()), (5, (1,)))
    node.begin(1000, y1(), now=0)
    assert not node._seen


def test_a_step_begins_once_and_after_the_last_has_ended() -> None:
    node = make(1, born=4)
    for step in (3, 0, -1):
        with pytest.raises(ValueError, match="begun at step 3"):
            node.begin(step, y1(), now=0)
    node.begin(4, y1(), now=0)
    for step in (4, 5):
        with pytest.raises(ValueError, match=r"node 1: step \d begun at step 4, stage measurement"):
            node.begin(step, y1(), now=0)
    node.tick(now=WAIT)
    node.tick(now=2 * WAIT)
    with pytest.raises(ValueError, match="step 4 begun at step 4, stage None"):
        node.begin(4, y1(), now=0)
    node.begin(5, y1(), now=0)


def test_events_are_numbered_on_their_own_key() -> None:
    node = make(1, born=3)
    first, second = node.event("started", 7, epoch=1), node.event("gone", 8, of=2)
    assert (first.step, first.seq, first.stage, first.fields) == (
        3,
        0,
        "event",
        {"kind": "started", "data": {"epoch": 1}},
    )
    assert (second.seq, second.t_ns) == (1, 8)
    assert node.begin(3, y1(), now=9)[0].seq == 0  # type: ignore[union-attr]


def test_other_methods_have_other_stages() -> None:
    local = make(1, method=Local)
    assert local.neighbours == ()
    assert stages(local.begin(1, y1(), now=0)) == ["measurement", "estimate"]
    central = make(1, method=Centralized)
    assert central.neighbours == (2, 3, 4)
    assert stages(central.begin(1, y1(), now=0)) == ["measurement"]
    central.receive(message(2, 1), now=0)
    central.receive(message(3, 1), now=0)
    (said,) = told(central.tick(now=WAIT))
    assert (said.stage, said.fields["used"]) == ("estimate", (1, 2, 3))
    assert stages(central.begin(4, None, now=0)) == ["measurement"]


# --- histories that are asked for


def with_a_gap() -> Node:
    """Node 1 at step 9, having missed node 2's steps 2..5 and been told nothing of them."""
    node = make(1)
    complete_step(node, 1)
    for k in range(2, 6):
        node.begin(k, y1(), now=k * 10**4)
        for stage in ("measurement", "intermediate"):
            node.receive(message(3, k, stage), now=k * 10**4)
            node.tick(now=k * 10**4 + (1 if stage == "measurement" else 2) * WAIT)
    return node


def gapped_step(node: Node, k: int) -> list[Effect]:
    effects = node.begin(k, y1(), now=0)
    for stage in ("measurement", "intermediate"):
        effects += node.receive(message(2, k, stage, history=[(6, NEIGHBOURS[2])] if k > 6 else []), now=0)
        effects += node.receive(message(3, k, stage), now=0)
    return effects


def test_a_history_is_asked_for_taken_in_and_told() -> None:
    node = with_a_gap()
    *_, estimate, ask = gapped_step(node, 6)
    assert ask == Ask(2, 2)
    assert isinstance(estimate, Message)
    assert estimate.fields["used"] == (1, 3)
    assert estimate.fields["excluded"] == (2,)
    assert node.fallbacks == 1
    assert not any(isinstance(effect, Ask) for effect in gapped_step(node, 7))  # not again at once
    runs: list[Run] = [(1, NEIGHBOURS[2]), (2, ()), (4, (2, 3)), (6, NEIGHBOURS[2]), (9, (2,))]
    node.learn_history(2, 1, 11, runs)
    effects = gapped_step(node, 8)
    event, estimate = told(effects)[-2:]
    assert event.fields == {"kind": "history", "data": {"of": 2, "born": 1, "end": 8, "runs": runs[:-1]}}
    assert estimate.fields["used"] == (1, 2, 3)
    history = node.ledger.of(2)
    assert history is not None
    assert [history.at(k) for k in range(1, 10)] == [NEIGHBOURS[2], (), (), (2, 3), (2, 3), *[NEIGHBOURS[2]] * 3, None]
    assert node.fallbacks == 2


def test_a_question_without_an_answer_is_asked_again_after_a_while() -> None:
    node = with_a_gap()
    asked = [k for k in range(6, 8 + 2 * ASK_AGAIN) if any(isinstance(e, Ask) for e in gapped_step(node, k))]
    assert asked == [6, 6 + ASK_AGAIN, 6 + 2 * ASK_AGAIN]


def test_answers_about_another_life_or_about_nobody_are_left_out() -> None:
    node = with_a_gap()
    gapped_step(node, 6)
    for of, born, end, runs in ((2, 5, 6, [(5, (2,))]), (4, 1, 6, [(1, (4,))]), (2, 1, 6, []), (2, 1, 20, [(9, (2,))])):
        node.learn_history(cast(NodeId, of), cast(int, born), cast(int, end), cast("list[Run]", runs))
    assert "event" not in stages(gapped_step(node, 7))
    assert node.estimate is not None
    assert node.estimate.excluded == (2,)


def test_a_long_history_is_told_in_pieces_that_make_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_module, "NAMED", 5)
    node, again = with_a_gap(), with_a_gap()
    for it in (node, again):
        gapped_step(it, 6)
    runs: list[Run] = [(1, NEIGHBOURS[2]), (2, ()), (3, (2, 3)), (4, ()), (5, (2, 4)), (6, NEIGHBOURS[2])]
    node.learn_history(2, 1, 7, runs)
    events = [m for m in told(gapped_step(node, 7)) if m.stage == "event"]
    pieces = [cast("dict[str, Any]", event.fields["data"]) for event in events]
    assert [(piece["end"], len(piece["runs"])) for piece in pieces] == [(2, 2), (5, 3), (7, 1)]
    for piece in pieces:
        again.learn_history(piece["of"], piece["born"], piece["end"], piece["runs"])
    gapped_step(again, 7)
    assert again.estimate is not None
    assert node.estimate is not None
    assert again.estimate.used == (1, 2, 3)
    assert again.estimate.x.tobytes() == node.estimate.x.tobytes()
    assert again.estimate.P.tobytes() == node.estimate.P.tobytes()


# --- the published example, through nodes


def test_four_nodes_have_the_published_error_variances() -> None:
    system, network = paper.paper_system(), Network(paper.NEIGHBOURS, {})
    nodes = {i: make(i, network=network, system=system) for i in network.ids}
    readings = SamplePath(system, 2)
    for k in range(1, 101):
        effects = [e for i, node in nodes.items() for e in node.begin(k, readings.measurement(i, k), now=0)]
        for message in (queue := told(effects)):
            if message.stage != "estimate":
                queue += [m for j in network.listeners(message.node) for m in told(nodes[j].receive(message, now=0))]
        if k in paper.ERROR_VARIANCES:
            found = [node.estimate.P[0, 0] for node in nodes.values() if node.estimate is not None]
            np.testing.assert_allclose(found, paper.ERROR_VARIANCES[k]["distributed"], rtol=0, atol=1e-9)
