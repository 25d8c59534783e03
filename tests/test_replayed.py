"""Replays: fed what a recording says was used, the nodes say the same again, bit for bit; or it is told where not."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import sqrt
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

from oracles import brute_force
from recordings import record as record_messages
from recordings import traffic
from simulations import (
    MS,
    altered,
    by_rule,
    four_sensor,
    losing,
    payloads,
    record,
    record_story,
    records,
    rewrite,
    walk,
    without,
    writer_for,
)
from zfusion.drivers import replayed
from zfusion.drivers.replayed import verify
from zfusion.drivers.rerun import rerun
from zfusion.drivers.simulated import EPOCH_NS, Simulation
from zfusion.drivers.verdict import TOLERANCE, Verdict, ulps_apart
from zfusion.errors import InputError
from zfusion.links import Edge, Link, ideal
from zfusion.messages import decode_any, encode_any
from zfusion.model.scenario import Scenario
from zfusion.recording import Keeping, Record, Recording
from zfusion.stages import Message
from zfusion.used_sets import HISTORY_RUNS


def verdict_on(path: Path, **how: Any) -> Verdict:
    with Recording.open(path) as recording:
        return verify(recording, **how)


def next_float(x: float) -> float:
    """x with the last bit of its mantissa flipped."""
    flipped: float = struct.unpack("<d", struct.pack("<q", struct.unpack("<q", struct.pack("<d", x))[0] ^ 1))[0]
    return flipped


def assert_all_identical(path: Path, count: int | None = None) -> Verdict:
    verdict = verdict_on(path)
    published = sum(len(payloads(path, stage)) for stage in ("intermediate", "estimate", "revised"))
    assert (verdict.different, verdict.unverifiable, verdict.cut_off) == (0, 0, 0), verdict.first or verdict.missing
    assert verdict.identical == published
    assert count is None or published == count
    assert verdict.verified
    return verdict


def bursts(edge: Edge, message: Message) -> int | None:
    """20 is not heard at 10 for longer than a history reaches back, while its used sets keep changing."""
    if edge == (20, 10) and 5 <= message.step < 5 + 3 * HISTORY_RUNS:
        return None
    if edge == (30, 20) and message.stage == "measurement" and message.step % 2:
        return None
    return 0


@pytest.mark.parametrize(
    ("scenario", "link"),
    [
        (four_sensor(40), ideal),
        (four_sensor(40), losing(0.2, seed=3)),
        (walk(40), losing(0.4, seed=4)),
        (walk(20, names=True), losing(0.1, seed=5)),
        (walk(30, timing={"free_run": True}), losing(0.1, seed=6)),
        (walk(20), by_rule(lambda edge, message: (7 * edge[0] + 3 * edge[1] + message.step) % 12 * MS)),
        (walk(10, method="local"), ideal),
        (walk(10, method="centralized"), losing(0.3, seed=7)),
    ],
)
def test_everything_is_identical(tmp_path: Path, scenario: Scenario, link: Link) -> None:
    stages = 2 if scenario.method.name == "two_stage" else 1
    path = record(tmp_path / "r.mcap", scenario, link)
    verdict = assert_all_identical(path, stages * scenario.steps * len(scenario.ids))
    assert verdict.lives == len(scenario.ids)
    assert verdict.tolerance is None


def late(edge: Edge, message: Message) -> int | None:
    """A tenth is lost, and a quarter is late by up to six steps of 20 ms."""
    random = Random(f"{edge} {message.stage} {message.step}")
    fate = random.random()
    return None if fate < 0.1 else random.randrange(120 * MS) if fate < 0.35 else MS


REVISING: dict[str, Any] = {"timing": {"rate_hz": 50.0, "late": "revise", "window": 4}}


@pytest.mark.parametrize("method", ["two_stage", "centralized"])
@pytest.mark.parametrize("timing", [{"late": "revise", "window": 3}, {"late": "wait", "timeout_s": 0.03}])
def test_whatever_becomes_of_what_is_late(tmp_path: Path, method: str, timing: dict[str, Any]) -> None:
    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 12 * 20 * MS)
        simulation.kill(20)
        simulation.run(EPOCH_NS + 16 * 20 * MS)
        simulation.revive(20)

    path = tmp_path / "r.mcap"
    scenario = walk(30, timing={"rate_hz": 50.0, **timing}, method=method)
    simulation = record_story(path, scenario, tell, by_rule(late))
    assert assert_all_identical(path).lives == 6
    corrected = payloads(path, "revised")
    assert (len(corrected) > 30) == ("window" in timing)
    assert all(1 <= p["at"] - p["step"] <= 3 for p in corrected)
    lives = [report for lives in simulation.reports.values() for report in lives]
    taken = [edge["revised"].get("measurement", 0) for report in lives for edge in report.edges.values()]
    assert (sum(taken) > 30) == ("window" in timing)


def test_what_is_wrong_with_a_corrected_estimate_or_missing(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(20, **REVISING), by_rule(late))
    whole = assert_all_identical(path)
    first, second = payloads(path, "revised", 10)[1:3]

    def change(old: Record, **changes: Any) -> list[Record]:
        payload = decode_any(old.data)
        here = old.topic.endswith("/node/10/revised") and payload["seq"] == 1
        return [old._replace(data=encode_any({**payload, **changes}))] if here else [old]

    wrong = rewrite(
        path, tmp_path / "wrong.mcap", lambda old: change(old, x=[first["x"][0], next_float(first["x"][1])])
    )
    verdict = verdict_on(wrong)
    assert (verdict.different, verdict.identical) == (1, whole.identical - 1)
    assert verdict.first is not None
    assert (verdict.first.node, verdict.first.step, verdict.first.stage) == (10, first["step"], "revised")
    moved = rewrite(path, tmp_path / "moved.mcap", lambda old: change(old, at=first["at"] + 1))
    assert verdict_on(moved).different == 1
    lost = without(path, tmp_path / "lost.mcap", (10, "revised", first["step"]))
    gone = len(payloads(path, "revised", 10)) - len(payloads(lost, "revised", 10))
    verdict = verdict_on(lost)
    assert (verdict.different, verdict.unverifiable, verdict.identical) == (0, gone, whole.identical - gone)
    assert second["seq"] == 2


def test_a_revision_that_nobody_told_proves_nothing(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(20, **REVISING), by_rule(late))
    event = next(p for p in payloads(path, "event", 10) if p["kind"] == "revised")
    verdict = verdict_on(without(path, tmp_path / "x.mcap", (10, "event", event["step"])))
    assert not verdict.different
    assert verdict.unverifiable > 10
    assert "x event of node 10" in verdict.missing[0]


def test_several_processes_find_what_one_does(tmp_path: Path) -> None:
    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 6 * 20 * MS + 5 * MS)
        simulation.kill(20)
        simulation.run(EPOCH_NS + 8 * 20 * MS + 5 * MS)
        simulation.revive(20)

    path = tmp_path / "r.mcap"
    record_story(path, walk(15), tell, by_rule(lambda edge, _: 4 * MS))
    short = without(path, tmp_path / "x.mcap", (20, "measurement", 3), (20, "measurement", 6))
    wrong = altered(short, tmp_path / "y.mcap", (40, "estimate", 2), lambda p: {"x": [0.0, p["x"][1]]})
    one, two = verdict_on(wrong), verdict_on(wrong, jobs=2)
    assert set(one.missing) == set(two.missing)
    assert replace(one, missing=()).as_dict() == replace(two, missing=()).as_dict()
    assert one.different == 1
    assert one.lives == 6


def test_histories_that_were_asked_for_are_identical_too(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(10 + 4 * HISTORY_RUNS), by_rule(bursts))
    assert any(event["kind"] == "history" for event in payloads(path, "event", 10))
    assert any(estimate["excluded"] for estimate in payloads(path, "estimate", 10))
    assert_all_identical(path)


def story(simulation: Simulation, period: int, middle: int) -> None:
    """20 dies within step 6 and is back at 9; 40 dies at 12 and stays away; 10 dies and is back at once."""

    def until(step: int, more: int) -> None:
        simulation.run(EPOCH_NS + step * period + more)

    until(6, middle)
    simulation.kill(20)
    until(8, middle)
    simulation.revive(20)
    until(12, 1)
    simulation.kill(40)
    until(14, middle)
    simulation.kill(10)
    simulation.revive(10)


@pytest.mark.parametrize("free_run", [False, True])
@pytest.mark.parametrize("middle", [2 * MS, 5 * MS, 7 * MS])
def test_lives_that_end_and_begin(tmp_path: Path, free_run: bool, middle: int) -> None:
    """Messages take 4 ms: so it happens in the middle of a stage."""
    scenario = walk(30, timing={"free_run": True, "timeout_s": 0.1} if free_run else {"rate_hz": 50.0})
    slow = by_rule(lambda edge, _: 4 * MS)
    path = tmp_path / "r.mcap"
    record_story(path, scenario, lambda s: story(s, 20 * MS, middle), slow)
    verdict = assert_all_identical(path)
    assert verdict.lives == 7


class Sleepy(Simulation):
    """A simulation in which node 20 sleeps through steps 5 to 8, as one does whose process was stopped for a while."""

    def _schedule(self, life: Any, step: int) -> None:
        super()._schedule(life, 9 if life.node.id == 20 and step == 5 else step)


def test_steps_that_were_slept_through(tmp_path: Path) -> None:
    scenario = walk(14)
    with writer_for(tmp_path / "r.mcap", scenario) as writer:
        Sleepy(scenario, run="r", record=writer.write).run()
    assert [p["step"] for p in payloads(tmp_path / "r.mcap", "estimate", 20)] == [*range(1, 5), *range(9, 15)]
    assert_all_identical(tmp_path / "r.mcap", 2 * (5 * 14 - 4))


def test_a_restart_that_is_heard_before_the_step_is_over(tmp_path: Path) -> None:
    """10 waits for 50 in step 4 when 20, whose message of that step it has, dies, is back, and speaks of step 6."""

    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 200 * MS)
        assert simulation.nodes[10].step == 4
        assert simulation.nodes[10].stage == "intermediate"
        simulation.kill(20)
        simulation.revive(20)

    path = tmp_path / "r.mcap"
    slow = by_rule(
        lambda edge, message: (
            500 * MS if edge == (50, 10) and (message.step, message.stage) == (4, "intermediate") else 0
        )
    )
    record_story(path, walk(12, timing={"free_run": True, "timeout_s": 10.0}), tell, slow)
    assert {p["step"] for p in payloads(path, "measurement", 20) if p["born"] > 1} == set(range(6, 13))
    assert_all_identical(path)


def test_a_life_that_ends_within_a_step_is_verified_as_far_as_it_came(tmp_path: Path) -> None:
    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 3 * 20 * MS + 5 * MS)
        simulation.kill(20)

    path = tmp_path / "r.mcap"
    record_story(path, walk(6), tell, by_rule(lambda edge, _: 4 * MS))
    assert len(payloads(path, "intermediate", 20)) == 3
    assert len(payloads(path, "estimate", 20)) == 2
    assert assert_all_identical(path).nodes[20].identical == 5


def test_what_died_on_the_way_to_the_recorder_is_known_from_those_who_heard_it(tmp_path: Path) -> None:
    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 3 * 20 * MS + 1)
        simulation.kill(20)

    path, short = tmp_path / "r.mcap", tmp_path / "short.mcap"
    record_story(path, walk(6), tell)
    lost = [(20, stage, 3) for stage in ("measurement", "intermediate", "estimate")]
    verdict = verdict_on(without(path, short, *lost))
    assert (verdict.different, verdict.unverifiable) == (0, 0)
    assert verdict.nodes[20].identical == 5  # the witnesses have its intermediate estimate too, not its estimate
    without_witnesses = rewrite(
        short, tmp_path / "none.mcap", lambda r: [r] if decode_any(r.data).get("kind") != "gone" else []
    )
    assert verdict_on(without_witnesses).unverifiable > 0


@pytest.mark.parametrize(("field", "ulps"), [("x", 1), ("P", 1), ("used", None), ("excluded", None)])
def test_one_bit_is_found(tmp_path: Path, field: str, ulps: int | None) -> None:
    """An estimate is nobody's input: so it is the only difference."""

    def change(payload: dict[str, Any]) -> dict[str, Any]:
        if ulps is None:
            return {
                "used": [10, 50] if field == "used" else payload["used"],
                "excluded": [20] if field == "excluded" else [],
            }
        return {field: [*payload[field][:-1], next_float(payload[field][-1])]}

    path = record(tmp_path / "r.mcap", walk(9))
    verdict = verdict_on(altered(path, tmp_path / "x.mcap", (10, "estimate", 7), change))
    assert (verdict.identical, verdict.different, verdict.unverifiable) == (2 * 9 * 5 - 1, 1, 0)
    assert verdict.nodes[10].different == 1
    assert not verdict.verified
    first = verdict.first
    assert first is not None
    assert (first.node, first.step, first.stage) == (10, 7, "estimate")
    assert field == "used" or (first.field, first.ulps) == (field, ulps)  # other used sets: x is compared first
    assert "node 10, step 7, estimate." in str(first)
    assert json.loads(json.dumps(verdict.as_dict()))["first_difference"]["step"] == 7


