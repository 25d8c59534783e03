"""Deployed folders on hosts of their own: network namespaces, each with its own address and nothing but its folder.

Needs root and the kernel for it; where they are missing, the tests say so and are skipped.
"""

from __future__ import annotations

import shutil
import socket
from pathlib import Path

import pytest

from deployed import SPREAD, deployed, hosts_document, process, swarm
from namespaces import hosts, why_none
from swarms import estimates, recorded, run_name, wait_until, zfusion

TROUBLE = why_none()

pytestmark = pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")

STEPS = 20


@pytest.mark.parametrize("topology", ["direct", "router"])
def test_each_host_with_nothing_but_its_folder(tmp_path: Path, topology: str) -> None:
    devices = socket.if_nameindex()
    spread = dict(SPREAD) | ({"gate": {"router": True}} if topology == "router" else {})
    with hosts(spread) as made:
        document = {
            "run": run_name("hosts"),
            "topology": topology,
            "hosts": {name: {"address": made.addresses[name], **what} for name, what in spread.items()},
        }
        plan = deployed(tmp_path, document, steps=STEPS, free_run=True)
        for name in spread:
            shutil.copytree(tmp_path / "out" / name, tmp_path / "copied" / name)
        shutil.rmtree(tmp_path / "out")
        with swarm(plan, tmp_path / "copied", made) as running:
            reports = running.ended()
    assert socket.if_nameindex() == devices
    for i in plan.scenario.ids:
        assert reports[f"node-{i}"]["completed"] == STEPS
        assert not any(edge["refused"] for edge in reports[f"node-{i}"]["edges"].values())
    assert reports["recorder"]["foreign"] == 0
    assert not reports["recorder"]["lost"]
    assert {m.topic.split("/")[3] for m in recorded(running.recording) if "/node/" in m.topic} == {"1", "2", "3", "4"}
    verdict = zfusion(tmp_path, "replay", running.recording, "--verify", "--json")
    assert verdict.code == 0, verdict.err


def test_a_router_that_is_killed_and_started_again(tmp_path: Path) -> None:
    """Nobody ends for it, and all find each other again; what was lost meanwhile is told."""
    plan = deployed(tmp_path, hosts_document("router"), steps=100_000, timing={"rate_hz": 20.0})
    with swarm(plan, tmp_path / "out") as running:
        wait_until(running.steps_taken, "steps are taken")
        said = running.commands["recorder"].said
        running.commands["router-a"].process.kill()
        running.commands["router-a"].process.wait()
        wait_until(lambda: all(f"node {i} is gone" in said() for i in "1234"), "the recorder sees nobody")
        running.start(process(plan, "router-a"))
        recorded_then = running.recording.stat().st_size
        wait_until(lambda: running.recording.stat().st_size > recorded_then + 40_000, "it is recorded again")
        running.interrupt()
        reports = running.ended()
    last = {i: used for (i, _), (*_, used, _) in sorted(estimates(running.recording).items())}
    assert last == {i: list(plan.scenario.network.neighbours(i)) for i in plan.scenario.ids}
    assert sum(reports["recorder"]["lost"].values()) > 0
