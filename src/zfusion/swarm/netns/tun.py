"""A network of TUN devices, one in each namespace, and the forwarder between them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from zfusion.model.network import Edge
from zfusion.model.types import NodeId
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.addresses import Place
from zfusion.swarm.netns.forwarder import Forwarder, PacketModel, Port

PRIORITY = 1
"""The lowest of the real-time ones."""


class TunNetwork:
    """Namespaces joined in user space."""

    def __init__(
        self, places: Sequence[Place], namespaces: Mapping[NodeId, int], model_of: Callable[[Edge], PacketModel]
    ) -> None:
        """OSError or InputError where the kernel refuses."""
        self._namespaces = namespaces
        ports = {}
        for place in places:
            with kernel.inside(namespaces[place.node]):
                ports[place.node] = Port(kernel.open_tun(place.address), place.address.packed)
        self._forwarder = Forwarder(ports, model_of)

    def carry(self) -> None:
        """Carry packets until `stop`; before all else that wants a processor, where that is allowed."""
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
        self._forwarder.run()

    def stop(self) -> None:
        """End `carry`, from any thread."""
        self._forwarder.stop()

    def report(self) -> Mapping[str, Any]:
        """What went over it.

        edges [{from, to, packets, bytes, lost, cut, queue_full}] between nodes; strays: packets to nobody; overrun:
        packets that came faster than they were taken; late_us {p50, p99}: after they were due.
        """
        forwarder = self._forwarder
        overrun = 0
        for namespace in self._namespaces.values():
            with kernel.inside(namespace):
                overrun += kernel.dropped(kernel.INTERFACE)
        return {
            "edges": [
                {"from": a, "to": b, "packets": route.packets, "bytes": route.bytes, **route.model.counters}
                for (a, b), route in forwarder.routes.items()
                if route.packets
            ],
            "strays": forwarder.strays,
            "overrun": overrun,
            "late_us": {name: forwarder.lateness.quantile_us(q) for name, q in (("p50", 0.5), ("p99", 0.99))},
        }
