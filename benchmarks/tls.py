"""What TLS and access control cost: rounds per second of the same deployed swarm with and without them.

    python benchmarks/tls.py [--repeat N] [--steps N] [--json]

The four-sensor example, free-running without a recorder, from folders as `zfusion deploy` writes them, all hosts being
this machine; secured and plain runs in turn, so that both have the same machine. Of each run the second half of the
steps counts, of the repetitions the median.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import tomli_w
from rich.console import Console
from rich.table import Table

from rounds import options_of
from zfusion.deploy.folders import write
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.plan import Plan
from zfusion.model.scenario import load_scenario
from zfusion.swarm.child import ONE_THREAD
from zfusion.swarm.ports import free_endpoints

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"

Found = dict[str, float]
"""rounds_per_s; cpu_us of a process for a round."""


def prepared(directory: Path, steps: int, *, secured: bool) -> Plan:
    """The plan of a swarm whose folders are in `directory`."""
    directory.mkdir()
    scenario = load_scenario(EXAMPLE, free_run=True, steps=steps)
    ports = [int(endpoint.rpartition(":")[2]) for endpoint in free_endpoints(len(scenario.ids))]
    hosts = {
        f"host{i}": {"address": "127.0.0.1", "nodes": [i], "port": p} for i, p in zip(scenario.ids, ports, strict=True)
    }
    document = {"run": f"tls-{os.getpid()}", "hosts": hosts, "security": {"enabled": secured}}
    path = directory / "hosts.toml"
    path.write_text(tomli_w.dumps(document))
    plan = Plan(scenario, HostsFile.load(path, scenario), str(document["run"]))
    write(plan, directory / "out")
    return plan


def run(plan: Plan, out: Path) -> Found:
    """One run of the swarm."""
    environment = {**os.environ, **ONE_THREAD}
    nodes = [
        subprocess.Popen(
            [sys.executable, "-m", *plan.command(process), "--json"],
            cwd=out / process.host,
            stdout=subprocess.PIPE,
            env=environment,
        )
        for process in plan.processes
    ]
    reports = [json.loads(node.communicate(timeout=600)[0]) for node in nodes]
    settled = [report["settled"] for report in reports]
    return {
        "rounds_per_s": statistics.mean(pace["completed"] / pace["elapsed_s"] for pace in settled),
        "cpu_us": statistics.mean(1e6 * pace["cpu_s"] / pace["completed"] for pace in settled),
    }


def measure(repeat: int, steps: int) -> dict[str, Found]:
    """Medians over the repetitions."""
    runs: dict[str, list[Found]] = {"plain": [], "TLS": []}
    with tempfile.TemporaryDirectory() as directory:
        plans = {name: prepared(Path(directory, name), steps, secured=name == "TLS") for name in runs}
        for _ in range(repeat):
            for name, plan in plans.items():
                runs[name].append(run(plan, Path(directory, name, "out")))
    return {name: {key: statistics.median(one[key] for one in of) for key in of[0]} for name, of in runs.items()}


def main() -> None:
    options = options_of(__doc__)
    load = os.getloadavg()[0]
    found = measure(options.repeat, options.steps)
    if options.json:
        sys.stdout.write(json.dumps({"cpus": os.cpu_count(), "load_before": load, "cases": found}) + "\n")
        return
    table = Table(
        "links", "rounds/s", "CPU µs a node and round", title=f"{os.cpu_count()} CPUs, load before {load:.2f}"
    )
    for name, numbers in found.items():
        table.add_row(name, *(f"{number:.0f}" for number in numbers.values()))
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
