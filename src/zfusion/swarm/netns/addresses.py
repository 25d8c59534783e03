"""Where the nodes are in their network of namespaces: chosen freely, for nothing else is in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface, IPv4Network

from zfusion.model.types import NodeId

NETWORK = IPv4Network("10.0.0.0/9")
"""That all nodes are in."""

FIRST_WIRE = IPv4Address("10.128.0.0")
"""Each node's wire to the recorder is a network of its own, of two addresses."""

PORT = 7447
"""Every node's, for every node has addresses of its own."""


@dataclass(frozen=True, slots=True)
class Place:
    """One node's network namespace."""

    node: NodeId
    number: int
    """In the order of ids, from 0."""

    @property
    def address(self) -> IPv4Interface:
        """In the network of the nodes."""
        return IPv4Interface((NETWORK.network_address + 1 + self.number, NETWORK.prefixlen))

    @property
    def wire(self) -> tuple[IPv4Interface, IPv4Interface]:
        """The two ends of the wire to the recorder: the node's, the recorder's."""
        first = FIRST_WIRE + 2 * self.number
        return IPv4Interface((first, 31)), IPv4Interface((first + 1, 31))

    @property
    def endpoint(self) -> str:
        """Where the other nodes dial it."""
        return f"tcp/{self.address.ip}:{PORT}"

    @property
    def recorder_dials(self) -> str:
        """Where the recorder dials it."""
        return f"tcp/{self.wire[0].ip}:{PORT}"


def places(ids: Sequence[NodeId]) -> list[Place]:
    """A place for every node."""
    return [Place(node, number) for number, node in enumerate(ids)]
