"""Hearing through emulated links: what is there when, and what is late, whenever the node looks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from simulations import walk
from zfusion.drivers.account import make_node
from zfusion.drivers.hearing import FAR, EmulatedHearing, Heard
from zfusion.drivers.inbox import Posted
from zfusion.links import Edge, Timeline
from zfusion.messages import Decoder, encode
from zfusion.methods import METHODS
from zfusion.node import Node
from zfusion.stages import MEASUREMENT, Message

MS = 1_000_000
EPOCH = 1_000_000_000 * MS


class Time:
    """A clock that stands where it is put."""

    def __init__(self) -> None:
        self.ahead_ns = 0
        self.ns = EPOCH

    def now(self) -> int:
        return self.ns


class Inbox:
    """What has come."""

    def __init__(self) -> None:
        self.posted = Posted()
        self.overrun = 0
        self.rests: list[int] = []

    def subscribe_posted(self, source: Any, key: str) -> None: ...

    def rest(self, until_ns: int, *, or_posted: bool = False) -> bool:
        assert or_posted
        self.rests.append(until_ns)
        return True


class Driver:
    """Feeds a node of the example and notes what became of that."""

    def __init__(self, delays: dict[int, Sequence[int]], **changes: Any) -> None:
        scenario = walk(timing={"rate_hz": 20.0, "deadlines": {"measurement": 0.4, "intermediate": 0.8}}, **changes)
        graph = METHODS[scenario.method.name].network(scenario.network)
        self.own = graph.ids[0]
        self.senders = [j for j in graph.neighbours(self.own) if j != self.own]
        self.node: Node | None = make_node(scenario, graph, self.own)
        self.time, self.inbox, self.delays = Time(), Inbox(), delays
        self.heard: list[Heard] = []
        self.hearing = EmulatedHearing(self.inbox, self, self.own, self, Timeline(scenario), self.time)  # type: ignore[arg-type]
        for j in self.senders:
            ny = scenario.system().by_id[j].ny
            self.hearing.subscribe((j, MEASUREMENT.name), "key", Decoder(MEASUREMENT, j, sizes={"ny": ny}))
        self.y = {j: np.zeros(scenario.system().by_id[j].ny) for j in graph.ids}
        self.start = EPOCH + 50 * MS

    def __call__(self, edge: Edge, message: Message, sent_ns: int, /) -> Sequence[int]:
        assert edge == (message.node, self.own)
        return [sent_ns + delay for delay in self.delays[message.node]]

    def hear(self, heard: Heard) -> None:
        assert self.node is not None
        self.heard.append(heard)
        now = self.time.ns if self.node.deadline is None else min(self.time.ns, self.node.deadline - 1)
        self.node.receive(heard.message, now)

    def let_close(self, now_ns: int) -> None:
        assert self.node is not None
        assert self.node.deadline is not None
        assert now_ns >= self.node.deadline
        self.node.tick(self.node.deadline)

    def begin(self) -> None:
        assert self.node is not None
        self.time.ns = self.start
        self.node.begin(1, self.y[self.own], self.start, self.start)

    def post(self, sender: int, sent_ns: int, *, received_ns: int | None = None, seq: int = 0, step: int = 1) -> None:
        message = Message(sender, step, MEASUREMENT.name, seq, 1, sent_ns, {"y": self.y[sender]})
        data = encode(message)
        self.inbox.posted.add((sender, MEASUREMENT.name), data, received_ns or sent_ns)

    def look(self, at_ns: int) -> None:
        self.time.ns = at_ns
        self.hearing.drain()

    def used(self, sender: int) -> int:
        assert self.node is not None
        return self.node.counters[sender].received[MEASUREMENT.name]

    def late(self, sender: int) -> int:
        assert self.node is not None
        return self.node.counters[sender].late[MEASUREMENT.name]


@pytest.fixture
def driver() -> Driver:
    made = Driver({})
    made.delays = {j: [5 * MS] for j in made.senders}
    made.begin()
    return made


def test_a_message_is_there_when_its_link_lets_go_of_it(driver: Driver) -> None:
    sender = driver.senders[0]
    driver.post(sender, driver.start, received_ns=driver.start + MS)
    driver.look(driver.start + 4 * MS)
    assert driver.heard == []
    assert driver.hearing.held(sender) != []
    driver.hearing.rest(driver.start + 10 * MS)
    assert driver.inbox.rests == [driver.start + 5 * MS]
    driver.look(driver.start + 5 * MS)
    [heard] = driver.heard
    assert (heard.received_ns, heard.due_ns, heard.looked_ns) == (
        driver.start + MS, driver.start + 5 * MS, driver.start + 5 * MS
    )  # fmt: skip
    assert driver.used(sender) == 1
    assert driver.hearing.held(sender) == []


def test_what_was_due_by_a_time_is_told_from_what_is_due_by_now(driver: Driver) -> None:
    first, second = driver.senders[:2]
    driver.delays |= {first: [5 * MS], second: [6 * MS]}
    driver.post(first, driver.start)
    driver.post(second, driver.start)
    driver.time.ns = driver.start + 9 * MS
    driver.hearing.drain(until_ns=driver.start + 5 * MS)
    assert [heard.message.node for heard in driver.heard] == [first]
    driver.hearing.drain()
    assert [heard.message.node for heard in driver.heard] == [first, second]


def test_one_that_comes_later_than_that_is_there_when_it_comes(driver: Driver) -> None:
    sender = driver.senders[0]
    driver.post(sender, driver.start, received_ns=driver.start + 9 * MS)
    driver.look(driver.start + 9 * MS)
    assert [heard.due_ns for heard in driver.heard] == [driver.start + 9 * MS]


def test_what_is_lost_is_not_heard_and_what_is_doubled_is_heard_twice(driver: Driver) -> None:
    lost, doubled = driver.senders[:2]
    driver.delays |= {lost: [], doubled: [2 * MS, 3 * MS]}
    driver.post(lost, driver.start)
    driver.post(doubled, driver.start)
    driver.look(driver.start + 10 * MS)
    assert [heard.message.node for heard in driver.heard] == [doubled, doubled]
    assert driver.node is not None
    assert driver.node.counters[doubled].refused["duplicate"] == 1


@pytest.mark.parametrize("looked_ms", [20, 21, 39, 70])
def test_what_was_due_by_the_deadline_is_in_time_and_what_was_not_is_late_however_late_it_is_looked_at(
    driver: Driver, looked_ms: int
) -> None:
    on_time, late = driver.senders[:2]
    driver.delays |= {on_time: [20 * MS], late: [20 * MS + 1]}
    driver.post(late, driver.start)
    driver.post(on_time, driver.start)
    driver.look(driver.start + looked_ms * MS)
    assert (driver.used(on_time), driver.late(on_time)) == (1, 0)
    assert (driver.used(late), driver.late(late)) == (0, int(looked_ms > 20))


def test_delays_count_from_when_a_message_was_sent_whatever_its_senders_clock_said() -> None:
    driver = Driver({}, faults=[{"kind": "clock", "node": 20, "step": 1, "offset_s": 3600.0}])
    driver.delays = {j: [5 * MS] for j in driver.senders}
    driver.begin()
    driver.time.ahead_ns = 7 * MS  # this node's own clock is wrong, too
    driver.post(20, driver.start + 3600 * 10**9, received_ns=driver.start + 7 * MS)
    driver.look(driver.start + 20 * MS)
    assert [heard.due_ns for heard in driver.heard] == [driver.start + 12 * MS]


def test_in_the_end_all_is_heard_that_has_come(driver: Driver) -> None:
    sender = driver.senders[0]
    driver.post(sender, driver.start)
    driver.time.ns = driver.start + MS
    driver.hearing.end()
    assert driver.used(sender) == 1
    assert driver.hearing.held(sender) == []


def test_what_is_no_message_is_counted(driver: Driver) -> None:
    sender = driver.senders[0]
    driver.inbox.posted.add((sender, MEASUREMENT.name), b"nonsense", driver.start)
    driver.look(driver.start + MS)
    assert driver.node is not None
    assert sum(driver.node.counters[sender].refused.values()) == 1


def test_nothing_is_lost_that_comes_before_the_node_begins(driver: Driver) -> None:
    node, driver.node = driver.node, None
    driver.post(driver.senders[0], driver.start)
    driver.look(driver.start + 6 * MS)
    driver.node = node
    driver.look(driver.start + 7 * MS)
    assert driver.used(driver.senders[0]) == 1


def test_no_link_is_asked_about_steps_that_nobody_can_be_at(driver: Driver) -> None:
    """A state that changes from step to step would be followed through all of them: for ever."""
    sender, asked = driver.senders[0], []
    driver.hearing._link = lambda *told: asked.append(told) or ()
    driver.post(sender, driver.start, step=2**53 - 1)
    driver.look(driver.start)
    assert (asked, [heard.message.step for heard in driver.heard]) == ([], [2**53 - 1])
    driver.post(sender, driver.start, step=FAR)
    driver.look(driver.start)
    assert len(asked) == 1
