"""Reading a recording, whether it is in one file or in several, finished or broken off."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from zfusion.gaps import Gaps
from zfusion.recording import layout
from zfusion.recording.channels import Description
from zfusion.recording.file import EVER, Record, RecordedFile, TooShort

__all__ = ["Record", "Recording"]


class Recording:
    """A recording, open for reading. A context manager; made by `Recording.open`."""

    def __init__(self, path: Path, files: Sequence[RecordedFile], notes: Iterable[str] = ()) -> None:
        """Of `files` that follow each other; `notes` say what is wrong with that."""
        first, last = files[0], files[-1]
        self._files = files
        self.path = path
        self.files = tuple(file.path for file in files)
        """Where it is: one file, or its segments."""
        in_segments = len(files) > 1 or first.number > 0
        self.not_to_replace = {*self.files, *(layout.all_segments(first.path, first.number) if in_segments else ())}
        """Where nothing is to be written while this is read: its files, and segments that it was not opened with."""
        self.size_bytes = sum(file.size_bytes for file in files)
        notes = [*(note for file in files for note in (file.note, file.derived.get("note", ""))), *notes]
        if layout.STOPPED in last.closing:
            notes.append(f"stopped before the run ended: {last.closing[layout.STOPPED]}")
        self.note = "; ".join(filter(None, notes))
        """What is not on it, of a recording that is not complete."""
        self.complete = not self.note
        """False for a recording that was broken off, or is a part only."""
        self.metadata: Mapping[str, str] = first.metadata
        """The facts of `zfusion.recording`: run, method, seed, versions, machine, clocks."""
        self.closing: Mapping[str, str] = last.closing
        """The facts of `zfusion.close`: how the recording ended; empty for one that was broken off."""
        self.derived: Mapping[str, str] = first.derived
        """How it was made from other recordings; empty if it was not."""
        self.scenario_toml = first.scenario_toml
        self.design = first.design
        """What the file of the method's design held; None where it has none, or nobody attached it."""
        self.topics: Mapping[str, int] = {
            topic: sum(file.topics.get(topic, 0) for file in files)
            for topic in dict.fromkeys(topic for file in files for topic in file.topics)
        }
        """Messages of every topic, in the order in which the topics first appeared."""
        self.descriptions: Mapping[str, Description] = {
            topic: of for file in reversed(files) for topic, of in file.descriptions.items()
        }
        """What the files say of the topics."""
        self.messages = sum(self.topics.values())
        times = [(file.start_ns, file.end_ns) for file in files if any(file.topics.values())] or [(0, 0)]
        self.start_ns = times[0][0]
        """Log time of the first message; 0 if there is none."""
        self.end_ns = times[-1][1]
        """Log time of the last message; 0 if there is none."""

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Self:
        """The recording that begins in the file at `path`, with the segments that follow it.

        If that file was removed to make room for later ones, the first that is there. RecordingError, naming the
        file, if one cannot be read or trusted.
        """
        path = Path(path)
        there = path
        if not path.exists():
            there = min(layout.later_segments(path), default=(0, path))[1]
        files = [RecordedFile.open(there)]
        notes = []
        try:
            if files[0].number and (there != path or layout.PREVIOUS in files[0].metadata):
                notes.append(f"begins with segment {files[0].number}: the ones before are not here")
            notes += _follow(files)
        except BaseException:
            for file in files:
                file.close()
            raise
        return cls(path, files, notes)

    @property
    def statistics(self) -> Mapping[str, Gaps] | None:
        """The writer's account of every topic; None for a recording that was broken off."""
        return self._files[-1].statistics

    def records(self, topics: Iterable[str] | None = None, start_ns: int = 0, end_ns: int = EVER) -> Iterator[Record]:
        """The messages in the order in which they came, from `start_ns` up to but not including `end_ns` (log time).

        `topics` leaves out all others. RecordingError if a file has changed since it was opened. Any number of
        iterations may go on at once.
        """
        chosen = None if topics is None else set(topics)
        for file in self._files:
            yield from file.records(chosen, start_ns, end_ns)

    def close(self) -> None:
        """Close the files; iterations that are under way end with an error."""
        for file in self._files:
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _follow(files: list[RecordedFile]) -> Iterator[str]:
    """Append the segments that follow the first file; what is wrong with that, in words."""
    first = layout.first_path(files[0].path, files[0].number)
    while True:
        last = files[-1]
        following = layout.segment_path(first, last.number + 1)
        promised = layout.NEXT in last.closing
        if (last.finished and not promised) or layout.IDENTITY not in last.metadata:
            return
        try:
            segment = RecordedFile.open(following) if following.exists() else None
        except TooShort as error:
            yield f"broken off: {error}"
            return
        if segment is None or not _belongs(segment, last):
            if segment is not None:
                segment.close()
            if promised:
                there = "not here" if segment is None else "of another recording"
                yield f"it goes on in {following.name}, which is {there}"
            return
        files.append(segment)


def _belongs(segment: RecordedFile, before: RecordedFile) -> bool:
    same = (layout.IDENTITY, "run", "method", "seed", "format")
    return (
        segment.number == before.number + 1
        and all(segment.metadata.get(fact) == before.metadata.get(fact) for fact in same)
        and segment.scenario_toml == before.scenario_toml
    )
