"""Who else is there: how a node and its neighbours find each other, agree on the beginning, and part.

Liveliness tokens say who is there, queries who he is, how he is doing and what he used. Zenoh's callbacks only leave
notices, which are handled here on the node's own thread when it asks for that.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Protocol

import zenoh

from zfusion import keys
from zfusion.drivers.claims import Claims
from zfusion.drivers.clock_watch import ClockWatch
from zfusion.drivers.clocks import ASK_AGAIN_NS, Clock
from zfusion.drivers.endpoints import linked, links_of
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.meeting import POLL_NS, Meeting, Start, check_identity, connected, hops_from_smallest
from zfusion.drivers.probe import WORD_NS, Prober, Waiting
from zfusion.drivers.transport import never_linger, on_zenoh_thread
from zfusion.errors import InputError, MessageError
from zfusion.messages import Reason, decode_any, encode_any
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import Node
from zfusion.status import HistoryAnswer, Phase, Status

log = logging.getLogger(__name__)

ANSWER_S = 2.0
"""How long a query may take; an answer is a few hundred bytes from a neighbour that is not busy for long."""

LEAVE_NS = 5_000_000_000
"""How long a node stays after its last step for neighbours that do not confirm that they have its messages."""

QUESTIONS = frozenset({"status?", "history?"})
"""Notices of queries. Each must be dropped explicitly, answered or not: Python would drop it holding its global lock,
and Zenoh's thread may be waiting for that while it holds what dropping needs."""

MAX_NOTICES = 4096
"""Notices waiting, above which questions are not answered: neighbours ask seldom, and can ask again."""

MOST_NOTICES = 65_536
"""Notices waiting, above which nothing more is noted, and that is counted: only somebody who floods makes so many."""

RECORDER = "the recorder"
"""Stands for it among node ids."""


class Host(Protocol):
    """The node that is present."""

    node: Node | None
    """None until it begins."""
    phase: Phase
    stopping: bool

    def status(self, *, counted: bool = False) -> Status:
        """How it is doing; what it has `counted` where that is wanted."""

    def tell_status(self) -> None:
        """Tell the launcher how it is doing."""

    def part_with(self, j: NodeId) -> None:
        """A neighbour is gone."""


