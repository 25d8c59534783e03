"""The experiment file: what it may say, and that everything that is wrong is said before anything runs."""

from pathlib import Path

import pytest

from zfusion.errors import ScenarioError
from zfusion.studies.experiment.plan import Plan, plan
from zfusion.studies.experiment.spec import load_experiment

SCENARIO = """
steps = 10
network = { generator = "ring" }
[timing]
rate_hz = 10.0
[system]
F = 0.9
Q = 1.0
initial_covariance = 1.0
[[sensors]]
ids = [1, 2, 3]
H = 1.0
R = 0.5
[[sensors]]
id = 4
H = 1.0
R = 2.0
"""

HEAD = '[experiment]\nscenario = "base.toml"\nseeds = [1, 2]\n'


def planned(directory: Path, text: str, *, small: bool = False) -> Plan:
    (directory / "base.toml").write_text(SCENARIO)
    (directory / "file.toml").write_text(text)
    return plan(load_experiment(directory / "file.toml", small=small))


def problems(directory: Path, text: str, *, small: bool = False) -> dict[str, str]:
    with pytest.raises(ScenarioError) as caught:
        planned(directory, text, small=small)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value.problems[0])
    return {problem.field: problem.expected for problem in caught.value.problems}


def test_a_grid_is_the_product_of_its_axes_the_last_one_fastest(tmp_path: Path) -> None:
    made = planned(
        tmp_path,
        HEAD + '[axes]\n"links.loss" = [0.0, 0.5]\nmethod = ["two_stage", "local"]\n'
        'network = [{ label = "line", generator = "line" }, { generator = "complete" }]\n',
    )
    assert made.axes == ("links.loss", "method", "network")
    labels = [tuple(point.labels.values()) for point in made.points]
    assert labels[:3] == [
        (0.0, "two_stage", "line"),
        (0.0, "two_stage", '{"generator": "complete"}'),
        (0.0, "local", "line"),
    ]
    assert len(labels) == 8
    assert made.points[0].scenario.network.neighbours(1) == (1, 2)
    assert made.points[-1].scenario.method.name == "local"
    assert made.points[-1].scenario.links.loss == 0.5


def test_zip_groups_go_together_and_points_are_listed(tmp_path: Path) -> None:
    made = planned(
        tmp_path,
        HEAD + '[[axes.zip]]\n"timing.rate_hz" = [10.0, 20.0]\n"label.pace" = ["slow", "fast"]\n'
        '[[axes.points]]\nsteps = 5\n"sensors[1].R" = 4.0\n[[axes.points]]\nsteps = 6\n"sensors[1].R" = 5.0\n',
    )
    assert [tuple(point.labels.values()) for point in made.points] == [
        (10.0, "slow", 5, 4.0),
        (10.0, "slow", 6, 5.0),
        (20.0, "fast", 5, 4.0),
        (20.0, "fast", 6, 5.0),
    ]
    last = made.points[-1].scenario
    assert last.timing.period_ns == 50_000_000
    assert (last.steps, last.sensors[1].R) == (6, ((5.0,),))


def test_an_axis_may_be_written_without_quotes_and_a_list_may_have_a_name(tmp_path: Path) -> None:
    kill = '{ kind = "kill", node = 1, step = 3 }'
    made = planned(
        tmp_path,
        HEAD + f'[axes]\nlinks.delay = [0.0, 0.01]\nfaults = [[], {{ label = "one dies", value = [{kill}] }}]\n',
    )
    assert made.axes == ("links.delay", "faults")
    assert [point.labels["faults"] for point in made.points] == ["[]", "one dies"] * 2
    assert len(made.points[1].scenario.faults) == 1


def test_what_is_set_holds_at_every_point_and_small_replaces(tmp_path: Path) -> None:
    text = (
        HEAD + 'set = { steps = 8, "links.delay" = { distribution = "exponential", mean = 0.1 } }\n'
        '[axes]\n"links.delay.mean" = [0.01, 0.02, 0.03]\n'
        "[experiment.small]\nseeds = { first = 7, count = 1 }\nset = { steps = 3 }\n"
        'axes = { "links.delay.mean" = [0.5] }\n'
    )
    made = planned(tmp_path, text)
    assert [point.scenario.steps for point in made.points] == [8, 8, 8]
    assert made.points[2].scenario.links.delay.mean == 0.03  # type: ignore[union-attr]
    small = planned(tmp_path, text, small=True)
    assert [(point.scenario.steps, point.labels) for point in small.points] == [(3, {"links.delay.mean": 0.5})]
    assert [task.seed for task in small.points[0].seeds] == [7]


