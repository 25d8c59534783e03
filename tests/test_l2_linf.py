"""Designs of the method `l2_linf`: the reference table of its specification, and what must hold for every design."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from lmi_examples import GRAPHS, IDS, MISSING, PAIRS, SURE, filters, slack_filters, switching
from zfusion.errors import InputError
from zfusion.methods.convex import DesignError
from zfusion.methods.l2_linf import Form, Problem, make_design
from zfusion.methods.l2_linf.alternation import alternate
from zfusion.methods.l2_linf.lmi import Designed, diagonal_design, slack_design
from zfusion.methods.l2_linf.losses import under_loss
from zfusion.methods.l2_linf.problem import Closed, Gains, closed
from zfusion.methods.l2_linf.verify import (
    certify,
    lower_bound,
    next_moments,
    node_errors,
    radius,
    worst_disturbance,
)
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

DIGITS = 1e-4

# gamma, certified, worst deterministic w; without missing measurements and with them
FORMS = {
    ("general", SURE): (0.42186, 0.4133, 0.4055),
    ("general", MISSING): (0.57844, 0.5470, 0.5392),
    ("observer", SURE): (0.42205, 0.4144, 0.4058),
    ("observer", MISSING): (0.63288, 0.5665, 0.5565),
}
SLACKS = {
    (0.0, MISSING): (0.5560, 0.5452, 0.5383),
    (-0.1, SURE): (0.4068, 0.4063, 0.4029),
    (-0.1, MISSING): (0.5443, 0.5412, 0.5333),
}


def check_zeros(problem: Problem, gains: Gains) -> None:
    for mask, K, H in zip(problem.masks, *gains, strict=True):
        assert not K[~np.kron(mask, np.ones((2, 2))).astype(bool)].any()
        assert not H[~np.repeat(mask, 2, axis=0)].any()


@pytest.mark.parametrize(("form", "arrival"), FORMS)
def test_reference_table_from_the_scenario(form: str, arrival: tuple[float, ...]) -> None:
    design = filters(arrival, form)
    found = (design.gamma, design.certified, design.worst)
    assert found == pytest.approx(FORMS[form, arrival], abs=DIGITS)
    assert design.worst <= design.certified <= design.gamma
    assert design.radius == pytest.approx(0.8, abs=1e-6)  # ρ(A)²: x itself is the slowest part
    check_zeros(switching(arrival), design.gains)
    assert design.lower_bound == (pytest.approx(0.40112, abs=1e-5) if arrival is SURE else None)


@pytest.mark.parametrize(("tau", "arrival"), SLACKS)
def test_reference_table_of_the_slack(tau: float, arrival: tuple[float, ...]) -> None:
    problem, design = switching(arrival), slack_filters(arrival, tau)
    proven, reached = certify(problem, design.gains), worst_disturbance(problem, design.gains)
    assert (design.gamma, proven.gamma, reached.gain) == pytest.approx(SLACKS[tau, arrival], abs=DIGITS)
    assert reached.gain <= proven.gamma <= design.gamma < filters(arrival, "general").gamma
    assert radius(problem, design.gains) == pytest.approx(0.8, abs=1e-6)
    check_zeros(problem, design.gains)


def test_an_observer_is_unbiased_and_never_better() -> None:
    problem, design = switching(MISSING), filters(MISSING, "observer")
    assert design.gamma >= filters(MISSING, "general").gamma
    for K, H in zip(*design.gains, strict=True):
        assert np.abs(problem.E @ problem.A - K @ problem.E - H @ problem.expected_C).max() < 1e-5


@pytest.mark.parametrize(
    ("mode", "arrival", "gamma"),
    [
        (GRAPHS["RING"], SURE, 0.40112),
        (GRAPHS["RING"], MISSING, 0.57391),
        (PAIRS, SURE, 0.45002),
        (GRAPHS["FULL"], MISSING, 0.53465),
        (GRAPHS["NONE"], MISSING, 0.74003),
    ],
)
def test_fixed_topologies_of_the_reference(mode: Array, arrival: tuple[float, ...], gamma: float) -> None:
    problem = switching(arrival, (mode,), ((1.0,),))
    assert diagonal_design(problem).gamma == pytest.approx(gamma, abs=DIGITS)


def test_modes_that_are_all_alike_are_no_modes() -> None:
    """And a complete graph without misses reaches what no linear filter beats."""
    full = GRAPHS["FULL"]
    one, two = switching(SURE, (full,), ((1.0,),)), switching(SURE, (full, full))
    bound = lower_bound(one)
    assert bound == pytest.approx(0.40112, abs=1e-5)
    assert diagonal_design(one).gamma == pytest.approx(bound, abs=1e-5)
    assert diagonal_design(two).gamma == pytest.approx(bound, abs=1e-5)


def dropped(design: Designed, problem: Problem) -> Gains:
    """The fixed ring's filter where the links that a mode does not have are just left out."""
    K = [design.gains.K[0] * np.kron(mask, np.ones((2, 2))) for mask in problem.masks]
    H = [design.gains.H[0] * np.repeat(mask, 2, axis=0) for mask in problem.masks]
    return Gains(np.array(K), np.array(H))


