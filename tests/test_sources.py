from pathlib import Path

import numpy as np
import pytest
import tomli_w

from zfusion.drivers.callables import NOT_FINITE, as_measurement
from zfusion.drivers.sources import open_source, open_sources
from zfusion.errors import InputError, RunError, ScenarioError
from zfusion.keys import stage_key, truth_key
from zfusion.messages import encode
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.schema.run import CsvSource
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import MEASUREMENT, TRUTH, TRUTH_SENDER, Message


def scenario_of(source, directory: Path, ny: int = 1, **changes) -> Scenario:
    H = [[1.0, 0.0], [0.0, 1.0]][:ny]
    document = {
        "network": {"generator": "complete"},
        "system": {
            "F": {"diagonal": [0.9, 0.8]},
            "Q": {"diagonal": [1, 1]},
            "initial_covariance": {"diagonal": [1, 1]},
        },
        "sensors": [{"ids": [1, 2], "H": H, "R": {"diagonal": [1.0] * ny}}],
        "source": source,
        **changes,
    }
    return Scenario.from_toml(tomli_w.dumps(document), directory=directory)


def readings(source, steps) -> list:
    return [None if (y := source.read(k, k * 10)) is None else y.tolist() for k in steps]


class TestSimulation:
    def test_gives_what_the_model_draws_and_the_truth(self, tmp_path):
        scenario = scenario_of({"kind": "simulation"}, tmp_path, seed=5)
        path = SamplePath(scenario.system(), 5)
        for node, source in open_sources(scenario, [1, 2]).items():
            for k in (1, 2, 300):
                np.testing.assert_array_equal(source.read(k, 0), path.measurement(node, k))
                np.testing.assert_array_equal(source.truth(k), path.truth(k))
            source.close()

    def test_sensors_opened_together_or_alone_measure_the_same(self, tmp_path):
        scenario = scenario_of({"kind": "simulation"}, tmp_path)
        together = open_sources(scenario, [1, 2])[2]
        assert readings(together, range(1, 9)) == readings(open_source(scenario, 2), range(1, 9))

    def test_an_unknown_sensor_is_refused(self, tmp_path):
        with pytest.raises(KeyError):
            open_source(scenario_of({"kind": "simulation"}, tmp_path), 9)


