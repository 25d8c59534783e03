"""The examples of the methods designed off-line: errors, switching, losses, design files, and what is refused."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from lmi_examples import EXAMPLES, IDS, MISSING, example, filters, switching_sensors
from simulations import losing, record
from zfusion.cli import app
from zfusion.drivers.designs import design_of, modes_of
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import Simulation, simulate
from zfusion.errors import InputError, ZfusionError
from zfusion.links import Topology
from zfusion.methods.design_files import DesignFileError
from zfusion.methods.l2_linf import Design
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import Array
from zfusion.recording import Recording
from zfusion.stages import ESTIMATE, Message

BOTH = ("stationary", "l2_linf")
MODES: list[dict[str, Any]] = tomllib.loads((EXAMPLES / "l2_linf.toml").read_text())["links"]["topology"]["modes"]
SCHEDULE = {"modes": MODES, "schedule": [{"step": 1, "mode": 1}, {"step": 4, "mode": 0}, {"step": 9, "mode": 1}]}


def simulated(scenario: Scenario) -> tuple[Simulation, dict[tuple[str, Any, int], Message]]:
    """A simulation that has ended, and its messages by stage, node and step."""
    said: dict[tuple[str, Any, int], Message] = {}
    simulation = Simulation(scenario, observe=lambda m, _: said.update({(m.stage, m.node, m.step): m}))
    simulation.run()
    return simulation, said


@pytest.mark.parametrize("name", BOTH)
def test_errors_of_the_examples_are_as_large_as_predicted(name: str) -> None:
    """Of independent runs, from the first step on: eᵀP⁻¹e is nx and |e|² is tr P in the mean, within 6 sigma of it."""
    base, runs = example(name, steps=12), 60
    nees, excess = np.zeros(runs), np.zeros(runs)
    for seed in range(runs):
        simulation, _ = simulated(base.with_overrides(seed=seed))
        of_nodes = [simulation.reports[i][0].errors[ESTIMATE.name] for i in IDS]
        nees[seed] = np.mean([errors["nees"] for errors in of_nodes])
        excess[seed] = np.mean([errors["mse"] / errors["predicted_mse"] - 1 for errors in of_nodes])
    for sample, expected in ((nees, base.system().nx), (excess, 0.0)):
        sigma = sample.std(ddof=1) / np.sqrt(runs)
        assert abs(sample.mean() - expected) < 6 * sigma
        assert sigma < 0.15  # which says something


def test_a_long_run_predicts_the_designs_errors() -> None:
    scenario = load_scenario(EXAMPLES / "stationary.toml", steps=150)
    _, said = simulated(scenario)
    last = [np.trace(np.asarray(said[ESTIMATE.name, i, 150].fields["P"])) for i in IDS]
    np.testing.assert_allclose(last, [0.91212, 0.91750, 0.87270, 0.91387], atol=3e-4)


@pytest.mark.parametrize("switch", ["markov", "schedule"])
def test_links_and_gains_switch_together(switch: str) -> None:
    """Every estimate is made with the gains of the mode in which the links were, from just what that mode carries."""
    scenario = example("l2_linf", steps=30) if switch == "markov" else example(
        "l2_linf", steps=12, links={"topology": SCHEDULE}
    )  # fmt: skip
    design, topology, A = design_of(scenario), Topology(scenario), np.array(scenario.system_spec.model_dump()["F"])
    assert isinstance(design, Design)
    networks, mean = modes_of(scenario).networks, scenario.system().initial_mean
    modes = [topology.mode(k) for k in range(1, scenario.steps + 1)]
    assert set(modes) == {0, 1}
    if switch == "schedule":
        assert modes == [1] * 3 + [0] * 5 + [1] * 4
    simulation, said = simulated(scenario)
    for k, mode in enumerate(modes, 1):
        mean = A @ mean
        here = [said["measurement", i, k].fields for i in IDS]
        x = np.concatenate([np.asarray(fields["x"]) - mean for fields in here])
        y = np.concatenate([np.asarray(fields["y"]) for fields in here]) - design.problem.expected_C @ mean
        following = (design.gains.K[mode] @ x + design.gains.H[mode] @ y).reshape(4, 2) + A @ mean
        for n, i in enumerate(IDS):
            assert said[ESTIMATE.name, i, k].fields["used"] == networks[mode].neighbours(i)
            if k < scenario.steps:
                told = said["measurement", i, k + 1].fields["x"]
                np.testing.assert_allclose(np.asarray(told), following[n], rtol=0, atol=1e-10)
    for i in IDS:  # and the links carried nothing else
        cut = simulation.reports[i][0].emulated
        for j in scenario.network.neighbours(i):
            gone = sum(j not in networks[mode].neighbours(i) for mode in modes)
            assert cut.get(str(j), {}).get("cut", 0) == (gone if j != i else 0)


def test_all_nodes_draw_the_same_modes_in_whatever_order() -> None:
    scenario = load_scenario(EXAMPLES / "l2_linf.toml")
    forwards = [Topology(scenario).mode(k) for k in range(1, 80)]
    one = Topology(load_scenario(EXAMPLES / "l2_linf.toml"))
    assert [one.mode(k) for k in range(79, 0, -1)][::-1] == forwards
    assert [Topology(scenario.with_overrides(seed=1)).mode(k) for k in range(1, 80)] != forwards


@pytest.mark.parametrize("timing", [{"rate_hz": 10.0, "late": "wait"}, {"free_run": True}])
def test_nobody_waits_for_neighbours_that_the_mode_does_not_have(timing: dict[str, Any], tmp_path: Path) -> None:
    """Not for one timeout; and a replay, which goes by what was used, finds the same."""
    scenario = example("l2_linf", steps=25, timing=timing | {"timeout_s": 5.0})
    path = tmp_path / "run.mcap"
    reports = simulate(scenario, run="r", output=path)
    for [life] in reports.values():
        assert life.completed == 25
        assert life.elapsed_s < 5.0
        assert all(not edge["missed"] for edge in life.edges.values())
    assert {Topology(scenario).mode(k) for k in range(1, 26)} == {0, 1}
    with Recording.open(path) as recording:
        assert verify(recording).identical == 2 * 25 * 4


KILLS = [{"kind": "kill", "node": 2, "step": 10, "restart_after": 5}, {"kind": "kill", "node": 4, "step": 20}]


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("stationary", {"faults": KILLS}),
        ("l2_linf", {"faults": KILLS}),
        ("l2_linf", {"links": {"topology": SCHEDULE, "loss": 0.2}}),
    ],
)
def test_losses_restarts_and_switching_are_replayed_bit_for_bit(
    name: str, changes: dict[str, Any], tmp_path: Path
) -> None:
    scenario = example(name, steps=30, **changes)
    lossy = None if "links" in changes else scenario.with_overrides(loss=0.2)
    path = record(tmp_path / "run.mcap", lossy or scenario)
    with Recording.open(path) as recording:
        verdict = verify(recording)
    assert verdict.verified
    assert verdict.identical == (2 * (30 * 4) if "links" in changes else 2 * (30 * 4 - 5 - 11))


@pytest.mark.parametrize("name", BOTH)
def test_errors_stay_bounded_under_loss_restart_and_kill(name: str) -> None:
    """Far below the state's own variance, which a node has that knows nothing; and P is optimistic, but not absurd."""
    scenario = example(name, steps=400, faults=KILLS).with_overrides(loss=0.2)
    simulation, _ = simulated(scenario)
    prior = float(np.trace(stationary_covariance(scenario)))
    assert [len(lives) for lives in simulation.reports.values()] == [1, 2, 1, 1]
    for i in (1, 2, 3):
        errors = simulation.reports[i][-1].errors[ESTIMATE.name]
        assert errors["count"] > 380
        assert errors["mse"] < 0.75 * prior
        assert 0.9 < errors["mse"] / errors["predicted_mse"] < 1.5


