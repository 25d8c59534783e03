"""The live world: one node on Zenoh, on the wall clock.

    join     link up, wait until everybody is there, agree on the epoch (`presence`, `meeting`)
    steps    measure, feed the node what arrives, publish what it says (`inbox`, `node`)
    leave    tell how it went, and stay until the neighbours have the last messages

Everything happens on one thread. Zenoh's callbacks only leave notices, which are handled between messages.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from itertools import count
from typing import Any, cast

from zfusion import keys
from zfusion.drivers.account import Account, make_node, truth_message
from zfusion.drivers.clocks import Clock, machine
from zfusion.drivers.complaints import Complaints
from zfusion.drivers.credentials import node_name
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.health import health
from zfusion.drivers.hearing import EmulatedHearing, Heard, Hearing
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.key_source import KeySource
from zfusion.drivers.meeting import Start
from zfusion.drivers.meters import MARKED_EVERY
from zfusion.drivers.metrics import NodeReport, told_estimate
from zfusion.drivers.misfortune import Blow, Misfortune
from zfusion.drivers.presence import Presence, make_meeting
from zfusion.drivers.sources import Source, open_source
from zfusion.drivers.transport import RECEIPT, closing, never_linger, open_session, prober, publisher
from zfusion.errors import InputError
from zfusion.links import LinkNetwork, ideal, links_of
from zfusion.messages import Decoder, decode_any, encode
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId, sorted_ids
from zfusion.node import LOOKAHEAD, Ask, Effect, Node
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH, Message
from zfusion.status import Counts, Phase, Status

log = logging.getLogger(__name__)

REPORT_NS = 250_000_000
"""How often a node tells its launcher how it is doing."""

LOOK_NS = 50_000_000
"""How often a node that rests until its next step looks at what comes: a channel has room for many messages, and how
large they are is the sender's choice."""

LINGERLESS_NS = 1_000_000_000
"""How often a node sees to the links that it was not told of; shorter than their lease."""

AHEAD = 65_536
"""Messages kept here that are too far ahead for the node to take: what a swarm says in half a minute, while a node that
was restarted follows it."""

MOST_HELD = 16
"""Messages of a neighbour that is gone, held by its link, that are told: an event is of bounded size."""

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
    first_step: int = 1
    """With which to begin, unless it is with the others'."""
    steps: int | None = None
    """Last step; None: until told to stop."""
    emulate: bool = True
    """Whether the node is to do to its neighbours' messages what the scenario's links say; False: the network does."""
    health_s: float = 0.0
    """How often to tell of its health; 0: never."""


