"""Meeting: nodes that talk only to their neighbours begin together, whoever comes first."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zfusion.drivers.meeting import JOIN_NS, LEAD_NS, POLL_NS, Meeting, Start, connected, hops_from_smallest
from zfusion.errors import InputError
from zfusion.status import Phase, Status

PERIOD = 10_000_000
NOW = 1_790_000_000_000_000_000
Link = tuple[int, int]


@dataclass
class Peer:
    """A node that is about to begin, as its neighbours see it."""

    meeting: Meeting
    start: Start | None = None
    step: int = 0

    def status(self) -> Status:
        meeting = self.meeting
        version, wire, fingerprint = meeting.identity
        return Status(
            node=meeting.own,
            fingerprint=fingerprint,
            phase=Phase.JOINING if self.start is None else Phase.RUNNING,
            step=self.step,
            born=self.start.born if self.start else 0,
            epoch_ns=meeting.epoch_ns,
            ready=dict(meeting.ready),
            zfusion=version,
            wire=wire,
        )


@dataclass
class Town:
    """Nodes on links, and a clock."""

    links: Collection[Link]
    ids: Collection[int]
    period: int | None = None
    recorder: bool = False
    epoch: int | None = None
    fingerprint: str = "f" * 64
    now: int = NOW
    peers: dict[int, Peer] = field(default_factory=dict)
    lives: int = 0

    def add(self, node: int, *, fingerprint: str | None = None, version: str = "1.0", first_step: int = 1) -> Peer:
        """A node's process starts, and is linked with those that are there."""
        self.lives += 1
        swarm = connected(node, self.links)
        linked = {b if a == node else a for a, b in self.links if node in (a, b)}
        peer = self.peers[node] = Peer(
            Meeting(
                own=node,
                identity=(version, 1, fingerprint or self.fingerprint),
                started_ns=NOW + self.lives,
                hears=frozenset(linked),
                linked=frozenset(linked),
                swarm=swarm,
                hops=hops_from_smallest(swarm, self.links),
                needs_recorder=self.recorder,
                period_ns=self.period,
                epoch_ns=self.epoch,
                fixed_epoch=self.epoch is not None,
                first_step=first_step,
            )
        )
        for other in linked & self.peers.keys():
            peer.meeting.came(other)
            self.peers[other].meeting.came(node)
        return peer

    def remove(self, node: int) -> None:
        """It dies."""
        del self.peers[node]
        for peer in self.peers.values():
            if node in peer.meeting.linked:
                peer.meeting.went(node)

    def poll(self, node: int) -> Start | None:
        """One turn of a node that waits: it asks all that it sees, and looks whether it can begin."""
        peer = self.peers[node]
        if peer.start is None:
            for other in sorted(peer.meeting.present):
                peer.meeting.answered(self.peers[other].status())
            peer.start = peer.meeting.start(self.now)
        return peer.start

    def poll_all(self, rounds: int = 1) -> None:
        """Everybody asks; those with large ids first, so that news from those with small ones goes one link a round."""
        for _ in range(rounds):
            self.now += POLL_NS
            for node in sorted(self.peers, reverse=True):
                self.poll(node)

    def begin_all(self) -> None:
        for node in self.ids:
            self.add(node)
        self.poll_all(2 * len(self.ids) + 2)
        assert all(peer.start for peer in self.peers.values())


def line(*ids: int) -> tuple[Link, ...]:
    return tuple(pairwise(ids))


def test_a_free_running_pair_begins_at_once_when_each_knows_that_the_other_is_ready() -> None:
    town = Town(line(1, 2), (1, 2))
    town.add(1)
    assert town.poll(1) is None
    assert town.peers[1].meeting.missing() == ["node 2"]
    town.add(2)
    assert town.poll(2) is None
    assert town.peers[2].meeting.missing() == ["node 1 to be ready"]
    assert town.poll(1) == Start(1, town.now, frozenset({2}))
    assert town.poll(2) == Start(1, town.now, frozenset({1}))


