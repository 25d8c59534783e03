import json
import re
import tomllib
from copy import deepcopy
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from zfusion.errors import ScenarioError
from zfusion.methods.check import deadline_ns
from zfusion.model import schema
from zfusion.model.distributions import Normal, Uniform
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.schema import (
    CsvSource,
    MethodSpec,
    NoiseSpec,
    PythonSource,
    RingGraph,
    SensorSpec,
    SequenceSpec,
    SimulationSource,
    SystemSpec,
    TapSpec,
    TermSpec,
    TermsSpec,
    TimingSpec,
    WhiteSpec,
)
from zfusion.model.schema.run import DEFAULT_RATE_HZ

EXAMPLES = Path(__file__).parent.parent / "examples"
DOCS = Path(__file__).parent.parent / "docs"

PLAIN: dict = {
    "network": {"generator": "complete"},
    "system": {"F": [[1, 1], [0, 1]], "Q": [[0.1, 0], [0, 0.2]], "initial_covariance": {"diagonal": [1, 2]}},
    "sensors": [{"id": 1, "H": [[1, 0]], "R": 0.5}, {"id": 2, "H": [[1, 0], [0, 1]], "R": [[2, 1], [1, 2]]}],
}


def scenario_of(**changes) -> Scenario:
    return Scenario.model_validate({**deepcopy(PLAIN), **changes})


def changed(path: str, value) -> dict:
    """PLAIN with `value` at a path like "sensors.0.H"."""
    document = deepcopy(PLAIN)
    *parents, last = [int(key) if key.isdecimal() else key for key in path.split(".")]
    place = document
    for key in parents:
        place = place.setdefault(key, {}) if isinstance(place, dict) else place[key]
    place[last] = value
    return document


def faults(document) -> dict[str, str]:
    """Field and expectation of every problem."""
    with pytest.raises(ScenarioError) as error:
        Scenario.model_validate(document)
    assert len({problem.field for problem in error.value.problems}) == len(error.value.problems)
    return {problem.field: problem.expected for problem in error.value.problems}


# --- what a scenario means ---


def test_the_papers_example_has_the_papers_statistics():
    scenario = load_scenario(EXAMPLES / "four_sensor.toml")
    system = scenario.system()
    c = np.array([1, 0.5, 0.75, 0.85])
    assert scenario.ids == (1, 2, 3, 4)
    noise = system.noise.covariances(7, scenario.ids)
    for got, wanted in zip(
        noise,
        (0.36, 0.18, np.outer(c, c), 0.5 * np.outer(c, c), 0.3 * c, 0.6 * c, 0.3 * c),
        strict=True,
    ):
        np.testing.assert_allclose(got, np.reshape(wanted, got.shape), rtol=1e-14)
    F = system.F.at(0)
    assert F.mean == pytest.approx(0.95)
    assert F.second_moment(np.ones((1, 1))) == pytest.approx(0.04)
    means = [sensor.H.at(1).mean.item() for sensor in system.sensors]
    assert means == pytest.approx([0.82 * 0.5, 0.75 * 0.65, 0.74 * 0.7, 0.75 * 0.7])
    variances = [sensor.H.at(1).second_moment(np.ones((1, 1))).item() for sensor in system.sensors]
    two, four = 0.1 * 0 + 0.5 * 0.25 + 0.4 - 0.65**2, 0.7 * (0.75**2 + 0.95**2) - (0.7 * 0.75) ** 2
    assert variances == pytest.approx([0.82**2 * 0.16 / 12, 0.75**2 * two, 0.74**2 * 0.21, four])
    assert scenario.network.neighbours(2) == (2, 3, 4)
    assert scenario.truth_known


def test_the_tracking_example_has_sensors_of_three_sizes_on_a_connected_graph():
    scenario = load_scenario(EXAMPLES / "tracking.toml")
    system = scenario.system()
    assert system.nx == 4
    assert {sensor.ny for sensor in system.sensors} == {1, 2, 4}
    assert system.initial_mean.tolist() == [1000, -500, 10, 5]
    reached, frontier = {1}, [1]
    while frontier:
        new = set(scenario.network.neighbours(frontier.pop())) - reached
        reached |= new
        frontier += new
    assert reached == set(scenario.ids)


def test_defaults():
    scenario = scenario_of()
    assert (scenario.seed, scenario.steps, scenario.method.name) == (0, 100, "two_stage")
    assert scenario.timing.period_ns == 100_000_000
    assert deadline_ns(scenario, "measurement") == 45_000_000
    assert deadline_ns(scenario, "intermediate") == 90_000_000
    assert scenario.timing.timeout_ns == 5_000_000_000
    assert scenario.system().initial_mean.tolist() == [0, 0]
    assert [scenario.endpoint(i) for i in (1, 2)] == ["tcp/127.0.0.1:7450", "tcp/127.0.0.1:7451"]
    assert scenario.recording.enabled