class LiveNode:
    """One node of a live swarm. `run` takes it from joining to leaving; `stop` ends it, from any thread."""

    def __init__(
        self,
        scenario: Scenario,
        node: NodeId,
        options: LiveOptions,
        tell: Callable[[Status], None] | None = None,
        announce: Callable[[Blow], None] | None = None,
        tell_health: Callable[[Mapping[str, Any]], None] = lambda _: None,
    ) -> None:
        """`tell` is called with the node's status a few times a second; `announce` with what fells it, just before;
        `tell_health` with `health.health`, as often as `options` say.

        Raises InputError where Zenoh does not open, or the sensor's source or a link's, and for a plan that stops the
        node where nobody is there to set it going again.
        """
        self.id = node
        self._scenario, self._options, self._tell = scenario, options, tell
        self._method = chosen(scenario)
        self._graph = self._method.network(scenario.network)
        self.phase = Phase.JOINING
        self.node: Node | None = None
        self.stopping = False
        self._account: Account | None = None
        self._ahead: list[tuple[int, int, Heard]] = []
        self._most_ahead = 0
        self._order = count()
        self._last_heard: dict[tuple[NodeId, str], bytes] = {}
        self._stamped = False
        """Whether receivers are asked to stamp this step's messages."""
        self._estimates: list[Message] = []
        self._told_ns = self._lingerless_ns = 0
        self._tell_health, self._health_ns = tell_health, round(options.health_s * 1e9)
        self._told_health_ns = 0
        self._period_ns = scenario.timing.period_ns or 0
        """0 for a free-running node."""
        self._patient = scenario.timing.late == "wait"
        """Whether a paced step begins late, if it has to, rather than not at all."""
        self._complaints = Complaints()
        self._misfortune = Misfortune(scenario, node, announce)
        link = links_of(scenario) if options.emulate else ideal
        self._session = open_session(
            options.endpoints,
            low_latency=scenario.transport.preset == "lowlatency",
            config_file=scenario.zenoh_config,
            name=node_name(node),
        )
        try:
            self._source: Source = open_source(scenario, node, self._subscribe)
        except InputError:
            self._session.close()  # type: ignore[no-untyped-call]
            raise
        self._clock = Clock()
        self._now = self._clock.now
        self._inbox = Inbox(self._session, self._clock)
        self._links = link if isinstance(link, LinkNetwork) else None
        self._hearing = self._hears()
        epoch_ns = options.epoch_ns if options.epoch_ns is not None else scenario.timing.epoch_ns
        self._meeting = make_meeting(
            scenario,
            self._graph,
            node,
            needs_recorder=options.recorder,
            epoch_ns=epoch_ns,
            first_step=options.first_step,
        )
        why = prober(options.endpoints, scenario.zenoh_config)
        self._presence = Presence(
            self, self._meeting, scenario, self._graph, options.run, self._session, self._inbox, self._clock, why
        )

    def run(self) -> NodeReport:
        """Join, take the steps, leave; what became of it all.

        Raises InputError where a neighbour runs another scenario or version, RunError where the source fails.
        """
        with closing(self._session):
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
        return self.report()

    def stop(self) -> None:
        """End after what is being done now: at the latest at the next message or deadline."""
        self.stopping = True
        self._inbox.notify(None)

    def keep_to(self, epoch_ns: int) -> None:
        """Begin in the midst of a run whose step 0 was at `epoch_ns`, if it has not begun; from any thread."""
        if self.phase is Phase.JOINING:
            self._meeting.keep_to(epoch_ns)
            self._inbox.notify(None)

    def status(self, *, counted: bool = False) -> Status:
        """How the node is doing; what it has `counted` where that is wanted."""
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
            machine=None if self._misfortune.clock_goes_wrong else machine(),
            counts=self._counts() if counted else None,
            line_ns=self._clock.line_ns,
            clock_jumps=self._clock.jumps,
            clock_offset_exceeded=self._presence.clocks.exceeded,
        )

    def health(self, node: Node, account: Account) -> dict[str, Any]:
        """See `health.health`."""
        inbox = self._inbox
        queues = {
            "ahead": len(self._ahead),
            "held": self._hearing.holds,
            "posted": len(inbox.posted),
            "notices": len(inbox.notices),
        }
        return health(node, account, queues=queues, overrun=inbox.overrun, now_ns=self._now())

    def report(self) -> NodeReport:
        """How it has gone so far."""
        node, account = self.node, self._account
        if node is None or account is None:
            return NodeReport.of_nothing(self.id)
        report = account.report()
        for *_, heard in self._ahead:
            refused = report.edges[str(heard.message.node)]["refused"]
            refused["too_early"] = refused.get("too_early", 0) + 1
        report.overheard = self._overheard(report.overheard)
        report.clocks = self._clocks()
        report.clock_jumps, report.clock_offset_exceeded = self._clock.jumps, self._presence.clocks.exceeded
        report.queues = self._queues()
        if self._links is not None:
            report.emulated = {str(j): dict(counts) for (j, _), counts in self._links.counters.items() if counts}
        return report

    def _counts(self) -> Counts | None:
        """What was counted so far; None before the first step."""
        if self._account is None:
            return None
        counts = self._account.counts()
        return replace(
            counts, overheard=self._overheard(counts.overheard), clocks=self._clocks(), queues=self._queues()
        )

    def _overheard(self, by_source: Mapping[str, int]) -> dict[str, int]:
        here = Counter(overrun=self._inbox.overrun, unheeded=self._presence.unheeded)
        return dict(Counter(by_source) + self._presence.overheard + here)

    def _clocks(self) -> dict[str, dict[str, float]]:
        return {str(j): told for j, offset in self._presence.clocks.offsets.items() if (told := offset.told())}

    def _queues(self) -> dict[str, int]:
        return {"ahead": self._most_ahead, "held": self._hearing.most_held}

    def _hears(self) -> Hearing:
        """Directly, or through the links that the scenario describes."""
        if self._links is None:
            return Hearing(self._inbox, self)
        return EmulatedHearing(self._inbox, self, self.id, self._links, self._misfortune.timeline, self._clock)

    def _subscribe(self, node: NodeId, key: str, ny: int) -> Source:
        """The source of the readings that a program of the user's publishes."""
        return KeySource(self._session, node, key, ny, 0.0 if self._period_ns else self._scenario.timing.timeout_s)

    def _declare(self) -> None:
        """Publishers and subscribers, and then: be there."""
        run, session, system = self._options.run, self._session, self._scenario.system()
        stages = [stage.name for stage in self._method.stages]
        published = (*stages, *(stage.name for stage in (ESTIMATE, EVENT, ARRIVALS, REVISED)))
        self._timed = {*stages, ESTIMATE.name}
        self._publish = {stage: publisher(session, keys.stage_key(run, self.id, stage)).put for stage in published}
        self._tells_truth = self._scenario.truth_known and self.id == self._graph.ids[0]
        if self._tells_truth:
            self._publish[TRUTH.name] = publisher(session, keys.truth_key(run)).put
        for j in sorted(self._meeting.hears, key=self._graph.ids.index):
            sizes = system.sizes(j)
            for stage in self._method.stages:
                decoder = Decoder(stage, j, sizes=sizes, ids=self._graph.neighbours(j))
                self._hearing.subscribe((j, stage.name), keys.stage_key(run, j, stage.name), decoder)
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
        now, period = self._now(), self._period_ns
        first = max(now, start.epoch_ns + start.born * period) if period else now
        exchanged = [stage.name for stage in self._method.stages]
        every = MARKED_EVERY if not period and self._hearing.stamped else 1
        self.node, self.phase = node, Phase.RUNNING
        self._account = Account(node, self._source, first, stages=exchanged, marked_every=every)
        self._carry_out([node.event("started", now, epoch_ns=start.epoch_ns)])
        log.info("begins with step %d, expecting %s", start.born, ", ".join(map(str, sorted_ids(start.expected))))
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
            if (
                self._inbox.notices
            ):  # who finds all messages there, being behind, never waits: and must still see to them
                self._presence.handle_notices()
            if period:
                self._clock.set_ahead(self._misfortune.clock_ns(step))
                due = self._await_due(start.epoch_ns + step * period)
            self._suffer(node, step, start.epoch_ns)
            if due is not None and not self._patient:
                skipped = (self._now() - due) // period  # its whole period is over
                if skipped > 0 and not self.stopping:
                    skipped = skipped if last is None else min(skipped, last + 1 - step)
                    account.skipped += skipped
                    step += skipped
                    continue
            if middle is not None and step >= middle:
                middle = None
                account.settle(self._now())
            self._take_step(node, account, step, due)
            step += 1

    def _await_due(self, due: int) -> int:
        """Sleep until a paced step is due, and take what comes meanwhile: it is not to fill the memory."""
        while True:
            self._hearing.drain(until_ns=due)  # what comes later is looked at when the step has begun: it may be late
            now = self._now()
            if self.stopping or now >= due:
                return due
            if not self._hearing.rest(min(due, now + LOOK_NS)):
                self._presence.handle_notices()

    def _suffer(self, node: Node, step: int, epoch_ns: int) -> None:
        """What is planned to happen to this node when it is to begin the step."""
        if not self._misfortune or self.stopping:
            return
        for data in self._misfortune.news(node.born, step):
            self._carry_out([node.event("fault", self._now(), **data)])
        if self._misfortune.kills(node.born, step):
            self._tell_arrivals(ended=True)
        self._misfortune.strike(node.born, step, epoch_ns)

    def _take_step(self, node: Node, account: Account, step: int, due: int | None) -> None:
        if self.stopping:
            return
        y = self._source.read(step, self._now() if due is None else due)
        began, now = time.perf_counter_ns(), self._now()
        if self._tells_truth:
            self._tell_truth(node, step, now)
        meter = account.meter
        meter.begin(step, now)
        self._stamped = self._hearing.stamped and meter.marks(step)
        # However late it begins: what has come in time is to be looked at before the first deadline counts.
        self._carry_out(node.begin(step, y, now if due is None else due, due))
        if self._ahead:
            self._catch_up(node)
        for j in node.silent:
            self._hearing.drain(j)
        while (stage := node.stage) is not None and not self.stopping:
            self._await_messages(node, stage)
        if node.stage is None:
            latency = time.perf_counter_ns() - began
            now = self._now()
            meter.finish()
            account.complete(now if due is None else max(now, due + self._period_ns), latency)
            self._tell_arrivals()
            if now - self._told_ns > REPORT_NS:
                self.tell_status()
            if self._health_ns and now - self._told_health_ns >= self._health_ns:
                self._told_health_ns = now
                self._tell_health(self.health(node, account))
        for estimate in self._estimates:
            account.compare(estimate)
        self._estimates.clear()

    def _await_messages(self, node: Node, stage: str) -> None:
        """Wait for the messages of a stage, the deadline or a notice, and act on it."""
        if self._hearing.wait(node, stage):
            return
        self._presence.handle_notices()
        deadline, now = node.deadline, self._now()
        # What stands in the channels has arrived in time, it was only not looked at yet; and none must run full.
        self._hearing.drain()
        if deadline is not None and now >= deadline and node.deadline == deadline:
            self.let_close(now)

    def let_close(self, now_ns: int) -> None:
        """The deadline of the present stage has passed, and all that came in time is taken."""
        node, account = self.node, self._account
        if node is None or account is None or node.deadline is None:
            return
        account.meter.there(now_ns)
        # With steps that have times only what is over at that deadline: of a later stage, more may be in time still.
        self._carry_out(node.tick(node.deadline if self._period_ns else now_ns))

    def hear(self, heard: Heard) -> None:
        """A neighbour's message is there."""
        node, message = self.node, heard.message
        if node is None:
            return
        if message.node in self._presence.strangers:
            node.counters[message.node].refused["other_scenario"] += 1
        elif message.step > node.step + LOOKAHEAD and len(self._ahead) < AHEAD:
            heappush(self._ahead, (message.step, next(self._order), heard))
            self._most_ahead = max(self._most_ahead, len(self._ahead))
        else:
            self._feed(node, heard)

    def _feed(self, node: Node, heard: Heard) -> None:
        """Give the node a message, which is in time until the driver says that time is up."""
        channel, data, message, looked_ns, received_ns, due_ns = heard
        if message.step >= node.step:
            self._last_heard[channel] = data
        account, taken, now = self._account, node.taken, self._now()
        assert account is not None  # it is there as long as the node is
        account.meter.there(looked_ns)
        if node.deadline is not None and now >= node.deadline:
            now = node.deadline - 1
        effects = node.receive(message, now)
        if node.taken != taken:
            account.meter.took(message, looked_ns, received_ns, due_ns)
        self._carry_out(effects)

    def _catch_up(self, node: Node) -> None:
        """Feed the node what was too far ahead of it and is not any more."""
        while self._ahead and self._ahead[0][0] <= node.step + LOOKAHEAD:
            self._feed(node, heappop(self._ahead)[2])

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Ask):
                self._presence.ask_history(effect.node)
                continue
            stage = effect.stage
            if stage in self._timed:
                self._put(effect)
            else:
                self._publish[stage](encode(effect))
            if "x" in effect.fields:
                self._estimates.append(effect)

    def _put(self, message: Message) -> None:
        """Publish a message of a step, with the time at which that is done."""
        assert self._account is not None  # steps are taken with one
        if self._misfortune and (slow_s := self._misfortune.slow_s(message.step)):
            time.sleep(slow_s)
        now = self._now()
        self._account.meter.put(now)
        if self._stamped and message.stage != ESTIMATE.name:
            self._publish[message.stage](encode(message, now), timestamp_instrumentation=RECEIPT)
        else:
            self._publish[message.stage](encode(message, now))

    def _tell_arrivals(self, *, ended: bool = False) -> None:
        """Tell what was measured of the neighbours' messages, when it is time to."""
        assert self._account is not None  # steps are taken with one
        for message in self._account.arrivals(self._now(), ended=ended):
            self._presence.clocks.mark(cast("dict[str, Any]", message.fields["data"]))
            self._publish[ARRIVALS.name](encode(message))

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
        log.warning("node %s is gone", j)
        self._hearing.drain(j)
        heard = [self._last_heard[channel] for channel in self._hearing.channels(j) if channel in self._last_heard]
        last = [decode_any(data) for data in (*heard, *self._hearing.held(j)[:MOST_HELD])]
        now = self._now()
        if self._account is not None:
            self._account.meter.there(now)
        self._carry_out([node.event("gone", now, of=j, last=last), *node.gone(j, now)])

    def tell_status(self) -> None:
        """Tell the launcher how the node is doing."""
        self._look_at_clock()
        self._told_ns = self._now()
        if self._told_ns >= self._lingerless_ns + LINGERLESS_NS:
            self._lingerless_ns = self._told_ns
            self._complain()
            never_linger()  # observers have links, too, and show no token
        self._presence.read_clocks(self._told_ns)
        if self._tell is not None:
            self._tell(self.status())

    def _complain(self, *, ended: bool = False) -> None:
        """Log what was refused."""
        if self.node is not None and self._account is not None:
            refused: dict[str, Mapping[str, int]] = {f"node {j}": c.refused for j, c in self.node.counters.items()}
            refused["elsewhere"] = self._overheard(self._source.counters)
            self._complaints.look(self._now(), refused, ended=ended)

    def _look_at_clock(self) -> None:
        """See whether the machine's clock has jumped; this node's time goes on as before, but it is told."""
        jump = self._clock.look()
        if jump is not None and self.node is not None:
            log.warning("the machine's clock has jumped: %s", jump)
            self._carry_out([self.node.event("clock_jump", self._now(), **jump._asdict())])

    def _leave(self, node: Node) -> None:
        """Tell how it went, and see that everybody has heard everything."""
        assert self._account is not None  # `_begin` has made it
        self.phase = Phase.DONE
        self._tell_arrivals(ended=True)
        self._carry_out([node.event("stopped", self._now(), **self._account.last_words())])
        self.tell_status()
        self._presence.take_leave()
        self._hearing.end()
        self._complain(ended=True)
        log.info("ends: %d steps completed, %d skipped", node.completed, self._account.skipped)