class TestCsv:
    def open(self, tmp_path, text, node=1, ny=1, **source):
        (tmp_path / "y.csv").write_text(text)
        spec = {"kind": "csv", "file": "y.csv", "columns": ["y"], **source}
        return open_source(scenario_of(spec, tmp_path, ny), node)

    def test_rows_are_steps(self, tmp_path):
        source = self.open(tmp_path, "t,y\n0,1.5\n0,\n0,nan\n0, 2 \n")
        assert readings(source, range(1, 6)) == [[1.5], None, None, [2.0], None]
        assert source.truth(1) is None
        assert not source.counters

    def test_a_row_may_be_step_one(self, tmp_path):
        assert readings(self.open(tmp_path, "y\n1\n2\n3\n", first_step=3), [1, 2]) == [[3.0], None]

    def test_a_column_may_hold_the_step(self, tmp_path):
        source = self.open(tmp_path, "n,y\n12,3\n9,0\n10,1\n", step_column="n", first_step=10)
        assert readings(source, range(1, 5)) == [[1.0], None, [3.0], None]

    def test_a_column_may_hold_the_sensor(self, tmp_path):
        text = "n,mote,y\n1,2,5\n1,1,6\n2,2,7\n"
        columns = {"id_column": "mote", "step_column": "n"}
        assert readings(self.open(tmp_path, text, node=1, **columns), [1, 2]) == [[6.0], None]
        assert readings(self.open(tmp_path, text, node=2, **columns), [1, 2]) == [[5.0], [7.0]]

    def test_without_a_step_column_a_sensors_rows_are_counted(self, tmp_path):
        assert readings(self.open(tmp_path, "mote,y\n2,5\n1,6\n2,7\n", node=2, id_column="mote"), [1, 2]) == [
            [5.0],
            [7.0],
        ]

    def test_every_component_has_a_column_and_a_row_with_a_gap_is_no_reading(self, tmp_path):
        source = self.open(tmp_path, "a,b\n1,2\n3,\n5,6\n", ny=2, columns=["b", "a"])
        assert readings(source, [1, 2, 3]) == [[2.0, 1.0], None, [6.0, 5.0]]

    def test_names_may_hold_the_sensors_id(self, tmp_path):
        (tmp_path / "of_2.csv").write_text("y2\n4\n")
        spec = {"kind": "csv", "file": "of_{id}.csv", "columns": ["y{id}"]}
        assert readings(open_source(scenario_of(spec, tmp_path), 2), [1]) == [[4.0]]

    def test_times_fall_into_steps_and_the_last_row_of_a_step_counts(self, tmp_path):
        text = "ms,y\n990,0\n1000,1\n1499,2\n1500,3\n2600,4\n2700,\n"
        source = self.open(tmp_path, text, time_column="ms", first_time=1000, time_step=500)
        assert readings(source, range(1, 6)) == [[2.0], [3.0], None, [4.0], None]

    def test_a_byte_order_mark_is_no_part_of_a_name(self, tmp_path):
        assert readings(self.open(tmp_path, "\ufeffy\n1\n"), [1]) == [[1.0]]

    @pytest.mark.parametrize(
        ("text", "source", "told"),
        [
            ("y\n1\nwarm\n", {}, r"y\.csv, line 3, column y: expected a number or nothing, is 'warm'"),
            ("y\ninf\n", {}, r"line 2, column y: expected a finite number"),
            ("x\n1\n", {}, r"y\.csv: has no column 'y'; it has x"),
            ("", {}, r"has no column 'y'; it has nothing"),
            ("n,y\n1.5,2\n", {"step_column": "n"}, r"line 2, column n: expected a whole number, is '1\.5'"),
            ("n,y\n1,2\n1,3\n", {"step_column": "n"}, r"line 3: a second row for step 1, after line 2"),
            ("n,y\n,2\n", {"time_column": "n", "first_time": 0, "time_step": 1}, r"line 2, column n: expected a time"),
        ],
    )
    def test_what_is_wrong_is_named_with_its_place(self, tmp_path, text, source, told):
        with pytest.raises(InputError, match=r"^source of sensor 1: .*" + told):
            self.open(tmp_path, text, **source)

    def test_a_file_that_is_missing_or_no_text_is_named(self, tmp_path):
        spec = {"kind": "csv", "file": "none.csv", "columns": ["y"]}
        with pytest.raises(InputError, match=r"none\.csv: cannot be read: No such file"):
            open_source(scenario_of(spec, tmp_path), 1)
        (tmp_path / "none.csv").write_bytes(b"y\n\xff\xfe\n")
        with pytest.raises(InputError, match=r"none\.csv: is not a CSV file in UTF-8"):
            open_source(scenario_of(spec, tmp_path), 1)

    @pytest.mark.parametrize(
        ("keys", "expected"),
        [
            ({"time_column": "t", "time_step": 1}, "expected time_column, first_time and time_step together"),
            ({"first_time": 3}, "expected time_column, first_time and time_step together"),
            (
                {"time_column": "t", "time_step": 1, "first_time": 0, "first_step": 2},
                "expected either step_column and first_step or time_column",
            ),
            ({"time_column": "t", "time_step": 0, "first_time": 0}, r"time_step: expected a number > 0"),
        ],
    )
    def test_a_scenario_says_either_steps_or_times(self, keys, expected):
        with pytest.raises(ScenarioError, match=expected):
            CsvSource(file="f", columns=("y",), **keys)


