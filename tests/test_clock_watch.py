"""Clocks that are apart: refused at the start, told during the run; and clocks that jump under real processes."""

from __future__ import annotations

import os
import shutil
import signal
import struct
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from swarms import ZFUSION, Command, Listener, client, decoded, recorded, run_name, wait_until, zfusion
from zfusion.drivers.clock_watch import ClockWatch, clock_limit_ns
from zfusion.drivers.clocks import Clock
from zfusion.errors import InputError
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.status import Phase, Status
from zfusion.swarm.ports import free_endpoints

MS = 1_000_000
SECOND = 1_000_000_000
HOUR = 3600 * SECOND

THREE = """
name = "three"
steps = 100

[timing]
rate_hz = 20

[system]
F = 0.9
Q = 0.1
initial_covariance = 1.0

[[sensors]]
id = 1
H = 1.0
R = 0.5

[[sensors]]
id = 2
H = 1.0
R = 1.0

[[sensors]]
id = 3
H = 2.0
R = 1.0

[network]
generator = "complete"
"""


def three(directory: Path, nodes: int = 3, **timing: Any) -> Path:
    """A scenario of three nodes, or the first of them, with endpoints."""
    document = tomllib.loads(THREE)
    document["sensors"] = document["sensors"][:nodes]
    document["timing"] |= timing
    document["transport"] = {"endpoints": dict(zip("123"[:nodes], free_endpoints(nodes), strict=True))}
    path = directory / "three.toml"
    path.write_text(tomli_w.dumps(document))
    return path


def scenario(directory: Path, **timing: Any) -> Scenario:
    return load_scenario(three(directory, **timing))


def test_the_limit_is_a_quarter_of_the_shortest_time_that_a_stage_is_open(tmp_path: Path) -> None:
    def limit(**timing: Any) -> int | None:
        return clock_limit_ns(scenario(tmp_path, **timing))

    assert limit() == 50 * MS * 45 // 100 // 4
    assert limit(deadlines={"measurement": 0.2}) == 50 * MS * 20 // 100 // 4
    assert limit(deadlines={"measurement": 0.8}) == 50 * MS * 10 // 100 // 4
    assert limit(late="wait", timeout_s=2.0) == SECOND // 2
    assert limit(max_clock_offset_s=0.25) == SECOND // 4
    document = tomllib.loads(THREE) | {"timing": {"free_run": True}}
    (tmp_path / "free.toml").write_text(tomli_w.dumps(document))
    assert clock_limit_ns(load_scenario(tmp_path / "free.toml")) is None


def answer(node: int, **fields: Any) -> Status:
    values: dict[str, Any] = {"phase": Phase.JOINING, "machine": "elsewhere", **fields}
    return Status(node, "", step=0, born=0, epoch_ns=None, ready={}, **values)


class Watched:
    """Node 1's view of two others, 10 ms of uncertainty in every reading."""

    def __init__(self, directory: Path, **timing: Any) -> None:
        self.clock = Clock()
        self.watch = ClockWatch(scenario(directory, max_clock_offset_s=0.1, **timing), 1, (2, 3), self.clock)

    def read(self, node: int, ahead_ms: int, *, begun: bool = False) -> None:
        heard = 10 * MS + ahead_ms * MS
        told = answer(node, heard_ns=heard, told_ns=heard, phase=Phase.RUNNING if begun else Phase.JOINING)
        self.watch.read(told, "here", 0, 20 * MS, begun=begun)


def test_an_offset_is_refused_where_it_is_surely_beyond_the_limit(tmp_path: Path) -> None:
    watched = Watched(tmp_path)
    watched.read(2, 109)  # it may be 99
    watched.read(3, -109)
    watched.watch.agree((2, 3))
    watched = Watched(tmp_path)
    watched.read(2, 112)
    watched.read(3, -3000)
    watched.watch.agree(())
    with pytest.raises(InputError) as refused:
        watched.watch.agree((2, 3))
    first, second = str(refused.value).splitlines()
    assert first.startswith(
        "the clock of node 2 is 0.112 s ahead of that of node 1, here, to within 0.01 s, where 0.1 s are allowed: "
    )
    assert "chronyc" in first
    assert second.startswith("the clock of node 3 is 3 s behind that of node 1, here, ")
    assert watched.watch.exceeded == 0


def test_what_is_not_known_is_told_and_not_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched(tmp_path)
    watched.read(2, 0)
    watched.watch.agree((2, 3))
    watched.watch.tell_unknown((2, 3))
    assert caplog.messages == ["how far the clocks of these nodes are off is not known: 3"]
    arrivals: dict[str, Any] = {"edges": [{"from": 2}, {"from": 3}]}
    watched.watch.mark(arrivals)
    assert arrivals == {"edges": [{"from": 2, "clock_error_ns": 10 * MS}, {"from": 3, "clock_error_ns": None}]}