def test_without_axes_there_is_one_point(tmp_path: Path) -> None:
    made = planned(tmp_path, HEAD)
    assert [point.text for point in made.points] == ["the scenario as it is"]


def test_a_hash_is_of_what_defines_a_run(tmp_path: Path) -> None:
    first = planned(tmp_path, HEAD + "[axes]\nsteps = [5, 6]\n")
    hashes = [task.hash for point in first.points for task in point.seeds]
    assert len(set(hashes)) == 4
    again = planned(tmp_path, HEAD.replace("[1, 2]", "[2, 3]") + 'name = "other"\n[axes]\nsteps = [6, 7]\n')
    assert again.points[0].seeds[0].hash == first.points[1].seeds[1].hash
    burnt = planned(tmp_path, HEAD + "burn_in = 1\n[axes]\nsteps = [5, 6]\n")
    assert not set(burnt.tasks) & set(first.tasks)
    assert first.points[0].theory.hash != first.points[1].theory.hash
    lossy = planned(tmp_path, HEAD + '[axes]\n"links.loss" = [0.0, 0.5]\n')
    assert lossy.points[0].theory.hash == lossy.points[1].theory.hash


def test_a_file_that_a_scenario_reads_is_part_of_the_hash(tmp_path: Path) -> None:
    text = HEAD + 'set = { "links.delay" = { trace = "delays.csv" } }\n'
    trace = tmp_path / "delays.csv"
    trace.write_text("0.01\n0.02\n")
    before = planned(tmp_path, text).points[0].seeds[0].hash
    assert planned(tmp_path, text).points[0].seeds[0].hash == before
    trace.write_text("0.01\n0.03\n")
    assert planned(tmp_path, text).points[0].seeds[0].hash != before


def test_files_of_one_name_are_told_apart(tmp_path: Path) -> None:
    text = HEAD + 'set = { "links.delay" = { trace = "a/x" }, method = { name = "stationary", design = "b/x" } }\n'
    for folder in "ab":
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x").write_text("0.01\n0.02\n")
    hashes = [planned(tmp_path, text).points[0].seeds[0].hash]
    for folder in "ab":
        (tmp_path / folder / "x").write_text("0.01\n0.03\n")
        hashes.append(planned(tmp_path, text).points[0].seeds[0].hash)
    assert len(set(hashes)) == 3


def test_a_design_file_is_part_of_the_hash_of_runs_only(tmp_path: Path) -> None:
    """What is predicted of a scenario is for the two-stage filter, whatever method the runs are of."""
    text = HEAD + 'set = { method = { name = "stationary", design = "d.npz" } }\n'
    (tmp_path / "d.npz").write_bytes(b"a design")
    [before] = planned(tmp_path, text).points
    (tmp_path / "d.npz").write_bytes(b"another one")
    [after] = planned(tmp_path, text).points
    assert not {task.hash for task in before.seeds} & {task.hash for task in after.seeds}
    assert before.theory.hash == after.theory.hash


