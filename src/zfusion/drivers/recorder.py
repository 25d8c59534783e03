"""The recorder: a process that subscribes to a whole run and writes what comes, bytes as they are.

It shows the same liveliness token all the while, so that nodes begin only when it is there, and answers a query when
all that was published before it has arrived, so that nodes leave only when it has their last messages.
"""

from __future__ import annotations

import logging
import platform
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from zfusion import keys
from zfusion.drivers.credentials import RECORDER_NAME
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.metrics import RecorderReport
from zfusion.drivers.transport import never_linger, on_zenoh_thread, open_session
from zfusion.errors import MessageError
from zfusion.messages import MAX_MESSAGE_BYTES, Decoder, decode_any
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH, TRUTH_SENDER, Stage
from zfusion.status import RecorderStatus

log = logging.getLogger(__name__)

CAPACITY = 65_536
"""Messages that wait for the disk: seconds of a large swarm, tens of MB. Beyond it senders wait, and lose nothing."""

CHANNEL = "all"


@dataclass(slots=True)
class _Topic:
    """One key of the run."""

    node: NodeId | None
    """None for the truth."""
    stage: Stage
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
        self._seen: set[str] = set()
        self._present: set[str] = set()
        self._stopping = False
        self._bell = f"{keys.recorder_token(run)}/bell"
        self._sent: dict[str, dict[int, int]] = defaultdict(dict)
        self._report = RecorderReport(str(writer.path))
        config = scenario.transport.zenoh_config
        self._session = open_session(
            endpoints,
            low_latency=scenario.transport.preset == "lowlatency",
            config_file=scenario.absolute(config) if config else None,
            name=RECORDER_NAME,
        )
        self._inbox = Inbox(self._session)
        writer.is_legal = self.is_legal

    def run(self) -> RecorderReport:
        """Record; the file is finished when this returns, whatever ends it. RunError when writing fails."""
        try:
            with self._session:
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
        self._inbox.subscribe(CHANNEL, keys.whole_run(self._run), CAPACITY, self._bell)
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
        self._inbox.notify((kind, about))

    def _record(self) -> None:
        inbox, writer = self._inbox, self._writer
        next_flush = time.time_ns() + self._flush_ns
        while True:
            sample = inbox.wait_sample(CHANNEL, next_flush)
            now = time.time_ns()
            if sample is not None:
                self._write(sample, now)
            if now >= next_flush:
                next_flush = now + self._flush_ns
                writer.flush()
                if self._tell is not None:
                    self._tell(self._count())
            if inbox.notices and self._handle_notices():
                return

    def _write(self, sample: Any, now: int) -> None:
        key = str(sample.key_expr)
        topic = self._topics.get(key)
        payload = sample.payload
        if topic is None or len(payload) > MAX_MESSAGE_BYTES:
            self._report.foreign += key != self._bell
            return
        data = payload.to_bytes()
        self._writer.write(key, data, now)
        topic.recorded += 1
        if topic.stage is EVENT:
            self._note_totals(key, data)

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
        return report

    def _note_totals(self, topic: str, data: bytes) -> None:
        """What a leaving node says that it has sent."""
        try:
            event = decode_any(data)
        except MessageError:
            return
        details = event.get("data")
        if event.get("kind") != "stopped" or not isinstance(details, dict) or not isinstance(event.get("born"), int):
            return
        sent = details.get("sent")
        if not isinstance(sent, dict):
            return
        for stage, count in sent.items():
            if isinstance(count, int) and isinstance(stage, str):
                key = keys.truth_key(self._run) if stage == TRUTH.name else topic.removesuffix(EVENT.name) + stage
                self._sent[key][event["born"]] = count

    def _handle_notices(self) -> bool:
        """Act on what happened; True when it is time to end."""
        notices = self._inbox.notices
        for _ in range(len(notices)):
            notice = notices.popleft()
            if notice is None:
                continue
            kind, about = notice
            if kind == "token":
                self._on_token(about)
            else:
                self._answer(about)
        everybody_left = self._until_all_gone and self._seen == self._ids and not self._present
        if self._stopping or everybody_left:
            self._drain()
            return True
        return False

    def _answer(self, query: Any) -> None:
        """Tell what is on the file, and how much waited for it."""
        waiting = self._drain()  # the asker's messages are in the channel, before its question
        report = self._count()
        status = RecorderStatus(
            messages=report.messages,
            foreign=report.foreign,
            lost=sum(self._writer.lost().values()),
            waiting=waiting,
            path=report.path,
            host=platform.node(),
        )
        with query:  # queries are to be dropped explicitly, see `presence.QUESTIONS`
            query.reply(keys.recorder_status_key(self._run), status.encode())

    def _drain(self) -> int:
        """Write what is there by now; how many messages that was."""
        for number in range(CAPACITY):
            sample = self._inbox.poll_sample(CHANNEL)
            if sample is None:
                return number
            self._write(sample, time.time_ns())
        return CAPACITY

    def _on_token(self, sample: Any) -> None:
        try:
            node = keys.parse_token(str(sample.key_expr)).node
        except MessageError:
            return
        if node not in self._ids:
            return
        if sample.kind == zenoh.SampleKind.PUT:
            never_linger()  # there is a new link
            self._seen.add(node)
            self._present.add(node)
            log.info("node %s is there", node)
        else:
            self._present.discard(node)
            log.info("node %s is gone", node)

    def _finish(self) -> None:
        self._count()
        accounts = self._writer.finish(sent=self._sent, facts={"foreign": str(self._report.foreign)})
        self._report.lost = {topic: gaps.lost for topic, gaps in accounts.items() if gaps.lost}
        log.info("%d messages in %s", self._report.messages, self._report.path)


def _topics(scenario: Scenario, run: str) -> dict[str, _Topic]:
    """All keys that a run can have, by themselves."""
    corrected = (REVISED,) if scenario.timing.revised_steps else ()
    stages = (*chosen(scenario).stages, *corrected, ESTIMATE, EVENT, ARRIVALS)
    topics = {keys.stage_key(run, i, stage.name): _Topic(i, stage) for i in scenario.ids for stage in stages}
    return topics | {keys.truth_key(run): _Topic(None, TRUTH)}
