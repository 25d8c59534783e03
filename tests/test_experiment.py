"""Running experiments: in parallel, interrupted, on full disks, again: always the same tables."""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from test_experiment_spec import HEAD, planned
from zfusion.errors import InputError, RunError
from zfusion.studies.experiment.engines import engine_of, in_processes, on_dask, one_by_one
from zfusion.studies.experiment.execute import execute
from zfusion.studies.experiment.plan import THEORY, Plan, Task
from zfusion.studies.experiment.run import run_experiment
from zfusion.studies.experiment.store import Store

SWEEP = HEAD + 'burn_in = 2\n[axes]\n"links.loss" = [0.0, 0.3]\nmethod = ["two_stage", "local"]\n'

SAME = ("results", "summary", "series", "series_mean")


@pytest.fixture
def sweep(tmp_path: Path) -> Plan:
    return planned(tmp_path, SWEEP)


def contents(directory: Path) -> dict[str, bytes]:
    return {f"{name}.{end}": (directory / f"{name}.{end}").read_bytes() for name in SAME for end in ("csv", "parquet")}


def rows(directory: Path, table: str = "results") -> list[dict[str, str]]:
    with (directory / f"{table}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_tables_are_the_same_in_parallel_twice_and_in_pieces(sweep: Plan, tmp_path: Path) -> None:
    first = run_experiment(sweep, tmp_path / "serial", one_by_one)
    assert (first.runs, first.done, first.reused, first.failed) == (8, 8, 0, [])
    wanted = contents(tmp_path / "serial")
    run_experiment(sweep, tmp_path / "parallel", engine_of("simulated", 2))
    assert contents(tmp_path / "parallel") == wanted

    def stopped(tasks: list[Task]) -> Iterator[tuple[Task, dict[str, object]]]:
        for number, task in enumerate(tasks):
            if number == 4:
                raise KeyboardInterrupt
            yield task, execute(task)

    broken = run_experiment(sweep, tmp_path / "pieces", stopped)  # type: ignore[arg-type]
    assert broken.interrupted
    assert broken.tables == []
    resumed = run_experiment(sweep, tmp_path / "pieces", one_by_one)
    assert resumed.reused == broken.done > 0
    assert resumed.reused + resumed.done == 8
    assert contents(tmp_path / "pieces") == wanted


def test_what_is_done_is_not_done_again_and_what_is_new_is(sweep: Plan, tmp_path: Path) -> None:
    run_experiment(sweep, tmp_path / "out", one_by_one)

    def refuse(tasks: list[Task]) -> Iterator[tuple[Task, dict[str, object]]]:
        pytest.fail(f"{len(tasks)} tasks again")
        yield

    again = run_experiment(sweep, tmp_path / "out", refuse)  # type: ignore[arg-type]
    assert (again.done, again.reused) == (0, 8)
    more = planned(tmp_path, SWEEP.replace("[0.0, 0.3]", "[0.3, 0.6]"))
    outcome = run_experiment(more, tmp_path / "out", one_by_one)
    assert (outcome.done, outcome.reused) == (4, 4)
    assert {row["links.loss"] for row in rows(tmp_path / "out")} == {"0.3", "0.6"}


def test_a_damaged_file_is_made_again(sweep: Plan, tmp_path: Path) -> None:
    run_experiment(sweep, tmp_path / "out", one_by_one)
    wanted = contents(tmp_path / "out")
    broken = sorted((tmp_path / "out" / "runs").glob("*.json"))[:2]
    broken[0].write_bytes(broken[0].read_bytes()[:100])
    broken[1].write_text(json.dumps({"hash": "another", "rows": []}))
    outcome = run_experiment(sweep, tmp_path / "out", one_by_one)
    assert outcome.reused < 8
    assert contents(tmp_path / "out") == wanted


def test_a_run_that_fails_does_not_sink_the_others_and_is_tried_again(tmp_path: Path) -> None:
    unstable = planned(tmp_path, HEAD + '[axes]\n"system.F" = [0.9, 1e300]\n')
    outcome = run_experiment(unstable, tmp_path / "out", one_by_one)
    assert outcome.done == 2
    failed = [failure for failure in outcome.failed if failure["seed"] is not None]
    assert [failure["seed"] for failure in failed] == [1, 2]
    assert all(failure["point"] == "system.F = 1e+300" and failure["error"] for failure in failed)
    assert {row["system.F"] for row in rows(tmp_path / "out")} == {"0.9"}
    record = json.loads((tmp_path / "out" / "runs" / f"{failed[0]['run']}.failed.json").read_text())
    assert record["error"] == failed[0]["error"]
    assert run_experiment(unstable, tmp_path / "out", one_by_one).failed == outcome.failed


def test_an_error_that_nobody_thought_of_is_told_with_its_traceback(sweep: Plan) -> None:
    task = replace(sweep.points[0].seeds[0], seed="one")  # type: ignore[arg-type]
    result = execute(task)
    assert result["error"]
    assert "rows" not in result


def test_a_process_that_dies_takes_nothing_with_it(sweep: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """The task whose process dies fails; one that was under way at the same time is done."""
    victim, other = sweep.points[1].seeds
    monkeypatch.setenv("ZFUSION_TEST_VICTIM", victim.hash)
    monkeypatch.setattr("zfusion.studies.experiment.engines.execute", die_or_execute)
    results = {task.hash: result for task, result in in_processes([victim, other], 2)}
    assert set(results) == {victim.hash, other.hash}
    assert "its process died" in results[victim.hash]["error"]
    assert "rows" in results[other.hash]


def die_or_execute(task: Task) -> dict[str, object]:
    if task.hash == os.environ["ZFUSION_TEST_VICTIM"]:
        os.kill(os.getpid(), signal.SIGKILL)
    return {"rows": [], "curves": [], "timings": []}


def test_a_full_disk_is_told_and_nothing_done_is_lost(
    sweep: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, saved = Store.save, []

    def full(self: Store, task: Task, result: dict[str, object]) -> None:
        if len(saved) == 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        saved.append(task)
        save(self, task, result)

    monkeypatch.setattr(Store, "save", full)
    with pytest.raises(RunError, match=r"No space left on device; 4 of 8 runs are kept, and the same command"):
        run_experiment(sweep, tmp_path / "out", one_by_one)
    monkeypatch.undo()
    outcome = run_experiment(sweep, tmp_path / "out", one_by_one)
    assert outcome.reused == 4 == sum(task.world != THEORY for task in saved)
    run_experiment(sweep, tmp_path / "other", one_by_one)
    assert contents(tmp_path / "out") == contents(tmp_path / "other")


def test_a_file_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, path = Store(tmp_path), tmp_path / "file"
    store.write(path, b"before")

    def half(self: Path, content: bytes) -> int:
        with self.open("wb") as file:
            file.write(content[:2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OSError, match="No space"):
        store.write(path, b"after")
    assert path.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_one_experiment_at_a_time_writes_to_a_directory(sweep: Plan, tmp_path: Path) -> None:
    store = Store(tmp_path / "out")
    with store.opened(), pytest.raises(InputError, match="another experiment is writing there"):
        run_experiment(sweep, tmp_path / "out", one_by_one)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        run_experiment(sweep, tmp_path / "file", one_by_one)


def test_the_tables_hold_what_they_say(sweep: Plan, tmp_path: Path) -> None:
    run_experiment(sweep, tmp_path, one_by_one)
    results, summary = rows(tmp_path), rows(tmp_path, "summary")
    assert list(results[0]) == [
        *("run", "links.loss", "method", "seed"),
        *("node", "sender", "stage", "metric", "value", "low", "high"),
    ]
    place = {"links.loss": "0.3", "method": "two_stage", "node": "all", "stage": "estimate", "metric": "mse"}
    values = [float(r["value"]) for r in results if all(r[key] == value for key, value in place.items())]
    [mean] = [r for r in summary if all(r[key] == value for key, value in place.items())]
    assert float(mean["mean"]) == pytest.approx(sum(values) / 2)
    assert float(mean["high"]) - float(mean["mean"]) == pytest.approx(
        12.7062 * abs(values[0] - values[1]) / 2, rel=1e-4
    )
    assert mean["n"] == "2"
    [root] = [r for r in summary if all(r[k] == v for k, v in {**place, "metric": "rmse"}.items())]
    assert float(root["mean"]) ** 2 == pytest.approx(float(mean["mean"]))
    bounds = {r["links.loss"]: r for r in summary if r["metric"] == "bound_centralized" and r["method"] == "local"}
    assert bounds["0.0"]["mean"] == bounds["0.3"]["mean"]
    assert bounds["0.0"]["n"] == bounds["0.0"]["low"] == ""
    table = pq.read_table(tmp_path / "results.parquet")
    assert table.column_names == list(results[0])
    assert table["links.loss"].to_pylist() == [float(r["links.loss"]) for r in results]
    assert table["value"].to_pylist() == [float(r["value"]) for r in results]
    assert table["seed"].to_pylist() == [int(r["seed"]) if r["seed"] else None for r in results]
    series = pq.read_table(tmp_path / "series.parquet").to_pylist()
    mses = [s["error_sq"] for s in series if s["run"] == results[-1]["run"] and s["node"] == "all" and s["step"] > 2]
    told = [r for r in results if r["run"] == results[-1]["run"] and (r["node"], r["metric"]) == ("all", "mse")]
    assert sum(mses) / len(mses) == pytest.approx(float(told[0]["value"]))
    facts = json.loads((tmp_path / "experiment.json").read_text())
    assert facts["axes"][1] == {"path": "method", "labels": ["two_stage", "local"]}
    assert (tmp_path / facts["points"][3]["scenario"]).read_text().count("local") == 1


def test_only_the_metrics_that_are_asked_for(tmp_path: Path) -> None:
    made = planned(tmp_path, HEAD + 'metrics = ["rmse", "nees", "nees_band"]\nseries = 1\n')
    run_experiment(made, tmp_path / "out", one_by_one)
    assert {row["metric"] for row in rows(tmp_path / "out")} == {"rmse", "nees"}
    assert {row["metric"] for row in rows(tmp_path / "out", "summary")} == {"rmse", "nees", "nees_band"}
    assert rows(tmp_path / "out", "timings") == []
    assert {row["seed"] for row in rows(tmp_path / "out", "series")} == {"1"}
    assert {row["n"] for row in rows(tmp_path / "out", "series_mean")} == {"2"}


def test_live_runs_take_place_here_and_one_at_a_time() -> None:
    with pytest.raises(InputError, match="--dask"):
        engine_of("live", 2, "local")
    assert engine_of("live", 2).func is one_by_one  # type: ignore[attr-defined]


def test_no_scheduler_is_an_error_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zfusion.studies.experiment.engines.DASK_CONNECT_S", "300ms")
    with pytest.raises(InputError, match="no scheduler that answers"):
        next(on_dask([], "tcp://127.0.0.1:9", 1))


COMMAND = (sys.executable, "-m", "zfusion", "experiment")


def command(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *words], cwd=directory, capture_output=True, text=True, timeout=120, check=False)


def test_the_command_tells_how_it_went(tmp_path: Path) -> None:
    planned(tmp_path, SWEEP)
    done = command(tmp_path, "file.toml", "-o", "out", "--jobs", "1", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert (told["runs"], told["done"], told["failed"], told["interrupted"]) == (8, 8, [], False)
    assert set(told["tables"]) >= {"results.parquet", "summary.csv"}
    assert told["headlines"][0]["labels"] == {"links.loss": 0.0, "method": "two_stage"}
    again = command(tmp_path, "file.toml", "-o", "out")
    assert again.returncode == 0
    assert "8 runs of 4 points: 0 done" in again.stdout
    wrong = command(tmp_path, "none.toml")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "Traceback" not in wrong.stderr


def test_ctrl_c_keeps_what_is_done(tmp_path: Path) -> None:
    planned(tmp_path, SWEEP.replace("[1, 2]", "{ count = 100 }"))
    words = [*COMMAND, "file.toml", "-o", "out", "--jobs", "2", "--json"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        runs = tmp_path / "out" / "runs"
        while len(list(runs.glob("*.json"))) < 4:
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.05)
                break
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 1, stderr
    assert "Traceback" not in stderr
    told = json.loads(stdout)
    assert told["interrupted"]
    assert 0 < told["done"] < 400
    made = planned(tmp_path, SWEEP.replace("[1, 2]", "{ count = 100 }"))
    assert sum(of in Store(tmp_path / "out").finished(made.tasks) for of in made.tasks) >= told["done"]
