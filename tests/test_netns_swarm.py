"""Whole swarms in network namespaces: real processes, the kernel's own TCP, and links as the scenario says.

Needs the rights and the kernel for it; where they are missing, the tests say so and are skipped.
"""

from __future__ import annotations

import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
import pytest
import tomli_w

from namespaces import in_a_thread_of_its_own
from swarms import (
    EXAMPLE,
    PATIENCE_S,
    ZFUSION,
    Command,
    Recorded,
    census,
    estimates,
    launch,
    process_of,
    recorded,
    run_name,
    wait_until,
    zfusion,
)
from zfusion.drivers.rerun import rerun
from zfusion.drivers.simulated import simulate
from zfusion.links import MeasuredLinks
from zfusion.model.scenario import load_scenario
from zfusion.recording import Recording
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.addresses import Place, places
from zfusion.swarm.netns.netem import NetemNetwork, missing
from zfusion.swarm.netns.wires import SYSTEM_PATH, wire_up

NODES = ["1", "2", "3", "4"]
MS = 1_000_000


def make_one() -> None:
    os.close(kernel.new_namespace())
    os.close(kernel.open_tun(places([1])[0].address))


def why_no_netem() -> str | None:
    os.close(kernel.new_namespace())
    return missing()


TROUBLE = in_a_thread_of_its_own(make_one) if sys.platform == "linux" else "not Linux"
TC = which("tc", path=f"{os.environ['PATH']}:{SYSTEM_PATH}")
NO_NETEM = in_a_thread_of_its_own(why_no_netem) if TROUBLE is None else TROUBLE

pytestmark = pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")


def scenario(directory: Path, name: str, **tables: Any) -> Path:
    """The example with other tables in the place of its own."""
    path = directory / f"{name}.toml"
    path.write_text(tomli_w.dumps(tomllib.loads(EXAMPLE.read_text()) | tables))
    return path


def latencies_ns(messages: list[Recorded], stages: Collection[str] = ("measurement", "intermediate")) -> list[int]:
    """All one-way latencies that the nodes measured."""
    told = [m.payload["data"] for m in messages if m.topic.endswith("/arrivals")]
    edges = [edge for data in told for edge in data["edges"] if edge["stage"] in stages]
    return [latency for edge in edges for latency in edge["latency_ns"]]


def used(messages: list[Recorded], node: int) -> dict[int, list[int]]:
    """Step -> whose measurements the node used."""
    return {m.payload["step"]: m.payload["used"] for m in messages if m.topic.endswith(f"/node/{node}/intermediate")}


def namespaces_of(pids: Mapping[int, Any]) -> set[str]:
    """The network namespaces that processes are in."""
    found = set()
    for pid in pids:
        with suppress(OSError):
            found.add(os.readlink(f"/proc/{pid}/ns/net"))
    return found - {os.readlink("/proc/self/ns/net")}


def namespaces_held() -> set[str]:
    """All network namespaces that any process is in or has open, or that are mounted somewhere."""
    mounted = {line.split()[3] for line in Path("/proc/self/mountinfo").read_text().splitlines()}
    held = set()
    for pid in filter(str.isdecimal, os.listdir("/proc")):
        with suppress(OSError):
            held.add(os.readlink(f"/proc/{pid}/ns/net"))
            for descriptor in os.listdir(f"/proc/{pid}/fd"):
                with suppress(OSError):
                    held.add(os.readlink(f"/proc/{pid}/fd/{descriptor}"))
    return {name for name in held | mounted if name.startswith("net:")}


def verified(directory: Path, recording: Path) -> int:
    """How many estimates a replay computes again, bit for bit; all of them."""
    verdict = zfusion(directory, "replay", recording, "--verify", "--json")
    assert verdict.code == 0, verdict.out + verdict.err
    assert verdict.summary["different"] == 0
    identical: int = verdict.summary["identical"]
    return identical


