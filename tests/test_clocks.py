"""How far another clock is ahead, found out by asking."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zfusion.drivers import clocks
from zfusion.drivers.clocks import READINGS, Clock, ClockOffset, machine

MS = 1_000_000
SECOND = 1_000_000_000

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
    assert offset.found is None


def test_one_machine_has_one_clock() -> None:
    offset = ClockOffset(same_machine=True)
    offset.read(0, 10**9, 10**9, 10)
    assert offset.told() == {"offset_us": 0.0, "uncertainty_us": 0.0}
    offset.lines_apart_ns = -3 * SECOND  # one of them began after the clock was set
    assert offset.told() == {"offset_us": -3e6, "uncertainty_us": 0.0}
    assert machine() == machine()


def test_another_boot_and_another_namespace_of_time_are_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "boot_id").write_text("a boot\n")
    (tmp_path / "time").symlink_to("time:[7]")
    machine.cache_clear()
    monkeypatch.setattr(clocks, "BOOT_ID", tmp_path / "boot_id")
    monkeypatch.setattr(clocks, "TIME_NAMESPACE", str(tmp_path / "time"))
    assert machine() == "a boot time:[7]"
    machine.cache_clear()
    monkeypatch.setattr(clocks, "TIME_NAMESPACE", str(tmp_path / "nowhere"))
    assert machine() == "a boot"
    machine.cache_clear()
    monkeypatch.setattr(clocks, "BOOT_ID", tmp_path / "nowhere")
    assert machine() is None
    machine.cache_clear()


class Machine:
    """A machine's clocks: one that can be set and slewed, one that counts all time, one that does so while awake."""

    def __init__(self) -> None:
        self.wall, self.steady, self.awake = 1_790_000_000 * SECOND, 5 * SECOND, 5 * SECOND

    def clock(self) -> Clock:
        return Clock(lambda: self.wall, lambda: self.steady, lambda: self.awake)

    def goes_on(self, ns: int, slewed: float = 0.0) -> None:
        self.wall += round(ns * (1 + slewed))
        self.steady += ns
        self.awake += ns

    def sleeps(self, ns: int) -> None:
        self.wall += ns
        self.steady += ns


def test_the_clock_of_a_node_is_the_machines_and_can_be_made_wrong() -> None:
    clock = Clock()
    assert abs(clock.now() - time.time_ns()) < SECOND
    clock.set_ahead(3600 * SECOND)
    assert abs(clock.now() - time.time_ns() - 3600 * SECOND) < SECOND
    assert clock.of_machine(5) == 5 + 3600 * SECOND
    clock.set_ahead(0)
    assert abs(clock.now() - time.time_ns()) < SECOND
    assert clock.look() is None


@given(jumps=st.lists(st.integers(-(10**15), 10**15).filter(lambda ns: abs(ns) > 10 * MS), max_size=5))
def test_a_line_that_is_kept_goes_on_whatever_becomes_of_the_machines_clock(jumps: list[int]) -> None:
    machine = Machine()
    clock, began, passed = machine.clock(), machine.wall, 0
    clock.keep()
    for by in jumps:
        machine.goes_on(SECOND // 4)
        machine.wall += by
        passed += SECOND // 4
        assert clock.now() == began + passed  # also before anybody has looked
        assert clock.look() == (by, 0)
        assert clock.now() == began + passed
        assert clock.of_machine(machine.wall) == clock.now()
        assert clock.look() is None
    assert clock.jumps == len(jumps)


def test_a_clock_that_is_slewed_is_followed() -> None:
    machine = Machine()
    clock = machine.clock()
    clock.keep()
    for slewed in (5e-4, -5e-4, 2e-5):
        for _ in range(100):
            machine.goes_on(SECOND // 4, slewed)
            assert clock.look() is None
            assert clock.now() == machine.wall
    assert clock.jumps == 0


def test_time_goes_on_while_the_machine_is_suspended_and_that_is_told() -> None:
    machine = Machine()
    clock = machine.clock()
    clock.keep()
    machine.goes_on(SECOND)
    machine.sleeps(60 * SECOND)
    assert clock.now() == machine.wall
    assert clock.look() == (0, 60 * SECOND)
    machine.sleeps(30 * SECOND)
    machine.wall -= 3600 * SECOND
    jump = clock.look()
    assert jump == (-3600 * SECOND, 30 * SECOND)
    assert str(jump) == "it was set by -3600 s, the machine was suspended for 30 s"
    assert clock.jumps == 2


def test_a_line_that_is_not_kept_yet_is_the_machines_clock() -> None:
    machine = Machine()
    clock = machine.clock()
    machine.wall += 3600 * SECOND
    assert clock.look() is None
    assert (clock.now(), clock.jumps) == (machine.wall, 0)


def test_the_line_of_another_process_can_be_joined_after_the_clock_was_set() -> None:
    machine = Machine()
    old = machine.clock()
    old.keep()
    machine.wall -= 7200 * SECOND
    old.look()
    new = machine.clock()
    assert new.now() == old.now() - 7200 * SECOND
    new.join(old.line_ns)
    for _ in range(3):
        assert new.now() == old.now()
        assert new.of_machine(machine.wall) == new.now()
        assert new.on_machine(new.now()) == machine.wall
        machine.goes_on(SECOND, 1e-4)
        assert new.look() is old.look() is None
