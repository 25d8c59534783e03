"""Writing a recording: every message of a run as it was on the wire, in the order in which it came.

The stock MCAP writer does the container. Nothing here is threaded: whoever receives messages puts them in a queue, and
one thread writes. After `flush`, what was written before survives the death of the process; after `sync`, a power cut.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import Writer

from zfusion import keys
from zfusion.errors import MessageError, RecordingError, RunError
from zfusion.gaps import GapCounter, Gaps
from zfusion.messages import VERSION, json_schema, read_stamp
from zfusion.recording import layout
from zfusion.recording.provenance import clocks, machine, software
from zfusion.stages import BUILT_IN, Stage

CHUNK_BYTES = 1 << 20
"""Messages are compressed in blocks of this size: 4 % smaller files than blocks of 64 KiB, 5 ms to close one."""

MAX_TOPICS = 65_535
"""What an MCAP file can name; a run with more keys is an attack."""


@dataclass(slots=True)
class _Channel:
    id: int
    counter: GapCounter = field(default_factory=GapCounter)


class RecordingWriter:
    """An open recording. A context manager: leaving it finishes the file.

    `path` must be in a directory that is there; a file there is replaced. `stages` are those of the method beside the
    built-in ones, for the schemas on the file; topics of other stages are recorded all the same. `design` is what the
    file of the method's design holds. `facts` are what else the caller knows of the run and wants on the file.
    RecordingError if the file cannot be made; RunError from any method when writing fails (disk full): the file is
    closed then, and readable up to there.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        scenario_toml: str,
        run: str,
        method: str,
        seed: int | None,
        stages: Iterable[Stage] = (),
        design: bytes | None = None,
        facts: Mapping[str, str] | None = None,
    ) -> None:
        self.is_legal: Callable[[str, bytes], bool] = lambda _topic, _data: True
        """Asked, with topic and payload, where counters are not the next in order: what is not legal does not count."""
        self.path = Path(path)
        self._stages = {stage.name: stage for stage in (*BUILT_IN, *stages)}
        self._schemas: dict[Stage | None, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._log_time_ns = 0
        self._refused = 0
        self.messages = 0
        """Messages written so far."""
        start = clocks()
        origin = {"format": layout.FORMAT, "run": run, "method": method, "seed": "" if seed is None else str(seed)}
        try:
            self._file = self.path.open("wb")
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, enable_data_crcs=True)
        with self._writing():
            self._begin(dict(facts or {}) | origin | software() | machine() | start, scenario_toml, design)

    def write(self, topic: str, data: bytes, arrival_ns: int) -> None:
        """Record `data`, that came on the key `topic` at `arrival_ns`.

        Bytes that are not a legal message are recorded as they are, and counted. Arrival times that go back are
        raised to the last one, so that the order on the file is the order of time.
        """
        if self._file.closed:
            raise RunError(f"{self.path}: the recording is closed")
        channel = self._channels.get(topic) or self._add_channel(topic)
        if channel is None:
            self._refused += 1
            return
        log_time = self._log_time_ns = max(self._log_time_ns, arrival_ns)
        try:
            born, seq, t_ns = read_stamp(data)
        except MessageError:
            born = seq = t_ns = 0
        if born and (channel.counter.expects(born, seq) or self.is_legal(topic, data)):
            channel.counter.observe(born, seq)
        else:
            channel.counter.observe_unreadable()
        try:
            self._writer.add_message(channel.id, log_time, data, t_ns or log_time, seq & 0xFFFF_FFFF)
        except OSError as error:
            raise self._fail(error) from error
        self.messages += 1

    def flush(self) -> None:
        """Hand all that was written to the operating system: it survives the death of this process."""
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]

    def lost(self) -> dict[str, int]:
        """By topic: what is missing so far between the messages that came, where anything is."""
        between = {topic: channel.counter.gaps().lost_between for topic, channel in self._channels.items()}
        return {topic: lost for topic, lost in between.items() if lost}

    def sync(self) -> None:
        """Have the operating system put what was flushed on the disk: it survives a power cut. Takes 4 to 50 ms."""
        with self._writing():
            os.fdatasync(self._file.fileno())

    def finish(
        self,
        *,
        sent: Mapping[str, Mapping[int, int]] | None = None,
        facts: Mapping[str, str] | None = None,
    ) -> dict[str, Gaps]:
        """Write the accounts and the indexes, and close the file; the accounts, by topic. Doing it again does nothing.

        `sent` tells, for the topics whose senders said so, how many messages they had put there, by their lives'
        first steps; `facts` are what the caller knows of how the run ended (queue, drops).
        """
        sent = sent or {}
        accounts = {topic: channel.counter.gaps(sent.get(topic)) for topic, channel in self._channels.items()}
        accounts |= {topic: GapCounter().gaps(counts) for topic, counts in sent.items() if topic not in accounts}
        if self._file.closed:
            return accounts
        end = clocks() | {"messages": str(self.messages), "refused": str(self._refused)} | dict(facts or {})
        with self._writing():
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._writer.add_metadata(
                layout.STATISTICS, {topic: json.dumps(asdict(account)) for topic, account in accounts.items()}
            )
            self._writer.add_metadata(layout.CLOSE, end)
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        return accounts

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def _begin(self, facts: Mapping[str, str], scenario_toml: str, design: bytes | None) -> None:
        """Put on the disk what makes even a recording that breaks off here one that can be read."""
        now = int(facts["clock_realtime_ns"])
        self._writer.start(profile=layout.PROFILE)
        self._writer.add_metadata(layout.RECORDING, layout.sealed(facts))
        self._attach(now, layout.SCENARIO, layout.SCENARIO_TYPE, scenario_toml.encode())
        if design is not None:
            self._attach(now, layout.DESIGN, layout.DESIGN_TYPE, design)
        self._writer.flush()  # type: ignore[no-untyped-call]

    def _attach(self, now: int, name: str, media_type: str, data: bytes) -> None:
        self._writer.add_attachment(create_time=now, log_time=now, name=name, media_type=media_type, data=data)

    def _add_channel(self, topic: str) -> _Channel | None:
        """A channel for `topic`; None if the file can hold no more."""
        if len(self._channels) == MAX_TOPICS:
            return None
        try:
            name = keys.parse(topic).stage
        except MessageError:
            name = ""
        stage = self._stages.get(name)
        about = {"encoding": "application/msgpack", "version": str(VERSION), "stage": name}
        with self._writing():
            number = self._writer.register_channel(topic, layout.MESSAGE_ENCODING, self._schema_of(stage), about)
        channel = self._channels[topic] = _Channel(number)
        return channel

    def _schema_of(self, stage: Stage | None) -> int:
        """The number of the stage's schema; of one that allows any map, for topics of no known stage."""
        if stage not in self._schemas:
            schema = {"type": "object"} if stage is None else json_schema(stage)
            self._schemas[stage] = self._writer.register_schema(
                _schema_name(stage), layout.SCHEMA_ENCODING, json.dumps(schema).encode()
            )
        return self._schemas[stage]

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._fail(error) from error

    def _fail(self, error: OSError) -> RunError:
        """Close the file: what is on it stays readable, while more could only be put behind half a record."""
        with suppress(OSError):
            self._file.close()
        return RunError(f"{self.path}: writing failed: {error.strerror}")


def _schema_name(stage: Stage | None) -> str:
    """``zfusion.Intermediate`` for the stage `intermediate`."""
    words = ["any"] if stage is None else stage.name.split("_")
    return "zfusion." + "".join(word.capitalize() for word in words)
