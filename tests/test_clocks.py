"""How far another clock is ahead, found out by asking."""

from __future__ import annotations

import time

from hypothesis import given
from hypothesis import strategies as st

from zfusion.drivers.clocks import READINGS, Clock, ClockOffset, WrongClock, machine

TRIP = st.integers(min_value=0, max_value=10**9)


@given(
    ahead=st.integers(min_value=-(10**12), max_value=10**12),
    trips=st.lists(st.tuples(TRIP, TRIP, TRIP), min_size=1, max_size=2 * READINGS),
)
def test_the_offset_is_right_to_within_its_uncertainty(ahead: int, trips: list[tuple[int, int, int]]) -> None:
    offset, now = ClockOffset(), 10**15
    for there, thought, back in trips:
        heard = now + there
        told = heard + thought
        offset.read(now, heard + ahead, told + ahead, told + back)
        now = told + back
    found = offset.told()
    assert abs(found["offset_us"] - ahead / 1000) <= found["uncertainty_us"] + 0.001
    quickest = min(there + back for there, _, back in trips[-READINGS:])
    assert found["uncertainty_us"] == (quickest + 1) // 2 / 1000


def test_a_clock_that_was_set_is_read_anew() -> None:
    offset, second = ClockOffset(), 10**9
    for n in range(3):
        offset.read(n * second, n * second + 100, n * second + 100, n * second + 200)
    assert offset.told() == {"offset_us": 0.0, "uncertainty_us": 0.1}
    now, ahead = 5 * second, 20_000_000
    offset.read(now, now + 5000 + ahead, now + 5000 + ahead, now + 9000)  # slower, and 20 ms ahead
    assert offset.told() == {"offset_us": 20_000.5, "uncertainty_us": 4.5}


def test_answers_that_cannot_be_are_not_counted() -> None:
    offset = ClockOffset()
    offset.read(1000, 500, 400, 2000)  # told before it was heard
    offset.read(1000, 0, 5000, 2000)  # took longer there than here
    assert offset.told() == {}
    assert not offset.known


def test_one_machine_has_one_clock() -> None:
    offset = ClockOffset(same_machine=True)
    offset.read(0, 10**9, 10**9, 10)
    assert offset.told() == {"offset_us": 0.0, "uncertainty_us": 0.0}
    assert machine() == machine()


def test_a_clock_can_be_wrong() -> None:
    right, wrong = Clock(), WrongClock()
    wrong.set_ahead(3600 * 10**9)
    assert abs(right.now() - time.time_ns()) < 10**9
    assert abs(wrong.now() - time.time_ns() - 3600 * 10**9) < 10**9
    wrong.set_ahead(0)
    assert abs(wrong.now() - time.time_ns()) < 10**9
