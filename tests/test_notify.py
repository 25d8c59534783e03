"""What supervisors are told: over a real datagram socket and a real file, by real processes."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from supervisors import Systemd
from swarms import Command, run_name, variant, wait_until, zfusion
from zfusion.drivers.notify import Health, Supervisor, verdict
from zfusion.drivers.registry import birth
from zfusion.errors import InputError

BIRTH = '{"ready": true, "status": "", "pid": 1, "at_ns": 1, "birth": 7}'

pytestmark = pytest.mark.timeout(method="thread")  # the other one uses the timer that the signs of life need


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    address = str(tmp_path / "notify") if request.param == "path" else f"@{run_name('notify')}"
    with Systemd(address) as listening:
        yield listening


def test_its_life_in_datagrams(systemd: Systemd) -> None:
    with Supervisor.of({"NOTIFY_SOCKET": systemd.address}) as supervisor:
        supervisor.waiting("joining")
        supervisor.waiting("joining")
        supervisor.ready("step 1")
        supervisor.ready("step 2")  # too soon after the first for people to read
    assert systemd.heard() == [
        "STATUS=starting",
        "STATUS=joining",
        "READY=1\nSTATUS=step 1",
        "STOPPING=1\nSTATUS=ended",
    ]


def test_a_failure_is_told_in_one_line(systemd: Systemd) -> None:
    with pytest.raises(InputError), Supervisor.of({"NOTIFY_SOCKET": systemd.address}):
        raise InputError("two\nREADY=1 lines")
    assert systemd.heard()[-1] == "STOPPING=1\nSTATUS=failed: two READY=1 lines"


def test_signs_of_life_while_the_main_thread_waits(tmp_path: Path) -> None:
    with Systemd(str(tmp_path / "notify")) as systemd:
        with Supervisor.of({"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "100000"}):
            lock = threading.Lock()
            lock.acquire()
            lock.acquire(timeout=0.2)
        assert systemd.heard().count("WATCHDOG=1") >= 2
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_another_process_watchdog_is_not_ours(systemd: Systemd) -> None:
    environment = {"NOTIFY_SOCKET": systemd.address, "WATCHDOG_USEC": "20000", "WATCHDOG_PID": "1"}
    with Supervisor.of(environment):
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_nobody_listening_ends_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with Supervisor.of({"NOTIFY_SOCKET": str(tmp_path / "nobody")}) as supervisor:
        supervisor.ready("well")
    assert [record.getMessage() for record in caplog.records if "cannot tell" in record.getMessage()] == [
        "cannot tell how this process is doing: [Errno 2] No such file or directory"
    ]


def test_what_could_not_be_told_is_told_later(tmp_path: Path) -> None:
    address, file = str(tmp_path / "notify"), tmp_path / "health"
    with Supervisor.of({"NOTIFY_SOCKET": address, "ZFUSION_HEALTH_FILE": str(file)}) as supervisor:
        supervisor.ready("working")
        assert Health.read(file).ready
        with Systemd(address) as systemd:
            supervisor.waiting("resting")
            assert systemd.heard() == ["READY=1\nSTATUS=resting"]


@pytest.mark.parametrize(
    "environment",
    [{"NOTIFY_SOCKET": "vsock:1"}, {"NOTIFY_SOCKET": "@"}, {"WATCHDOG_USEC": "-1"}, {"WATCHDOG_USEC": "0"}],
)
def test_a_wrong_environment_is_refused(environment: dict[str, str]) -> None:
    with pytest.raises(InputError, match="expected"):
        Supervisor.of(environment)


def test_health_file(tmp_path: Path) -> None:
    file = tmp_path / "health"
    with Supervisor.of({"ZFUSION_HEALTH_FILE": str(file)}) as supervisor:
        assert not Health.read(file).ready
        supervisor.ready("running")
        assert Health.read(file).ready
        assert zfusion(tmp_path, "health", file, "--json").summary["ok"]
    left = Health.read(file)
    assert (left.ready, left.status, left.pid) == (False, "ended", os.getpid())
    assert list(tmp_path.glob(".health*")) == []


def test_verdicts() -> None:
    def told(*, ready: bool, age_s: float, alive: bool) -> bool:
        health = Health(ready, "", os.getpid(), time.monotonic_ns() - int(age_s * 1e9), birth(os.getpid()))
        return verdict(health, alive=alive, within_s=30.0)[0]

    assert told(ready=True, age_s=0, alive=False)
    assert not told(ready=False, age_s=0, alive=False)
    assert told(ready=False, age_s=0, alive=True)
    assert not told(ready=True, age_s=40, alive=False)
    assert not told(ready=True, age_s=40, alive=True)


def test_a_process_that_was_killed_is_not_alive_any_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "health"
    monkeypatch.setenv("ZFUSION_HEALTH_FILE", str(file))
    with alone(tmp_path) as node:
        wait_until(lambda: file.exists() and Health.read(file).ready, "it runs")
        alive = zfusion(tmp_path, "health", file, "--alive", "--within", 3600)
        node.process.kill()
        node.process.wait()
        dead = zfusion(tmp_path, "health", file, "--alive", "--within", 3600)
    assert (alive.code, dead.code) == (0, 1)
    assert dead.out.startswith("gone; its last word: running")
    another = json.loads(file.read_text()) | {"pid": os.getpid()}  # whoever has its id now
    assert not verdict(Health(**another), alive=True, within_s=3600)[0]
    told_none = Health(**{**another, "birth": None})
    assert verdict(told_none, alive=True, within_s=3600)[0]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"ready": 1, "status": "", "pid": 1, "at_ns": 1}', BIRTH])
def test_what_is_no_health_file_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "health"
    file.write_text(text)
    with pytest.raises(InputError, match="expected a health file"):
        Health.read(file)
    with pytest.raises(InputError, match="can be read"):
        Health.read(tmp_path / "none")


@contextmanager
def alone(directory: Path, *words: str) -> Iterator[Command]:
    """A node that needs nobody else."""
    scenario = variant(
        directory,
        "alone",
        network={"matrix": [[int(i == j) for j in range(4)] for i in range(4)]},
        steps=100_000,
        timing={"rate_hz": 50.0},
    )
    command = Command(directory, "node", scenario, "--id", "1", "--run", run_name("alone"), "--json", *words)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.kill()
        command.process.wait()


def test_a_node_tells_systemd_and_the_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "health"
    with Systemd(str(tmp_path / "notify")) as systemd:
        monkeypatch.setenv("NOTIFY_SOCKET", systemd.address)
        monkeypatch.setenv("WATCHDOG_USEC", "200000")
        monkeypatch.setenv("ZFUSION_HEALTH_FILE", str(file))
        with alone(tmp_path) as node:
            wait_until(lambda: systemd.said("READY=1"), "ready")
            wait_until(lambda: systemd.said("WATCHDOG=1"), "a sign of life")
            completed = re.compile(r"STATUS=running: step \d+, [1-9]\d* completed")
            wait_until(lambda: any(map(completed.search, systemd.heard())), "a step that is completed")
            assert Health.read(file).ready
            assert Health.read(file).pid == node.process.pid
            node.process.send_signal(signal.SIGSTOP)
            wait_until(
                lambda: systemd.heard() and Health.read(file).age_s > 1.0, "a stopped process gives no signs of life"
            )
            node.process.send_signal(signal.SIGCONT)
            wait_until(lambda: systemd.heard() and Health.read(file).age_s < 1.0, "it goes on")
            node.process.send_signal(signal.SIGTERM)
            wait_until(lambda: systemd.said("STOPPING=1"), "stopping")
            result = node.wait()
        assert result.code == 0, result.err
        assert result.summary["completed"] > 0
        said = systemd.heard()
    order = [next(n for n, one in enumerate(said) if word in one) for word in ("=starting", "READY=1", "STOPPING=1")]
    assert order == sorted(order)
    assert sum("READY=1" in one for one in said) == 1
    assert json.loads(file.read_text())["status"] == "ended"