def test_moving_averages_and_their_covariances_are_the_same_noise():
    c = {1: [[1.0]], 2: [[0.5], [0.25]]}
    white = {"noise": [{"source": "e", "lag": 0, "matrix": [[2], [1]]}]}
    system = {"F": [[1, 1], [0, 1]], "initial_covariance": {"diagonal": [1, 1]}, **white}
    taps = scenario_of(
        system={**system, "Q": [[0.1, 0], [0, 0.2]]},
        sensors=[
            {**sensor, "noise": [{"source": "e", "lag": lag, "matrix": c[sensor["id"]]} for lag in (-1, 0)]}
            for sensor in PLAIN["sensors"]
        ],
        noise={"white": {"e": {"covariance": 0.5}}},
    )
    wanted = taps.system().noise.covariances(5, (1, 2))
    stacked = np.array([[1], [0.5], [0.25]])
    np.testing.assert_allclose(wanted.R, stacked @ stacked.T + np.array([[0.5, 0, 0], [0, 2, 1], [0, 1, 2]]))
    names = ("R", "R1", "S0", "S1")
    whole = scenario_of(
        system={**PLAIN["system"], "Q": wanted.Q.tolist()},
        sensors=[{"id": i, "H": sensor["H"]} for i, sensor in enumerate(PLAIN["sensors"], 1)],
        noise={name: getattr(wanted, name).tolist() for name in names},
    )
    blocks = scenario_of(
        system={**PLAIN["system"], "Q": wanted.Q.tolist()},
        sensors=[
            {"id": 1, "H": [[1, 0]], "R": wanted.R[:1, :1].tolist()},
            {"id": 2, "H": [[1, 0], [0, 1]], "R": wanted.R[1:, 1:].tolist()},
        ],
        noise={
            "R": [{"sensors": [2, 1], "value": wanted.R[1:, :1].tolist()}],
            "R1": [
                {"sensors": [i, j], "value": wanted.R1[rows[i], rows[j]].tolist()}
                for rows in [{1: slice(0, 1), 2: slice(1, 3)}]
                for i in rows
                for j in rows
            ],
            "S0": [
                {"sensor": 1, "value": wanted.S0[:, :1].tolist()},
                {"sensor": 2, "value": wanted.S0[:, 1:].tolist()},
            ],
            "S1": [
                {"sensor": 1, "value": wanted.S1[:, :1].tolist()},
                {"sensor": 2, "value": wanted.S1[:, 1:].tolist()},
            ],
        },
    )
    for scenario in (whole, blocks):
        for got, want in zip(scenario.system().noise.covariances(5, (1, 2)), wanted, strict=True):
            np.testing.assert_allclose(got, want, atol=1e-15)


def test_a_sequence_of_the_system_begins_at_step_0_and_one_of_a_sensor_at_step_1():
    def sequence(*values, after="cycle"):
        return {"sequence": list(values), "after": after}

    document = {
        "network": {"generator": "line"},
        "system": {"F": sequence(1, 2, 3), "Q": sequence(4, 5, 6), "initial_covariance": 1},
        "sensors": [{"id": 1, "H": sequence(7, 8, 9), "R": sequence(10, 11, 12)}],
    }
    system = Scenario.model_validate(document).system()
    assert [system.F.at(k).mean.item() for k in range(4)] == [1, 2, 3, 1]
    assert [system.noise.covariances(k, (1,)).Q.item() for k in range(4)] == [4, 5, 6, 4]
    assert [system.sensors[0].H.at(k).mean.item() for k in range(1, 5)] == [7, 8, 9, 7]
    assert [system.noise.covariances(k, (1,)).R.item() for k in range(1, 5)] == [10, 11, 12, 10]

    document["sensors"][0] |= {
        "R": sequence(4, 9, after="hold"),
        "noise": [{"source": "e", "matrix": sequence(1, 2, after="hold")}],
    }
    document["noise"] = {"white": {"e": {"covariance": 1}}}
    noise = Scenario.model_validate(document).system().noise
    assert [noise.covariances(k, (1,)).R.item() for k in (1, 2, 3, 9)] == pytest.approx([5, 13, 13, 13])


def test_many_sensors_that_are_alike_are_a_few_lines():
    sensors = [{"count": 62, "H": [[1, 0]], "R": 1}, {"ids": [100, 0], "H": [[0, 1]], "R": 2}]
    scenario = scenario_of(sensors=sensors, network={"generator": "random_regular", "degree": 6})
    assert scenario.ids == (0, *range(1, 63), 100)
    assert scenario.system().by_id[100].H.at(1).mean.tolist() == [[0, 1]]
    assert len(scenario.network.neighbours(100)) == 7
    assert scenario_of(sensors=[{"count": 2, "first_id": 5, "H": [[1, 0]], "R": 1}]).ids == (5, 6)


@pytest.mark.parametrize(
    ("network", "neighbours_of_2"),
    [
        ({"matrix": [[1, 1], [0, 0.5]]}, (2,)),
        ({"matrix": [[0.5, 0], [1, 1]], "ids": [2, 1]}, (2,)),
        ({"edges": [[1, 2]]}, (1, 2)),
        ({"edges": [[2, 1]]}, (2,)),
        ({"edges": [[2, 1]], "undirected": True}, (1, 2)),
        ({"edges": []}, (2,)),
        ({"generator": "complete"}, (1, 2)),
        ({"generator": "ring", "directed": True, "reach": 2}, (1, 2)),
        ({"generator": "line", "directed": True}, (1, 2)),
        ({"generator": "star", "hub": 2}, (1, 2)),
        ({"generator": "grid", "columns": 1}, (1, 2)),
        ({"generator": "random_geometric", "radius": 2.0, "seed": 1}, (1, 2)),
        ({"generator": "random_regular", "degree": 0}, (2,)),
    ],
)
def test_every_form_of_a_network(network, neighbours_of_2):
    scenario = scenario_of(network=network)
    assert scenario.network.neighbours(2) == neighbours_of_2
    assert Scenario.from_toml(scenario.to_toml()) == scenario


def test_ids_may_be_names_and_keys_of_tables_become_ids():
    names = [{**sensor, "id": name} for sensor, name in zip(PLAIN["sensors"], ("b", "a-1"), strict=True)]
    scenario = scenario_of(
        sensors=names,
        network={"matrix": [[1, 0], [1, 1]], "ids": ["b", "a-1"]},
        transport={"endpoints": {"b": "tcp/10.0.0.1:7447"}},
    )
    assert scenario.ids == ("a-1", "b")
    assert scenario.network.neighbours("a-1") == ("a-1", "b")
    assert scenario.endpoint("b") == "tcp/10.0.0.1:7447"
    assert scenario.endpoint("a-1") == "tcp/127.0.0.1:7450"
    assert scenario.node_id("b") == "b"
    numbers = scenario_of(transport={"endpoints": {"2": "tcp/10.0.0.1:7447"}})
    assert numbers.endpoint(2) == "tcp/10.0.0.1:7447"
    assert numbers.node_id("2") == 2
    assert Scenario.from_toml(numbers.to_toml()) == numbers


