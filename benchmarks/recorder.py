"""The recorder: messages a second that it sustains with none lost, and its CPU a message, beside a raw append.

    python benchmarks/recorder.py [--messages N] [--json]

One process publishes the estimates of four nodes as fast as the recorder takes them (a full link holds it back). The
floor appends the same bytes, with a length before each, to a file; both in the same run, in turn.
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from results import tell
from zfusion import keys
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import open_session, publisher
from zfusion.messages import encode
from zfusion.stages import Message
from zfusion.swarm.ports import free_endpoints

SCENARIO = Path(__file__).parents[1] / "examples" / "four_sensor.toml"
RUN = "benchmark"


def estimates(count: int) -> list[tuple[int, bytes]]:
    """(node, payload) of `count` estimates of four nodes in turn."""
    rng = np.random.default_rng(0)
    found = []
    for number in range(count):
        node, seq = number % 4 + 1, number // 4
        fields = {"x": rng.standard_normal(1), "P": np.array([[rng.random()]]), "used": (node,), "excluded": ()}
        found.append((node, encode(Message(node, seq + 1, "estimate", seq, 1, time.time_ns(), fields))))
    return found


def record(messages: list[tuple[int, bytes]], directory: Path) -> dict[str, float]:
    """Publish all to a recorder in a process of its own."""
    path = directory / "benchmark.mcap"
    [endpoint] = free_endpoints(1)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with open_session(Endpoints(listen=(endpoint,))) as session:
        command = [sys.executable, "-m", "zfusion", "record", str(SCENARIO), "--run", RUN]
        recorder = subprocess.Popen(
            [*command, "-o", str(path), "--connect", endpoint, "--json"], stdout=subprocess.PIPE, text=True
        )
        while not list(session.liveliness().get(keys.recorder_token(RUN), timeout=0.2)):
            pass
        puts = {node: publisher(session, keys.stage_key(RUN, node, "estimate")).put for node in (1, 2, 3, 4)}
        began = time.perf_counter()
        for node, payload in messages:
            puts[node](payload)
        answers = list(session.get(keys.recorder_status_key(RUN), timeout=60.0))
        wall = time.perf_counter() - began
        assert answers, "the recorder did not answer"
        recorder.send_signal(signal.SIGINT)
        report = json.loads(recorder.communicate(timeout=60)[0])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    lost = len(messages) - report["messages"]
    return {"wall_s": wall, "cpu_s": cpu, "lost": lost, "bytes_per_message": path.stat().st_size / len(messages)}


def append(messages: list[tuple[int, bytes]], directory: Path) -> dict[str, float]:
    """Append the same bytes to a file."""
    began, cpu = time.perf_counter(), time.process_time()
    with (directory / "raw").open("wb") as file:
        for _, payload in messages:
            file.write(struct.pack("<I", len(payload)))
            file.write(payload)
    return {"wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    messages, few = estimates(options.messages), estimates(1000)
    recorded, raw, idle = [], [], []
    with tempfile.TemporaryDirectory() as directory:
        for _ in range(options.repetitions):
            idle.append(record(few, Path(directory))["cpu_s"])  # start and end of the process alone
            recorded.append(record(messages, Path(directory)))
            raw.append(append(messages, Path(directory)))
    n = options.messages
    cpu = (statistics.median(r["cpu_s"] for r in recorded) - statistics.median(idle)) / n * 1e6
    floor = statistics.median(r["cpu_s"] for r in raw) / n * 1e6
    result = {
        "messages": n,
        "lost": max(r["lost"] for r in recorded),
        "messages_per_s": round(n / statistics.median(r["wall_s"] for r in recorded)),
        "cpu_us_per_message": round(cpu, 2),
        "raw_append_cpu_us_per_message": round(floor, 2),
        "ratio": round(cpu / floor, 1),
        "bytes_per_message": round(recorded[0]["bytes_per_message"], 1),
    }
    tell(result, options.json)


if __name__ == "__main__":
    main()
