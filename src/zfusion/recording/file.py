"""Reading one file of a recording, finished or broken off.

Opening proves the whole file: a finished one by the checksums of its data section and summary (which cover every
byte), one that was broken off by the checksum of every chunk. So what is not what the writer wrote is refused before
anything is done with it. A file that merely ends too early is read as far as it goes, and says so.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, Metadata, Schema, Statistics

from zfusion.errors import RecordingError
from zfusion.gaps import Gaps
from zfusion.recording import layout
from zfusion.recording.accounts import stated_accounts
from zfusion.recording.channels import Description, described, from_metadata
from zfusion.recording.container import (
    MAGIC,
    Damage,
    Frame,
    check_message_index,
    chunk_declarations,
    chunk_messages,
    frames,
    parse,
    parse_attachment,
    read_at,
    unpack_chunk,
)
from zfusion.recording.paths import open_to_read

EVER = 2**64
"""Later than every time that an MCAP file can say."""

_SEALED = (layout.RECORDING, layout.CHANNELS, layout.DERIVED)
"""Metadata that have a checksum of their own in all recordings; the others had none once."""


class Record(NamedTuple):
    """One recorded message."""

    topic: str
    """The Zenoh key that it came on."""
    data: bytes
    """The wire bytes."""
    log_time_ns: int
    """When the recorder got it; never less than the record's before."""
    publish_time_ns: int
    """When the sender sent it, by its own clock."""
    sequence: int
    """The sender's counter mod 2^32."""


class _ChunkPlace(NamedTuple):
    position: int
    """Of the body, in the file."""
    length: int
    start_ns: int
    """Lowest log time in it."""
    end_ns: int
    """Highest log time in it."""


@dataclass(slots=True)
class _Contents:
    """What is found in a file from its beginning to its end."""

    chunks: list[_ChunkPlace] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages of each channel."""
    start_ns: int = 0
    end_ns: int = 0
    readable: int = 0
    """Bytes until the end of the last record that is whole."""
    data_ended: bool = False
    """The writer had no more to say: all messages are there."""
    proven: bool = False
    """Data section and summary have checksums, and they agree."""
    finished: bool = False
    """The file is whole to its last byte."""


class TooShort(RecordingError):
    """A file that ends before it says what it is."""


class RecordedFile:
    """A file of a recording, open for reading; made by `RecordedFile.open`.

    Any number of iterations may read it at once. A file that is still being written is read up to where it was
    flushed when it was opened.
    """

    def __init__(self, path: Path, file: BinaryIO, contents: _Contents, size: int) -> None:
        self._file = file
        self._contents = contents
        self.path = path
        self.size_bytes = size
        self.finished = contents.finished
        """False for a file that was broken off; `note` says what is there and what is not."""
        self.note = "" if contents.finished else _note(contents, size)
        self.metadata: Mapping[str, str] = contents.metadata[layout.RECORDING]
        self.closing: Mapping[str, str] = layout.unsealed(contents.metadata.get(layout.CLOSE, {}))
        self.derived: Mapping[str, str] = layout.unsealed(contents.metadata.get(layout.DERIVED, {}))
        """How it was made from others, if it was."""
        self.number = int(self.metadata.get(layout.SEGMENT, "0"))
        """Its place among the segments."""
        self.scenario_toml = contents.attachments[layout.SCENARIO].decode()
        self.design = contents.attachments.get(layout.DESIGN)
        channels = dict(sorted(contents.channels.items()))
        self.topics: Mapping[str, int] = {c.topic: contents.counts.get(c.id, 0) for c in channels.values()}
        """Messages of every topic, in the order in which the topics first appeared."""
        self.descriptions: Mapping[str, Description] = {
            c.topic: described(c, contents.schemas) for c in channels.values()
        }
        self.start_ns = contents.start_ns
        """Log time of the first message; 0 if there is none."""
        self.end_ns = contents.end_ns
        """Log time of the last message; 0 if there is none."""

    @classmethod
    def open(cls, path: Path) -> Self:
        """The file at `path`; RecordingError, naming it, if it cannot be read or trusted."""
        try:
            file = open_to_read(path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            size = os.fstat(file.fileno()).st_size
            contents = _survey(file, size)
            _check_layout(contents)
            return cls(path, file, contents, size)
        except (RecordingError, UnicodeDecodeError, OSError) as error:
            file.close()
            kind = TooShort if isinstance(error, TooShort) else RecordingError
            remedy = "; zfusion recover saves what can be saved" if isinstance(error, Damage) else ""
            raise kind(f"{path}: {error}{remedy}") from error

    @property
    def statistics(self) -> Mapping[str, Gaps] | None:
        """The writer's account of every topic, since the recording began; None for a file that was broken off."""
        stated = self._contents.metadata.get(layout.STATISTICS)
        if stated is None or not self.finished:
            return None
        return stated_accounts(stated)

    def records(self, chosen: Set[str] | None, start_ns: int = 0, end_ns: int = EVER) -> Iterator[Record]:
        """The messages as in `Recording.records`. RecordingError if the file has changed since it was opened."""
        wanted = {
            number: channel.topic if chosen is None or channel.topic in chosen else None
            for number, channel in self._contents.channels.items()
        }
        try:
            for chunk in self._contents.chunks:
                if self._contents.proven and (chunk.end_ns < start_ns or chunk.start_ns >= end_ns):
                    continue
                _, data = unpack_chunk(read_at(self._file, chunk.position, chunk.length), chunk.position)
                yield from map(Record._make, chunk_messages(data, chunk.position, wanted, start_ns, end_ns))
        except Damage as error:
            raise RecordingError(f"{self.path}: {error}") from error

    def close(self) -> None:
        """Close the file; iterations that are under way end with an error."""
        self._file.close()