def test_sources_are_per_sensor_where_they_are_given_and_know_their_sensor(tmp_path):
    document = changed("source", {"kind": "csv", "file": "data/{id}.csv", "columns": ["y{id}"]})
    document["sensors"][1]["source"] = {"kind": "python", "function": "here/mine.py:read", "options": {"a": [1]}}
    text = Scenario.model_validate(document).to_toml()
    scenario = Scenario.from_toml(text, directory=tmp_path)
    assert scenario.source_of(1) == CsvSource(file=str(tmp_path / "data/1.csv"), columns=["y1"])
    mine = f"{tmp_path / 'here/mine.py'}:read"
    assert scenario.source_of(2) == PythonSource(function=mine, options={"a": [1]})
    assert not scenario.truth_known
    module = scenario_of(source={"kind": "python", "function": "package.module:read"})
    assert module.source_of(1) == PythonSource(function="package.module:read")


def test_anchored_paths_are_absolute_and_change_nothing_else(tmp_path):
    document = changed("source", {"kind": "mcap", "recording": "runs/a.mcap"})
    document |= {"transport": {"zenoh_config": "z.json5"}, "recording": {"directory": "out"}}
    document["sensors"][0]["source"] = {"kind": "csv", "file": "/data/x.csv", "columns": ["y"]}
    scenario = Scenario.from_toml(Scenario.model_validate(document).to_toml(), directory=tmp_path / "one")
    anchored = scenario.anchored()
    assert anchored.source.recording == str(tmp_path / "one/runs/a.mcap")
    assert anchored.transport.zenoh_config == str(tmp_path / "one/z.json5")
    assert anchored.recording.directory == str(tmp_path / "one/out")
    assert anchored.sensors[0].source.file == "/data/x.csv"
    assert anchored.fingerprint == scenario.fingerprint
    again = Scenario.from_toml(anchored.to_toml(), directory=tmp_path / "two")
    assert again == anchored
    assert [again.source_of(i) for i in (1, 2)] == [scenario.source_of(i) for i in (1, 2)]


def test_epoch_and_rate_in_nanoseconds():
    timing = scenario_of(timing={"rate_hz": 300, "epoch": "2026-01-31T13:00:00.5+01:00"}).timing
    assert timing.period_ns == 3_333_333
    assert timing.epoch_ns == 1_769_860_800_500_000_000
    free = scenario_of(timing={"free_run": True, "timeout_s": 0.25})
    assert free.timing.period_ns is None
    assert free.timing.timeout_ns == 250_000_000
    with pytest.raises(ValueError, match="free-running"):
        deadline_ns(free, "measurement")


# --- by hand, as text, changed ---


def by_hand() -> Scenario:
    return Scenario(
        name="by_hand",
        method=MethodSpec(name="local", options={"window": 3}),
        timing=TimingSpec(free_run=True, epoch=datetime(2026, 1, 1, tzinfo=UTC)),
        network=RingGraph(reach=2),
        system=SystemSpec(
            F=TermsSpec(
                terms=[TermSpec(matrix=0.9), TermSpec(matrix=0.1, variables=["a", "a"])], variables={"a": Normal(0, 2)}
            ),
            initial_covariance=np.eye(1),
            noise=[TapSpec(source="e", matrix=SequenceSpec(sequence=[1, 2], after="cycle"))],
        ),
        sensors=[
            SensorSpec(ids=["x", "y"], H=np.ones((2, 1)), R=[[1, 0], [0, 1]], source=SimulationSource()),
            SensorSpec(id="z", H=1, noise=[TapSpec(source="e")]),
        ],
        noise=NoiseSpec(white={"e": WhiteSpec(covariance=1, shape=Uniform(0, 1))}),
    )


def test_built_by_hand_is_the_same_as_read_from_a_file():
    scenario = by_hand()
    text = """
        name = "by_hand"
        method = { name = "local", options = { window = 3 } }
        timing = { free_run = true, epoch = 2026-01-01T00:00:00Z }
        network = { generator = "ring", reach = 2 }
        [system]
        F.terms = [{ matrix = 0.9 }, { matrix = 0.1, variables = ["a", "a"] }]
        F.variables.a = { distribution = "normal", mean = 0, variance = 2 }
        initial_covariance = 1
        noise = [{ source = "e", matrix = { sequence = [1, 2], after = "cycle" } }]
        [[sensors]]
        ids = ["x", "y"]
        H = [[1], [1]]
        R = { diagonal = [1, 1] }
        source.kind = "simulation"
        [[sensors]]
        id = "z"
        H = 1
        noise = [{ source = "e" }]
        [noise.white.e]
        covariance = 1
        shape = { distribution = "uniform", low = 0, high = 1 }
    """
    assert Scenario.from_toml(text) == scenario
    assert Scenario.from_toml(scenario.to_toml()) == scenario
    assert scenario.system().noise.covariances(1, ("x", "z")).Q.item() == pytest.approx(4)


def test_a_piece_built_by_hand_is_checked_too():
    with pytest.raises(ScenarioError, match="TapSpec: sorce: unknown key; did you mean 'source'"):
        TapSpec(sorce="e")
    with pytest.raises(ScenarioError, match=r"SensorSpec: H\.covariance: expected an array of shape \(2, 2\)"):
        SensorSpec(id=1, H={"mean": [[1, 2]], "covariance": 1}, R=1)
    with pytest.raises(ScenarioError) as error:
        Scenario(network=RingGraph(), system=PLAIN["system"], sensors=[SensorSpec(id=1, H=1, R=1)])
    assert [str(problem) for problem in error.value.problems] == [
        "sensors[0].H: expected a 1 x 2 matrix, not a 1 x 1 one (is 1.0)"
    ]


