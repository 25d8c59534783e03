"""Processes that share work: what becomes of them, and of the work, when one is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from zfusion.drivers.workers import in_order
from zfusion.errors import RunError

PATIENCE_S = 90.0

ENDLESS = """
import os, threading
from zfusion.drivers.workers import in_order

def work(_):
    print(os.getpid(), flush=True)
    threading.Event().wait()

if __name__ == "__main__":
    list(in_order(work, [1, 2], jobs=2))
"""


@pytest.mark.parametrize("killer", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent_however_it_ends(tmp_path: Path, killer: signal.Signals) -> None:
    """All of them hold the pipe: it ends when the last of them has."""
    script = tmp_path / "endless.py"
    script.write_text(ENDLESS)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(parent.stdout.readline()) for _ in range(2)]
        parent.send_signal(killer)
        try:
            parent.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            for pid in pids:
                os.kill(pid, signal.SIGKILL)
            raise
        assert parent.returncode == -killer


def die_at_two(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_worker_that_is_killed_is_an_error_that_says_so() -> None:
    with pytest.raises(RunError, match="not done: its process died: killed, or out of memory"):
        list(in_order(die_at_two, [1, 2, 3], jobs=2))
