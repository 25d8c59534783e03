"""What is checked once, where numbers enter the model, and the square root of a semi-definite matrix.

Everything here refuses and nothing repairs. A *singular* covariance is legal everywhere in the model (common
noises are its rule, not its exception); an indefinite one nowhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from zfusion.errors import InputError, Problem
from zfusion.model.types import Array

INDEFINITE = 1e-9
"""A negative eigenvalue of the matrix scaled to unit diagonal, beyond which it counts as indefinite: far above
what rounding makes of a singular matrix, far below a mistake in an entry."""

SYMMETRY = 1e-12
"""Largest difference between an entry and its mirror image, relative to the two variances."""


class ModelError(InputError, ValueError):
    """A number of the model that cannot be; `problem.field` is relative to the object that refused it."""

    def __init__(self, field: str, value: object, expected: str) -> None:
        self.problem = Problem(field, value, expected)
        super().__init__(str(self.problem))


def finite_number(field: str, value: float) -> float:
    """`value` as a float; ModelError if it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ModelError(field, value, "expected a number")
    if not np.isfinite(value):
        raise ModelError(field, value, "expected a finite number")
    return float(value)


def finite_array(field: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """`value` as a read-only copy of the given shape (None: any size >= 1); ModelError if it is not that."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(field, value, f"expected numbers in an array of shape {_text(shape)}") from None
    fits = array.ndim == len(shape) and all(
        got >= 1 if wanted is None else got == wanted for got, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits:
        raise ModelError(field, array.shape, f"expected an array of shape {_text(shape)}")
    if not np.isfinite(array).all():
        raise ModelError(field, array.tolist(), "expected finite numbers")
    array.setflags(write=False)
    return array


def covariance_matrix(field: str, value: ArrayLike, size: int | None = None) -> Array:
    """`value` as a read-only covariance matrix (size, size); ModelError if asymmetric or indefinite."""
    matrix = finite_array(field, value, (size, size))
    if matrix.shape[0] != matrix.shape[1]:
        raise ModelError(field, matrix.shape, "expected a square matrix")
    scale = np.sqrt(np.abs(np.diag(matrix)))
    if (np.abs(matrix - matrix.T) > SYMMETRY * np.outer(scale, scale)).any():
        raise ModelError(field, matrix.tolist(), "expected a symmetric matrix")
    lowest = lowest_eigenvalue(matrix)
    if lowest < -INDEFINITE:
        raise ModelError(
            field,
            matrix.tolist(),
            f"expected a positive semi-definite matrix; scaled to unit diagonal, its lowest eigenvalue is {lowest:.3g}",
        )
    return matrix


def lowest_eigenvalue(matrix: Array) -> float:
    """Lowest eigenvalue of a symmetric matrix scaled to unit diagonal; -inf if the diagonal forbids a scaling.

    A row of zero variance must be zero altogether: it is left out then, and makes the matrix indefinite otherwise.
    """
    variance = np.diag(matrix)
    live = variance > 0
    if (variance < 0).any() or matrix[~live].any() or matrix[:, ~live].any():
        return -np.inf
    if not live.any():
        return 0.0
    scale = np.sqrt(variance[live])
    return float(np.linalg.eigvalsh(matrix[np.ix_(live, live)] / np.outer(scale, scale))[0])


def semidefinite_factor(matrix: Array, rank_threshold: float = 1e-14) -> Array:
    """L, (n, rank), with L Lᵀ = matrix, for a positive semi-definite matrix (n, n) that may well be singular.

    Eigenvalues of the matrix scaled to unit diagonal that are below `rank_threshold` count as zero.
    """
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    live = scale > 0
    unit = matrix[np.ix_(live, live)] / np.outer(scale[live], scale[live])
    values, vectors = np.linalg.eigh(unit)
    kept = values > rank_threshold
    factor = np.zeros((len(matrix), int(kept.sum())))
    factor[live] = scale[live, None] * vectors[:, kept] * np.sqrt(values[kept])
    return factor


def _text(shape: tuple[int | None, ...]) -> str:
    sizes = ["any" if size is None else str(size) for size in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"