def test_a_scenario_cannot_be_changed():
    with pytest.raises(ValueError, match="frozen"):
        scenario_of().seed = 3


def test_what_was_set_is_written_and_nothing_else():
    written = tomllib.loads(scenario_of().to_toml())
    assert written.keys() == PLAIN.keys()
    assert written["sensors"][0] == {"id": 1, "H": [[1, 0]], "R": 0.5}
    assert "H = [[1.0, 0.0]]\n" in scenario_of(sensors=[{"count": 2, "H": [[1, 0]], "R": [[3]]}]).to_toml()


def test_texts_survive_whatever_is_in_them():
    odd = 'a "quote", a \\ and\n[\n  1,\n  2,\n]\ttab, [ "x",\n ] Ω'
    sensors = [{**PLAIN["sensors"][0], "source": {"kind": "csv", "file": odd, "columns": [odd + "  \u2028  ,"]}}]
    scenario = scenario_of(description=odd, source={"kind": "zenoh", "key": odd}, sensors=sensors)
    again = Scenario.from_toml(scenario.to_toml())
    assert again.description == odd
    assert again == scenario


def test_overrides(tmp_path):
    path = tmp_path / "lab 7.toml"
    extra = {"method": {"name": "two_stage", "options": {"a": 1}}, "timing": {"rate_hz": 5, "timeout_s": 1}}
    path.write_text(scenario_of(**extra).to_toml())
    plain = load_scenario(path)
    assert plain.name == "lab_7"
    free = load_scenario(path, steps=7, seed=8, free_run=True, method="local")
    assert (free.steps, free.seed, free.method) == (7, 8, MethodSpec(name="local"))
    assert (free.timing.period_ns, free.timing.timeout_s) == (None, 1)
    assert free == plain.with_overrides(steps=7, seed=8, free_run=True, method="local")
    assert free.with_overrides(rate_hz=50).timing.period_ns == 20_000_000
    assert plain.with_overrides(method="two_stage").method.options == {"a": 1}
    assert plain.with_overrides(steps=None) == plain
    with pytest.raises(ScenarioError, match=r"lab 7\.toml: seed: expected a number >= 0 \(is -1\)"):
        plain.with_overrides(seed=-1)
    with pytest.raises(ScenarioError, match="timing: expected either rate_hz or free_run"):
        plain.with_overrides(rate_hz=3, free_run=True)


def test_relative_paths_are_relative_to_the_file(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(scenario_of(source={"kind": "mcap", "recording": "old/run.mcap"}).to_toml())
    assert load_scenario(path).source_of(1).recording == str(tmp_path / "old/run.mcap")
    assert load_scenario(path).with_overrides(seed=4).absolute("x") == tmp_path / "x"


# --- fingerprints ---


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "other", "description": "other", "steps": 7},
        {"transport": {"base_port": 8000, "mesh": "full"}, "recording": {"path": "x.mcap"}},
        {"network": {"matrix": [[1, 1], [1, 1]]}},
        {"network": {"edges": [[1, 2]], "undirected": True}},
        {"method": "two_stage", "timing": {"rate_hz": 10}, "source": {"kind": "simulation"}},
        {"sensors": list(reversed(PLAIN["sensors"]))},
        {"system": {**PLAIN["system"], "initial_covariance": [[1, 0], [0, 2]]}},
    ],
)
def test_what_does_not_matter_to_a_run_is_not_in_the_fingerprint(changes):
    assert scenario_of(**changes).fingerprint == scenario_of().fingerprint


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"method": "local"},
        {"timing": {"rate_hz": 11}},
        {"timing": {"deadlines": {"measurement": 0.4}}},
        {"network": {"edges": [[1, 2]]}},
        {"network": {"matrix": [[1, 1], [1, 2]]}},
        {"source": {"kind": "mcap", "recording": "a.mcap"}},
        {"system": {**PLAIN["system"], "initial_mean": [1, 0]}},
        {"sensors": [PLAIN["sensors"][0], {**PLAIN["sensors"][1], "id": 3}]},
        {"sensors": [{**PLAIN["sensors"][0], "R": 0.6}, PLAIN["sensors"][1]]},
        {"noise": {"Q1": [[0.01, 0], [0, 0]]}},
    ],
)
def test_what_matters_to_a_run_is_in_the_fingerprint(changes):
    assert scenario_of(**changes).fingerprint != scenario_of().fingerprint


def test_the_fingerprint_is_the_same_in_every_process():
    """Nodes compare it across machines: a changed value is a changed protocol, and needs another version in it."""
    fingerprint = load_scenario(EXAMPLES / "four_sensor.toml").fingerprint
    assert fingerprint == "a1a349fb3c5cb9acbc4270b1b665854c112c3292491f2cfcfc77af87e38ca1f7"


# --- what is wrong is said, where and how ---