def believed(design: Designed, problem: Problem) -> Gains:
    """The same where a neighbour that is not there is taken to believe what the node does."""
    K, H = dropped(design, problem)
    full = design.gains
    for s, mask in enumerate(problem.masks):
        for i in range(4):
            at = slice(2 * i, 2 * i + 2)
            for j in np.flatnonzero((GRAPHS["RING"][i] > 0) & ~mask[i]):
                expected = full.H[0][at, problem.rows(j)] @ (problem.arrival[j] * problem.C[j])
                K[s, at, at] += full.K[0][at, 2 * j : 2 * j + 2] + expected
    return Gains(K, H)


def test_filters_for_a_fixed_ring_under_switching() -> None:
    fixed, problem = switching(MISSING, (GRAPHS["RING"],), ((1.0,),)), switching(MISSING)
    general, by_belief = diagonal_design(fixed), diagonal_design(fixed, Form.OBSERVER)
    assert certify(problem, dropped(general, problem)).gamma == pytest.approx(0.911, rel=0.03)
    assert certify(problem, believed(by_belief, problem)).gamma == pytest.approx(0.594, abs=2e-3)
    assert certify(problem, believed(general, problem)).gamma < 0.72 * 0.911


@pytest.mark.parametrize(("arrival", "gamma", "worst"), [(SURE, 0.4061, 0.4029), (MISSING, 0.5398, 0.5320)])
def test_alternation_of_the_reference(
    arrival: tuple[float, ...], gamma: float, worst: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it ends is a matter of when it is ended: after two rounds it is where the reference is."""
    monkeypatch.setattr("zfusion.methods.l2_linf.alternation.ROUNDS", 2)
    problem, start = switching(arrival), slack_filters(arrival, -0.1)
    found = alternate(problem, start.gains)
    assert found.certificate.gamma == pytest.approx(gamma, abs=2 * DIGITS)
    assert found.certificate.gamma < start.gamma
    reached = worst_disturbance(problem, found.gains).gain
    assert reached == pytest.approx(worst, abs=5 * DIGITS)
    assert reached <= found.certificate.gamma
    check_zeros(problem, found.gains)


# the reference's certified gamma and worst deterministic w, from the slack's design and from the paper's; gamma here
ALTERNATED = {
    ("slack", SURE): (0.4061, 0.4029, 0.4061),
    ("slack", MISSING): (0.5398, 0.5320, 0.5384),
    ("paper", SURE): (0.4065, 0.4025, 0.4062),
    ("paper", MISSING): (0.5456, 0.5371, 0.5440),
}
NOT_REACHED = pytest.param(
    *("paper, in other units", SURE),
    marks=pytest.mark.xfail(strict=True, reason="from a start that differs by 1e-8 it ends at 0.4068, not 0.4065"),
)
STARTS: dict[str, Callable[[tuple[float, ...]], Gains]] = {
    "slack": lambda arrival: slack_filters(arrival, -0.1).gains,
    "paper": lambda arrival: diagonal_design(switching(arrival)).gains,
    "paper, in other units": lambda arrival: filters(arrival, "general").gains,
}


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("start", "arrival"), [*ALTERNATED, NOT_REACHED])
def test_alternation_that_has_converged_is_where_the_reference_is_or_better(
    start: str, arrival: tuple[float, ...]
) -> None:
    """A smaller γ with a proof is a better one; the reference was ended earlier where there are misses.

    The problem is not convex, and where an alternation leads is a matter of rounding: without misses, from the paper's
    design in two units of the noises, whose gains differ by 1e-8, it ends at 0.4062 and at 0.4068, the reference
    between them.
    """
    gamma, worst, ends = ALTERNATED[start.partition(",")[0], arrival]
    problem = switching(arrival)
    found = alternate(problem, STARTS[start](arrival))
    reached = worst_disturbance(problem, found.gains).gain
    assert reached <= found.certificate.gamma <= gamma + DIGITS
    assert found.certificate.gamma == pytest.approx(ends, abs=3 * DIGITS)
    if arrival is SURE:
        assert reached == pytest.approx(worst, abs=3 * DIGITS)
    again = certify(problem, found.gains)  # which proves its numbers by eigenvalues
    assert again.gamma == pytest.approx(found.certificate.gamma, rel=1e-5)


def test_free_response_of_the_reference() -> None:
    problem = switching(MISSING)
    motions = closed(problem, filters(MISSING, "general").gains)
    eta = np.array([1.0, -1, 2, 1, -1, 2, 0, 3, 1, -2])
    X = np.array([np.outer(eta, eta), np.zeros((10, 10))])  # begins in the first mode
    errors = {}
    for k in range(41):
        errors[k] = np.trace(problem.output @ X.sum(axis=0) @ problem.output.T)
        X = next_moments(problem, motions, X)
    assert [errors[k] for k in (0, 5, 10, 20, 40)] == pytest.approx([6, 0.33, 0.039, 0.0037, 4.2e-5], rel=0.03)


def test_radius_is_that_of_the_operator() -> None:
    """Against the eigenvalues of the operator's matrix, in a problem where the errors are slower than the state."""
    problem = switching((0.5, 0.5, 0.5, 0.5))
    gains = filters(MISSING, "general").gains
    slowed = Gains(gains.K * 0.6 + 0.38 * np.eye(8), gains.H)
    motions = closed(problem, slowed)
    whole = np.zeros((2, 100, 2, 100))
    for s, motion in enumerate(motions):
        step = sum(np.kron(M, M) for M in (motion.A, *motion.noises))
        for t in range(2):
            whole[t, :, s] = problem.transition[s, t] * step
    expected = np.abs(np.linalg.eigvals(whole.reshape(200, 200))).max()
    assert radius(problem, slowed) == pytest.approx(expected, rel=1e-7)


def simulated(problem: Problem, gains: Gains, w: Array, runs: int, seed: int) -> Array:
    """|z̃(end)|² of independent runs under the disturbance w, (runs,)."""
    rng = np.random.default_rng(seed)
    count = len(problem.modes)
    mode = rng.choice(count, size=runs, p=problem.stationary_modes)
    eta = np.zeros((runs, problem.nx + problem.size))
    motions = closed(problem, gains)
    for step in w:
        following = np.empty_like(eta)
        theta = {i: (rng.random(runs) < problem.arrival[i]) - problem.arrival[i] for i in problem.doubtful}
        for s, motion in enumerate(motions):
            here = mode == s
            moved = eta[here] @ motion.A.T + motion.B @ step
            for i, noise in zip(problem.doubtful, motion.noises, strict=True):
                moved += (theta[i][here, None] / problem.spread(i)) * (eta[here] @ noise.T)
            following[here] = moved
        eta = following
        mode = (rng.random(runs)[:, None] > problem.transition[mode].cumsum(axis=1)).sum(axis=1)
    return np.asarray(((eta @ problem.output.T) ** 2).sum(axis=1))


def test_the_worst_disturbance_does_what_it_says() -> None:
    """Mean of 10 000 runs within 6 standard errors of the computed gain², and below the certified γ²."""
    problem, design = switching(MISSING), filters(MISSING, "general")
    worst = worst_disturbance(problem, design.gains)
    assert np.sum(worst.disturbance**2) == pytest.approx(1.0, rel=1e-12)
    found = simulated(problem, design.gains, worst.disturbance, 10_000, 4)
    error = found.std(ddof=1) / 100
    assert abs(found.mean() - worst.gain**2) < 6 * error
    assert found.mean() - 6 * error < design.gamma**2


def test_a_smooth_disturbance_stays_far_below() -> None:
    """The reference's ratios 0.166 and 0.251: largest root mean square error over the disturbance's norm."""
    k = np.arange(60)
    w = np.array(
        [np.exp(-0.1 * k) * np.sin(0.3 * k)] + [0.5 * np.exp(-0.1 * k) * np.cos((0.5 + 0.2 * i) * k) for i in range(4)]
    )
    for arrival, ratio in ((SURE, 0.166), (MISSING, 0.251)):
        problem, gains = switching(arrival), filters(arrival, "general").gains
        assert expected_peak(problem, gains, w.T) / np.linalg.norm(w) == pytest.approx(ratio, rel=0.01)


def expected_peak(problem: Problem, gains: Gains, w: Array) -> float:
    """sup_k sqrt(E|z̃(k)|²), exactly, from the means and second moments of η joint with the mode."""
    motions, chances = closed(problem, gains), problem.stationary_modes
    m = np.zeros((len(motions), problem.nx + problem.size))
    X = np.zeros((*m.shape, m.shape[1]))
    peak = 0.0
    for step in w:
        moved_m, moved_X = np.zeros_like(m), np.zeros_like(X)
        for s, motion in enumerate(motions):
            push = motion.B @ step
            moved_m[s] = motion.A @ m[s] + chances[s] * push
            mixed = np.outer(motion.A @ m[s], push)
            noise = sum(N @ X[s] @ N.T for N in motion.noises)
            moved_X[s] = motion.A @ X[s] @ motion.A.T + noise + mixed + mixed.T + chances[s] * np.outer(push, push)
        m, X = problem.transition.T @ moved_m, np.tensordot(problem.transition.T, moved_X, 1)
        peak = max(peak, float(np.trace(problem.output @ X.sum(axis=0) @ problem.output.T)))
    return float(np.sqrt(peak))


def test_a_random_network() -> None:
    rng = np.random.default_rng(0)
    n, nx, modes = 3, 2, 2
    A = rng.standard_normal((nx, nx))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    graphs = np.array([np.minimum(np.eye(n) + (rng.random((n, n)) < 0.4), 1) for _ in range(modes)])
    chain = rng.random((modes, modes))
    C = tuple(rng.standard_normal((1 + i % 2, nx)) for i in range(n))
    D = tuple(rng.standard_normal((len(c), 6)) for c in C)
    M = rng.standard_normal((2, nx))
    chances = rng.uniform(0.3, 1, n)
    problem = Problem(
        A, rng.standard_normal((nx, 6)), C, D, M, chances, graphs, chain / chain.sum(axis=1, keepdims=True)
    )
    design = make_design((1, 2, 3), problem)
    assert design.worst <= design.certified <= design.gamma * (1 + 1e-4)
    assert design.radius < 1
    assert slack_design(problem, 0.0).gamma <= design.gamma * (1 + 1e-6)
    found = simulated(problem, design.gains, design.worst_disturbance, 4000, 1)
    assert abs(found.mean() - design.worst**2) < 6 * found.std(ddof=1) / np.sqrt(4000)


def test_a_design_tries_what_it_is_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zfusion.methods.l2_linf.design.TAUS", (-0.2, -0.1))
    problem = switching(SURE, (GRAPHS["RING"],), ((1.0,),))
    plain, better = make_design(IDS, problem), make_design(IDS, problem, slack=True, alternate=True)
    assert (plain.tau, plain.rounds, plain.form) == (None, 0, "general")
    assert better.tau in (-0.2, -0.1)
    assert better.lower_bound is not None
    assert better.lower_bound * (1 - 1e-6) <= better.certified <= plain.certified * (1 + 1e-5)


def test_a_gamma_that_cannot_be_is_infeasible() -> None:
    with pytest.raises(DesignError, match=r"no filter with P=diag\(R,Q\(s\)\) found"):
        diagonal_design(switching(MISSING), gamma=0.55)  # which a full P(s) would prove
    assert diagonal_design(switching(MISSING), gamma=0.6).gamma == 0.6


def test_filters_that_are_not_stable_have_no_certificate() -> None:
    problem, gains = switching(SURE), filters(SURE, "general").gains
    with pytest.raises(DesignError, match=r"no certificate: they are not stable in mean square \(radius"):
        certify(problem, Gains(gains.K + 0.8 * np.eye(8), gains.H))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"A": np.array([[1.0, 0], [0, 0.5]])}, DesignError, r"A is not Schur stable \(spectral radius 1\)"),
        ({"transition": np.array([[0.7, 0.4], [0.4, 0.6]])}, ModelError, "transition.*add up to 1"),
        ({"transition": np.array([[1.7, -0.7], [0.4, 0.6]])}, ModelError, "transition.*add up to 1"),
        ({"transition": np.eye(3)}, ModelError, "transition"),
        ({"arrival": np.array([0.8, 1.2, 0.9, 0.6])}, ModelError, "arrival.*probabilities"),
        ({"modes": np.array([np.ones((4, 4)) - np.eye(4)] * 2)}, ModelError, "diagonal of ones"),
        ({"modes": np.array([2 * np.eye(4) - np.ones((4, 4))] * 2)}, ModelError, "negative"),
        ({"D": (np.ones((1, 5)),)}, ModelError, "as many D"),
        ({"M": np.ones((1, 3))}, ModelError, "M:"),
    ],
)
def test_problems_that_cannot_be_are_refused(change: dict[str, Any], error: type[Exception], words: str) -> None:
    given = switching(MISSING)
    names = ("A", "B", "C", "D", "M", "arrival", "modes", "transition")
    with pytest.raises(error, match=words):
        Problem(**({name: getattr(given, name) for name in names} | change))


