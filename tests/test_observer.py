"""Looking at a running swarm from outside: who is there, what they say, and that nobody waits for who looks."""

from __future__ import annotations

import gzip
import json
import os
import pty
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import tomli_w
from opentelemetry.proto.collector.metrics.v1.metrics_service_pb2 import ExportMetricsServiceRequest
from prometheus_client.parser import text_string_to_metric_families

from deployed import deployed, hosts_document, swarm
from swarms import (
    PATIENCE_S,
    Command,
    endpoints,
    estimates,
    process_of,
    run_name,
    variant,
    wait_until,
    zfusion,
)
from zfusion.drivers import registry
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.observer import Observer, SeenNode, Swarm, find_swarm
from zfusion.drivers.settings import LEASE_MS
from zfusion.drivers.simulated import simulate
from zfusion.drivers.transport import open_session, publisher
from zfusion.errors import InputError
from zfusion.model.scenario import load_scenario
from zfusion.report.exporters import push
from zfusion.report.metrics import Family
from zfusion.report.swarm_table import seen_swarm
from zfusion.status import Phase, Status
from zfusion.swarm.ports import free_endpoints

NODES = ("1", "2", "3", "4")


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("observed")


@pytest.fixture(scope="module", autouse=True)
def own_registry(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A registry of these tests' own: other runs of this machine are none of theirs."""
    path = tmp_path_factory.mktemp("runtime")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(path))
        yield path


@pytest.fixture(scope="module")
def run(directory: Path) -> Iterator[str]:
    """A paced swarm of the example that goes on for as long as it is looked at, and its recorder."""
    scenario, run = variant(directory, "observed", timing={"rate_hz": 20.0}), run_name("observed")
    command = Command(directory, "launch", scenario, "--json", "--run", run, "--steps", 1_000_000)
    with Observer(_swarm(run)) as observer:
        wait_until(lambda: _looked(observer, "running"), "all nodes are running")
    yield run
    command.interrupt()
    assert command.wait().summary["failures"] == []


def _swarm(run: str) -> Any:
    wait_until(lambda: [entry for entry in registry.entries() if entry.run == run], f"{run} is in the registry")
    return find_swarm(run=run)


def _looked(observer: Observer, *states: str) -> bool:
    observer.ask()
    return all(node.state in states for node in observer.nodes.values())


def _state(observer: Observer, name: str) -> str:
    observer.ask()
    return observer.nodes[name].state


def test_status_tells_of_every_node_and_of_the_recorder(run: str, directory: Path) -> None:
    result = zfusion(directory, "status", "--json")  # the only run on this machine
    told = result.summary
    assert result.code == 0
    assert told["run"] == run
    assert list(told["nodes"]) == list(NODES)
    for name, node in told["nodes"].items():
        assert node["state"] == "running"
        assert node["completed"] > 0
        assert node["step"] >= node["completed"]
        assert node["sent"]["estimate"] >= node["completed"]
        assert name not in node["edges"]
        assert node["received"] == sum(n for edge in node["edges"].values() for n in edge["received"].values()) > 0
        assert len(node["estimate"]["x"]) == 1
        assert node["rate_hz"] > 0
    assert told["recorder"]["state"] == "recording"
    assert told["recorder"]["messages"] > 0
    assert told["recorder"]["path"].endswith(f"{run}.mcap")
    assert told["missing"] == []


@pytest.mark.parametrize("columns", [80, 60, 40])
def test_tables_fit(run: str, directory: Path, columns: int) -> None:
    command = [sys.executable, "-m", "zfusion", "top", "--once", "--interval", "0.2"]
    environment = {**os.environ, "COLUMNS": str(columns)}
    lines = subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    assert max(map(len, lines)) <= columns
    rows = {words[0]: words for line in lines if len(words := line.split()) > 2 and words[0] in NODES}
    assert {name: row[1] for name, row in rows.items()} == dict.fromkeys(NODES, "running")
    assert all(row[2].isdecimal() for row in rows.values())  # the whole of it, whatever is left out
    assert ("estimate" in "".join(lines)) == (columns >= 60)


