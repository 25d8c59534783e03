"""The directory of an experiment: one file for every task that is done, written in one piece or not at all."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from zfusion.errors import InputError
from zfusion.studies.experiment.plan import Task

FAILED = ".failed.json"


class Store:
    """What has been done. OSErrors of writing are the caller's."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._runs = directory / "runs"

    @contextmanager
    def opened(self) -> Iterator[None]:
        """The directory for one process at a time; InputError where another has it, or it cannot be written."""
        try:
            self._runs.mkdir(parents=True, exist_ok=True)
            lock = (self.directory / ".lock").open("w")
        except OSError as error:
            raise InputError(f"{self.directory}: cannot be written: {error.strerror}") from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"{self.directory}: another experiment is writing there") from None
            yield

    def finished(self, hashes: Iterable[str]) -> set[str]:
        """Those that are done; a file that is damaged does not count."""
        return {of for of in hashes if self.load(of) is not None}

    def load(self, of: str) -> dict[str, Any] | None:
        """What became of a task; None if it is not done."""
        try:
            record = json.loads((self._runs / f"{of}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if isinstance(record, dict) and record.get("hash") == of and "rows" in record else None

    def save(self, task: Task, result: Mapping[str, Any]) -> None:
        """Keep what became of a task, or why it failed; the latter until it succeeds."""
        record = {"hash": task.hash, "world": task.world, "seed": task.seed, "burn_in": task.burn_in, **result}
        failure = self._runs / f"{task.hash}{FAILED}"
        if "error" in result:
            self.write(failure, json.dumps({**record, "scenario": task.scenario}).encode())
        else:
            self.write(self._runs / f"{task.hash}.json", json.dumps(record).encode())
            failure.unlink(missing_ok=True)

    def write(self, path: Path, content: bytes) -> None:
        """The whole file or, where that fails, what was there before."""
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            temporary.write_bytes(content)
            temporary.replace(path)
        except BaseException:  # Ctrl-C, too
            temporary.unlink(missing_ok=True)
            raise