def test_long_run_chances_of_the_modes() -> None:
    np.testing.assert_allclose(switching(SURE).stationary_modes, [4 / 7, 3 / 7], rtol=1e-12)
    swapping = switching(SURE, transition=((0.0, 1.0), (1.0, 0.0)))
    np.testing.assert_allclose(swapping.stationary_modes, [0.5, 0.5], rtol=1e-12)
    assert isinstance(closed(swapping, filters(SURE, "general").gains)[0], Closed)


def test_no_loss_is_what_the_nodes_do_and_losses_cost() -> None:
    design = filters(MISSING, "general")
    costs = [under_loss(design, loss) for loss in (0.0, 0.1, 0.3, 0.6, 1.0)]
    np.testing.assert_allclose(costs[0], node_errors(design.problem, design.gains), rtol=1e-8)
    sums = [float(cost.sum()) for cost in costs]
    assert sums == sorted(sums)
    assert np.isfinite(sums).all()
    for wrong in (-0.1, 1.1, float("nan")):
        with pytest.raises(InputError, match="from 0 to 1"):
            under_loss(design, wrong)


def test_errors_under_loss_are_those_of_sampled_runs() -> None:
    """With switching modes, misses that are common to all who hear a sensor, and a third of the messages lost.

    Means over independent runs at one step, within 6 standard errors of what is computed.
    """
    design, runs, loss, rng = filters(MISSING, "general"), 2000, 1 / 3, np.random.default_rng(21)
    problem, (K, H) = design.problem, design.gains
    A, B, D, C = problem.A, problem.B, problem.stacked_D, np.vstack(problem.C)
    x, xh = np.zeros((runs, 2)), np.zeros((runs, 4, 2))
    mode = (rng.random(runs) > problem.stationary_modes[0]).astype(int)
    blocks = [(K[s].reshape(4, 2, 4, 2), H[s].reshape(4, 2, 4)) for s in range(2)]
    for _ in range(120):  # 0.894^240: nothing is left of the start
        w = rng.standard_normal((runs, problem.nw))
        theta = rng.random((runs, 4)) < problem.arrival
        y = theta * (x @ C.T) + w @ D.T
        there = (rng.random((runs, 4, 4)) > loss) | np.eye(4, dtype=bool)
        following = np.empty_like(xh)
        for s, (k, h) in enumerate(blocks):
            at = mode == s
            believed = np.where(there[at][..., None], xh[at][:, None], xh[at][:, :, None])  # by receiver, sender
            supposed = np.einsum("rijb,jb->rij", believed, problem.expected_C)
            seen = np.where(there[at], y[at][:, None], supposed)
            following[at] = np.einsum("iajb,rijb->ria", k, believed) + np.einsum("iaj,rij->ria", h, seen)
        xh, x = following, x @ A.T + w @ B.T
        mode = (rng.random(runs) > problem.transition[mode, 0]).astype(int)
    errors = ((x[:, None] - xh) ** 2).sum(axis=2)
    expected = under_loss(design, loss)
    assert (expected > 1.02 * under_loss(design, 0.0)).all()
    assert (np.abs(errors.mean(axis=0) - expected) < 6 * errors.std(axis=0, ddof=1) / np.sqrt(runs)).all()
