"""A live swarm from outside: what a Zenoh client that knows nothing of zfusion sees, and nodes started by hand."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from swarms import (
    EXAMPLE,
    Command,
    Listener,
    Result,
    census,
    client,
    decoded,
    endpoints,
    estimates,
    run_name,
    variant,
    wait_until,
)
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import open_session
from zfusion.messages import encode
from zfusion.model.scenario import load_scenario
from zfusion.stages import Message
from zfusion.status import Phase, Status
from zfusion.swarm.ports import free_endpoints

NODES = (1, 2, 3, 4)


class Outsider:
    """A Zenoh client and what it collected of a run."""

    def __init__(self, session: zenoh.Session, run: str) -> None:
        self.session, self.run = session, run
        self.everything = Listener(session, f"zfusion/{run}/**")
        self._tokens = session.liveliness().declare_subscriber(
            f"zfusion/{run}/**", zenoh.handlers.FifoChannel(1000), history=True
        )
        self.alive: set[str] = set()

    def watch(self) -> set[str]:
        """The liveliness tokens that are shown now."""
        while (token := self._tokens.handler.try_recv()) is not None:
            key = str(token.key_expr)
            (self.alive.add if token.kind == zenoh.SampleKind.PUT else self.alive.discard)(key)
        return self.alive

    def of(self, key: str) -> list[zenoh.Sample]:
        return [s for s in self.everything.collect() if str(s.key_expr) == f"zfusion/{self.run}/{key}"]

    def ask(self, key: str) -> list[dict[str, Any]]:
        replies = self.session.get(f"zfusion/{self.run}/{key}", zenoh.handlers.FifoChannel(100), timeout=20.0)
        return [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies]


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("live")


@pytest.fixture(scope="module")
def outsider(directory: Path) -> Iterator[Outsider]:
    """Somebody who watches a paced swarm of the example that goes on until he has seen enough."""
    scenario, run = variant(directory, "watched", timing={"rate_hz": 50.0}), run_name("watched")
    command = Command(directory, "launch", scenario, "--json", "--no-record", "--run", run, "--steps", 1_000_000)
    with client(*endpoints(scenario).values()) as session:
        watching = Outsider(session, run)
        wait_until(lambda: all(len(watching.of(f"node/{i}/estimate")) > 20 for i in NODES), "estimates of all nodes")
        watching.watch()
        yield watching
        command.interrupt()
        assert command.wait().code == 0
    assert not census(run)


def test_the_keys_are_those_of_the_contract(outsider: Outsider) -> None:
    published = {str(sample.key_expr) for sample in outsider.everything.collect()}
    stages = ("measurement", "intermediate", "estimate")
    expected = {f"zfusion/{outsider.run}/node/{i}/{stage}" for i in NODES for stage in stages}
    assert expected | {f"zfusion/{outsider.run}/truth"} <= published
    assert published - expected <= {
        f"zfusion/{outsider.run}/truth",
        *(f"zfusion/{outsider.run}/node/{i}/{stage}" for i in NODES for stage in ("event", "arrivals")),
    }


def test_encoding_and_time_stamps(outsider: Outsider) -> None:
    for sample in outsider.everything.collect():
        assert str(sample.encoding) == "application/msgpack"
        assert sample.kind == zenoh.SampleKind.PUT
        assert sample.timestamp is not None
        stamped = sample.timestamp.get_time_as_ntp64().as_nanos()
        assert abs(stamped - decoded(sample)["t_ns"]) < 5_000_000_000
        assert abs(stamped - time.time_ns()) < 600_000_000_000


def test_the_payloads_describe_themselves(outsider: Outsider) -> None:
    for i in NODES:
        measurement = decoded(outsider.of(f"node/{i}/measurement")[-1])
        intermediate = decoded(outsider.of(f"node/{i}/intermediate")[-1])
        estimate = decoded(outsider.of(f"node/{i}/estimate")[-1])
        for message in (measurement, intermediate, estimate):
            assert (message["v"], message["node"], message["born"]) == (1, i, 1)
            assert message["step"] >= 1
        assert [type(y) for y in measurement["y"]] == [float]
        assert [type(x) for x in intermediate["x"]] == [float]
        assert set(intermediate["used"]) <= set(NODES)
        assert i in intermediate["used"]
        assert estimate["shape"] == [1, 1]
        assert estimate["P"][0] > 0
        assert i in estimate["used"]
    assert decoded(outsider.of("truth")[-1])["node"] == "truth"


def test_one_put_a_message_whoever_listens(outsider: Outsider) -> None:
    for i in NODES:
        numbers = [decoded(sample)["seq"] for sample in outsider.of(f"node/{i}/measurement")]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_everybody_shows_that_he_is_there(outsider: Outsider) -> None:
    wait_until(lambda: outsider.watch() == {f"zfusion/{outsider.run}/node/{i}" for i in NODES}, "tokens of all nodes")


def test_nodes_answer_how_they_are_doing(outsider: Outsider) -> None:
    for i in NODES:
        [status] = outsider.ask(f"node/{i}/status")
        assert (status["node"], status["phase"], status["born"]) == (i, "running", 1)
        assert status["step"] >= 20
        assert status["completed"] >= 20
        assert len(status["fingerprint"]) == 64
        assert {node for node, _ in status["ready"]} == set(NODES)
    assert {status["node"] for status in outsider.ask("node/*/status")} == set(NODES)


def test_nodes_answer_what_they_used(outsider: Outsider) -> None:
    for i in NODES:
        [history] = outsider.ask(f"node/{i}/history")
        assert history["born"] == 1
        assert history["end"] >= 20
        assert history["runs"][0][0] == 1
        assert all(i in used or not used for _, used in history["runs"])


def started_by_hand(
    directory: Path, scenario: Path, run: str, nodes: tuple[int, ...], *words: object
) -> dict[int, Command]:
    return {i: Command(directory, "node", scenario, "--id", i, "--run", run, "--json", *words) for i in nodes}


def pair(directory: Path, name: str = "pair", **tables: Any) -> Path:
    """Two of the example's sensors that hear each other."""
    text = EXAMPLE.read_text()
    sensors = text.split("[[sensors]]")
    base = directory / f"{name}.base.toml"
    base.write_text("[[sensors]]".join(sensors[:3]))
    return variant(directory, name, base, network={"matrix": [[1, 1], [1, 1]]}, **tables)