def test_the_first_difference_is_that_of_the_lowest_step(tmp_path: Path) -> None:
    path = record(tmp_path / "0.mcap", walk(9))
    for number, (node, step) in enumerate([(10, 8), (50, 4), (30, 4), (20, 6)]):
        path = altered(
            path,
            tmp_path / f"{number + 1}.mcap",
            (node, "estimate", step),
            lambda payload: {"x": [-x for x in payload["x"]]},
        )
    verdict = verdict_on(path)
    assert verdict.different == 4
    assert verdict.first is not None
    assert (verdict.first.step, verdict.first.node) == (4, 30)


def test_an_altered_input_shows_where_it_was_used(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(9))
    changed = altered(path, tmp_path / "x.mcap", (20, "intermediate", 9), lambda p: {"x": [p["x"][0] + 1.0, p["x"][1]]})
    verdict = verdict_on(changed)  # its own, and the estimates of its two neighbours
    assert {i: tally.different for i, tally in verdict.nodes.items()} == {10: 1, 20: 1, 30: 1, 40: 0, 50: 0}
    changed = altered(path, tmp_path / "y.mcap", (20, "measurement", 9), lambda p: {"y": [p["y"][0] + 1.0, p["y"][1]]})
    verdict = verdict_on(changed)  # the intermediate estimates of those who used it, and 20's estimate
    assert {i: tally.different for i, tally in verdict.nodes.items()} == {10: 2, 20: 2, 30: 2, 40: 0, 50: 0}
    assert verdict.first is not None
    assert (verdict.first.step, verdict.first.stage, verdict.first.node) == (9, "intermediate", 10)


