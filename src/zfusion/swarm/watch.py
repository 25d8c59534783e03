"""Watches the processes of a swarm over a long run: what the machine says of each, and what the nodes tell.

Samples go to a CSV file as they are taken, a row a process; none is kept in memory, so that whoever watches for growth
does not grow.
"""

from __future__ import annotations

import csv
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zfusion.drivers.health import COUNTERS, QUEUES
from zfusion.drivers.metrics import Latencies
from zfusion.errors import InputError
from zfusion.model.types import NodeId
from zfusion.swarm.child import Child

NODE, RECORDER, LAUNCHER = "node", "recorder", "launcher"
"""Kinds of processes."""

OF_ALL = ("anonymous_bytes", "uss_bytes", "pss_bytes", "rss_bytes", "fds", "threads", "cpu_s")
"""What the machine says of a process: memory that no file backs (USS, where that is not known); memory that it would
give back if it ended (USS); the same and its part of what it shares (PSS); all that is resident (RSS); descriptors,
threads, CPU time since it began."""

OF_RECORDER = ("messages", "foreign")

OF_LAUNCHER = ("recording_bytes", "logs_bytes", "disk_free_bytes")

ROUND = "round"


def quantile_columns(stages: Sequence[str]) -> list[str]:
    """Columns of the medians and 99 % quantiles of a round and of each stage's wait, in µs, over one interval."""
    return [f"{name}_{q}_us" for name in (ROUND, *stages) for q in ("p50", "p99")]


def check_watching() -> None:
    """InputError, with what to install, where processes cannot be watched."""
    if find_spec("psutil") is None:
        raise InputError("watching processes needs psutil: pip install 'zfusion[soak]'")


class Watch:
    """A context manager; `update` is called often, and takes a sample when it is time to.

    Raises InputError where `path` cannot be written.
    """

    def __init__(
        self, path: Path, stages: Sequence[str], interval_s: float, *, recording: Path | None, logs: Path
    ) -> None:
        self.samples = 0
        """Times that all processes were looked at."""
        self.unwritten = 0
        """Rows that could not be written: the disk is full."""
        self.began = time.monotonic()
        self._interval_s, self._stages = interval_s, tuple(stages)
        self._recording, self._logs = recording, logs
        self._due = self.began + interval_s
        self._processes: dict[int, Any] = {}
        self._before: dict[NodeId, tuple[int, Mapping[str, Any]]] = {}
        """The last health of each node's present process."""
        quantiles = quantile_columns(stages)
        columns = ["t_s", "kind", "process", "pid", "restarts", *OF_ALL, "health_age_s", *COUNTERS, *QUEUES]
        try:
            self._file = path.open("w", newline="", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self._rows = csv.DictWriter(self._file, [*columns, *quantiles, *OF_RECORDER, *OF_LAUNCHER], restval="")
        self._rows.writeheader()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # counted when it was written
            self._file.close()

    @property
    def elapsed_s(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    def recorded_bytes(self) -> int:
        """Of the recording, with those that it was continued in."""
        return 0 if self._recording is None else _size(self._recording.parent, f"{self._recording.stem}*.mcap")

    def update(self, nodes: Mapping[NodeId, Child], recorder: Child | None) -> None:
        """Look at all processes, if it is time to; what is no longer there is left out."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = max(self._due + self._interval_s, now)
        self.samples += 1
        at = {"t_s": round(now - self.began, 3)}
        try:
            for row in self._look(nodes, recorder):
                self._rows.writerow(at | row)
            self._file.flush()
        except OSError:
            self.unwritten += 1

    def _look(self, nodes: Mapping[NodeId, Child], recorder: Child | None) -> Iterator[dict[str, Any]]:
        seen = {os.getpid()}
        yield {"kind": LAUNCHER, "process": LAUNCHER, **self._of_process(os.getpid()), **self._of_disk()}
        children = [(NODE, child) for child in nodes.values()]
        children += [(RECORDER, recorder)] if recorder is not None else []
        for kind, child in children:
            pid = child.process.pid if child.running and child.process is not None else None
            found = {} if pid is None else self._of_process(pid)
            if pid is None or not found:
                continue
            seen.add(pid)
            told = {name: child.status.get(name, "") for name in OF_RECORDER} if kind == RECORDER else {}
            if child.node is not None and child.health:
                told = self._of_health(child.node, pid, child.health)
            name = RECORDER if child.node is None else child.node
            yield {"kind": kind, "process": name, "restarts": child.restarts, **found, **told}
        for pid in self._processes.keys() - seen:
            del self._processes[pid]

    def _of_process(self, pid: int) -> dict[str, Any]:
        """What the machine says of a process; empty where it has ended."""
        import psutil  # noqa: PLC0415 - of an extra

        try:
            process = self._processes.get(pid)
            if process is None:
                process = self._processes[pid] = psutil.Process(pid)
            with process.oneshot():
                memory, times = process.memory_full_info(), process.cpu_times()
                if not memory.rss:
                    return {}  # it has just ended
                return {
                    "pid": pid,
                    "anonymous_bytes": _anonymous(pid, memory.uss),
                    "uss_bytes": memory.uss,
                    "pss_bytes": getattr(memory, "pss", ""),
                    "rss_bytes": memory.rss,
                    "fds": process.num_fds(),
                    "threads": process.num_threads(),
                    "cpu_s": round(times.user + times.system, 3),
                }
        except (psutil.NoSuchProcess, psutil.AccessDenied):  # a zombie's files cannot be read, either
            return {}

    def _of_disk(self) -> dict[str, Any]:
        found: dict[str, Any] = {"logs_bytes": _size(self._logs, "*")}
        if self._recording is not None:
            found["recording_bytes"] = self.recorded_bytes()
        with suppress(OSError):
            found["disk_free_bytes"] = shutil.disk_usage(self._logs).free
        return found

    def _of_health(self, node: NodeId, pid: int, told: Mapping[str, Any]) -> dict[str, Any]:
        """What a node has told, and what its rounds and waits were like since the sample before."""
        before_pid, before = self._before.get(node, (pid, {}))
        if before_pid != pid:
            before = {}
        self._before[node] = pid, told
        row: dict[str, Any] = {name: told[name] for name in (*COUNTERS, *QUEUES)}
        row["health_age_s"] = round((time.time_ns() - told["t_ns"]) / 1e9, 3)
        row |= _quantiles(ROUND, told[ROUND], before.get(ROUND, {}))
        for stage in self._stages:
            row |= _quantiles(stage, told["waits"].get(stage, {}), before.get("waits", {}).get(stage, {}))
        return row


def _anonymous(pid: int, otherwise: int) -> int:
    """Bytes that no file backs. (A library's pages count as a process's own when the last other that has it ends.)"""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) * 1024
    return otherwise


def _quantiles(name: str, told: Mapping[str, int], before: Mapping[str, int]) -> dict[str, float]:
    """Of what was counted since `before`; empty where that is nothing."""
    since = Latencies({int(number): n for number, n in (Counter(told) - Counter(before)).items()})
    found = {f"{name}_p50_us": since.quantile_us(0.5), f"{name}_p99_us": since.quantile_us(0.99)}
    return {column: value for column, value in found.items() if value is not None}


def _size(directory: Path, pattern: str) -> int:
    """Bytes of the files in a directory that match."""
    total = 0
    with suppress(OSError):
        for path in directory.glob(pattern):
            with suppress(OSError):  # it was removed since it was listed
                total += path.stat().st_size
    return total
