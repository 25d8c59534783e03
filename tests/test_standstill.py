"""Processes that somebody has stopped: what a run can only wait for it does not wait for for ever."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from swarms import wait_until
from zfusion.swarm.control import ChildEnd, LauncherEnd
from zfusion.swarm.standstill import LOOK_S, STANDSTILL_S, Standstill, is_stopped

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nobody can see who is stopped")


@pytest.fixture
def sleeper() -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE) as process:
        yield process.pid
        process.kill()


def stop(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: is_stopped(pid), "it stands still")


def test_who_has_ended_is_not_stopped(sleeper: int) -> None:
    assert is_stopped(sleeper) is False
    stop(sleeper)
    assert is_stopped(sleeper) is True
    assert is_stopped(2**22) is False


def test_a_run_that_has_not_begun_waits_for_each(sleeper: int) -> None:
    standstill, processes = Standstill(), {"node 1": sleeper, "node 2": os.getpid()}
    assert standstill.overdue(processes, begun=False, now=100.0) == []
    stop(sleeper)
    assert standstill.overdue(processes, begun=False, now=101.0) == []
    assert standstill.overdue(processes, begun=False, now=100.9 + STANDSTILL_S) == []
    assert standstill.overdue(processes, begun=False, now=102.0 + STANDSTILL_S) == ["node 1"]
    assert standstill.overdue(processes, begun=False, now=102.0 + STANDSTILL_S + LOOK_S / 2) == []  # not so often


def test_a_run_that_has_begun_waits_for_none_while_one_takes_steps(sleeper: int) -> None:
    stop(sleeper)
    standstill, both = Standstill(), {"node 1": sleeper, "node 2": os.getpid()}
    assert standstill.overdue(both, begun=True, now=100.0) == []
    assert standstill.overdue(both, begun=True, now=200.0) == []
    assert standstill.overdue({"node 1": sleeper}, begun=True, now=300.0) == []
    assert standstill.overdue({"node 1": sleeper}, begun=True, now=300.0 + STANDSTILL_S) == ["node 1"]
    os.kill(sleeper, signal.SIGCONT)
    wait_until(lambda: not is_stopped(sleeper), "it is set going")
    assert standstill.overdue({"node 1": sleeper}, begun=True, now=400.0) == []


def test_nobody_is_held_up_by_a_launcher_that_does_not_listen() -> None:
    launcher = LauncherEnd()
    child = ChildEnd(socket.socket(fileno=os.dup(launcher.child.fileno())).detach())
    launcher.child.close()
    for n in range(5000):  # far more than there is room for
        child.tell(status={"step": n, "what": "x" * 500})
    heard = list(launcher.messages())
    steps = [message["status"]["step"] for message in heard]
    assert 10 < len(steps) < 5000
    assert steps == list(range(len(steps)))  # whole messages, the oldest
    child.tell(report={"done": True})
    *rest, last = launcher.messages()
    assert last == {"report": {"done": True}}
    assert len(rest) <= 1  # what had been begun
    launcher.close()
    child.tell(status={})
    child.tell(report={})
    child._socket.close()