def stationary_covariance(scenario: Scenario) -> Array:
    system = scenario.system()
    A, Q = system.F.items[0].mean, system.noise.covariances(5, []).Q
    X = Q
    for _ in range(500):
        X = A @ X @ A.T + Q
    return np.asarray(X)


# --- design files ---


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The examples' designs as files."""
    directory = tmp_path_factory.mktemp("designs")
    paths = {name: directory / f"{name}.npz" for name in BOTH}
    for name, path in paths.items():
        design_of(load_scenario(EXAMPLES / f"{name}.toml")).save(path)
    return paths


def written(name: str, directory: Path, design: str, **changes: Any) -> Path:
    """The example's scenario as a file that names a design."""
    scenario = example(name, steps=5, **changes)
    document = tomllib.loads(scenario.to_toml())
    document["method"] |= {"design": design}
    path = directory / f"{name}.toml"
    path.write_text(Scenario.model_validate(document).to_toml())
    return path


@pytest.mark.parametrize("name", BOTH)
def test_a_run_from_a_design_file_is_that_of_the_design(name: str, stored: Mapping[str, Path], tmp_path: Path) -> None:
    (tmp_path / "x.npz").write_bytes(stored[name].read_bytes())
    with_file = load_scenario(written(name, tmp_path, "x.npz"))
    outcomes = [simulated(scenario)[1] for scenario in (with_file, example(name, steps=5))]
    for i in IDS:
        first, second = (said[ESTIMATE.name, i, 5].fields for said in outcomes)
        np.testing.assert_array_equal(first["x"], second["x"])
        np.testing.assert_allclose(first["P"], second["P"], rtol=1e-11)
    path = record(tmp_path / "run.mcap", with_file, losing(0.2, 3))
    with Recording.open(path) as recording:
        assert verify(recording).verified


