"""`zfusion design` for every kind of method, the designs that runs share, and the notes of a run's summary."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner, Result

from swarms import launch, run_name, wait_until
from zfusion.cli import app, progress
from zfusion.drivers import designs
from zfusion.drivers.designs import design_of, make, with_design
from zfusion.drivers.simulated import simulate
from zfusion.errors import InputError
from zfusion.methods import stationary
from zfusion.methods.consensus.forecast import forecast_of, observed_of
from zfusion.methods.consensus.mixing import Mixing, Spectrum
from zfusion.methods.consensus.prediction import alone, error_covariances
from zfusion.methods.design_files import DesignFileError
from zfusion.methods.l2_linf.verify import node_errors
from zfusion.model.scenario import Scenario, load_scenario

EXAMPLES = Path(__file__).parents[1] / "examples"
FIELD = EXAMPLES / "shootout_field.toml"

pytest.importorskip("cvxpy")


def design(*arguments: str) -> Result:
    """The command in this process."""
    return CliRunner().invoke(app, ["design", *arguments])


def told(*arguments: str) -> dict[str, Any]:
    result = design(*arguments, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert isinstance(found, dict)
    return found


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("design") / "design.npz"
    assert design(str(FIELD), "--method", "stationary", "-o", str(path)).exit_code == 0
    return path


def named(method: str, **document: Any) -> Scenario:
    """Four sensors of one level that wanders and is drawn back, on a ring."""
    base: dict[str, Any] = {
        "name": "level",
        "steps": 8,
        "method": method,
        "network": {"generator": "ring"},
        "system": {"F": 0.9, "Q": 0.2, "initial_covariance": 1.0},
        "sensors": [{"id": i, "H": 1.0, "R": 0.5 * i} for i in (1, 2, 3, 4)],
    }
    return Scenario.model_validate(base | document)


def written(directory: Path, scenario: Scenario) -> str:
    path = directory / "scenario.toml"
    path.write_text(scenario.to_toml())
    return str(path)


def test_a_stationary_design_is_told_and_saved(file: Path) -> None:
    found = told(str(FIELD), "--method", "stationary")
    network, nodes = found["network"], found["nodes"]
    assert [row["node"] for row in nodes] == [1, 2, 3, 4, 5, 6]
    assert network["true_cost"] == pytest.approx(sum(row["mse"] for row in nodes))
    assert network["information_limit_sum"] < network["true_cost"] <= network["bound"]
    assert network["bound"] <= network["neighbourhood_sum"] < network["own_sensor_sum"]
    assert network["solver"].startswith("CLARABEL")
    assert found["seconds"] > 0
    assert found["file"] is None
    kept = stationary.Design.load(file)
    assert kept.forecast.network["true_cost"] == pytest.approx(network["true_cost"])
    shown = design(str(FIELD), "--method", "stationary").output
    assert "information limit" in shown
    assert "designed in" in shown


def test_an_l2_linf_design_is_told() -> None:
    found = told(str(FIELD), "--method", "l2_linf")
    network = found["network"]
    assert network["gamma_reached"] <= network["gamma_certified"] * (1 + 1e-6) <= network["gamma"] * (1 + 2e-4)
    assert network["radius"] < 1
    assert all(row["mse"] > 0.25 for row in found["nodes"])


def test_errors_by_node_of_l2_linf_are_those_of_long_runs() -> None:
    """Against the recursion of the covariances, which the filters report as P."""
    scenario = load_scenario(FIELD, method="l2_linf", steps=300)
    made = design_of(scenario)
    last = {i: lives[-1] for i, lives in simulate(scenario, run="long").items()}
    reported = [sum(sd**2 for sd in last[i].estimate["sd"]) for i in scenario.ids]
    np.testing.assert_allclose(node_errors(made.problem, made.gains), reported, rtol=1e-6)


def test_consensus_is_foretold_beside_being_alone(tmp_path: Path) -> None:
    scenario = named("consensus")
    found = told(written(tmp_path, scenario), "--method", "consensus")
    a = np.eye(4, k=1) + np.eye(4, k=-1) + np.eye(4, k=3) + np.eye(4, k=-3)
    mixing = Mixing(Spectrum.of(a), int(found["network"]["rounds"]), found["network"]["step_size"])
    observed = observed_of(scenario.system())
    np.testing.assert_allclose([row["mse"] for row in found["nodes"]], error_covariances(observed, mixing)[:, 0, 0])
    np.testing.assert_allclose([row["alone"] for row in found["nodes"]], alone(observed)[:, 0, 0])
    best = observed.centralised[1][0, 0]
    assert [row["loss"] for row in found["nodes"]] == pytest.approx([row["mse"] / best - 1 for row in found["nodes"]])
    assert not any("does not help" in remark for remark in found["remarks"])


def test_it_says_for_whom_the_network_is_of_no_help() -> None:
    """One exchange with a tiny step: the sensor that is a hundred times better than the others loses by sharing."""
    sensors = [{"id": i, "H": 1.0, "R": 0.01 if i == 1 else 1.0} for i in (1, 2, 3, 4)]
    system = named("consensus", sensors=sensors).system()
    a = np.eye(4, k=1) + np.eye(4, k=-1) + np.eye(4, k=3) + np.eye(4, k=-3)
    forecast = forecast_of(system, Mixing(Spectrum.of(a), 1, 0.01))
    worse = [
        str(i) for i, mse, single in zip((1, 2, 3, 4), forecast.nodes["mse"], forecast.nodes["alone"], strict=True)
        if mse >= single
    ]  # fmt: skip
    assert "1" in worse
    [remark] = [remark for remark in forecast.remarks if "does not help" in remark]
    assert all(i in remark for i in worse) or "any node" in remark


@pytest.mark.parametrize(
    ("method", "why"),
    [("diffusion", "nothing tells the errors of diffusion"), ("consensus", "only known where all sensors measure")],
)
def test_methods_without_a_prediction_say_so(method: str, why: str) -> None:
    found = told(str(FIELD), "--method", method, "--steps", "40")
    assert why in found["remarks"][0]
    assert found["network"]["centralized_mse"] < min(row["alone"] for row in found["nodes"])
    assert all(set(row) == {"node", "alone"} for row in found["nodes"])


def test_only_what_is_designed_has_a_file(tmp_path: Path) -> None:
    result = design(str(FIELD), "--method", "consensus", "-o", str(tmp_path / "x.npz"))
    assert isinstance(result.exception, InputError)
    assert "not designed off-line: expected one of" in str(result.exception)


def test_without_cvxpy_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    designs._designed.cache_clear()
    result = design(str(FIELD), "--method", "stationary")
    assert isinstance(result.exception, InputError)
    [line] = str(result.exception).splitlines()
    assert line == "convex design needs cvxpy: pip install 'zfusion[design]'"


def test_a_file_is_used_and_checked(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario(FIELD, steps=6)
    method = {"name": "stationary", "design": str(file)}
    given = Scenario.model_validate(scenario._document() | {"method": method})
    monkeypatch.setitem(sys.modules, "cvxpy", None)  # nothing is designed any more
    designs._designed.cache_clear()
    assert pytest.approx(stationary.Design.load(file).J) == design_of(given).J
    assert with_design(given, tmp_path / "other.npz") is given
    assert {len(lives) for lives in simulate(given, run="given").values()} == {1}
    other = Scenario.model_validate(given._document() | {"network": {"generator": "complete"}})
    with pytest.raises(DesignFileError, match="another system, network"):
        design_of(other)


def test_seeds_and_sources_share_a_design() -> None:
    scenario = load_scenario(FIELD, method="l2_linf")
    assert design_of(scenario) is design_of(scenario.with_overrides(seed=5, steps=3, loss=0.3))
    assert design_of(load_scenario(FIELD)) is None
    with pytest.raises(ValueError, match="not designed"):
        make(load_scenario(FIELD))


def test_a_launch_designs_once_for_all_nodes(tmp_path: Path) -> None:
    scenario = EXAMPLES / "shootout_field.toml"
    run = run_name("designed")
    result = launch(
        tmp_path, scenario, "--free-run", "--steps", 20, "--method", "stationary", "--record", "run.mcap", run=run
    )
    assert result.code == 0, result.err
    assert set(result.summary["completed_steps"].values()) == {20}
    assert result.summary["notes"][0].startswith("stationary: ")
    [logs] = tmp_path.glob("*.logs")
    given = load_scenario(logs / "scenario.toml")
    assert given.method.design == str(logs / "design.npz")
    assert stationary.Design.load(logs / "design.npz").ids == (1, 2, 3, 4, 5, 6)
    rmtree(logs)  # the recording has the design, too
    (tmp_path / "elsewhere").mkdir()
    recording = (tmp_path / "run.mcap").rename(tmp_path / "elsewhere" / "moved.mcap")
    verified = CliRunner().invoke(app, ["replay", str(recording), "--verify", "--json"])
    assert (verified.exit_code, json.loads(verified.stdout)["different"]) == (0, 0)


def test_the_note_of_a_method_is_in_its_summary() -> None:
    def simulated(method: str, *more: str) -> Result:
        arguments = ["simulate", str(FIELD), "--method", method, "--steps", "3", "--no-record", *more]
        return CliRunner().invoke(app, arguments)

    [note] = json.loads(simulated("consensus", "--json").stdout)["notes"]
    assert "lost one way" in note
    assert f"note: {note}" in " ".join(simulated("consensus").stdout.split("\n"))
    assert json.loads(simulated("two_stage", "--json").stdout)["notes"] == []


def test_who_waits_for_long_is_told_what_for(monkeypatch: pytest.MonkeyPatch) -> None:
    told = io.StringIO()
    monkeypatch.setattr(progress, "err", Console(file=told, force_terminal=True, width=80))
    with progress.waiting("designing quickly"):
        pass
    assert "designing" not in told.getvalue()
    monkeypatch.setattr(progress, "PATIENCE_S", 0.0)
    with progress.waiting("designing slowly"):
        wait_until(lambda: "designing slowly" in told.getvalue(), "the text is there")


def test_a_recording_is_run_again_by_a_designed_method(tmp_path: Path) -> None:
    def replay(*arguments: str) -> Any:
        result = CliRunner().invoke(app, ["replay", *arguments, "--json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    simulate(load_scenario(FIELD, steps=12), run="run", output=tmp_path / "run.mcap")
    again = str(tmp_path / "again.mcap")
    done = replay(str(tmp_path / "run.mcap"), "--method", "stationary", "-o", again)
    assert all(node["rms"] > 0 for node in done["nodes"].values())
    assert replay(again, "--verify")["different"] == 0
