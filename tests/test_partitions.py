"""Hosts that are cut off and come back, links that carry one way only, a router that dies and is started again.

    python -m pytest -m long tests/test_partitions.py

Needs network namespaces, but for the router.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

import pytest

from exactness import Exactness
from swarms import Command, Listener, client, decoded, launch, recorded, run_name, variant, wait_until, zfusion
from test_netns_swarm import TROUBLE
from zfusion.swarm.launch import free_endpoints

pytestmark = pytest.mark.long

EVERYBODY = {1: [1, 2, 3], 2: [2, 3, 4], 3: [1, 3, 4], 4: [1, 2, 4]}
SLOW = {"timing": {"rate_hz": 20.0}}

PARTINGS: dict[str, list[dict[str, Any]]] = {
    "a host": [{"kind": "partition", "step": 21, "steps": 70, "groups": [[1]]}],
    "one way": [{"kind": "cut", "from": 2, "to": 1, "step": 21, "steps": 70}],
}


def assert_right(directory: Path, path: Path) -> None:
    """Every estimate on the recording comes out of a replay bit for bit, and is the least-squares one."""
    verdict = zfusion(directory, "replay", path, "--verify", "--json")
    assert verdict.code == 0, verdict.out
    assert (verdict.summary["different"], verdict.summary["unverifiable"]) == (0, 0)
    assert Exactness(path).assert_sample(Random(1), 25)["estimates"] > 50


@pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")
@pytest.mark.parametrize("what", PARTINGS)
def test_who_is_cut_off_is_missed_and_taken_back(tmp_path: Path, what: str) -> None:
    scenario = variant(tmp_path, "parted", links={"delay": 0.002}, faults=PARTINGS[what], **SLOW)
    result = launch(tmp_path, scenario, "--netns-with", "tun", "--steps", 160, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["failures"] == []
    used: dict[int, dict[int, list[int]]] = {i: {} for i in EVERYBODY}
    for m in recorded(tmp_path / "x.mcap"):
        if m.topic.endswith("/intermediate"):
            used[m.payload["node"]][m.payload["step"]] = m.payload["used"]
    # TCP needs both ways: where one is cut, the acknowledgements of the other do not come, and its link is given up.
    assert all(2 not in ids for step, ids in used[1].items() if 24 <= step <= 88)
    assert EVERYBODY[1] in [ids for step, ids in used[1].items() if step > 92]
    missed = {(e["sender"], e["receiver"]): e["missed"] + e["lost"] for e in summary["edges"]}
    assert missed["2", "1"] > 0
    assert_right(tmp_path, tmp_path / "x.mcap")


ROUTER = """
import sys
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import open_session
with open_session(Endpoints(listen=(sys.argv[1],)), mode="router"):
    print("ready", flush=True)
    sys.stdin.read()
"""


@contextmanager
def router(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A Zenoh router, until it is killed."""
    words = [sys.executable, "-c", ROUTER, endpoint]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def wait_for_everybody(endpoint: str, run: str, command: Command, after: int) -> int:
    """Until all nodes use all their neighbours at some step beyond one; that step."""
    with client(endpoint) as session:
        heard = Listener(session, f"zfusion/{run}/node/*/intermediate")

        def full() -> set[int]:
            at: dict[int, set[int]] = {i: set() for i in EVERYBODY}
            for message in map(decoded, heard.collect()):
                if message["step"] > after and message["used"] == EVERYBODY[message["node"]]:
                    at[message["node"]].add(message["step"])
            return set.intersection(*at.values())

        wait_until(full, f"everybody is heard after step {after}\n{command.said()}")
        return max(full())


def test_a_router_that_is_killed_and_started_again(tmp_path: Path) -> None:
    [endpoint] = free_endpoints(1)
    retry = {"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5}
    (tmp_path / "zenoh.json5").write_text(
        json.dumps(
            {
                "mode": "client",
                "connect": {"endpoints": [endpoint], "timeout_ms": -1, "exit_on_failure": False, "retry": retry},
                "scouting": {"multicast": {"enabled": False}},
            }
        )
    )
    scenario = variant(tmp_path, "routed", transport={"zenoh_config": "zenoh.json5", "endpoints": {}}, **SLOW)
    run, path = run_name("routed"), tmp_path / "x.mcap"
    with router(endpoint):
        command = Command(tmp_path, "launch", scenario, "--json", "--run", run, "--record", path, "--steps", 1_000_000)
        step = wait_for_everybody(endpoint, run, command, 20)
    with router(endpoint):
        wait_for_everybody(endpoint, run, command, step)
        command.interrupt()
        result = command.wait()
    assert result.code == 0, result.err
    assert result.summary["failures"] == []
    assert_right(tmp_path, path)