def test_nodes_with_different_designs_refuse_each_other(stored: Mapping[str, Path], tmp_path: Path) -> None:
    """A node's fingerprint says what is in its design file, and not what that is called or where it lies."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    (tmp_path / "a" / "x.npz").write_bytes(stored["stationary"].read_bytes())
    one = load_scenario(written("stationary", tmp_path / "a", "x.npz"))
    (tmp_path / "b" / "other_name.npz").write_bytes(stored["stationary"].read_bytes())
    same = load_scenario(written("stationary", tmp_path / "b", "other_name.npz"))
    assert one.fingerprint == same.fingerprint
    other = example("stationary", method={"name": "stationary", "options": {"gramian": "controllability"}})
    design_of(other).save(tmp_path / "b" / "other_name.npz")
    different = load_scenario(tmp_path / "b" / "stationary.toml")
    assert different.fingerprint != one.fingerprint
    assert len({one.fingerprint, different.fingerprint, example("stationary").fingerprint}) == 3
    nowhere = load_scenario(written("stationary", tmp_path, "nowhere.npz"))
    assert nowhere.fingerprint not in (one.fingerprint, different.fingerprint)  # and loading it is no error yet
    with pytest.raises(DesignFileError, match=r"nowhere.npz: there is no such file"):
        design_of(nowhere)


def cut_short(content: bytes) -> bytes:
    return content[: len(content) // 2]


def of_another_version(content: bytes, directory: Path) -> bytes:
    path = directory / "old.npz"
    path.write_bytes(content)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(path, allow_pickle=False, **(arrays | {"version": np.array(99)}))
    return path.read_bytes()


@pytest.mark.parametrize(
    ("trouble", "words"),
    [
        ("missing", "there is no such file"),
        ("damaged", "not a design file"),
        ("text", "not a design file"),
        ("method", "a design of the method 'l2_linf', expected one of 'stationary'"),
        ("version", "a design file of version 99; this zfusion reads version 1"),
        ("scenario", "designed for another system, network or choice of options; design it anew"),
    ],
)
def test_a_design_file_that_cannot_be_used_is_one_line_that_names_it(
    trouble: str, words: str, stored: Mapping[str, Path], tmp_path: Path
) -> None:
    content = stored["stationary"].read_bytes()
    made = {
        "damaged": cut_short(content),
        "text": b"K = 1",
        "method": stored["l2_linf"].read_bytes(),
        "version": of_another_version(content, tmp_path),
        "scenario": content,
    }
    if trouble != "missing":
        (tmp_path / "x.npz").write_bytes(made[trouble])
    network = {"network": {"generator": "complete"}} if trouble == "scenario" else {}
    error = refused(written("stationary", tmp_path, "x.npz", **network))
    assert str(tmp_path / "x.npz") in str(error)
    assert words in str(error)


# --- what a scenario may not ask for ---


def refused(path: Path) -> ZfusionError:
    """What `zfusion simulate` says to it: one line, exit code 2, before anything runs."""
    result = CliRunner().invoke(app, ["simulate", str(path), "--no-record", "--json"])
    assert isinstance(result.exception, InputError), result.output
    assert result.exception.exit_code == 2
    assert "\n" not in str(result.exception)
    assert not result.stdout
    return result.exception


UNSTABLE = {"F": [[1.1, 0, 0], [0, 0.5, 0], [0, 0, 0.5]], "Q": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
PRIOR = {"initial_mean": [0, 0, 0], "initial_covariance": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
BERNOULLI = {"distribution": "bernoulli", "p": 0.8}
RANDOM = {"terms": [{"matrix": [[1, 0, 0]], "variables": ["t"]}], "variables": {"t": BERNOULLI}}


def with_first_sensor(name: str, **changes: Any) -> list[dict[str, Any]]:
    sensors: list[dict[str, Any]] = tomllib.loads((EXAMPLES / f"{name}.toml").read_text())["sensors"]
    return [sensors[0] | changes, *sensors[1:]]


def asking(name: str, **options: Any) -> dict[str, Any]:
    return {"method": {"name": name, "options": options}}


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("stationary", {"system": UNSTABLE | PRIOR}, "A is not asymptotically stable (spectral radius 1.1)"),
        (
            "stationary",
            {"sensors": with_first_sensor("stationary", H=RANDOM)},
            "needs matrices that are not random; H of sensor 1 is",
        ),
        ("stationary", asking("stationary", worst_node=True), "controllability design only"),
        ("stationary", asking("stationary", gramian="gram"), "method.options.gramian: expected one of"),
        ("stationary", asking("stationary", gramain="x"), "method.options.gramain: expected an option of stationary"),
        (
            "l2_linf",
            {"system": {"F": [[1, 0], [0, 0.5]], "Q": [[1, 0], [0, 1]], "initial_mean": [0, 0],
                        "initial_covariance": [[1, 0], [0, 1]]}},
            "A is not Schur stable (spectral radius 1)",
        ),
        ("l2_linf", {"sensors": switching_sensors((1.2, 1, 1, 1))}, "p: expected"),
        ("l2_linf", {"links": {"topology": {"modes": MODES, "markov": {"transition": [[0.7, 0.4], [0.4, 0.6]],
                                                                        "initial": [1, 0]}}}}, "add up to 1"),
        ("l2_linf", asking("l2_linf", form="any"), "method.options.form: expected one of"),
        ("l2_linf", asking("l2_linf", output=[[1.0, 0.0, 0.0]]), "M"),
    ],
)  # fmt: skip
def test_what_the_methods_cannot_stand_is_said_before_anything_runs(
    name: str, changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    document = tomllib.loads((EXAMPLES / f"{name}.toml").read_text()) | changes
    path = tmp_path / "s.toml"
    path.write_text(tomli_w.dumps(document))
    error = refused(path)
    assert words in str(error)
    assert str(path) in str(error)


def test_the_designs_of_the_examples_are_those_of_the_references() -> None:
    stationary = design_of(load_scenario(EXAMPLES / "stationary.toml"))
    assert (stationary.bound, stationary.J) == pytest.approx((3.63182, 3.61618), abs=3e-4)
    switching = design_of(load_scenario(EXAMPLES / "l2_linf.toml"))
    assert (switching.gamma, switching.certified, switching.worst) == pytest.approx((0.57844, 0.5470, 0.5392), abs=1e-4)
    assert switching.fingerprint == filters(MISSING, "general").fingerprint
