"""The live world: one node on Zenoh, on the wall clock.

    join     link up, wait until everybody is there, agree on the epoch (`presence`, `meeting`)
    steps    measure, feed the node what arrives, publish what it says (`inbox`, `node`)
    leave    tell how it went, and stay until the neighbours have the last messages

Everything happens on one thread. Zenoh's callbacks only leave notices, which are handled between messages.
"""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import count

from zfusion import keys
from zfusion.drivers.account import Account, make_node, truth_message
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.key_source import KeySource
from zfusion.drivers.meeting import Start
from zfusion.drivers.metrics import NodeReport, told_estimate
from zfusion.drivers.presence import Presence, make_meeting
from zfusion.drivers.sources import Source, open_source
from zfusion.drivers.transport import open_session, publisher
from zfusion.errors import InputError, MessageError
from zfusion.messages import Decoder, decode_any, encode
from zfusion.methods import METHODS
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import LOOKAHEAD, Ask, Effect, Node
from zfusion.stages import ESTIMATE, EVENT, TRUTH, Message
from zfusion.status import Phase, Status

REPORT_NS = 250_000_000
"""How often a node tells its launcher how it is doing."""

AHEAD = 65_536
"""Messages kept here that are too far ahead for the node to take: what a swarm says in half a minute, while a node that
was restarted follows it."""

GARBAGE_THRESHOLD = 100_000
"""Allocations between two garbage collections. A round makes no cycles; a collection costs as much as a round."""

