"""Random matrices: exact moments, draws that have them, schedules."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from zfusion.errors import InputError
from zfusion.model.distributions import Bernoulli, Discrete, Normal, Uniform
from zfusion.model.matrices import ByMoments, Fixed, RandomMatrix, Schedule, Terms, constant_from
from zfusion.model.streams import Seeds

rng = np.random.default_rng(11)
A, B, C = rng.normal(size=(3, 2, 3))
ROOT = rng.normal(size=(6, 4))
TWO = Discrete((-1.0, 2.0), (0.3, 0.7))
THREE = Discrete((0.0, 0.5, 1.0), (0.1, 0.5, 0.4))


def entry_covariance(matrix: RandomMatrix) -> np.ndarray:
    """Cov[m_pa, m_qb] at [p, a, q, b], read off E[M̃ G M̃ᵀ] for G = (e_a e_bᵀ)."""
    rows, columns = matrix.shape
    covariance = np.zeros((rows, columns, rows, columns))
    for a, b in product(range(columns), repeat=2):
        covariance[:, a, :, b] = matrix.second_moment(np.outer(np.eye(columns)[a], np.eye(columns)[b]))
    return covariance.reshape(rows * columns, rows * columns)


def test_terms_have_the_moments_of_all_their_outcomes() -> None:
    """Against the enumeration of every combination of two discrete variables; one is squared, one is in two terms."""
    terms = Terms(((A, ()), (B, ("x", "y")), (C, ("y", "y"))), {"x": TWO, "y": THREE})
    outcomes, chances = [], []
    for (x, p), (y, q) in product(
        zip(TWO.values, TWO.probabilities, strict=True), zip(THREE.values, THREE.probabilities, strict=True)
    ):
        outcomes.append(A + x * y * B + y * y * C)
        chances.append(p * q)
    mean = np.tensordot(chances, outcomes, 1)
    deviations = (np.array(outcomes) - mean).reshape(len(outcomes), -1)
    assert np.allclose(terms.mean, mean, rtol=1e-14, atol=1e-15)
    assert np.allclose(entry_covariance(terms), deviations.T @ np.diag(chances) @ deviations, rtol=1e-12, atol=1e-14)
    assert terms.shape == (2, 3)
    assert terms.is_random


def test_second_moment_is_the_defining_sum() -> None:
    """E[M̃ G M̃ᵀ]_pq = Σ_ab Cov[m_pa, m_qb] G_ab."""
    matrix = ByMoments(A, ROOT @ ROOT.T)
    G = ROOT[:3] @ ROOT[:3].T
    covariance = (ROOT @ ROOT.T).reshape(2, 3, 2, 3)
    assert np.allclose(matrix.second_moment(G), np.einsum("paqb,ab->pq", covariance, G), rtol=1e-12)
    assert np.allclose(entry_covariance(matrix), ROOT @ ROOT.T, atol=1e-12)
    assert len(matrix.factors) == 4  # the covariance's rank


def test_variance_survives_beside_a_large_mean() -> None:
    terms = Terms((([[1.0]], ("x", "y")),), {"x": Uniform(1e6, 1e6 + 1), "y": Normal(1e6, 1e-3)})
    exact = 1e-3 * (1e6 + 0.5) ** 2 + 1e12 / 12 + 1e-3 / 12
    assert terms.second_moment(np.eye(1))[0, 0] == pytest.approx(exact, rel=1e-12)


def test_what_does_not_vary_is_not_random() -> None:
    assert not Fixed(A).is_random
    assert not Terms(((A, ()), (B, ("sure",))), {"sure": Bernoulli(1.0)}).is_random
    assert not ByMoments(A, np.zeros((6, 6))).is_random
    assert np.array_equal(Fixed(A).second_moment(np.eye(3)), np.zeros((2, 2)))
    assert np.array_equal(Fixed(A).sample(Seeds(0).streams("F", block=0), 3), [A, A, A])


@pytest.mark.parametrize(
    "matrix",
    [
        Terms(((A, ()), (B, ("x", "y")), (C, ("y", "y"))), {"x": Normal(0.5, 2.0), "y": Uniform(-1, 2)}),
        ByMoments(A, ROOT @ ROOT.T),
        Fixed(A),
    ],
    ids=["terms", "moments", "fixed"],
)
def test_draws_have_the_moments(matrix: RandomMatrix) -> None:
    """Means and covariances of the entries within six standard deviations of their own estimates."""
    count = 40_000
    drawn = matrix.sample(Seeds(3).streams("F", block=0), count)
    assert drawn.shape == (count, 2, 3)
    deviations = (drawn - matrix.mean).reshape(count, -1)
    products = deviations[:, :, None] * deviations[:, None, :]
    for estimates, exact in ((deviations, 0.0), (products, entry_covariance(matrix))):
        bound = 6 * estimates.std(axis=0) / np.sqrt(count) + 1e-12
        assert (np.abs(estimates.mean(axis=0) - exact) <= bound).all()


def test_terms_share_their_variables_draw_by_draw() -> None:
    drawn = Terms((([[1.0, 0]], ("x",)), ([[0, 2.0]], ("x", "x"))), {"x": Normal(0, 1)}).sample(
        Seeds(0).streams("F", block=0), 50
    )
    assert np.allclose(drawn[:, 0, 1], 2 * drawn[:, 0, 0] ** 2)


def test_a_schedule_cycles_or_holds() -> None:
    cycle, hold = Schedule(("a", "b", "c"), 1, "cycle"), Schedule(("a", "b", "c"), 1, "hold")
    assert "".join(cycle.at(k) for k in range(1, 9)) == "abcabcab"
    assert "".join(hold.at(k) for k in range(1, 9)) == "abcccccc"
    assert Schedule.constant("a", 1).at(10**9) == "a"
    assert (cycle.constant_from, hold.constant_from, Schedule(("a",), 2, "cycle").constant_from) == (None, 3, 2)
    assert [cycle.items[n] for n in cycle.indices(-1, 6)] == ["a", "a", "a", "b", "c", "a"]
    assert [hold.items[n] for n in hold.indices(2, 4)] == [hold.at(k) for k in range(2, 6)]
    assert constant_from([hold, Schedule(("a",), 7)]) == 7
    assert constant_from([hold, cycle]) is None
    assert constant_from([]) == 0
    with pytest.raises(ValueError, match="step 0 is before the schedule's first step 1"):
        cycle.at(0)


def test_model_objects_cannot_be_changed_afterwards() -> None:
    mine = np.eye(2)
    matrix = Fixed(mine)
    mine[0, 0] = 5
    assert matrix.mean[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        matrix.mean[0, 0] = 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Schedule(()), "items: expected at least one"),
        (lambda: Schedule((1,), 0, "repeat"), "after: expected 'cycle' or 'hold'"),
        (lambda: Fixed([1.0, 2.0]), r"mean: expected an array of shape \(any, any\) \(is \(2,\)\)"),
        (lambda: Fixed([[np.nan]]), "mean: expected finite"),
        (lambda: Fixed([["a"]]), "mean: expected numbers"),
        (lambda: Terms((), {}), "terms: expected at least one"),
        (lambda: Terms(((A, ()), (np.eye(2), ())), {}), r"terms\[1\].matrix: expected an array of shape \(2, 3\)"),
        (lambda: Terms(((A, ("x",)),), {"y": TWO}), r"terms\[0\].variables: expected one of \['y'\] \(is 'x'\)"),
        (lambda: Terms(((A, ()),), {"y": TWO}), r"variables: expected variables that occur .*\['y'\]"),
        (lambda: ByMoments(A, np.eye(5)), r"covariance: expected an array of shape \(6, 6\)"),
        (lambda: ByMoments([[1.0]], [[-1.0]]), "covariance: expected a positive semi-definite"),
        (lambda: ByMoments([[1.0, 1.0]], [[1.0, 0.5], [0.4, 1.0]]), "covariance: expected a symmetric"),
        (lambda: ByMoments([[1.0, 1.0]], [[1.0, 0.5], [0.5, 0.0]]), "covariance: expected a positive semi-definite"),
    ],
)
def test_what_cannot_be_is_refused(make, message) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        make()