@pytest.mark.parametrize(
    ("text", "field", "expected"),
    [
        ('[axes]\n"links.dealy" = [0.1]\n', 'axes."links.dealy"[0]', "links.dealy: unknown key; did you mean 'delay'?"),
        ("[axes]\nnonsense = [1]\n", "axes.nonsense[0]", "nonsense: unknown key"),
        ('[axes]\n"links.delay" = [0.1, "soon"]\n', 'axes."links.delay"[1]', "expected seconds"),
        ('[axes]\n"links.delay" = 0.1\n', 'axes."links.delay"', "expected a list of at least one value"),
        ("[axes]\nsteps = []\n", "axes.steps", "expected a list of at least one value"),
        ("[axes]\nsteps = [5, 5]\n", "axes.steps[1]", "expected values, or labels, that differ from those before"),
        ('[axes]\n"sensors[7].R" = [1.0]\n', 'axes."sensors[7].R"[0]', "names nothing: there is no 7 in a list of 2"),
        ('[axes]\n"steps.more" = [1.0]\n', 'axes."steps.more"[0]', "names nothing: there is no 'more'"),
        ('[axes]\nlinks = [{ loss = 0.1 }]\n"links.loss" = [0.1]\n', 'axes."links.loss"', "each thing to vary once"),
        ('[axes]\n"a..b" = [1]\n', 'axes."a..b"', "expected a path"),
        ('[axes]\nmethod = ["magic"]\n', "axes.method[0]", "expected one of two_stage"),
        ("[axes]\nseed = [1, 2]\n", "axes.seed", "expected the seeds in [experiment]"),
        ('[[axes.zip]]\nsteps = [5, 6]\n"links.loss" = [0.1]\n', "axes.zip[0]", "equally long"),
        ("[axes]\nzip = 3\n", "axes.zip", "expected tables"),
        ("[[axes.points]]\nsteps = 5\n[[axes.points]]\nseed = 5\n", "axes.points[1]", "expected the axes steps"),
        ("[axes]\npoints = []\n", "axes.points", "expected tables"),
        ('[axes]\n"timing.deadlines.measurement" = [1.5]\n', 'axes."timing.deadlines.measurement"[0]', "<= 1"),
        ('set = { "links.loss" = 2 }\n', 'experiment.set."links.loss"', "<= 1"),
        ('set = { "a b..c" = 2 }\n', 'experiment.set."a b..c"', "expected a path"),
        ('metrics = ["mse", "luck"]\n', "experiment.metrics[1]", "expected one of mse"),
        ('world = "dream"\n', "experiment.world", "'simulated'"),
        ("burn_in = 10\n", "steps", "expected more steps than the 10 of burn_in"),
        ("confidence = 1.0\n", "experiment.confidence", "expected a number between 0 and 1"),
        ("small.seeds = []\n", "experiment.small.seeds", "at least 1"),
        ("small.axes = { steps = [3] }\n", "experiment.small.axes.steps", "expected an axis of [axes]"),
        ('set = { sensors = [{ ids = ["all", "b"], H = 1.0, R = 1.0 }] }\n', "experiment.set.sensors", "another name"),
        ("colour = 3\n", "experiment.colour", "unknown key"),
    ],
)
def test_what_is_wrong_is_said_at_its_place(tmp_path: Path, text: str, field: str, expected: str) -> None:
    found = problems(tmp_path, HEAD + text)
    assert field in found, found
    assert expected in found[field]


@pytest.mark.parametrize(
    ("seeds", "expected"),
    [
        ("[]", "at least 1"),
        ("[1, 1]", "expected seeds that differ"),
        ("{ count = 0 }", "expected a number >= 1"),
        ("{ number = 3 }", "required"),
        ("[-1]", "expected a number >= 0"),
    ],
)
def test_bad_seeds_are_refused(tmp_path: Path, seeds: str, expected: str) -> None:
    found = problems(tmp_path, f'[experiment]\nscenario = "base.toml"\nseeds = {seeds}\n')
    assert any(expected in told for field, told in found.items() if field.startswith("experiment.seeds")), found


def test_all_problems_are_said_at_once(tmp_path: Path) -> None:
    found = problems(tmp_path, HEAD + '[axes]\n"links.loss" = [0.1, 2.0]\n"timing.rate_hz" = [-1.0, 10.0]\n')
    assert set(found) == {'axes."links.loss"[1]', 'axes."timing.rate_hz"[0]'}


def test_files_that_are_not_there_or_not_toml(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="No such file"):
        load_experiment(tmp_path / "none.toml")
    assert "expected a scenario file" in problems(tmp_path, HEAD.replace("base", "none"))["experiment.scenario"]
    assert "valid TOML" in problems(tmp_path, "[experiment\n")["file"]
    (tmp_path / "broken.toml").write_text("steps = 0\n")
    with pytest.raises(ScenarioError, match=r"broken\.toml: steps"):
        planned(tmp_path, HEAD.replace("base", "broken"))