Channel = tuple[NodeId, str]
"""(neighbour, stage)."""


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
        self.phase = Phase.JOINING
        self.node: Node | None = None
        self.stopping = False
        self._account: Account | None = None
        self._decoders: dict[Channel, Decoder] = {}
        self._ahead: list[tuple[int, int, Channel, bytes, Message]] = []
        self._order = count()
        self._last_heard: dict[Channel, bytes] = {}
        self._estimates: list[Message] = []
        self._told_ns = 0
        self._period_ns = scenario.timing.period_ns or 0
        """0 for a free-running node."""
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
        epoch_ns = options.epoch_ns if options.epoch_ns is not None else scenario.timing.epoch_ns
        self._meeting = make_meeting(scenario, self._graph, node, needs_recorder=options.recorder, epoch_ns=epoch_ns)
        self._presence = Presence(self, self._meeting, scenario, self._graph, options.run, self._session, self._inbox)

    def run(self) -> NodeReport:
        """Join, take the steps, leave; what became of it all.

        Raises InputError where a neighbour runs another scenario or version, RunError where the source fails.
        """
        with self._session:
            try:
                self._declare()
                start = self._presence.join()
                if start is not None:
                    node = self._begin(start)
                    self._take_steps(node, start)
                    self._leave(node)
            finally:
                self._inbox.close()
                self._source.close()
                self._presence.close()
        return self._report()

    def stop(self) -> None:
        """End after what is being done now: at the latest at the next message or deadline."""
        self.stopping = True
        self._inbox.notify(None)

    def status(self) -> Status:
        """How the node is doing."""
        node, meeting = self.node, self._meeting
        return Status(
            node=self.id,
            fingerprint=self._scenario.fingerprint,
            phase=self.phase,
            step=node.step if node else 0,
            born=node.born if node else 0,
            epoch_ns=meeting.epoch_ns,
            ready=meeting.ready,
            completed=node.completed if node else 0,
            fallbacks=node.fallbacks if node else 0,
            estimate=told_estimate(node) if node else {},
        )

    def _report(self) -> NodeReport:
        node, account = self.node, self._account
        if node is None or account is None:
            return NodeReport.of_nothing(self.id)
        while self._ahead:
            *_, message = heappop(self._ahead)
            node.counters[message.node].refused["too_early"] += 1
        report = account.report()
        report.overheard = dict(Counter(report.overheard) + self._presence.overheard)
        return report

    def _subscribe(self, node: NodeId, key: str, ny: int) -> Source:
        """The source of the readings that a program of the user's publishes."""
        return KeySource(self._session, node, key, ny, 0.0 if self._period_ns else self._scenario.timing.timeout_s)

    def _declare(self) -> None:
        """Publishers and subscribers, and then: be there."""
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
        self._presence.declare()

    def _begin(self, start: Start) -> Node:
        """Make the node, and say that it is there."""
        self._meeting.epoch_ns = start.epoch_ns
        node = make_node(self._scenario, self._graph, self.id, born=start.born, expected=start.expected)
        for j in self._meeting.present & self._meeting.hears:
            node.back(j)
        gc.collect()
        gc.freeze()
        gc.set_threshold(GARBAGE_THRESHOLD)
        now, period = time.time_ns(), self._period_ns
        first = max(now, start.epoch_ns + start.born * period) if period else now
        self.node, self._account, self.phase = node, Account(node, self._source, first), Phase.RUNNING
        self._carry_out([node.event("started", now, epoch_ns=start.epoch_ns)])
        self.tell_status()
        return node

    def _take_steps(self, node: Node, start: Start) -> None:
        """From the first step of this life to the last of the run, the second half of them counting as settled."""
        account, period, last = self._account, self._period_ns, self._options.steps
        assert account is not None  # `_begin` has made it
        middle = None if last is None else (start.born + last + 1) // 2
        step = start.born
        while not self.stopping and (last is None or step <= last):
            due = None
            if period:
                due = self._await_due(start.epoch_ns + step * period)
                skipped = (time.time_ns() - due) // period  # its whole period is over
                if skipped > 0 and not self.stopping:
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
        while not self.stopping and not self._inbox.rest(due):
            self._presence.handle_notices()
        self._inbox.drain(self._decoders, self._take)
        return due

    def _take_step(self, node: Node, account: Account, step: int, due: int | None) -> None:
        if self.stopping:
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
        while (stage := node.stage) is not None and not self.stopping:
            self._await_messages(node, stage)
        if node.stage is None:
            latency = time.perf_counter_ns() - began
            now = time.time_ns()
            account.complete(now if due is None else max(now, due + self._period_ns), latency)
            if now - self._told_ns > REPORT_NS:
                self.tell_status()
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
        self._presence.handle_notices()
        overdue = node.deadline is not None and time.time_ns() >= node.deadline
        # What stands in the channels has arrived in time, it was only not looked at yet; and none must run full.
        self._inbox.drain(self._decoders, self._take)
        if overdue:
            self._carry_out(node.tick(time.time_ns()))

    def _take(self, channel: Channel, data: bytes) -> None:
        """Feed the node a message; what is not one is counted."""
        node = self.node
        if node is None:
            return
        try:
            message = self._decoders[channel].decode(data)
        except MessageError as error:
            node.counters[channel[0]].refused[error.reason] += 1
            return
        if channel[0] in self._presence.strangers:
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
                self._presence.ask_history(effect.node)
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

    def part_with(self, j: NodeId) -> None:
        """A neighbour is gone.

        Its last messages may be waiting still. They are told to all: they may not have come to the recorder.
        """
        node = self.node
        if node is None:
            return
        channels = [channel for channel in self._decoders if channel[0] == j]
        self._inbox.drain(channels, self._take)
        last = [decode_any(self._last_heard[channel]) for channel in channels if channel in self._last_heard]
        now = time.time_ns()
        self._carry_out([node.event("gone", now, of=j, last=last), *node.gone(j, now)])

    def tell_status(self) -> None:
        """Tell the launcher how the node is doing."""
        self._told_ns = time.time_ns()
        if self._tell is not None:
            self._tell(self.status())

    def _leave(self, node: Node) -> None:
        """Tell how it went, and see that everybody has heard everything."""
        assert self._account is not None  # `_begin` has made it
        self.phase = Phase.DONE
        self._carry_out([node.event("stopped", time.time_ns(), **self._account.last_words())])
        self.tell_status()
        self._presence.take_leave()
        self._inbox.drain(self._decoders, self._take)
