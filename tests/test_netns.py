"""A network for a swarm: what is decided, what is asked of the kernel, how packets are carried. Needs no rights."""

from __future__ import annotations

import os
import select
import socket
import struct
import subprocess
import sys
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from swarms import EXAMPLE
from zfusion.drivers.transport import never_linger
from zfusion.errors import InputError, ScenarioError
from zfusion.links.rules import PACKETS, Rules
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.swarm.control import LauncherEnd
from zfusion.swarm.netns.addresses import NETWORK, Place, places
from zfusion.swarm.netns.choice import check, choose
from zfusion.swarm.netns.forwarder import Forwarder, Port
from zfusion.swarm.netns.kernel import Timer
from zfusion.swarm.netns.netem import hub, inexpressible, leaf, shaping

MS = 1_000_000


def scenario_with(directory: Path, **tables: Any) -> Scenario:
    """The example with other tables in the place of its own."""
    path = directory / "scenario.toml"
    path.write_text(tomli_w.dumps(tomllib.loads(EXAMPLE.read_text()) | tables))
    return load_scenario(path)


def rules_of(directory: Path, edge: tuple[int, int] = (1, 2), **links: Any) -> Rules:
    return Rules.of(scenario_with(directory, links=links).links, edge, PACKETS)


class TestAddresses:
    def test_each_node_has_a_place_and_a_wire_of_its_own(self) -> None:
        found = places([*range(1, 2001)])
        assert len({place.address.ip for place in found}) == 2000
        assert len({end.ip for place in found for end in place.wire}) == 4000
        assert all(place.address.network == NETWORK for place in found)
        assert not any(end.ip in NETWORK for place in found for end in place.wire)
        assert all(place.wire[0].network == place.wire[1].network for place in found)

    def test_endpoints(self) -> None:
        first, second = places([1, "b"])
        assert (first.endpoint, first.recorder_dials) == ("tcp/10.0.0.1:7447", "tcp/10.128.0.0:7447")
        assert (second.endpoint, second.recorder_dials) == ("tcp/10.0.0.2:7447", "tcp/10.128.0.2:7447")


class Constant:
    """Each packet arrives so long after it was sent, or not at all, in turns."""

    def __init__(self, *delays_ns: int | None) -> None:
        self._delays, self._sent = delays_ns, 0
        self.counters: Counter[str] = Counter()

    def next(self, now_ns: int, _size: int) -> int | None:
        delay = self._delays[self._sent % len(self._delays)]
        self._sent += 1
        self.counters["lost"] += delay is None
        return None if delay is None else now_ns + delay


class Wires:
    """Datagram sockets in the place of TUN devices: each end gives and takes one packet at a time, too."""

    def __init__(self, nodes: int) -> None:
        self.ends: dict[int, socket.socket] = {}
        self.ports: dict[int, Port] = {}
        self._devices = []
        for place in places(range(nodes)):
            end, device = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
            device.setblocking(False)
            end.settimeout(10)
            self._devices.append(device)
            self.ends[place.node] = end  # type: ignore[index]
            self.ports[place.node] = Port(device.fileno(), place.address.packed)  # type: ignore[index]

    def send(self, sender: int, receiver: int, content: bytes) -> None:
        self.ends[sender].send(bytes(16) + self.ports[receiver].address + content)

    def take(self, node: int) -> bytes:
        return self.ends[node].recv(2048)[20:]

    def nothing_for(self, node: int) -> bool:
        return not select.select([self.ends[node]], [], [], 0)[0]

    def close(self) -> None:
        for end in (*self.ends.values(), *self._devices):
            end.close()


@contextmanager
def carried(nodes: int, model_of: Callable[[tuple[int, int]], Constant]) -> Iterator[tuple[Wires, Forwarder]]:
    wires = Wires(nodes)
    forwarder = Forwarder(wires.ports, model_of)  # type: ignore[arg-type]
    thread = threading.Thread(target=forwarder.run)
    thread.start()
    try:
        yield wires, forwarder
    finally:
        forwarder.stop()
        thread.join(10)
        assert not thread.is_alive()
        wires.close()


