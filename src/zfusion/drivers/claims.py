"""Two processes with the id of one node: the neighbours know, and the second is refused.

Neighbours have the same neighbours, but no link to each other's doubles: a second node 2 does not see the first. But
whoever asks a neighbour how it is doing says which process it is, by when that was started, and is told if the
neighbour knows another one under that id that has not gone. A process that is told so before it has begun does not
begin: it may be that the other has died and its link is not known to be closed yet, so it asks again for a while.

No input or output: it is told who asks, who goes and what is answered.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zfusion.errors import InputError
from zfusion.model.types import NodeId

PATIENCE_NS = 6_000_000_000
"""How long a process waits for another of its id to go: three times what it takes to see that a link is dead."""


@dataclass(slots=True)
class Claims:
    """Which processes this node knows under its neighbours' ids, and what neighbours know under its own."""

    own: NodeId
    _holders: dict[NodeId, int] = field(default_factory=dict)
    _told: dict[NodeId, int] = field(default_factory=dict)
    _since_ns: int | None = None

    def asked(self, node: NodeId, started_ns: int, *, present: bool, begun: bool) -> int | None:
        """A process that was started then asks in the name of `node`: the start of the one that is known, if another.

        Nobody is known who does not show the node's token. Before this node has `begun` it goes by who is older: two
        that are started together are told the same by all.
        """
        holder = self._holders.get(node)
        if present and (holder is None or (not begun and started_ns < holder)):
            holder = self._holders[node] = started_ns
        return None if holder == started_ns else holder

    def gone(self, node: NodeId) -> None:
        """Nobody shows that node's token any more."""
        self._holders.pop(node, None)
        self._told.pop(node, None)

    def answered(self, by: NodeId, holder_ns: int | None) -> None:
        """What a neighbour knows under the own id, if it is not this process."""
        if holder_ns is None:
            self._told.pop(by, None)
        else:
            self._told[by] = holder_ns

    @property
    def contested(self) -> bool:
        """Whether a neighbour knows another process under the own id."""
        return bool(self._told)

    def check(self, now_ns: int) -> None:
        """InputError when a neighbour has known another process under the own id for too long."""
        if not self._told:
            self._since_ns = None
            return
        if self._since_ns is None:
            self._since_ns = now_ns
        if now_ns - self._since_ns >= PATIENCE_NS:
            by = ", ".join(f"node {j}" for j in sorted(self._told, key=str))
            raise InputError(
                f"node {self.own} is there already: {by} knows another process of that id, which has not gone; "
                "every node of a run is one process (run names tell runs apart)"
            )