class TestMcap:
    def record(self, path, messages, scenario_toml="") -> dict:
        with RecordingWriter(path, scenario_toml=scenario_toml, run="r", method="m", seed=1) as writer:
            for topic, data in messages:
                writer.write(topic, data, 1)
        return {"kind": "mcap", "recording": path.name}

    def measured(self, node, step, y, seq=0) -> tuple[str, bytes]:
        fields = {"y": None if y is None else np.array(y, float)}
        return stage_key("r", node, "measurement"), encode(Message(node, step, MEASUREMENT.name, seq, 1, 0, fields))

    def true(self, step, x) -> tuple[str, bytes]:
        return truth_key("r"), encode(Message(TRUTH_SENDER, step, TRUTH.name, 0, 1, 0, {"x": np.array(x, float)}))

    def test_gives_the_recorded_measurements_and_the_truth(self, tmp_path):
        odd = 0.1 + 0.2
        messages = [
            self.measured(1, 1, [odd]),
            self.measured(2, 1, [7]),
            self.true(1, [3, 4]),
            self.measured(1, 2, None),
            self.measured(1, 4, [2]),
        ]
        source = open_source(scenario_of(self.record(tmp_path / "a.mcap", messages), tmp_path), 1)
        assert readings(source, range(1, 6)) == [[odd], None, None, [2.0], None]
        assert source.truth(1).tolist() == [3.0, 4.0]
        assert source.truth(2) is None
        assert not source.counters

    def test_what_a_neighbour_would_have_refused_is_counted_and_the_first_of_a_step_counts(self, tmp_path):
        key, _ = self.measured(1, 1, [0])
        messages = [self.measured(1, 1, [1]), (key, b"garbage"), self.measured(1, 1, [9]), self.measured(1, 2, [1, 2])]
        source = open_source(scenario_of(self.record(tmp_path / "a.mcap", messages), tmp_path), 1)
        assert readings(source, [1, 2]) == [[1.0], None]
        assert source.counters["refused"] == 2

    def test_the_truth_of_another_state_is_not_ours(self, tmp_path):
        messages = [self.measured(1, 1, [1]), self.true(1, [1, 2, 3])]
        source = open_source(scenario_of(self.record(tmp_path / "a.mcap", messages), tmp_path), 1)
        assert source.truth(1) is None

    def test_a_recording_without_the_sensor_or_of_another_kind_of_sensor_is_refused(self, tmp_path):
        record = self.record(tmp_path / "a.mcap", [self.measured(2, 1, [1, 2])])
        with pytest.raises(InputError, match=r"a\.mcap: has no measurements of sensor 1: there is no topic zfusion/r/"):
            open_source(scenario_of(record, tmp_path), 1)
        with pytest.raises(InputError, match=r"can be a measurement of sensor 2: wrong_shape"):
            open_source(scenario_of(record, tmp_path), 2)
        with pytest.raises(InputError, match=r"b\.mcap: cannot be read"):
            open_source(scenario_of({"kind": "mcap", "recording": "b.mcap"}, tmp_path), 1)


