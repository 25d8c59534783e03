"""How a recording is kept on the disk: in how many files of what size, and what survives what."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass
from os import fdatasync
from pathlib import Path
from typing import Self

from zfusion.model.schema.run import RecordingSpec


@dataclass(frozen=True, slots=True)
class Keeping:
    """What a writer is to do beside writing. By default: one file, that is left to the operating system."""

    compression: str = "zstd"
    rotate_bytes: int = 0
    """Size from which on a file is finished and the next one begun; 0: none."""
    rotate_ns: int = 0
    """Time, by the messages' arrival, after which that is done; 0: none."""
    max_files: int = 0
    """Files that are kept; of more, the oldest are removed; 0: all are kept."""
    min_free_bytes: int = 0
    """What is to be left free on the disk: the recording ends before."""
    fsync_interval_ns: int = 0
    """How often what was flushed is put on the disk; 0: whenever the operating system likes."""

    @classmethod
    def of(cls, spec: RecordingSpec) -> Self:
        """What a scenario says."""
        return cls(
            spec.compression,
            spec.rotate_bytes,
            round(spec.rotate_s * 1e9),
            spec.max_files,
            spec.min_free_bytes,
            round(spec.fsync_interval_s * 1e9),
        )

    def free_bytes(self, path: Path) -> int:
        """What an ordinary user could still write where `path` is. OSError if that cannot be told."""
        there = os.statvfs(path.parent)
        return there.f_bavail * there.f_frsize


class Syncer:
    """Has files put on the disk every so often, on a thread of its own: that takes 4 ms, and 50 ms at times.

    What was flushed longer ago than the interval, and the time it takes, survives a power cut.
    """

    def __init__(self, interval_ns: int) -> None:
        self.failure: OSError | None = None
        """What the disk said; nothing is synced any more then."""
        self.count = 0
        self._interval_s = interval_ns / 1e9
        self._wake = threading.Condition()
        self._current: int | None = None
        self._retired: list[int] = []
        self._open = True
        self._thread = threading.Thread(target=self._run, name="fsync", daemon=True)
        self._thread.start()

    def watch(self, descriptor: int, directory: Path) -> None:
        """From now on it is this file, new in `directory`; the one before is put on the disk a last time."""
        with self._wake:
            self._retire()
            self._current = os.dup(descriptor)
            self._retired.append(os.open(directory, os.O_RDONLY))  # so that the file's name survives, too
            self._wake.notify()

    def close(self) -> None:
        """Put all on the disk, and end."""
        with self._wake:
            self._retire()
            self._open = False
            self._wake.notify()
        self._thread.join()

    def _retire(self) -> None:
        if self._current is not None:
            self._retired.append(self._current)
            self._current = None

    def _run(self) -> None:
        going = True
        while going:
            with self._wake:
                if self._open and not self._retired:
                    self._wake.wait(self._interval_s)
                going = self._open
                last, self._retired = self._retired, []
                current = None if self._current is None else os.dup(self._current)
            for descriptor in (*last, *(() if current is None else (current,))):
                self._sync(descriptor)

    def _sync(self, descriptor: int) -> None:
        try:
            if self.failure is None:
                fdatasync(descriptor)
                self.count += 1
        except OSError as error:
            self.failure = error
        finally:
            with suppress(OSError):
                os.close(descriptor)