def test_echo_prints_messages(run: str, directory: Path) -> None:
    lines = zfusion(directory, "echo", "1/estimate", "--count", 3, "--json").out.splitlines()
    letters = [json.loads(line) for line in lines]
    assert [letter["key"] for letter in letters] == [f"zfusion/{run}/node/1/estimate"] * 3
    first = letters[0]["message"]["seq"]
    assert [letter["message"]["seq"] for letter in letters] == [first, first + 1, first + 2]
    text = zfusion(directory, "echo", "estimate", "--count", 1).out
    assert "step" in text
    assert "  P " in text
    key, size, data = zfusion(directory, "echo", f"zfusion/{run}/node/2/measurement", "--count", 1, "--raw").out.split()
    assert (key, len(bytes.fromhex(data))) == (f"zfusion/{run}/node/2/measurement", int(size))
    assert msgpack.unpackb(bytes.fromhex(data))["node"] == 2


def test_hz_measures_every_key(run: str, directory: Path) -> None:
    told = zfusion(directory, "hz", "measurement", "--once", "--json", "--interval", 2).summary
    assert set(told["keys"]) == {f"zfusion/{run}/node/{name}/measurement" for name in NODES}
    for rhythm in told["keys"].values():
        assert rhythm["messages"] > 5
        assert rhythm["lost"] == rhythm["unreadable"] == 0
        assert rhythm["min_s"] <= rhythm["mean_s"] <= rhythm["max_s"]
        assert rhythm["rate_hz"] * rhythm["mean_s"] == pytest.approx(1)
    assert zfusion(directory, "hz", "nothing", "--once", "--json").code == 1


def test_metrics_are_served_and_pushed(run: str, directory: Path) -> None:
    pushed: list[bytes] = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            pushed.append(gzip.decompress(body) if self.headers.get("Content-Encoding") == "gzip" else body)
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Collector) as collector:
        thread = threading.Thread(target=collector.serve_forever)
        thread.start()
        otlp = f"http://127.0.0.1:{collector.server_port}/v1/metrics"
        command = Command(directory, "metrics", "--run", run, "--port", 0, "--otlp", otlp, "--interval", 0.2)
        wait_until(lambda: "http://" in command.said(), "it serves")
        url = re.search(r"http://\S+", command.said())
        assert url
        first, second = _scraped(url[0]), {}
        steps = ("zfusion_node_steps_total", ("node", "1"), ("run", run))
        wait_until(lambda: second.update(_scraped(url[0])) or second[steps] > first[steps], "steps are counted")
        wait_until(lambda: pushed, "metrics are pushed")
        command.interrupt()
        assert command.wait().code == 0
        collector.shutdown()
        thread.join()
    edge = (("from", "2"), ("node", "1"), ("run", run), ("stage", "measurement"))
    assert second["zfusion_messages_received_total", *edge] > 0
    assert second["zfusion_messages_lost_total", *edge] == 0
    assert second["zfusion_recorder_messages_total", ("run", run)] > 0
    wait = (("node", "1"), ("run", run), ("stage", "intermediate"))
    count = second["zfusion_stage_wait_seconds_count", *wait]
    assert 0 < second["zfusion_stage_wait_seconds_sum", *wait] < count
    assert second["zfusion_stage_wait_seconds_bucket", ("le", "+Inf"), *wait] == count
    told = ExportMetricsServiceRequest.FromString(pushed[0]).resource_metrics[0].scope_metrics[0].metrics
    assert "zfusion_node_steps" in {metric.name for metric in told}


@pytest.mark.parametrize("url", ["garbage", "collector:4318", "ftp://collector/v1/metrics", "http://", "http://a b/"])
def test_where_metrics_cannot_be_pushed_is_refused(url: str) -> None:
    with pytest.raises(InputError, match="--otlp: expected a URL"):
        push(list, url, 1.0)


def test_pushing_to_a_collector_that_is_not_there_ends_soon() -> None:
    tried = threading.Event()

    def families() -> list[Family]:
        tried.set()
        return [Family("up", "gauge", "", (), {(): 1.0})]

    [endpoint] = free_endpoints(1)
    end = push(families, f"http://{endpoint.removeprefix('tcp/')}/v1/metrics", 0.1)
    tried.clear()
    assert tried.wait(PATIENCE_S)
    begins = time.monotonic()
    end()
    assert time.monotonic() - begins < 7.0  # the exporter, left to itself, tries for ten seconds


def _scraped(url: str) -> dict[tuple[Any, ...], float]:
    with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return {(s.name, *sorted(s.labels.items())): s.value for family in families for s in family.samples}