class TestForwarder:
    def test_packets_come_whole_in_order_and_to_whom_they_are_sent(self) -> None:
        with carried(3, lambda _: Constant(MS)) as (wires, forwarder):
            for n in range(100):
                wires.send(0, 1 + n % 2, bytes([n]) * (n + 1))
            for node in (1, 2):
                expected = [bytes([n]) * (n + 1) for n in range(100) if 1 + n % 2 == node]
                assert [wires.take(node) for _ in expected] == expected
        assert forwarder.routes[0, 1].packets == forwarder.routes[0, 2].packets == 50
        assert forwarder.routes[0, 1].bytes == sum(20 + n + 1 for n in range(0, 100, 2))
        assert forwarder.routes[1, 0].packets == 0

    def test_none_comes_before_it_is_due(self) -> None:
        with carried(2, lambda edge: Constant((50 if edge == (0, 1) else 10) * MS)) as (wires, _):
            sent = time.time_ns()
            wires.send(0, 1, b"slow")
            wires.send(1, 0, b"fast")
            assert wires.take(0) == b"fast"
            fast = time.time_ns() - sent
            assert wires.take(1) == b"slow"
            slow = time.time_ns() - sent
        assert fast >= 10 * MS
        assert slow >= 50 * MS

    def test_what_is_due_first_comes_first(self) -> None:
        with carried(2, lambda _: Constant(200 * MS, 1 * MS)) as (wires, _):
            wires.send(0, 1, b"first")
            wires.send(0, 1, b"second")
            assert [wires.take(1), wires.take(1)] == [b"second", b"first"]

    def test_what_is_lost_does_not_come(self) -> None:
        with carried(2, lambda _: Constant(None, 0)) as (wires, forwarder):
            for n in range(10):
                wires.send(0, 1, bytes([n]))
            assert [wires.take(1) for _ in range(5)] == [bytes([n]) for n in (1, 3, 5, 7, 9)]
            assert wires.nothing_for(1)
        assert forwarder.routes[0, 1].model.counters["lost"] == 5

    def test_what_goes_to_nobody_is_counted(self) -> None:
        with carried(2, lambda _: Constant(0)) as (wires, forwarder):
            wires.ends[0].send(bytes(16) + b"\x0a\x00\x07\x07")
            wires.ends[0].send(b"short")
            wires.send(0, 1, b"last")
            assert wires.take(1) == b"last"
        assert forwarder.strays == 2

    def test_it_ends_although_packets_are_under_way(self) -> None:
        with carried(2, lambda _: Constant(3600 * 1000 * MS)) as (wires, forwarder):
            wires.send(0, 1, b"never")
            wires.send(1, 0, b"never")
        assert forwarder.routes[0, 1].packets <= 1

    def test_it_tells_how_late_it_was(self) -> None:
        with carried(2, lambda _: Constant(0)) as (wires, forwarder):
            for _ in range(20):
                wires.send(0, 1, b"x")
                wires.take(1)
        assert sum(forwarder.lateness.sparse().values()) == 20
        median = forwarder.lateness.quantile_us(0.5)
        assert median is not None
        assert 0 < median < 1e6


def test_a_timer_goes_off_at_its_time_and_not_again() -> None:
    timer = Timer()
    due = time.time_ns() + 5 * MS
    timer.set(due)
    assert select.select([timer.descriptor], [], [], 10)[0]
    assert time.time_ns() >= due
    timer.clear()
    assert not select.select([timer.descriptor], [], [], 0)[0]
    assert timer.at_ns is None
    timer.clear()  # nothing to clear
    timer.close()


def test_no_socket_holds_up_who_closes_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 10))
        before = len(os.listdir("/dev/fd"))
        never_linger()
        assert len(os.listdir("/dev/fd")) == before
        lingers, _ = struct.unpack("ii", client.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))
        assert not lingers
        client.sendall(b"still there")
        with server.accept()[0] as other:
            assert other.recv(100) == b"still there"


CHILD = """
import sys, threading
from zfusion.swarm.control import ChildEnd
child, stopped = ChildEnd(int(sys.argv[1])), threading.Event()
child.on_stop(stopped.set, lambda word: child.tell(heard=word))
stopped.wait()
child.tell(stopped=True)
"""


