"""What a message carries of a matrix, and what no honest neighbour can have put into one.

Symmetric matrices go as vectors, (n (n + 1) / 2,): the lower triangle row by row.
"""

from __future__ import annotations

from functools import lru_cache
from math import isqrt
from typing import cast

import numpy as np
from numpy.typing import NDArray

from zfusion.methods.protocol import Fields
from zfusion.model.checks import lowest_eigenvalue
from zfusion.model.types import Array

IMPOSSIBLE = "impossible"
"""The word under which a message is counted that no honest neighbour can have sent."""

LARGEST = 1e100
"""Largest number that is believed: its products with two others can be represented."""

SINGULAR = 1e-13
"""Lowest eigenvalue of a matrix scaled to unit diagonal, up to which it is not believed to be positive definite."""

NEGATIVE = 1e-9
"""The same, below zero, up to which a matrix may be positive semi-definite: what rounding makes of one is less."""

ASYMMETRIC = 1e-9
"""Difference of an entry and its mirror image, relative to the two variances, that is not rounding."""


def packed(matrix: Array) -> Array:
    """The lower triangle, row by row."""
    return matrix[_triangle(len(matrix))]


def unpacked(vector: Array, size: int | None = None) -> Array:
    """The symmetric matrix, (size, size), that was packed."""
    size = (isqrt(8 * len(vector) + 1) - 1) // 2 if size is None else size
    rows, columns = _triangle(size)
    matrix = np.empty((size, size))
    matrix[rows, columns] = matrix[columns, rows] = vector
    return matrix


def too_large(fields: Fields, *names: str) -> bool:
    """Whether a field, where it is there, has a number that is not believed."""
    values = (cast("Array | None", fields[name]) for name in names)
    return any(value is not None and not np.abs(value).max(initial=0.0) <= LARGEST for value in values)


def is_definite(matrix: Array) -> bool:
    """Whether a matrix is symmetric and positive definite, safely enough to be inverted."""
    variances = matrix.diagonal()
    if not (variances >= 1.0 / LARGEST).all():
        return False
    scale = np.sqrt(variances)
    skewed = np.abs(matrix - matrix.T) > ASYMMETRIC * np.multiply.outer(scale, scale)
    return not skewed.any() and lowest_eigenvalue(matrix) > SINGULAR


def is_semidefinite(matrix: Array) -> bool:
    """Whether a symmetric matrix can be positive semi-definite."""
    return lowest_eigenvalue(matrix) >= -NEGATIVE


@lru_cache
def _triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.tril_indices(size)