def test_what_is_broken_is_shown_as_that(directory: Path) -> None:
    good = msgpack.packb({"v": 1, "node": 3, "step": 1, "t_ns": 0, "seq": 0, "born": 1, "x": [float("nan")]})
    payloads = {
        b"\xc1": "not_a_map",
        b"\x1b[2J\x1b]0;owned\x07": "not_a_map",
        b"\x81" * 3000: "not_msgpack",
        msgpack.packb([1]): "not_a_map",
        msgpack.packb({"v": 1, "node": 3}): "missing_field",
        msgpack.packb({"a": {"b": {"c": {"d": {"e": {"f": {"g": {"h": {"i": 1}}}}}}}}}): "too_deep",
        good: "wrong_node",
        bytes(2 << 20): "too_large",
    }
    [endpoint] = free_endpoints(1)
    key = "zfusion/forged/node/9/event"
    with open_session(Endpoints(listen=(endpoint,))) as session:
        forger = publisher(session, key)
        where = ("--connect", endpoint, "--run", "forged", "--count", len(payloads))
        as_json, as_text = (Command(directory, "echo", "event", *where, *more) for more in (["--json"], []))
        hz = Command(directory, "hz", "/my/key", "--connect", endpoint, "--once", "--json", "--interval", 0.2)
        wait_until(lambda: forger.matching_status.matching, "somebody listens")
        while as_json.process.poll() is None or as_text.process.poll() is None or hz.process.poll() is None:
            for payload in payloads:
                forger.put(payload)
            session.put("my/key", b"21.5")
            time.sleep(0.05)
    letters = [json.loads(line) for line in as_json.wait().out.splitlines()]
    assert {letter["error"] for letter in letters} == set(payloads.values())
    text = as_text.wait().out
    assert text.count("broken") == len(payloads)
    assert "\x1b" not in text
    assert list(hz.wait().summary["keys"]) == ["my/key"]


def test_nodes_that_die_are_missing(directory: Path) -> None:
    scenario, run = variant(directory, "dying", timing={"rate_hz": 20.0}), run_name("dying")
    command = Command(directory, "launch", scenario, "--json", "--no-record", "--run", run, "--steps", 1_000_000)
    with Observer(_swarm(run)) as observer:
        wait_until(lambda: _looked(observer, "running"), "all nodes are running")
        os.kill(process_of(run, "--id", "2"), signal.SIGSTOP)
        wait_until(lambda: _state(observer, "2") in {"silent", "gone"}, "node 2 does not answer")
        wait_until(lambda: _state(observer, "2") == "gone", "its lease is over")
        os.kill(process_of(run, "--id", "2"), signal.SIGCONT)
        wait_until(lambda: _state(observer, "2") == "running", "it is back")
        os.kill(process_of(run, "--id", "3"), signal.SIGKILL)
        wait_until(lambda: _state(observer, "3") == "gone", "node 3 is gone")
        assert seen_swarm(observer)["nodes"]["3"]["completed"] > 0  # the last that was heard of it
    result = zfusion(directory, "status", "--run", run, "--json")
    assert (result.code, result.summary["missing"]) == (1, ["node 3"])
    command.interrupt()
    assert command.wait().code == 1
    assert run not in {entry.run for entry in registry.entries()}


def test_several_runs_are_told_apart(run: str, directory: Path) -> None:
    other = registry.Entry("other", "observed", {"1": "tcp/127.0.0.1:1"})
    with registry.registered(other):
        assert f"other, {run}" in zfusion(directory, "status").error
        assert zfusion(directory, "status", "--run", run, "--json").code == 0
        assert zfusion(directory, "status", "--run", "third").code == 2
        with pytest.raises(InputError, match="--run"):
            find_swarm(directory / "observed.toml")
    assert [entry.run for entry in registry.entries()] == [run]


def test_nodes_that_were_started_one_by_one_are_one_run(own_registry: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(own_registry / "apart"))
    (own_registry / "apart").mkdir()
    elsewhere = {"1": "tcp/10.0.0.1:7450", "2": "tcp/10.0.0.2:7450", "10": "tcp/10.0.0.3:7450"}
    first = registry.Entry("run", "s", {"2": "tcp/0.0.0.0:7777"}, elsewhere)
    other = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    second = replace(first, endpoints={"1": "tcp/127.0.0.1:8888"}, pid=other.pid, birth=registry.birth(other.pid))
    with registry.registered(first), registry.registered(second), registry.registered(replace(first, run="another")):
        swarm = find_swarm(run="run")
        other.communicate(b"\n")
        alone = find_swarm(run="run")
    assert swarm.nodes == alone.nodes == ("1", "2", "10")
    assert set(swarm.endpoints.connect) == {"tcp/127.0.0.1:8888", "tcp/127.0.0.1:7777", "tcp/10.0.0.3:7450"}
    assert set(alone.endpoints.connect) == {"tcp/10.0.0.1:7450", "tcp/127.0.0.1:7777", "tcp/10.0.0.3:7450"}


