"""Lyapunov and Riccati equations, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov, solve_sylvester

from zfusion.errors import RunError
from zfusion.methods.gramians import (
    lyapunov,
    predictor_by_doubling,
    predictor_covariance,
    riccati_step,
    spectral_radius,
    sylvester,
)
from zfusion.model.types import Array


def stable(rng: np.random.Generator, n: int, radius: float) -> Array:
    A = rng.standard_normal((n, n))
    return np.asarray(radius * A / spectral_radius(A))


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.99, 0.99999])
def test_lyapunov_is_scipys(radius: float) -> None:
    rng = np.random.default_rng(1)
    A, root = stable(rng, 6, radius), rng.standard_normal((6, 2))
    expected = solve_discrete_lyapunov(A, root @ root.T)
    np.testing.assert_allclose(lyapunov(A, root @ root.T), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("radius", [1.0, 1.1])
def test_lyapunov_of_an_unstable_matrix_is_refused(radius: float) -> None:
    with pytest.raises(RunError, match="spectral radius"):
        lyapunov(radius * np.eye(2), np.eye(2))


@pytest.mark.parametrize("seed", range(4))
def test_predictor_is_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, C = stable(rng, 4, 0.97), rng.standard_normal((2, 4))
    joint = rng.standard_normal((6, 7))
    joint = joint @ joint.T
    Q, cross, R = joint[:4, :4], joint[:4, 4:], joint[4:, 4:]
    S = predictor_covariance(A, C, Q, R, cross)
    np.testing.assert_allclose(S, solve_discrete_are(A.T, C.T, Q, R, s=cross), rtol=1e-8)


def test_predictor_with_a_measurement_that_has_no_noise() -> None:
    A, C = np.array([[0.9, 0.2], [0, 0.7]]), np.array([[1.0, 0]])
    S = predictor_covariance(A, C, np.eye(2), np.zeros((1, 1)))
    np.testing.assert_allclose(riccati_step(A, C, np.eye(2), np.zeros((1, 1)), S), S, rtol=1e-10)


def test_predictor_is_where_the_recursion_ends() -> None:
    A, C = np.array([[0.9, 0.2], [0, 0.7]]), np.array([[1.0, 0]])
    S = np.eye(2)
    for _ in range(200):
        S = riccati_step(A, C, np.eye(2), np.eye(1), S)
    np.testing.assert_allclose(predictor_covariance(A, C, np.eye(2), np.eye(1)), S, rtol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_sylvester_is_scipys_for_many_at_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, C = stable(rng, 5, 0.98), stable(rng, 3, 0.9), rng.standard_normal((4, 5, 3))
    found = sylvester(A, B, C)
    for one, constant in zip(found, C, strict=True):
        expected = solve_sylvester(np.linalg.inv(A), -B.T, np.linalg.inv(A) @ constant)
        np.testing.assert_allclose(one, expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    with pytest.raises(RunError, match=r"spectral radii 1\.1 and 1"):
        sylvester(1.1 * np.eye(2), np.eye(2), np.eye(2))


@pytest.mark.parametrize("radius", [0.9, 1.0, 1.5])
def test_predictor_by_doubling_is_scipys_for_any_state(radius: float) -> None:
    rng = np.random.default_rng(5)
    A, C, root = stable(rng, 4, radius), rng.standard_normal((2, 4)), rng.standard_normal((4, 4))
    Q, R = root @ root.T, np.array([[1.0, 0.2], [0.2, 0.5]])
    expected = solve_discrete_are(A.T, C.T, Q, R)
    np.testing.assert_allclose(predictor_by_doubling(A, C, Q, R), expected, rtol=1e-8)
    if radius < 1:
        np.testing.assert_allclose(predictor_covariance(A, C, Q, R), expected, rtol=1e-8)


def test_what_grows_unmeasured_has_no_predictor() -> None:
    with pytest.raises(RunError, match="a part of the state grows and is not measured"):
        predictor_by_doubling(np.diag([1.2, 0.5]), np.array([[0.0, 1.0]]), np.eye(2), np.eye(1))
