"""Designs for a polytope of systems, as a scenario says them: options, references, files, and what is refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmi_examples import EXAMPLES, GRAPHS, polytope
from zfusion.drivers.designs import design_of, make
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import simulate
from zfusion.errors import InputError, ScenarioError
from zfusion.methods.check import check_method
from zfusion.methods.convex import DesignError
from zfusion.methods.design_files import DesignFileError
from zfusion.methods.stationary import Design, Plant, StationaryOptions
from zfusion.methods.stationary.cost import evaluate
from zfusion.methods.stationary.limits import information_limit
from zfusion.model.checks import ModelError
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording

pytest.importorskip("cvxpy")

DIGITS = 3e-4
ROBUST = tomllib.loads((EXAMPLES / "stationary_robust.toml").read_text())

VERTICES: list[dict[str, Any]] = [
    {"F": [[0.5, 0.2], [0.0, 0.5]], "R": {"1": 0.49}},
    {"F": [[0.8, 0.2], [0.0, 0.5]], "R": {"1": 1.69}},
]
"""Of the small system, which is right between them: of the noise's standard deviations, too."""


def small(vertices: Any = VERTICES, *, between: float = 0.5, **options: Any) -> Scenario:
    """Two sensors of two states, all of whose systems are mixtures of two."""
    return Scenario.model_validate(
        {
            "name": "small",
            "steps": 10,
            "network": {"generator": "complete"},
            "system": {
                "F": [[0.5 + 0.3 * between, 0.2], [0.0, 0.5]],
                "Q": {"diagonal": [1.0, 1.0]},
                "initial_covariance": {"diagonal": [1.0, 1.0]},
                "initial_mean": [0.0, 0.0],
            },
            "sensors": [
                {"id": 1, "H": [[1.0, 0.0]], "R": (0.7 + 0.6 * between) ** 2},
                {"id": 2, "H": [[0.0, 1.0]], "R": 1.0},
            ],
            "method": {"name": "stationary", "options": {"vertices": vertices, **options}},
        }
    )


# (O) bound and worst over a 9 x 9 grid, the grid's mean; (C) the same; plain (O) the same
REFERENCES = {
    "PATH": ((4.2380, 4.1323, 3.7085), (5.0126, 4.3072, None), (4.5963, 4.2012, None)),
    "RING": ((4.4403, 4.3078, 3.8597), (5.9589, 4.7782, None), (4.8446, 4.4139, None)),
}
OPTIONS: tuple[dict[str, Any], ...] = ({}, {"gramian": "controllability"}, {"plain": True})


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("graph", REFERENCES)
@pytest.mark.parametrize("number", range(3))
def test_robust_designs_of_the_reference_from_a_scenario(graph: str, number: int) -> None:
    options = ROBUST["method"]["options"] | OPTIONS[number]
    document = ROBUST | {"network": {"matrix": GRAPHS[graph].tolist()}}
    design = make(Scenario.model_validate(document | {"method": {"name": "stationary", "options": options}}))
    assert isinstance(design, Design)
    costs = [evaluate(design.problem, design.gains, one).J for one in polytope(9)]
    bound, worst, mean = REFERENCES[graph][number]
    assert design.bound == pytest.approx(bound, abs=DIGITS)
    assert max(costs) == pytest.approx(worst, abs=DIGITS)
    assert mean is None or np.mean(costs) == pytest.approx(mean, abs=DIGITS)
    assert pytest.approx(max(costs)) == design.J  # the worst of all is a vertex


# the soft maximum of the vertices refined, worst over the grid; the information limit of the worst system
DESCENTS = {"PATH": (3.9215, 3.8819), "RING": (4.0787, 4.0473)}


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("graph", DESCENTS)
def test_descents_on_the_reference_polytope_from_a_scenario(graph: str) -> None:
    options = ROBUST["method"]["options"] | {"refine": True}
    document = ROBUST | {"network": {"matrix": GRAPHS[graph].tolist()}}
    design = make(Scenario.model_validate(document | {"method": {"name": "stationary", "options": options}}))
    assert isinstance(design, Design)
    worst, limit = DESCENTS[graph]
    assert max(information_limit(design.problem, one).sum() for one in polytope(3)) == pytest.approx(limit, abs=DIGITS)
    found = max(evaluate(design.problem, design.gains, one).J for one in polytope(9))
    assert limit < found <= worst + DIGITS
    assert design.bound is None


