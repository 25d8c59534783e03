"""Designs of the method `stationary`: the tables of its specification, and what must hold for every design."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from lmi_examples import GRAPHS, IDS, designed, example, plant, polytope
from zfusion.drivers.designs import make
from zfusion.errors import InputError
from zfusion.methods import convex
from zfusion.methods.convex import DesignError
from zfusion.methods.stationary import Choice, Design, Gramian, Plant, Problem, make_design
from zfusion.methods.stationary import refine as refine_module
from zfusion.methods.stationary.cost import Gains, best_output, evaluate, extended, gradients, masked, rescaled
from zfusion.methods.stationary.doubt import Doubted
from zfusion.methods.stationary.limits import (
    centralized_mse,
    information_limit,
    local_predictors,
    neighbourhood_mse,
    own_sensor_mse,
)
from zfusion.methods.stationary.losses import under_loss
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

CONTROLLABILITY = Choice(Gramian.CONTROLLABILITY)
DIGITS = 3e-4

# graph: local KF(N_i), information limit, (O) bound, (O) true, (C) bound, (C) true, refined
TABLE = {
    "PATH": (4.35258, 3.46332, 3.48907, 3.48285, 3.81344, 3.54020, 3.46332),
    "RING": (4.81002, 3.58652, 3.63182, 3.61618, 4.30381, 3.80363, 3.58652),
    "FULL": (3.38516, 3.38516, 3.38516, 3.38516, 3.38516, 3.38516, 3.38516),
    "NONE": (6.37479, 6.37479, 6.37479, 6.37479, 6.72957, 6.49783, 6.37479),
}


def test_baselines_of_the_reference_example() -> None:
    assert centralized_mse(plant()) == pytest.approx(0.84629, abs=1e-5)
    np.testing.assert_allclose(own_sensor_mse(plant()), [1.34836, 1.41615, 1.92580, 1.68448], atol=1e-5)
    limits = {
        "PATH": [0.86533, 0.84629, 0.84629, 0.90541],
        "RING": [0.90354, 0.91224, 0.86533, 0.90541],
    }
    for graph, expected in limits.items():
        np.testing.assert_allclose(information_limit(Problem.of(plant(), GRAPHS[graph])), expected, atol=1e-5)


@cache
def refined(graph: str) -> Design:
    """What a few hundred steps of descent make of the convex design: where thousands lead to, in four digits."""
    design = designed(graph)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refine_module, "OPTIONS", refine_module.OPTIONS | {"maxiter": 300})
        gains = refine_module.refine(design.problem, design.gains).gains
    cost = evaluate(design.problem, gains)
    return replace(design, gains=gains, J=cost.J, mse=cost.mse)


@pytest.mark.parametrize("graph", TABLE)
def test_reference_table_from_the_scenario(graph: str) -> None:
    o, c = designed(graph), designed(graph, CONTROLLABILITY)
    found = [o.neighbourhood_mse.sum(), o.information_limit.sum(), o.bound, o.J, c.bound, c.J, refined(graph).J]
    np.testing.assert_allclose(np.array(found, dtype=float), TABLE[graph], atol=DIGITS)


def test_per_node_errors_and_bounds() -> None:
    np.testing.assert_allclose(designed("PATH").mse, [0.86800, 0.85267, 0.85266, 0.90952], atol=DIGITS)
    np.testing.assert_allclose(designed("RING").mse, [0.91212, 0.91750, 0.87270, 0.91387], atol=DIGITS)
    c = designed("RING", CONTROLLABILITY)
    assert c.node_bounds is not None
    np.testing.assert_allclose(c.node_bounds, [1.08658, 1.09440, 1.05310, 1.06974], atol=DIGITS)
    worst = designed("RING", Choice(Gramian.CONTROLLABILITY, worst_node=True))
    assert worst.node_bounds is not None
    np.testing.assert_allclose(worst.node_bounds, 1.07792, atol=DIGITS)
    for design in (c, worst):
        assert design.node_bounds is not None
        assert (design.mse <= design.node_bounds).all()


def test_plain_design_of_the_reference() -> None:
    plain = designed("RING", Choice(Gramian.CONTROLLABILITY, plain=True))
    assert plain.bound == pytest.approx(4.8368, abs=DIGITS)


def test_observer_type_of_the_reference() -> None:
    design = designed("RING", Choice(observer=True))
    assert pytest.approx(3.9733, abs=DIGITS) == design.J
    problem = design.problem
    F, G, H = design.gains
    np.testing.assert_array_equal(H, -np.eye(12))
    unbiased = F @ problem.E - G @ problem.nominal.stacked_C - problem.E @ problem.nominal.A
    assert np.abs(unbiased).max() < 1e-6


@pytest.mark.parametrize(("graph", "optimum", "free"), [("PATH", 3.7321, 3.46332), ("RING", 3.9589, 3.58652)])
def test_true_cost_optimum_of_the_observer_type(graph: str, optimum: float, free: float) -> None:
    """From the convex design, and from none: one's own Kalman filter as an observer. 7 to 10 % above the free type."""
    problem = Problem.of(plant(), GRAPHS[graph])
    start = designed(graph, Choice(observer=True)).gains
    F, G, _ = local_predictors(problem)
    for gains in (start, Gains(F, -G, -np.eye(12))):
        found = refine_module.refine(problem, gains, observer=True).gains
        J = evaluate(problem, found).J
        assert pytest.approx(optimum, abs=DIGITS) == J
        assert 1.07 * free < J < 1.11 * free
        unbiased = found.F @ problem.E - found.G @ problem.nominal.stacked_C - problem.E @ plant().A
        assert np.abs(unbiased).max() < 1e-12
        assert not found.F[~problem.blocks.F].any()
        assert not found.G[~problem.blocks.G].any()