@pytest.mark.parametrize(
    ("path", "value", "field", "expected"),
    [
        ("steps", 0, "steps", "expected a number >= 1"),
        ("steps", 1.5, "steps", "expected a whole number"),
        ("steps", True, "steps", "expected a whole number"),
        ("name", "a b", "name", "expected a name of letters"),
        ("sed", 1, "sed", "unknown key; did you mean 'seed'?"),
        ("zzz", 1, "zzz", "unknown key; expected one of description, faults, links, method, name"),
        ("sensors.0.h", 1, "sensors[0].h", "unknown key; did you mean 'H'?"),
        ("sensors.1.R", [[1, 0.5], [0.4, 1]], "sensors[1].R", "expected a symmetric matrix"),
        ("sensors.1.R", [[1, 2], [2, 1]], "sensors[1].R", "expected a positive semi-definite matrix"),
        ("sensors.0.R", -1, "sensors[0].R", "expected a variance >= 0"),
        ("sensors.0.R", [[1, 0], [0, 1]], "sensors[0].R", "expected a 1 x 1 matrix, not a 2 x 2 one"),
        ("sensors.0.R", None, "sensors[0].R", "required: the covariance of the measurement noise"),
        ("sensors.0.H", [[1, 0, 0]], "sensors[0].H", "expected a 1 x 2 matrix, not a 1 x 3 one"),
        ("sensors.0.H", [[1, 0], [1]], "sensors[0].H", "expected a number or a matrix"),
        ("sensors.0.H", [1, 0], "sensors[0].H", "expected a number or a matrix"),
        ("sensors.0.H", [["1", 0]], "sensors[0].H", "expected a number or a matrix"),
        ("sensors.0.H", [[float("nan"), 0]], "sensors[0].H", "expected a number or a matrix as a list of rows"),
        ("sensors.0.H", [[10**400, 0]], "sensors[0].H", "expected a number or a matrix as a list of rows"),
        ("sensors.0.H", {"term": []}, "sensors[0].H", "expected a number, a list of rows, or a table of"),
        ("sensors.0.H", {"terms": []}, "sensors[0].H.terms", "expected at least 1 item(s)"),
        ("sensors.0.H", {"mean": [[1, 0]]}, "sensors[0].H.covariance", "required"),
        ("sensors.0.H", {"mean": [[1, 0]], "covariance": 1}, "sensors[0].H.covariance", "expected an array"),
        ("sensors.0.H", {"sequence": [[[1, 0]]]}, "sensors[0].H.after", "required"),
        ("sensors.0.H", {"sequence": [], "after": "hold"}, "sensors[0].H.sequence", "expected at least 1"),
        (
            "sensors.0.H",
            {"sequence": [[[1, 0]], [[1]]], "after": "hold"},
            "sensors[0].H.sequence[1]",
            "expected a 1 x 2 matrix",
        ),
        ("sensors.0.id", 2, "sensors[1]", "expected each id once only"),
        ("sensors.0.id", "a", "sensors[1]", "expected ids that are all numbers or all names"),
        ("sensors.0.id", "a b", "sensors[0].id", "expected a whole number >= 0 or a name"),
        ("sensors.0.id", "7", "sensors[0].id", "expected an id that is a number to stand without quotes"),
        ("sensors.0.id", -1, "sensors[0].id", "expected a whole number >= 0 or a name"),
        ("sensors.0.ids", [5], "sensors[0]", "expected exactly one of id, ids and count, not id and ids"),
        ("sensors.0.first_id", 3, "sensors[0]", "expected first_id only beside count"),
        ("sensors", [], "sensors", "expected at least 1 item(s)"),
        ("sensors", {"id": 1}, "sensors", "expected a list"),
        ("system.F", [[1, 0]], "system.F", "expected a 1 x 1 matrix, not a 1 x 2 one"),
        ("system.Q", 1, "system.Q", "expected a 2 x 2 matrix, not a 1 x 1 one"),
        ("system.Q", None, "system.Q", "required: the covariance of the process noise"),
        ("system.initial_mean", [1], "system.initial_mean", "expected 2 numbers"),
        ("system.initial_covariance", 1, "system.initial_covariance", "expected a 2 x 2 matrix"),
        ("system", 1, "system", "expected a table"),
        ("method", 3, "method", "expected a table"),
        ("method.options", {"a": float("inf")}, "method.options", "expected text, finite numbers"),
        ("timing.rate_hz", 0, "timing.rate_hz", "expected a number > 0"),
        ("timing.rate_hz", "10", "timing.rate_hz", "expected a number"),
        ("timing.deadlines", {"measurement": 1.5}, "timing.deadlines.measurement", "expected a number <= 1"),
        ("timing.deadlines", {"measurement": 0.9}, "timing.deadlines", "expected the deadline of measurement before"),
        ("timing.epoch", "yesterday", "timing.epoch", "expected a date and time with its offset"),
        ("timing.epoch", datetime(2026, 1, 1), "timing.epoch", "expected a date and time with its offset"),
        ("timing", {"rate_hz": 1, "free_run": True}, "timing", "expected either rate_hz or free_run"),
        ("network", {}, "network", "expected one of matrix"),
        ("network", {"matrix": [[1, 1], [1, 0]]}, "network.matrix[1][1]", "expected a_ii > 0"),
        ("network", {"matrix": [[1, -1], [1, 1]]}, "network.matrix[0][1]", "expected 0 or a positive number"),
        ("network", {"matrix": [[1]]}, "network.matrix", "expected 2 x 2, a row and a column for each"),
        ("network", {"matrix": [[1, 1], [1, 1]], "ids": [1, 3]}, "network.ids", "expected the id of every sensor"),
        ("network", {"edges": [[1, 2], [2, 3]]}, "network.edges[1]", "there is no node 3"),
        ("network", {"edges": [[1, 2, 3]]}, "network.edges[0]", "expected at most 2 items"),
        ("network", {"edges": [[1, 1]]}, "network.edges[0]", "expected two different nodes"),
        ("network", {"edges": [], "undirectd": True}, "network.undirectd", "unknown key; did you mean 'undirected'?"),
        ("network", {"generator": "rings"}, "network.generator", "expected one of 'complete', 'ring'"),
        ("network", {"generator": "ring", "radius": 1.0}, "network.radius", "unknown key"),
        ("network", {"generator": "random_geometric"}, "network.radius", "required"),
        ("network", {"generator": "random_regular", "degree": 2}, "network", "no graph of 2 nodes has degree 2"),
        ("network", {"generator": "star", "hub": 9}, "network", "the hub 9 is not a node"),
        ("noise", {"white": {"e": {"covariance": 1}}}, "noise.white.e", "expected a white noise that some noise"),
        ("noise", {"white": {"a/b": {"covariance": 1}}}, "noise.white.a/b", "expected a name"),
        ("noise", {"R": [{"sensors": [1, 9], "value": 1}]}, "noise.R[0]", "expected the id of a sensor"),
        ("noise", {"R": [{"sensors": [1, 1], "value": 1}]}, "noise.R[0]", "expected two sensors"),
        ("noise", {"R": [{"sensors": [1, 2], "value": 1}]}, "noise.R[0].value", "expected a 1 x 2 matrix"),
        ("noise", {"S0": [{"sensor": 2, "value": 1}]}, "noise.S0[0].value", "expected a 2 x 2 matrix"),
        ("noise", {"S0": 1}, "noise.S0", "expected a 2 x 3 matrix"),
        ("noise", {"Q1": 1}, "noise.Q1", "expected a 2 x 2 matrix"),
        ("noise", {"Q1": [[5, 0], [0, 5]]}, "noise", "expected a positive semi-definite joint covariance of w"),
        ("source", {"kind": "cvs"}, "source.kind", "expected one of 'simulation', 'csv'"),
        ("source", {"file": "x"}, "source.kind", "required"),
        ("source", "csv", "source", "expected a table"),
        ("source", {"kind": "python", "function": "f"}, "source.function", "expected 'module:function'"),
        (
            "sensors.0.source",
            {"kind": "csv", "file": "f", "columns": ["a", "b"]},
            "sensors[0].source.columns",
            "expected 1",
        ),
        (
            "source",
            {"kind": "csv", "file": "f", "columns": ["a"], "time_column": "t", "first_time": 0},
            "source",
            "expected time_column, first_time and time_step together",
        ),
        (
            "source",
            {
                "kind": "csv",
                "file": "f",
                "columns": ["a"],
                "time_column": "t",
                "first_time": 0,
                "time_step": 1,
                "first_step": 2,
            },
            "source",
            "expected either step_column and first_step or time_column",
        ),
        ("transport.endpoints", {"9": "tcp/1.1.1.1:1"}, "transport.endpoints.9", "expected the id of a sensor"),
        ("transport.endpoints", {"1": "localhost"}, "transport.endpoints.1", "expected an endpoint like"),
        (
            "transport.endpoints",
            {"1": "tcp/a:1", "2": "tcp/a:1"},
            "transport.endpoints.2",
            "expected an endpoint of its own",
        ),
        ("transport.base_port", 65535, "transport.base_port", "expected at most 65534"),
        ("transport.mesh", "ful", "transport.mesh", "expected 'neighbours' or 'full'"),
        ("recording", {"path": "a", "directory": "b"}, "recording", "expected either path or directory"),
    ],
)
def test_each_mistake_is_named_with_its_place(path, value, field, expected):
    found = faults(changed(path, value))
    assert list(found) == [field]
    assert found[field].startswith(expected)


