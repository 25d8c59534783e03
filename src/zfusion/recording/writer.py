"""Writing a recording: every message of a run as it was on the wire, in the order in which it came.

Whoever receives messages puts them in a queue, and one thread writes. After `flush`, what was written before survives
the death of the process; a thread of its own sees to what is to survive a power cut (`keeping.Syncer`). A recording
that gets too large, or too long, goes on in another file (`layout`).
"""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from zfusion.errors import RecordingError, RunError
from zfusion.gaps import Gaps
from zfusion.recording import layout
from zfusion.recording.accounts import Accounts, to_state
from zfusion.recording.channels import by_stages
from zfusion.recording.claim import TAKEN, is_claimed
from zfusion.recording.keeping import Keeping, Syncer
from zfusion.recording.provenance import clocks, machine, software
from zfusion.recording.segment import STRIDE_BYTES, SegmentWriter
from zfusion.stages import Stage


class RecordingWriter:
    """An open recording. A context manager: leaving it finishes the file.

    `path` must be in a directory that is there; a file there is replaced, unless another process is writing it.
    `stages` are those of the method beside the built-in ones, for the schemas on the file; topics of other stages are
    recorded all the same. `design` is what the file of the method's design holds. `facts` are what else the caller
    knows of the run and wants on the file; `keeping` says when files are changed and when to stop. RecordingError if
    the file cannot be made, is written by another process, or there is no room for it; RunError from any method when
    writing fails (disk full): the file is closed then, and readable up to there.
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
        keeping: Keeping | None = None,
    ) -> None:
        self.path = Path(path)
        """Of the first file."""
        self.messages = 0
        """Messages written so far."""
        self.stopped = ""
        """Why nothing is written any more, where something was asked for that ends a recording."""
        self.unrecorded = 0
        """Messages that came after that."""
        self.accounts = Accounts()
        """What came of what was sent."""
        self._keeping = keeping or Keeping()
        self._scenario_toml, self._design, self._describe = scenario_toml, design, by_stages(stages)
        self._stride = min(STRIDE_BYTES, (self._keeping.rotate_bytes or STRIDE_BYTES) // 8)
        self._until_look = 0
        """Bytes until it is looked again what room there is."""
        self._log_time_ns = 0
        self._refused = 0
        self._number = 0
        self._kept = [self.path]
        self._rotate_at_ns: int | None = None
        origin = {"format": layout.FORMAT, "run": run, "method": method, "seed": "" if seed is None else str(seed)}
        start = clocks()
        identity = {layout.IDENTITY: f"{int(start['clock_realtime_ns']):x}-{os.getpid():x}"}
        self._facts = dict(facts or {}) | origin | software() | machine() | identity
        self._look_for_room()
        if self.stopped:
            raise RecordingError(f"{self.path}: cannot be written: {self.stopped}")
        self._segment = self._following(start)
        try:
            self._look_for_others()
            self._segment.open()
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        with self._writing():
            self._segment.begin()
        interval_ns = self._keeping.fsync_interval_ns
        self._syncer = Syncer(interval_ns) if interval_ns else None
        self._watch()

    @property
    def files(self) -> tuple[Path, ...]:
        """The files that are there, in order."""
        return tuple(self._kept)

    def write(self, topic: str, data: bytes, arrival_ns: int) -> None:
        """Record `data`, that came on the key `topic` at `arrival_ns`; once the recording is `stopped`, count it.

        Bytes that are not a legal message are recorded as they are, and counted. Arrival times that go back are
        raised to the last one, so that the order on the file is the order of time.
        """
        if self.stopped:
            self.unrecorded += 1
            return
        if self._segment.closed:
            raise RunError(f"{self.path}: the recording is closed")
        log_time = self._log_time_ns = max(self._log_time_ns, arrival_ns)
        with self._writing():
            if self._is_over(log_time, len(data)):
                self._rotate()
            if self.stopped:
                self.unrecorded += 1
                return
            if not self._segment.takes(topic):
                self._refused += 1
                return
            stamp = self.accounts.observe(topic, data)
            self._segment.add(topic, data, log_time, stamp.t_ns or log_time, stamp.seq & 0xFFFF_FFFF)
        self.messages += 1

    def flush(self) -> None:
        """Hand all that was written to the operating system: it survives the death of this process."""
        if self.stopped:
            return
        with self._writing():
            self._segment.flush()
            if self._syncer is not None and self._syncer.failure is not None:
                raise self._syncer.failure
            self._look_for_room()
            if self.stopped:
                self._close({layout.STOPPED: self.stopped})

    def lost(self) -> dict[str, int]:
        """By topic: what is missing so far between the messages that came, where anything is."""
        return {topic: gaps.lost_between for topic, gaps in self.accounts.gaps().items() if gaps.lost_between}

    def finish(
        self,
        *,
        sent: Mapping[str, Mapping[int, int]] | None = None,
        facts: Mapping[str, str] | None = None,
    ) -> dict[str, Gaps]:
        """Write the accounts and the indexes, and close the file; the accounts, by topic. Doing it again does nothing.

        `sent` tells, for the topics whose senders' own last words do not, how many messages they had put there, by
        their lives' first steps; `facts` are what the caller knows of how the run ended (queue, drops).
        """
        accounts = self.accounts.gaps(sent)
        if not self._segment.closed:
            with self._writing():
                self._close(facts or {}, accounts)
        if self._syncer is not None:
            self._syncer.close()
        return accounts

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def _is_over(self, now_ns: int, more: int) -> bool:
        """Whether a message of `more` bytes that comes now is for the next file; looks for room now and then."""
        self._until_look -= more
        if self._until_look < 0:
            self._until_look = STRIDE_BYTES
            self._look_for_room()
            if self.stopped:
                self._close({layout.STOPPED: self.stopped})
                return False
        keeping = self._keeping
        if self._rotate_at_ns is None:
            self._rotate_at_ns = now_ns + (keeping.rotate_ns or 2**63)
        return self._segment.messages > 0 and (
            now_ns >= self._rotate_at_ns or 0 < keeping.rotate_bytes < self._segment.size + more
        )

    def _look_for_room(self) -> None:
        least = self._keeping.min_free_bytes
        if least:
            with suppress(OSError):
                free = self._keeping.free_bytes(self.path)
                if free < least:
                    self.stopped = f"only {free} bytes are free on the disk, and min_free_bytes is {least}"

    def _look_for_others(self) -> None:
        """OSError if a recording that began at the same place is being written, though in another file by now."""
        if any(is_claimed(path) for _, path in layout.later_segments(self.path)):
            raise OSError(errno.EBUSY, TAKEN)

    def _following(self, start: dict[str, str]) -> SegmentWriter:
        """The file of the present number."""
        place = {layout.SEGMENT: str(self._number)}
        if self._number:
            place[layout.PREVIOUS] = layout.segment_path(self.path, self._number - 1).name
        return SegmentWriter(
            layout.segment_path(self.path, self._number),
            self._facts | start | place,
            self._scenario_toml,
            self._describe,
            design=self._design,
            compression=self._keeping.compression,
            stride_bytes=self._stride,
        )

    def _rotate(self) -> None:
        following = layout.segment_path(self.path, self._number + 1)
        with self._segment.claimed():  # the recording is ours at any moment
            self._close({layout.NEXT: following.name})
            self._number += 1
            self._rotate_at_ns = None
            self._segment = self._following(clocks())
            self._segment.open()
        self._segment.begin()
        self._watch()
        self._kept.append(following)
        while len(self._kept) > (self._keeping.max_files or len(self._kept)):
            self._kept.pop(0).unlink(missing_ok=True)

    def _watch(self) -> None:
        if self._syncer is not None:
            self._syncer.watch(self._segment.fileno(), self.path.absolute().parent)

    def _close(self, facts: Mapping[str, str], accounts: Mapping[str, Gaps] | None = None) -> None:
        """Finish the file that is open."""
        if accounts is None:
            accounts = self.accounts.gaps()
        counts = {"messages": self.messages, layout.IN_SEGMENT: self._segment.messages, "refused": self._refused}
        end = clocks() | {name: str(count) for name, count in counts.items()} | dict(facts)
        self._segment.finish({layout.STATISTICS: to_state(accounts), layout.CLOSE: end})

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> RunError:
        self._segment.abandon()
        return RunError(f"{self.path}: writing failed: {error.strerror}")