def test_during_the_run_it_is_counted_each_time_and_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    watched = Watched(tmp_path)
    for _ in range(3):
        watched.read(2, 500, begun=True)
    watched.read(3, 50, begun=True)
    assert watched.watch.exceeded == 3
    assert [message.split(" is ")[0] for message in caplog.messages] == ["the clock of node 2"]


def test_who_begins_late_takes_up_the_line_of_its_machine(tmp_path: Path) -> None:
    watched = Watched(tmp_path)
    here = watched.clock.line_ns
    running = answer(2, phase=Phase.RUNNING, machine="here", line_ns=here + HOUR)  # the clock was set back since
    watched.watch.read(running, "here", 0, 0, begun=False)
    assert watched.clock.line_ns == here + HOUR
    assert watched.clock.kept
    watched.watch.agree((2,))
    assert watched.watch.offsets[2].told() == {"offset_us": 0.0, "uncertainty_us": 0.0}


def test_the_line_of_one_that_is_still_to_take_it_up_is_not_looked_at(tmp_path: Path) -> None:
    watched = Watched(tmp_path)
    line = watched.clock.line_ns
    for phase, line_ns in ((Phase.RUNNING, line), (Phase.JOINING, line + HOUR), (Phase.RUNNING, line)):
        watched.watch.read(answer(2, phase=phase, machine="here", line_ns=line_ns), "here", 0, 0, begun=True)
        assert watched.watch.offsets[2].told() == {"offset_us": 0.0, "uncertainty_us": 0.0}
    watched.watch.read(answer(2, phase=Phase.RUNNING, machine="here", line_ns=line + HOUR), "here", 0, 0, begun=True)
    assert watched.watch.offsets[2].told() == {"offset_us": HOUR / 1000, "uncertainty_us": 0.0}
    assert watched.watch.exceeded == 1


class Box:
    """A machine of which zfusion's processes read what a test wants: its clock, and what its boot is called."""

    def __init__(self, directory: Path, name: str, ahead_ns: int = 0) -> None:
        self._offset, self._boot = directory / f"{name}.offset", directory / f"{name}.boot"
        self._boot.write_text(name)
        self._offset.write_bytes(struct.pack("q", ahead_ns))

    def set(self, ahead_ns: int) -> None:
        with self._offset.open("r+b") as file:
            file.write(struct.pack("q", ahead_ns))

    @property
    def zfusion(self) -> list[object]:
        return [sys.executable, Path(__file__).with_name("other_machine.py"), self._offset, self._boot]


@contextmanager
def ended(commands: list[Command]) -> Iterator[None]:
    """Nothing is left running, whatever happens."""
    try:
        yield
    finally:
        for command in commands:
            if command.process.poll() is None:
                command.process.kill()
                command.process.wait()


def test_a_clock_that_jumps_does_not_stop_the_swarm(tmp_path: Path) -> None:
    file, run = three(tmp_path), run_name("jumps")
    here, there = Box(tmp_path, "here"), Box(tmp_path, "there")
    common = (file, "--run", run, "--json")

    def start(node: int, box: Box) -> Command:
        return Command(tmp_path, "node", *common, "--id", node, "--forever", *waits, program=box.zfusion)

    waits = ["--await-recorder"]
    recorder = Command(tmp_path, "record", *common, "-o", tmp_path / "jumps.mcap", program=here.zfusion)
    nodes = [start(1, here), start(2, here), start(3, there)]
    places = load_scenario(file).transport.endpoints.values()
    with ended([recorder, *nodes]), client(*places) as session:
        estimates = Listener(session, f"zfusion/{run}/node/1/estimate")
        events = Listener(session, f"zfusion/{run}/node/*/event")

        def goes_on(steps: int) -> None:
            reached = max(estimates.steps())
            wait_until(lambda: max(estimates.steps()) >= reached + steps, f"{steps} more steps")

        def jumps() -> list[tuple[int, int]]:
            told = [decoded(sample) for sample in events.collect()]
            return [(e["node"], round(e["data"]["set_ns"] / HOUR)) for e in told if e["kind"] == "clock_jump"]

        wait_until(lambda: len(estimates.steps()) > 5, "steps")
        here.set(HOUR)
        wait_until(lambda: {(1, 1), (2, 1)} <= set(jumps()), "jumps of nodes 1 and 2")
        goes_on(5)
        nodes[1].process.send_signal(signal.SIGKILL)
        nodes[1].process.wait()
        goes_on(3)
        nodes[1] = start(2, here)  # by a clock that is an hour ahead of the others' time line
        again = Listener(session, f"zfusion/{run}/node/2/estimate")
        wait_until(lambda: len(again.steps()) > 5, "steps of node 2's second life")
        here.set(-5 * HOUR)
        wait_until(lambda: {(1, -6), (2, -6)} <= set(jumps()), "jumps back")
        goes_on(5)
        for node in nodes:
            node.interrupt()
        reports = [node.wait().summary for node in nodes]
        assert recorder.wait().code == 0
    assert [report["clock_jumps"] for report in reports] == [2, 1, 0]
    assert [report["clock_offset_exceeded"] for report in reports] == [0, 0, 0]
    assert all(report["skipped"] < 1000 and report["step"] < 5000 for report in reports)  # an hour has 72,000 steps
    assert reports[0]["clocks"]["2"] == {"offset_us": 0.0, "uncertainty_us": 0.0}
    assert abs(reports[2]["clocks"]["1"]["offset_us"]) < 1e6
    messages = recorded(tmp_path / "jumps.mcap")
    stamps = [m.payload["t_ns"] for m in messages] + [m.log_time for m in messages]
    assert max(stamps) - min(stamps) < HOUR // 2
    verified = zfusion(tmp_path, "replay", tmp_path / "jumps.mcap", "--verify", "--json").summary
    assert verified["different"] == 0
    assert verified["identical"] > 60
    marked = [e for m in messages if m.topic.endswith("arrivals") for e in m.payload["data"]["edges"]]
    assert {(e["from"] == 3) for e in marked if "clock_error_ns" in e} == {True, False}


