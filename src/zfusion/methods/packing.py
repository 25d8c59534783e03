"""Symmetric matrices as vectors, (n (n + 1) / 2,): the lower triangle row by row. What a message carries of one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from zfusion.model.types import Array


def packed(matrix: Array) -> Array:
    """The lower triangle, row by row."""
    return matrix[_triangle(len(matrix))]


def unpacked(vector: Array, size: int) -> Array:
    """The symmetric matrix, (size, size), that was packed."""
    rows, columns = _triangle(size)
    matrix = np.empty((size, size))
    matrix[rows, columns] = matrix[columns, rows] = vector
    return matrix


@lru_cache
def _triangle(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.tril_indices(size)
