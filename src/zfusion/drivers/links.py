"""What carries a message from one node to another in the simulated world.

A link is a function of the edge, the message and the time at which it was sent; it returns when the message arrives:
once, never, or more than once. All that can happen to a message on its way is said with that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from zfusion.errors import InputError
from zfusion.model.streams import Seeds
from zfusion.model.types import NodeId
from zfusion.stages import Message

Edge = tuple[NodeId, NodeId]
"""(sender, receiver)."""

DRAWN_AT_ONCE = 256
"""Random numbers of an edge that are drawn together: a tenth of the cost of one by one."""


class Link(Protocol):
    """All links of a network."""

    def __call__(self, edge: Edge, message: Message, sent_ns: int, /) -> Sequence[int]:
        """The times, none before `sent_ns`, at which the message arrives; empty if it is lost.

        Called once for every edge and message, in the order of sending.
        """


def ideal(_edge: Edge, _message: Message, sent_ns: int) -> Sequence[int]:
    """Everything arrives, and at once."""
    return (sent_ns,)


class Dropping:
    """Loses each message with a probability, independently of all others; what is not lost arrives at once.

    Every edge has random numbers of its own, so that the losses on one do not depend on what is sent on another.
    """

    def __init__(self, probability: float, seed: int) -> None:
        """InputError for a probability that is not in [0, 1]."""
        if not 0.0 <= probability <= 1.0:
            raise InputError(f"probability of loss: expected a number from 0 to 1 (is {probability})")
        self._probability = probability
        self._seeds = Seeds(seed)
        self._drawn: dict[Edge, list[bool]] = {}
        self._generators: dict[Edge, np.random.Generator] = {}

    def __call__(self, edge: Edge, _message: Message, sent_ns: int, /) -> Sequence[int]:
        """See `Link`."""
        drawn = self._drawn.get(edge) or self._draw(edge)
        return () if drawn.pop() else (sent_ns,)

    def _draw(self, edge: Edge) -> list[bool]:
        """The losses of the edge's next messages."""
        if edge not in self._generators:
            self._generators[edge] = self._seeds.generator("link", *map(str, edge))
        lost: list[bool] = (self._generators[edge].random(DRAWN_AT_ONCE) < self._probability).tolist()
        self._drawn[edge] = lost
        return lost