def test_notes_of_processes_that_are_gone_are_removed(own_registry: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    directory = own_registry / "zfusion"
    stale = registry.Entry("stale", "s", {}, pid=ended.pid, birth="somebody/1")
    another = registry.Entry("another", "s", {}, birth="somebody/1")  # a process of our id, another time
    with registry.registered(stale), registry.registered(another):
        assert len(list(directory.glob("*.json"))) >= 2
        assert not {"stale", "another"} & {entry.run for entry in registry.entries()}
        assert not list(directory.glob("stale*")) + list(directory.glob("another*"))


def test_a_registry_that_others_can_write_to_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "zfusion").mkdir()
    (tmp_path / "zfusion").chmod(0o777)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with registry.registered(registry.Entry("run", "s", {})):
        assert not list((tmp_path / "zfusion").iterdir())
        assert registry.entries() == []


def test_nobody_is_there(directory: Path) -> None:
    [endpoint] = free_endpoints(1)
    assert "nobody is there" in zfusion(directory, "status", "--connect", endpoint).error


@pytest.mark.parametrize("words", [("status",), ("top", "--once")])
def test_nobody_of_a_run_is_there(run: str, directory: Path, words: tuple[str, ...]) -> None:
    live = endpoints(directory / "observed.toml")["1"]
    result = zfusion(directory, *words, "--connect", live, "--run", "another")
    assert (result.code, result.out) == (1, "")
    assert "nobody of run another is there" in result.error


def test_what_is_no_endpoint_is_refused(directory: Path) -> None:
    result = zfusion(directory, "status", "--connect", "garbage")
    assert result.code == 2
    assert "connect: expected Zenoh endpoints" in result.error
    with pytest.raises(InputError, match="listen: expected Zenoh endpoints"):
        open_session(Endpoints(listen=("garbage",)))


def test_rates_of_a_single_look_are_those_of_the_whole_life(run: str, directory: Path) -> None:
    command = Command(directory, "top", "--run", run, "--json")
    wait_until(lambda: command.heard, "the first look")
    command.interrupt()
    nodes = json.loads(command.wait().out.splitlines()[0])["nodes"]
    assert list(nodes) == list(NODES)
    for node in nodes.values():
        assert node["rate_hz"] == pytest.approx(node["completed"] / node["elapsed_s"], abs=1e-3)


def test_paces_are_taken_over_no_less_than_a_second() -> None:
    node, told = SeenNode(present=True), Status(1, "f", Phase.RUNNING, 0, 1, None, {})
    rates = []
    for at_s, completed in ((50.0, 100), (50.01, 100), (50.1, 103), (51.0, 120), (55.0, 200)):
        node.answer(replace(told, completed=completed), at_s)
        rates.append(node.rate_hz)
    assert rates == [None, None, None, 20.0, 20.0]  # it tells nothing of its life here


