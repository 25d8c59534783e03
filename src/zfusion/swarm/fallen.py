"""Nodes that were felled by plan: when they are to be raised again, and with which step those begin that had died."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import inf
from typing import Any

from zfusion.model.types import NodeId
from zfusion.swarm.child import Child
from zfusion.swarm.standstill import is_stopped

TICK_S = 0.1
"""How soon it is looked again where nobody can say when it will be time."""

BLINK_S = 0.002
"""... and whether a process that has said that it stops, or dies, has done so."""


class Fallen:
    """Of a swarm's nodes, those that were felled. They are told apart by `Child.blow`."""

    def __init__(self, nodes: Mapping[NodeId, Child], part_of: Mapping[NodeId, frozenset[NodeId]], paced: bool) -> None:
        """`part_of`: whom each node is connected with, itself included; whether steps have times (`paced`)."""
        self._nodes, self._part_of, self._paced = nodes, part_of, paced

    def due(self, now_ns: int) -> tuple[list[Child], float]:
        """Those that are to be raised now; and the seconds until the next one may have to be."""
        wait, raised = TICK_S, []
        for child in self._nodes.values():
            if child.blow is None or child.blow["until_step"] is None:
                continue
            left = self._left(child, child.blow, now_ns)
            if left > 0:
                wait = min(wait, left)
            elif not _has_fallen(child):
                wait = min(wait, BLINK_S)
            else:
                raised.append(child)
        return raised, wait

    def first_step(self, child: Child, raised: Sequence[Child]) -> int | None:
        """With which step a node that had died is to begin, that is `raised` with others.

        None where the time tells it, or one of those that it is connected with, for that takes steps. If none does they
        all begin with one step.
        """
        assert child.node is not None  # only nodes are felled
        part = self._part_of[child.node]
        standing = [self._nodes[i] for i in part if self._nodes[i].running]
        if self._paced or any(other.status.get("phase") == "running" for other in standing):
            return None
        told = [other.first_step for other in standing if other.first_step is not None]
        return max(told or _returns(other for other in raised if other.node in part))

    def returns(self, last_step: int) -> bool:
        """Whether, with no node running, some will all the same: all that they are connected with have fallen, too."""
        for part in self._part_of.values():
            nodes = [self._nodes[i] for i in part]
            ended = any(child.exit_code == 0 for child in nodes)
            if not ended and min(_returns(nodes), default=inf) <= last_step:
                return True
        return False

    def _left(self, child: Child, blow: Mapping[str, Any], now_ns: int) -> float:
        """Seconds until a felled node is to be raised; where steps have no times, at least until it is looked again."""
        if blow["until_ns"] is not None:
            left: float = (blow["until_ns"] - now_ns) / 1e9
            return left
        others = [other for other in self._nodes.values() if other is not child and other.running]
        if not others:  # nobody takes the steps that it would be away for
            return 0 if blow["kind"] == "stop" or blow["until_step"] == min(_returns(self._nodes.values())) else TICK_S
        return 0 if any(other.status.get("step", 0) >= blow["until_step"] for other in others) else TICK_S


def _returns(nodes: Iterable[Child]) -> list[int]:
    """The steps at which those that were felled by plan are to return."""
    steps = (child.blow["until_step"] for child in nodes if child.blow is not None)
    return [step for step in steps if step is not None]


def _has_fallen(child: Child) -> bool:
    """Whether what it has announced has happened: it is dead; or it stands still, as far as that can be seen."""
    if child.blow is None or child.process is None or child.blow["kind"] == "kill":
        return not child.running
    return is_stopped(child.process.pid) is not False
