"""Who of those that were felled by plan is raised when, and with which step they begin."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from zfusion.swarm.child import Child
from zfusion.swarm.fallen import BLINK_S, TICK_S, Fallen

NOW = 10**18


def child(node: int) -> Child:
    return Child(f"node {node}", node, [], Path("log"))


def run(child: Child, step: int) -> Child:
    """It takes steps; its process is this one, which does not stand still."""
    child.process = cast(Any, SimpleNamespace(pid=os.getpid()))
    child.exit_code, child.status = None, {"phase": "running" if step else "joining", "step": step}
    return child


def fell(child: Child, until_step: int | None, until_ns: int | None = None, kind: str = "kill") -> Child:
    """It has announced its fall; if it was to die, it has."""
    run(child, 29)
    child.blow = {"kind": kind, "step": 30, "until_step": until_step, "until_ns": until_ns}
    if kind == "kill":
        child.exit_code = -9
    return child


def swarm(*parts: tuple[int, ...], paced: bool = False) -> tuple[dict[Any, Child], Fallen]:
    nodes: dict[Any, Child] = {node: child(node) for part in parts for node in part}
    return nodes, Fallen(nodes, {node: frozenset(part) for part in parts for node in part}, paced)


def names(children: list[Child]) -> list[object]:
    return [child.node for child in children]


def test_with_times_each_has_its_own() -> None:
    nodes, fallen = swarm((1, 2, 3), paced=True)
    run(nodes[1], 60)
    fell(nodes[2], 90, NOW + 20_000_000)
    fell(nodes[3], None)
    assert fallen.due(NOW) == ([], pytest.approx(0.02))
    raised, wait = fallen.due(NOW + 20_000_000)
    assert (names(raised), wait) == ([2], TICK_S)
    assert fallen.first_step(nodes[2], raised) is None


def test_one_returns_when_the_others_have_come_to_its_step_and_tell_it() -> None:
    nodes, fallen = swarm((1, 2))
    run(nodes[1], 89)
    fell(nodes[2], 90)
    assert fallen.due(NOW) == ([], TICK_S)
    run(nodes[1], 93)
    raised, _ = fallen.due(NOW)
    assert names(raised) == [2]
    assert fallen.first_step(nodes[2], raised) is None


def test_who_is_alone_is_told_its_own_step() -> None:
    nodes, fallen = swarm((1,), (2,))
    run(nodes[1], 93)
    fell(nodes[2], 90)
    raised, _ = fallen.due(NOW)
    assert fallen.first_step(nodes[2], raised) == 90


def test_where_all_have_fallen_the_first_return_and_the_rest_wait_for_them() -> None:
    nodes, fallen = swarm((1, 2, 3, 4))
    for node, until in {1: 90, 2: 90, 3: 120, 4: None}.items():
        fell(nodes[node], until)
    raised, _ = fallen.due(NOW)
    assert names(raised) == [1, 2]
    assert [fallen.first_step(one, raised) for one in raised] == [90, 90]
    for one in raised:
        run(one, 0).blow = None
    assert fallen.due(NOW) == ([], TICK_S)
    for one in raised:
        run(one, 120)
    assert names(fallen.due(NOW)[0]) == [3]
    assert fallen.first_step(nodes[3], fallen.due(NOW)[0]) is None


def test_a_part_begins_with_one_step_whenever_its_nodes_are_raised() -> None:
    nodes, fallen = swarm((1, 2), (3,))
    run(nodes[3], 95)
    fell(nodes[1], 90)
    fell(nodes[2], 100)
    raised, _ = fallen.due(NOW)
    assert names(raised) == [1]
    assert fallen.first_step(nodes[1], raised) == 90
    run(nodes[1], 0).blow = None
    nodes[1].first_step = 90
    run(nodes[3], 100)
    raised, _ = fallen.due(NOW)
    assert (names(raised), fallen.first_step(nodes[2], raised)) == ([2], 90)

    fell(nodes[1], 90)
    fell(nodes[2], 100)
    raised, _ = fallen.due(NOW)
    assert [fallen.first_step(one, raised) for one in raised] == [100, 100]


@pytest.mark.parametrize("kind", ["kill", "stop"])
def test_who_has_not_fallen_yet_is_not_raised(kind: str) -> None:
    nodes, fallen = swarm((1,))
    run(fell(nodes[1], 90, kind=kind), 29)
    assert fallen.due(NOW) == ([], BLINK_S)


def test_a_swarm_that_lies_on_the_ground_is_over_unless_some_return_in_time() -> None:
    nodes, fallen = swarm((1, 2), (3,))
    fell(nodes[1], 90)
    fell(nodes[2], None)
    nodes[3].exit_code = 0
    assert fallen.returns(90)
    assert not fallen.returns(89)
    nodes[2].exit_code = 0  # it has come to the end: who returns finds nobody
    assert not fallen.returns(90)
