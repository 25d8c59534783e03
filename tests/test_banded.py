"""Square roots of block-tridiagonal covariances, singular ones above all, and what is refused."""

from __future__ import annotations

from itertools import islice, pairwise

import numpy as np
import pytest

from zfusion.model.banded import SLACK, Indefinite, RootRow, root_rows, spectral_floor

rng = np.random.default_rng(17)


def moving_average(M0: np.ndarray, M1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Γ0 and Γ1 of z_k = M0 u_k + M1 u_{k-1}."""
    return M0 @ M0.T + M1 @ M1.T, M1 @ M0.T


def largest_error(rows: list[RootRow], G0: np.ndarray, G1: np.ndarray) -> float:
    """Of the covariances that the rows have, in units of the variances."""
    scale = np.sqrt(np.outer(np.diag(G0), np.diag(G0)))
    same = [np.abs(row.A @ row.A.T + row.B @ row.B.T - G0) / scale for row in rows]
    apart = [np.abs(now.B @ then.A.T - G1) / scale for then, now in pairwise(rows)]
    return float(np.max(same + apart))


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (3, 6), (5, 1), (5, 2), (10, 9)])
@pytest.mark.parametrize("kind", ["any", "unit root", "delay", "backwards"])
def test_rows_have_the_covariances_however_singular(shape: tuple[int, int], kind: str) -> None:
    """Fewer sources than components, noise that is known from the past, unit roots, non-invertible averages."""
    M0, M1 = rng.normal(size=(2, *shape))
    if kind == "unit root":
        M1 = M0
    elif kind == "delay":
        M0[::2], M1[1::2] = 0, 0
    elif kind == "backwards":
        M0 = 0.1 * M0
    live = (M0 != 0).any(axis=1) | (M1 != 0).any(axis=1)
    G0, G1 = moving_average(M0[live], M1[live])
    assert spectral_floor(G0, G1) > -1e-13
    rows = list(islice(root_rows(lambda k: (G0, G1), 1), 300))
    assert not rows[0].B.any()
    assert largest_error(rows, G0, G1) < 2 * SLACK


def test_rows_settle_and_are_then_the_same_object() -> None:
    rows = list(islice(root_rows(lambda k: (np.eye(2), 0.3 * np.eye(2)), 1), 200))
    assert rows[-1] is rows[-2]
    assert rows[-1].A[0, 0] ** 2 == pytest.approx(0.9)  # x = 1 - 0.3² / x
    assert rows[0].A[0, 0] == pytest.approx(1)


def test_rows_follow_covariances_that_vary() -> None:
    """Against a dense Cholesky factorisation of the whole, with a component that is absent now and then."""
    M = rng.normal(size=(8, 2, 3, 3))
    M[4, :, 1] = 0

    def blocks(k: int) -> tuple[np.ndarray, np.ndarray]:
        return M[k, 0] @ M[k, 0].T + M[k, 1] @ M[k, 1].T, M[k, 1] @ M[k - 1, 0].T

    rows = list(islice(root_rows(blocks, None), 7))
    root = np.zeros((21, 21))
    whole = np.zeros((21, 21))
    for n, row in enumerate(rows):
        at, before = slice(3 * n, 3 * n + 3), slice(3 * n - 3, 3 * n)
        root[at, at] = row.A
        whole[at, at] = blocks(n + 1)[0]
        if n:
            root[at, before] = row.B
            whole[at, before] = blocks(n + 1)[1]
            whole[before, at] = whole[at, before].T
    assert np.abs(root @ root.T - whole).max() < 1e-11 * np.abs(whole).max()


def test_spectral_floor_is_exact() -> None:
    """1 + 2 g cos θ has its minimum 1 - 2 |g|; a grid that misses θ = 2.2 would not find the second one."""
    assert spectral_floor(np.eye(1), np.array([[-0.5]])) == pytest.approx(0, abs=1e-15)
    assert spectral_floor(np.array([[4.0]]), np.array([[2.4]])) == pytest.approx(-0.2)
    turn = np.array([[np.cos(2.2), np.sin(2.2)], [-np.sin(2.2), np.cos(2.2)]])
    assert spectral_floor(np.eye(2), -0.5 * turn) == pytest.approx(0, abs=1e-12)
    assert spectral_floor(np.zeros((2, 2)), np.zeros((2, 2))) == 0
    assert spectral_floor(np.diag([1.0, 0.0]), np.array([[0.0, 0.1], [0.0, 0.0]])) == -np.inf


@pytest.mark.parametrize(
    ("G0", "G1"),
    [
        ([[1, 2], [2, 1]], [[0, 0], [0, 0]]),
        ([[1, 0], [0, 1]], [[0.51, 0], [0, 0]]),
        ([[1, 0], [0, 0]], [[0, 0.1], [0, 0]]),
        ([[1, 1], [1, 1]], [[0.3, -0.3], [0.3, 0.3]]),
    ],
)
def test_what_no_sequence_has_is_refused(G0, G1) -> None:
    blocks = np.array(G0, float), np.array(G1, float)
    assert spectral_floor(*blocks) < -SLACK
    with pytest.raises(Indefinite):
        list(islice(root_rows(lambda k: blocks, 1), 100))
