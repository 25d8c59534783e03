"""The recorder: a process that subscribes to a whole run and writes what comes, bytes as they are.

It shows the same liveliness token all the while, so that nodes begin only when it is there, and answers a query when
all that was published before it has arrived, so that nodes leave only when it has their last messages.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import zenoh

from zfusion import keys
from zfusion.drivers.inbox import Inbox
from zfusion.drivers.transport import Endpoints, on_zenoh_thread, open_session
from zfusion.errors import MessageError
from zfusion.messages import decode_any, encode_any
from zfusion.model.scenario import Scenario
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import EVENT

CAPACITY = 65_536
"""Messages that wait for the disk: seconds of a large swarm, tens of MB. Beyond it the senders wait, and lose nothing."""

CHANNEL = "all"


@dataclass(slots=True)
class RecorderReport:
    """What is on the file."""

    path: str
    messages: int = 0
    recorded: dict[str, int] = field(default_factory=dict)
    """By stage."""
    by_key: dict[str, int] = field(default_factory=dict)
    """By node and stage: ``1/measurement``."""
    lost: dict[str, int] = field(default_factory=dict)
    """By topic, where anything is missing that its sender sent."""
    foreign: int = 0
    """Messages of the run on keys that are none of zfusion's."""


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
        self._run, self._writer, self._tell = run, writer, tell
        self._until_all_gone = until_all_gone
        self._ids = {str(i) for i in scenario.ids}
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
        )
        self._inbox = Inbox(self._session)

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
                    self._tell(self._report)
            if inbox.notices and self._handle_notices():
                return

    def _write(self, sample: Any, now: int) -> None:
        topic = str(sample.key_expr)
        try:
            _, node, stage = keys.parse(topic)
        except MessageError:
            self._report.foreign += topic != self._bell
            return
        data = sample.payload.to_bytes()
        self._writer.write(topic, data, now)
        report = self._report
        report.messages += 1
        report.recorded[stage] = report.recorded.get(stage, 0) + 1
        key = f"{node}/{stage}"
        report.by_key[key] = report.by_key.get(key, 0) + 1
        if stage == EVENT.name:
            self._note_totals(topic, data)

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
                self._sent[topic.removesuffix(EVENT.name) + stage][event["born"]] = count

    def _handle_notices(self) -> bool:
        """Act on what happened; True when it is time to end."""
        notices = self._inbox.notices
        while notices:
            notice = notices.popleft()
            if notice is None:
                continue
            kind, about = notice
            if kind == "token":
                self._on_token(about)
            else:
                self._drain()  # the asker's messages are in the channel, before its question
                about.reply(keys.recorder_status_key(self._run), encode_any({"messages": self._report.messages}))
        everybody_left = self._until_all_gone and self._seen == self._ids and not self._present
        if self._stopping or everybody_left:
            self._drain()
            return True
        return False

    def _drain(self) -> None:
        while (sample := self._inbox.poll_sample(CHANNEL)) is not None:
            self._write(sample, time.time_ns())

    def _on_token(self, sample: Any) -> None:
        try:
            node = keys.parse_token(str(sample.key_expr)).node
        except MessageError:
            return
        if node not in self._ids:
            return
        if sample.kind == zenoh.SampleKind.PUT:
            self._seen.add(node)
            self._present.add(node)
        else:
            self._present.discard(node)

    def _finish(self) -> None:
        accounts = self._writer.finish(sent=self._sent, facts={"foreign": str(self._report.foreign)})
        self._report.lost = {topic: gaps.lost for topic, gaps in accounts.items() if gaps.lost}