@pytest.mark.parametrize(
    ("law", "field", "expected"),
    [
        ({"distribution": "unifrom"}, "distribution", "expected one of normal, uniform"),
        ({"low": 1}, "distribution", "expected one of normal, uniform"),
        ({"distribution": "uniform", "low": 2, "high": 1}, "low", "expected a number <= high"),
        ({"distribution": "uniform", "low": 2}, "high", "required"),
        ({"distribution": "bernoulli", "p": 1.2}, "p", "expected a probability"),
        ({"distribution": "bernoulli", "p": 1, "q": 2}, "q", "unknown key; expected one of p"),
        ({"distribution": "normal", "variance": -1}, "variance", "expected a number >= 0"),
        (
            {"distribution": "discrete", "values": [1, 2], "probabilities": [0.5, 0.6]},
            "probabilities",
            "expected numbers >= 0",
        ),
        (
            {"distribution": "discrete", "values": ["1", "2"], "probabilities": [0.5, 0.5]},
            "values",
            "expected a number or a list",
        ),
    ],
)
def test_each_mistake_in_a_distribution_is_named_with_its_place(law, field, expected):
    H = {"terms": [{"matrix": [[1, 0]], "variables": ["x"]}], "variables": {"x": law}}
    found = faults(changed("sensors.0.H", H))
    assert list(found) == [f"sensors[0].H.variables.x.{field}"]
    assert next(iter(found.values())).startswith(expected)


def test_mistakes_in_terms():
    x = {"x": {"distribution": "normal"}}
    one, other = {"matrix": [[1, 0]], "variables": ["y"]}, {"matrix": [[1, 0, 0]], "variables": ["x"]}
    assert faults(changed("sensors.0.H", {"terms": [one], "variables": x}))["sensors[0].H.terms[0].variables"]
    two = {"terms": [{"matrix": [[1, 0]]}, other], "variables": x}
    assert faults(changed("sensors.0.H", two))["sensors[0].H.terms[1].matrix"]
    unused = {"terms": [{"matrix": [[1, 0]]}], "variables": x}
    assert "occur in a term" in faults(changed("sensors.0.H", unused))["sensors[0].H.variables"]


def test_mistakes_in_taps():
    def taps(*given, covariance=1):
        document = changed("sensors.0.noise", list(given))
        document["noise"] = {"white": {"e": {"covariance": covariance}}}
        return faults(document)

    assert "e" in taps({"source": "f"})["sensors[0].noise[0].source"]
    assert "1 x 1" in taps({"source": "e", "matrix": [[1, 2]]})["sensors[0].noise[0].matrix"]
    of_two = taps({"source": "e"}, covariance={"diagonal": [1, 1]})
    assert "required here: a 1 x 2" in of_two["sensors[0].noise[0].matrix"]
    assert "whole number" in taps({"source": "e", "lag": 0.5})["sensors[0].noise[0].lag"]
    far = taps({"source": "e", "lag": 0}, {"source": "e", "lag": 5})
    assert "no such correlation" in far["noise"]


