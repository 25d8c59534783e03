"""The floor of a round: the same messages between as many processes on raw Zenoh, and nothing else.

    python benchmarks/floor.py [--rounds N] [--rate HZ] [--lowlatency] [--nodes N] [--json]

Each process puts a message of a measurement's size, waits for one of each of the two that it hears, puts one of an
intermediate estimate's size, waits again. No codec but a counter, no numerics, no time stamps, no accounts; one thread
for Zenoh, a channel for each neighbour, links between neighbours only, every message at once: the leanest of what was
tried. (The estimate itself is heard by nobody here, so it is not sent.) The graph is that of the four-sensor example
for four nodes: node i hears i + 1 and i + 2.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import struct
import subprocess
import sys
import time
from typing import Any

os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx: (handover: app), acc: (handover: app), tx: (handover: app), net: (handover: app), app: (worker_threads: 1))",
)

import zenoh

from zfusion.swarm.ports import free_endpoints

SIZES = (57, 81)
"""Bytes of a measurement and of an intermediate estimate of the example, once it has settled."""

COUNTER = struct.Struct("<Q")

IN_STEP = 20
"""Rounds after which all processes are in step, and are paced from there."""


def heard(node: int, nodes: int) -> list[int]:
    """Whom a node hears; the example's rows are (1, 2), (2, 3), (0, 3), (0, 1)."""
    return sorted({(node + 1) % nodes, (node + 2) % nodes} - {node})


def configuration(node: int, endpoints: list[str], low_latency: bool) -> zenoh.Config:
    nodes = len(endpoints)
    linked = {j for j in range(nodes) if j in heard(node, nodes) or node in heard(j, nodes)}
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [endpoints[node]],
        "connect/endpoints": [endpoints[j] for j in linked if j < node],
        "connect/timeout_ms": 20_000,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 10, "period_max_ms": 50, "period_increase_factor": 1.5},
        "transport/shared_memory/enabled": False,
    }
    if low_latency:
        settings |= {"transport/unicast/qos/enabled": False, "transport/unicast/lowlatency": True}
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def run_node(node: int, run: str, endpoints: list[str], options: argparse.Namespace) -> None:
    """One process: prints a line of JSON."""
    with zenoh.open(configuration(node, endpoints, options.lowlatency)) as session:
        subscribers = [
            session.declare_subscriber(f"floor/{run}/{j}", zenoh.handlers.FifoChannel(64))
            for j in heard(node, len(endpoints))
        ]
        publisher = session.declare_publisher(
            f"floor/{run}/{node}",
            express=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        token = meet(session, run, node, len(endpoints))
        channels = [(s.handler.try_recv, s.handler.recv) for s in subscribers]
        put, pack, unpack = publisher.put, COUNTER.pack, COUNTER.unpack_from
        pads = [bytes(size - COUNTER.size) for size in SIZES]
        gc.collect()
        gc.freeze()
        gc.disable()
        period = 0 if options.rate is None else round(1e9 / options.rate)
        durations = []
        due = begun = cpu = 0
        for k in range(options.rounds):
            if k == options.rounds // 2:
                begun, cpu = time.perf_counter_ns(), time.process_time_ns()
            if period and k < IN_STEP:
                due = time.perf_counter_ns()
            elif period:
                due += period
                time.sleep(max(0, due - time.perf_counter_ns()) / 1e9)
            start = time.perf_counter_ns()
            for stage, pad in enumerate(pads):
                number = 2 * k + stage
                put(pack(number) + pad)
                for try_recv, recv in channels:
                    (got,) = unpack((try_recv() or recv()).payload.to_bytes())
                    if got != number:
                        raise RuntimeError(f"node {node}: {got}, expected {number}")
            durations.append(time.perf_counter_ns() - start)
        elapsed, cpu = time.perf_counter_ns() - begun, time.process_time_ns() - cpu
        half = len(durations) - options.rounds // 2
        told = {"rate": 1e9 * half / elapsed, "cpu_us": cpu / half / 1000, "us": [d / 1000 for d in durations[-half:]]}
        sys.stdout.write(json.dumps(told) + "\n")
        sys.stdout.flush()
        put(pack(2**63))  # leave together
        for _, recv in channels:
            recv()
        token.undeclare()


def meet(session: zenoh.Session, run: str, node: int, nodes: int) -> zenoh.LivelinessToken:
    """Wait until all that hear this node, or that it hears, have subscribed: tokens come after subscriptions."""
    near = {j for j in range(nodes) if j in heard(node, nodes) or node in heard(j, nodes)} - {node}
    liveliness = session.liveliness()
    tokens = liveliness.declare_subscriber(f"floor/{run}/up/*", zenoh.handlers.FifoChannel(1000), history=True)
    own = liveliness.declare_token(f"floor/{run}/up/{node}")
    while near:
        near.discard(int(str(tokens.recv().key_expr).rsplit("/", 1)[1]))
    return own


def measure(options: argparse.Namespace) -> dict[str, float]:
    """Start all processes, and put together what they say: the settled second half of the rounds."""
    endpoints = free_endpoints(options.nodes)
    run = f"{os.getpid()}-{time.monotonic_ns()}"
    words = ["--rounds", str(options.rounds), "--run", run, "--endpoints", *endpoints]
    words += ["--rate", str(options.rate)] if options.rate is not None else []
    words += ["--lowlatency"] if options.lowlatency else []
    processes = [
        subprocess.Popen([sys.executable, __file__, *words, "--node", str(i)], stdout=subprocess.PIPE, text=True)
        for i in range(options.nodes)
    ]
    try:
        told = [json.loads(process.communicate(timeout=120)[0]) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait()
    durations = sorted(us for node in told for us in node["us"])
    return {
        "rounds_per_s": min(node["rate"] for node in told),
        "p50_us": durations[len(durations) // 2],
        "p99_us": durations[len(durations) * 99 // 100],
        "cpu_us": statistics.mean(node["cpu_us"] for node in told),
    }


def parsed(words: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=4000)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--lowlatency", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--node", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("--endpoints", nargs="+", help=argparse.SUPPRESS)
    return parser.parse_args(words)


def main() -> None:
    options = parsed()
    if options.node is not None:
        run_node(options.node, options.run, options.endpoints, options)
        return
    found = measure(options)
    if options.json:
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        sys.stdout.write(
            f"{found['rounds_per_s']:.0f} rounds/s; {found['p50_us']:.0f} µs (p50), {found['p99_us']:.0f} µs (p99); "
            f"{found['cpu_us']:.0f} µs of CPU a node and round\n"
        )


if __name__ == "__main__":
    main()
