"""Rounds per second and latency of the live swarm beside the leanest raw-Zenoh exchange of the same messages.

    python benchmarks/rounds.py [--repeat N] [--steps N] [--json]

Everything in one run and in turn, so that all have the same machine: the four-sensor example free-running and paced at
100 Hz, with and without its recorder, on Zenoh's default and on its low-latency transport, and `floor.py` likewise. Of
each run the second half of the steps counts, when the covariances have settled; of the repetitions the median.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

import floor

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"

RATE_HZ = 100.0
PACED_STEPS = 1400
"""The example settles after some 600 steps."""

Found = dict[str, float]
"""rounds_per_s, p50_us, p99_us; cpu_us of a process for a round."""


def swarm(directory: Path, scenario: Path, steps: int, *words: str) -> Found:
    """One launch of the swarm."""
    command = [sys.executable, "-m", "zfusion", "launch", str(scenario), "--json", "--steps", str(steps), *words]
    done = subprocess.run(command, cwd=directory, capture_output=True, text=True, check=True, timeout=300)
    summary = json.loads(done.stdout)
    if summary["lost"]:
        raise RuntimeError(f"{summary['lost']} messages lost")
    settled = summary["settled"]
    return {
        "rounds_per_s": settled["rounds_per_s"],
        "p50_us": settled["latency_us"]["p50"],
        "p99_us": settled["latency_us"]["p99"],
        "cpu_us": settled["cpu_us"],
        "missed": summary["missed"],
    }


def cases(directory: Path, steps: int) -> dict[str, Callable[[], Found]]:
    """What is measured, by name; of each transport and pace the floor first."""
    low = directory / "lowlatency.toml"
    low.write_text(EXAMPLE.read_text() + '\n[transport]\npreset = "lowlatency"\n')
    record = ("--record", str(directory / "rounds.mcap"))
    found: dict[str, Callable[[], Found]] = {}
    for name, scenario, options in (("default", EXAMPLE, []), ("lowlatency", low, ["--lowlatency"])):
        for pace, words, count in (
            ("free", ("--free-run",), steps),
            ("100 Hz", ("--rate", str(RATE_HZ)), PACED_STEPS),
        ):
            rate = [] if pace == "free" else ["--rate", str(RATE_HZ)]
            floors = floor.parsed(["--rounds", str(count), *rate, *options])
            found[f"{name}, {pace}: floor"] = lambda floors=floors: floor.measure(floors)  # type: ignore[misc]
            found[f"{name}, {pace}: swarm"] = lambda s=scenario, c=count, w=words: swarm(  # type: ignore[misc]
                directory, s, c, *w, "--no-record"
            )
            found[f"{name}, {pace}: swarm, recorded"] = lambda s=scenario, c=count, w=words: swarm(  # type: ignore[misc]
                directory, s, c, *w, *record
            )
    return found


def measure(repeat: int, steps: int) -> dict[str, Found]:
    """Medians over the repetitions, with the ratios to the floor of the same transport and pace."""
    runs: dict[str, list[Found]] = {}
    with tempfile.TemporaryDirectory() as directory:
        for _ in range(repeat):
            for name, run in cases(Path(directory), steps).items():
                runs.setdefault(name, []).append(run())
    found = {
        name: {key: statistics.median(run[key] for run in of_case) for key in of_case[0]}
        for name, of_case in runs.items()
    }
    for name, numbers in found.items():
        least = found[name.split(":")[0] + ": floor"]
        numbers["rate_ratio"] = numbers["rounds_per_s"] / least["rounds_per_s"]
        numbers["cpu_ratio"] = numbers["cpu_us"] / least["cpu_us"]
        numbers["p50_ratio"] = numbers["p50_us"] / least["p50_us"]
    return found


def options_of(description: str | None) -> argparse.Namespace:
    """The options of a benchmark of live swarms."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def main() -> None:
    options = options_of(__doc__)
    before = os.getloadavg()[0]
    found = measure(options.repeat, options.steps)
    if options.json:
        sys.stdout.write(json.dumps({"cpus": os.cpu_count(), "load_before": before, "cases": found}) + "\n")
        return
    table = Table(title=f"{os.cpu_count()} CPUs, load before {before:.2f}, median of {options.repeat}")
    for name in ("case", "rounds/s", "of floor", "p50 µs", "of floor", "p99 µs", "CPU µs", "of floor", "missed"):
        table.add_column(name, justify="left" if name == "case" else "right")
    for name, numbers in found.items():
        cells = [f"{numbers[key]:.{digits}f}" for key, digits in COLUMNS]
        table.add_row(name, *cells, f"{numbers['missed']:.0f}" if "missed" in numbers else "")
    Console(width=110).print(table)


COLUMNS = (
    *(("rounds_per_s", 0), ("rate_ratio", 2), ("p50_us", 0), ("p50_ratio", 2), ("p99_us", 0)),
    *(("cpu_us", 0), ("cpu_ratio", 2)),
)


if __name__ == "__main__":
    main()