def test_one_description_of_the_noises_only():
    document = changed("noise", {"white": {"e": {"covariance": 1}}, "Q1": [[0, 0], [0, 0]]})
    document["sensors"][0]["noise"] = [{"source": "e"}]
    assert "not both" in faults(document)["noise"]
    twice = changed("noise", {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]})
    assert faults(twice).keys() == {"sensors[0].R", "sensors[1].R"}


def test_matrices_over_unsorted_sensors_must_say_what_is_what():
    document = changed("sensors", list(reversed(PLAIN["sensors"])))
    document["network"] = {"matrix": [[1, 1], [0, 1]]}
    document["noise"] = {"R1": [[0, 0, 0]] * 3}
    found = faults(document)
    assert "not listed in the order of their ids" in found["network.ids"]
    assert "not listed in the order of their ids" in found["noise.R1"]


def test_all_mistakes_are_told_at_once():
    document = deepcopy(PLAIN)
    document["seed"] = "1"
    document["system"] |= {"q": 1, "initial_mean": [1, 2, 3]}
    document["sensors"][0] |= {"Hh": 1, "H": [[1, 2, 3]]}
    document["sensors"].append({"id": 3, "H": "x", "R": 1})
    document["sensors"].append({"id": 1, "H": [[1, 1]], "R": [[1, 2], [2, 1]]})
    document["sensors"].append({"id": 1, "H": [[1, 1]], "R": [[1, 0], [0, 1]]})
    document["timing"] = {"rate_hz": -1, "free_run": 1}
    document["transport"] = {"mesh": "x", "endpoint": {}}
    assert set(faults(document)) == {
        "seed",
        "system.q",
        "system.initial_mean",
        "sensors[0].Hh",
        "sensors[0].H",
        "sensors[2].H",
        "sensors[3].R",
        "sensors[4]",
        "sensors[4].R",
        "timing.rate_hz",
        "timing.free_run",
        "transport.mesh",
        "transport.endpoint",
    }