def test_a_refined_observer_is_one() -> None:
    problem = Problem.of(small_plant(), np.ones((2, 2)))
    design = make_design((1, 2), problem, Choice(observer=True), refine=True)
    np.testing.assert_array_equal(design.gains.H, -np.eye(4))
    assert design.J <= make_design((1, 2), problem, Choice(observer=True)).J
    with pytest.raises(InputError, match="not for the observer type"):
        make_design((1, 2), problem, Choice(observer=True), refine=True, doubt=0.1)
    alone = make_design((1, 2), problem, Choice(observer=True), convex=False)
    np.testing.assert_array_equal(alone.gains.H, -np.eye(4))
    assert pytest.approx(design.J, rel=1e-5) == alone.J


def random_problem(seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    n, nx = 3, 2
    A = rng.standard_normal((nx, nx))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    C = tuple(rng.standard_normal((1 + i % 2, nx)) for i in range(n))
    D = tuple(rng.standard_normal((len(c), 2)) for c in C)
    V = tuple(np.diag(rng.uniform(0.5, 2, 2)) for _ in C)
    graph = np.minimum(np.eye(n) + (rng.random((n, n)) < 0.5), 1)
    one = Plant(A, rng.standard_normal((nx, 3)), C, D, np.diag(rng.uniform(0.1, 1, 3)), V)
    return Problem.of(one, graph, weights=rng.uniform(0.5, 2, n))


@pytest.mark.parametrize("seed", range(2))
def test_what_holds_for_every_design(seed: int) -> None:
    problem = random_problem(seed)
    local = float(problem.weights @ neighbourhood_mse(problem.nominal, problem.G))
    limit = float(problem.weights @ information_limit(problem))
    o = make_design((1, 2, 3), problem)
    c = make_design((1, 2, 3), problem, CONTROLLABILITY)
    r = make_design((1, 2, 3), problem, refine=True)
    for design in (o, c, r):
        for gain, free in zip(design.gains, (problem.blocks.F, problem.blocks.G, problem.blocks.H), strict=True):
            assert not gain[~free].any()
    assert o.bound is not None
    assert c.bound is not None
    assert c.node_bounds is not None
    assert limit <= r.J * (1 + 1e-9)
    assert r.J <= o.J
    assert o.J <= o.bound <= local * (1 + 1e-5)
    assert c.bound >= c.J
    assert (c.mse <= c.node_bounds).all()


def test_cost_is_what_a_simulation_finds() -> None:
    """Mean of |e_i|² over independent runs; for Gaussian e its variance is 2 tr Σ² / runs. Bound: 6 sigma."""
    design, runs, rng = designed("RING"), 4000, np.random.default_rng(5)
    one = design.problem.nominal
    A_e, B_e = extended(one, design.gains.F, design.gains.G)
    eta = np.zeros((len(A_e), runs))
    for _ in range(150):  # 0.934^300: nothing is left of the start
        eta = A_e @ eta + B_e @ rng.standard_normal((B_e.shape[1], runs))
    errors = np.hstack((design.problem.E, -design.gains.H)) @ eta
    found = (errors**2).mean(axis=1).reshape(4, 3).sum(axis=1)
    covariances = evaluate(design.problem, design.gains).covariances
    sigma = np.sqrt(2 * np.einsum("iab,iab->i", covariances, covariances) / runs)
    assert (np.abs(found - design.mse) < 6 * sigma).all()


def test_gradients_are_those_of_finite_differences() -> None:
    problem, start = designed("RING").problem, designed("RING", CONTROLLABILITY).gains
    one = problem.nominal
    rng = np.random.default_rng(2)

    def cost(gains: Gains) -> float:
        return evaluate(problem, gains).J

    P = evaluate(problem, start).P
    J, slope = gradients(problem, one, start, P)
    assert pytest.approx(cost(start), rel=1e-10) == J
    move = masked(problem, Gains(*(rng.standard_normal(gain.shape) for gain in start)))
    along = sum(float(np.sum(s * m)) for s, m in zip(slope, move, strict=True))
    step = 1e-5
    ahead, behind = (Gains(*(g + sign * step * m for g, m in zip(start, move, strict=True))) for sign in (1, -1))
    assert (cost(ahead) - cost(behind)) / (2 * step) == pytest.approx(along, rel=1e-6)


def test_gradients_under_doubt_are_those_of_finite_differences() -> None:
    problem, (F, G, _) = random_problem(4), local_predictors(random_problem(4))
    doubted, rng = Doubted(problem, 0.05), np.random.default_rng(3)
    F = F + 0.1 * problem.blocks.F * rng.standard_normal(F.shape)
    found = doubted.cost(F, G)
    assert found is not None
    dF, dG = (free * rng.standard_normal(free.shape) for free in (problem.blocks.F, problem.blocks.G))
    along = float(np.sum(found[1].F * dF) + np.sum(found[1].G * dG))
    step = 1e-5
    ahead, behind = (doubted.cost(F + sign * step * dF, G + sign * step * dG) for sign in (1, -1))
    assert ahead is not None
    assert behind is not None
    assert (ahead[0] - behind[0]) / (2 * step) == pytest.approx(along, rel=1e-5)


def test_no_doubt_is_the_true_cost_and_too_much_has_none() -> None:
    problem, (F, G, _) = designed("RING").problem, designed("RING").gains
    found = Doubted(problem, 0.0).cost(F, G)
    assert found is not None
    P = evaluate(problem, designed("RING").gains).P
    assert found[0] == pytest.approx(evaluate(problem, Gains(F, G, best_output(problem, P))).J, rel=1e-9)
    assert Doubted(problem, 100.0).cost(F, G) is None
    with pytest.raises(DesignError, match="not stable"):
        refine_module.refine(problem, designed("RING").gains, 100.0)
    with pytest.raises(InputError, match="for one plant"):
        refine_module.refine(
            Problem.of([small_plant(), small_plant(0.5)], np.ones((2, 2))), designed("RING").gains, 0.1
        )


def test_doubt_is_a_simulated_factor() -> None:
    """Messages multiplied by 1 + ζ: the mean of the cost over independent runs, within 6 standard errors."""
    problem, (F, G, _) = designed("RING").problem, designed("RING").gains
    doubt, runs, rng = 0.1, 3000, np.random.default_rng(8)
    found = Doubted(problem, doubt).cost(F, G)
    P = Doubted(problem, doubt).covariance(F, G)
    assert found is not None
    assert P is not None
    H, one = Doubted(problem, doubt).best_output(P), problem.nominal
    x, xi = np.zeros((3, runs)), np.zeros((4, 3, runs))
    blocks = F.reshape(4, 3, 4, 3), G.reshape(4, 3, 4), H.reshape(4, 3, 4, 3)
    for _ in range(150):
        y = np.vstack(one.C) @ x + one.sensor_root @ rng.standard_normal((4, runs))
        factor = 1 + np.sqrt(doubt) * (1 - np.eye(4))[:, :, None] * rng.standard_normal((4, 4, runs))
        estimates = np.einsum("iajb,ijr,jbr->iar", blocks[2], factor, xi)
        errors = ((x - estimates) ** 2).sum(axis=(0, 1))
        moved = np.einsum("iajb,ijr,jbr->iar", blocks[0], factor, xi)
        xi = moved + np.einsum("iaj,ijr,jr->iar", blocks[1], factor, y)
        x = one.A @ x + one.process_root @ rng.standard_normal((3, runs))
    assert abs(errors.mean() - found[0]) < 6 * errors.std(ddof=1) / np.sqrt(runs)


def test_best_output_is_best() -> None:
    design = designed("RING", CONTROLLABILITY)
    problem, (F, G, _) = design.problem, design.gains
    P = evaluate(problem, design.gains).P
    best = evaluate(problem, Gains(F, G, best_output(problem, P)))
    assert (best.mse <= design.mse).all()
    _, slope = gradients(problem, problem.nominal, Gains(F, G, best_output(problem, P)), P)
    assert np.abs(slope.H).max() < 1e-9


def test_coordinates_change_nothing_that_can_be_seen() -> None:
    design = designed("PATH")
    cost = evaluate(design.problem, design.gains)
    T = np.kron(np.eye(4), np.array([[30.0, 3, 0], [0, 0.1, 0], [1, 0, 5]]))
    inverse = np.linalg.inv(T)
    F, G, H = design.gains
    moved = Gains(T @ F @ inverse, T @ G, H @ inverse)
    back = rescaled(design.problem, moved, evaluate(design.problem, moved).P)
    again = evaluate(design.problem, back)
    np.testing.assert_allclose(again.mse, cost.mse, rtol=1e-8)
    for i in range(1, 5):
        at = slice(3 * i, 3 * i + 3)
        np.testing.assert_allclose(again.P[at, at], np.eye(3), atol=1e-6)


@pytest.mark.parametrize("graph", ["PATH", "RING"])
def test_descent_without_convex_design_comes_near_the_limit_and_bears_losses(graph: str) -> None:
    problem = Problem.of(plant(), GRAPHS[graph])
    design = make_design(IDS, problem, convex=False)
    for loss in (0.1, 0.3):
        assert under_loss(design, loss).mse.sum() < 1.08 * under_loss(designed(graph), loss).mse.sum()
    assert design.bound is None
    assert design.iterations > 0
    limit = float(design.information_limit.sum())
    assert limit * (1 - 1e-9) <= design.J <= limit * 1.0013
    assert local_predictors(problem).F.shape == design.gains.F.shape


def test_larger_networks_take_the_route_without_convex_design(monkeypatch: pytest.MonkeyPatch) -> None:
    n, nx = 21, 2
    A = np.array([[0.9, 0.2], [-0.2, 0.9]])
    C = tuple(np.array([[1.0, 0.0]] if i % 2 else [[0.0, 1.0]]) for i in range(n))
    one = Plant(A, np.eye(nx), C, (np.eye(1),) * n, 0.1 * np.eye(nx), (np.eye(1),) * n)
    ring = np.eye(n) + np.roll(np.eye(n), 1, axis=1)
    monkeypatch.setattr("zfusion.methods.stationary.refine.DOUBT_OPTIONS", {"maxiter": 5})
    design = make_design(tuple(range(n)), Problem.of(one, ring))
    assert design.solver == ""
    assert design.information_limit.sum() <= design.J < design.neighbourhood_mse.sum()


LOSSES = (0.0, 0.1, 0.5, 0.9)


@pytest.mark.parametrize("graph", ["PATH", "RING"])
def test_convex_designs_bear_losses_better_than_refined_ones(graph: str) -> None:
    """The descent gains less than 1 % where nothing is lost, and pays for it where something is, by 2 to 200 %."""
    costs = [under_loss(designed(graph), loss).mse.sum() for loss in LOSSES]
    assert costs[0] == pytest.approx(designed(graph).J, rel=1e-9)
    assert costs == sorted(costs)
    assert costs[-1] < own_sensor_mse(plant()).sum()
    assert under_loss(refined(graph), 0.0).mse.sum() < costs[0]
    assert under_loss(refined(graph), 0.1).mse.sum() > 1.02 * costs[1]


def worst(problem: Problem, gains: Gains) -> float:
    return max(evaluate(problem, gains, one).J for one in polytope(9))


# local KF nominal, nominal (O)
NOMINAL = {"PATH": (5.8627, 4.5919), "RING": (6.8158, 4.7961)}


@pytest.mark.slow
def test_robust_designs_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """(O) and the descent from it on the path; a hundred steps of descent are past the reference's."""
    robust = make(example("stationary_robust", network={"matrix": GRAPHS["PATH"].tolist()}))
    assert isinstance(robust, Design)
    problem = robust.problem
    assert robust.bound == pytest.approx(4.2380, abs=DIGITS)
    assert worst(problem, robust.gains) == pytest.approx(4.1323, abs=DIGITS)
    monkeypatch.setattr(refine_module, "OPTIONS", refine_module.OPTIONS | {"maxiter": 100})
    descended = refine_module.refine(problem, robust.gains)
    limit = max(information_limit(problem, one).sum() for one in polytope(3))
    assert limit == pytest.approx(3.8819, abs=DIGITS)
    assert limit < worst(problem, descended.gains) <= 3.9215 + DIGITS


@pytest.mark.parametrize("choice", [Choice(), CONTROLLABILITY, Choice(plain=True)])
def test_a_robust_bound_holds_between_the_vertices_too(choice: Choice) -> None:
    problem = Problem.of([small_plant(0.5), small_plant(0.8)], np.ones((2, 2)))
    design = make_design((1, 2), problem, choice)
    costs = [evaluate(problem, design.gains, small_plant(a)) for a in np.linspace(0.5, 0.8, 7)]
    assert design.bound is not None
    assert max(cost.J for cost in costs) <= design.bound
    if design.node_bounds is not None:
        assert all((cost.mse <= design.node_bounds).all() for cost in costs)


@pytest.mark.parametrize("graph", NOMINAL)
def test_what_nominal_designs_do_on_the_polytope(graph: str) -> None:
    problem = Problem.of(plant(), GRAPHS[graph])
    assert worst(problem, local_predictors(problem)) == pytest.approx(NOMINAL[graph][0], abs=DIGITS)
    assert worst(problem, designed(graph).gains) == pytest.approx(NOMINAL[graph][1], abs=DIGITS)


def test_a_descent_on_a_polytope_has_no_certificate() -> None:
    corners = [small_plant(0.5), small_plant(0.7)]
    problem = Problem.of(corners, np.ones((2, 2)))
    certified, descended = (make_design((1, 2), problem, refine=r) for r in (False, True))
    assert certified.bound is not None
    assert descended.bound is None
    assert descended.J < certified.J


def small_plant(a: float = 0.8) -> Plant:
    A, C = np.array([[a, 0.2], [0.0, 0.5]]), (np.array([[1.0, 0]]), np.array([[0, 1.0]]))
    return Plant(A, np.eye(2), C, (np.eye(1),) * 2, np.eye(2), (np.eye(1),) * 2)


def test_a_polytope_of_one_vertex_is_the_nominal_problem() -> None:
    twice = make_design((1, 2), Problem.of([small_plant(), small_plant()], np.ones((2, 2))))
    once = make_design((1, 2), Problem.of([small_plant()], np.ones((2, 2))))
    assert twice.bound == pytest.approx(once.bound, rel=1e-5)
    assert pytest.approx(once.J, rel=1e-5) == twice.J


def test_unstable_plants_are_refused() -> None:
    with pytest.raises(DesignError, match=r"A is not asymptotically stable \(spectral radius 1.1\)"):
        Problem.of(small_plant(1.1), np.ones((2, 2)))
    with pytest.raises(DesignError, match=r"A is not asymptotically stable \(spectral radius 1, vertex 1\)"):
        Problem.of([small_plant(), small_plant(1.0)], np.ones((2, 2)))


def test_a_polytope_that_holds_an_unstable_plant_is_infeasible() -> None:
    def one(A: list[list[float]]) -> Plant:
        return Plant(np.array(A), np.eye(2), (np.eye(2),), (np.eye(2),), np.eye(2), (np.eye(2),))

    with pytest.raises(DesignError, match="LMI problem infeasible"):
        make_design((1,), Problem.of([one([[0.5, 2], [0, 0.5]]), one([[0.5, 0], [2, 0.5]])], np.eye(1)))


@pytest.mark.parametrize(
    ("graph", "words"),
    [
        (np.array([[1, 0.5], [0, 1]]), "entries 0 and 1"),
        (np.array([[1, 1], [1, 0]]), "diagonal of ones"),
        (np.ones((3, 3)), r"shape \(2, 2\)"),
    ],
)
def test_what_is_no_graph_is_refused(graph: Array, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        Problem.of(small_plant(), graph)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"W": -np.eye(2)}, "positive semi-definite"),
        ({"V": (np.eye(1), -np.eye(1))}, r"V\[1\].*positive semi-definite"),
        ({"C": (np.eye(2),)}, "as many D and V"),
        ({"B": np.ones((3, 1))}, "B:"),
        ({"A": np.ones((2, 3))}, "A:"),
    ],
)
def test_plants_that_do_not_fit_are_refused(change: dict[str, Any], words: str) -> None:
    one = small_plant()
    given = {name: getattr(one, name) for name in ("A", "B", "C", "D", "W", "V")} | change
    with pytest.raises(ModelError, match=words):
        Plant(**given)