def test_a_paced_swarm_learns_of_the_epoch_before_its_first_step() -> None:
    town = Town(line(1, 2, 3, 4, 5), (1, 2, 3, 4, 5), period=PERIOD)
    town.begin_all()
    starts = [peer.start for peer in town.peers.values()]
    epochs = {start.epoch_ns for start in starts if start}
    assert len(epochs) == 1
    assert epochs.pop() + PERIOD >= town.now - 6 * POLL_NS  # not past when the last of them learned of it
    assert all(start is not None and start.born == 1 for start in starts)


def test_the_lead_covers_the_way_of_the_epoch_from_one_end_to_the_other() -> None:
    ids = tuple(range(1, 9))
    town = Town(line(*ids), ids, period=PERIOD)
    for node in ids:
        town.add(node)
    while town.peers[1].meeting.epoch_ns is None:
        town.poll_all()
    first_step = town.peers[1].meeting.epoch_ns + PERIOD
    rounds = 0
    while any(peer.start is None for peer in town.peers.values()):
        rounds += 1
        town.poll_all()
        assert town.now < first_step
    assert rounds == len(ids) - 1
    assert first_step - NOW < LEAD_NS + 4 * len(ids) * POLL_NS


def test_whoever_learns_late_begins_with_the_first_step_all_the_same() -> None:
    town = Town(line(1, 2, 3), (1, 2, 3))
    for node in (1, 2, 3):
        town.add(node)
    for node in (3, 2, 1, 2, 1):  # 3 is not polled again until the others have long been running
        town.poll(node)
    for node in (1, 2):
        assert town.peers[node].start is not None
        town.peers[node].step = 50
    town.now += 10**9
    start = town.poll(3)
    assert start is not None
    assert (start.born, start.epoch_ns) == (1, town.peers[1].meeting.epoch_ns)


@pytest.mark.parametrize("period", [None, PERIOD])
def test_a_new_life_joins_those_that_run(period: int | None) -> None:
    town = Town(line(1, 2, 3), (1, 2, 3), period=period)
    town.begin_all()
    epoch = town.peers[1].meeting.epoch_ns
    assert epoch is not None
    town.remove(2)
    town.now = epoch + 100 * PERIOD
    town.peers[1].step, town.peers[3].step = 100, 99
    town.add(2)
    assert town.poll(2) == Start(101, epoch, frozenset({1, 3}))


def test_a_new_life_waits_for_an_answer_of_all_that_it_sees() -> None:
    town = Town(line(1, 2, 3), (1, 2, 3))
    town.begin_all()
    town.remove(2)
    two = town.add(2).meeting
    two.answered(town.peers[1].status())
    assert two.start(town.now) is None
    two.answered(town.peers[3].status())
    assert two.start(town.now) is not None


def test_a_new_life_does_not_wait_for_neighbours_that_are_away() -> None:
    town = Town(line(1, 2, 3), (1, 2, 3))
    town.begin_all()
    town.remove(2)
    town.remove(3)
    town.peers[1].step = 7
    town.add(2)
    assert town.poll(2) is None
    town.now += JOIN_NS
    assert town.poll(2) == Start(8, town.peers[1].meeting.epoch_ns or 0, frozenset({1}))


def test_nobody_begins_without_the_recorder() -> None:
    town = Town(line(1, 2), (1, 2), recorder=True)
    for node in (1, 2):
        town.add(node)
    town.poll_all(5)
    assert not any(peer.start for peer in town.peers.values())
    assert town.peers[1].meeting.missing() == ["the recorder"]
    town.peers[1].meeting.recorder = True
    town.poll_all(5)
    assert not any(peer.start for peer in town.peers.values())  # 2 has no link with the recorder yet
    town.peers[2].meeting.recorder = True
    town.poll_all(5)
    assert all(peer.start for peer in town.peers.values())


