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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import zenoh

from zfusion import keys
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.meeting import POLL_NS, Meeting, Start, check_identity, connected, hops_from_smallest
from zfusion.drivers.metrics import Errors, Latencies, NodeReport, edge_report
from zfusion.drivers.sources import Source
from zfusion.drivers.transport import Endpoints, on_zenoh_thread, open_session, publisher
from zfusion.errors import InputError, MessageError, RunError
from zfusion.messages import Decoder, encode
from zfusion.methods import METHODS, Setting
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.node import Ask, Effect, Node, Patience
from zfusion.stages import ESTIMATE, EVENT, TRUTH, TRUTH_SENDER, Message
from zfusion.status import HistoryAnswer, Phase, Status

log = logging.getLogger(__name__)

ANSWER_S = 2.0
"""How long a query may take; an answer is a few hundred bytes from a neighbour that is not busy for long."""

LEAVE_S = 5.0
"""How long a node stays after its last step for neighbours that do not confirm that they have its messages."""

REPORT_NS = 250_000_000
"""How often a node tells its launcher how it is doing."""

TOLD_RUNS = 512
"""Runs of a history in one event: what an event may hold, with room to spare."""

Channel = tuple[NodeId, str]
"""(neighbour, stage)."""

RECORDER = "the recorder"
"""Stands for it among node ids."""