def test_a_look_ends_though_somebody_takes_the_connection_and_says_nothing() -> None:
    """As a process that is stopped does; Zenoh, left to itself, waits for him for ten seconds."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        observer = Observer(Swarm("run", Endpoints(connect=(f"tcp/127.0.0.1:{silent.getsockname()[1]}",))))
        silent.settimeout(PATIENCE_S)
        with silent.accept()[0]:
            begins = time.monotonic()
            observer.close()
    assert time.monotonic() - begins < 8.0


def test_an_observer_of_a_secured_run_is_told_what_it_lacks_and_gets_what_it_is_given(directory: Path) -> None:
    plan = deployed(directory, hosts_document(), steps=1_000_000, timing={"rate_hz": 20.0})
    with swarm(plan, directory / "out") as running:
        wait_until(running.steps_taken, "messages are on the recording")
        beside = zfusion(directory / "out" / "a", "status", "--run", plan.run)  # the nodes' configurations are here
        desk, given = directory / "out" / "c", ("--zenoh-config", "zenoh/observer.json5", "--run", plan.run)
        found = zfusion(desk, "status", *given, "--json")
        lines = zfusion(desk, "echo", "**", *given, "--json", "--count", 40).out.splitlines()
        denied = zfusion(desk, "echo", "1/measurement", *given)
        running.interrupt()
        running.ended()
    assert beside.code == 2
    assert "an observer's (zfusion deploy writes it as zenoh/observer.json5)" in beside.error
    assert [node["state"] for node in found.summary["nodes"].values()] == ["running"] * 4
    letters = [json.loads(line) for line in lines]
    estimates_of = [(m["message"]["node"], m["message"]["step"]) for m in letters if m["key"].endswith("/estimate")]
    assert {m["key"].rpartition("/")[2] for m in letters} <= {"estimate", "event"}
    assert {str(node) for node, _ in estimates_of} == set(NODES)
    assert len(set(estimates_of)) == len(estimates_of)  # nothing comes twice
    assert denied.code == 2
    assert "(security.observer_reads) give nothing of" in denied.error


def test_top_on_a_terminal_ends_with_q(run: str, directory: Path) -> None:
    terminal, child = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "zfusion", "top", "--interval", "0.2"],
        cwd=directory,
        stdin=child,
        stdout=child,
        stderr=child,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"},
    )
    os.close(child)
    shown = b""
    while shown.count(b"running") < 12:
        shown += os.read(terminal, 4096)
    os.write(terminal, b"q")
    with suppress(OSError):  # the end of the terminal's other side
        while os.read(terminal, 4096):
            pass
    assert process.wait(60) == 0
    os.close(terminal)


def test_an_observer_that_stands_still_holds_nobody_up_beyond_its_lease(directory: Path) -> None:
    """Messages of 37 kB, fifty a second, so that its links fill."""
    nx, rate = 64, 50
    system = {"F": np.eye(nx).tolist(), "Q": np.eye(nx).tolist(), "initial_mean": [0.0] * nx}
    system |= {"initial_covariance": np.eye(nx).tolist()}
    sensors = [{"id": i, "H": [[1.0] + [0.0] * (nx - 1)], "R": 1.0} for i in (1, 2)]
    document = {"steps": 1, "method": "local", "timing": {"rate_hz": rate}, "system": system, "sensors": sensors}
    path, run = directory / "large.toml", run_name("stopped")
    path.write_text(tomli_w.dumps({"name": "large", **document, "network": {"generator": "complete"}}))
    command = Command(directory, "launch", path, "--json", "--no-record", "--run", run, "--steps", 1_000_000)
    with Observer(_swarm(run)) as observer:
        wait_until(lambda: _looked(observer, "running"), "all nodes are running")
        still = Command(directory, "echo", "**", "--run", run, "--json")
        wait_until(lambda: still.heard, "it hears something")
        still.process.send_signal(signal.SIGSTOP)
        stands = time.monotonic()
        wait_until(lambda: time.monotonic() > stands + 1.5 * LEASE_MS / 1e3, "its lease is over")
        before = {name: _steps(observer, name) for name in observer.nodes}
        wait_until(lambda: time.monotonic() > stands + 3 * LEASE_MS / 1e3, "another lease and a half is over")
        made = {name: _steps(observer, name) - before[name] for name in observer.nodes}
        still.process.kill()
        still.process.wait()
    command.interrupt()
    assert command.wait().code == 0
    assert min(made.values()) > 0  # a closing link that lingers would have held them up for ten seconds


def _steps(observer: Observer, name: str) -> int:
    """Steps that a node has completed."""
    observer.ask()
    status = observer.nodes[name].status
    assert status is not None
    return status.completed


def test_estimates_are_the_same_to_the_bit_whoever_looks(directory: Path) -> None:
    """A free-running swarm uses all messages, so that its estimates can be told beforehand."""
    scenario, run = variant(directory, "looked-at", timing={"timeout_s": 60.0}), run_name("looked-at")
    steps = 400
    command = Command(directory, "launch", scenario, "--free-run", "--json", "--run", run, "--steps", steps)
    heard = 0
    with Observer(_swarm(run)) as observer:
        ring = observer.listen(f"zfusion/{run}/**")
        while command.process.poll() is None:
            observer.ask()
            heard += sum(1 for _ in ring.take(0.1))
    assert command.wait().summary["completed_steps"] == dict.fromkeys(NODES, steps)
    assert heard > 100
    simulate(load_scenario(scenario, free_run=True, steps=steps), run=run, output=directory / "expected.mcap")
    assert estimates(directory / "recordings" / f"{run}.mcap") == estimates(directory / "expected.mcap")
