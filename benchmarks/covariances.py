"""The covariance recursion beside a direct transcription of the paper's formulas with Python loops.

    OPENBLAS_NUM_THREADS=1 python benchmarks/covariances.py [--sizes 16 64 256] [--json]

Per step, while nothing has settled, everything in one process and one thread, in turn:

    node       all that one node of degree 6 does: its own filter, the pairs of its neighbourhood, the fusion, the data
    network    intermediate and fused covariances of all nodes, each pair once
    printed    the same by `tests/oracles/printed_form.py`: each node what it needs, as in the paper; or each pair once

and what a node's step costs once all has settled. The system is the paper's example with two states and more sensors:
a noise common to all of them, correlated over time and with the process noise.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np

from oracles import paper, printed_form
from zfusion.methods import Fields, Setting
from zfusion.methods.prediction import Filters, Fusions, with_common_listener
from zfusion.methods.two_stage import TwoStage
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.network import Network
from zfusion.model.noise import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.statistics import step_models
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId
from zfusion.used_sets import Ledger

DEGREE, NX = 6, 2
STEPS = 12
"""Steps from the start that are timed: far from settled."""
SAMPLE = 16
"""Nodes of which the transcription is timed: all do the same."""
SETTLED_STEPS = 2_000


def common_noise_system(m: int) -> System:
    """x in R², y^i = h_i x + v^i in R, with one η in w and in all v^i, as in the paper, and a private noise each."""
    rng = np.random.default_rng(1)

    def tap(source: str, lag: int, matrix: Array) -> Tap:
        return Tap(source, lag, Schedule((matrix,)))

    push, weights = np.array([[0.1], [0.6]]), rng.uniform(0.5, 1.0, (m, 1, 1))
    white = {"eta": WhiteNoise(np.array([[0.5]])), "state": WhiteNoise(0.1 * np.eye(NX))}
    white |= {f"sensor {i}": WhiteNoise(np.array([[0.25]])) for i in range(m)}
    return System(
        nx=NX,
        initial_mean=np.zeros(NX),
        initial_covariance=np.eye(NX),
        F=Schedule((Fixed(np.array([[0.95, 0.1], [0.0, 0.9]])),)),
        sensors=tuple(Sensor(i, 1, Schedule((Fixed(rng.normal(size=(1, NX))),), first=1)) for i in range(m)),
        noise=MovingAverageNoise(
            white=white,
            process=(tap("state", 0, np.eye(NX)), tap("eta", 0, push), tap("eta", 1, push)),
            sensors={
                i: (tap(f"sensor {i}", 0, np.eye(1)), tap("eta", -1, weights[i]), tap("eta", 0, weights[i]))
                for i in range(m)
            },
        ),
    )


def node_steps(system: System, network: Network, node: NodeId) -> Iterator[None]:
    """The method at one node, every message arriving."""
    method = TwoStage(Setting(node, system, network))
    ledger, near = Ledger(node, 1), network.neighbours(node)
    told: dict[NodeId, Fields] = {j: {"y": np.ones(system.by_id[j].ny), "x": np.ones(system.nx)} for j in near}
    k = 0
    while True:
        k += 1
        method.advance(0, k, told, ledger)
        for j in near:
            ledger.learn(j, 1, k, network.neighbours(j), [(1, network.neighbours(j))] if k > 1 else [])
        method.advance(1, k, told, ledger)
        yield


def network_steps(system: System, network: Network) -> Iterator[None]:
    """The covariances of all nodes."""
    filters = Filters(system, network.neighbourhoods, with_common_listener(network))
    fusions = Fusions(network, filters.layout, system.nx)
    for model, moments in step_models(system, network.ids):
        filters.advance(model)
        fusions.covariances(filters.state, moments.covariance)
        yield


def printed_steps(system: System, network: Network, nodes: list[NodeId]) -> Iterator[None]:
    """The transcription: each of the nodes all that it needs."""
    recursions = [printed_form.node_recursion(system, network.neighbourhoods, node) for node in nodes]
    while True:
        for recursion in recursions:
            recursion.step()
        yield


def printed_shared_steps(system: System, network: Network) -> Iterator[None]:
    """The transcription: each pair of the network once."""
    recursion = printed_form.network_recursion(system, network.neighbourhoods)
    while True:
        recursion.step()
        yield


def seconds_a_step(starts: dict[str, Callable[[], Iterator[None]]], repetitions: int) -> dict[str, float]:
    """Median time of a step of each; they take turns, a few steps each."""
    times: dict[str, list[float]] = {name: [] for name in starts}
    for _ in range(repetitions):
        for name, start in starts.items():
            steps = start()
            for step in range(STEPS):
                began = time.perf_counter()
                next(steps)
                if step > 1:  # the first steps also arrange things
                    times[name].append(time.perf_counter() - began)
    return {name: statistics.median(taken) for name, taken in times.items()}


def settled_seconds(system: System, network: Network) -> float:
    """Median time of a node's step when nothing changes any more."""
    steps, times = node_steps(system, network, network.ids[0]), []
    for _ in range(2 * SETTLED_STEPS):
        began = time.perf_counter()
        next(steps)
        times.append(time.perf_counter() - began)
    return statistics.median(times[SETTLED_STEPS:])


def compare(system: System, network: Network, repetitions: int) -> dict[str, float]:
    """Milliseconds a step, and ratios."""
    nodes = list(network.ids[:SAMPLE])
    seconds = seconds_a_step(
        {
            "node": lambda: node_steps(system, network, nodes[0]),
            "network": lambda: network_steps(system, network),
            "printed_nodes": lambda: printed_steps(system, network, nodes),
            "printed_shared": lambda: printed_shared_steps(system, network),
        },
        repetitions,
    )
    m = len(network.ids)
    printed_node = seconds["printed_nodes"] / len(nodes)
    return {
        "m": m,
        "node_ms": seconds["node"] * 1e3,
        "printed_node_ms": printed_node * 1e3,
        "node_ratio": printed_node / seconds["node"],
        "network_ms": seconds["network"] * 1e3,
        "network_us_per_node": seconds["network"] / m * 1e6,
        "printed_network_ms": printed_node * m * 1e3,
        "network_ratio": printed_node * m / seconds["network"],
        "printed_shared_ms": seconds["printed_shared"] * 1e3,
        "shared_ratio": seconds["printed_shared"] / seconds["network"],
        "settled_node_ms": settled_seconds(system, network) * 1e3,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=cast(str, __doc__).splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[16, 64, 256])
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    example = compare(paper.paper_system(), Network(paper.NEIGHBOURS, {}), options.repetitions)
    results = {"four_sensor": example}
    for m in options.sizes:
        network = Network.random_regular(range(m), DEGREE, seed=1)
        results[f"degree_{DEGREE}_m_{m}"] = compare(common_noise_system(m), network, options.repetitions)
    if options.json:
        print(json.dumps({name: {key: round(value, 4) for key, value in row.items()} for name, row in results.items()}))
        return
    print(f"{'':22}" + "".join(f"{name:>18}" for name in results))
    for key in example:
        print(f"{key:22}" + "".join(f"{row[key]:18.3f}" for row in results.values()))


if __name__ == "__main__":
    main()
