import csv
import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from zfusion.drivers.simulated import Simulation
from zfusion.drivers.sources import open_source
from zfusion.errors import InputError, RecordingError, ScenarioError
from zfusion.keys import stage_key
from zfusion.messages import encode
from zfusion.model.scenario import load_scenario
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import ESTIMATE, Message
from zfusion.studies.library import Study, load_study, prepare, score, show_score
from zfusion.studies.library.data import Readings, load_links, load_readings
from zfusion.studies.library.field import damped, identify, principal_components, wandering, without_gaps

ROOT = Path(__file__).parent.parent
DATA = ROOT.parent / "shared" / "data" / "library_wsn"

STUDY = Study(train_fraction=0.8, held_out=(3,), modes=1, max_mean_lqi=130.0, min_reports=10)
MOTES = (1, 2, 3, 5, 6)


def field(rounds=200, seed=1) -> np.ndarray:
    """Temperatures of five motes as the model has them, with one spatial mode, (rounds, 5), to a hundredth."""
    rng = np.random.default_rng(seed)
    trend, mode = (ar1(rng, phi, variance, rounds)[:, np.newaxis] for phi, variance in ((0.95, 4e-4), (0.9, 0.04)))
    common = trend.cumsum(axis=0) * [1, 0.9, 1.1, 1.0, 1.0]
    spatial = mode * [1, -1, 0.5, 0, -0.5]
    own = rng.normal(0, 0.004, (rounds, 5)).cumsum(axis=0) * [1, 1, 0, 1, 1]
    noise = rng.normal(0, 0.02, (rounds, 5))
    return np.round(np.array([20, 20.5, 21, 21.5, 22]) + common + spatial + own + noise, 2)


def ar1(rng, phi, variance, n) -> np.ndarray:
    """An AR(1) process of this variance, (n,)."""
    noise = rng.normal(0, np.sqrt(variance * (1 - phi**2)), n)
    state = np.empty(n)
    state[0] = rng.normal(0, np.sqrt(variance))
    for k in range(1, n):
        state[k] = phi * state[k - 1] + noise[k]
    return state


def write(directory: Path, celsius: np.ndarray, links=()) -> Path:
    directory.mkdir(exist_ok=True)
    rows = [(m, k + 1, c) for k, row in enumerate(celsius) for m, c in zip(MOTES, row, strict=True) if not np.isnan(c)]
    for name, header, body in (
        ("readings.csv", ("node", "sequence", "temperature_c"), rows),
        ("links.csv", ("node", "heard_node", "reports", "mean_lqi"), links or COMPLETE),
    ):
        with (directory / name).open("w", newline="") as file:
            csv.writer(file).writerows([header, *body])
    return directory


COMPLETE = [(i, j, 100, 120.0) for i in MOTES for j in MOTES if i != j]


def simulated(path: Path, steps=None) -> Path:
    """A recording of the scenario at `path`, made in virtual time."""
    scenario = load_scenario(path, steps=steps)
    recording = path.parent / "run.mcap"
    facts = {"scenario_toml": scenario.to_toml(), "run": "r", "method": scenario.method.name, "seed": 0}
    with RecordingWriter(recording, **facts) as writer:
        Simulation(scenario, run="r", record=writer.write).run()
    return recording


class TestData:
    def test_rounds_and_motes_make_a_table_with_gaps(self, tmp_path):
        celsius = field(6)
        celsius[2, 1] = celsius[4] = np.nan
        readings = load_readings(write(tmp_path, celsius))
        assert readings.motes == MOTES
        np.testing.assert_array_equal(readings.celsius, celsius)
        np.testing.assert_array_equal(readings.of([5, 2]), celsius[:, [3, 1]])

    def test_of_a_packet_that_came_twice_the_first_counts(self, tmp_path):
        write(tmp_path, field(3))
        with (tmp_path / "readings.csv").open("a") as file:
            file.write("1,2,99\n")
        assert load_readings(tmp_path).celsius[1, 0] < 90

    def test_links_are_directed(self, tmp_path):
        [link] = load_links(write(tmp_path, field(3), links=[(1, 2, 40, 118.5)]))
        assert (link.node, link.heard, link.reports, link.mean_lqi) == (1, 2, 40, 118.5)

    @pytest.mark.parametrize("name", ["readings.csv", "links.csv"])
    def test_a_missing_file_is_named_and_where_it_is_published(self, tmp_path, name):
        (write(tmp_path, field(150)) / name).unlink()
        with pytest.raises(InputError, match=rf"{name}: No such file.*Library 1.*Université Libre de Bruxelles"):
            prepare(STUDY, tmp_path, tmp_path / "out")

    def test_what_is_not_the_data_is_named_with_its_place(self, tmp_path):
        path = write(tmp_path, field(3)) / "readings.csv"
        path.write_text("node,sequence,temperature_c\n1,1,20.5\n1,2,warm\n")
        with pytest.raises(InputError, match=r"readings\.csv, line 3, temperature_c: expected a number, is 'warm'"):
            load_readings(tmp_path)
        path.write_text("node,sequence,temperature_c\nx,1,20.5\n")
        with pytest.raises(InputError, match=r"line 2, node: expected a whole number, is 'x'"):
            load_readings(tmp_path)
        path.write_text("node,temperature_c\n")
        with pytest.raises(InputError, match=r"has no column 'sequence'"):
            load_readings(tmp_path)
        path.write_text("node,sequence,temperature_c\n")
        with pytest.raises(InputError, match=r"expected readings of rounds 1, 2"):
            load_readings(tmp_path)


