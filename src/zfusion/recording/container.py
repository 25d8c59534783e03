"""Reading MCAP strictly: every byte is accounted for, and what does not fit is damage at a place that is named.

The stock readers parse the records. What is added here: the framing with byte positions, for errors that say where;
the check of every checksum that MCAP offers (whole data section, summary, chunk, attachment); the difference between
a file that was cut off and one that was altered; and a walk through a chunk's messages that costs half a microsecond
for each.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import get_chunk_data_stream

from zfusion.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"

_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = 22
"""Bytes of a message record between its frame and its data."""
_LENGTH = struct.Struct("<Q")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<BQQQQII")
"""Frame, times, uncompressed size, checksum, and the length of the compression's name."""
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
_KINDS: Mapping[int, type] = {
    Opcode.HEADER: Header,
    Opcode.FOOTER: Footer,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
    Opcode.DATA_END: DataEnd,
}

MAX_RECORD = 1 << 29
"""Bytes of a record; no chunk is larger, and nothing else nearly as large."""

MAX_CHUNK = 1 << 28
"""Bytes of a chunk's records; what says that it has more is damaged, or would fill the memory."""

_R = TypeVar("_R")
_Bytes = bytes | mmap.mmap


class Damage(RecordingError):
    """A file that is not what was written; `position` is the byte where that shows, `what` says how."""

    def __init__(self, position: int, what: str) -> None:
        self.position = position
        self.what = what
        super().__init__(f"damaged at byte {position}: {what}")


class Frame(NamedTuple):
    """One record of the file."""

    opcode: int
    position: int
    """Of its first byte, in the file."""
    head: bytes
    body: bytes

    @property
    def end(self) -> int:
        """Of the byte after its last."""
        return self.position + len(self.head) + len(self.body)


def frames(file: BinaryIO, size: int, finished: bool) -> Iterator[Frame]:
    """The records of `file`, that has `size` bytes, from behind the magic on, until its footer or its end.

    In a file that was not `finished`, a last record that is not all there ends the iteration, and so does a tail of
    nothing but zeros, which a file system may leave after a power cut. Everything else that does not fit is Damage.
    """
    position = len(MAGIC)
    file.seek(position)
    while position < size:
        head = file.read(_FRAME.size)
        opcode, length = _FRAME.unpack(head) if len(head) == _FRAME.size else (-1, 0)
        cut_off = opcode < 0 or length > size - position - _FRAME.size
        if not finished and (cut_off or (not any(head) and _only_zeros_follow(file))):
            return
        if opcode not in _OPCODES:
            raise Damage(position, f"no record of a type {opcode}" if opcode >= 0 else "half a record")
        if cut_off:
            raise Damage(position, f"a record of {length} bytes does not fit into the file")
        frame = Frame(opcode, position, head, file.read(length))
        yield frame
        if opcode == Opcode.FOOTER:
            return
        position = frame.end


def parse(record: type[_R], frame: Frame) -> _R:
    """The record in the frame; Damage if it is not one of that type from end to end."""
    stream = ReadDataStream(BytesIO(frame.body))
    try:
        parsed: _R = record.read(stream)  # type: ignore[attr-defined]
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise Damage(frame.position, f"not a {record.__name__.lower()}: {error}") from error
    if stream.count != len(frame.body):
        raise Damage(frame.position, f"a {record.__name__.lower()} shorter than its record")
    return parsed


def parse_attachment(frame: Frame) -> Attachment:
    """The attachment in the frame; Damage if its checksum does not agree."""
    attachment = parse(Attachment, frame)
    if zlib.crc32(frame.body[:-4]) != int.from_bytes(frame.body[-4:], "little"):
        raise Damage(frame.position, f"the checksum of the attachment {attachment.name!r} does not agree")
    return attachment


def check_message_index(frame: Frame) -> None:
    """Damage if the frame does not hold a message index. (Its entries are not used.)"""
    if len(frame.body) < 6 or int.from_bytes(frame.body[2:6], "little") != len(frame.body) - 6:
        raise Damage(frame.position, "not a message index")


def unpack_chunk(body: bytes, position: int) -> tuple[Chunk, bytes]:
    """A chunk and the records in it, uncompressed; Damage if its checksum does not agree, or it has none."""
    chunk = parse(Chunk, Frame(Opcode.CHUNK, position, b"", body))
    if chunk.uncompressed_size > MAX_CHUNK:
        raise Damage(position, f"a chunk of {chunk.uncompressed_size} bytes, where {MAX_CHUNK} are the most")
    try:
        stream, length = get_chunk_data_stream(chunk)
        data = stream.read(length)
    except Exception as error:  # the compressors each have errors of their own
        raise Damage(position, f"the chunk cannot be uncompressed: {error}") from error
    if len(data) != chunk.uncompressed_size or zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damage(position, "the checksum of the chunk does not agree")
    return chunk, data