def test_those_that_were_told_with_which_step_begin_together() -> None:
    town = Town(line(1, 2), (1, 2))
    for node in (1, 2):
        town.add(node, first_step=90)
    town.poll_all(2)
    assert {peer.start.born for peer in town.peers.values() if peer.start} == {90}
    assert {peer.start.expected for peer in town.peers.values() if peer.start} == {frozenset({1}), frozenset({2})}


def test_those_that_were_told_with_which_step_do_not_wait_for_who_does_not_come() -> None:
    town = Town(line(1, 2, 3), (1, 2, 3))
    for node in (1, 2):
        town.add(node, first_step=90)
    town.poll_all(4)
    assert not any(peer.start for peer in town.peers.values())
    town.now += JOIN_NS
    assert town.poll(1) == Start(90, town.now, frozenset({2}))
    town.peers[1].step = 95
    assert town.poll(2) == Start(96, town.now, frozenset({1}))


def test_parts_that_are_not_connected_begin_by_themselves() -> None:
    links = (*line(1, 2), *line(3, 4))
    town = Town(links, (1, 2, 3, 4, 5))
    for node in (1, 2, 5):
        town.add(node)
    town.poll_all(4)
    assert town.peers[1].start is not None
    assert town.peers[5].start is not None  # alone
    town.add(3)
    town.poll_all(4)
    assert town.peers[3].start is None


def test_a_given_epoch_is_kept_to() -> None:
    town = Town(line(1, 2), (1, 2), period=PERIOD, epoch=NOW + 10**9)
    town.begin_all()
    assert {peer.start for peer in town.peers.values()} == {
        Start(1, NOW + 10**9, frozenset({2})),
        Start(1, NOW + 10**9, frozenset({1})),
    }


def test_a_given_epoch_is_kept_to_whoever_is_there() -> None:
    epoch = NOW + 10**9
    town = Town(line(1, 2, 3), (1, 2, 3), period=PERIOD, epoch=epoch)
    town.add(1)
    town.add(2)
    town.poll_all(4)
    assert town.peers[1].start is None
    town.now = epoch + 5 * PERIOD + 1
    assert town.poll(1) == Start(6, epoch, frozenset({2}))
    town.add(3)
    assert town.poll(3) == Start(6, epoch, frozenset({2}))
    assert town.poll(2) == Start(6, epoch, frozenset({1, 3}))


def test_a_given_epoch_that_is_over_is_no_reason_to_skip_steps() -> None:
    town = Town(line(1, 2), (1, 2), period=PERIOD, epoch=NOW - 1000 * PERIOD)
    for node in (1, 2):
        town.add(node)
    start = town.poll(1)
    assert start is not None
    assert start.born == 1001


def test_clocks_are_not_judged_before_all_have_answered_who_are_to_be_waited_for() -> None:
    """One that has not may be on the same machine, and its time line the one that counts."""
    town = Town(line(1, 2, 3), (1, 2, 3), period=PERIOD)
    town.begin_all()
    town.remove(2)
    meeting = town.add(2).meeting
    statuses = {node: town.peers[node].status() for node in (1, 3)}
    meeting.went(1)  # that is: it has not been seen yet
    meeting.answered(statuses[3])
    assert meeting.agrees_with(town.now) == frozenset()
    assert meeting.agrees_with(town.now, begins=True) == {3}
    assert meeting.agrees_with(town.now + JOIN_NS) == {3}  # nobody else is there
    meeting.came(1)
    assert meeting.agrees_with(town.now + JOIN_NS) == frozenset()
    meeting.answered(statuses[1])
    assert meeting.agrees_with(town.now) == {1, 3}


def test_another_scenario_is_refused_and_both_are_named() -> None:
    town = Town(line(1, 2), (1, 2))
    town.add(1)
    town.add(2, fingerprint="0" * 64)
    with pytest.raises(InputError, match=r"node 2 runs scenario 000000000000 .*node 1, here, runs scenario ffffffff"):
        town.poll(1)
    with pytest.raises(InputError, match=r"node 1 runs scenario ffffffffffff .*node 2, here, runs scenario 00000000"):
        town.poll(2)


