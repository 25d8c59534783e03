"""The live world: one node on Zenoh, on the wall clock.

    join     link up, wait until everybody is there, agree on the epoch (`meeting`)
    steps    measure, feed the node what arrives, publish what it says (`inbox`, `node`)
    leave    tell how it went, and stay until the neighbours have the last messages

Everything happens on one thread. Zenoh's callbacks only leave notices, which are handled between messages.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from heapq import heappop, heappush
from itertools import count
from typing import Any, ClassVar

import zenoh

from zfusion import keys
from zfusion.drivers.account import Account, make_node, truth_message
from zfusion.drivers.endpoints import Endpoints, linked, links_of
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.key_source import KeySource
from zfusion.drivers.meeting import POLL_NS, Meeting, Start, check_identity, connected, hops_from_smallest
from zfusion.drivers.metrics import NodeReport, told_estimate
from zfusion.drivers.sources import Source, open_source
from zfusion.drivers.transport import on_zenoh_thread, open_session, publisher
from zfusion.errors import InputError, MessageError
from zfusion.messages import Decoder, Reason, decode_any, encode, encode_any
from zfusion.methods import METHODS
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import LOOKAHEAD, Ask, Effect, Node
from zfusion.stages import ESTIMATE, EVENT, TRUTH, Message
from zfusion.status import HistoryAnswer, Phase, Status

log = logging.getLogger(__name__)

ANSWER_S = 2.0
"""How long a query may take; an answer is a few hundred bytes from a neighbour that is not busy for long."""

LEAVE_NS = 5_000_000_000
"""How long a node stays after its last step for neighbours that do not confirm that they have its messages."""

WORD_NS = 5_000_000_000
"""How often a node that waits for others says for whom."""

REPORT_NS = 250_000_000
"""How often a node tells its launcher how it is doing."""

AHEAD = 65_536
"""Messages kept here that are too far ahead for the node to take: what a swarm says in half a minute, while a node that
was restarted follows it."""

QUESTIONS = frozenset({"status?", "history?"})
"""Notices of queries. Each must be dropped explicitly, answered or not: Python would drop it holding its global lock,
and Zenoh's thread may be waiting for that while it holds what dropping needs."""

MAX_NOTICES = 4096
"""Notices waiting, above which questions are not answered: neighbours ask seldom, and can ask again."""

GARBAGE_THRESHOLD = 100_000
"""Allocations between two garbage collections. A round makes no cycles; a collection costs as much as a round."""

Channel = tuple[NodeId, str]
"""(neighbour, stage)."""