@pytest.mark.parametrize(
    ("lost", "named", "nodes"),
    [
        ((20, "measurement", 5), "measurement of node 20, step 5, which node 10 used", {10, 20, 30}),
        ((20, "intermediate", 5), "intermediate of node 20, step 5, which node 10 used", {10, 20, 30}),
        ((20, "estimate", 5), "1 x estimate of node 20 before step 6", {20}),
    ],
)
def test_what_is_missing_is_named_and_proves_nothing(
    tmp_path: Path, lost: tuple[int, str, int], named: str, nodes: set[int]
) -> None:
    path = record(tmp_path / "r.mcap", walk(12))
    verdict = verdict_on(without(path, tmp_path / "x.mcap", lost))
    assert verdict.different == 0
    assert named in verdict.missing
    assert {i for i, tally in verdict.nodes.items() if tally.unverifiable} == nodes
    assert verdict.identical + verdict.unverifiable == 2 * 12 * 5


def test_after_a_lost_measurement_a_filter_that_forgets_comes_back(tmp_path: Path) -> None:
    """Covariances and used sets never were in doubt; the readings of then count less with every step."""
    path = record(tmp_path / "r.mcap", walk(200))
    verdict = verdict_on(without(path, tmp_path / "x.mcap", (20, "measurement", 5)))
    assert verdict.different == 0
    assert 0 < verdict.unverifiable < 2 * 3 * 120
    assert verdict.missing_count == 3  # two who used it, and its own


