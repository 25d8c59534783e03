"""The recorder: a process that subscribes to a whole run and writes what comes, bytes as they are.

It shows the same liveliness token all the while, so that nodes begin only when it is there, and answers a query when
all that was published before it has arrived, so that nodes leave only when it has their last messages.

When it cannot follow, senders wait for it, and nothing is lost; or they do not, and what is too much is dropped and
counted (`recording.when_full`). When it can write no more (disk full), it goes on to receive and to count: a swarm is
not to suffer from its recorder.
"""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from zfusion import keys
from zfusion.drivers.clocks import Clock
from zfusion.drivers.credentials import RECORDER_NAME
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.metrics import RecorderReport
from zfusion.drivers.probe import WORD_NS, Waiting
from zfusion.drivers.transport import closing, never_linger, on_zenoh_thread, open_session, prober
from zfusion.errors import MessageError, RecordingError, RunError
from zfusion.gaps import Gaps
from zfusion.messages import MAX_MESSAGE_BYTES, Decoder, decode_any
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording.reader import Recording
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH, TRUTH_SENDER, Stage
from zfusion.status import RecorderStatus

log = logging.getLogger(__name__)

CAPACITY = 65_536
"""Messages that wait for the disk where senders wait when it is full: seconds of a large swarm, tens of MB."""

GRACE_NS = 5_000_000_000
"""How long nodes that vanished without a word, or with their router, which is back, may take to come back: a recorder
that stood still finds all links broken."""

MAX_NOTICES = 65_536
"""Questions and news of nodes that wait; beyond it they are dropped, and counted: whoever asks can ask again."""

CHANNEL = "all"


@dataclass(slots=True)
class _Topic:
    """One key of the run."""

    node: NodeId | None
    """None for the truth."""
    stage: Stage
    received: int = 0
    recorded: int = 0
    decoder: Decoder | None = None