@pytest.mark.parametrize("options", OPTIONS)
def test_a_bound_is_one_for_all_mixtures(options: dict[str, Any]) -> None:
    """Of F and of standard deviations; and the nodes' own numbers are those of the scenario's system."""
    scenario = small(**options)
    design = design_of(scenario)
    corners = design.problem.vertices
    for share in np.linspace(0, 1, 7):
        A, roots = (share * corners[1].A + (1 - share) * corners[0].A), []
        for first, second in zip(corners[0].D, corners[1].D, strict=True):
            roots.append(share * second + (1 - share) * first)
        one = Plant(A, np.eye(2), corners[0].C, tuple(roots), np.eye(2), (np.eye(1),) * 2)
        cost = evaluate(design.problem, design.gains, one)
        assert design.bound >= cost.J
        if share == 0.5:
            np.testing.assert_allclose(cost.mse, design.mse, rtol=1e-9)
    told = design.forecast
    assert told.network["true_cost"] == pytest.approx(design.mse.sum())
    assert design.mse.sum() < told.network["worst_vertex_cost"] <= told.network["bound"]
    assert told.network["vertices"] == 2
    assert any("every system of the polytope" in remark for remark in told.remarks)


def test_all_that_a_vertex_does_not_say_is_as_it_was() -> None:
    same = small([{"F": [[0.65, 0.2], [0.0, 0.5]]}, {"H": {"2": [[0.0, 1.0]]}, "Q": {"diagonal": [1.0, 1.0]}}])
    alone = Scenario.model_validate(same._document() | {"method": "stationary"})
    assert design_of(same).bound == pytest.approx(design_of(alone).bound, rel=1e-5)
    assert design_of(same).problem.nominal.V[0] == pytest.approx(1.0)


def test_a_robust_design_runs_is_kept_and_is_verified(tmp_path: Path) -> None:
    scenario = small()
    design_of(scenario).save(tmp_path / "d.npz")
    kept = Design.load(tmp_path / "d.npz", design_of(scenario).fingerprint)
    assert len(kept.problem.vertices) == 2
    np.testing.assert_allclose(evaluate(kept.problem, kept.gains).mse, kept.mse)
    document = scenario._document()
    document["method"] |= {"design": str(tmp_path / "d.npz")}
    simulate(Scenario.model_validate(document), run="r", output=tmp_path / "r.mcap")
    with Recording.open(tmp_path / "r.mcap") as recording:
        assert verify(recording).identical == 2 * 2 * 10
    document["method"] |= {"options": {"vertices": [VERTICES[0], VERTICES[1] | {"R": {"1": 1.7}}]}}
    with pytest.raises(DesignFileError, match="another system, network or choice"):
        design_of(Scenario.model_validate(document))


def test_a_system_outside_of_its_polytope_is_refused() -> None:
    with pytest.raises(DesignError, match=r"own system is not in the polytope.* off by 0\.0\d* or more"):
        make(small(between=1.1))
    make(small(between=1.0))


@pytest.mark.parametrize(
    ("vertices", "field", "expected"),
    [
        ("F", "vertices", "two or more tables"),
        ([VERTICES[0]], "vertices", "two or more tables"),
        ([VERTICES[0], {}], "vertices[1]", "some of F, Q, H, R"),
        ([{"A": [[1.0]]}, VERTICES[0]], "vertices[0]", "some of F, Q, H, R"),
        ([VERTICES[0], {"F": "x"}], "vertices[1].F", "rows of numbers, a number"),
        ([VERTICES[0], {"F": [[True, 0.0], [0.0, 0.1]]}], "vertices[1].F", "rows of numbers"),
        ([VERTICES[0], {"F": [[0.1, 0.0], [0.1]]}], "vertices[1].F", "numbers in an array of shape"),
        ([VERTICES[0], {"F": {"diag": [0.1, 0.2]}}], "vertices[1].F", "{diagonal = numbers}"),
        ([VERTICES[0], {"F": 0.5}], "vertices[1].F", "shape (2, 2)"),
        ([VERTICES[0], {"H": [[1.0, 0.0]]}], "vertices[1].H", "matrices by sensor id"),
        ([VERTICES[0], {"H": {"3": [[1.0, 0.0]]}}], "vertices[1].H", "ids of sensors: 1, 2"),
        ([VERTICES[0], {"H": {"1": [[1.0, 0.0, 0.0]]}}], "vertices[1].H.1", "shape (1, 2)"),
        ([VERTICES[0], {"Q": {"diagonal": [1.0, -1.0]}}], "vertices[1].Q", "positive semi-definite"),
        ([VERTICES[0], {"R": {"1": -1.0}}], "vertices[1].R.1", "positive semi-definite"),
    ],
)
def test_what_is_no_vertex_is_refused(vertices: Any, field: str, expected: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        check_method(small(vertices), "s.toml")
    [problem] = caught.value.problems
    assert problem.field == f"method.options.{field}"
    assert expected in problem.expected


def test_an_unstable_vertex_is_refused() -> None:
    vertices = [VERTICES[0], {"F": [[1.1, 0.2], [0.0, 0.5]]}]
    with pytest.raises(InputError, match=r"s.toml.*not asymptotically stable \(spectral radius 1.1, vertex 1\)"):
        check_method(small(vertices), "s.toml")


@pytest.mark.parametrize("options", [{"observer": True}, {"doubt": 0.1}])
def test_what_is_for_one_system_only_is_refused_beside_vertices(options: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match="beside vertices"):
        StationaryOptions(vertices=VERTICES, **options)