def test_nodes_and_recorder_started_by_hand_make_a_swarm(directory: Path) -> None:
    scenario, run = pair(directory), run_name("hand")
    path = directory / "hand.mcap"
    recorder = Command(directory, "record", scenario, "--run", run, "-o", path, "--json")
    nodes = started_by_hand(directory, scenario, run, (2, 1), "--free-run", "--steps", 100, "--await-recorder")
    results = {i: command.wait() for i, command in nodes.items()}
    for i, result in results.items():
        assert result.code == 0, result.err
        report = result.summary
        assert (report["node"], report["completed"]) == (i, 100)
        [edge] = report["edges"].values()
        assert edge["received"] == {"measurement": 100, "intermediate": 100}
    recorded = recorder.wait()  # ends by itself when all have left
    assert recorded.code == 0, recorded.err
    assert recorded.summary["recorded"] == {
        "measurement": 200, "intermediate": 200, "estimate": 200, "event": 4, "arrivals": 4, "truth": 100
    }  # fmt: skip
    assert recorded.summary["lost"] == {}
    assert len(estimates(path)) == 200
    assert not census(run)


def test_nodes_of_different_scenarios_refuse_each_other_and_both_say_both(directory: Path) -> None:
    one, run = pair(directory, "one"), run_name("strangers")
    other = directory / "other.toml"
    other.write_text(re.sub("^seed = .*$", "seed = 12345", one.read_text(), flags=re.MULTILINE))
    commands = [
        started_by_hand(directory, scenario, run, (i,), "--free-run")[i] for i, scenario in ((1, one), (2, other))
    ]
    results: list[Result] = [command.wait() for command in commands]
    prints = set()
    for own, theirs, result in zip((1, 2), (2, 1), results, strict=True):
        assert result.code == 2
        assert f"node {theirs} runs scenario" in result.error
        assert f"node {own}, here, runs scenario" in result.error
        prints.add(frozenset(word for word in result.error.replace(";", " ").split() if len(word) == 12))
    assert len(prints) == 1
    assert len(prints.pop()) >= 2


def test_a_node_alone_says_whom_it_waits_for_and_can_be_stopped(directory: Path) -> None:
    [command] = started_by_hand(directory, pair(directory, "alone"), run_name("alone"), (1,)).values()
    wait_until(lambda: "waiting for node 2" in command.said(), "it says so")
    command.interrupt()
    result = command.wait()
    assert result.code == 0
    assert result.summary["completed"] == 0


