"""How a live node hears its neighbours: directly, or through the links that its scenario describes.

    Hearing           a message is there when it has come; each waits in a channel of its own until it is wanted
    EmulatedHearing   a message is there when the scenario's link says so, or when it has come if that is later; those
                      that the link loses are dropped

Both decode what comes and give it to the node's driver; what is no message of the neighbour's is counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from heapq import heappop, heappush
from itertools import count
from operator import itemgetter
from typing import NamedTuple, Protocol

from zfusion.drivers.clocks import Clock
from zfusion.drivers.inbox import NEVER, Inbox, Letter
from zfusion.errors import MessageError
from zfusion.links import Link, Timeline
from zfusion.messages import Decoder
from zfusion.model.types import NodeId
from zfusion.node import Node
from zfusion.stages import Message

HELD = 65_536
"""Messages that links hold for one node; beyond it they are dropped, and counted."""

FAR = 65_536
"""Steps ahead of the node from which on no link is asked what becomes of a message: nobody is so far ahead, and a link
whose state changes from step to step would go through all of those in between."""

Channel = tuple[NodeId, str]
"""(neighbour, stage)."""


class Heard(NamedTuple):
    """A neighbour's message that is there for the node."""

    channel: Channel
    data: bytes
    message: Message
    looked_ns: int
    """When the node looked at it."""
    received_ns: int | None
    """When it had come to this machine, where that is known."""
    due_ns: int | None
    """When its link let go of it, where it is emulated."""


class Listener(Protocol):
    """The driver of the node that hears."""

    node: Node | None
    """None until it begins: what comes before is not heard."""

    def hear(self, heard: Heard) -> None:
        """A message is there."""

    def let_close(self, now_ns: int) -> None:
        """A stage's deadline has passed."""


class Hearing:
    """Messages as they come."""

    stamped = True
    """Whether the senders' request for a stamp of receipt is of use."""

    def __init__(self, inbox: Inbox, listener: Listener) -> None:
        self._inbox, self._listener = inbox, listener
        self._decoders: dict[Channel, Decoder] = {}
        self.most_held = 0
        """Messages that links held at the most."""

    def subscribe(self, channel: Channel, key: str, decoder: Decoder) -> None:
        """Hear what is published on `key`."""
        self._decoders[channel] = decoder
        self._inbox.subscribe(channel, key)

    def channels(self, of: NodeId) -> list[Channel]:
        """A neighbour's channels."""
        return [channel for channel in self._decoders if channel[0] == of]

    def rest(self, until_ns: int) -> bool:
        """Sleep until a time; False if there is something to attend to before."""
        return self._inbox.rest(until_ns)

    def wait(self, node: Node, stage: str) -> bool:
        """Wait for the messages of a stage, its deadline or a notice; True if all that were awaited are taken.

        They are taken together when the last is there: to wait and to work in turns costs more than both.
        """
        awaiting, came = node.awaiting, []
        for j in awaiting:
            letter = self._inbox.wait((j, stage), node.deadline)
            if letter is None:
                break
            came.append(((j, stage), letter))
        heard = [self._take(channel, letter) or self._take_next(channel) for channel, letter in came]
        return sum(heard) == len(awaiting)

    def drain(self, of: NodeId | None = None, until_ns: int | None = None) -> None:  # noqa: ARG002
        """Take all that is there, of one neighbour or of all; where it is known, what was there by a time."""
        for channel in self._decoders if of is None else self.channels(of):
            for message, letter in self._arrived(channel):
                self._give(channel, message, letter)

    def end(self) -> None:
        """Take all that has come, whether or not it is due: there will be no later."""
        self.drain()

    @property
    def holds(self) -> int:
        """How many messages links hold now."""
        return 0

    def held(self, of: NodeId) -> list[bytes]:  # noqa: ARG002
        """A neighbour's messages that have come and are not there for the node yet."""
        return []

    def _take(self, channel: Channel, letter: Letter) -> bool:
        """Whether it is a message."""
        message = self._decoded(channel, letter[0])
        return message is not None and self._give(channel, message, letter)

    def _take_next(self, channel: Channel) -> bool:
        """Take the next message that is there, if any; what is none is passed by."""
        return any(self._give(channel, message, letter) for message, letter in self._arrived(channel))

    def _arrived(self, channel: Channel) -> Iterator[tuple[Message, Letter]]:
        return self._inbox.arrived(channel, partial(self._decoded, channel))

    def _give(self, channel: Channel, message: Message, letter: Letter) -> bool:
        data, looked_ns, received_ns = letter
        self._listener.hear(Heard(channel, data, message, looked_ns, received_ns, None))
        return True

    def _decoded(self, channel: Channel, data: bytes) -> Message | None:
        node = self._listener.node
        if node is None:
            return None
        try:
            return self._decoders[channel].decode(data)
        except MessageError as error:
            node.counters[channel[0]].refused[error.reason] += 1
            return None


