"""A recorder that stands still, or has no room: the swarm goes on, and what is missing is told."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from swarms import Command, process_of, run_name, variant, wait_until
from test_supervision import ENDLESS, NODES, swarm
from zfusion import keys
from zfusion.drivers.settings import LEASE_MS
from zfusion.recording import Recording

RATE_HZ = 50.0


def test_a_recorder_that_stands_still_does_not_hold_up_a_paced_swarm(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, timing={"rate_hz": RATE_HZ}) as running:
        running.wait_for(1, 20)
        recorder = process_of(running.run, "record")
        os.kill(recorder, signal.SIGSTOP)
        stopped = running.step(1)
        lease = int(LEASE_MS / 1000 * RATE_HZ)
        running.wait_for(1, stopped + 3 * lease)  # far beyond what the links hold, and all that the lease explains
        os.kill(recorder, signal.SIGCONT)
        running.wait_for(1, running.step(1) + 2 * lease)
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["failures"] == []
    messages = summary["messages"]
    missing = sum(messages["sent"].values()) - sum(messages["recorded"].values())
    assert sum(summary["lost_on_recording"].values()) == missing > 0
    with Recording.open(running.recording) as recording:
        assert recording.complete
        assert recording.statistics is not None
        gaps = recording.statistics[keys.stage_key(running.run, 1, "measurement")]
    assert gaps.lost_between > 0


def test_a_recorder_that_stands_still_longer_than_links_are_kept_misses_what_a_free_running_swarm_says(
    tmp_path: Path,
) -> None:
    """Senders wait for it, until its links are given up."""
    with swarm(tmp_path, "--steps", ENDLESS, "--free-run") as running:
        logs = [tmp_path / f"{running.run}.logs" / f"node-{node}.log" for node in NODES]
        running.wait_for(1, 20)
        recorder = process_of(running.run, "record")
        os.kill(recorder, signal.SIGSTOP)
        gone, there = "the recorder is gone", "the recorder is there"
        wait_until(lambda: all(gone in log.read_text() for log in logs), "its links are given up")
        running.wait_for(1, running.step(1) + 20)
        os.kill(recorder, signal.SIGCONT)
        wait_until(lambda: all(there in log.read_text().partition(gone)[2] for log in logs), "it is back")
        running.wait_for(1, running.step(1) + 20)
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["failures"] == []
    missing = sum(summary["messages"]["sent"].values()) - sum(summary["messages"]["recorded"].values())
    assert sum(summary["lost_on_recording"].values()) == missing > 0
    assert (summary["recorder"]["unrecorded"], summary["recorder"]["overrun"]) == (0, 0)


def test_a_swarm_whose_recording_has_no_more_room_runs_to_its_end(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: any user may set one."""
    scenario = variant(tmp_path, recording={"min_free_bytes": 0, "flush_interval_s": 0.05})
    run, path = run_name("full"), tmp_path / "r.mcap"
    words = ["launch", scenario, "--json", "--run", run, "--free-run", "--steps", 1500, "--record", path]
    result = Command(tmp_path, *words, limit_bytes=100_000).wait()
    assert result.code == 1, result.err
    summary = result.summary
    assert set(summary["completed_steps"].values()) == {1500}
    [failure] = summary["failures"]
    sent, written = sum(summary["messages"]["sent"].values()), sum(summary["messages"]["recorded"].values())
    assert failure == f"{path}: writing failed: File too large: {sent - written} messages are not on the recording"
    assert summary["recorder"]["unrecorded"] == sent - written
    with Recording.open(path) as recording:
        assert recording.messages == written > 500
        assert not recording.complete