class TestField:
    def test_gaps_are_bridged_in_a_straight_line(self):
        nan = np.nan
        filled = without_gaps(np.array([[nan, 1.0], [2.0, nan], [nan, nan], [4.0, 4.0]]))
        np.testing.assert_allclose(filled, [[2, 1], [2, 2], [3, 3], [4, 4]])

    def test_components_of_a_field_without_noise_are_found(self):
        rng = np.random.default_rng(3)
        loadings = np.array([[1.0, 1], [0.9, -1], [1.1, 0.3], [1.0, -0.3]])
        scores = rng.normal(size=(50, 2)) * [3, 1]
        found, at = principal_components((scores - scores.mean(axis=0)) @ loadings.T, 2)
        np.testing.assert_allclose(at @ found.T, (scores - scores.mean(axis=0)) @ loadings.T, atol=1e-12)
        assert found[:, 0].mean() == pytest.approx(1)
        assert np.mean(found[:, 1] ** 2) == pytest.approx(1)
        assert found[np.abs(found[:, 1]).argmax(), 1] > 0

    def test_a_decay_and_a_variance_are_found_through_white_noise(self):
        rng, phi, variance = np.random.default_rng(4), 0.9, 2.0
        found = np.array(
            [damped(ar1(rng, phi, variance, 4000) + rng.normal(0, 1, 4000), range(1, 11)) for _ in range(60)]
        )
        within_six_sigma(found, (phi, variance))

    def test_a_walk_and_the_noise_upon_it_are_told_apart(self):
        rng = np.random.default_rng(5)
        walks = rng.normal(0, 0.5, (60, 4000)).cumsum(axis=1) + rng.normal(0, 2.0, (60, 4000))
        within_six_sigma(np.array([wandering(walk) for walk in walks]), (0.25, 4.0))

    def test_noise_is_at_least_that_of_rounding(self):
        q, r = wandering(np.arange(100) % 2 * 1e-6)
        assert q == 0
        assert r == pytest.approx(0.01**2 / 12)

    def test_a_mote_in_the_swarm_has_its_own_level_and_one_held_out_its_mean(self):
        readings = Readings(MOTES, field())
        model = identify(readings, [1, 2, 5, 6], modes=1, rounds=160)
        assert len(model.initial_mean) == 2 + 1 + 4
        before = readings.celsius[:160]
        np.testing.assert_allclose(model.initial_mean[3:], before[:, [0, 1, 3, 4]].mean(axis=0))
        assert model.offset == {1: 0, 2: 0, 3: pytest.approx(before[:, 2].mean()), 5: 0, 6: 0}
        for mote, column in zip(MOTES, before.T, strict=True):  # x_0 is the state in the last round of the training
            assert model.reading(mote, model.initial_mean) == pytest.approx(column[-1], abs=0.1)

    def test_what_cannot_be_identified_is_refused(self):
        with pytest.raises(InputError, match="a training of 50 rounds: expected at least 60"):
            identify(Readings(MOTES, field()), MOTES, modes=1, rounds=50)
        with pytest.raises(InputError, match="4 spatial modes: expected at most 3"):
            identify(Readings(MOTES, field()), MOTES, modes=4, rounds=160)
        celsius = field()
        celsius[1:160, 0] = np.nan
        with pytest.raises(InputError, match="mote 1 has 1 readings in a training of 160 rounds"):
            identify(Readings(MOTES, celsius), MOTES, modes=1, rounds=160)


