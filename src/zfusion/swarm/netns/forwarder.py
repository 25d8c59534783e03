"""The network in user space: takes IP packets out of TUN devices and puts each into its destination's, when it is due.

    read a packet ── whose? to whom? ── the edge's model: when does it arrive? ── wait ── write it

One thread, which sleeps until a packet or a due time comes. What TCP makes of a packet's delay or loss is the kernel's
business, here as on a real network.
"""

from __future__ import annotations

import os
import select
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count
from typing import Protocol

from zfusion.drivers.metrics import Latencies
from zfusion.model.network import Edge
from zfusion.model.types import NodeId
from zfusion.swarm.netns.kernel import Timer

MAX_PACKET = 2048
"""More than the 1500 bytes that a TUN device passes at once."""

BURST = 64
"""Packets read from one device before what is due meanwhile is delivered."""

DESTINATION = slice(16, 20)
"""Of an IPv4 packet."""


class PacketModel(Protocol):
    """What an edge does to the packets that are sent on it."""

    counters: Counter[str]
    """Packets that did not arrive, by reason."""

    def next(self, now_ns: int, size: int, /) -> int | None:
        """When the packet that is sent now arrives; None if it is lost. Called in the order of sending."""


@dataclass(frozen=True, slots=True)
class Port:
    """One end of the network."""

    descriptor: int
    """Of a TUN device; non-blocking, gives and takes one packet at a time."""
    address: bytes
    """IPv4, four bytes."""


@dataclass(slots=True)
class Route:
    """One directed edge of the network, and what went over it."""

    to: int
    """Descriptor."""
    model: PacketModel
    packets: int = 0
    bytes: int = 0


class Forwarder:
    """Carries packets between the ports until `stop`."""

    def __init__(self, ports: Mapping[NodeId, Port], model_of: Callable[[Edge], PacketModel]) -> None:
        """`model_of` is asked once for each pair of ports."""
        self.routes = {(a, b): Route(ports[b].descriptor, model_of((a, b))) for a in ports for b in ports if a != b}
        self.strays = 0
        """Packets to nobody."""
        self.lateness = Latencies()
        """How long after they were due packets were delivered."""
        self._tables = {
            port.descriptor: {ports[b].address: route for (a, b), route in self.routes.items() if a == name}
            for name, port in ports.items()
        }
        self._waiting: list[tuple[int, int, int, bytes]] = []
        self._order = count()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK)
        self._stopping = False

    def run(self) -> None:
        """Carry packets."""
        timer, waiting = Timer(), self._waiting
        with select.epoll() as poll:
            for descriptor in (*self._tables, timer.descriptor, self._bell):
                poll.register(descriptor, select.EPOLLIN)
            while not self._stopping:
                for descriptor, _ in poll.poll():
                    if descriptor in self._tables:
                        self._take(descriptor)
                    elif descriptor == timer.descriptor:
                        timer.clear()
                self._deliver()
                if waiting and waiting[0][0] != timer.at_ns:
                    timer.set(waiting[0][0])
        timer.close()

    def stop(self) -> None:
        """End, from any thread; what is on its way is lost."""
        self._stopping = True
        os.eventfd_write(self._bell, 1)

    def _take(self, descriptor: int) -> None:
        table = self._tables[descriptor]
        for _ in range(BURST):
            try:
                packet = os.read(descriptor, MAX_PACKET)
            except BlockingIOError:
                return
            route = table.get(packet[DESTINATION])
            if route is None:
                self.strays += 1
                continue
            route.packets += 1
            route.bytes += len(packet)
            due = route.model.next(time.time_ns(), len(packet))
            if due is not None:
                heappush(self._waiting, (due, next(self._order), route.to, packet))

    def _deliver(self) -> None:
        waiting, lateness = self._waiting, self.lateness
        now = time.time_ns()
        while waiting and waiting[0][0] <= now:
            due, _, to, packet = heappop(waiting)
            os.write(to, packet)
            lateness.add(now - due)