GARBAGE_THRESHOLD = 100_000
"""Allocations between two garbage collections. A round makes no cycles; a collection costs as much as a round."""


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
        source: Source,
        options: LiveOptions,
        tell: Callable[[Status], None] | None = None,
    ) -> None:
        """`tell` is called with the node's status a few times a second.

        Raises InputError where Zenoh does not open.
        """
        self.id = node
        self._scenario, self._source, self._options, self._tell = scenario, source, options, tell
        self._method = METHODS[scenario.method.name]
        self._graph = self._method.network(scenario.network)
        self._started_ns = time.time_ns()
        self._phase = Phase.JOINING
        self._node: Node | None = None
        self._stopping = False
        self._outstanding = 0
        self._errors: dict[str, Errors] = {}
        self._latencies = Latencies()
        self._overheard: Counter[str] = Counter()
        self._strangers: set[NodeId] = set()
        self._skipped = 0
        self._begun_ns = self._ended_ns = 0
        self._truths = 0
        self._told_ns = 0
        self._meeting = self._make_meeting()
        self._session = open_session(
            options.endpoints,
            low_latency=scenario.transport.preset == "lowlatency",
            config_file=None if not scenario.transport.zenoh_config else scenario.absolute(scenario.transport.zenoh_config),
        )
        self._inbox = Inbox(self._session)

    def run(self) -> NodeReport:
        """Join, take the steps, leave; what became of it all.

        Raises InputError where a neighbour runs another scenario or version.
        """
        try:
            with self._session:
                try:
                    self._declare()
                    start = self._join()
                    if start is not None:
                        self._take_steps(start)
                        self._leave()
                finally:
                    self._inbox.close()
        finally:
            self._source.close()
        return self.report()

    def stop(self) -> None:
        """End after what is being done now: at the latest at the next message or deadline."""
        self._stopping = True
        self._inbox.notify(None)

    def report(self) -> NodeReport:
        """What became of it all so far."""
        node = self._node
        return NodeReport(
            node=self.id,
            born=node.born if node else 0,
            step=node.step if node else 0,
            completed=node.completed if node else 0,
            skipped=self._skipped,
            elapsed_s=(self._ended_ns - self._begun_ns) / 1e9,
            sent=dict(node.sent) if node else {},
            edges=edge_report(node) if node else {},
            fallbacks=node.fallbacks if node else 0,
            errors={stage: errors.summary() for stage, errors in self._errors.items()},
            latency={str(number): count for number, count in self._latencies.sparse().items()},
            overheard=dict(self._overheard),
        )

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
        )

    def _make_meeting(self) -> Meeting:
        graph, timing = self._graph, self._scenario.timing
        links = links_of(self._scenario)
        swarm = connected(self.id, links)
        given = self._options.epoch_ns if self._options.epoch_ns is not None else timing.epoch_ns
        return Meeting(
            own=self.id,
            identity=Status(self.id, self._scenario.fingerprint, Phase.JOINING, 0, 0, None, {}).identity,
            started_ns=self._started_ns,
            hears=frozenset(graph.neighbours(self.id)) - {self.id},
            linked=frozenset(linked(self._scenario, self.id)),
            swarm=swarm,
            hops=hops_from_smallest(swarm, links),
            needs_recorder=self._options.recorder,
            period_ns=timing.period_ns,
            epoch_ns=given,
            fixed_epoch=given is not None,
        )

    def _declare(self) -> None:
        """Publishers, subscribers, queryables; the token last, so that whoever sees it is heard by this node."""
        run, session = self._options.run, self._session
        stages = [stage.name for stage in self._method.stages]
        published = (*stages, ESTIMATE.name, EVENT.name)
        self._publish = {stage: publisher(session, keys.stage_key(run, self.id, stage)).put for stage in published}
        self._tells_truth = self._scenario.truth_known and self.id == self._graph.ids[0]
        if self._tells_truth:
            self._publish[TRUTH.name] = publisher(session, keys.truth_key(run)).put
        self._decoders: dict[Channel, Decoder] = {}
        system = self._scenario.system()
        for j in self._meeting.hears:
            sizes = {"nx": system.nx, "ny": system.by_id[j].ny}
            for stage in self._method.stages:
                self._decoders[j, stage.name] = Decoder(stage, j, sizes=sizes, ids=self._graph.neighbours(j))
                self._inbox.subscribe((j, stage.name), keys.stage_key(run, j, stage.name))
        self._kept = [
            session.declare_queryable(keys.status_key(run, self.id), on_zenoh_thread(partial(self._note, "status?"))),
            session.declare_queryable(keys.history_key(run, self.id), on_zenoh_thread(partial(self._note, "history?"))),
            session.liveliness().declare_subscriber(
                keys.node_token(run, "*"), on_zenoh_thread(partial(self._note, "token")), history=True
            ),
            session.liveliness().declare_subscriber(
                keys.recorder_token(run), on_zenoh_thread(partial(self._note, "recorder")), history=True
            ),
        ]
        self._kept.append(session.liveliness().declare_token(keys.node_token(run, self.id)))

    def _note(self, kind: str, about: Any) -> None:
        self._inbox.notify((kind, about))

    def _join(self) -> Start | None:
        """Wait until it is time to begin; None if stopped before."""
        next_poll = next_word = time.time_ns()
        next_word += 5_000_000_000
        while not self._stopping:
            self._handle_notices()
            now = time.time_ns()
            start = self._meeting.start(now)
            if start is not None:
                return start
            if now >= next_poll:
                next_poll = now + POLL_NS
                for j in self._meeting.present:
                    self._query(keys.status_key(self._options.run, j), "status!", j)
                self._tell_status(now)
            if now >= next_word:
                next_word = now + 5_000_000_000
                log.warning("waiting for %s", ", ".join(self._meeting.missing()))
            self._inbox.rest(next_poll)
        return None

    def _take_steps(self, start: Start) -> None:
        scenario, period = self._scenario, self._scenario.timing.period_ns
        stages = [stage.name for stage in self._method.stages]
        timing = scenario.timing
        waits = tuple(timing.timeout_ns if period is None else timing.deadline_ns(stage) for stage in stages)
        self._meeting.epoch_ns = start.epoch_ns
        method = self._method(Setting(self.id, scenario.system(), self._graph, start.born))
        neighbourhood = self._graph.neighbours(self.id)
        node = self._node = Node(
            self.id, neighbourhood, method, Patience(waits, period is not None), born=start.born, expected=start.expected
        )
        for j in self._meeting.present & self._meeting.hears:
            node.back(j)
        self._phase = Phase.RUNNING
        gc.collect()
        gc.freeze()
        gc.set_threshold(GARBAGE_THRESHOLD)
        self._begun_ns = self._ended_ns = time.time_ns()
        self._carry_out([node.event("started", self._begun_ns, epoch_ns=start.epoch_ns)])
        step = start.born
        while not self._stopping and (self._options.steps is None or step <= self._options.steps):
            due = None
            if period is not None:
                due = start.epoch_ns + step * period
                step, due = self._await_step(step, due, period)
                if self._stopping:
                    break
            self._take_step(node, step, due)
            step += 1

    def _await_step(self, step: int, due: int, period: int) -> tuple[int, int]:
        """Sleep until a paced step is due; if its whole period is over already, the step that is due now."""
        while not self._stopping and not self._inbox.rest(due):
            self._handle_notices()
        late = (time.time_ns() - due) // period
        if late > 0:
            self._skipped += late
            step, due = step + late, due + late * period
        self._inbox.drain(self._decoders, self._take)
        return step, due

    def _take_step(self, node: Node, step: int, due: int | None) -> None:
        now = time.time_ns()
        y = self._source.read(step, due if due is not None else now)
        began = time.perf_counter_ns()
        if self._tells_truth:
            self._tell_truth(step, now)
        self._carry_out(node.begin(step, y, now, due))
        for j in node.silent:
            self._inbox.drain([channel for channel in self._decoders if channel[0] == j], self._take)
        while node.stage is not None and not self._stopping:
            self._await_message(node)
        if node.stage is None:
            self._latencies.add(time.perf_counter_ns() - began)
            self._ended_ns = time.time_ns()
            if self._ended_ns - self._told_ns > REPORT_NS:
                self._tell_status(self._ended_ns)

    def _await_message(self, node: Node) -> None:
        """Wait for one message, the deadline or a notice, and act on it."""
        if self._inbox.notices:
            self._handle_notices()
        awaiting, stage = node.awaiting, node.stage
        if not awaiting or stage is None:
            self._carry_out(node.tick(time.time_ns()))
            return
        channel = (awaiting[0], stage)
        data = self._inbox.wait(channel, node.deadline)
        if data is not None:
            self._take(channel, data)
        elif node.deadline is not None and time.time_ns() >= node.deadline:
            # what stands in the channels has arrived in time: it was only not looked at yet
            self._inbox.drain([(j, stage) for j in awaiting], self._take)
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
            return
        self._carry_out(node.receive(message, time.time_ns()))

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Ask):
                self._query(keys.history_key(self._options.run, effect.node), "history!", effect.node)
                continue
            self._publish[effect.stage](encode(effect))
            if "x" in effect.fields:
                self._compare(effect)

    def _compare(self, message: Message) -> None:
        """Set an estimate beside the truth, where that is known."""
        truth = self._source.truth(message.step)
        if truth is None:
            return
        errors = self._errors.get(message.stage)
        if errors is None:
            errors = self._errors[message.stage] = Errors()
        errors.add(cast(Array, message.fields["x"]) - truth, cast("Array | None", message.fields.get("P")))

    def _tell_truth(self, step: int, now: int) -> None:
        x = self._source.truth(step)
        message = Message(TRUTH_SENDER, step, TRUTH.name, self._truths, 1, now, {"x": x})
        self._truths += 1
        self._publish[TRUTH.name](encode(message))

    def _query(self, key: str, kind: str, about: NodeId) -> None:
        """Ask; the answer comes as a notice."""
        self._session.get(
            key,
            on_zenoh_thread(lambda reply: self._note(kind, (about, reply))),
            timeout=ANSWER_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def _handle_notices(self) -> None:
        notices = self._inbox.notices
        while notices:
            notice = notices.popleft()
            if notice is None:
                continue
            kind, about = notice
            try:
                self._handlers[kind](self, about)
            except MessageError as error:
                self._overheard[error.reason] += 1

    def _on_token(self, sample: Any) -> None:
        node = self._scenario.node_id(keys.parse_token(str(sample.key_expr)).node or "")
        if node not in self._meeting.linked:
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self._on_gone(node)
            return
        self._meeting.came(node)
        if self._node is not None:
            self._query(keys.status_key(self._options.run, node), "status!", node)

    def _on_gone(self, node: NodeId) -> None:
        self._meeting.went(node)
        if self._node is None or node not in self._meeting.hears:
            return
        # its last messages may be waiting behind this notice
        self._inbox.drain([channel for channel in self._decoders if channel[0] == node], self._take)
        now = time.time_ns()
        self._carry_out([self._node.event("gone", now, of=node), *self._node.gone(node, now)])

    def _on_recorder(self, sample: Any) -> None:
        self._meeting.recorder = sample.kind == zenoh.SampleKind.PUT

    def _on_recorder_status(self, about: object) -> None:
        """It is only waited for."""

    def _on_status(self, about: tuple[NodeId, Any]) -> None:
        reply = about[1].ok
        if reply is None:
            return
        status = Status.decode(reply.payload.to_bytes())
        if status.node != about[0]:
            raise MessageError("wrong_node", f"{status.node} answers for {about[0]}")
        if self._node is None:
            self._meeting.answered(status)
            return
        try:
            check_identity(self.id, self._meeting.identity, status)
        except InputError as error:
            log.error("%s", error)
            self._strangers.add(status.node)
            return
        self._strangers.discard(status.node)
        if status.node in self._meeting.hears and status.phase is not Phase.DONE:
            self._node.back(status.node)

    def _on_history(self, about: tuple[NodeId, Any]) -> None:
        of, reply = about[0], about[1].ok
        if reply is None or self._node is None:
            return
        answer = HistoryAnswer.decode(reply.payload.to_bytes(), frozenset(self._graph.neighbours(of)))
        self._node.learn_history(of, answer.born, answer.end, answer.runs)

    def _answer_status(self, query: Any) -> None:
        query.reply(keys.status_key(self._options.run, self.id), self.status().encode())

    def _answer_history(self, query: Any) -> None:
        node = self._node
        own = node.ledger.of(self.id) if node is not None else None
        if node is not None and own is not None:
            answer = HistoryAnswer(node.born, own.last, own.runs(own.last))
            query.reply(keys.history_key(self._options.run, self.id), answer.encode())

    _handlers: dict[str, Callable[[LiveNode, Any], None]] = {
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

    def _leave(self) -> None:
        """Tell how it went, and stay until everybody that listens has the last messages.

        An answer to a query that was put after the last message comes after that message has arrived: links keep
        the order.
        """
        node = self._node
        if node is None:
            raise RunError("left before it had begun")
        self._phase = Phase.DONE
        self._carry_out([node.event("stopped", time.time_ns(), **self._last_words())])
        run = self._options.run
        waiting = {j for j in self._graph.listeners(self.id) if j in self._meeting.present}
        for j in waiting:
            self._query(keys.status_key(run, j), "status!", j)
        if self._meeting.recorder:
            waiting.add(RECORDER)
            self._query(keys.recorder_status_key(run), "recorder!", RECORDER)
        self._tell_status(time.time_ns())
        end = time.time_ns() + int(LEAVE_S * 1e9)
        while waiting and time.time_ns() < end:
            answers = [about[0] for kind, about in filter(None, self._inbox.notices) if kind in {"status!", "recorder!"}]
            self._handle_notices()
            waiting.difference_update(answers)
            waiting &= self._meeting.present | ({RECORDER} if self._meeting.recorder else set())
            if waiting:
                self._inbox.rest(min(end, time.time_ns() + POLL_NS))

    def _last_words(self) -> dict[str, object]:
        report = self.report()
        return {"sent": report.sent, "edges": report.edges, "completed": report.completed, "skipped": report.skipped}


def links_of(scenario: Scenario) -> Sequence[tuple[NodeId, NodeId]]:
    """The pairs of nodes that have a link: graph neighbours, or all, as the scenario says."""
    graph = METHODS[scenario.method.name].network(scenario.network)
    return Network.complete(graph.ids).links() if scenario.transport.mesh == "full" else graph.links()


def linked(scenario: Scenario, node: NodeId) -> tuple[NodeId, ...]:
    """The nodes that `node` has a link with."""
    return tuple(a if b == node else b for a, b in links_of(scenario) if node in (a, b))


def endpoints_of(
    scenario: Scenario, node: NodeId, listen: Sequence[str] | None = None, connect: Sequence[str] | None = None
) -> Endpoints:
    """Where a node listens and whom it dials: what is given, and else what the scenario says.

    Of two linked nodes the one with the larger id dials, so that there is one link. A user's own Zenoh configuration,
    where the scenario names one, rules alone unless endpoints are given.
    """
    if scenario.transport.zenoh_config and not listen and not connect:
        return Endpoints()
    rank = {i: number for number, i in enumerate(scenario.ids)}
    dialled = [scenario.endpoint(j) for j in linked(scenario, node) if rank[j] < rank[node]]
    return Endpoints(tuple(listen or (scenario.endpoint(node),)), tuple(dialled if connect is None else connect))


def recorder_endpoints(
    scenario: Scenario, connect: Sequence[str] | None = None, listen: Sequence[str] | None = None
) -> Endpoints:
    """Whom the recorder dials: every node, for peers pass nothing on."""
    if scenario.transport.zenoh_config and not listen and not connect:
        return Endpoints()
    return Endpoints(tuple(listen or ()), tuple(connect or [scenario.endpoint(i) for i in scenario.ids]))