def test_another_version_is_refused_and_both_are_named() -> None:
    town = Town(line(1, 2), (1, 2))
    town.add(1)
    town.add(2, version="0.9")
    with pytest.raises(InputError, match=r"on zfusion 0\.9.*on zfusion 1\.0"):
        town.poll(1)


def test_what_is_said_of_strangers_is_not_believed() -> None:
    town = Town(line(1, 2), (1, 2))
    meeting = town.add(1).meeting
    town.add(2)
    said = town.peers[2].status()
    meeting.answered(Status(**{**{name: getattr(said, name) for name in said.__slots__}, "ready": {1: 5, 77: 9}}))
    assert meeting.ready == {}


def test_hops() -> None:
    links = ((1, 2), (2, 3), (3, 1), (3, 4), (7, 8))
    assert connected(4, links) == {1, 2, 3, 4}
    assert connected(9, links) == {9}
    assert hops_from_smallest({1, 2, 3, 4}, links) == 2
    assert hops_from_smallest({7, 8}, links) == 1
    assert hops_from_smallest({9}, links) == 0


@st.composite
def graphs(draw: st.DrawFn) -> tuple[tuple[int, ...], tuple[Link, ...]]:
    """A connected graph."""
    ids = tuple(draw(st.lists(st.integers(0, 99), min_size=1, max_size=9, unique=True)))
    tree = [(ids[draw(st.integers(0, n - 1))], ids[n]) for n in range(1, len(ids))]
    extra = draw(st.lists(st.sampled_from([(a, b) for a in ids for b in ids if a < b] or [(0, 0)]), max_size=6))
    return ids, tuple({(min(a, b), max(a, b)) for a, b in (*tree, *extra) if a != b})


@given(graph=graphs(), seed=st.integers(0, 2**32), paced=st.booleans())
def test_any_graph_in_any_order_agrees_on_one_epoch_and_begins_with_step_one(
    graph: tuple[tuple[int, ...], tuple[Link, ...]], seed: int, paced: bool
) -> None:
    ids, links = graph
    random = Random(seed)
    town = Town(links, ids, period=PERIOD if paced else None)
    waiting = list(ids)
    for _ in range(100 * len(ids) * len(ids)):
        town.now += random.randrange(POLL_NS)
        if waiting and random.random() < 0.2:
            town.add(waiting.pop(random.randrange(len(waiting))))
        elif town.peers:
            peer = town.peers[random.choice(sorted(town.peers))]
            town.poll(peer.meeting.own)
            peer.step += peer.start is not None  # those who have begun go on meanwhile
        if len(town.peers) == len(ids) and all(peer.start for peer in town.peers.values()):
            break
    starts = {node: peer.start for node, peer in town.peers.items()}
    assert all(starts.values())
    assert {start.born for start in starts.values() if start} == {1}
    assert len({start.epoch_ns for start in starts.values() if start}) == 1
    assert all(start.expected == town.peers[node].meeting.linked for node, start in starts.items() if start)


@given(graph=graphs(), seed=st.integers(0, 2**32))
def test_whoever_dies_joins_again(graph: tuple[tuple[int, ...], tuple[Link, ...]], seed: int) -> None:
    ids, links = graph
    random = Random(seed)
    town = Town(links, ids)
    town.begin_all()
    for _ in range(10):
        for peer in town.peers.values():
            peer.step += random.randrange(3)
        node = random.choice(ids)
        town.remove(node)
        town.add(node)
        start = town.poll(node)
        assert start is not None
        near = town.peers[node].meeting.linked
        assert start.born == max((town.peers[j].step for j in near), default=0) + 1
        assert start.expected == near
        town.peers[node].step = start.born
