"""The search for the worst network: against exhaustive search, and its witnesses against the nodes themselves."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulations import four_sensor, record, walk
from zfusion.drivers.rerun import on_recording
from zfusion.errors import InputError, ScenarioError
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording
from zfusion.studies.worst import Problem, find_worst, worst_network, write_witness
from zfusion.studies.worst.search import random_values
from zfusion.studies.worst.witness import _data, simulated_objective


def nothing(problem: Problem) -> Any:
    return np.zeros(len(problem.arriving), dtype=np.bool_)


def with_witness(scenario: Scenario, text: str, directory: Path) -> Scenario:
    (directory / "witness.toml").write_text(text)
    return scenario.with_overrides(links=directory / "witness.toml")


@pytest.mark.parametrize("objective", ["predicted", "measured"])
@pytest.mark.parametrize("links", [{}, {"loss": 0.2}], ids=str)
def test_the_value_of_a_choice_is_what_the_nodes_say_of_it(
    objective: Any, links: dict[str, Any], tmp_path: Path
) -> None:
    """Choices at random, each in a simulation with those messages lost."""
    scenario = Scenario.model_validate(walk(12)._document() | {"links": links})
    problem = Problem(scenario, objective=objective, data=_data(scenario))
    rng = np.random.default_rng(2)
    for _ in range(3):
        lost = problem.arriving & (rng.random(len(problem.arriving)) < 0.2)
        rules = [
            {"from": sender, "to": receiver, "stage": stage, "steps": [int(k) + 1], "lost": True}
            for number, stage in enumerate(problem.stages)
            for k, at in zip(*np.nonzero(lost.reshape(problem.shape)[number]), strict=True)
            for receiver, sender in [problem.arcs.pairs[at]]
        ]
        named = Scenario.model_validate(scenario._document() | {"links": {**links, "messages": rules}})
        assert problem.value(lost) == pytest.approx(simulated_objective(named, objective), rel=1e-9)


@pytest.mark.parametrize("objective", ["predicted", "measured"])
def test_a_gain_is_the_difference_of_two_values(objective: Any) -> None:
    """For messages that are lost and ones that come back, alone and many, more than there are copies for."""
    scenario = walk(25)
    problem = Problem(scenario, objective=objective, data=_data(scenario))
    rng = np.random.default_rng(3)
    lost = problem.arriving & (rng.random(len(problem.arriving)) < 0.1)
    arriving = np.flatnonzero(problem.arriving)
    toggles = [rng.choice(arriving, size=size, replace=False) for size in [1] * 150 + [3] * 100 + [40] * 5]
    gains = problem.gains(lost, toggles)
    base = problem.value(lost)
    for n in [*range(0, 250, 25), 252, 254]:
        changed = lost.copy()
        changed[toggles[n]] ^= True
        assert gains[n] == pytest.approx(problem.value(changed) - base, rel=1e-5, abs=1e-7 * base)


@pytest.mark.parametrize("objective", ["predicted", "measured"])
def test_local_search_on_tiny_problems_against_all_choices(objective: Any) -> None:
    """Three messages of 32: the gap to the optimum is at most 2 % of what the optimum does; mostly there is none."""
    gaps = []
    for seed in range(2):
        scenario = four_sensor(2, seed=seed)
        problem = Problem(scenario, objective=objective, data=_data(scenario))
        best = find_worst(problem, 3)
        assert best.exact
        for chosen in itertools.islice(itertools.combinations(np.flatnonzero(problem.arriving), 3), 0, None, 397):
            other = nothing(problem)
            other[list(chosen)] = True
            assert best.value >= problem.value(other) - 1e-12
        found = find_worst(problem, 3, exhaustive=0)
        assert not found.exact
        assert found.lost.sum() <= 3
        gaps.append((best.value - found.value) / (best.value - problem.value(nothing(problem))))
    assert max(gaps) <= 0.02
    assert min(gaps) == pytest.approx(0.0, abs=1e-9)


def test_the_worst_is_far_worse_than_chance() -> None:
    problem = Problem(four_sensor(12))
    found = find_worst(problem, 10, limit_s=3.0)
    random, base = random_values(problem, 10, 20, seed=1), problem.value(nothing(problem))
    assert int(found.lost.sum()) == 10
    assert found.value - base > 5 * (random.max() - base) > 0
    assert find_worst(problem, 10, limit_s=0.0).ran_out


def test_the_search_is_the_same_again() -> None:
    problem = Problem(four_sensor(6))
    one, two = (find_worst(problem, 4, seed=5, limit_s=60.0) for _ in range(2))
    assert not one.ran_out
    np.testing.assert_array_equal(one.lost, two.lost)
    assert one.value == two.value


@pytest.mark.parametrize(
    ("objective", "delay", "links"),
    [
        ("predicted", None, {}),
        ("measured", None, {"loss": 0.1}),
        ("predicted", 0.05, {}),
        ("predicted", 0.05, {"delay": 0.001}),
    ],
    ids=str,
)
def test_a_witness_shows_the_number_that_is_claimed(
    objective: Any, delay: float | None, links: dict[str, Any], tmp_path: Path
) -> None:
    """Bit for bit, in a simulation with the file of links and nothing else."""
    scenario = Scenario.model_validate(four_sensor(10)._document() | ({"links": links} if links else {}))
    report = worst_network(scenario, 0.05, objective=objective, delay_s=delay, nodes=[2, 3], limit_s=1.0)
    witness = with_witness(scenario, write_witness(report), tmp_path)
    assert simulated_objective(witness, objective, [2, 3]) == report.worst
    assert report.worst > max(report.random_mean, report.nothing)
    if not (delay and links):  # where links keep their order, what is late holds up what follows
        assert report.searched == pytest.approx(report.worst, rel=1e-9)
    assert report.chosen <= report.budget == 8
    assert sum(report.by_receiver.values()) == report.chosen
    if links:
        assert witness.links.model_dump(exclude={"messages"}) == scenario.links.model_dump(exclude={"messages"})


def test_what_is_late_is_counted_as_late(tmp_path: Path) -> None:
    from zfusion.drivers.simulated import Simulation

    scenario = four_sensor(10)
    report = worst_network(scenario, 0.05, delay_s=0.05, limit_s=1.0)
    simulation = Simulation(with_witness(scenario, write_witness(report), tmp_path))
    simulation.run()
    edges = [edge for [life] in simulation.reports.values() for edge in life.edges.values()]
    assert sum(sum(edge["missed"].values()) for edge in edges) == report.chosen


def test_on_recorded_measurements_with_gaps(tmp_path: Path) -> None:
    """A recording in which sensor 1 has no reading at some steps: what is measured is what a rerun would show."""
    csv = "step,y\n" + "".join(f"{k},{0.1 * k}\n" for k in range(1, 13) if k % 3)
    (tmp_path / "one.csv").write_text(csv)
    document = four_sensor(12)._document()
    gappy = {"kind": "csv", "file": str(tmp_path / "one.csv"), "columns": ["y"], "step_column": "step"}
    document["sensors"][0]["source"] = gappy
    path = record(tmp_path / "r.mcap", Scenario.model_validate(document))
    with Recording.open(path) as recording:
        scenario = on_recording(recording)
    report = worst_network(scenario, 0.05, limit_s=1.0)
    assert report.searched == pytest.approx(report.worst, rel=1e-9)
    with pytest.raises(InputError, match="true state is not known at step 1"):
        worst_network(scenario, 0.05, objective="measured")


def test_what_cannot_be_searched_for() -> None:
    with pytest.raises(InputError, match="budget"):
        worst_network(four_sensor(3), 0.001)
    with pytest.raises(InputError, match=r"delay: expected more than the last deadline, 0\.045 s"):
        worst_network(four_sensor(3), 0.5, delay_s=0.04)
    revise = Scenario.model_validate(four_sensor(3)._document() | {"timing": {"rate_hz": 20.0, "late": "revise"}})
    with pytest.raises(InputError, match=r"timing\.late"):
        worst_network(revise, 0.5)
    with pytest.raises(InputError, match="expected steps that have times"):
        worst_network(revise, 0.5, delay_s=1.0)


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ({"from": 1, "to": 3, "stage": "measurement", "steps": [1]}, "either delay or lost"),
        (
            {"from": 1, "to": 3, "stage": "measurement", "steps": [1], "lost": True, "delay": 1.0},
            "either delay or lost",
        ),
        ({"from": 9, "to": 3, "stage": "measurement", "steps": [1], "lost": True}, r"messages\[0\].from"),
        ({"from": 3, "to": 3, "stage": "measurement", "steps": [1], "lost": True}, "two nodes"),
        ({"from": 1, "to": 3, "stage": "measurement", "steps": [], "lost": True}, "steps"),
        ({"from": 1, "to": 3, "stage": "measurement", "steps": [0], "lost": True}, "steps"),
    ],
    ids=str,
)
def test_rules_for_messages_that_are_wrong(rule: dict[str, Any], said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        Scenario.model_validate(four_sensor(3)._document() | {"links": {"messages": [rule]}})


def test_a_witness_is_legible(tmp_path: Path) -> None:
    text = write_witness(worst_network(four_sensor(8), 0.1, limit_s=1.0))
    assert text.startswith("# ")
    rules = tomllib.loads(text)["links"]["messages"]
    assert len([line for line in text.splitlines() if line.startswith("steps = [")]) == len(rules)
