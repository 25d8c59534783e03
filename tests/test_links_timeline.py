"""Switching topologies and timelines of faults: which edge, which node, at which step."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
import pytest

from simulations import MS, walk
from zfusion.links import Kill, LinkNetwork, Timeline, Topology
from zfusion.links.timeline import Stop
from zfusion.model.streams import BLOCK
from zfusion.stages import Message

RING = [(10, 20), (20, 30), (30, 40), (40, 50), (50, 10)]
ONE_WAY = {"generator": "ring", "directed": True}


def timeline(*faults: dict[str, Any], **more: Any) -> Timeline:
    """Of the five nodes 10, 20, ... in a ring, 50 steps a second."""
    return Timeline(walk(faults=list(faults), **more))


def topology(**spec: Any) -> Topology:
    return Topology(walk(links={"topology": spec}))


# --- topologies ---


def test_without_modes_every_edge_is_there() -> None:
    still = Topology(walk())
    assert not still.switches
    assert still.mode(1) == 0
    assert still.carries((10, 20), 5)


def test_a_schedule_of_modes() -> None:
    switching = topology(
        modes=[{"generator": "ring"}, ONE_WAY, {"edges": []}],
        schedule=[{"step": 1, "mode": 0}, {"step": 5, "mode": 2}, {"step": 7, "mode": 1}],
    )
    assert [switching.mode(k) for k in (1, 4, 5, 6, 7, 1000)] == [0, 0, 2, 2, 1, 1]
    for sender, receiver in RING:
        assert [switching.carries((sender, receiver), k) for k in (4, 5, 7)] == [True, False, True]
        assert [switching.carries((receiver, sender), k) for k in (4, 5, 7)] == [True, False, False]


def test_edges_that_are_not_the_networks_are_not_switched() -> None:
    """A method may have another graph: the centralised bound hears everybody."""
    assert topology(modes=[{"edges": []}], schedule=[{"step": 1, "mode": 0}]).carries((10, 30), 1)


def test_a_chain_of_modes_is_as_often_in_each_as_it_should_be() -> None:
    markov = {"transition": [[0.9, 0.1], [0.3, 0.7]], "initial": [1, 0]}
    chained = topology(modes=[{"generator": "ring"}, ONE_WAY], markov=markov)
    modes = np.array([chained.mode(k) for k in range(1, 20_001)])
    assert modes[0] == 0
    memory = 0.6
    assert abs(modes.mean() - 0.25) < 6 * sqrt(0.25 * 0.75 * (1 + memory) / (1 - memory) / len(modes)) + 1 / len(modes)
    leaves = modes[1:][modes[:-1] == 0].mean()
    assert abs(leaves - 0.1) < 6 * sqrt(0.09 / (modes == 0).sum())


def test_all_edges_see_the_same_mode_in_whatever_order_they_ask() -> None:
    markov = {"transition": [[0.5, 0.5], [0.5, 0.5]], "initial": [0.5, 0.5]}
    spec = {"modes": [{"generator": "ring"}, ONE_WAY], "markov": markov}
    links = LinkNetwork(walk(links={"topology": spec}))
    chained = topology(**spec)
    for step in (700, 3, BLOCK, BLOCK - 1, 1):
        for sender, receiver in RING:
            back = Message(receiver, step, "measurement", 0, 1, 0, {})
            assert bool(links((receiver, sender), back, 0)) == (chained.mode(step) == 0)
            assert links((sender, receiver), back._replace(node=sender), 0)


# --- faults ---


def test_deaths_and_what_comes_after() -> None:
    faults = [
        {"kind": "kill", "node": 20, "step": 30},
        {"kind": "kill", "node": 20, "step": 5, "restart_after": 3},
        {"kind": "kill", "node": 10, "at_s": 0.21, "restart_after": 1},
    ]
    told = timeline(*faults)
    assert told.kills(20) == (Kill(5, 8), Kill(30, None))
    assert told.kills(10) == (Kill(11, 12),)  # due at 0.22 s
    assert told.kills(30) == ()
    assert [told.dead(20, k) for k in (4, 5, 7, 8, 29, 30, 1000)] == [False, True, True, False, False, True, True]
    assert [told.told_before(20, born) for born in (1, 5, 8, 31)] == [0, 0, 5, 30]


def test_when_a_fault_in_seconds_is() -> None:
    """50 steps a second: step k is due at 20 k ms."""
    told = timeline(
        {"kind": "stop", "node": 10, "at_s": 0.1, "for_s": 0.1},
        {"kind": "stop", "node": 20, "at_s": 0.11, "for_s": 0.001},
        {"kind": "stop", "node": 30, "step": 5, "for_s": 0.05},
        {"kind": "stop", "node": 40, "at_s": 0.0, "steps": 2},
    )
    stops = [told.stops(node) for node in (10, 20, 30, 40, 50)]
    assert stops == [(Stop(5, 10),), (Stop(6, 7),), (Stop(5, 8),), (Stop(1, 3),), ()]


def test_slowness_and_clock_errors_add_up() -> None:
    told = timeline(
        {"kind": "slow", "node": 10, "step": 2, "steps": 4, "delay_s": 0.01},
        {"kind": "slow", "node": 10, "step": 4, "delay_s": 0.005},
        {"kind": "clock", "node": 20, "step": 3, "offset_s": -0.5},
        {"kind": "clock", "node": 20, "step": 5, "steps": 1, "offset_s": 0.1},
    )
    assert [told.slow_ns(10, k) // MS for k in (1, 2, 4, 6, 99)] == [0, 10, 15, 5, 5]
    assert [told.clock_ns(20, k) // MS for k in (2, 3, 5, 6)] == [0, -500, -400, -500]
    assert told.slow_ns(20, 4) == told.clock_ns(10, 4) == 0


def test_cuts_and_partitions() -> None:
    told = timeline(
        {"kind": "cut", "from": [10, 20], "to": 30, "step": 2, "steps": 1},
        {"kind": "partition", "groups": [[10, 20], [30]], "step": 5},
    )
    assert [told.cut((20, 30), k) for k in (1, 2, 3, 5)] == [False, True, False, True]
    assert not told.cut((30, 20), 2)
    parted = {(a, b) for a, b in [*RING, *((b, a) for a, b in RING)] if told.cut((a, b), 9)}
    assert parted == {(20, 30), (30, 20), (30, 40), (40, 30), (50, 10), (10, 50)}  # 40 and 50: a group of their own


def test_what_is_told_and_by_whom() -> None:
    cut = {"kind": "cut", "from": 20, "to": 30, "step": 2, "steps": 2}
    kill = {"kind": "kill", "node": 10, "step": 4, "restart_after": 2}
    slow = {"kind": "slow", "node": 30, "step": 4, "delay_s": 0.01}
    told = timeline(cut, kill, slow)
    assert told.events(30, 2) == [{"fault": cut, "phase": "begins", "step": 2}]
    assert told.events(20, 2) == []  # told by the receiver
    assert told.events(30, 4) == [
        {"fault": cut, "phase": "ends", "step": 4},
        {"fault": slow, "phase": "begins", "step": 4},
    ]
    assert [event["step"] for event in told.events(30, 9, since=1)] == [2, 4, 4]
    assert [event["phase"] for event in told.events(10, 6, since=5)] == ["ends"]
    assert told.events(30, 9, since=5) == []


def test_faults_that_nobody_will_see_are_told() -> None:
    told = timeline({"kind": "cut", "from": 20, "step": 30}, {"kind": "slow", "node": 10, "step": 31, "delay_s": 1.0})
    assert told.beyond(30) == [1]
    assert bool(told)
    assert not timeline()


@pytest.mark.parametrize("free_run", [False, True])
def test_steps_need_no_times(free_run: bool) -> None:
    timing = {"free_run": True} if free_run else {"rate_hz": 7.0}
    told = timeline({"kind": "kill", "node": 10, "step": 4, "restart_after": 2}, timing=timing)
    assert told.kills(10) == (Kill(4, 6),)
