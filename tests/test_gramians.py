"""Lyapunov and Riccati equations, against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from zfusion.errors import RunError
from zfusion.methods.gramians import lyapunov, predictor_covariance, riccati_step, spectral_radius
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
