"""How the nodes of a swarm agree on when to begin, with nobody in charge.

A node is *ready* when it has found all that it is linked to, and the recorder where there is to be one. Every node
keeps asking its neighbours who is known to be ready; when everybody is, the node with the smallest id names the
epoch, which spreads the same way. A node that finds the others running joins them.

No input or output: it is told who is there and what they answered, and says when and with which step to begin.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from zfusion.errors import InputError
from zfusion.model.types import NodeId
from zfusion.status import Phase, Status

POLL_NS = 50_000_000
"""How often neighbours are asked. The epoch spreads one link per poll."""

LEAD_NS = 100_000_000
"""From naming the epoch to the epoch, beside the time that it takes to spread."""


JOIN_NS = 3_000_000_000
"""How long a node that finds others running waits for those that it does not see, from its start: whoever is to dial it
may not try for some hundred milliseconds. A free-running node that hears nobody would be far ahead of them by then."""


@dataclass(frozen=True, slots=True)
class Start:
    """When and with what a node begins."""

    born: int
    epoch_ns: int
    """When step 0 was, for paced swarms: step k begins at epoch + k period."""
    expected: frozenset[NodeId]
    """The in-neighbours to wait for from the first step on."""


@dataclass(slots=True)
class Meeting:
    """One node's view of who is there."""

    own: NodeId
    identity: tuple[str, int, str]
    started_ns: int
    """When this process was started: tells its lives apart."""
    hears: frozenset[NodeId]
    """In-neighbours."""
    linked: frozenset[NodeId]
    """All it has links to."""
    swarm: frozenset[NodeId]
    """All that it is connected with over any number of links."""
    hops: int
    """Links from the smallest of them to the farthest."""
    needs_recorder: bool
    period_ns: int | None
    epoch_ns: int | None = None
    fixed_epoch: bool = False
    """The epoch was given: it is kept to, whoever is there by then."""
    first_step: int = 1
    """With which step to begin where nobody is running: a later one where the run had come so far before all died."""
    moved_ns: int = 0
    """How far the node's clock was set forward since it was started."""
    present: set[NodeId] = field(default_factory=set)
    recorder: bool = False
    ready: dict[NodeId, int] = field(default_factory=dict)
    heard: dict[NodeId, Status] = field(default_factory=dict)

    def came(self, node: NodeId) -> None:
        """A linked node is there."""
        self.present.add(node)

    def went(self, node: NodeId) -> None:
        """A linked node is gone."""
        self.present.discard(node)
        self.heard.pop(node, None)

    def answered(self, status: Status) -> None:
        """What a linked node answered; InputError if it runs something else than this node."""
        check_identity(self.own, self.identity, status)
        self.heard[status.node] = status
        for node, started in status.ready.items():
            if node in self.swarm and node != self.own:
                self.ready[node] = max(started, self.ready.get(node, 0))
        if status.epoch_ns is not None and not self.fixed_epoch:
            self.epoch_ns = status.epoch_ns

    def keep_to(self, epoch_ns: int) -> None:
        """The epoch is given: begin with the step that is next by then, with whoever is there."""
        self.fixed_epoch = True
        self.epoch_ns = epoch_ns

    def missing(self) -> list[str]:
        """Who or what this node still waits for, in words."""
        absent = [f"node {j}" for j in sorted(self.linked - self.present, key=str)]
        absent += ["the recorder"] if self.needs_recorder and not self.recorder else []
        return absent or [f"node {j} to be ready" for j in sorted(self.swarm - self.ready.keys(), key=str)]

    def agrees_with(self, now: int, *, begins: bool = False) -> frozenset[NodeId]:
        """Whose clocks must agree with this node's before it begins: those of the nodes that run, or else of all.

        Also of one that has gone meanwhile: it may have been the first to refuse. Empty until all have answered that
        are to be waited for, unless this node `begins` without them: one of them may be running, or be on this node's
        machine, whose time line it takes up then.
        """
        running = frozenset(j for j, status in self.heard.items() if status.phase is Phase.RUNNING)
        if running:
            return running if begins or self._awaited(now) <= self.heard.keys() else frozenset()
        return self.linked if begins or self.present <= self.heard.keys() else frozenset()

    def start(self, now: int) -> Start | None:
        """When to begin, if that can be said yet."""
        if self.needs_recorder and not self.recorder:
            return None
        if begun := self._join_running(now) or self._begin_without_the_rest(now):
            return begun
        if self.linked <= self.heard.keys() and self.linked <= self.present:
            self.ready[self.own] = self.started_ns
        if self.swarm <= self.ready.keys():
            if self.epoch_ns is None and self.own == min(self.swarm):
                lead = 0 if self.period_ns is None else LEAD_NS + 2 * self.hops * POLL_NS - self.period_ns
                self.epoch_ns = now + lead
            if self.epoch_ns is not None:
                return Start(self.first_step, self.epoch_ns, self.hears)
        return None

    def _join_running(self, now: int) -> Start | None:
        """Begin among nodes that are running already and do not know of this process."""
        running = [
            s for s in self.heard.values() if s.phase is Phase.RUNNING and s.ready.get(self.own) != self.started_ns
        ]
        if not running or not self._awaited(now) <= self.heard.keys():
            return None
        epoch = self.epoch_ns if self.epoch_ns is not None else now
        born = max(s.step for s in running) + 1
        if self.period_ns is not None:
            born = max(1, (now - epoch) // self.period_ns + 1)
        return Start(born, epoch, self.hears & {s.node for s in running})

    def _awaited(self, now: int) -> frozenset[NodeId]:
        """Whose answers a node that finds others running waits for."""
        return frozenset(self.present) if self._has_waited(now) else self.linked

    def _has_waited(self, now: int) -> bool:
        """Whether the time is over for those that it does not see to come."""
        return now >= self.started_ns + self.moved_ns + JOIN_NS

    def _begin_without_the_rest(self, now: int) -> Start | None:
        """Keep to a given epoch: once step 1 has begun, begin with the next, and with those who are there.

        Where steps have no times, begin with a given step, if the others have not come within the time for joining.
        """
        if self.period_ns is None and self.first_step > 1 and self._has_waited(now):
            return Start(self.first_step, now, self.hears & self.heard.keys())
        if not self.fixed_epoch or self.epoch_ns is None or self.period_ns is None:
            return None
        if now < self.epoch_ns + self.period_ns:
            return None
        return Start((now - self.epoch_ns) // self.period_ns + 1, self.epoch_ns, self.hears & self.heard.keys())


def check_identity(own: NodeId, identity: tuple[str, int, str], status: Status) -> None:
    """InputError, with both sides, unless a neighbour runs the same scenario on the same version."""
    if status.identity != identity:
        mine, theirs = (f"scenario {i[2][:12]} on zfusion {i[0]}, format {i[1]}" for i in (identity, status.identity))
        raise InputError(f"node {status.node} runs {theirs}; node {own}, here, runs {mine}: they are not of one swarm")


def hops_from_smallest(swarm: Collection[NodeId], links: Collection[tuple[NodeId, NodeId]]) -> int:
    """Links from the smallest of the connected `swarm` to the node farthest from it."""
    beside: dict[NodeId, set[NodeId]] = {node: set() for node in swarm}
    for a, b in links:
        if a in beside and b in beside:
            beside[a].add(b)
            beside[b].add(a)
    reached, edge, hops = {min(swarm)}, {min(swarm)}, 0
    while edge := {b for a in edge for b in beside[a]} - reached:
        reached |= edge
        hops += 1
    return hops


def connected(node: NodeId, links: Collection[tuple[NodeId, NodeId]]) -> frozenset[NodeId]:
    """All nodes that `node` is connected with over links, itself included."""
    beside: dict[NodeId, set[NodeId]] = {}
    for a, b in links:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    reached, edge = {node}, {node}
    while edge := {b for a in edge for b in beside.get(a, ())} - reached:
        reached |= edge
    return frozenset(reached)
