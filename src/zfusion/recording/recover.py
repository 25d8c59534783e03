"""Making a whole recording of a damaged one: everything that can be saved, and an account of what cannot."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mcap.records import Channel

from zfusion.errors import RecordingError
from zfusion.recording import layout
from zfusion.recording.accounts import stated_accounts
from zfusion.recording.channels import described
from zfusion.recording.container import chunk_messages, read_at, unpack_chunk
from zfusion.recording.derived import DerivedWriter
from zfusion.recording.file import EVER, Record
from zfusion.recording.paths import open_to_read
from zfusion.recording.salvage import Found, Loss, Place, Salvage


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of a file."""

    source: str
    output: str
    size_bytes: int
    kept_bytes: int
    """In records that proved themselves."""
    chunks: int
    messages: int
    dropped: tuple[Loss, ...]
    """Bytes that are not what was written; the first thousand places."""
    dropped_places: int
    dropped_bytes: int
    repeated_chunks: int
    """That were there twice; left out the second time."""
    orphaned: Mapping[str, int]
    """Messages that were left out because nothing says what their channel was, by its number."""
    written: int | None
    """Messages that there were, as the recorder said at the end; None if that is not there."""
    lost_by_counters: int
    """Messages missing by the senders' counters, whether they came to the recorder or not."""
    end_is_missing: bool

    @property
    def lossy(self) -> bool:
        """Whether messages that were on the file may not have been saved."""
        if self.orphaned:
            return True
        return self.dropped_places > 0 if self.written is None else self.messages < self.written

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self) | {"lossy": self.lossy, "dropped": [loss._asdict() for loss in self.dropped]}


def recover(source: Path, output: Path, advance: Callable[[int], None] = lambda _: None) -> Recovery:
    """Save what can be saved of the file `source` in a new recording, `output`.

    Only what proves itself by a checksum is taken: every message is one of the original's, on its topic and with its
    times. Reads the file twice, in memory that grows by some hundred bytes with each block of messages. `advance` is
    told how many more bytes have been gone through, of twice the file's size.

    RecordingError if there is nothing to be saved, or the file holds pieces of several recordings; InputError if
    `output` is the file itself; RunError if it cannot be written to its end.
    """
    try:
        with open_to_read(source) as file:
            return _recover(source, file, output, advance)
    except (RecordingError, OSError, UnicodeDecodeError) as error:
        if isinstance(error, RecordingError) and str(error).startswith((f"{source}:", f"{output}:")):
            raise
        words = f"cannot be read: {error.strerror}" if isinstance(error, OSError) else error
        raise RecordingError(f"{source}: {words}") from error


def _recover(source: Path, file: BinaryIO, output: Path, advance: Callable[[int], None]) -> Recovery:
    salvage = Salvage(file, advance)
    try:
        found = salvage.run()
    finally:
        salvage.close()
    facts = found.metadata.get(layout.RECORDING)
    if facts is None or found.scenario_toml is None:
        raise RecordingError("what the recording is of is nowhere on it: nothing can be saved")
    if facts.get("format") != layout.FORMAT:
        raise RecordingError(f"is a recording of format {facts.get('format')}; this zfusion reads {layout.FORMAT}")
    known = _known_channels(found)
    descriptions = {channel.topic: described(channel, found.schemas) for channel in known.values()}
    of = descriptions.__getitem__
    kept = _not_to_replace(source, found, facts)
    with DerivedWriter(output, kept, facts, found.scenario_toml, of, found.design) as writer:
        for place in found.places:
            for record in _records(file, place, known, found):
                writer.add(record)
            advance(place.length)
        told = _tell(source, file, output, found, known, writer)
        _finish(source, found, writer, told)
    return told


def _not_to_replace(source: Path, found: Found, facts: Mapping[str, str]) -> tuple[Path, ...]:
    """The file itself and, where it may be one of several, the other segments that there are."""
    number, closing = int(facts.get(layout.SEGMENT, "0")), found.metadata.get(layout.CLOSE)
    in_segments = number > 0 or closing is None or layout.NEXT in closing
    return source, *(layout.all_segments(source, number) if in_segments else ())


def _known_channels(found: Found) -> dict[int, Channel]:
    """The channels whose topic is beyond doubt: of those that messages are of, and the others."""
    return {number: channel for number, channel in found.channels.items() if number not in found.disputed}


def _records(file: BinaryIO, place: Place, known: Mapping[int, Channel], found: Found) -> Iterator[Record]:
    _, data = unpack_chunk(read_at(file, place.position, place.length), place.position)
    topics = {number: known[number].topic if number in known else None for number in found.messages}
    return map(Record._make, chunk_messages(data, place.position, topics, 0, EVER))


def _tell(
    source: Path, file: BinaryIO, output: Path, found: Found, known: Mapping[int, Channel], writer: DerivedWriter
) -> Recovery:
    closing = found.metadata.get(layout.CLOSE)
    written = None if closing is None else int(closing.get(layout.IN_SEGMENT, closing.get("messages", "0")))
    return Recovery(
        source=str(source),
        output=str(output),
        size_bytes=os.fstat(file.fileno()).st_size,
        kept_bytes=found.kept_bytes,
        chunks=len(found.places),
        messages=writer.messages,
        dropped=tuple(found.lost),
        dropped_places=found.losses,
        dropped_bytes=found.lost_bytes,
        repeated_chunks=found.repeated,
        orphaned={str(number): count for number, count in found.messages.items() if number not in known},
        written=written,
        lost_by_counters=sum(gaps.lost for gaps in writer.accounts.gaps().values()),
        end_is_missing=closing is None,
    )


def _finish(source: Path, found: Found, writer: DerivedWriter, told: Recovery) -> None:
    notes = []
    if told.written is not None and told.messages < told.written:
        notes.append(f"{told.written - told.messages} of {told.written} messages could not be saved")
    elif told.lossy:
        lost = [f"{told.dropped_bytes} bytes at {told.dropped_places} places"] if told.dropped_places else []
        lost += [f"{sum(told.orphaned.values())} messages of unknown topics"] if told.orphaned else []
        notes.append(f"{' and '.join(lost)} could not be saved")
    if told.end_is_missing:
        notes.append("its end, with the accounts of what was sent, is missing")
    before = found.metadata.get(layout.DERIVED, {}).get("note", "")
    note = f"recovered from {source.name}: {', '.join(notes)}" if notes else ""
    original = found.metadata.get(layout.STATISTICS)
    kept = original is not None and not notes
    statistics = stated_accounts(original) if kept and original is not None else writer.accounts.gaps()
    closing = found.metadata.get(layout.CLOSE)
    writer.finish(
        "recovered",
        [source],
        "; ".join(filter(None, (before, note))),
        told.as_dict(),
        statistics=statistics,
        closing=None if closing is None else layout.unsealed(closing),
    )
