"""Writing one file of a recording. The stock MCAP writer does the container; errors are the system's, as OSError."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, Schema
from mcap.writer import CompressionType, Writer

from zfusion.recording import layout
from zfusion.recording.channels import Describe, Description, Table, to_metadata
from zfusion.recording.claim import open_claimed

CHUNK_BYTES = 1 << 20
"""Messages are compressed in blocks of this size: 4 % smaller files than blocks of 64 KiB, 5 ms to close one."""

TABLE_EVERY_BYTES = 8 << 20
"""How often the facts, the scenario and all channels are repeated: what is lost with them is bounded by this."""

STRIDE_BYTES = 1 << 16
"""How often it is looked how large the file is by now, and whether there are new channels to tell."""

MESSAGE_OVERHEAD = 31
"""Bytes of a message record beside its data."""


class SegmentWriter:
    """A file of a recording that is being written; there is none until it is opened.

    `facts` are all that it says of itself, `scenario_toml` what was run, `design` what the file of the method's design
    holds.
    """

    def __init__(
        self,
        path: Path,
        facts: Mapping[str, str],
        scenario_toml: str,
        describe: Describe,
        *,
        design: bytes | None = None,
        compression: str = "zstd",
        stride_bytes: int = STRIDE_BYTES,
    ) -> None:
        self.path = path
        self.messages = 0
        self._facts, self._scenario_toml, self._describe = layout.unsealed(facts), scenario_toml, describe
        self._design = design
        self._stride = min(STRIDE_BYTES, stride_bytes)
        self._numbers: dict[str, int] = {}
        self._channels: list[Channel] = []
        self._schemas: dict[Description, Schema] = {}
        self._told = 0
        """Channels that are in a table by now."""
        self._table_at = 0
        self._written = 0
        """Bytes of the file when that was looked at last."""
        self._open = 0
        """Bytes of messages since then."""
        self._compression = CompressionType[compression.upper()]
        self._file: BinaryIO | None = None
        self._writer: Writer

    def open(self) -> None:
        """Make the file; one that is there is replaced, unless another process is writing it: OSError."""
        self._file = open_claimed(self.path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=self._compression, enable_data_crcs=True)

    def begin(self) -> None:
        """Put on the disk what makes even a file that breaks off here one that can be read."""
        now = int(self._facts.get("clock_realtime_ns", 0)) or time.time_ns()
        self._writer.start(profile=layout.PROFILE)
        self._writer.add_metadata(layout.RECORDING, layout.sealed(self._facts))
        self._attach(now, layout.SCENARIO, layout.SCENARIO_TYPE, self._scenario_toml.encode())
        if self._design is not None:
            self._attach(now, layout.DESIGN, layout.DESIGN_TYPE, self._design)
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._measure()
        self._table_at = self._written

    def _attach(self, now: int, name: str, media_type: str, data: bytes) -> None:
        self._writer.add_attachment(create_time=now, log_time=now, name=name, media_type=media_type, data=data)

    @property
    def closed(self) -> bool:
        """Whether nothing can be added any more."""
        return self._file is None or self._file.closed

    @property
    def size(self) -> int:
        """Bytes of the file if it ended here, with what is not compressed yet as it is."""
        return self._written + self._open

    def fileno(self) -> int:
        """The open file's descriptor."""
        return self._there.fileno()

    def takes(self, topic: str) -> bool:
        """Whether the file can hold messages of that topic: it cannot name any number of them."""
        return topic in self._numbers or len(self._channels) < layout.MAX_TOPICS

    def add(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int) -> None:
        """Put a message on the file, of a topic that it takes."""
        number = self._numbers.get(topic) or self._add_channel(topic)
        self._writer.add_message(number, log_time_ns, data, publish_time_ns, sequence)
        self.messages += 1
        self._open += len(data) + MESSAGE_OVERHEAD
        if self._open >= self._stride:
            self._measure()
            self._tell_channels()

    def flush(self) -> None:
        """Hand all that was added to the operating system: it survives the death of this process."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._measure()
        self._tell_channels()
        self._there.flush()

    @contextmanager
    def claimed(self) -> Iterator[None]:
        """Have it be nobody else's to write until the end of the block, though it is closed within."""
        also = os.dup(self.fileno())
        try:
            yield
        finally:
            os.close(also)

    def finish(self, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Write metadata records, each sealed, and the indexes; close the file."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._tell_channels()
        for name, facts in metadata.items():
            self._writer.add_metadata(name, layout.sealed(facts))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._there.close()

    def abandon(self) -> None:
        """Close the file as it is: after an error, more could only be put behind half a record."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()

    @property
    def _there(self) -> BinaryIO:
        assert self._file is not None, "open comes first"
        return self._file

    def _measure(self) -> None:
        written = self._there.tell()
        if written != self._written:
            self._written, self._open = written, 0

    def _add_channel(self, topic: str) -> int:
        """The number of a new channel for `topic`."""
        of = self._describe(topic)
        schema = self._schemas.get(of) if of.schema_name else None
        schema_id = schema.id if schema is not None else self._add_schema(of)
        number: int = self._writer.register_channel(topic, of.encoding, schema_id, dict(of.about))
        self._numbers[topic] = number
        self._channels.append(
            Channel(id=number, topic=topic, message_encoding=of.encoding, schema_id=schema_id, metadata=dict(of.about))
        )
        return number

    def _add_schema(self, of: Description) -> int:
        if not of.schema_name:
            return 0
        number: int = self._writer.register_schema(of.schema_name, of.schema_encoding, of.schema)
        self._schemas[of] = Schema(id=number, name=of.schema_name, encoding=of.schema_encoding, data=of.schema)
        return number

    def _tell_channels(self) -> None:
        """Repeat the declarations: of new channels soon; all of them, and what the file is, every so often."""
        whole = self._written - self._table_at >= TABLE_EVERY_BYTES or not self._told
        rows = self._channels if whole else self._channels[self._told :]
        if not rows:
            return
        used = {channel.schema_id for channel in rows}
        schemas = [schema for schema in self._schemas.values() if schema.id in used]
        told = (self._facts, self._scenario_toml) if whole else ({}, "")
        self._table_at = self._written if whole else self._table_at
        table = to_metadata(Table(rows, schemas, *told))
        self._told = len(self._channels)
        self._writer.add_metadata(layout.CHANNELS, layout.sealed(table))