def test_weights_and_vertices_must_fit() -> None:
    with pytest.raises(ModelError, match="weights"):
        Problem.of(small_plant(), np.eye(2), weights=[1.0, 0.0])
    with pytest.raises(ModelError, match="at least one plant"):
        Problem((), np.eye(1, dtype=bool), np.eye(1, dtype=bool), np.eye(1, dtype=bool), np.ones(1))
    with pytest.raises(ModelError, match="sizes"):
        Problem.of([small_plant(), plant()], np.ones((2, 2)))


def test_choices_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(InputError, match="controllability"):
        Choice(worst_node=True)
    with pytest.raises(InputError, match="observability"):
        Choice(Gramian.CONTROLLABILITY, observer=True)
    with pytest.raises(InputError, match="one plant"):
        make_design((1, 2), Problem.of([small_plant(), small_plant(0.5)], np.ones((2, 2))), Choice(observer=True))


def test_unstable_gains_are_numerical_trouble() -> None:
    problem = Problem.of(small_plant(), np.eye(2))
    with pytest.raises(DesignError, match=r"numerical trouble.*spectral radius 1.5"):
        evaluate(problem, Gains(1.5 * np.eye(4), np.zeros((4, 2)), np.eye(4)))


def test_without_the_packages_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(convex, "import_module", missing)
    problem = Problem.of(small_plant(), np.ones((2, 2)))
    with pytest.raises(InputError, match=r"convex design needs cvxpy: pip install 'zfusion\[design\]'"):
        make_design((1, 2), problem)
    with pytest.raises(InputError, match=r"refinement needs scipy: pip install 'zfusion\[design\]'"):
        make_design((1, 2), problem, convex=False)
