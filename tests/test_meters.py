"""What a node measures: latencies, waits, and a budget whose parts are the round, to the nanosecond."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from zfusion.drivers.meters import BATCH, BATCH_STEPS, MOST_PENDING, PARTS, Meter, add_up, runs_of
from zfusion.drivers.metrics import Latencies
from zfusion.links.measured import read_arrivals
from zfusion.messages import Decoder, encode
from zfusion.stages import ARRIVALS, Message

STAGES = ("measurement", "intermediate")


def message(sender: int, step: int, stage: str, sent_ns: int) -> Message:
    return Message(sender, step, stage, step, 1, sent_ns, {})


def budget(meter: Meter, sender: int, stage: str) -> dict[str, int]:
    """The parts that are not zero."""
    parts = meter.told()["edges"][str(sender)][stage]["budget_ns"]
    return {part: ns for part, ns in parts.items() if ns}


def round_of(meter: Meter, step: int, marks: list[int], rows: dict[tuple[int, str], tuple[int, ...]]) -> None:
    """One round with these marks: begun, put, (there, put) of each stage; rows of sent, received, due, looked at."""
    begun, put, *closings = marks
    meter.begin(step, begun)
    meter.put(put)
    for (sender, stage), (sent, received, due, looked) in rows.items():
        meter.took(message(sender, step, stage, sent), looked, received, due)
    for there, put in zip(closings[::2], closings[1::2], strict=True):
        meter.there(there)
        meter.put(put)
    meter.finish()


def test_a_round_is_cut_where_its_marks_and_the_messages_say() -> None:
    meter = Meter([2, 3], STAGES)
    rows = {
        (2, "measurement"): (130, 150, 150, 155),
        (3, "measurement"): (90, 120, 180, 185),  # sent before this node had put its own
        (2, "intermediate"): (250, 270, 270, 280),
    }
    round_of(meter, 1, [100, 110, 200, 220, 300, 340], rows)
    assert budget(meter, 2, "measurement") == {"computed": 10, "behind": 20, "wire": 20, "queued": 5, "waited": 45}
    assert budget(meter, 3, "measurement") == {"computed": 10, "wire": 10, "injected": 60, "queued": 5, "waited": 15}
    assert budget(meter, 2, "intermediate") == {
        "computed": 20, "behind": 30, "wire": 20, "queued": 10, "waited": 20, "finished": 40
    }  # fmt: skip
    assert budget(meter, 3, "intermediate") == {"computed": 20, "missing": 80, "finished": 40}
    assert (meter.told()["rounds"], meter.told()["rounds_ns"]) == (1, 240)


TIME = st.integers(min_value=0, max_value=10**12)


@given(
    rounds=st.lists(
        st.tuples(
            st.lists(TIME, min_size=6, max_size=6),
            st.dictionaries(
                st.tuples(st.sampled_from([2, 3]), st.sampled_from(STAGES)), st.tuples(TIME, TIME, TIME, TIME)
            ),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_the_parts_are_the_round_whatever_the_clocks_say(
    rounds: list[tuple[list[int], dict[tuple[int, str], tuple[int, ...]]]],
) -> None:
    meter = Meter([2, 3], STAGES)
    for step, (marks, rows) in enumerate(rounds, start=1):
        round_of(meter, step, marks, rows)
    told = meter.told()
    assert told["rounds"] == len(rounds)
    for stages in told["edges"].values():
        parts = [ns for stage in stages.values() for ns in stage["budget_ns"].values()]
        assert min(parts) >= 0
        assert sum(parts) == told["rounds_ns"]


def test_only_marked_rounds_have_a_budget_but_all_latencies_count() -> None:
    meter = Meter([2], STAGES, marked_every=4)
    for step in range(1, 9):
        rows = {(2, stage): (100, 120, 120, 130) for stage in STAGES}
        round_of(meter, step, [100, 110, 200, 220, 300, 340], rows)
    list(meter.batch(ended=True))
    told = meter.told()
    assert told["rounds"] == 2
    assert sum(told["edges"]["2"]["measurement"]["latency"].values()) == 8
    assert sum(told["waits"]["measurement"].values()) == 8


def test_a_round_that_was_broken_off_has_no_budget() -> None:
    meter = Meter([2], STAGES)
    meter.begin(1, 100)
    meter.put(110)
    meter.finish()
    assert meter.told()["rounds"] == 0


def arrivals(data: dict[str, Any]) -> dict[tuple[Any, str], dict[int, int]]:
    """What a batch tells, by sender and stage."""
    found: dict[tuple[Any, str], dict[int, int]] = {}
    for sender, stage, step, latency in read_arrivals(data):
        found.setdefault((sender, stage), {})[step] = latency
    return found


def test_latencies_are_told_in_batches_and_once() -> None:
    meter = Meter(["ada", 7], STAGES)
    expected: dict[tuple[Any, str], dict[int, int]] = {}
    told: list[dict[str, Any]] = []
    for step in range(1, 2 * BATCH_STEPS + 10):
        meter.begin(step, step)
        for sender, stage in (("ada", "measurement"), (7, "intermediate")):
            if step % 5:
                meter.took(Message(sender, step, stage, step, 1, 1000, {}), 1000 + step)
                meter.took(Message(sender, step, stage, step, 1, 1000, {}), 5000 + step)  # once more: the first counts
                expected.setdefault((sender, stage), {})[step] = step
        meter.finish()
        told += meter.batch()
    assert len(told) == 2
    told += meter.batch(ended=True)
    found: dict[tuple[Any, str], dict[int, int]] = {}
    for data in told:
        for place, latencies in arrivals(data).items():
            assert not found.setdefault(place, {}).keys() & latencies.keys()
            found[place] |= latencies
    assert found == expected
    assert not list(meter.batch(ended=True))


def test_a_batch_is_a_legal_message_however_much_there_is_to_tell() -> None:
    meter = Meter(range(2, 70), STAGES)
    for step in range(1, 2 * BATCH_STEPS, 2):  # runs of one step each, the most there is to say of a latency
        meter.begin(step, step)
        for sender in range(2, 70):
            for stage in STAGES:
                meter.took(message(sender, step, stage, 0), 2**62)
        meter.finish()
    batches = list(meter.batch(ended=True))
    assert len(batches) == -(-68 * 2 * BATCH_STEPS // BATCH)
    decoder = Decoder(ARRIVALS, 1)
    counted = 0
    for data in batches:
        decoded = decoder.decode(encode(Message(1, 500, ARRIVALS.name, 0, 1, 0, {"data": data})))
        assert decoded.fields["data"] == data
        counted += sum(len(latencies) for latencies in arrivals(data).values())
    assert counted == 68 * 2 * BATCH_STEPS


def test_a_neighbour_who_repeats_himself_does_not_fill_the_memory() -> None:
    meter = Meter([2], STAGES)
    for step in range(1, 2 * MOST_PENDING):
        meter.took(message(2, step, "measurement", 0), 1)
    [told, *_] = [arrivals(data) for data in meter.batch(ended=True)]
    counted = meter.told()["edges"]["2"]["measurement"]["latency"]
    assert sum(counted.values()) == MOST_PENDING
    assert len(told[2, "measurement"]) <= BATCH


@given(steps=st.sets(st.integers(min_value=1, max_value=60)))
def test_runs_say_the_steps(steps: set[int]) -> None:
    runs = runs_of(sorted(steps))
    assert {step for first, count in runs for step in range(first, first + count)} == steps
    assert all(first + count < after for (first, count), (after, _) in pairwise(runs))


def test_lives_add_up() -> None:
    lives = []
    for life in (1, 2):
        meter = Meter([2], STAGES)
        round_of(meter, 1, [0, 1, 10, 12, 20, 30], {(2, "measurement"): (1, 2, 2, 5 * life)})
        list(meter.batch(ended=True))
        lives.append(meter.told())
    total = add_up([*lives, {}])
    assert (total["rounds"], total["rounds_ns"]) == (2, 60)
    edge = total["edges"]["2"]["measurement"]
    assert sum(edge["latency"].values()) == 2
    assert edge["total_ns"] == (2 - 1) + (2 - 1)  # until it was due
    assert sum(edge["budget_ns"].values()) == 2 * 10
    assert set(edge["budget_ns"]) == set(PARTS)


@given(durations=st.lists(st.integers(min_value=-(10**6), max_value=2**63), min_size=1))
def test_many_durations_are_counted_like_one_after_the_other(durations: list[int]) -> None:
    one, many = Latencies(), Latencies()
    for duration in durations:
        one.add(duration)
    many.add_all(durations)
    assert one.told() == many.told()
