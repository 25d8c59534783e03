"""Finding what can be saved of a damaged file: every piece that proves itself, wherever it is.

A piece is a record with a checksum: a block of messages, an attachment, one of zfusion's metadata. The file is gone
through from piece to piece; where none follows, the next one is looked for, byte by byte. All else of a file can be
made anew from these. Nothing is kept in memory but where the blocks are.
"""

from __future__ import annotations

import mmap
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from zfusion.errors import RecordingError
from zfusion.recording import layout
from zfusion.recording.channels import from_metadata
from zfusion.recording.container import (
    MAGIC,
    MAX_RECORD,
    Damage,
    Frame,
    chunk_contents,
    chunk_length,
    frame_length,
    is_well_formed,
    parse,
    parse_attachment,
    unpack_chunk,
)

NAMED = 1000
"""Places of damage that are told one by one; the others are counted."""

_CANDIDATE = re.compile(
    rb"\x06(?=.{36}(?:\x04\0\0\0zstd|\x03\0\0\0lz4|\0\0\0\0))"  # a chunk, by its compression
    rb"|\x09(?=.{24}(?:\x0d\0\0\0scenario\.toml|\x0a\0\0\0design\.npz))"
    rb"|\x0c(?=.{8}.\0\0\0zfusion\.)",
    re.DOTALL,
)
"""Where a piece may begin."""


class Place(NamedTuple):
    """A block of messages that is as it was written."""

    start_ns: int
    """Log time of its first message."""
    end_ns: int
    position: int
    """Of its body, in the file."""
    length: int


class Loss(NamedTuple):
    """Bytes that could not be saved."""

    position: int
    length: int
    why: str