def test_a_child_hears_what_the_launcher_says_until_it_is_told_to_stop() -> None:
    line = LauncherEnd()
    number = line.child.fileno()
    with subprocess.Popen([sys.executable, "-c", CHILD, str(number)], pass_fds=[number]) as child:
        line.child.close()
        line.tell(epoch_ns=7)
        line.tell(epoch_ns=None)
        line.stop()
        assert child.wait(20) == 0
    assert list(line.messages()) == [{"heard": {"epoch_ns": 7}}, {"heard": {"epoch_ns": None}}, {"stopped": True}]
    line.tell(epoch_ns=8)  # nobody is there any more
    line.close()


LEAVES = {
    "nothing": ({}, "netem limit 100000"),
    "constant": ({"delay": 0.01}, "netem limit 100000 delay 10000.000us"),
    "uniform": (
        {"delay": {"distribution": "uniform", "low": 0.002, "high": 0.008, "shift": 0.001}, "reorder": True},
        "netem limit 100000 delay 6000.000us 3000.000us",
    ),
    "normal": (
        {"delay": {"distribution": "normal", "mean": 0.01, "sd": 0.0005}, "reorder": True},
        "netem limit 100000 delay 10000.000us 500.000us distribution normal",
    ),
    "loss": ({"delay": 0.0015, "loss": 0.05}, "netem limit 100000 delay 1500.000us loss random 5%"),
    "bursts": (
        {"loss": {"gilbert_elliott": {"to_bad": 0.01, "to_good": 0.25, "loss_good": 0.001, "loss_bad": 0.8}}},
        "netem limit 100000 loss gemodel 1% 25% 80% 0.1%",
    ),
    "bandwidth": ({"bandwidth": {"rate_bps": 1e6, "queue": 20}}, "netem limit 21 rate 1000000bit"),
}

BEYOND = {
    "lognormal": ({"delay": {"distribution": "lognormal", "median": 0.01, "sigma": 1.0}}, "delay by lognormal"),
    "pareto": ({"delay": {"distribution": "pareto", "minimum": 0.01, "shape": 3.0}, "reorder": True}, "by pareto"),
    "mixture": ({"delay": {"mixture": [{"weight": 1.0, "delay": 0.01}]}}, "by mixture or trace"),
    "order": ({"delay": {"distribution": "uniform", "low": 0.0, "high": 0.01}}, "keep the order"),
    "bandwidth": ({"delay": 0.01, "bandwidth": {"rate_bps": 1e6}}, "bandwidth with a queue of its own"),
}


class TestNetem:
    @pytest.mark.parametrize("case", LEAVES)
    def test_a_link_in_its_words(self, tmp_path: Path, case: str) -> None:
        links, expected = LEAVES[case]
        rules = rules_of(tmp_path, **links)
        assert not list(inexpressible(rules))
        assert leaf(rules) == expected

    @pytest.mark.parametrize("case", BEYOND)
    def test_what_it_cannot_do_is_named(self, tmp_path: Path, case: str) -> None:
        links, named = BEYOND[case]
        [found] = inexpressible(rules_of(tmp_path, **links))
        assert named in found

    def test_each_sender_has_a_class_at_each_receiver(self) -> None:
        commands = list(shaping(places([1, 2]), lambda edge: f"netem delay {edge[0]}{edge[1]}ms"))
        assert commands == [
            "qdisc add dev p0 root handle 1: htb default 1",
            "class add dev p0 parent 1: classid 1:1 htb rate 100gbit quantum 60000",
            "class add dev p0 parent 1: classid 1:3 htb rate 100gbit quantum 60000",
            "qdisc add dev p0 parent 1:3 netem delay 21ms",
            "filter add dev p0 parent 1: protocol ip prio 1 u32 match ip src 10.0.0.2/32 flowid 1:3",
            "qdisc add dev p1 root handle 1: htb default 1",
            "class add dev p1 parent 1: classid 1:1 htb rate 100gbit quantum 60000",
            "class add dev p1 parent 1: classid 1:2 htb rate 100gbit quantum 60000",
            "qdisc add dev p1 parent 1:2 netem delay 12ms",
            "filter add dev p1 parent 1: protocol ip prio 1 u32 match ip src 10.0.0.1/32 flowid 1:2",
        ]

    def test_all_are_on_one_bridge(self) -> None:
        assert list(hub([Place("a", 0)], {"a": 9})) == [
            "link add name bridge type bridge",
            "link set dev bridge up",
            f"link add name p0 type veth peer name zfusion netns /proc/{os.getpid()}/fd/9",
            "link set dev p0 master bridge",
            "link set dev p0 up",
        ]