class Recorder:
    """Records a run until `stop`, or until every node of the scenario has come and gone."""

    def __init__(
        self,
        scenario: Scenario,
        run: str,
        endpoints: Endpoints,
        writer: RecordingWriter,
        *,
        until_all_gone: bool = False,
        tell: Callable[[RecorderReport], None] | None = None,
    ) -> None:
        """InputError where Zenoh does not open."""
        self._scenario, self._run, self._writer, self._tell = scenario, run, writer, tell
        self._until_all_gone = until_all_gone
        self._ids = {str(i) for i in scenario.ids}
        self._topics = _topics(scenario, run)
        self._flush_ns = round(scenario.recording.flush_interval_s * 1e9)
        recording, paced = scenario.recording, scenario.timing.period_ns is not None
        self._waits = recording.when_full == "wait" or (recording.when_full is None and not paced)
        self._seen: set[str] = set()
        self._present: set[str] = set()
        self._left: set[str] = set()
        """Those whose last words have come."""
        self._routed = False
        """Whether nodes are reached through a router."""
        self._empty_since = 0
        """When the last of all nodes had gone."""
        self._stopping = False
        self._bell = f"{keys.recorder_token(run)}/bell"
        self._report = RecorderReport(str(writer.path))
        self._failed = False
        self._session = open_session(
            endpoints,
            low_latency=scenario.transport.preset == "lowlatency",
            config_file=scenario.zenoh_config,
            name=RECORDER_NAME,
        )
        self._clock = Clock()
        self._clock.keep()
        self._inbox = Inbox(self._session, self._clock)
        self._waiting = Waiting(prober(endpoints, scenario.zenoh_config), self._clock.now() + WORD_NS)
        writer.accounts.is_legal = self.is_legal
        writer.accounts.is_topic = self._topics.__contains__

    def run(self) -> RecorderReport:
        """Record; the file is finished when this returns, whatever ends it. What could not be written is told."""
        try:
            with closing(self._session):
                try:
                    self._declare()
                    self._record()
                finally:
                    self._inbox.close()
        finally:
            self._finish()
        return self._report

    def stop(self) -> None:
        """End when all that has arrived is written."""
        self._stopping = True
        self._inbox.notify(None)

    def _declare(self) -> None:
        if self._waits:
            self._inbox.subscribe(CHANNEL, keys.whole_run(self._run), CAPACITY, self._bell)
        else:
            self._inbox.subscribe_posted(None, keys.whole_run(self._run))
        tokens = keys.node_token(self._run, "*")
        self._kept = [
            self._session.declare_queryable(
                keys.recorder_status_key(self._run), on_zenoh_thread(partial(self._note, "status?"))
            ),
            self._session.liveliness().declare_subscriber(
                tokens, on_zenoh_thread(partial(self._note, "token")), history=True
            ),
            self._session.liveliness().declare_token(keys.recorder_token(self._run)),
        ]

    def _note(self, kind: str, about: Any) -> None:
        if len(self._inbox.notices) < MAX_NOTICES:
            self._inbox.notify((kind, about))
            return
        self._report.unheeded += 1
        if kind == "status?":
            about.drop()

    def _record(self) -> None:
        inbox = self._inbox
        next_flush = self._clock.now() + self._flush_ns
        while True:
            wakes = next_flush if self._all_seen else min(next_flush, self._waiting.due_ns)
            if self._waits:
                sample = inbox.wait_sample(CHANNEL, wakes)
                if sample is not None:
                    self._receive(str(sample.key_expr), sample.payload, self._clock.now())
            elif not self._take():
                inbox.rest(wakes, or_posted=True)
            now = self._clock.now()
            if now >= next_flush:
                next_flush = now + self._flush_ns
                self._clock.look()
                self._try(self._writer.flush)
                if self._tell is not None:
                    self._tell(self._count())
            if inbox.notices:
                self._handle_notices()
            if not self._all_seen:
                self._waiting.tell(now, self._missing)
            if self._stopping or self._everybody_left(now):
                self._drain()
                return

    def _take(self) -> bool:
        """Write the next message that was posted, if there is one."""
        letter = self._inbox.posted.take()
        if letter is None:
            return False
        self._receive(*letter)
        return True

    def _receive(self, key: str, payload: Any, now: int) -> None:
        """A message came: bytes, or what Zenoh has in their place."""
        topic = self._topics.get(key)
        if topic is None or len(payload) > MAX_MESSAGE_BYTES:
            self._report.foreign += key != self._bell
            return
        data = payload if isinstance(payload, bytes) else payload.to_bytes()
        topic.received += 1
        if topic.stage is EVENT and topic.node is not None and _is_farewell(data):
            self._left.add(str(topic.node))
        before = self._writer.messages
        self._try(partial(self._writer.write, key, data, now))
        topic.recorded += self._writer.messages - before

    def _try(self, write: Callable[[], None]) -> None:
        """Write, as long as that can be done."""
        if not self._report.stopped:
            try:
                write()
            except RunError as error:
                self._failed, self._report.stopped = True, str(error)
            else:
                self._report.stopped = self._writer.stopped

    def is_legal(self, key: str, data: bytes) -> bool:
        """Whether bytes are a message that the node whose key they came on can have sent."""
        topic = self._topics[key]
        if topic.decoder is None:
            topic.decoder = self._decoder(topic)
        try:
            topic.decoder.decode(data)
        except MessageError:
            return False
        return True

    def _decoder(self, topic: _Topic) -> Decoder:
        system = self._scenario.system()
        if topic.node is None:
            return Decoder(topic.stage, TRUTH_SENDER, sizes={"nx": system.nx})
        graph = chosen(self._scenario).network(self._scenario.network)
        sizes = system.sizes(topic.node)
        return Decoder(topic.stage, topic.node, sizes=sizes, ids=graph.neighbours(topic.node))

    def _count(self) -> RecorderReport:
        """The report, brought up to date."""
        report = self._report
        report.recorded = {}
        for topic in self._topics.values():
            if topic.recorded:
                report.recorded[topic.stage.name] = report.recorded.get(topic.stage.name, 0) + topic.recorded
        report.by_key = {f"{t.node}/{t.stage.name}": t.recorded for t in self._topics.values() if t.recorded}
        report.messages = sum(report.recorded.values())
        report.unrecorded = sum(topic.received - topic.recorded for topic in self._topics.values())
        report.overrun = self._inbox.overrun
        report.files = list(map(str, self._writer.files))
        return report

    def _handle_notices(self) -> None:
        """Act on what happened."""
        for kind, about in self._inbox.take_notices():
            if kind == "token":
                self._on_token(about)
            else:
                self._answer(about)

    def _answer(self, query: Any) -> None:
        """Tell what is on the file, and how much waited for it."""
        waiting = self._drain()  # the asker's messages came before its question
        report = self._count()
        status = RecorderStatus(
            messages=report.messages,
            foreign=report.foreign,
            lost=sum(self._writer.lost().values()),
            waiting=waiting,
            unrecorded=report.unrecorded,
            overrun=report.overrun,
            stopped=report.stopped,
            path=report.path,
            host=platform.node(),
        )
        with query:  # queries are to be dropped explicitly, see `presence.QUESTIONS`
            query.reply(keys.recorder_status_key(self._run), status.encode())

    @property
    def _all_seen(self) -> bool:
        """Whether every node has been there."""
        return len(self._seen) == len(self._ids)

    def _missing(self) -> list[str]:
        """The nodes that have not been there yet, in words."""
        return [f"node {i}" for i in self._scenario.ids if str(i) not in self._seen]

    def _everybody_left(self, now: int) -> bool:
        """Whether all nodes have come and gone: with a word, or for good.

        Behind a router they may only be out of sight with it.
        """
        if not self._until_all_gone or self._present or not self._all_seen:
            self._empty_since = 0
            return False
        out_of_sight = self._routed and not self._session.info.routers_zid()
        self._empty_since = now if out_of_sight else self._empty_since or now
        return self._left >= self._ids or now >= self._empty_since + GRACE_NS

    def _drain(self) -> int:
        """Write what is there by now; how many messages that was."""
        most = max(CAPACITY, len(self._inbox.posted))
        for number in range(most):
            if self._waits:
                sample = self._inbox.poll_sample(CHANNEL)
                if sample is None:
                    return number
                self._receive(str(sample.key_expr), sample.payload, self._clock.now())
            elif not self._take():
                return number
        return most

    def _on_token(self, sample: Any) -> None:
        try:
            node = keys.parse_token(str(sample.key_expr)).node
        except MessageError:
            return
        if node not in self._ids:
            return
        if sample.kind == zenoh.SampleKind.PUT:
            never_linger()  # there is a new link
            self._routed = bool(self._session.info.routers_zid())
            self._seen.add(node)
            self._present.add(node)
            self._left.discard(node)
            log.info("node %s is there", node)
        else:
            self._present.discard(node)
            log.info("node %s is gone", node)

    def _finish(self) -> None:
        report, facts = self._count(), {"foreign": str(self._report.foreign), "overrun": str(self._inbox.overrun)}
        accounts: dict[str, Gaps] = {}
        try:
            accounts = self._writer.finish(facts=facts)
        except RunError as error:
            self._failed, report.stopped = True, report.stopped or str(error)
            accounts = self._writer.finish()  # there is nothing more to write
        if self._failed:
            self._recount()
            self._count()
        report.lost = {topic: gaps.lost for topic, gaps in accounts.items() if gaps.lost}
        for key, topic in self._topics.items():
            if topic.received > topic.recorded:
                report.lost[key] = report.lost.get(key, 0) + topic.received - topic.recorded
        log.info("%d messages in %s", report.messages, report.path)

    def _recount(self) -> None:
        """What was written last may not have come to the disk when that failed: see what is there."""
        counts: Mapping[str, int] = {}
        with suppress(RecordingError), Recording.open(self._writer.path) as recording:
            counts = recording.topics
        for key, topic in self._topics.items():
            topic.recorded = counts.get(key, 0)


def _is_farewell(data: bytes) -> bool:
    """Whether an event says that its sender leaves."""
    try:
        return bool(decode_any(data).get("kind") == "stopped")
    except MessageError:
        return False


def _topics(scenario: Scenario, run: str) -> dict[str, _Topic]:
    """All keys that a run can have, by themselves."""
    corrected = (REVISED,) if scenario.timing.revised_steps else ()
    stages = (*chosen(scenario).stages, *corrected, ESTIMATE, EVENT, ARRIVALS)
    topics = {keys.stage_key(run, i, stage.name): _Topic(i, stage) for i in scenario.ids for stage in stages}
    return topics | {keys.truth_key(run): _Topic(None, TRUTH)}
