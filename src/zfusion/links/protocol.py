"""What carries a message from one node to another.

A link is a function of the edge, the message and the time at which it was sent; it returns when the message arrives:
once, never, or more than once. All that can happen to a message on its way is said with that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from zfusion.model.network import Edge
from zfusion.stages import Message

__all__ = ["CUT", "DUPLICATED", "EPOCH_NS", "LOST", "QUEUE_FULL", "Edge", "Link", "ideal"]

EPOCH_NS = 946_684_800_000_000_000
"""When step 0 is in virtual time, where the scenario does not say: the beginning of the year 2000."""


LOST, CUT, QUEUE_FULL, DUPLICATED = "lost", "cut", "queue_full", "duplicated"
"""What links count of messages, beside those that arrive."""


class Link(Protocol):
    """All links of a network."""

    def __call__(self, edge: Edge, message: Message, sent_ns: int, /) -> Sequence[int]:
        """The times, none before `sent_ns`, at which the message arrives; empty if it is lost.

        Called once for every edge and message, on each edge in the order of sending.
        """


def ideal(_edge: Edge, _message: Message, sent_ns: int) -> Sequence[int]:
    """Everything arrives, and at once."""
    return (sent_ns,)