def test_clocks_that_are_apart_are_refused_by_both_sides(tmp_path: Path) -> None:
    file, run = three(tmp_path, nodes=2), run_name("apart")
    boxes = [Box(tmp_path, "a"), Box(tmp_path, "b", 3 * SECOND)]
    nodes = [
        Command(tmp_path, "node", file, "--run", run, "--id", n, program=box.zfusion) for n, box in enumerate(boxes, 1)
    ]
    with ended(nodes):
        results = [node.wait() for node in nodes]
    assert [result.code for result in results] == [2, 2]
    assert "the clock of node 2 is 3 s ahead of that of node 1, here" in round_off(results[0].error)
    assert "the clock of node 1 is 3 s behind that of node 2, here" in round_off(results[1].error)
    for result in results:
        assert "where 0.005625 s are allowed" in result.error
        assert 'timing.on_clock_offset = "warn"' in result.error


def round_off(text: str) -> str:
    """Offsets of about three seconds as 3."""
    words = text.split(" ")
    return " ".join("3" if word.startswith(("2.9", "3.0")) else word for word in words)


def test_by_option_they_begin_all_the_same_and_it_is_counted(tmp_path: Path) -> None:
    file, run = three(tmp_path, nodes=2, on_clock_offset="warn"), run_name("warned")
    boxes = [Box(tmp_path, "a"), Box(tmp_path, "b", 3 * SECOND // 10)]
    nodes = [
        Command(tmp_path, "node", file, "--run", run, "--id", n, "--steps", 120, "--json", program=box.zfusion)
        for n, box in enumerate(boxes, 1)
    ]
    with ended(nodes):
        results = [node.wait() for node in nodes]
    assert [result.code for result in results] == [0, 0]
    assert results[0].err.count("the clock of node 2 is ") == 1
    for result in results:
        assert result.summary["clock_offset_exceeded"] > 0
        assert result.summary["completed"] > 0
    offset = results[0].summary["clocks"]["2"]
    assert abs(offset["offset_us"] - 300_000) <= offset["uncertainty_us"] + 10_000


FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("unshare"), reason="needs root: a mount namespace")
@pytest.mark.skipif(not FAKETIME.exists(), reason="needs libfaketime")
def test_another_machine_made_by_the_kernel_with_a_clock_set_for_the_whole_process(tmp_path: Path) -> None:
    (tmp_path / "boot").write_text("another\n")
    file, run = three(tmp_path, nodes=2, max_clock_offset_s=0.5), run_name("kernel")
    bind = f"mount --bind {tmp_path / 'boot'} /proc/sys/kernel/random/boot_id"
    clock = f"LD_PRELOAD={FAKETIME} FAKETIME_DONT_FAKE_MONOTONIC=1 FAKETIME=+3s"
    elsewhere = ["unshare", "-m", "sh", "-c", f'{bind} && {clock} exec "$@"', "sh", *ZFUSION]
    nodes = [
        Command(tmp_path, "node", file, "--run", run, "--id", n, program=program)
        for n, program in enumerate((ZFUSION, elsewhere), 1)
    ]
    with ended(nodes):
        results = [node.wait() for node in nodes]
    assert [result.code for result in results] == [2, 2]
    assert "the clock of node 2 is 3 s ahead of that of node 1, here" in round_off(results[0].error)
    assert "the clock of node 1 is 3 s behind that of node 2, here" in round_off(results[1].error)