def test_a_message_is_a_line_with_file_field_expectation_and_value(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(scenario_of().to_toml().replace("R = 0.5", 'R = 0.5\nHH = "x"'))
    with pytest.raises(ScenarioError) as error:
        load_scenario(path)
    assert str(error.value) == f"{path}: sensors[0].HH: unknown key; did you mean 'H'? (is 'x')"
    assert error.value.exit_code == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = 1\nsteps = = 2\n", "line 2, column 9: expected valid TOML: Invalid value (is 'steps = = 2')"),
        ("seed = 1\nseed = 2\n", "line 2, column 9: expected valid TOML: Cannot overwrite a value (is 'seed = 2')"),
        ("seed = 1\nname = 'x", 'line 2: expected valid TOML: Expected "\'" (is "name = \'x")'),
        ("", "network: required (is not given)"),
    ],
)
def test_broken_toml_is_located(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as error:
        load_scenario(path)
    assert str(error.value).splitlines()[0] == f"{path}: {message}"


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(ScenarioError, match="No such file or directory"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(ScenarioError, match="Is a directory"):
        load_scenario(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(ScenarioError, match="not UTF-8"):
        load_scenario(tmp_path / "latin.toml")


# --- any scenario ---

finite = st.floats(-1e6, 1e6, allow_nan=False)


def matrix(rows: int, columns: int):
    return st.lists(st.lists(finite, min_size=columns, max_size=columns), min_size=rows, max_size=rows)


def covariance(size: int):
    entries = st.lists(st.integers(-3, 3), min_size=size * size, max_size=size * size)
    return entries.map(lambda a: np.reshape(a, (size, size))).map(lambda a: (a @ a.T + 0.0).tolist())


def over_time(item):
    sequences = st.fixed_dictionaries(
        {"sequence": st.lists(item, min_size=1, max_size=3), "after": st.sampled_from(["cycle", "hold"])}
    )
    return st.one_of(item, item, sequences)


laws = st.one_of(
    st.builds(lambda m, v: {"distribution": "normal", "mean": m, "variance": v}, finite, st.floats(0, 9)),
    st.builds(lambda a, b: {"distribution": "uniform", "low": min(a, b), "high": max(a, b)}, finite, finite),
    st.builds(lambda p: {"distribution": "bernoulli", "p": p}, st.floats(0, 1)),
    st.builds(
        lambda x: {"distribution": "discrete", "values": x, "probabilities": [0.25, 0.75]}, st.tuples(finite, finite)
    ),
    st.builds(lambda m: {"distribution": "exponential", "mean": m}, st.floats(0.1, 9)),
)


def random_matrix(rows: int, columns: int):
    terms = st.lists(
        st.fixed_dictionaries(
            {"matrix": matrix(rows, columns), "variables": st.sampled_from([["a"], ["a", "b"], ["b", "b"]])}
        ),
        max_size=2,
    ).map(lambda some: [*some, {"matrix": np.ones((rows, columns)).tolist(), "variables": ["a", "b"]}])
    return st.one_of(
        matrix(rows, columns),
        st.fixed_dictionaries({"terms": terms, "variables": st.fixed_dictionaries({"a": laws, "b": laws})}),
        st.fixed_dictionaries({"mean": matrix(rows, columns), "covariance": covariance(rows * columns)}),
    )


networks = st.one_of(
    st.just({"generator": "complete"}),
    st.builds(
        lambda reach, directed: {"generator": "ring", "reach": reach, "directed": directed},
        st.integers(1, 3),
        st.booleans(),
    ),
    st.builds(
        lambda radius, seed: {"generator": "random_geometric", "radius": radius, "seed": seed},
        st.floats(0.01, 2),
        st.integers(0, 9),
    ),
    st.just({"edges": []}),
)


@st.composite
def documents(draw):
    nx = draw(st.integers(1, 3))
    with_taps = draw(st.booleans())
    taps = st.lists(st.sampled_from([-1, 0]), min_size=1, max_size=2)
    names = draw(st.booleans())
    system = {
        "F": draw(over_time(random_matrix(nx, nx))),
        "Q": draw(over_time(covariance(nx))),
        "initial_covariance": draw(covariance(nx)),
        "initial_mean": draw(st.lists(finite, min_size=nx, max_size=nx)),
    }
    sensors = []
    for n in range(draw(st.integers(1, 4))):
        ny = draw(st.integers(1, 2))
        sensor = {"H": draw(over_time(random_matrix(ny, nx))), "R": draw(over_time(covariance(ny)))}
        sensor["id"] = f"node.{n}" if names else n
        if with_taps:
            sensor["noise"] = [{"source": "e", "lag": lag, "matrix": draw(matrix(ny, 2))} for lag in draw(taps)]
        if draw(st.booleans()):
            sensor["source"] = {"kind": "zenoh", "key": draw(st.text(st.characters(codec="utf-8"), max_size=9))}
        sensors.append(sensor)
    document = {"system": system, "sensors": sensors, "network": draw(networks), "seed": draw(st.integers(0, 2**64))}
    if with_taps:
        document["noise"] = {"white": {"e": {"covariance": draw(covariance(2)), "shape": "uniform"}}}
    document["timing"] = draw(
        st.sampled_from([{"free_run": True}, {"rate_hz": 0.1}, {"epoch": datetime(2026, 2, 3, 4, 5, 6, 7, tzinfo=UTC)}])
    )
    document["method"] = {"name": "two_stage", "options": {"a": draw(st.lists(st.integers() | finite, max_size=3))}}
    return document


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(documents())
def test_any_scenario_is_read_back_from_its_text(document):
    scenario = Scenario.model_validate(document)
    again = Scenario.from_toml(scenario.to_toml())
    assert again == scenario
    assert again.fingerprint == scenario.fingerprint
    assert hash(again) == hash(scenario)
    assert again.network == scenario.network
    one, other = (s.system() for s in (scenario, again))
    for k in (1, 4):
        pairs = zip(one.noise.covariances(k, one.ids), other.noise.covariances(k, one.ids), strict=True)
        assert all((a == b).all() for a, b in pairs)
        assert (one.F.at(k).factors == other.F.at(k).factors).all()


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=150, deadline=None)
@given(junk, st.data())
def test_junk_anywhere_is_refused_in_our_own_words_or_legal(value, data):
    """No input gets past the checks into a traceback."""
    document = json.loads(json.dumps(PLAIN))
    document |= {
        "timing": {"deadlines": {}},
        "transport": {"endpoints": {}},
        "noise": {},
        "method": {},
        "source": {"kind": "csv"},
    }
    document["sensors"][0]["H"] = {
        "terms": [{"matrix": 1, "variables": ["x"]}],
        "variables": {"x": {"distribution": "uniform"}},
    }
    places = []

    def collect(place):
        for key, inner in place.items() if isinstance(place, dict) else enumerate(place):
            places.append((place, key))
            if isinstance(inner, dict | list):
                collect(inner)

    collect(document)
    place, key = data.draw(st.sampled_from(places))
    place[key] = value
    message = refusal(document)
    assume(message)
    assert all(line.startswith("Scenario: ") for line in message.splitlines())
    assert "Input should" not in message
    assert "pydantic" not in message


def refusal(document) -> str:
    try:
        Scenario.model_validate(document)
    except ScenarioError as error:
        return str(error)
    return ""


# --- the reference tells the truth ---

BASE_OF_FRAGMENTS = """
    network = { generator = "complete" }
    system = { F = 0.9, Q = 0.1, initial_covariance = 1 }
    sensors = [{ count = 3, H = 1, R = 1 }]
"""

REFERENCE = "\n".join((DOCS / page).read_text(encoding="utf-8") for page in ("scenario.md", "links.md"))


def fragments(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", REFERENCE, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("fragment", fragments("toml"))
def test_every_example_of_the_reference_is_legal(fragment):
    given = tomllib.loads(fragment)
    scenario = Scenario.model_validate({**tomllib.loads(BASE_OF_FRAGMENTS), **given})
    assert Scenario.from_toml(scenario.to_toml()) == scenario


def test_the_python_example_of_the_reference_runs():
    (program,) = fragments("python")
    exec(compile(program, "docs/scenario.md", "exec"), {})


def test_every_key_is_in_the_reference():
    pieces = [Scenario, *(getattr(schema, name) for name in schema.__all__)]
    keys = {field.alias or name for piece in pieces for name, field in piece.model_fields.items()}
    told = set(re.findall(r"[A-Za-z_0-9]+", REFERENCE))
    assert keys <= told


def test_the_stated_defaults_are_the_defaults():
    stated = {
        "timing": ("rate_hz", "free_run", "timeout_s"),
        "transport": ("base_port", "mesh", "preset"),
        "recording": ("enabled", "flush_interval_s", "compression"),
    }
    scenario = scenario_of()
    for section, keys in stated.items():
        for key in keys:
            default = re.search(rf"^\| `{key}` \| `([^`]*)` ", REFERENCE, re.MULTILINE)[1]
            value = DEFAULT_RATE_HZ if key == "rate_hz" else getattr(getattr(scenario, section), key)
            assert tomllib.loads(f"x = {default}") == {"x": value}
