"""Running an experiment: what is not done yet is done, and kept as it comes; then the tables."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from zfusion.errors import RunError
from zfusion.recording.provenance import machine, software
from zfusion.studies.experiment.catalogue import METRICS_VERSION
from zfusion.studies.experiment.engines import Engine
from zfusion.studies.experiment.plan import THEORY, Plan, Task
from zfusion.studies.experiment.store import Store
from zfusion.studies.experiment.table import write_tables

FACTS = "experiment.json"
"""The file that says what an experiment's directory holds."""


class Progress(Protocol):
    """Is told how it goes."""

    def begin(self, total: int, done: int) -> None:
        """So many runs there are, of which so many are done already."""

    def advance(self, failed: bool) -> None:
        """One more is done."""


@dataclass(slots=True)
class Outcome:
    """How an experiment went."""

    name: str
    directory: str
    points: int
    runs: int
    """Runs that the plan has, predictions not counted."""
    reused: int
    """Of them, those that were done before."""
    done: int = 0
    """Those that were done now."""
    failed: list[dict[str, Any]] = field(default_factory=list)
    """Tasks that failed: run (hash), point, seed, error."""
    interrupted: bool = False
    elapsed_s: float = 0.0
    tables: list[str] = field(default_factory=list)
    """Files, relative to the directory; none where it was interrupted."""
    headlines: list[dict[str, Any]] = field(default_factory=list)
    """See `Written`."""


class _Silent:
    """Tells nobody."""

    def begin(self, total: int, done: int) -> None:
        pass

    def advance(self, failed: bool) -> None:
        pass


def run_experiment(plan: Plan, directory: Path, engine: Engine, progress: Progress | None = None) -> Outcome:
    """Do what of the plan is not done in `directory`, and write the tables there.

    A run that fails is told in the outcome and tried again the next time. KeyboardInterrupt ends it early: what was
    done is kept. InputError where the directory cannot be written, RunError where that ends in the middle.
    """
    store, began = Store(directory), time.monotonic()
    with store.opened():
        tasks = plan.tasks
        finished = store.finished(tasks)
        runs = [task for task in tasks.values() if task.world != THEORY]
        outcome = Outcome(
            plan.experiment.name,
            str(directory),
            len(plan.points),
            len(runs),
            reused=sum(task.hash in finished for task in runs),
        )
        left = [task for of, task in tasks.items() if of not in finished]
        progress = progress or _Silent()
        progress.begin(len(tasks), len(finished))
        try:
            store.write(directory / "experiment.toml", plan.experiment.text.encode())
            _do(plan, left, store, engine, progress, outcome)
            if not outcome.interrupted:
                written = write_tables(plan, store)
                outcome.tables, outcome.headlines = list(written.files), list(written.headlines)
                store.write(directory / FACTS, json.dumps(_facts(plan, outcome), indent=1).encode())
        except OSError as error:
            kept = outcome.reused + outcome.done
            raise RunError(
                f"{directory}: cannot be written: {error.strerror}; {kept} of {outcome.runs} runs are kept, "
                "and the same command goes on from there"
            ) from None
    outcome.elapsed_s = round(time.monotonic() - began, 3)
    return outcome


def _do(plan: Plan, left: list[Task], store: Store, engine: Engine, progress: Progress, outcome: Outcome) -> None:
    if not left:
        return
    points = {task.hash: point for point in reversed(plan.points) for task in (*point.seeds, point.theory)}
    try:
        with closing(engine(left)) as results:
            for task, result in results:
                store.save(task, result)
                failed = "error" in result
                if failed:
                    told = {"run": task.hash, "point": points[task.hash].text, "error": result["error"]}
                    outcome.failed.append({**told, "seed": None if task.world == THEORY else task.seed})
                outcome.done += not failed and task.world != THEORY
                progress.advance(failed)
    except KeyboardInterrupt:
        outcome.interrupted = True


def _facts(plan: Plan, outcome: Outcome) -> Mapping[str, Any]:
    """What the directory holds, for whoever reads it: name, axes and their labels, points with their graphs, ..."""
    experiment, spec = plan.experiment, plan.experiment.spec
    axes = [
        {"path": path, "labels": list(dict.fromkeys(point.labels[path] for point in plan.points))} for path in plan.axes
    ]
    return {
        "name": experiment.name,
        "description": spec.description,
        "small": experiment.small,
        "world": spec.world,
        "metrics_version": METRICS_VERSION,
        "axes": axes,
        "seeds": list(spec.seeds),
        "burn_in": spec.burn_in,
        "confidence": spec.confidence,
        "points": [
            {
                "point": point.number,
                "labels": dict(point.labels),
                "scenario": f"scenarios/{point.number}.toml",
                "method": point.scenario.method.name,
                "steps": point.scenario.steps,
                "nodes": [str(i) for i in point.scenario.ids],
                "theory": point.theory.hash,
                "runs": [task.hash for task in point.seeds],
            }
            for point in plan.points
        ],
        "runs": outcome.runs,
        "failed": outcome.failed,
        "made_on": {**software(), **machine()},
    }
