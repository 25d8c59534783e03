"""What the plants have in common that constant gains are designed for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zfusion.model.types import Array

Mask = NDArray[np.bool_]
"""True where a node (row) may use what another (column) has."""


class Sensed:
    """A plant x(k+1) = A x(k) + ..., and sensors y_i(k) = C_i x(k) + ... of it, one a node."""

    A: Array
    """(nx, nx)."""
    C: tuple[Array, ...]
    """Each (p_i, nx)."""

    @property
    def n(self) -> int:
        """Number of nodes."""
        return len(self.C)

    @property
    def nx(self) -> int:
        """Size of the state."""
        return len(self.A)

    @property
    def ny(self) -> tuple[int, ...]:
        """p_i, the sizes of the measurements."""
        return tuple(len(c) for c in self.C)
