"""Processes that somebody has stopped (SIGSTOP) and that a run can only wait for: found, so that it does not for ever.

While others take steps a stopped node is merely missed, and is taken back in when it is set going. But nobody begins
without everybody, and a run has not ended before its last node has.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

STANDSTILL_S = 10.0
"""How long a run waits for stopped processes alone: long enough to be set going by hand, in a debugger say."""

LOOK_S = 1.0
"""How often processes are looked at."""


class Standstill:
    """For how long a run has been waiting for stopped processes alone."""

    def __init__(self) -> None:
        self._looks = 0.0
        self._since: float | None = None

    def overdue(self, processes: Mapping[str, int], *, begun: bool, now: float | None = None) -> list[str]:
        """Of the processes that the run waits for, by name, those that are stopped, where it has waited too long.

        One that has not begun waits for each of them; one that has, for those that still take steps: while there is
        one that does, none is overdue.
        """
        now = time.monotonic() if now is None else now
        if now < self._looks:
            return []
        self._looks = now + LOOK_S
        still = [name for name, pid in processes.items() if is_stopped(pid)]
        if not still or (begun and len(still) < len(processes)):
            self._since = None
            return []
        if self._since is None:
            self._since = now
        return still if now - self._since >= STANDSTILL_S else []


def is_stopped(pid: int) -> bool | None:
    """Whether a process stands still, by a signal; None where that cannot be seen."""
    if sys.platform != "linux":
        return None
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    except OSError:  # it has ended
        return False