RECORDER = "the recorder"
"""Stands for it among node ids."""


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How one node takes part, beside what the scenario says."""

    run: str
    endpoints: Endpoints
    recorder: bool = False
    """Wait for a recorder before beginning."""
    epoch_ns: int | None = None
    """When step 0 is; by default what the scenario says, or what the swarm agrees on."""
    steps: int | None = None
    """Last step; None: until told to stop."""


class LiveNode:
    """One node of a live swarm. `run` takes it from joining to leaving; `stop` ends it, from any thread."""

    def __init__(
        self,
        scenario: Scenario,
        node: NodeId,
        options: LiveOptions,
        tell: Callable[[Status], None] | None = None,
    ) -> None:
        """`tell` is called with the node's status a few times a second.

        Raises InputError where Zenoh does not open, or the sensor's source.
        """
        self.id = node
        self._scenario, self._options, self._tell = scenario, options, tell
        self._method = METHODS[scenario.method.name]
        self._graph = self._method.network(scenario.network)
        self._phase = Phase.JOINING
        self._node: Node | None = None
        self._account: Account | None = None
        self._stopping = False
        self._unconfirmed: set[NodeId] = set()
        """Who has not said yet that it has this node's last messages."""
        self._leaving: set[NodeId] = set()
        """Who has said that it had put its last messages."""
        self._answered: set[NodeId] = set()
        """Who was told how this node is doing."""
        self._overheard: Counter[str] = Counter()
        self._strangers: set[NodeId] = set()
        self._decoders: dict[Channel, Decoder] = {}
        self._ahead: list[tuple[int, int, Channel, bytes, Message]] = []
        self._order = count()
        self._last_heard: dict[Channel, bytes] = {}
        self._estimates: list[Message] = []
        self._told_ns = 0
        self._meeting = self._make_meeting()
        config = scenario.transport.zenoh_config
        self._session = open_session(
            options.endpoints,
            low_latency=scenario.transport.preset == "lowlatency",
            config_file=scenario.absolute(config) if config else None,
        )
        try:
            self._source: Source = open_source(scenario, node, self._subscribe)
        except InputError:
            self._session.close()  # type: ignore[no-untyped-call]
            raise
        self._inbox = Inbox(self._session)

    def run(self) -> NodeReport:
        """Join, take the steps, leave; what became of it all.

        Raises InputError where a neighbour runs another scenario or version, RunError where the source fails.
        """
        with self._session:
            try:
                self._declare()
                start = self._join()
                if start is not None:
                    node = self._begin(start)
                    self._take_steps(node, start)
                    self._leave(node)
            finally:
                self._inbox.close()
                self._source.close()
                for kind, about in filter(None, self._inbox.notices):
                    if kind in QUESTIONS:
                        about.drop()
        return self._report()

    def stop(self) -> None:
        """End after what is being done now: at the latest at the next message or deadline."""
        self._stopping = True
        self._inbox.notify(None)

    def status(self) -> Status:
        """How the node is doing."""
        node, meeting = self._node, self._meeting
        return Status(
            node=self.id,
            fingerprint=self._scenario.fingerprint,
            phase=self._phase,
            step=node.step if node else 0,
            born=node.born if node else 0,
            epoch_ns=meeting.epoch_ns,
            ready=meeting.ready,
            completed=node.completed if node else 0,
            fallbacks=node.fallbacks if node else 0,
            estimate=told_estimate(node) if node else {},
        )

    def _report(self) -> NodeReport:
        node, account = self._node, self._account
        if node is None or account is None:
            return NodeReport.of_nothing(self.id)
        while self._ahead:
            *_, message = heappop(self._ahead)
            node.counters[message.node].refused["too_early"] += 1
        report = account.report()
        report.overheard = dict(Counter(report.overheard) + self._overheard)
        return report

    def _make_meeting(self) -> Meeting:
        scenario, timing = self._scenario, self._scenario.timing
        links = links_of(scenario)
        swarm = connected(self.id, links)
        given = self._options.epoch_ns if self._options.epoch_ns is not None else timing.epoch_ns
        return Meeting(
            own=self.id,
            identity=Status(self.id, scenario.fingerprint, Phase.JOINING, 0, 0, None, {}).identity,
            started_ns=time.time_ns(),
            hears=frozenset(self._graph.neighbours(self.id)) - {self.id},
            linked=frozenset(linked(scenario, self.id)),
            swarm=swarm,
            hops=hops_from_smallest(swarm, links),
            needs_recorder=self._options.recorder,
            period_ns=timing.period_ns,
            epoch_ns=given,
            fixed_epoch=given is not None,
        )

    def _subscribe(self, node: NodeId, key: str, ny: int) -> Source:
        """The source of the readings that a program of the user's publishes."""
        timing = self._scenario.timing
        return KeySource(self._session, node, key, ny, 0.0 if timing.period_ns is not None else timing.timeout_s)

    def _declare(self) -> None:
        """Publishers, subscribers, queryables; the token last, so that whoever sees it is heard by this node."""
        run, session, system = self._options.run, self._session, self._scenario.system()
        stages = [stage.name for stage in self._method.stages]
        published = (*stages, ESTIMATE.name, EVENT.name)
        self._publish = {stage: publisher(session, keys.stage_key(run, self.id, stage)).put for stage in published}
        self._tells_truth = self._scenario.truth_known and self.id == self._graph.ids[0]
        if self._tells_truth:
            self._publish[TRUTH.name] = publisher(session, keys.truth_key(run)).put
        for j in sorted(self._meeting.hears, key=self._graph.ids.index):
            sizes = {"nx": system.nx, "ny": system.by_id[j].ny}
            for stage in self._method.stages:
                self._decoders[j, stage.name] = Decoder(stage, j, sizes=sizes, ids=self._graph.neighbours(j))
                self._inbox.subscribe((j, stage.name), keys.stage_key(run, j, stage.name))
        liveliness = session.liveliness()
        self._kept = [
            session.declare_queryable(keys.status_key(run, self.id), self._noting("status?")),
            session.declare_queryable(keys.history_key(run, self.id), self._noting("history?")),
            liveliness.declare_subscriber(keys.node_token(run, "*"), self._noting("token"), history=True),
            liveliness.declare_subscriber(keys.recorder_token(run), self._noting("recorder"), history=True),
        ]
        self._kept.append(liveliness.declare_token(keys.node_token(run, self.id)))

    def _noting(self, kind: str) -> Any:
        return on_zenoh_thread(partial(self._note, kind))

    def _note(self, kind: str, about: Any) -> None:
        if kind in QUESTIONS and len(self._inbox.notices) >= MAX_NOTICES:
            about.drop()
        else:
            self._inbox.notify((kind, about))

    def _join(self) -> Start | None:
        """Wait until it is time to begin; None if stopped before."""
        next_poll = time.time_ns()
        next_word = next_poll + WORD_NS
        while not self._stopping:
            try:
                self._handle_notices()
            except InputError:
                self._be_refused()
                raise
            now = time.time_ns()
            start = self._meeting.start(now)
            if start is not None:
                return start
            if now >= next_poll:
                next_poll = now + POLL_NS
                for j in self._meeting.present:
                    self._ask_status(j)
                self._tell_status(now)
            if now >= next_word:
                next_word = now + WORD_NS
                log.warning("waiting for %s", ", ".join(self._meeting.missing()))
            self._inbox.rest(next_poll)
        return None

    def _be_refused(self) -> None:
        """Stay until those who are there have been told, too, what this node runs: they are to say so themselves."""
        end = time.time_ns() + int(ANSWER_S * 1e9)
        while not self._stopping and not self._meeting.present <= self._answered and time.time_ns() < end:
            self._inbox.rest(end)
            with suppress(InputError):
                self._handle_notices()

    def _begin(self, start: Start) -> Node:
        """Make the node, and say that it is there."""
        self._meeting.epoch_ns = start.epoch_ns
        node = make_node(self._scenario, self._graph, self.id, born=start.born, expected=start.expected)
        for j in self._meeting.present & self._meeting.hears:
            node.back(j)
        gc.collect()
        gc.freeze()
        gc.set_threshold(GARBAGE_THRESHOLD)
        now, period = time.time_ns(), self._scenario.timing.period_ns
        first = now if period is None else max(now, start.epoch_ns + start.born * period)
        self._node, self._account, self._phase = node, Account(node, self._source, first), Phase.RUNNING
        self._carry_out([node.event("started", now, epoch_ns=start.epoch_ns)])
        self._tell_status(now)
        return node

    def _take_steps(self, node: Node, start: Start) -> None:
        """From the first step of this life to the last of the run, the second half of them counting as settled."""
        account, period, last = self._account, self._scenario.timing.period_ns, self._options.steps
        assert account is not None  # `_begin` has made it
        middle = None if last is None else (start.born + last + 1) // 2
        step = start.born
        while not self._stopping and (last is None or step <= last):
            due = None
            if period is not None:
                due = self._await_due(start.epoch_ns + step * period)
                skipped = (time.time_ns() - due) // period  # its whole period is over
                if skipped > 0 and not self._stopping:
                    skipped = skipped if last is None else min(skipped, last + 1 - step)
                    account.skipped += skipped
                    step += skipped
                    continue
            if middle is not None and step >= middle:
                middle = None
                account.settle(time.time_ns())
            self._take_step(node, account, step, due)
            step += 1

    def _await_due(self, due: int) -> int:
        """Sleep until a paced step is due; then take what has come meanwhile."""
        while not self._stopping and not self._inbox.rest(due):
            self._handle_notices()
        self._inbox.drain(self._decoders, self._take)
        return due

    def _take_step(self, node: Node, account: Account, step: int, due: int | None) -> None:
        if self._stopping:
            return
        y = self._source.read(step, time.time_ns() if due is None else due)
        began, now = time.perf_counter_ns(), time.time_ns()
        if self._tells_truth:
            self._tell_truth(node, step, now)
        self._carry_out(node.begin(step, y, now, due))
        if self._ahead:
            self._catch_up(node)
        for j in node.silent:
            self._inbox.drain([channel for channel in self._decoders if channel[0] == j], self._take)
        while (stage := node.stage) is not None and not self._stopping:
            self._await_messages(node, stage)
        if node.stage is None:
            latency = time.perf_counter_ns() - began
            now = time.time_ns()
            account.complete(now, latency)
            if now - self._told_ns > REPORT_NS:
                self._tell_status(now)
        for estimate in self._estimates:
            account.compare(estimate)
        self._estimates.clear()

    def _await_messages(self, node: Node, stage: str) -> None:
        """Wait for the messages of a stage, the deadline or a notice, and act on it.

        The messages are taken together when the last is there: to wait and to work in turns costs more than both.
        """
        awaiting, came = node.awaiting, []
        for j in awaiting:
            data = self._inbox.wait((j, stage), node.deadline)
            if data is None:
                break
            came.append(((j, stage), data))
        for channel, data in came:
            self._take(channel, data)
        if len(came) == len(awaiting):
            return
        self._handle_notices()
        overdue = node.deadline is not None and time.time_ns() >= node.deadline
        # What stands in the channels has arrived in time, it was only not looked at yet; and none must run full.
        self._inbox.drain(self._decoders, self._take)
        if overdue:
            self._carry_out(node.tick(time.time_ns()))

    def _take(self, channel: Channel, data: bytes) -> None:
        """Feed the node a message; what is not one is counted."""
        node = self._node
        if node is None:
            return
        try:
            message = self._decoders[channel].decode(data)
        except MessageError as error:
            node.counters[channel[0]].refused[error.reason] += 1
            return
        if channel[0] in self._strangers:
            node.counters[channel[0]].refused["other_scenario"] += 1
        elif message.step > node.step + LOOKAHEAD and len(self._ahead) < AHEAD:
            heappush(self._ahead, (message.step, next(self._order), channel, data, message))
        else:
            if message.step >= node.step:
                self._last_heard[channel] = data
            self._carry_out(node.receive(message, time.time_ns()))

    def _catch_up(self, node: Node) -> None:
        """Feed the node what was too far ahead of it and is not any more."""
        while self._ahead and self._ahead[0][0] <= node.step + LOOKAHEAD:
            _, _, channel, data, message = heappop(self._ahead)
            self._last_heard[channel] = data
            self._carry_out(node.receive(message, time.time_ns()))

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Ask):
                self._query(keys.history_key(self._options.run, effect.node), "history!", effect.node)
                continue
            self._publish[effect.stage](encode(effect))
            if "x" in effect.fields:
                self._estimates.append(effect)

    def _tell_truth(self, node: Node, step: int, now: int) -> None:
        x = self._source.truth(step)
        if x is not None:
            message = truth_message(x, step, node.sent[TRUTH.name], now)._replace(born=node.born)
            node.sent[TRUTH.name] += 1
            self._publish[TRUTH.name](encode(message))

    def _query(self, key: str, kind: str, about: NodeId) -> None:
        """Ask, and say who asks and whether it is leaving; the answer comes as a notice."""
        self._session.get(
            key,
            on_zenoh_thread(lambda reply: self._note(kind, (about, reply))),
            payload=encode_any({"from": self.id, "leaving": self._phase is Phase.DONE}),
            timeout=ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def _ask_status(self, node: NodeId) -> None:
        self._query(keys.status_key(self._options.run, node), "status!", node)

    def _handle_notices(self) -> None:
        notices = self._inbox.notices
        for _ in range(len(notices)):
            notice = notices.popleft()
            if notice is None:
                continue
            kind, about = notice
            try:
                self._handlers[kind](self, about)
            except MessageError as error:
                self._overheard[error.reason] += 1

    def _on_token(self, sample: Any) -> None:
        text = keys.parse_token(str(sample.key_expr)).node or ""
        try:
            node = self._scenario.node_id(text)
        except KeyError:
            raise MessageError(Reason.UNKNOWN_ID, f"a token of node {text!r}") from None
        if node not in self._meeting.linked:
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self._on_gone(node)
            return
        self._meeting.came(node)
        if self._node is not None:
            self._ask_status(node)

    def _on_gone(self, j: NodeId) -> None:
        self._meeting.went(j)
        self._leaving.discard(j)
        self._unconfirmed.discard(j)
        if self._node is None or self._phase is not Phase.RUNNING or j not in self._meeting.hears:
            return
        # Its last messages may be waiting behind this notice. They are told: they may not have come to the recorder.
        channels = [channel for channel in self._decoders if channel[0] == j]
        self._inbox.drain(channels, self._take)
        last = [decode_any(self._last_heard[channel]) for channel in channels if channel in self._last_heard]
        now = time.time_ns()
        self._carry_out([self._node.event("gone", now, of=j, last=last), *self._node.gone(j, now)])

    def _on_recorder(self, sample: Any) -> None:
        self._meeting.recorder = sample.kind == zenoh.SampleKind.PUT
        if not self._meeting.recorder:
            self._unconfirmed.discard(RECORDER)

    def _on_recorder_status(self, about: tuple[NodeId, Any]) -> None:
        if about[1].ok is not None:
            self._unconfirmed.discard(RECORDER)

    def _on_status(self, about: tuple[NodeId, Any]) -> None:
        j, reply = about[0], about[1].ok
        if reply is None:
            if self._node is not None and j in self._meeting.present:
                self._ask_status(j)  # it was busy
            return
        status = Status.decode(reply.payload.to_bytes())
        if status.node != j:
            raise MessageError(Reason.WRONG_NODE, f"{status.node} answers for {j}")
        self._unconfirmed.discard(j)
        if self._node is None:
            self._meeting.answered(status)
            return
        try:
            check_identity(self.id, self._meeting.identity, status)
        except InputError as error:
            log.error("%s", error)
            self._strangers.add(j)
            return
        self._strangers.discard(j)
        if j in self._meeting.hears and j in self._meeting.present and status.phase is not Phase.DONE:
            self._node.back(j)

    def _on_history(self, about: tuple[NodeId, Any]) -> None:
        of, reply = about[0], about[1].ok
        if reply is None or self._node is None:
            return
        answer = HistoryAnswer.decode(reply.payload.to_bytes(), frozenset(self._graph.neighbours(of)))
        self._node.learn_history(of, answer.born, answer.end, answer.runs)

    def _answer_status(self, query: Any) -> None:
        with query:
            question = decode_any(query.payload.to_bytes()) if query.payload is not None else {}
            query.reply(keys.status_key(self._options.run, self.id), self.status().encode())
            asker = question.get("from")
            if isinstance(asker, int | str):
                self._answered.add(asker)
                if question.get("leaving"):
                    self._leaving.add(asker)

    def _answer_history(self, query: Any) -> None:
        with query:
            node = self._node
            own = node.ledger.of(self.id) if node is not None else None
            if node is not None and own is not None:
                answer = HistoryAnswer(node.born, own.last, own.runs(own.last))
                query.reply(keys.history_key(self._options.run, self.id), answer.encode())

    _handlers: ClassVar[dict[str, Callable[[LiveNode, Any], None]]] = {
        "token": _on_token,
        "recorder": _on_recorder,
        "status!": _on_status,
        "history!": _on_history,
        "recorder!": _on_recorder_status,
        "status?": _answer_status,
        "history?": _answer_history,
    }

    def _tell_status(self, now: int) -> None:
        self._told_ns = now
        if self._tell is not None:
            self._tell(self.status())

    def _leave(self, node: Node) -> None:
        """Tell how it went, and stay until everybody that listens has the last messages, and this node theirs.

        An answer to a query that was put after the last message comes after that message has arrived, and so does the
        query: links keep the order.
        """
        assert self._account is not None  # `_begin` has made it
        self._phase = Phase.DONE
        self._carry_out([node.event("stopped", time.time_ns(), **self._account.last_words())])
        for j in self._graph.listeners(self.id):
            if j in self._meeting.present:
                self._unconfirmed.add(j)
                self._ask_status(j)
        if self._meeting.recorder:
            self._unconfirmed.add(RECORDER)
            self._query(keys.recorder_status_key(self._options.run), "recorder!", RECORDER)
        self._tell_status(time.time_ns())
        end = time.time_ns() + LEAVE_NS
        while (self._unconfirmed or self._speaking()) and time.time_ns() < end:
            self._inbox.rest(end)
            self._handle_notices()
        self._inbox.drain(self._decoders, self._take)

    def _speaking(self) -> bool:
        """Whether a neighbour still has something to say, for a node that is to hear the run to its end."""
        meeting = self._meeting
        return not self._stopping and not meeting.hears & meeting.present <= self._leaving