@dataclass(slots=True)
class Found:
    """What a file holds that proves itself."""

    places: list[Place] = field(default_factory=list)
    messages: Counter[int] = field(default_factory=Counter)
    """By channel."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    scenario_toml: str | None = None
    design: bytes | None = None
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    disputed: set[int] = field(default_factory=set)
    """Channels that two pieces declare otherwise."""
    kept_bytes: int = 0
    """Of the pieces."""
    lost: list[Loss] = field(default_factory=list)
    losses: int = 0
    lost_bytes: int = 0
    repeated: int = 0
    """Blocks that were there before."""


class Salvage:
    """One pass over a file."""

    def __init__(self, file: BinaryIO, advance: Callable[[int], None]) -> None:
        """`advance` is told how many more bytes are behind us. RecordingError for an empty file."""
        try:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError:
            raise RecordingError("is empty") from None
        self._advance = advance
        self._seen: set[bytes] = set()
        self._found = Found()

    def run(self) -> Found:
        """Find all pieces. RecordingError where they are not of one recording."""
        found, data, size = self._found, self._data, len(self._data)
        behind = place = len(MAGIC) if data[: len(MAGIC)] == MAGIC else 0
        self._advance(behind)
        while (candidate := _CANDIDATE.search(data, place)) is not None:
            start = candidate.start()
            end, why = self._take(start)
            if why:
                place = end
                continue
            found.kept_bytes += end - start
            self._account(behind, start)
            self._advance(end - behind)
            behind = place = end
        self._account(behind, size)
        self._advance(size - behind)
        found.places.sort()
        return found

    def close(self) -> None:
        """Let go of the file."""
        self._data.close()

    def _take(self, start: int) -> tuple[int, str]:
        """(end, "") of a piece that begins there; (where to look on, why not) if none does."""
        end = start + frame_length(self._data, start)
        if end > len(self._data) or end - start > MAX_RECORD:
            return start + 1, "not all there"
        opcode = self._data[start]
        if opcode == Opcode.CHUNK and chunk_length(self._data, start) != end - start:
            return start + 1, "not a chunk"
        frame = Frame(opcode, start, self._data[start : start + 9], self._data[start + 9 : end])
        try:
            take = {Opcode.CHUNK: self._chunk, Opcode.ATTACHMENT: self._attachment, Opcode.METADATA: self._metadata}
            take[Opcode(opcode)](frame)
        except Damage as damage:
            # What is in a block that has its length, and damage, is payload, whatever it looks like.
            bounded = opcode == Opcode.CHUNK and is_well_formed(self._data, end)
            return (end if bounded else start + 1), damage.what
        return end, ""

    def _chunk(self, frame: Frame) -> None:
        _, data = unpack_chunk(frame.body, frame.position)
        declared, counts, start_ns, end_ns = chunk_contents(data, frame.position)
        for declaration in declared:
            self._declare(declaration)
        digest = blake2b(data, digest_size=16).digest()
        if digest in self._seen:
            self._found.repeated += 1
            return
        self._seen.add(digest)
        self._found.messages.update(counts)
        self._found.places.append(Place(start_ns, end_ns, frame.position + len(frame.head), len(frame.body)))

    def _attachment(self, frame: Frame) -> None:
        attachment: Attachment = parse_attachment(frame)
        if attachment.name == layout.SCENARIO:
            self._note_scenario(attachment.data.decode())
        elif attachment.name == layout.DESIGN:
            self._found.design = attachment.data

    def _metadata(self, frame: Frame) -> None:
        metadata = parse(Metadata, frame)
        name, facts = metadata.name, metadata.metadata
        if not layout.is_intact(facts):
            raise Damage(frame.position, f"nothing says that a {name} is as it was written")
        if name != layout.CHANNELS:
            self._note_facts(name, facts)
            return
        table = from_metadata(facts)
        declarations: list[Channel | Schema] = [*table.channels, *table.schemas]
        for declaration in declarations:
            self._declare(declaration)
        if table.facts:
            self._note_facts(layout.RECORDING, layout.sealed(table.facts))
            self._note_scenario(table.scenario_toml)

    def _declare(self, declaration: Channel | Schema) -> None:
        if isinstance(declaration, Schema):
            self._found.schemas.setdefault(declaration.id, declaration)
        elif self._found.channels.setdefault(declaration.id, declaration).topic != declaration.topic:
            self._found.disputed.add(declaration.id)

    def _note_facts(self, name: str, facts: dict[str, str]) -> None:
        if self._found.metadata.setdefault(name, facts) != facts:
            raise RecordingError(f"holds pieces of more than one recording: two records {name} differ")

    def _note_scenario(self, scenario_toml: str) -> None:
        if self._found.scenario_toml is None:
            self._found.scenario_toml = scenario_toml
        elif self._found.scenario_toml != scenario_toml:
            raise RecordingError("holds pieces of more than one recording: two scenarios differ")

    def _account(self, start: int, end: int) -> None:
        """Tell what of the bytes between two pieces is damage; the rest are indexes, which are made anew."""
        place, data = start, self._data
        while place < end and not self._is_end(place):
            length = frame_length(data, place)
            whole = is_well_formed(data, place) and place + length <= end
            if whole and data[place] != Opcode.CHUNK:
                place += length
                continue
            length = length if whole else end - place
            self._lose(place, length)
            place += length

    def _is_end(self, place: int) -> bool:
        """Whether nothing but the mark of a finished file's end is left. Copies no more than that."""
        return len(self._data) - place == len(MAGIC) and self._data[place:] == MAGIC

    def _lose(self, place: int, length: int) -> None:
        self._found.losses += 1
        self._found.lost_bytes += length
        if len(self._found.lost) < NAMED:
            self._found.lost.append(Loss(place, length, self._why(place, place + length)))

    def _why(self, start: int, end: int) -> str:
        if all(block.count(0) == len(block) for block in self._blocks(start, end)):
            return "zeros"
        if end - start < 9 or start + frame_length(self._data, start) > len(self._data):
            return "a record that is not all there" if end == len(self._data) else "no record"
        return self._take_again(start)

    def _take_again(self, start: int) -> str:
        known = self._data[start] in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA)
        return (self._take(start)[1] if known else "") or "no record"

    def _blocks(self, start: int, end: int) -> Iterator[bytes]:
        for place in range(start, end, 1 << 20):
            yield self._data[place : min(place + (1 << 20), end)]