class EmulatedHearing(Hearing):
    """Messages when their links let go of them.

    The delays count from when a message was sent, on this node's clock: what a sender's clock is wrong by, by plan, is
    taken off. A stage closes after all messages that were due up to its deadline, however late the node looks at them.
    """

    stamped = False

    def __init__(
        self, inbox: Inbox, listener: Listener, own: NodeId, link: Link, timeline: Timeline, clock: Clock
    ) -> None:
        """`clock` is the node's."""
        super().__init__(inbox, listener)
        self._own, self._link, self._timeline, self._clock = own, link, timeline, clock
        self._held: list[tuple[int, int, int, Channel, bytes, Message]] = []
        """(due, number, received, ...)."""
        self._numbers = count()

    def subscribe(self, channel: Channel, key: str, decoder: Decoder) -> None:
        """See `Hearing`."""
        self._decoders[channel] = decoder
        self._inbox.subscribe_posted(channel, key)

    def rest(self, until_ns: int) -> bool:
        """See `Hearing`."""
        if self._held and self._held[0][0] < until_ns:
            self._inbox.rest(self._held[0][0], or_posted=True)
            return False
        return self._inbox.rest(until_ns, or_posted=True)

    def wait(self, node: Node, stage: str) -> bool:  # noqa: ARG002
        """See `Hearing`: until something can be done; it is for `drain` to find out what."""
        self.rest(NEVER if node.deadline is None else node.deadline)
        return False

    def drain(self, of: NodeId | None = None, until_ns: int | None = None) -> None:  # noqa: ARG002
        """Take all that is due, of whomever: what has not come yet is not heard any sooner from one who is gone."""
        node, held, now = self._listener.node, self._held, self._clock.now()
        if node is None:
            return
        self._sort_in()
        until_ns = now if until_ns is None else min(now, until_ns)
        while held and held[0][0] <= until_ns:
            if node.deadline is not None and held[0][0] > node.deadline:
                self._listener.let_close(now)
                continue
            due, _, received, channel, data, message = heappop(held)
            self._listener.hear(Heard(channel, data, message, now, received, due))

    def end(self) -> None:
        """See `Hearing`."""
        self.drain()
        while self._held:
            due, _, received, channel, data, message = heappop(self._held)
            self._listener.hear(Heard(channel, data, message, due, received, due))

    @property
    def holds(self) -> int:
        """See `Hearing`."""
        return len(self._held)

    def held(self, of: NodeId) -> list[bytes]:
        """See `Hearing`."""
        return [data for *_, channel, data, _ in sorted(self._held, key=itemgetter(0, 1)) if channel[0] == of]

    def _sort_in(self) -> None:
        """Find out what becomes of all that has come."""
        posted = self._inbox.posted
        while (letter := posted.take()) is not None:
            channel, data, received = letter
            node, message = self._listener.node, self._decoded(channel, data)
            if node is None or message is None:
                continue
            sent = message.t_ns - self._timeline.clock_ns(message.node, message.step) + self._clock.ahead_ns
            is_far = message.step > node.step + FAR
            for due in (received,) if is_far else self._link((message.node, self._own), message, sent):
                if len(self._held) < HELD:
                    entry = (max(due, received), next(self._numbers), received, channel, data, message)
                    heappush(self._held, entry)
                    self.most_held = max(self.most_held, len(self._held))
                else:
                    self._inbox.overrun += 1