class TestPython:
    def open(self, tmp_path, code, node=1, ny=1, function="mine.py:read", **options):
        (tmp_path / "mine.py").write_text(code)
        spec = {"kind": "python", "function": function, "options": options}
        return open_source(scenario_of(spec, tmp_path, ny), node)

    def test_is_called_with_step_time_sensor_and_options(self, tmp_path):
        code = "def read(step, t_ns, node, *, a):\n    return step + t_ns + 1000 * node + a"
        assert readings(self.open(tmp_path, code, node=2, a=0.5), [1, 2]) == [[2011.5], [2022.5]]

    @pytest.mark.parametrize(
        ("value", "read"),
        [("None", None), ("[1, 2.5]", [1.0, 2.5]), ("(True, 0)", [1.0, 0.0]), ("array('d', [3, 4])", [3.0, 4.0])],
    )
    def test_may_return_any_sequence_of_numbers_or_none(self, tmp_path, value, read):
        code = f"from array import array\ndef read(step, t_ns, node): return {value}"
        source = self.open(tmp_path, code, ny=2)
        assert readings(source, [1]) == [read]
        assert source.truth(1) is None
        source.close()

    def test_what_is_not_finite_is_no_reading_and_is_counted(self, tmp_path):
        code = "def read(step, t_ns, node): return [float('nan'), float('inf'), 5][step - 1]"
        source = self.open(tmp_path, code)
        assert readings(source, [1, 2, 3]) == [None, None, [5.0]]
        assert source.counters[NOT_FINITE] == 2

    def test_a_buffer_that_is_used_again_does_not_change_what_was_read(self, tmp_path):
        code = "import numpy\nkept = numpy.zeros(1)\ndef read(step, t_ns, node):\n    kept[0] = step\n    return kept"
        source = self.open(tmp_path, code)
        first = source.read(1, 0)
        source.read(2, 0)
        assert first.tolist() == [1.0]

    def test_each_sensor_has_the_variables_of_the_file_to_itself(self, tmp_path):
        code = "calls = []\ndef read(step, t_ns, node):\n    calls.append(step)\n    return len(calls)"
        (tmp_path / "mine.py").write_text(code)
        spec = {"kind": "python", "function": "mine.py:read"}
        sources = open_sources(scenario_of(spec, tmp_path), [1, 2])
        assert readings(sources[1], [1, 2]) == [[1.0], [2.0]]
        assert readings(sources[2], [1]) == [[1.0]]

    def test_a_module_that_can_be_imported_will_do(self, tmp_path, monkeypatch):
        (tmp_path / "zfusion_test_sensor.py").write_text("def read(step, t_ns, node): return 1")
        monkeypatch.syspath_prepend(str(tmp_path))
        spec = {"kind": "python", "function": "zfusion_test_sensor:read"}
        assert readings(open_source(scenario_of(spec, tmp_path), 1), [1]) == [[1.0]]

    def test_a_failure_names_function_sensor_step_and_line(self, tmp_path):
        code = "def inner(step):\n    return 1 / (2 - step)\ndef read(step, t_ns, node):\n    return inner(step)"
        source = self.open(tmp_path, code)
        assert readings(source, [1]) == [[1.0]]
        told = r"mine\.py:read, sensor 1, step 2: ZeroDivisionError: division by zero \(mine\.py, line 2\)"
        with pytest.raises(RunError, match=told):
            source.read(2, 0)

    @pytest.mark.parametrize("value", ["'3.5'", "[1, 2, 3]", "[[1, 2]]", "[1, [2]]", "1", "{}", "1j"])
    def test_what_is_no_measurement_is_refused(self, tmp_path, value):
        source = self.open(tmp_path, f"def read(step, t_ns, node): return {value}", ny=2)
        with pytest.raises(RunError, match=r"mine\.py:read, sensor 1, step 3: expected 2 numbers or None, not"):
            source.read(3, 0)

    @pytest.mark.parametrize(
        ("code", "function", "told"),
        [
            ("def read(step, t_ns, node): pass", "mine.py:rad", r"mine\.py has no 'rad'"),
            ("read = 3", "mine.py:read", r"something else than a function under the name 'read'"),
            ("def read(step): pass", "mine.py:read", r"cannot be called as read\(step, t_ns, node, \*\*options\)"),
            ("def read(step, t_ns, node, x): pass", "mine.py:read", r"missing a required argument: 'x'"),
            ("import nothing_of_that_name", "mine.py:read", r"ModuleNotFoundError: .* \(mine\.py, line 1\)"),
            ("def read(:", "mine.py:read", r"SyntaxError"),
            ("", "other.py:read", r"there is no file .*other\.py"),
            ("", "no_such_module_anywhere:read", r"ModuleNotFoundError"),
        ],
    )
    def test_a_function_that_cannot_be_had_is_refused_before_the_run(self, tmp_path, code, function, told):
        with pytest.raises(InputError, match=told):
            self.open(tmp_path, code, function=function)

    def test_options_that_the_function_does_not_take_are_named(self, tmp_path):
        with pytest.raises(InputError, match=r"with the options scale: .*'scale'"):
            self.open(tmp_path, "def read(step, t_ns, node): pass", scale=2)


def test_a_number_may_stand_for_one_component():
    assert as_measurement(3, 1).tolist() == as_measurement([3.0], 1).tolist() == [3.0]
    assert as_measurement(np.float32(0.5), 1).dtype == np.float64


def test_a_zenoh_key_needs_the_live_world(tmp_path):
    scenario = scenario_of({"kind": "zenoh", "key": "lab/{id}"}, tmp_path)
    with pytest.raises(InputError, match="'lab/2' can be had in a live run only"):
        open_source(scenario, 2)
    asked = []
    subscribed = open_source(scenario_of({"kind": "simulation"}, tmp_path), 1)
    assert open_source(scenario, 2, lambda *told: asked.append(told) or subscribed) is subscribed
    assert asked == [(2, "lab/2", 1)]


def test_where_one_source_cannot_be_opened_the_others_are_closed(tmp_path):
    closed = []

    class Held:
        def close(self):
            closed.append(True)

    (tmp_path / "1.csv").write_text("y\n1\n")
    scenario = scenario_of(
        {"kind": "csv", "file": "{id}.csv", "columns": ["y"]},
        tmp_path,
        sensors=[
            {"id": 1, "H": [[1, 0]], "R": 1, "source": {"kind": "zenoh", "key": "a"}},
            {"id": 2, "H": [[1, 0]], "R": 1},
        ],
    )
    with pytest.raises(InputError, match="source of sensor 2"):
        open_sources(scenario, [1, 2], lambda *_: Held())
    assert closed == [True]
