"""What a network of stationary estimators is designed for: a plant, sensors, and who may use what of whom.

    x(k+1) = A x(k) + B w(k),   y_i(k) = C_i x(k) + D_i v_i(k),   Cov w = W, Cov v_i = V_i, all white and uncorrelated
    ξ_i(k+1) = Σ_j F_ij ξ_j(k) + G_ij y_j(k),   x̂_i(k) = Σ_j H_ij ξ_j(k),   j in N_i

Source: de Souza, Coutinho, Kinnaert, Automatica 72 (2016) 108-114, equations (1)-(8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from zfusion.methods.convex import DesignError
from zfusion.methods.gramians import spectral_radius
from zfusion.methods.plant import Mask, Sensed
from zfusion.model.checks import ModelError, covariance_matrix, finite_array, semidefinite_factor
from zfusion.model.types import Array


@dataclass(frozen=True, eq=False)
class Plant(Sensed):
    """One plant with its sensors, all matrices constant. ModelError unless they fit one another."""

    A: Array
    """(nx, nx)."""
    B: Array
    """(nx, nw)."""
    C: tuple[Array, ...]
    """Each (p_i, nx)."""
    D: tuple[Array, ...]
    """Each (p_i, m_i)."""
    W: Array
    """(nw, nw)."""
    V: tuple[Array, ...]
    """Each (m_i, m_i)."""

    def __post_init__(self) -> None:
        A = finite_array("A", self.A, (None, None))
        nx = A.shape[0]
        if not len(self.C) == len(self.D) == len(self.V) or not self.C:
            raise ModelError("C", len(self.C), "expected one or more C, and as many D and V")
        B = finite_array("B", self.B, (nx, None))
        C = tuple(finite_array(f"C[{i}]", c, (None, nx)) for i, c in enumerate(self.C))
        D = tuple(finite_array(f"D[{i}]", d, (len(C[i]), None)) for i, d in enumerate(self.D))
        V = tuple(covariance_matrix(f"V[{i}]", v, D[i].shape[1]) for i, v in enumerate(self.V))
        fields = {"A": finite_array("A", A, (nx, nx)), "B": B, "C": C, "D": D}
        for name, value in (fields | {"W": covariance_matrix("W", self.W, B.shape[1]), "V": V}).items():
            object.__setattr__(self, name, value)

    @cached_property
    def stacked_C(self) -> Array:
        """col(C_i), (p, nx)."""
        return np.vstack(self.C)

    @cached_property
    def process_root(self) -> Array:
        """B W^½, (nx, rank)."""
        return self.B @ semidefinite_factor(self.W)

    @cached_property
    def sensor_root(self) -> Array:
        """D V^½, block diagonal, (p, rank)."""
        return block_diagonal([d @ semidefinite_factor(v) for d, v in zip(self.D, self.V, strict=True)])

    @cached_property
    def Q(self) -> Array:
        """B W Bᵀ, (nx, nx)."""
        return self.B @ self.W @ self.B.T

    @cached_property
    def R(self) -> Array:
        """D V Dᵀ, block diagonal, (p, p)."""
        return block_diagonal([d @ v @ d.T for d, v in zip(self.D, self.V, strict=True)])


@dataclass(frozen=True, eq=False)
class Problem:
    """A plant, or the vertices of a polytope of plants, and the graph; refuses what cannot be designed for.

    `F`, `G`, `H`: (n, n), True where node i (row) may use j's ξ for its own, j's measurement, j's ξ for its estimate.
    The sum that is minimised weighs node i with `weights[i]` > 0. `center` is the plant of the polytope that the nodes
    believe in; by default the first vertex.
    """

    vertices: tuple[Plant, ...]
    F: Mask
    G: Mask
    H: Mask
    weights: Array
    center: Plant | None = None

    def __post_init__(self) -> None:
        if not self.vertices:
            raise ModelError("vertices", self.vertices, "expected at least one plant")
        first = self.vertices[0]
        named = [(f", vertex {v}" if len(self.vertices) > 1 else "", plant) for v, plant in enumerate(self.vertices)]
        for where, plant in named if self.center is None else [("", self.center), *named]:
            if (plant.nx, plant.ny) != (first.nx, first.ny):
                raise ModelError(f"plants{where}", (plant.nx, plant.ny), f"expected the sizes {(first.nx, first.ny)}")
            radius = spectral_radius(plant.A)
            if radius >= 1:
                raise DesignError(f"A is not asymptotically stable (spectral radius {radius:.6g}{where})")
        for name in ("F", "G", "H"):
            object.__setattr__(self, name, _mask(name, getattr(self, name), first.n))
        weights = finite_array("weights", self.weights, (first.n,))
        if (weights <= 0).any():
            raise ModelError("weights", weights.tolist(), "expected numbers > 0")
        object.__setattr__(self, "weights", weights)

    @classmethod
    def of(
        cls,
        vertices: Plant | Sequence[Plant],
        graph: ArrayLike,
        *,
        exchange_measurements: bool = True,
        weights: ArrayLike = (),
        center: Plant | None = None,
    ) -> Problem:
        """With one graph, γ_ij = 1 where i receives from j; without exchange of measurements G is block diagonal."""
        plants = (vertices,) if isinstance(vertices, Plant) else tuple(vertices)
        mask = _mask("graph", graph, plants[0].n if plants else 0)
        measured = mask if exchange_measurements else np.eye(len(mask), dtype=bool)
        given = np.asarray(weights, dtype=np.float64)
        return cls(plants, mask, measured, mask, given if given.size else np.ones(len(mask)), center)

    @property
    def nominal(self) -> Plant:
        """What the nodes believe in: the center of a polytope that has one, else the first vertex."""
        return self.vertices[0] if self.center is None else self.center

    @property
    def size(self) -> int:
        """N = n nx, of all ξ together."""
        return self.nominal.n * self.nominal.nx

    @cached_property
    def blocks(self) -> Blocks:
        """The masks entry by entry."""
        nx, ny = [self.nominal.nx] * self.nominal.n, self.nominal.ny
        return Blocks(entries(self.F, nx, nx), entries(self.G, nx, ny), entries(self.H, nx, nx))

    @cached_property
    def E(self) -> Array:
        """col(I, ..., I), (N, nx)."""
        return np.tile(np.eye(self.nominal.nx), (self.nominal.n, 1))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Which entries of F (N, N), G (N, p) and H (N, N) are free."""

    F: Mask
    G: Mask
    H: Mask


def entries(mask: Mask, rows: Sequence[int], columns: Sequence[int]) -> Mask:
    """The mask of blocks (rows[i], columns[j]) entry by entry."""
    return np.repeat(np.repeat(mask, rows, axis=0), columns, axis=1)


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """The blocks along the diagonal, zero elsewhere."""
    rows, columns = sum(len(b) for b in blocks), sum(b.shape[1] for b in blocks)
    whole = np.zeros((rows, columns))
    row = column = 0
    for block in blocks:
        whole[row : row + len(block), column : column + block.shape[1]] = block
        row, column = row + len(block), column + block.shape[1]
    return whole


def _mask(name: str, value: ArrayLike, n: int) -> Mask:
    given = finite_array(name, np.asarray(value, dtype=np.float64), (n, n))
    if not np.isin(given, (0.0, 1.0)).all():
        raise ModelError(name, given.tolist(), "expected entries 0 and 1")
    if not given.diagonal().all():
        raise ModelError(name, given.diagonal().tolist(), "expected a diagonal of ones: every node uses its own")
    mask: Mask = given.astype(bool)
    mask.setflags(write=False)
    return mask