def _survey(file: BinaryIO, size: int) -> _Contents:
    """Read the file from end to end, prove it, and list what is in it."""
    magic = file.read(len(MAGIC))
    if not size:
        raise TooShort("is empty")
    if magic != MAGIC:
        raise RecordingError("is not an MCAP file")
    file.seek(max(size - len(MAGIC), 0))
    ends_well = size > len(MAGIC) and file.read() == MAGIC
    contents = _Contents(readable=len(MAGIC))
    records = frames(file, size, ends_well)
    data_proven = _read_data(records, contents)
    summary_proven = _read_summary(records, contents, file)
    if ends_well and not contents.finished:
        raise Damage(contents.readable, "the file ends as a finished one, but has no footer")
    contents.proven = data_proven and summary_proven
    if not contents.proven:
        for name in (layout.STATISTICS, layout.CLOSE):
            if not layout.is_intact(contents.metadata.get(name, {})):
                contents.metadata.pop(name, None)  # of an older recording: nothing says that they are as they were
        _count_messages(file, contents)
    return contents


def _read_data(records: Iterator[Frame], contents: _Contents) -> bool:
    """Take in the data section. True if it came to its end and its checksum agrees."""
    checksum = zlib.crc32(MAGIC)
    for frame in records:
        contents.readable = frame.end
        match frame.opcode:
            case Opcode.CHUNK:
                chunk = parse(Chunk, frame)
                start = frame.position + len(frame.head)
                contents.chunks.append(
                    _ChunkPlace(start, len(frame.body), chunk.message_start_time, chunk.message_end_time)
                )
            case Opcode.MESSAGE_INDEX:
                check_message_index(frame)
            case Opcode.METADATA:
                _take_metadata(contents, parse(Metadata, frame), frame.position)
            case Opcode.ATTACHMENT:
                attachment = parse_attachment(frame)
                contents.attachments[attachment.name] = attachment.data
            case Opcode.CHANNEL:
                _declare(contents, parse(Channel, frame), frame.position)
            case Opcode.SCHEMA:
                _declare(contents, parse(Schema, frame), frame.position)
            case Opcode.HEADER:
                parse(Header, frame)
            case Opcode.DATA_END:
                contents.data_ended = True
                return _agree(parse(DataEnd, frame).data_section_crc, checksum, frame.position, "data section")
            case _:
                raise Damage(frame.position, f"a record of type {frame.opcode} among the data")
        checksum = zlib.crc32(frame.body, zlib.crc32(frame.head, checksum))
    return False


