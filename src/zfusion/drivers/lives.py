"""What is on a recording of each node: its messages, as long as somebody needs them, and its lives."""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable
from enum import Enum

from zfusion.drivers.verdict import EXACT, Comparison, Difference
from zfusion.model.types import NodeId
from zfusion.node import Node
from zfusion.stages import Message
from zfusion.status import HistoryAnswer

Place = tuple[NodeId, str, int]
"""(sender, stage, step)."""


class Doubt(Enum):
    """Why a difference proves nothing."""

    MISSING = "something that should be on the recording is not"
    CUT_OFF = "the recording ends before something that it depends on"


class Shelf:
    """The messages of one node that somebody may still need, by stage and step."""

    def __init__(self, stages: Iterable[str]) -> None:
        self.by_stage: dict[str, dict[int, Message]] = {stage: {} for stage in stages}
        self.disputed: set[tuple[str, int]] = set()
        """(stage, step) of which there are two that differ: of two lives, or because somebody else spoke too."""
        self._second: dict[tuple[str, int, int], Message] = {}
        """By stage, step and life: those of a second life at a step."""

    def put(self, message: Message) -> bool:
        """Keep a message; False if it is there already. Of two of one life the first counts, as it does for nodes."""
        stage, step = message.stage, message.step
        known = self.by_stage[stage].setdefault(step, message)
        if known is message:
            return True
        if known.born == message.born:
            if EXACT.differs(stage, known.fields, message.fields):
                self.disputed.add((stage, step))
            return False
        self.disputed.add((stage, step))
        return self._second.setdefault((stage, step, message.born), message) is message

    def said(self, stage: str, step: int, born: int) -> Message | None:
        """What the node said in the life that began at `born`."""
        message = self.by_stage[stage].get(step)
        return message if message is None or message.born == born else self._second.get((stage, step, born))

    def forget(self, floor: int) -> None:
        """Drop what is of steps up to `floor`."""
        for stage, messages in self.by_stage.items():
            self.by_stage[stage] = {step: message for step, message in messages.items() if step > floor}
        self.disputed = {place for place in self.disputed if place[1] > floor}
        self._second = {place: message for place, message in self._second.items() if place[1] > floor}


class Life:
    """One life of a node: how far it was lived again."""

    def __init__(self, node: NodeId, born: int, tolerance: float | None) -> None:
        self.id, self.born = node, born
        self.node: Node | None = None
        """Made when the first step is lived again."""
        self.steps: list[int] = []
        """Begun, and not lived again yet; ascending."""
        self.done = born - 1
        """The last step that was lived again."""
        self.told: dict[int, list[tuple[NodeId, HistoryAnswer]]] = {}
        """By step: histories that were asked for."""
        self.taken: dict[tuple[int, str], list[tuple[int, tuple[NodeId, ...]]]] = {}
        """By step and stage: of which past steps whose messages came late and were taken in."""
        self.corrections: dict[tuple[int, int], Message] = {}
        """By the step at which they were made, and their own: corrected estimates that were told, not compared yet."""
        self.corrected: dict[tuple[int, int], Message] = {}
        """Likewise: those that came out when their time was lived again, and were not compared yet."""
        self.over = False
        """It was lived again to its end: a message that comes only now comes too late."""
        self.awaits: Place | None = None
        """The input that it waits for."""
        self.counters: dict[str, int] = {}
        """By stage: the number of the next message."""
        self.heard: dict[NodeId, int] = {}
        """The neighbours' lives that it has heard."""
        self.doubt: Doubt | None = None
        self.differences = 0
        """Since its last event: they count only if that which follows shows that no event is missing."""
        self.first: Difference | None = None
        """Of them, that of the lowest step."""
        self.comparison = Comparison(tolerance)

    def begin(self, step: int) -> None:
        """A message of `step` is there."""
        if not self.steps or step > self.steps[-1]:
            self.steps.append(step)
        elif step not in self.steps:
            insort(self.steps, step)
