"""Asking the nodes of a running swarm how they are, from outside: once, and then it is over."""

from __future__ import annotations

import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import zenoh

from zfusion import keys
from zfusion.drivers.clocks import Clock
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import closing, may_ask, open_session
from zfusion.errors import MessageError
from zfusion.messages import encode_any
from zfusion.model.types import NodeId, sorted_ids
from zfusion.status import Status

ANSWER_S = 1.0
"""How long an answer may take: nodes answer between messages."""

LINK_S = 2.0
"""How long it may take until a node is seen: links are dialled in the background."""

POLL_S = 0.02


class Answer(NamedTuple):
    """What a node answered."""

    status: Status
    asked_ns: int
    answered_ns: int


class Answers(NamedTuple):
    """What all of them did."""

    of: dict[NodeId, Answer]
    unread: frozenset[NodeId]
    """Who answered what could not be read: of another version of zfusion, or not of zfusion."""
    unasked: frozenset[NodeId]
    """Who showed itself, and may not be asked by the rules of the session's configuration."""
    silent: frozenset[NodeId]
    """Who showed itself, and did not answer."""

    @property
    def present(self) -> frozenset[NodeId]:
        """Who showed itself."""
        return self.unread | self.unasked | self.silent | self.of.keys()


def ask(
    run: str, nodes: Collection[NodeId], endpoints: Endpoints, clock: Clock, config_file: Path | None = None
) -> Answers:
    """Ask those of the nodes that show themselves; InputError where no session can be opened."""
    found: dict[NodeId, Answer] = {}
    unread: set[NodeId] = set()
    with closing(open_session(endpoints, config_file=config_file, looks=True)) as session:
        present = frozenset(_present(session, run, nodes))
        asked = {node for node in present if may_ask(keys.status_key(run, node), config_file)}
        for node in sorted_ids(asked):
            asked_ns = clock.now()
            replies = session.get(
                keys.status_key(run, node),
                zenoh.handlers.FifoChannel(4),
                payload=encode_any({}),
                timeout=ANSWER_S,
            )
            for reply in replies:
                answered_ns = clock.now()
                if reply.ok is None:
                    continue
                try:
                    found[node] = Answer(Status.decode(reply.ok.payload.to_bytes()), asked_ns, answered_ns)
                except MessageError:
                    unread.add(node)
    silent = asked - found.keys() - unread
    return Answers(found, frozenset(unread), present - asked, frozenset(silent))


def _present(session: zenoh.Session, run: str, nodes: Collection[NodeId]) -> list[NodeId]:
    """The nodes whose tokens are seen before the time is up."""
    by_text = {str(node): node for node in nodes}
    seen: dict[NodeId, None] = {}
    tokens = session.liveliness().declare_subscriber(
        keys.node_token(run, "*"), zenoh.handlers.FifoChannel(max(16, 4 * len(by_text))), history=True
    )
    end = time.monotonic() + LINK_S
    while len(seen) < len(by_text) and time.monotonic() < end:
        sample = tokens.handler.try_recv()
        if sample is None:
            time.sleep(POLL_S)
            continue
        with suppress(MessageError):
            node = by_text.get(keys.parse_token(str(sample.key_expr)).node or "")
            if node is not None and sample.kind == zenoh.SampleKind.PUT:
                seen[node] = None
    tokens.undeclare()  # type: ignore[no-untyped-call]
    return list(seen)
