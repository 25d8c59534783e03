"""How long a sweep takes, and what a run's time goes into.

    python benchmarks/experiment.py [--runs N] [--steps N] [--jobs N] [--loss P] [--json]

The sweep: the four-sensor example under loss and delay, as `zfusion experiment` runs it. The profile: one run with a
clock around each of its parts, by the seams that the simulation has.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # as the command does, and before numpy is imported

from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from zfusion.drivers.simulated import Simulation  # noqa: E402
from zfusion.drivers.sources import open_sources  # noqa: E402
from zfusion.links import links_of  # noqa: E402
from zfusion.methods import METHODS  # noqa: E402
from zfusion.model.scenario import load_scenario  # noqa: E402
from zfusion.studies.experiment.engines import engine_of  # noqa: E402
from zfusion.studies.experiment.metrics import metrics  # noqa: E402
from zfusion.studies.experiment.observed import Observer  # noqa: E402
from zfusion.studies.experiment.plan import plan  # noqa: E402
from zfusion.studies.experiment.run import run_experiment  # noqa: E402
from zfusion.studies.experiment.spec import load_experiment  # noqa: E402

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"

EXPERIMENT = """
[experiment]
name = "benchmark"
scenario = "{scenario}"
seeds = {{ first = 1, count = {seeds} }}
burn_in = 20
[experiment.set]
steps = {steps}
"links.delay" = 0.005
[axes]
"links.loss" = [0.0, {loss}]
"""


def sweep(directory: Path, runs: int, steps: int, loss: float, jobs: int) -> dict[str, float]:
    """One sweep, half of it without loss."""
    file = directory / "benchmark.toml"
    file.write_text(EXPERIMENT.format(scenario=EXAMPLE, seeds=runs // 2, steps=steps, loss=loss))
    began = time.perf_counter()
    outcome = run_experiment(plan(load_experiment(file)), directory / "out", engine_of("simulated", jobs))
    elapsed_s = time.perf_counter() - began
    if outcome.failed or outcome.done != outcome.runs:
        raise RuntimeError(f"{outcome.failed}")
    return {"runs": outcome.runs, "elapsed_s": elapsed_s, "runs_per_s": outcome.runs / elapsed_s}


class Clock:
    """Seconds by part; what a part calls of another one's counts there."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._open: list[float] = []

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time counted for a part."""

        def call(*arguments: Any, **words: Any) -> Any:
            self._open.append(0.0)
            began = time.perf_counter()
            try:
                return function(*arguments, **words)
            finally:
                elapsed = time.perf_counter() - began
                self.seconds[part] += elapsed - self._open.pop()
                if self._open:
                    self._open[-1] += elapsed

        return call


def profile(steps: int, loss: float) -> dict[str, float]:
    """Seconds of one run, by part."""
    clock = Clock()
    scenario = load_scenario(EXAMPLE, steps=steps, loss=loss)

    class Timed(METHODS[scenario.method.name]):  # type: ignore[misc]
        begin = clock.timed("mathematics", METHODS[scenario.method.name].begin)
        advance = clock.timed("mathematics", METHODS[scenario.method.name].advance)

    class Read:
        def __init__(self, source: Any) -> None:
            self.read = clock.timed("drawing measurements", source.read)
            self.truth = clock.timed("drawing measurements", source.truth)
            self.close, self.counters = source.close, source.counters

    def whole() -> None:
        observer = Observer(scenario)
        simulation = Simulation(
            scenario,
            link=clock.timed("links", links_of(scenario)),
            sources={i: Read(source) for i, source in open_sources(scenario, scenario.ids).items()},
            method=Timed,
            observe=clock.timed("metrics", observer),
        )
        simulation.run()
        clock.timed("metrics", metrics)(observer, simulation.reports, 20)

    clock.timed("nodes, event queue and accounts", whole)()
    return dict(clock.seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--loss", type=float, default=0.2)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    before = os.getloadavg()[0]
    profiles = {f"loss {loss:g}": profile(options.steps, loss) for loss in (0.0, options.loss)}
    with tempfile.TemporaryDirectory() as directory:
        found = sweep(Path(directory), options.runs, options.steps, options.loss, options.jobs)
    if options.json:
        told = {"cpus": os.cpu_count(), "load_before": before, "sweep": found, "profile_s": profiles}
        sys.stdout.write(json.dumps(told) + "\n")
        return
    console = Console(width=100)
    console.print(
        f"{found['runs']} runs of {options.steps} steps in {found['elapsed_s']:.0f} s, {options.jobs} at a time; "
        f"{os.cpu_count()} CPUs, load before {before:.2f}"
    )
    table = Table(title="one run, seconds and share")
    for heading in ("part", *profiles):
        table.add_column(heading, justify="left" if heading == "part" else "right")
    for part in next(iter(profiles.values())):
        cells = [f"{of[part]:.2f}  {of[part] / sum(of.values()):4.0%}" for of in profiles.values()]
        table.add_row(part, *cells)
    console.print(table)


if __name__ == "__main__":
    main()
