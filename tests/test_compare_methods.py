"""Methods compared on the same measurements and the same network: numbers, costs, refusals, figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from simulations import record, walk
from zfusion.cli import app
from zfusion.drivers.simulated import Simulation, simulate
from zfusion.errors import InputError
from zfusion.methods.prediction import predict
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.recording import Recording
from zfusion.stages import Message
from zfusion.studies import method_comparison
from zfusion.studies.contestants import field_of, field_of_recording
from zfusion.studies.experiment.plan import plan
from zfusion.studies.experiment.spec import load_experiment
from zfusion.studies.intervals import Interval
from zfusion.studies.method_comparison import BELIEVED, MethodComparison, Standing, compare_methods

EXAMPLES = Path(__file__).parents[1] / "examples"
FIELD = EXAMPLES / "shootout_field.toml"
FOUR = EXAMPLES / "four_sensor.toml"
STEPS = 12
THREE = ("two_stage", "local", "diffusion")


def compared(
    scenario: Scenario, labels: tuple[str, ...], directory: Path, seeds: range = range(3), jobs: int = 1
) -> MethodComparison:
    return compare_methods(field_of(scenario, labels, directory), seeds, jobs=jobs)


def command(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["compare", *arguments])


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> MethodComparison:
    """Three methods, a third of all messages lost."""
    return compared(walk(STEPS, links={"loss": 0.3}), THREE, tmp_path_factory.mktemp("designs"))


def test_errors_are_those_of_the_estimates_of_the_same_simulations(lossy: MethodComparison) -> None:
    for standing in lossy.standings:
        by_seed, normalised = [], []
        for seed in range(3):
            scenario = walk(STEPS, links={"loss": 0.3}, method=standing.label).with_overrides(seed=seed)
            path, found, nees = SamplePath(scenario.system(), seed), list[float](), list[float]()

            def observe(message: Message, _now: int, path: Any = path, found: Any = found, nees: Any = nees) -> None:
                if message.stage == "estimate":
                    error = message.fields["x"] - path.truth(message.step)
                    found.append(float(error @ error))
                    nees.append(float(error @ np.linalg.solve(message.fields["P"], error)) / 2)  # type: ignore[call-overload]

            Simulation(scenario, observe=observe).run()
            by_seed.append(np.mean(found))
            normalised.append(np.mean(nees))
        assert standing.mse.mean == pytest.approx(np.mean(by_seed), rel=1e-12)
        assert standing.nees is not None
        assert standing.nees.mean == pytest.approx(np.mean(normalised), rel=1e-12)
        assert standing.mse.n == lossy.units == 3
        assert np.mean(list(standing.by_node.values())) == pytest.approx(standing.mse.mean)


def test_the_ideal_network_stands_beside_a_lossy_one(lossy: MethodComparison, tmp_path: Path) -> None:
    ideal = compared(walk(STEPS), THREE, tmp_path)
    for standing, twin in zip(lossy.standings, ideal.standings, strict=True):
        assert twin.ideal_mse is None
        assert standing.ideal_mse == twin.mse
    two_stage, local, _ = lossy.standings
    assert two_stage.ideal_mse is not None
    assert two_stage.mse.mean > two_stage.ideal_mse.mean
    assert local.mse == local.ideal_mse


def test_bounds_are_the_predicted_ones(lossy: MethodComparison) -> None:
    prediction = predict(walk(STEPS).system(), walk(STEPS).network, STEPS)
    local = np.einsum("kmaa->km", prediction.local[1:]).mean(axis=0)
    assert [lossy.local[str(i)] for i in walk().ids] == pytest.approx(local.tolist())
    assert lossy.centralized == pytest.approx(np.einsum("kaa->k", prediction.centralized[1:]).mean())
    assert lossy.local["all"] == pytest.approx(local.mean())
    assert lossy.best == lossy.centralized
    assert not any(standing.heavy_tailed for standing in lossy.standings)


def test_traffic_is_counted_for_every_edge(lossy: MethodComparison) -> None:
    """Five nodes on a ring: ten directed edges, whether the message arrives or not."""
    two_stage, local, diffusion = lossy.standings
    assert (two_stage.rounds, two_stage.messages) == (2, 20.0)
    assert (diffusion.rounds, diffusion.messages) == (2, 20.0)
    assert (local.rounds, local.messages, local.bytes) == (0, 0.0, 0.0)
    assert 40 < two_stage.bytes / two_stage.messages < 200
    assert all(standing.cpu_us > 0 for standing in lossy.standings)


def test_each_is_set_against_the_first(lossy: MethodComparison) -> None:
    first, *others = lossy.standings
    assert first.against is None
    for standing in others:
        assert standing.against is not None
        assert (standing.against.base, standing.against.other) == ("two_stage", standing.label)
        assert standing.against.nodes["all"].a == pytest.approx(first.mse.mean)
        assert standing.against.nodes["all"].b == pytest.approx(standing.mse.mean)


def test_all_but_the_timing_is_the_same_whatever_the_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def plain(found: MethodComparison) -> Any:
        told = found.as_dict()
        for method in told["methods"]:
            assert method.pop("timing")["reproducible"] is False
        return told

    monkeypatch.setattr(method_comparison, "WORTH_PROCESSES", 0)
    scenario = load_scenario(FIELD, steps=6, loss=0.2)
    labels = ("two_stage", "stationary:filtered=true")
    one, two = (compared(scenario, labels, tmp_path, range(2), jobs) for jobs in (1, 2))
    assert plain(one) == plain(two)


def test_who_cannot_stand_it_is_listed_with_the_reason(tmp_path: Path) -> None:
    field = field_of(load_scenario(FOUR, steps=4), ("two_stage", "consensus", "stationary", "l2_linf"), tmp_path)
    assert [one.label for one in field.contestants] == ["two_stage"]
    assert field.refused["consensus"].startswith("network: directed graph not supported: weight 2->1")
    assert field.refused["stationary"].startswith("the method stationary needs")
    assert "\n" not in "".join(field.refused.values())
    with pytest.raises(InputError, match="no method can stand four_sensor: consensus: network"):
        field_of(load_scenario(FOUR, steps=4), ("consensus",), tmp_path)
    with pytest.raises(InputError, match=r"expected some of two_stage, .*is 'kalman'"):
        field_of(load_scenario(FOUR, steps=4), ("two_stage", "kalman"), tmp_path)
    with pytest.raises(InputError, match="every method once"):
        field_of(walk(), ("local", "local"), tmp_path)


def test_a_policy_that_a_method_has_not_is_a_reason_too(tmp_path: Path) -> None:
    scenario = walk(6, timing={"rate_hz": 50.0, "late": "revise", "window": 3}, links={"delay": 0.03})
    field = field_of(scenario, ("two_stage", "diffusion"), tmp_path)
    assert field.refused["diffusion"].startswith("timing.late: expected a method that can go back")
    [standing] = compare_methods(field, range(2)).standings
    assert standing.ideal_mse is not None
    assert standing.against is None


def test_options_are_part_of_the_label(tmp_path: Path) -> None:
    scenario = load_scenario(FIELD, steps=8)
    few, many = compared(scenario, ("consensus:rounds=1", "consensus:rounds=6"), tmp_path, range(2)).standings
    assert (few.rounds, many.rounds) == (1, 6)
    assert many.messages == 6 * few.messages == 72
    field = field_of(scenario, ("local", "consensus:rounds=0"), tmp_path)
    assert field.refused["consensus:rounds=0"].startswith("method.options.rounds: expected a whole number")


def test_designs_are_made_once_and_shared(tmp_path: Path) -> None:
    field = field_of(load_scenario(FIELD, steps=3, loss=0.1), ("local", "stationary"), tmp_path)
    stationary = field.contestants[1]
    assert stationary.ideal is not None
    assert stationary.scenario.method.design == stationary.ideal.method.design == str(tmp_path / "1.npz")


def test_a_method_that_refuses_messages_does_so_here(tmp_path: Path) -> None:
    """The same as in a plain simulation: what is in between to take the time hides nothing."""
    scenario = load_scenario(FIELD, steps=6)
    [standing] = compared(scenario, ("covariance_intersection",), tmp_path, range(1)).standings
    plain = simulate(scenario.with_overrides(method="covariance_intersection", seed=0), run="plain")
    of_nodes = [lives[0].errors["estimate"]["mse"] for lives in plain.values()]
    assert standing.mse.mean == pytest.approx(np.mean(of_nodes))
    assert standing.mse.low is None


def test_a_recording_has_the_measurements(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", walk(30))
    with Recording.open(path) as recording:
        found = compare_methods(field_of_recording(recording, THREE, tmp_path), ())
        lost = compare_methods(field_of_recording(recording, THREE, tmp_path, {"loss": 0.5}), ())
    assert (found.unit, found.units, found.steps) == ("stretch", 6, 30)
    squared = [lives[0].errors["estimate"]["mse"] for lives in simulate(walk(30), run="again").values()]
    assert found.standings[0].mse.mean == pytest.approx(np.mean(squared))
    assert lost.standings[0].ideal_mse is not None
    assert lost.standings[0].ideal_mse.mean == pytest.approx(found.standings[0].mse.mean)
    assert lost.standings[0].mse.mean > found.standings[0].mse.mean


@pytest.mark.parametrize(
    ("interval", "believed"),
    [
        (Interval(1.01, 0.8, 1.2, 9), "yes"),
        (Interval(1.2, 1 + BELIEVED / 2, 1.4, 9), "unclear"),
        (Interval(1.2, 1.1, 1.3, 9), "optimistic"),
        (Interval(0.7, 0.6, 0.8, 9), "pessimistic"),
        (Interval(3.0, None, None, 1), "unclear"),
        (None, "unknown"),
    ],
)
def test_whose_covariance_can_be_believed(interval: Interval | None, believed: str) -> None:
    one = Standing("m", Interval(1, None, None, 1), {}, None, interval, 1, 1, 1, 1, None, "")
    assert one.believed == believed


def test_with_random_matrices_few_seeds_do_not_convict_a_covariance() -> None:
    """That of two_stage is exact there; what is too small on average is so for want of the rare large errors."""
    small, large = Interval(0.6, 0.4, 0.8, 20), Interval(1.6, 1.4, 1.8, 20)
    of = [Standing("m", small, {}, None, nees, 1, 1, 1, 1, None, "", heavy_tailed=True) for nees in (small, large)]
    assert [one.believed for one in of] == ["unclear", "optimistic"]


def test_the_best_is_that_of_the_same_measurements_where_it_is_known(tmp_path: Path) -> None:
    found = compared(load_scenario(FOUR, steps=5, loss=0.5), ("two_stage", "centralized"), tmp_path, range(2))
    assert found.standings[1].ideal_mse is not None
    assert found.best == found.standings[1].ideal_mse.mean < found.standings[1].mse.mean
    assert all(standing.heavy_tailed for standing in found.standings)


def test_the_command_tells_and_draws(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    labels = "two_stage,local,consensus,covariance_intersection"
    few = (str(FIELD), "--methods", labels, "--seeds", "2", "--steps", "5", "--loss", "0.2")
    told = json.loads(command(*few, "--json", "-o", str(tmp_path)).stdout)
    assert [method["method"] for method in told["methods"]] == labels.split(",")
    assert told["bounds"]["centralized"] < told["bounds"]["local"]["all"]
    names = {"methods-error", "methods-nees", "methods-by-node", "methods-traffic"}
    assert {Path(figure).stem for figure in told["figures"]} == names
    for name in names:
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
        assert "local" in (tmp_path / f"{name}.svg").read_text() or name == "methods-by-node"
    shown = command(str(FOUR), "--methods", "two_stage,consensus", "--seeds", "2", "--steps", "4").stdout
    assert "cannot stand it: consensus: network: directed graph" in shown
    assert "alone, predicted" in shown


def test_what_does_not_go_together() -> None:
    for more in (("--b", "seed=3"), ("--metric", "nees"), (str(FOUR),)):
        assert isinstance(command(str(FOUR), *more, "--methods", "local").exception, InputError)
    assert "--output goes with --methods" in str(command(str(FOUR), "-o", "x").exception)


def test_every_point_of_the_shootout_can_be_run() -> None:
    """That every method stands every network of the experiment; its numbers are on a page of the docs."""
    made = plan(load_experiment(EXAMPLES / "shootout.toml", small=True))
    methods = {point.scenario.method.name: point.scenario for point in made.points}
    assert len(methods) == 11
    assert len(made.points) == 11 * 6
    for scenario in methods.values():
        reports = simulate(scenario.with_overrides(steps=2), run="one")
        assert all(lives[0].completed == 2 for lives in reports.values())