def test_a_whole_step_that_is_missing_is_not_taken_for_one_that_was_skipped(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(12))
    lost = [(20, stage, 5) for stage in ("measurement", "intermediate", "estimate")]
    verdict = verdict_on(without(path, tmp_path / "x.mcap", *lost))
    assert verdict.different == 0
    assert "1 x measurement of node 20 before step 6" in verdict.missing


def test_a_missing_event_is_named(tmp_path: Path) -> None:
    """It may have been a history."""
    path = record(tmp_path / "r.mcap", walk(10 + 4 * HISTORY_RUNS), by_rule(bursts))
    step = next(event["step"] for event in payloads(path, "event", 10) if event["kind"] == "history")
    verdict = verdict_on(without(path, tmp_path / "x.mcap", (10, "event", step)))
    assert verdict.different == 0
    assert any("x event of node 10" in what for what in verdict.missing)


def test_a_recording_that_was_broken_off_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    scenario = walk(12)
    with writer_for(path, scenario) as writer:
        everything = records(record(tmp_path / "whole.mcap", scenario, losing(0.1, seed=2)))
        for n, (topic, data, log_time, *_) in enumerate(everything):
            writer.write(topic, data, log_time)
            if n % 7 == 0:
                writer.flush()
    whole = path.read_bytes()
    seen = set()
    for size in range(len(whole) // 3, len(whole), len(whole) // 50):
        path.write_bytes(whole[:size])
        verdict = verdict_on(path)
        assert (verdict.different, verdict.unverifiable) == (0, 0), verdict.missing
        published = len(payloads(path, "intermediate")) + len(payloads(path, "estimate"))
        assert verdict.identical + verdict.cut_off == published
        assert verdict.cut_off <= 10
        assert verdict.note
        seen.add(verdict.identical)
    assert len(seen) > 10


def test_what_the_recorder_heard_in_another_order_than_the_nodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One node's messages come much later than the others', each in its own order."""
    path = record(tmp_path / "r.mcap", walk(40), losing(0.2, seed=2))
    late = rewritten_in_order(path, tmp_path / "x.mcap", lambda r: "/node/20/" in r.topic)
    assert_all_identical(late)
    monkeypatch.setattr(replayed, "WAIT_STEPS", 16)
    verdict = verdict_on(late)  # too late: memory is bounded
    assert verdict.different == 0
    assert verdict.unverifiable > 0


def rewritten_in_order(path: Path, target: Path, last: Callable[[Record], bool]) -> Path:
    with Recording.open(path) as recording, writer_for(target, Scenario.from_toml(recording.scenario_toml)) as writer:
        for topic, data, log_time, *_ in sorted(recording.records(), key=last):
            writer.write(topic, data, log_time)
    return target


def test_memory_does_not_grow_with_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shelves are looked at as they are tidied: they hold no more than what came since."""
    monkeypatch.setattr(replayed, "TIDY_EVERY", 16)
    most = 0
    tidy = replayed._Verifier._tidy

    def watched(self: replayed._Verifier, node: Any) -> None:
        nonlocal most
        tidy(self, node)
        most = max(most, *(len(of) for shelf in self._shelves.values() for of in shelf.by_stage.values()))

    monkeypatch.setattr(replayed._Verifier, "_tidy", watched)
    assert_all_identical(record(tmp_path / "r.mcap", walk(120), losing(0.1, seed=2)))
    assert 0 < most <= 16


def test_garbage_repetitions_and_strangers_change_nothing(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(10), losing(0.2, seed=1))
    random = Random(1)

    def disturbed(old: Record) -> Iterable[Record]:
        yield old
        if random.random() < 0.3:
            yield old
        if random.random() < 0.2 and "event" not in old.topic:
            yield old._replace(data=old.data[:-3])
        if random.random() < 0.1:
            yield old._replace(topic="zfusion/r/node/stranger/measurement")
        if random.random() < 0.1:
            yield old._replace(topic="elsewhere")
        if random.random() < 0.1 and old.topic.endswith("intermediate"):
            yield old._replace(data=encode_any(decode_any(old.data) | {"x": [float("nan"), 0.0]}))

    verdict = verdict_on(rewrite(path, tmp_path / "x.mcap", disturbed))
    assert (verdict.different, verdict.unverifiable, verdict.identical) == (0, 0, 2 * 10 * 5)
    assert verdict.unreadable > 10


def test_a_message_from_the_far_future_keeps_nobody_busy(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(6))

    def forged(old: Record) -> list[Record]:
        payload = decode_any(old.data)
        if payload["step"] != 4 or "event" in old.topic or "truth" in old.topic:
            return [old]
        return [old, *(old._replace(data=encode_any(payload | {"step": 2**53 - 1, "born": b})) for b in (1, 2**53 - 1))]

    verdict = verdict_on(rewrite(path, tmp_path / "x.mcap", forged))
    assert (verdict.identical, verdict.different, verdict.unverifiable) == (2 * 6 * 5, 0, 0)
    assert verdict.unreadable == 2 * 3 * 5


def test_a_former_life_that_speaks_up_when_the_next_has_begun(tmp_path: Path) -> None:
    """Its last estimate comes to the recorder seconds later than it should: it is not verified, and said so."""

    def tell(simulation: Simulation) -> None:
        simulation.run(EPOCH_NS + 6 * 20 * MS + 1)
        simulation.kill(20)
        simulation.revive(20)

    path = tmp_path / "r.mcap"
    record_story(path, walk(12), tell)
    late = rewritten_in_order(
        path,
        tmp_path / "x.mcap",
        lambda r: r.topic.endswith("/20/estimate") and decode_any(r.data)["step"] == 6,
    )
    verdict = verdict_on(late)
    assert (verdict.different, verdict.unverifiable) == (0, 0)  # it belongs to a step that is over: nobody misses it
    assert verdict.identical == 2 * 12 * 5 - 1
    silent = rewrite(path, tmp_path / "y.mcap", lambda r: [] if decode_any(r.data).get("kind") == "gone" else [r])
    verdict = verdict_on(
        rewritten_in_order(silent, tmp_path / "z.mcap", lambda r: "/20/" in r.topic and decode_any(r.data)["step"] == 6)
    )
    assert verdict.different == 0
    assert verdict.nodes[20].unverifiable == 2
    assert any("when that life is over" in what for what in verdict.missing)


def test_two_different_messages_of_one_step_leave_it_open_which_was_used(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(6))

    def twice(old: Record) -> list[Record]:
        payload = decode_any(old.data)
        if not old.topic.endswith("/node/20/measurement") or payload["step"] != 4:
            return [old]
        return [old._replace(data=encode_any(payload | {"y": [0.0, 0.0]})), old]

    verdict = verdict_on(rewrite(path, tmp_path / "x.mcap", twice))
    assert "which measurement of node 20, step 4, node 10 used: there are two" in verdict.missing
    assert verdict.nodes[10].different == 0
    assert verdict.nodes[10].unverifiable > 0


def test_on_another_kind_of_machine_it_is_compared_within_a_tolerance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = {"cpu": ("another", "this")}
    monkeypatch.setattr(replayed, "arithmetic_differences", lambda _: other)
    path = record(tmp_path / "r.mcap", walk(9))

    def by(relative: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
        return lambda payload: {"x": [x * (1 + relative) for x in payload["x"]]}

    near = verdict_on(altered(path, tmp_path / "1.mcap", (10, "estimate", 7), by(TOLERANCE / 10)))
    assert (near.different, near.identical, near.tolerance) == (0, 90, TOLERANCE)
    assert near.arithmetic == other
    far = verdict_on(altered(path, tmp_path / "2.mcap", (10, "estimate", 7), by(TOLERANCE * 10)))
    assert far.different == 1
    sets = verdict_on(altered(path, tmp_path / "3.mcap", (10, "estimate", 7), lambda p: {"excluded": [20]}))
    assert sets.different == 1
    strict = verdict_on(tmp_path / "1.mcap", tolerance=TOLERANCE / 100)
    assert strict.different == 1


def test_a_recording_of_a_method_that_is_not_there(tmp_path: Path) -> None:
    scenario = walk(2)
    with writer_for(tmp_path / "r.mcap", scenario.with_overrides(method="clairvoyance")):
        pass
    with pytest.raises(InputError, match="clairvoyance"):
        verdict_on(tmp_path / "r.mcap")


def test_an_empty_recording_proves_nothing(tmp_path: Path) -> None:
    with writer_for(tmp_path / "r.mcap", walk(2)):
        pass
    verdict = verdict_on(tmp_path / "r.mcap")
    assert verdict.identical == verdict.different == 0
    assert not verdict.verified


def test_ulps() -> None:
    one = np.array([1.0, 0.0, 1e-300])
    assert ulps_apart(one, one) == 0
    assert ulps_apart(one, np.array([np.nextafter(1.0, 2.0), -0.0, 1e-300])) == 1
    assert ulps_apart(np.array([5e-324]), np.array([-5e-324])) == 2
    assert ulps_apart(one, np.zeros(2)) is None


def test_a_rerun_changes_only_what_it_is_told_to(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", walk(12))
    with Recording.open(path) as recording:
        again = rerun(recording, {}, tmp_path / "again.mcap")
        lossy = rerun(recording, {}, tmp_path / "lossy.mcap", link=losing(0.3, seed=1), run="lossy")
    assert {(change.compared, change.rms) for change in again.changes.values()} == {(12, 0.0)}
    assert all(change.before == change.after for change in again.changes.values())
    assert all(change.compared == 12 and change.rms for change in lossy.changes.values())
    with Recording.open(tmp_path / "again.mcap") as recording:
        assert recording.metadata["run"] == "r-rerun"
    for stage in ("measurement", "truth"):
        bare = [
            sorted(
                ({**p, "t_ns": 0} for p in payloads(tmp_path / name, stage)), key=lambda p: (p["step"], str(p["node"]))
            )
            for name in ("r.mcap", "again.mcap", "lossy.mcap")
        ]
        assert bare[0] == bare[1] == bare[2]
    for name in ("again.mcap", "lossy.mcap"):
        assert_all_identical(tmp_path / name)


def test_a_rerun_replaces_nothing_that_it_reads(tmp_path: Path) -> None:
    path = record_messages(tmp_path / "r.mcap", traffic(200), keeping=Keeping(rotate_bytes=20_000))
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    for output in before:
        with (
            Recording.open(path) as recording,
            pytest.raises(InputError, match="is one of the recordings that are read"),
        ):
            rerun(recording, {}, output)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_rerun_with_another_graph_is_the_simulation_with_that_graph(tmp_path: Path) -> None:
    graph = {"edges": [[10, 30], [30, 50], [20, 10]]}
    path = record(tmp_path / "r.mcap", walk(8))
    with Recording.open(path) as recording:
        rerun(recording, walk(8, network=graph), tmp_path / "new.mcap")
    expected = record(tmp_path / "expected.mcap", walk(8, network=graph))
    assert payloads(tmp_path / "new.mcap", "estimate") == payloads(expected, "estimate")


def test_some_of_the_sensors(tmp_path: Path) -> None:
    full = walk(5)
    document = full.model_dump(by_alias=True, exclude_unset=True)
    few = Scenario.model_validate(document | {"sensors": document["sensors"][:3]})
    path = record(tmp_path / "r.mcap", full)
    with Recording.open(path) as recording:
        result = rerun(recording, few, tmp_path / "few.mcap")
        assert list(result.changes) == [10, 20, 30]
        with pytest.raises(InputError, match="no measurements of sensor ada"):
            rerun(recording, walk(5, names=True), tmp_path / "x.mcap")
        wider = document | {"sensors": [{"id": 10, "H": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0, 0.0], [0.0, 1.0]]}]}
        with pytest.raises(InputError, match=r"sensor 10.*wrong_shape"):
            rerun(recording, Scenario.model_validate(wider), tmp_path / "x.mcap")
        with pytest.raises(InputError, match="is one of the recordings that are read"):
            rerun(recording, {}, path)


@pytest.mark.parametrize("method", ["local", "centralized"])
def test_errors_of_a_rerun_are_those_that_were_predicted(tmp_path: Path, method: str) -> None:
    """x' = 0.9 x + w, everything white and Gaussian, one realisation of n steps.

    The filter's errors are a stationary process e' = rho e + ..., rho = 0.9 (1 - K H); so the mean over n steps of e²/P
    has variance (2/n) (1 + rho²) / (1 - rho²) at most, and lies within six standard deviations of 1.
    """
    n = 1500
    scenario = Scenario.model_validate(
        {
            "seed": 3,
            "steps": n,
            "timing": {"free_run": True},
            "network": {"generator": "ring"},
            "system": {"F": [[0.9]], "Q": [[1.0]], "initial_mean": [0.0], "initial_covariance": [[1.0]]},
            "sensors": [{"ids": [1, 2, 3], "H": [[1.0]], "R": [[0.8]]}],
        }
    )
    path = record(tmp_path / "r.mcap", scenario)
    with Recording.open(path) as recording:
        result = rerun(recording, {"method": method}, tmp_path / "new.mcap")
    hears = {i: (i,) if method == "local" else (1, 2, 3) for i in (1, 2, 3)}
    P = float(brute_force.error_covariances(scenario.system(), hears, 12).intermediate[-1, 0, 0, 0])
    rho = 0.9 * P / (0.81 * P + 1.0)  # 1 - K H = P / P_predicted
    bound = 6 * sqrt(2 / n * (1 + rho**2) / (1 - rho**2))
    for i, change in result.changes.items():
        assert change.after["predicted_mse"] == pytest.approx(P, rel=1e-3)
        assert abs(change.after["nees"] - 1.0) < bound
        assert abs(change.after["mse"] / P - 1.0) < bound + 1e-3
        assert result.reports[i][0].errors["estimate"] == change.after
    assert bound < 0.3