def test_latencies_are_those_of_the_simulation_and_the_recording_is_not_delayed(tmp_path: Path) -> None:
    """Every 0.2 s measurements are sent on quiet links: each is one packet, whose latency is what the link draws, and
    what the machine needs. By Dvoretzky, Kiefer and Wolfowitz an empirical distribution of n is anywhere more than
    sqrt(ln(1/p) / 2n) above the true one with a probability of at most p, and so for below."""
    steps, drawn, slack = 30, 4_000, 15 * MS
    law = {"distribution": "uniform", "low": 0.01, "high": 0.09}
    path = scenario(tmp_path, "uniform", links={"delay": law}, timing={"rate_hz": 5.0})
    result = launch(tmp_path, path, "--netns-with", "tun", "--steps", steps, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert min(summary["completed_steps"].values()) > 0.8 * steps  # a busy machine may skip some
    assert (summary["lost"], summary["failures"], summary["emulated"]) == (0, [], [])
    assert "network namespaces: tun (as asked for)" in result.err
    messages = recorded(tmp_path / "x.mcap")
    live = np.array(latencies_ns(messages, ["measurement"]))
    assert len(live) > 0.8 * 8 * steps
    assert min(live) >= 10 * MS  # never before it is due
    simulate(load_scenario(path, steps=drawn // 8), run="simulated", output=tmp_path / "simulated.mcap")
    expected = np.array(latencies_ns(recorded(tmp_path / "simulated.mcap"), ["measurement"]))
    bound = sum(math.sqrt(math.log(1e6) / (2 * n)) for n in (len(live), len(expected)))
    for at in range(10 * MS, 90 * MS, MS):
        in_time = np.mean(expected <= at)
        assert np.mean(live <= at) <= in_time + bound  # late as often, for any deadline
        assert np.mean(live <= at + slack) >= in_time - bound
    to_the_recorder = [m.log_time - m.publish_time for m in messages if m.topic.endswith("/measurement")]
    assert np.median(to_the_recorder) < 10 * MS
    assert verified(tmp_path, tmp_path / "x.mcap") > 4 * steps


def test_loss_is_made_good_by_tcp_and_costs_time(tmp_path: Path) -> None:
    lossy = scenario(tmp_path, "lossy", links={"delay": 0.002, "loss": 0.04}, timing={"rate_hz": 20.0})
    result = launch(tmp_path, lossy, "--netns-with", "tun", "--steps", 80, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["lost"] == 0  # of messages: unless one packet is lost five times, and Zenoh gives the link up
    assert summary["late"] > 0
    network = summary["network"]
    assert (network["kind"], network["why"], network["strays"]) == ("tun", "as asked for", 0)
    sent = sum(edge["packets"] for edge in network["edges"])
    lost = sum(edge.get("lost", 0) for edge in network["edges"])
    assert abs(lost - 0.04 * sent) < 6 * np.sqrt(0.04 * 0.96 * sent)
    latencies = latencies_ns(recorded(tmp_path / "x.mcap"))
    # Of 1280 messages 51 are expected to lose their packet. Nobody sees that before the next packet has come or a
    # timeout has passed, the one half a step later, the other 0.2 s. Fewer than 19: a probability of 1e-7.
    assert np.quantile(latencies, 0.985) > 15 * MS
    assert np.quantile(latencies, 0.25) < 20 * MS
    assert verified(tmp_path, tmp_path / "x.mcap") > 4 * 80  # a busy machine may skip some
    with Recording.open(tmp_path / "x.mcap") as recording:
        rerun(recording, {}, tmp_path / "simulated.mcap", link=MeasuredLinks.of(recording))
    simulated = estimates(tmp_path / "simulated.mcap")
    assert all(simulated[place] == told for place, told in estimates(tmp_path / "x.mcap").items())


def test_a_partition_takes_nobody_with_it(tmp_path: Path) -> None:
    """Longer than the two seconds after which Zenoh gives a link up: links are closed and come up again."""
    parted = scenario(
        tmp_path,
        "parted",
        links={"delay": 0.002},
        timing={"rate_hz": 20.0},
        faults=[{"kind": "partition", "step": 11, "steps": 60, "groups": [[1, 2]]}],
    )
    result = launch(tmp_path, parted, "--netns", "--steps", 115, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["network"]["why"] == "netem has no cuts and partitions at steps"
    assert summary["failures"] == []
    cut = {(edge["from"], edge["to"]) for edge in summary["network"]["edges"] if edge.get("cut")}
    assert cut <= {(a, b) for a in (1, 2) for b in (3, 4)} | {(b, a) for a in (1, 2) for b in (3, 4)}
    assert len(cut) >= 6
    messages = recorded(tmp_path / "x.mcap")
    # Node 1 hears 2 and 3. The first and last steps are those in which packets are on their way already, or still.
    during = {step: taken for step, taken in used(messages, 1).items() if 14 <= step <= 68}
    assert all(3 not in taken for taken in during.values())
    assert sum(2 in taken for taken in during.values()) > 0.8 * 55  # a busy machine may skip some
    assert [1, 2, 3] in [taken for step, taken in used(messages, 1).items() if step > 70]
    assert verified(tmp_path, tmp_path / "x.mcap") > 4 * 115


ENDLESS = ("--steps", 1_000_000, "--rate", 50)


@contextmanager
def endless(directory: Path) -> Iterator[tuple[Command, str, Path]]:
    """A swarm in namespaces that does not end by itself: the launcher, the run, the recording."""
    run, path = run_name("netns"), directory / "x.mcap"
    tables = {"links": {"delay": 0.001}, "recording": {"flush_interval_s": 0.1}}
    command = Command(
        directory,
        "launch",
        scenario(directory, "s", **tables),
        *ENDLESS,
        "--netns",
        "--json",
        "--run",
        run,
        "--record",
        path,
    )
    try:
        yield command, run, path
    finally:
        for pid in census(run):
            os.kill(pid, signal.SIGKILL)
        command.process.wait()


def has_taken_steps(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 40_000


@pytest.mark.parametrize("moment", ["starting", "running"])
def test_nothing_is_left_when_the_launcher_is_killed(tmp_path: Path, moment: str) -> None:
    devices = socket.if_nameindex()
    with endless(tmp_path) as (command, run, path):
        if moment == "starting":
            wait_until(lambda: len(census(run)) > 3, "the first nodes have been started")
        else:
            wait_until(lambda: has_taken_steps(path), "steps are taken")
            assert len(namespaces_of(census(run))) >= 5
        before = namespaces_of(census(run))
        command.process.kill()
        wait_until(lambda: not census(run), "nothing is left running", 20)
        wait_until(lambda: not before & namespaces_held(), "no namespace is left", 20)
        if moment == "running":
            with Recording.open(path) as recording:
                assert recording.complete  # the recorder's wires do not hang on the network
    assert socket.if_nameindex() == devices


def test_the_end_of_the_network_is_the_end_of_the_run(tmp_path: Path) -> None:
    with endless(tmp_path) as (command, run, path):
        wait_until(lambda: has_taken_steps(path), "steps are taken")
        began = time.monotonic()
        os.kill(process_of(run, "network"), signal.SIGKILL)
        result = command.wait()
        assert time.monotonic() - began < 20
        assert not census(run)
    assert result.code == 1
    assert "the network died: killed by SIGKILL" in result.err
    summary = result.summary
    assert summary["failures"] == ["the network died: killed by SIGKILL"]
    assert set(summary["network"]) == {"kind", "why"}
    assert min(summary["completed_steps"].values()) > 0
    with Recording.open(path) as recording:
        assert recording.complete


POWERLESS = ("setpriv", "--bounding-set=-all", "--inh-caps=-all", "--")
ALMOST = ("setpriv", "--bounding-set=-all,+setfcap", "--inh-caps=-all", "--")
"""Without it, who is root outside may not be so in a user namespace: a rule for root alone."""
NO_USER_NAMESPACES = ("unshare", "--user", "--map-root-user", "sh", "-c")


def started_by(words: tuple[str, ...], directory: Path, *command: object) -> subprocess.CompletedProcess[str]:
    """A zfusion command, started by another."""
    return subprocess.run(
        [*words, *ZFUSION, *map(str, command)],
        cwd=directory,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
        env={**os.environ, "COLUMNS": "500"},
    )


def test_without_root_a_user_namespace_will_do(tmp_path: Path) -> None:
    trial = subprocess.run(
        [*ALMOST, "unshare", "--user", "--map-root-user", "--net", "true"], capture_output=True, text=True, check=False
    )
    if trial.returncode:
        pytest.skip(f"no user namespaces without rights here: {trial.stderr}")
    path = scenario(tmp_path, "s", links={"delay": 0.001})
    result = started_by(ALMOST, tmp_path, "launch", path, "--netns", "--steps", 10, "--record", "x.mcap", "--json")
    assert result.returncode == 0, result.stderr
    assert verified(tmp_path, tmp_path / "x.mcap") > 0


def test_without_rights_it_says_what_is_missing_and_what_to_use_instead(tmp_path: Path) -> None:
    forbidden = "echo 0 > /proc/sys/user/max_user_namespaces && exec " + " ".join(POWERLESS) + ' "$0" "$@"'
    words = (*NO_USER_NAMESPACES, forbidden)
    trial = subprocess.run([*words, "true"], capture_output=True, text=True, check=False)
    if trial.returncode:
        pytest.skip(f"rights cannot be taken away here: {trial.stderr}")
    path = scenario(tmp_path, "s", links={"delay": 0.001})
    result = started_by(words, tmp_path, "launch", path, "--netns", "--no-record")
    assert result.returncode == 2, result.stderr
    [line] = [line for line in result.stderr.splitlines() if line]
    assert line.startswith("error: the network: network namespaces need root (CAP_SYS_ADMIN and CAP_NET_ADMIN)")
    assert "without --netns the same links are emulated at the receivers" in line


def test_what_cannot_be_carried_is_refused_in_one_line(tmp_path: Path) -> None:
    path = scenario(tmp_path, "s", links={"delay": 0.001, "duplicate": 0.1})
    result = zfusion(tmp_path, "launch", path, "--netns", "--no-record")
    assert result.code == 2
    assert result.error.startswith("error: the network: --netns: links.duplicate: expected 0")


@pytest.mark.skipif(NO_NETEM is None, reason="this kernel has netem")
def test_netem_is_refused_where_there_is_none(tmp_path: Path) -> None:
    result = zfusion(tmp_path, "launch", scenario(tmp_path, "s"), "--netns-with", "netem", "--no-record")
    assert result.code == 2
    assert "there is no netem (" in result.error
    assert "--netns-with tun" in result.error


@pytest.mark.skipif(NO_NETEM is not None, reason=f"no netem here: {NO_NETEM}")
def test_a_delay_by_netem_is_measured(tmp_path: Path) -> None:
    delayed = scenario(tmp_path, "delayed", links={"delay": 0.01, "loss": 0.02}, timing={"rate_hz": 10.0})
    result = launch(tmp_path, delayed, "--netns-with", "netem", "--steps", 25, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert (summary["lost"], summary["failures"]) == (0, [])
    assert summary["network"] == {"kind": "netem", "why": "as asked for"}
    latencies = latencies_ns(recorded(tmp_path / "x.mcap"))
    assert min(latencies) >= 10 * MS
    assert np.quantile(latencies, 0.25) < 20 * MS


def exchange(namespaces: dict[Any, int], where: list[Place]) -> bytes:
    """What the first says to the second, over TCP."""
    with ExitStack() as stack:
        with kernel.inside(namespaces[where[1].node]):
            server = stack.enter_context(socket.create_server((str(where[1].address.ip), 0)))
        with kernel.inside(namespaces[where[0].node]):
            client = stack.enter_context(socket.create_connection(server.getsockname(), 10))
        other = stack.enter_context(server.accept()[0])
        other.settimeout(10)
        client.sendall(b"hello")
        return other.recv(100)


@pytest.mark.skipif(TC is None, reason="there is no tc (of iproute2)")
def test_all_of_the_network_of_netem_but_netem_itself(tmp_path: Path) -> None:
    """Bridge, veth pairs, classes and filters, with another queue in the place of netem: any kernel has that."""

    def build() -> tuple[bytes, str]:
        where = places(["a", "b", "c"])
        own = [kernel.new_namespace()]
        try:
            namespaces = {place.node: kernel.new_namespace() for place in where}
            own += namespaces.values()
            own.append(kernel.new_namespace())
            wire_up(where, namespaces)
            network = NetemNetwork(where, namespaces, lambda _: "pfifo limit 1000")
            own.append(network.hub)
            heard = exchange(namespaces, where)
            shown = subprocess.run(
                [TC or "tc", "-s", "class", "show", "dev", "p1"], capture_output=True, text=True, check=True
            )
            return heard, shown.stdout
        finally:
            for descriptor in own:
                os.close(descriptor)

    found = in_a_thread_of_its_own(build)
    assert not isinstance(found, Exception), found
    heard, classes = found
    assert heard == b"hello"
    of_class = dict(re.findall(r"class htb (\S+).*?Sent (\d+) bytes", classes, re.DOTALL))
    assert int(of_class["1:2"]) > 0  # what comes from a is in a's class
    assert int(of_class["1:4"]) == 0  # nothing comes from c