def within_six_sigma(found: np.ndarray, true: tuple[float, ...]) -> None:
    """The mean of independent estimates, (repetitions, parameters), is the truth but for six standard errors."""
    error = np.abs(found.mean(axis=0) - true)
    assert (error < 6 * found.std(axis=0, ddof=1) / np.sqrt(len(found))).all()


class TestPrepare:
    def test_the_scenario_runs_on_the_rest_of_the_readings(self, tmp_path):
        celsius = field()
        celsius[161, 1] = np.nan
        path = prepare(STUDY, write(tmp_path / "data", celsius), tmp_path / "deep" / "out")
        scenario = load_scenario(path)
        assert scenario.ids == (1, 2, 5, 6)
        assert scenario.steps == 40
        assert scenario.timing.free_run
        source = open_source(scenario, 2)
        read = [source.read(k, 0) for k in (1, 2, 3, 40, 41)]
        assert [None if y is None else y.tolist() for y in read] == [
            [celsius[160, 1]],
            None,
            [celsius[162, 1]],
            [celsius[199, 1]],
            None,
        ]

    def test_good_links_are_edges_from_the_heard_to_the_hearer(self, tmp_path):
        links = [(1, 2, 10, 130.0), (2, 1, 9, 120), (2, 5, 10, 130.1), (5, 3, 99, 100), (6, 1, 99, 100)]
        network = load_scenario(prepare(STUDY, write(tmp_path, field(), links), tmp_path / "out")).network
        assert {i: network.neighbours(i) for i in network.ids} == {1: (1, 2), 2: (2,), 5: (5,), 6: (1, 6)}

    def test_it_is_the_same_every_time(self, tmp_path):
        data = write(tmp_path, field())
        first, second = (prepare(STUDY, data, tmp_path / name).read_bytes() for name in "ab")
        assert first == second

    @pytest.mark.parametrize(
        ("change", "told"),
        [
            ({"held_out": (4,)}, r"there is no mote 4; the data are of \[1, 2, 3, 5, 6\]"),
            ({"held_out": MOTES}, "at least one mote to be left"),
            ({"train_fraction": 1.0}, "train_fraction: expected less than 1"),
            ({"train_fraction": 0.1}, "a training of 20 rounds"),
        ],
    )
    def test_settings_that_do_not_fit_are_refused(self, tmp_path, change, told):
        with pytest.raises(InputError, match=told):
            prepare(STUDY.model_copy(update=change), write(tmp_path, field()), tmp_path / "out")

    def test_a_wrong_study_file_is_named(self, tmp_path):
        path = tmp_path / "study.toml"
        path.write_text("train_fraction = 0\nheld_out = [1]\nmodes = 2\nmax_mean_lqi = 130.0\nmin_report = 3\n")
        with pytest.raises(ScenarioError, match=r"study\.toml: min_report: .*did you mean 'min_reports'"):
            load_study(path)
        with pytest.raises(ScenarioError, match=r"none\.toml: file: expected a TOML file"):
            load_study(tmp_path / "none.toml")