def chunk_declarations(data: bytes, position: int) -> Iterator[Channel | Schema]:
    """The channels and schemas that a chunk's records declare. `position` is the chunk's, for errors."""
    for opcode, start, end in _chunk_frames(data, position):
        if opcode == Opcode.CHANNEL:
            yield parse(Channel, Frame(opcode, position, b"", data[start:end]))
        elif opcode == Opcode.SCHEMA:
            yield parse(Schema, Frame(opcode, position, b"", data[start:end]))


def chunk_contents(data: bytes, position: int) -> tuple[list[Channel | Schema], Counter[int], int, int]:
    """(declarations, messages by channel, lowest log time, highest) of a chunk; Damage if it holds anything else."""
    declared: list[Channel | Schema] = []
    counts: Counter[int] = Counter()
    first_ns, last_ns = 2**64, 0
    for opcode, start, end in _chunk_frames(data, position):
        if opcode == Opcode.MESSAGE and end - start >= _MESSAGE_FIELDS:
            channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(data, start)
            counts[channel] += 1
            first_ns, last_ns = min(first_ns, log_time), max(last_ns, log_time)
        elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            frame = Frame(opcode, position, b"", data[start:end])
            declared.append(parse(Channel, frame) if opcode == Opcode.CHANNEL else parse(Schema, frame))
        else:
            raise Damage(position, f"the chunk holds a record of type {opcode}")
    return declared, counts, first_ns, last_ns


def chunk_messages(
    data: bytes, position: int, topics: Mapping[int, str | None], start_ns: int, end_ns: int
) -> Iterator[tuple[Any, ...]]:
    """(topic, data, log time, publish time, sequence) of the chunk's messages with start <= log time < end.

    `topics` gives every channel's topic, or None for the channels that are not wanted. `position` is the chunk's.
    """
    place, size, read = 0, len(data), _MESSAGE.unpack_from
    message, fields_end = Opcode.MESSAGE.value, _MESSAGE.size
    try:
        while place < size:
            if data[place] == message:
                _, length, channel, sequence, log_time, publish_time = read(data, place)
                body, place = place + fields_end, place + _FRAME.size + length
                topic = topics[channel]
                if topic is not None and start_ns <= log_time < end_ns:
                    yield topic, data[body:place], log_time, publish_time, sequence
            else:
                place += _FRAME.size + _FRAME.unpack_from(data, place)[1]
    except struct.error as error:
        raise Damage(position, f"the chunk holds half a record: {error}") from error
    except KeyError as channel_id:
        raise Damage(position, f"the chunk has messages of channel {channel_id}, which is declared nowhere") from None
    if place != size:
        raise Damage(position, "the chunk holds half a record")


def frame_length(data: _Bytes, place: int) -> int:
    """Bytes of the record that begins there, with its frame, by its own account; very many if it has no frame."""
    if place + _FRAME.size > len(data):
        return 2**64
    length: int = _FRAME.unpack_from(data, place)[1]
    return _FRAME.size + length


def chunk_length(data: _Bytes, place: int) -> int:
    """Bytes of the chunk that begins there, by what it says of its contents; 0 if it cannot be one."""
    if place + _CHUNK.size > len(data):
        return 0
    *_, uncompressed, _, words = _CHUNK.unpack_from(data, place)
    if words > len("zstd") or uncompressed > MAX_CHUNK or place + _CHUNK.size + words + _LENGTH.size > len(data):
        return 0
    (stored,) = _LENGTH.unpack_from(data, place + _CHUNK.size + words)
    return int(_CHUNK.size + words + _LENGTH.size + stored)


def is_well_formed(data: _Bytes, place: int) -> bool:
    """Whether a record begins there that has the form of its type, so far as that can be seen without a checksum."""
    length = frame_length(data, place)
    if place + length > len(data) or length > MAX_RECORD:
        return False
    kind = _KINDS.get(data[place])
    if kind is None:
        return False
    if kind is Chunk:
        return chunk_length(data, place) == length
    frame = Frame(data[place], place, b"", data[place + _FRAME.size : place + length])
    try:
        if kind is MessageIndex:
            check_message_index(frame)
        else:
            parse(kind, frame)
    except Damage:
        return False
    return True


def read_at(file: BinaryIO, position: int, length: int) -> bytes:
    """`length` bytes from `position` on, whoever else reads the file; Damage if they are no longer there."""
    data = os.pread(file.fileno(), length, position)
    if len(data) != length:
        raise Damage(position, "the file has become shorter since it was opened")
    return data


def _chunk_frames(data: bytes, position: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, start of the body, its end) of the records in a chunk."""
    place = 0
    while place < len(data):
        try:
            opcode, length = _FRAME.unpack_from(data, place)
        except struct.error as error:
            raise Damage(position, f"the chunk holds half a record: {error}") from error
        start, place = place + _FRAME.size, place + _FRAME.size + length
        if place > len(data):
            raise Damage(position, "the chunk holds half a record")
        yield opcode, start, place


def _only_zeros_follow(file: BinaryIO) -> bool:
    while block := file.read(1 << 20):
        if block.count(0) != len(block):
            return False
    return True
