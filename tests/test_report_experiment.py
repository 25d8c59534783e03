"""Reports of experiments: from the tables to figures, numbers and words, in one file that needs nothing else."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.artist import Artist
from typer.testing import CliRunner

from reports import Page, experiment, rmse_of
from simulations import EXAMPLE
from zfusion.cli import app
from zfusion.cli.common import steps_range
from zfusion.errors import InputError
from zfusion.report import extras
from zfusion.report.experiment_figures import (
    _against,
    against_axes,
    error_measure,
    errors_over_time,
    heat_maps,
    networks,
)
from zfusion.report.experiment_report import write_report
from zfusion.report.figures.style import Picture
from zfusion.report.results import Results

DELAY, LOSS, LATE = "links.delay", "links.loss", "timing.late"
AXES: dict[str, list[Any]] = {DELAY: [0.0, 0.01, 0.03], LOSS: [0.0, 0.2], LATE: ["drop", "revise"]}


def drawn(picture: Picture, gid: str) -> list[Any]:
    return [artist for artist in picture.figure.findobj(Artist) if artist.get_gid() == gid]


def errors_against(results: Results) -> dict[str, Picture]:
    measure = error_measure(results)
    assert measure is not None
    return {picture.name: picture for picture in against_axes(results, measure, 3)}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return Results(experiment(tmp_path_factory.mktemp("experiments") / "three", AXES))


# --- which figures there are, and what is in them --------------------------------------------------------------------


def test_errors_against_every_numeric_axis(results: Results) -> None:
    pictures = errors_against(results)
    assert set(pictures) == {"rmse-estimate-by-links_delay", "rmse-estimate-by-links_loss"}
    picture = pictures["rmse-estimate-by-links_delay"]
    assert len(drawn(picture, "measured")) == 4  # two policies in two panels, one for each loss
    expected = [
        [rmse_of({DELAY: delay, LOSS: loss, LATE: late}) for delay in AXES[DELAY]]
        for loss in AXES[LOSS]
        for late in AXES[LATE]
    ]
    assert np.allclose([line.get_ydata() for line in drawn(picture, "measured")], expected)
    assert np.allclose([line.get_ydata() for line in drawn(picture, "predicted")], 0.9 * np.array(expected))
    assert {float(line.get_ydata()[0]) for line in drawn(picture, "bound")} == {0.2, 5.0}
    assert "link delay" in picture.title
    for words in (
        "link delay [ms]",
        "root mean squared error [unit of the state]",
        ">late<",
        "loss = 0.2",
        "revise",
    ):
        assert words in picture.svg


def test_maps_of_pairs_of_numbers(results: Results) -> None:
    measure = error_measure(results)
    assert measure is not None
    [picture] = heat_maps(results, measure)
    assert picture.name == "rmse-estimate-map-links_delay-links_loss"
    assert len(drawn(picture, "value")) == 12
    image = picture.figure.axes[0].images[0].get_array()
    assert np.allclose(image, [[rmse_of({DELAY: d, LOSS: p, LATE: "drop"}) for d in AXES[DELAY]] for p in AXES[LOSS]])


def test_labels_that_are_numbers_make_a_map_and_others_are_left_out_of_it(tmp_path: Path) -> None:
    found = Results(experiment(tmp_path / "e", {DELAY: [0.0, 0.01], "timing.deadlines": ["0.2", "none", "0.1"]}))
    measure = error_measure(found)
    assert measure is not None
    [picture] = heat_maps(found, measure)
    labels = [{DELAY: d, "timing.deadlines": deadline} for deadline in ("0.1", "0.2") for d in (0.0, 0.01)]
    image = picture.figure.axes[0].images[0].get_array()
    assert np.allclose(image.ravel(), [rmse_of(of_point) for of_point in labels])
    assert "Conditions to which no number belongs are left out" in picture.reading


def test_errors_over_time_beside_the_prediction(results: Results) -> None:
    picture = errors_over_time(results)
    assert picture is not None
    assert len(drawn(picture, "measured")) == len(drawn(picture, "predicted")) == 12
    k = np.arange(1, 11)
    assert np.allclose(drawn(picture, "measured")[0].get_ydata(), k * rmse_of({DELAY: 0.0, LOSS: 0.0, LATE: "drop"}))
    assert np.allclose(drawn(picture, "predicted")[0].get_ydata(), 0.9 * k)


def test_the_network_is_shown_where_its_error_is_largest(results: Results) -> None:
    picture = networks(results)
    assert picture is not None
    [nodes] = drawn(picture, "nodes")
    assert len(nodes.get_offsets()) == 4
    worst = max(results.points, key=lambda p: rmse_of(p.labels))
    assert worst.words(results.axes) in picture.svg


def test_names_alone_make_a_figure_without_lines(tmp_path: Path) -> None:
    found = Results(experiment(tmp_path / "e", {"network": ["ring", "grid", "complete"]}))
    [picture] = errors_against(found).values()
    [line] = drawn(picture, "measured")
    assert line.get_linestyle() == "None"
    assert np.allclose(line.get_ydata(), [rmse_of({"network": n}) for n in ("ring", "grid", "complete")])
    measure = error_measure(found)
    assert measure is not None
    assert not [*heat_maps(found, measure)]


def test_one_condition_has_no_axes(tmp_path: Path) -> None:
    directory = experiment(tmp_path / "e", {DELAY: [0.01]}, seeds=1)
    assert not errors_against(Results(directory))
    page = Page(write_report(directory))
    page.check()
    assert "0.01" in page.words


def test_axes_that_go_together_are_one(tmp_path: Path) -> None:
    directory = experiment(tmp_path / "e", {DELAY: [0.0, 0.01], "timing.rate_hz": [10.0, 20.0]})
    facts = json.loads((directory / "experiment.json").read_text())
    facts["points"] = [p for p in facts["points"] if (p["labels"][DELAY] > 0) == (p["labels"]["timing.rate_hz"] > 10)]
    (directory / "experiment.json").write_text(json.dumps(facts))
    found = Results(directory)
    assert [axis.path for axis in found.axes] == [DELAY]
    assert found.follows == {"timing.rate_hz": (DELAY,)}
    [picture] = errors_against(found).values()
    assert [len(line.get_ydata()) for line in drawn(picture, "measured")] == [2]


def test_labels_stand_for_the_tables_that_they_name(tmp_path: Path) -> None:
    axes = {
        "label.kind": ["even", "bursts"],
        "label.rate": [0.0, 0.2],
        LOSS: ["0.0", "0.2", "bursts 0.0", "bursts 0.2"],
    }
    directory = experiment(tmp_path / "e", axes)
    facts = json.loads((directory / "experiment.json").read_text())
    wanted = {("even", 0.0): "0.0", ("even", 0.2): "0.2", ("bursts", 0.0): "bursts 0.0", ("bursts", 0.2): "bursts 0.2"}
    kept = [
        p for p in facts["points"] if wanted[p["labels"]["label.kind"], p["labels"]["label.rate"]] == p["labels"][LOSS]
    ]
    (directory / "experiment.json").write_text(json.dumps(facts | {"points": kept}))
    found = Results(directory)
    assert [axis.path for axis in found.axes] == ["label.kind", "label.rate"]
    assert found.follows == {LOSS: ("label.kind", "label.rate")}
    [picture] = errors_against(found).values()
    assert [len(line.get_ydata()) for line in drawn(picture, "measured")] == [2, 2]
    assert "against rate" in picture.title


def test_more_panels_than_fit_go_on_in_another_figure_and_what_is_left_out_is_told(tmp_path: Path) -> None:
    axes = {DELAY: [0.0, 0.01], LATE: ["a", "b"], "timing.window": [1, 2, 3, 4, 5], "steps": [30, 40, 50]}
    found = Results(experiment(tmp_path / "e", axes))
    measure = error_measure(found)
    assert measure is not None
    first, second = _against(found, measure, found.axes[0], 2)
    assert [len({line.axes for line in drawn(p, "measured")}) for p in (first, second)] == [12, 3]
    assert (first.title[-9:], second.title[-9:]) == (" (1 of 2)", " (2 of 2)")
    [only] = _against(found, measure, found.axes[0], 1)
    assert "3 more panels are not drawn" in only.reading


# --- the report -----------------------------------------------------------------------------------------------------


def test_the_report_is_one_file_that_needs_nothing_else(tmp_path: Path) -> None:
    axes = {DELAY: [0.0, 0.01], "network": ["<ring> & co", "grid"]}
    failed = [{"run": "abc", "point": "delay = <0>", "seed": 3, "error": "it <broke> & fell"}]
    directory = experiment(tmp_path / "e", axes, name="a <script>alert(1)</script>", failed=failed)
    page = Page(write_report(directory))
    page.check()
    for words in (
        "<ring> & co", "it <broke> & fell", "a <script>alert(1)</script>", 'scenario = "a <b> & c.toml"',
        "Failed runs: 1 of 20", "4 conditions, 5 seeds, 20 runs", "1 to 5 (5)", "zfusion 0.1.0", "SHA-256",
    ):  # fmt: skip
        assert words in page.words, words
    [rmse, *_] = page.rows(DELAY, "network", "rmse")
    expected = rmse_of({DELAY: 0.0, "network": "<ring> & co"})
    assert rmse[:2] == ["0", "<ring> & co"]
    assert rmse[2] == f"{expected:.3g} [{expected - 0.05:.3g}, {expected + 0.05:.3g}]"
    counts = next(row for row in page.cells if "lost" in row)
    assert page.cells[page.cells.index(counts) + 1][counts.index("lost")] == "7"  # both stages together
    names = {path.stem for path in (directory / "figures").iterdir()}
    assert all((directory / "figures" / f"{name}{end}").stat().st_size for name in names for end in (".svg", ".png"))
    assert names == {i for i in page.ids if f'<figure id="{i}"' in page.html}
    assert {"rmse-estimate-by-links_delay", "error-over-time", "nees-by-links_delay", "networks"} <= names


def test_the_same_tables_make_the_same_report(tmp_path: Path) -> None:
    directory = experiment(tmp_path / "e", {DELAY: [0.0, 0.01]}, metrics=("rmse",))
    first = write_report(directory).read_bytes()
    assert write_report(directory, tmp_path / "other.html").read_bytes() == first


def test_numbers_that_are_missing_do_not_stop_it(tmp_path: Path) -> None:
    """No truth, no scenario of a point, no series."""
    directory = experiment(tmp_path / "e", {DELAY: [0.0, 0.01]}, seeds=1, metrics=("nees", "messages"))
    (directory / "series_mean.parquet").unlink()
    (directory / "scenarios" / "0.toml").unlink()
    page = Page(write_report(directory))
    page.check()
    assert "the truth is not known" in page.words
    assert "One seed says nothing about the scatter" in page.words


# --- errors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["missing", "empty", "foreign", "not json", "no table", "broken table", "no column"])
def test_directories_that_are_no_experiments(tmp_path: Path, what: str) -> None:
    directory = tmp_path / "e"
    expected = {
        "missing": "there is no such directory", "empty": "there is no experiment.json", "no table": "cannot be read",
        "foreign": "has no axes", "not json": "cannot be read", "broken table": "cannot be read",
        "no column": "has no column",
    }[what]  # fmt: skip
    if what not in ("missing", "empty"):
        experiment(directory, {DELAY: [0.0, 0.01]})
    if what == "empty":
        directory.mkdir()
    elif what == "foreign":
        (directory / "experiment.json").write_text('{"name": "x"}')
    elif what == "not json":
        (directory / "experiment.json").write_text("{")
    elif what == "no table":
        (directory / "summary.parquet").unlink()
    elif what == "broken table":
        (directory / "summary.parquet").write_bytes(b"PAR1 nothing of the kind PAR1")
    elif what == "no column":
        (directory / "summary.parquet").write_bytes((directory / "series_mean.parquet").read_bytes())
    with pytest.raises(InputError, match=expected) as error:
        write_report(directory)
    assert "\n" not in str(error.value)
    assert str(directory) in str(error.value)


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    extras.check_extras()
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "jinja2" else object())
    with pytest.raises(InputError, match=r"reports need jinja2: pip install 'zfusion\[experiments\]'") as error:
        extras.check_extras()
    assert error.value.exit_code == 2


def test_the_command_line_does_not_import_what_only_reports_need() -> None:
    import subprocess

    code = "import sys, zfusion.cli; sys.exit(any(m in sys.modules for m in ('matplotlib', 'jinja2', 'pyarrow')))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


# --- the command, and a real experiment -----------------------------------------------------------------------------


def test_a_real_experiment_has_a_report(tmp_path: Path) -> None:
    from zfusion.studies.experiment.engines import engine_of
    from zfusion.studies.experiment.plan import plan
    from zfusion.studies.experiment.run import run_experiment
    from zfusion.studies.experiment.spec import load_experiment

    file = tmp_path / "real.toml"
    file.write_text(
        f'[experiment]\nscenario = "{EXAMPLE}"\nseeds = [1, 2]\nmetrics = ["mse", "rmse", "predicted_mse", '
        '"bound_centralized", "lost"]\n[experiment.set]\nsteps = 12\n[axes]\n"links.loss" = [0.0, 0.3]\n'
    )
    directory = tmp_path / "out"
    outcome = run_experiment(plan(load_experiment(file)), directory, engine_of("simulated", 1, None, None))
    assert not outcome.failed
    result = CliRunner().invoke(app, ["report", str(directory), "-o", str(tmp_path / "r.html"), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told == {"report": str(tmp_path / "r.html"), "figures": str(directory / "figures")}
    page = Page(tmp_path / "r.html")
    page.check()
    found = Results(directory)
    [picture] = errors_against(found).values()
    values = found.values("rmse")
    assert np.allclose(drawn(picture, "measured")[0].get_ydata(), [values[0].mean, values[1].mean])
    assert len(page.rows("links.loss", "rmse")) == 2


def test_steps_are_for_recordings(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["report", str(tmp_path), "--steps", "1:2"])
    assert result.exit_code == 2


@pytest.mark.parametrize("text", ["", "5:3", "0:3", "a", "1:2:3", "-1:3", "1.5"])
def test_steps_that_are_none(text: str) -> None:
    with pytest.raises(InputError, match="--steps"):
        steps_range(text)


def test_the_examples_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    docs = Path(__file__).parents[1] / "docs" / "reports.md"
    first, second = re.findall(r"```python\n(.*?)```", docs.read_text(), re.DOTALL)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "run.mcap").write_bytes((docs.parents[1] / "recordings" / "sample.mcap").read_bytes())
    experiment(tmp_path / "out", {DELAY: [0.0, 0.01]}, metrics=("rmse",))
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(first.replace("range(100, 113)", "range(10, 13)"), names)
    exec(second, names)
    assert {"run.html", "out", "figures"} <= {path.name for path in tmp_path.iterdir()}
    assert (tmp_path / "figures" / "grid.svg").exists()