class TestScore:
    @pytest.fixture
    def data(self, tmp_path) -> Path:
        return write(tmp_path / "data", field())

    def test_a_swarm_predicts_the_field_better_than_the_baselines(self, data, tmp_path):
        result = score(simulated(prepare(STUDY, data, tmp_path / "out")), data)
        assert (result.training, result.rounds, result.method) == (160, 40, "two_stage")
        [held] = result.held_out
        assert held.mote == 3
        assert held.nodes <= held.worst
        assert held.swarm < min(held.alone, held.mean, held.corrected_mean, held.nearest, held.last)
        assert {row.rounds for row in result.next_reading} == {39}
        assert together(result.next_reading, "swarm") < together(result.next_reading, "last")

    def test_it_is_computed_from_the_recorded_estimates(self, data, tmp_path):
        """Estimates in which every mote's own level is its last reading, and nothing is in common."""
        scenario = load_scenario(prepare(STUDY, data, tmp_path / "out"))
        celsius = field()
        after = celsius[160:, [0, 1, 3, 4]]
        with RecordingWriter(
            tmp_path / "run.mcap", scenario_toml=scenario.to_toml(), run="r", method="two_stage", seed=0
        ) as writer:
            for k, row in enumerate(after, start=1):
                for i in scenario.ids:
                    fields = {"x": np.array([0.0, 0, 0, *row]), "P": np.eye(7), "used": [i], "excluded": []}
                    message = Message(i, k, ESTIMATE.name, k - 1, 1, 0, fields)
                    writer.write(stage_key("r", i, ESTIMATE.name), encode(message), k)
        result = score(tmp_path / "run.mcap", data)
        for row, own in zip(result.next_reading, after.T, strict=True):
            assert row.swarm == pytest.approx(row.last) == pytest.approx(np.sqrt(np.mean(np.diff(own) ** 2)))
        [held] = result.held_out
        true, before = celsius[160:, 2], celsius[:160]
        others = [0, 1, 3, 4]
        assert held.swarm == pytest.approx(held.nodes) == pytest.approx(held.worst)
        assert held.swarm == pytest.approx(np.sqrt(np.mean((true - before[:, 2].mean()) ** 2)))
        assert held.mean == pytest.approx(np.sqrt(np.mean((true - after.mean(axis=1)) ** 2)))
        distance = before[:, 2].mean() - before[:, others].mean()
        assert held.corrected_mean == pytest.approx(np.sqrt(np.mean((true - after.mean(axis=1) - distance) ** 2)))
        assert held.last == pytest.approx(np.sqrt(np.mean((true - before[-1, 2]) ** 2)))
        apart = before[:, [2]] - before[:, others]
        nearest = apart.var(axis=0).argmin()
        parallel = after[:, nearest] + apart[:, nearest].mean()
        assert held.nearest == pytest.approx(np.sqrt(np.mean((true - parallel) ** 2)))

    def test_missing_readings_and_missing_estimates_are_left_out(self, data, tmp_path):
        celsius = field()
        celsius[165:170] = np.nan
        celsius[::7, 1] = np.nan
        data = write(data, celsius)
        result = score(simulated(prepare(STUDY, data, tmp_path / "out"), steps=20), data)
        assert result.rounds == 20
        assert result.held_out[0].rounds == 15
        assert all(np.isfinite(row.swarm) for row in result.next_reading)

    def test_it_can_be_shown_and_written_as_json(self, data, tmp_path):
        result = score(simulated(prepare(STUDY, data, tmp_path / "out"), steps=1), data)
        told = json.loads(json.dumps(result.facts(), allow_nan=False))
        assert [row["mote"] for row in told["held_out"]] == [3]
        assert told["next_reading"][0]["swarm"] is None  # one round: nothing to predict the next one of
        text = StringIO()
        show_score(Console(file=text, width=120), result)
        assert "held out" in text.getvalue()

    def test_a_run_of_something_else_is_refused(self, data, tmp_path):
        recording = simulated(prepare(STUDY, data, tmp_path / "out"), steps=2)
        with pytest.raises(InputError, match="its model is not the one that is identified from these data"):
            score(recording, write(tmp_path / "other", field(seed=2)))
        four = load_scenario(ROOT / "examples" / "four_sensor.toml")
        with RecordingWriter(tmp_path / "4.mcap", scenario_toml=four.to_toml(), run="r", method="m", seed=1):
            pass
        with pytest.raises(InputError, match="is not a run of a scenario that `zfusion library prepare` made"):
            score(tmp_path / "4.mcap", data)
        with pytest.raises(RecordingError, match="cannot be read"):
            score(tmp_path / "none.mcap", data)


@pytest.mark.skipif(not DATA.exists(), reason=f"the library's data are not there: {DATA}")
class TestOnTheData:
    def test_the_data_are_what_the_page_says(self):
        readings = load_readings(DATA)
        assert len(readings.motes) == 19
        assert readings.rounds == 1595
        assert np.isnan(readings.celsius).mean(axis=0).max() < 0.06
        assert len(load_links(DATA)) == 19 * 18

    def test_the_example_beats_the_baselines(self, tmp_path):
        study = load_study(ROOT / "examples" / "library.toml")
        path = prepare(study, DATA, tmp_path)
        scenario = load_scenario(path)
        assert len(scenario.ids) == 19 - len(study.held_out)
        assert all(len(scenario.network.neighbours(i)) > 1 for i in scenario.ids)
        result = score(simulated(path, steps=30), DATA)
        held = {name: together(result.held_out, name) for name in ("swarm", "alone", "mean", "corrected_mean", "last")}
        assert held["swarm"] < 0.6 * min(held["mean"], held["corrected_mean"], held["last"])
        assert held["swarm"] < held["alone"]
        ahead = {name: together(result.next_reading, name) for name in ("swarm", "alone", "last", "mean")}
        assert ahead["swarm"] < ahead["alone"] < ahead["last"] < ahead["mean"]


def together(rows, name: str) -> float:
    """Root mean square over motes."""
    return float(np.sqrt(np.mean([getattr(row, name) ** 2 for row in rows])))