def test_a_node_can_be_stopped_and_leaves_the_others_running(directory: Path) -> None:
    scenario, run = pair(directory, "stopped", timing={"rate_hz": 50.0}), run_name("stopped")
    nodes = started_by_hand(directory, scenario, run, (1, 2), "--steps", 1_000_000)
    with client(*endpoints(scenario).values()) as session:
        heard = Listener(session, f"zfusion/{run}/node/1/intermediate")
        wait_until(lambda: len(heard.collect()) > 10, "both run")
        nodes[2].interrupt()
        assert nodes[2].wait().code == 0
        wait_until(lambda: decoded(heard.collect()[-1])["used"] == [1], "node 1 goes on alone")
        step = decoded(heard.collect()[-1])["step"]
        wait_until(lambda: decoded(heard.collect()[-1])["step"] > step + 10, "and on")
    nodes[1].interrupt()
    result = nodes[1].wait()
    assert result.code == 0
    assert result.summary["edges"]["2"]["lost"] == {"measurement": 0, "intermediate": 0}


def test_a_given_epoch_begins_with_whoever_is_there(directory: Path) -> None:
    scenario = pair(directory, "epoch", timing={"rate_hz": 50.0})
    begins = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() - 100))
    [command] = started_by_hand(
        directory, scenario, run_name("epoch"), (1,), "--epoch", begins, "--steps", 100_000_000
    ).values()
    with client(endpoints(scenario)["1"]) as session:
        heard = Listener(session, "zfusion/*/node/1/intermediate")
        wait_until(heard.collect, "it begins")
    command.interrupt()
    assert command.wait().code == 0
    first = decoded(heard.samples[0])
    assert first["born"] >= 100 * 50
    assert first["used"] == [1]


def test_endpoints_that_cannot_be_are_refused(directory: Path) -> None:
    for words in (("--listen", "carrier-pigeon/coop:1"), ("--listen", "tcp/no.such.host.invalid:1")):
        [command] = started_by_hand(directory, EXAMPLE, run_name("bad"), (1,), *words).values()
        result = command.wait()
        assert result.code == 2
        assert words[1] in result.error


def test_a_zenoh_configuration_of_the_users_rules(directory: Path) -> None:
    [endpoint] = free_endpoints(1)
    quiet = {"multicast": {"enabled": False}}
    (directory / "zenoh.json5").write_text(
        json.dumps({"mode": "peer", "listen": {"endpoints": [endpoint]}, "scouting": quiet})
    )
    scenario = pair(directory, "configured", transport={"zenoh_config": "zenoh.json5"})
    run = run_name("configured")
    [command] = started_by_hand(directory, scenario, run, (1,)).values()
    with client(endpoint) as session:
        watching = Outsider(session, run)
        wait_until(watching.watch, "the node is found where the file says")
    command.interrupt()
    assert command.wait().code == 0
    (directory / "zenoh.json5").write_text("{ nonsense")
    [broken] = started_by_hand(directory, scenario, run, (1,)).values()
    result = broken.wait()
    assert result.code == 2
    assert "zenoh.json5" in result.error


def test_a_node_that_is_behind_and_never_waits_still_answers(directory: Path) -> None:
    """Whatever happens beside the messages is seen to between two steps, not only when there is nothing to do."""
    scenario, run, steps = pair(directory, "behind", timing={"timeout_s": 60.0}), run_name("behind"), 12_000
    loaded = load_scenario(scenario, free_run=True)
    status = Status(2, loaded.fingerprint, Phase.RUNNING, step=1, born=1, epoch_ns=1, ready={})
    said: dict[str, dict[str, object]] = {
        "measurement": {"y": np.zeros(1)},
        "intermediate": {"x": np.zeros(1), "used": (2,), "history": ((1, (2,)),)},
    }
    messages = [
        (stage, encode(Message(2, step, stage, step - 1, 1, 1, fields)))
        for step in range(2, steps)
        for stage, fields in said.items()
    ]
    [command] = started_by_hand(directory, scenario, run, (1,), "--free-run", "--forever").values()
    own = Endpoints(listen=(endpoints(scenario)["2"],), connect=(endpoints(scenario)["1"],))
    with open_session(own) as session:
        key = f"zfusion/{run}/node/2"
        answering = session.declare_queryable(
            f"{key}/status", lambda query: query.reply(f"{key}/status", status.encode())
        )
        token = session.liveliness().declare_token(key)
        heard = Listener(session, f"zfusion/{run}/node/1/measurement")
        wait_until(heard.collect, "node 1 begins")
        for stage, data in messages:
            session.put(f"{key}/{stage}", data, congestion_control=zenoh.CongestionControl.BLOCK)
        [reply] = session.get(f"zfusion/{run}/node/1/status", zenoh.handlers.FifoChannel(10), timeout=60.0)
        told = Status.decode(reply.ok.payload.to_bytes())
        assert told.step < steps - 1, "it answered when it had nothing else to do"
        answering.undeclare()
        token.undeclare()
    command.interrupt()
    assert command.wait().code == 0
