"""What a zfusion recording is made of, beyond what MCAP says: the names and versions that writer and reader share.

Metadata  zfusion.recording   first record of the file: format, run, method, seed, versions, machine, clocks; segment
Attachment scenario.toml      the scenario
Attachment design.npz         the design of its method, where that is designed off-line
Chunks                        one channel per Zenoh key; message data are the wire bytes
Metadata  zfusion.channels    again and again: what the channels are, and from time to time the two above once more
Metadata  zfusion.derived     in a file made from others: how, of which, and what is not on it
Metadata  zfusion.stats       at the close: the account of every topic, since the recording's beginning
Metadata  zfusion.close       at the close: how the recording ended, and the next segment

A recording may be in several files, its *segments*: ``name.mcap``, ``name.1.mcap``, ``name.2.mcap``, ... Each is a
whole recording by itself.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

FORMAT = "1"
"""Version of this layout; a reader refuses every other."""

PROFILE = "zfusion"
MESSAGE_ENCODING = "msgpack"
SCHEMA_ENCODING = "jsonschema"

RECORDING = "zfusion.recording"
CHANNELS = "zfusion.channels"
DERIVED = "zfusion.derived"
STATISTICS = "zfusion.stats"
CLOSE = "zfusion.close"

SCENARIO = "scenario.toml"
SCENARIO_TYPE = "application/toml"

DESIGN = "design.npz"
DESIGN_TYPE = "application/zip"

CHECKSUM = "checksum"

MAX_TOPICS = 65_535
"""What an MCAP file can name; a run with more keys is an attack."""

IDENTITY = "recording"
"""Fact: the same in all segments of a recording, and in no other recording."""
SEGMENT = "segment"
"""Fact: the segment's number, from 0."""
PREVIOUS = "previous"
"""Fact: the name of the file before, in segments from 1 on."""
NEXT = "next"
"""Fact at the close: the name of the file in which the recording goes on."""
IN_SEGMENT = "segment_messages"
"""Fact at the close: messages in this file."""
CUT_FROM = "cut_from"
"""Fact of what was cut from a complete recording: the identity of that."""
OF_MESSAGES = "of_messages"
"""Fact beside it: the messages of that."""
STOPPED = "stopped"
"""Fact at the close: why the recording ended before the run did."""


def sealed(facts: Mapping[str, str]) -> dict[str, str]:
    """`facts` and their checksum: MCAP guards its metadata only in files that were finished."""
    return {**facts, CHECKSUM: _checksum(facts)}


def is_intact(facts: Mapping[str, str]) -> bool:
    """Whether the checksum among the facts is theirs."""
    return facts.get(CHECKSUM) == _checksum(unsealed(facts))


def unsealed(facts: Mapping[str, str]) -> dict[str, str]:
    """The facts without their checksum."""
    return {name: value for name, value in facts.items() if name != CHECKSUM}


def segment_path(first: Path, number: int) -> Path:
    """Where the segment of that number is, if the first one is at `first`."""
    return first if number == 0 else first.with_name(f"{first.stem}.{number}{first.suffix}")


def first_path(path: Path, number: int) -> Path:
    """Where the first segment is, if the one of that number is at `path`."""
    return path.with_name(f"{path.stem.removesuffix(f'.{number}')}{path.suffix}") if number else path


def later_segments(first: Path) -> Iterator[tuple[int, Path]]:
    """The segments that there are, by their names, after the first one, whose place is `first`: number and place."""
    name = re.compile(rf"{re.escape(first.stem)}\.([1-9]\d{{0,8}}){re.escape(first.suffix)}")
    if first.parent.is_dir():
        for path in first.parent.iterdir():
            if found := name.fullmatch(path.name):
                yield int(found[1]), path


def all_segments(path: Path, number: int) -> tuple[Path, ...]:
    """The segments that there are, by their names, of the recording of which that one is at `path`."""
    first = first_path(path, number)
    return first, *(later for _, later in later_segments(first))


def _checksum(facts: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(facts.items())).encode()):08x}"