def _read_summary(records: Iterator[Frame], contents: _Contents, file: BinaryIO) -> bool:
    """Take in the summary section. True if it came to its end and its checksum agrees."""
    checksum = 0
    for frame in records:
        contents.readable = frame.end
        if frame.opcode == Opcode.FOOTER:
            checksum = zlib.crc32(frame.body[:-4], zlib.crc32(frame.head, checksum))
            file.seek(frame.end)
            rest = file.read(len(MAGIC) + 1)
            if not MAGIC.startswith(rest):
                raise Damage(frame.end, "something follows the footer")
            contents.finished = rest == MAGIC
            return _agree(parse(Footer, frame).summary_crc, checksum, frame.position, "summary")
        checksum = zlib.crc32(frame.body, zlib.crc32(frame.head, checksum))
        if frame.opcode == Opcode.CHANNEL:
            _declare(contents, parse(Channel, frame), frame.position)
        elif frame.opcode == Opcode.SCHEMA:
            _declare(contents, parse(Schema, frame), frame.position)
        elif frame.opcode == Opcode.STATISTICS:
            statistics = parse(Statistics, frame)
            contents.counts = statistics.channel_message_counts
            contents.start_ns, contents.end_ns = statistics.message_start_time, statistics.message_end_time
    return False


def _agree(stated: int, computed: int, position: int, what: str) -> bool:
    """Whether a checksum is there (0 says that it is not) and right; Damage if it is there and wrong."""
    if stated not in (0, computed):
        raise Damage(position, f"the checksum of the {what} does not agree")
    return stated != 0


def _take_metadata(contents: _Contents, metadata: Metadata, position: int) -> None:
    facts = metadata.metadata
    sealed = metadata.name in _SEALED or layout.CHECKSUM in facts
    if sealed and not layout.is_intact(facts):
        raise Damage(position, f"the checksum of a {metadata.name} does not agree")
    if metadata.name != layout.CHANNELS:
        contents.metadata[metadata.name] = facts
        return
    table = from_metadata(facts)
    for channel in table.channels:
        _declare(contents, channel, position)
    for schema in table.schemas:
        _declare(contents, schema, position)


def _declare(contents: _Contents, declaration: Channel | Schema, position: int) -> None:
    if isinstance(declaration, Channel):
        known = contents.channels.setdefault(declaration.id, declaration).topic
        if known != declaration.topic:
            raise Damage(position, f"channel {declaration.id} is declared twice")
    else:
        contents.schemas.setdefault(declaration.id, declaration)


def _count_messages(file: BinaryIO, contents: _Contents) -> None:
    """Prove every chunk of a file that has no checksum as a whole, and count what is in it."""
    contents.counts, times = {}, [0, 0]
    for place in contents.chunks:
        _, data = unpack_chunk(read_at(file, place.position, place.length), place.position)
        for declaration in chunk_declarations(data, place.position):
            _declare(contents, declaration, place.position)
        numbers: dict[int, str | None] = {number: str(number) for number in contents.channels}
        for number, _, log_time, _, _ in chunk_messages(data, place.position, numbers, 0, EVER):
            contents.counts[int(number)] = contents.counts.get(int(number), 0) + 1
            times = [times[0] or log_time, log_time]
    contents.start_ns, contents.end_ns = times


def _check_layout(contents: _Contents) -> None:
    """Refuse a file that is none of ours, or of another version, or that broke off before it had begun."""
    facts = contents.metadata.get(layout.RECORDING)
    if facts is None:
        if not contents.finished:
            raise TooShort(f"ends at byte {contents.readable}, before it says what it is: nothing can be read")
        raise RecordingError("is an MCAP file, but not a recording of zfusion's")
    if facts.get("format") != layout.FORMAT:
        raise RecordingError(
            f"is a recording of format {facts.get('format')}; this zfusion reads format {layout.FORMAT}"
        )
    if layout.SCENARIO not in contents.attachments:
        kind = RecordingError if contents.finished else TooShort
        raise kind(f"has no {layout.SCENARIO}: it ends at byte {contents.readable}")


def _note(contents: _Contents, size: int) -> str:
    """What is and what is not in a recording that was broken off."""
    messages = sum(contents.counts.values())
    if contents.data_ended:
        return f"broken off while it was finished: all {messages} messages are there, the summary is not"
    cut = size - contents.readable
    half = f", and {cut} bytes of a record that is not all there" if cut else ""
    return (
        f"broken off: it holds {messages} messages{half}. What came after the recorder's last flush is lost, and the "
        "accounts of what was sent are missing"
    )