class Presence:
    """A node's dealings with the others, beside the messages of the method."""

    def __init__(
        self,
        host: Host,
        meeting: Meeting,
        scenario: Scenario,
        graph: Network,
        run: str,
        session: zenoh.Session,
        inbox: Inbox,
        clock: Clock,
        prober: Prober,
    ) -> None:
        self.meeting = meeting
        self._now = clock.now
        self.overheard: Counter[str] = Counter()
        """What came and was neither a question nor an answer, by reason."""
        self.unheeded = 0
        """What happened and was not noted, too much being to be attended to."""
        self.strangers: set[NodeId] = set()
        """Neighbours that run something else than this node."""
        self._host, self._scenario, self._graph, self._run = host, scenario, graph, run
        self._session, self._inbox, self._prober = session, inbox, prober
        self._unconfirmed: set[NodeId] = set()
        """Who has not said yet that it has this node's last messages."""
        self._leaving: set[NodeId] = set()
        """Who has said that it had put its last messages."""
        self._answered: set[NodeId] = set()
        """Who was told how this node is doing."""
        self._claims = Claims(meeting.own)
        self._token: Any = None
        self._kept: list[Any] = []
        self.clocks = ClockWatch(scenario, meeting.own, meeting.linked, clock)
        """How far the neighbours' clocks are ahead of this node's."""
        self._clock = clock
        self._read_clocks_ns = 0

    def declare(self) -> None:
        """Be there. To be done when everything is subscribed: whoever sees the token is heard."""
        run, own, session = self._run, self.meeting.own, self._session
        liveliness = session.liveliness()
        self._kept = [
            session.declare_queryable(keys.status_key(run, own), self._noting("status?")),
            session.declare_queryable(keys.history_key(run, own), self._noting("history?")),
            liveliness.declare_subscriber(keys.node_token(run, "*"), self._noting("token"), history=True),
            liveliness.declare_subscriber(keys.recorder_token(run), self._noting("recorder"), history=True),
        ]
        self._show_token()

    def join(self) -> Start | None:
        """Wait until it is time to begin; None if stopped before.

        InputError where somebody runs something else, or has a clock that is too far off.
        """
        next_poll = self._now()
        waiting = Waiting(self._prober, next_poll + WORD_NS)
        line = self._clock.line_ns
        while not self._host.stopping:
            try:
                self.handle_notices()
                now = self._now()
                if moved := self._clock.line_ns - line:
                    line += moved
                    next_poll += moved
                    waiting.due_ns += moved
                    self.meeting.moved_ns += moved
                start = self._try_to_begin(now)
            except InputError:
                self._be_refused()
                raise
            if start is not None:
                self._clock.keep()
                self.clocks.tell_unknown(self.meeting.present)
                return start
            if self.meeting.epoch_ns is not None and not self.meeting.fixed_epoch:
                self._clock.keep()  # it was agreed on by what the clocks say now
            if now >= next_poll:
                next_poll = now + POLL_NS
                for j in self.meeting.present:
                    self._ask_status(j)
                self._host.tell_status()
            waiting.tell(now, self.meeting.missing, linked=self.meeting.linked <= self.meeting.present)
            self._inbox.rest(next_poll)
        return None

    def _try_to_begin(self, now: int) -> Start | None:
        self.clocks.agree(self.meeting.agrees_with(now))
        self._claims.check(now)
        self._show_token()
        start = None if self._claims.contested else self.meeting.start(now)
        if start is not None:
            self.clocks.agree(self.meeting.agrees_with(now, begins=True))
        return start

    def take_leave(self) -> None:
        """Stay until everybody that listens has the last messages, and this node theirs.

        An answer to a query that was put after the last message comes after that message has arrived, and so does the
        query: links keep the order.
        """
        for j in self._graph.listeners(self.meeting.own):
            if j in self.meeting.present:
                self._unconfirmed.add(j)
                self._ask_status(j)
        if self.meeting.recorder:
            self._unconfirmed.add(RECORDER)
            self._query(keys.recorder_status_key(self._run), "recorder!", RECORDER)
        end = self._now() + LEAVE_NS
        while (self._unconfirmed or self._somebody_speaks()) and self._now() < end:
            self._inbox.rest(end)
            self.handle_notices()

    def close(self) -> None:
        """Answer nothing any more."""
        for kind, about, _ in self._inbox.take_notices():
            if kind in QUESTIONS:
                about.drop()

    def read_clocks(self, now_ns: int) -> None:
        """Ask the neighbours on other machines for the time, if it is time to."""
        if now_ns >= self._read_clocks_ns:
            self._read_clocks_ns = now_ns + ASK_AGAIN_NS
            for j, clock in self.clocks.offsets.items():
                if j in self.meeting.present and clock.error_ns != 0:
                    self._ask_status(j)

    def ask_history(self, j: NodeId) -> None:
        """Ask a neighbour what it used; the node is told what it answers."""
        self._query(keys.history_key(self._run, j), "history!", j)

    def _show_token(self) -> None:
        """Say that this node is there, unless there may be another of its id: whether that one goes is to be seen."""
        if self._claims.contested:
            if self._token is not None:
                self._token.undeclare()
                self._token = None
        elif self._token is None:
            self._token = self._session.liveliness().declare_token(keys.node_token(self._run, self.meeting.own))

    def handle_notices(self) -> None:
        """Act on all that has happened."""
        for kind, about, at_ns in self._inbox.take_notices():
            try:
                self._handlers[kind](self, about, at_ns)
            except MessageError as error:
                self.overheard[error.reason] += 1

    def _noting(self, kind: str) -> Any:
        return on_zenoh_thread(partial(self._note, kind))

    def _note(self, kind: str, about: Any) -> None:
        waiting = len(self._inbox.notices)
        if waiting >= (MAX_NOTICES if kind in QUESTIONS else MOST_NOTICES):
            self.unheeded += 1
            if kind in QUESTIONS:
                about.drop()
        else:
            self._inbox.notify((kind, about, self._now()))

    def _query(self, key: str, kind: str, about: NodeId) -> None:
        """Ask, and say who asks and whether it is leaving; the answer comes as a notice, with the times of both."""
        asked_ns = self._now()
        self._session.get(
            key,
            on_zenoh_thread(lambda reply: self._note(kind, (about, reply, asked_ns))),
            payload=encode_any(
                {
                    "from": self.meeting.own,
                    "started": self.meeting.started_ns,
                    "leaving": self._host.phase is Phase.DONE,
                }
            ),
            timeout=ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def _ask_status(self, j: NodeId) -> None:
        self._query(keys.status_key(self._run, j), "status!", j)

    def _be_refused(self) -> None:
        """Stay until those who are there have been told, too, what this node runs: they are to say so themselves."""
        end = time.monotonic() + ANSWER_S
        while not self._host.stopping and not self.meeting.present <= self._answered and time.monotonic() < end:
            self._inbox.rest(self._now() + POLL_NS)
            with suppress(InputError):
                self.handle_notices()

    def _somebody_speaks(self) -> bool:
        """Whether a neighbour still has something to say, for a node that is to hear the run to its end."""
        meeting = self.meeting
        return not self._host.stopping and not meeting.hears & meeting.present <= self._leaving

    def _on_token(self, sample: Any, _at_ns: int) -> None:
        text = keys.parse_token(str(sample.key_expr)).node or ""
        try:
            j = self._scenario.node_id(text)
        except KeyError:
            raise MessageError(Reason.UNKNOWN_ID, f"a token of node {text!r}") from None
        if j not in self.meeting.linked:
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self.meeting.went(j)
            self._claims.gone(j)
            self._leaving.discard(j)
            self._unconfirmed.discard(j)
            if self._host.phase is Phase.RUNNING and j in self.meeting.hears:
                self._host.part_with(j)
            return
        never_linger()  # there may be a new link
        log.info("node %s is there", j)
        self.meeting.came(j)
        if self._host.node is not None:
            self._ask_status(j)

    def _on_recorder(self, sample: Any, _at_ns: int) -> None:
        self.meeting.recorder = sample.kind == zenoh.SampleKind.PUT
        log.info("the recorder is %s", "there" if self.meeting.recorder else "gone")
        if not self.meeting.recorder:
            self._unconfirmed.discard(RECORDER)

    def _on_recorder_status(self, about: tuple[NodeId, Any, int], _at_ns: int) -> None:
        if about[1].ok is not None:
            self._unconfirmed.discard(RECORDER)

    def _on_status(self, about: tuple[NodeId, Any, int], at_ns: int) -> None:
        j, reply, node = about[0], about[1].ok, self._host.node
        if reply is None:
            if node is not None and j in self.meeting.present:
                self._ask_status(j)  # it was busy
            return
        status = Status.decode(reply.payload.to_bytes())
        if status.node != j:
            raise MessageError(Reason.WRONG_NODE, f"{status.node} answers for {j}")
        self._unconfirmed.discard(j)
        self.clocks.read(status, self._host.status().machine, about[2], at_ns, begun=node is not None)
        self._claims.answered(j, status.holder_ns)
        if node is None:
            self.meeting.answered(status)
            return
        try:
            check_identity(self.meeting.own, self.meeting.identity, status)
        except InputError as error:
            log.error("%s", error)
            self.strangers.add(j)
            return
        self.strangers.discard(j)
        if j in self.meeting.hears and j in self.meeting.present and status.phase is not Phase.DONE:
            node.back(j)

    def _on_history(self, about: tuple[NodeId, Any, int], _at_ns: int) -> None:
        of, reply, node = about[0], about[1].ok, self._host.node
        if reply is None or node is None:
            return
        answer = HistoryAnswer.decode(reply.payload.to_bytes(), frozenset(self._graph.neighbours(of)))
        node.learn_history(of, answer.born, answer.end, answer.runs)

    def _answer_status(self, query: Any, at_ns: int) -> None:
        with query:
            question = decode_any(query.payload.to_bytes()) if query.payload is not None else {}
            asker, started = question.get("from"), question.get("started")
            known = type(asker) in (int, str) and asker in self.meeting.linked  # whoever else asks is not remembered
            holder = self._holder(asker, started) if known and type(started) is int else None
            status = self._host.status(counted=question.get("counts") is True)
            status = replace(status, heard_ns=at_ns, told_ns=self._now(), holder_ns=holder)
            query.reply(keys.status_key(self._run, self.meeting.own), status.encode())
            if asker is not None and known and holder is None:
                self._answered.add(asker)
                if question.get("leaving"):
                    self._leaving.add(asker)

    def _holder(self, asker: Any, started_ns: int) -> int | None:
        """The process that is known under an asker's id, if it is another one."""
        present, begun = asker in self.meeting.present, self._host.node is not None
        return self._claims.asked(asker, started_ns, present=present, begun=begun)

    def _answer_history(self, query: Any, _at_ns: int) -> None:
        with query:
            node = self._host.node
            if node is not None:
                answer = HistoryAnswer(*node.tell_history())
                query.reply(keys.history_key(self._run, self.meeting.own), answer.encode())

    _handlers: ClassVar[dict[str, Callable[[Presence, Any, int], None]]] = {
        "token": _on_token,
        "recorder": _on_recorder,
        "status!": _on_status,
        "history!": _on_history,
        "recorder!": _on_recorder_status,
        "status?": _answer_status,
        "history?": _answer_history,
    }


def make_meeting(
    scenario: Scenario,
    graph: Network,
    own: NodeId,
    *,
    needs_recorder: bool,
    epoch_ns: int | None,
    first_step: int,
) -> Meeting:
    """The meeting of a node whose process begins now; `graph` is the method's, `epoch_ns` is given or agreed on."""
    links = links_of(scenario)
    swarm = connected(own, links)
    return Meeting(
        own=own,
        identity=Status(own, scenario.fingerprint, Phase.JOINING, 0, 0, None, {}).identity,
        started_ns=time.time_ns(),
        hears=frozenset(graph.neighbours(own)) - {own},
        linked=frozenset(linked(scenario, own)),
        swarm=swarm,
        hops=hops_from_smallest(swarm, links),
        needs_recorder=needs_recorder,
        period_ns=scenario.timing.period_ns,
        epoch_ns=epoch_ns,
        fixed_epoch=epoch_ns is not None,
        first_step=first_step,
    )