def has_netem() -> None:
    return None


def has_none() -> str:
    return "unknown qdisc"


class TestChoice:
    def test_netem_where_it_is_and_can(self) -> None:
        assert choose(load_scenario(EXAMPLE), None, has_netem) == ("netem", "the kernel has netem")

    def test_tun_where_there_is_no_netem(self) -> None:
        assert choose(load_scenario(EXAMPLE), None, has_none) == ("tun", "there is no netem (unknown qdisc)")

    def test_tun_where_netem_cannot_do_the_links(self, tmp_path: Path) -> None:
        slow = [{"from": 3, "to": 1, "delay": {"distribution": "exponential", "mean": 0.01}}]
        kind, why = choose(scenario_with(tmp_path, links={"delay": 0.01, "edges": slow}), None, has_netem)
        assert kind == "tun"
        assert why == "netem cannot do a delay by exponential (link 3 -> 1)"

    @pytest.mark.parametrize(
        ("tables", "why"),
        [
            ({"faults": [{"kind": "cut", "step": 5, "from": 1}]}, "cuts and partitions"),
            ({"faults": [{"kind": "partition", "step": 5, "groups": [[1, 2]]}]}, "cuts and partitions"),
            (
                {"links": {"topology": {"modes": [{"generator": "ring"}], "schedule": [{"step": 1, "mode": 0}]}}},
                "switching topology",
            ),
        ],
        ids=["cut", "partition", "topology"],
    )
    def test_tun_where_links_change_with_the_steps(self, tmp_path: Path, tables: dict[str, Any], why: str) -> None:
        found = choose(scenario_with(tmp_path, network={"generator": "complete"}, **tables), None, has_netem)
        assert found.kind == "tun"
        assert why in found.why

    def test_what_is_asked_for(self) -> None:
        scenario = load_scenario(EXAMPLE)
        assert choose(scenario, "tun", has_netem) == ("tun", "as asked for")
        assert choose(scenario, "netem", has_netem) == ("netem", "as asked for")
        with pytest.raises(InputError, match=r"no netem \(unknown qdisc\); --netns-with tun"):
            choose(scenario, "netem", has_none)

    def test_a_scenario_that_fits_passes(self, tmp_path: Path) -> None:
        fault = {"kind": "partition", "step": 5, "groups": [[1, 2]]}
        check(scenario_with(tmp_path, links={"delay": 0.01, "loss": 0.1}, faults=[fault]))

    @pytest.mark.parametrize(
        ("tables", "field"),
        [
            ({"links": {"duplicate": 0.1}}, "links.duplicate"),
            ({"links": {"edges": [{"from": 3, "duplicate": 0.1}]}}, "links.duplicate"),
            ({"links": {"edges": [{"delay": 0.1, "stages": "measurement"}]}}, "links.edges[0].stages"),
            ({"links": {"recorded": {"recording": "x.mcap"}}}, "links.recorded"),
            (
                {"timing": {"free_run": True}, "faults": [{"kind": "cut", "step": 5, "from": 1}]},
                "faults[0]",
            ),
            ({"source": {"kind": "zenoh", "key": "sensor/{id}"}}, "source of node 1"),
        ],
        ids=["duplicate", "duplicate on an edge", "stages", "recorded", "free-running cut", "zenoh source"],
    )
    def test_what_packets_cannot_be_is_refused(self, tmp_path: Path, tables: dict[str, Any], field: str) -> None:
        with pytest.raises(ScenarioError) as caught:
            check(scenario_with(tmp_path, **tables))
        [problem] = caught.value.problems
        assert problem.field == field
        assert str(caught.value).startswith(f"--netns: {field}: expected ")
