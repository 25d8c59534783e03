"""One recording of several of the same run: of its segments, or of what recorders in different places heard."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from enum import Enum, auto
from pathlib import Path
from typing import Any

from zfusion.errors import InputError, MessageError
from zfusion.messages import read_stamp
from zfusion.recording import layout
from zfusion.recording.channels import Description
from zfusion.recording.derived import OF_ITS_PLACE, DerivedWriter
from zfusion.recording.reader import Record, Recording

WINDOW = 1 << 18
"""Messages that are remembered, to recognise them where another recorder has them, too: some 60 MB."""

EVERY = 4096
"""Messages after which it is told how far it is."""

NAMED = 20
"""Topics with conflicts that are named."""


@dataclass(frozen=True, slots=True)
class Merged:
    """What was put together."""

    output: str
    sources: tuple[str, ...]
    messages: int
    duplicates: int
    """Messages that several of the recordings have; one of each is kept."""
    conflicts: int
    """Messages of the same counters on the same key, and other contents, in different recordings: all are kept."""
    conflicting: tuple[str, ...]
    """Topics on which there are such."""
    still_twice: int
    """Messages that are on the result more than once: they came so, or too long apart to be recognised."""

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self)


class Verdict(Enum):
    """What a message is beside those before it."""

    NEW = auto()
    DUPLICATE = auto()
    CONFLICT = auto()


class Known:
    """The messages that came last, by key and counters, and which recording they were in."""

    def __init__(self, window: int) -> None:
        self._window = window
        self._seen: dict[tuple[object, ...], list[tuple[int, int]]] = {}

    def judge(self, source: int, record: Record) -> Verdict:
        """What a message of the source of that number is; it is remembered.

        What one source has twice was on the wire twice. Messages without counters are the same only if they came at
        the same nanosecond.
        """
        digest = hash(record.data)
        try:
            stamp = read_stamp(record.data)
        except MessageError:
            identity: tuple[object, ...] = (record.topic, None, record.log_time_ns, digest)
        else:
            identity = (record.topic, stamp.born, stamp.seq)
        seen = self._seen.get(identity)
        if seen is None:
            if len(self._seen) >= self._window:
                del self._seen[next(iter(self._seen))]
            self._seen[identity] = [(source, digest)]
            return Verdict.NEW
        same = [of for of, known in seen if known == digest]
        if same:
            return Verdict.NEW if source in same else Verdict.DUPLICATE
        others = any(of != source for of, _ in seen)
        seen.append((source, digest))
        return Verdict.CONFLICT if others else Verdict.NEW


def merge(sources: Sequence[Path], output: Path, advance: Callable[[int], None] = lambda _: None) -> Merged:
    """Put recordings of the same run together in one, `output`, in the order of their times.

    A file that has segments after it brings them along. `advance` is told how many more messages are done. Memory
    grows neither with the number of messages nor with their size, beyond `WINDOW`. InputError if they are not of the
    same run, or `output` is one of them; otherwise as `Recording.open` and `DerivedWriter`.
    """
    with ExitStack() as stack:
        recordings = _different([stack.enter_context(Recording.open(path)) for path in sources])
        first = recordings[0]
        for other in recordings[1:]:
            _check_same_run(first, other)
        facts = {name: value for name, value in first.metadata.items() if name not in OF_ITS_PLACE}
        descriptions: dict[str, Description] = {}
        for recording in reversed(recordings):
            descriptions |= recording.descriptions
        files = [file for recording in recordings for file in recording.files]
        of = descriptions.__getitem__
        inputs = [path for recording in recordings for path in recording.not_to_replace]
        with DerivedWriter(output, inputs, facts, first.scenario_toml, of, first.design) as writer:
            counts, conflicting = _copy(recordings, writer, advance)
            alone = len(recordings) == 1 and first.statistics is not None
            statistics = first.statistics if alone and first.statistics is not None else writer.accounts.gaps()
            told = Merged(
                output=str(output),
                sources=tuple(map(str, files)),
                messages=writer.messages,
                duplicates=counts[Verdict.DUPLICATE],
                conflicts=counts[Verdict.CONFLICT],
                conflicting=tuple(conflicting)[:NAMED],
                still_twice=sum(gaps.duplicates for gaps in writer.accounts.gaps().values()),
            )
            lacking = () if _is_whole(recordings, writer.messages) else (r for r in recordings if r.note)
            note = "; ".join(f"{r.path.name}: {r.note}" for r in lacking)
            writer.finish("merged", files, note, told.as_dict(), statistics=statistics)
    return told


def _is_whole(recordings: Sequence[Recording], messages: int) -> bool:
    """Whether nothing is missing, whatever the recordings say of themselves.

    What is on one of them that is complete is all there. And parts of one complete recording that have together as many
    different messages as that has are all of it.
    """
    if any(recording.complete for recording in recordings):
        return True
    facts = {tuple(map(recording.derived.get, (layout.CUT_FROM, layout.OF_MESSAGES))) for recording in recordings}
    origin, of = facts.pop()
    return not facts and origin is not None and of == str(messages)


def _copy(
    recordings: Sequence[Recording], writer: DerivedWriter, advance: Callable[[int], None]
) -> tuple[dict[Verdict, int], dict[str, None]]:
    """Copy all messages; how many of them are what, and the topics with conflicts."""
    known = Known(WINDOW)
    counts = dict.fromkeys(Verdict, 0)
    conflicting: dict[str, None] = {}
    for done, (source, record) in enumerate(_in_order(recordings), 1):
        verdict = Verdict.NEW if len(recordings) == 1 else known.judge(source, record)
        counts[verdict] += 1
        if verdict is Verdict.CONFLICT:
            conflicting[record.topic] = None
        if verdict is not Verdict.DUPLICATE:
            writer.add(record)
        if done % EVERY == 0:
            advance(EVERY)
    return counts, conflicting


def _in_order(recordings: Sequence[Recording]) -> Iterator[tuple[int, Record]]:
    """All messages with their source's number, by their log times."""
    streams = [_numbered(number, recording) for number, recording in enumerate(recordings)]
    return heapq.merge(*streams, key=lambda numbered: numbered[1].log_time_ns)


def _numbered(number: int, recording: Recording) -> Iterator[tuple[int, Record]]:
    for record in recording.records():
        yield number, record


def _different(recordings: Iterable[Recording]) -> list[Recording]:
    """The recordings without those that are parts of others: segments that were named beside their first."""
    chosen: list[Recording] = []
    for recording in sorted(recordings, key=lambda r: -len(r.files)):
        own = {path.resolve() for path in recording.files}
        if not any(own <= {path.resolve() for path in other.files} for other in chosen):
            chosen.append(recording)
    return chosen


def _check_same_run(first: Recording, other: Recording) -> None:
    for fact in ("run", "method", "seed"):
        one, two = first.metadata.get(fact), other.metadata.get(fact)
        if one != two:
            raise InputError(f"{other.path}: {fact}: expected {one!r}, as in {first.path} (is {two!r})")
    if first.scenario_toml != other.scenario_toml:
        raise InputError(f"{other.path}: scenario.toml: expected the same as in {first.path}")
