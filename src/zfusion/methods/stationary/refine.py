"""Beyond the convex designs: descent on the true cost from any stable start, over the free entries of F and G.

Estimators of the observer type stay of that type: what is free of them is G and the F between nodes.

For one plant H is eliminated (`best_output`), and by the envelope theorem the gradients at that H are those of what
is left. For a polytope H is free too, and the soft maximum of the vertices' costs is minimised: no certificate for
the plants between the vertices, but closer to the worst case than any.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from zfusion.errors import InputError
from zfusion.methods.convex import DesignError, minimiser
from zfusion.methods.gramians import lyapunov, spectral_radius
from zfusion.methods.stationary.cost import Gains, best_output, extended, gradients, rescaled
from zfusion.methods.stationary.doubt import Doubted
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.model.types import Array

NO_COST = 1e6
"""What an unstable or nearly unstable network costs: the line search comes back from it."""

STABLE = 0.99999
"""Spectral radius from which on it is nearly unstable."""

SHARPNESSES = (100.0, 400.0, 1600.0, 6400.0)
"""Of the soft maximum, in turn, times the ratio of a cost to that of the start: at the last one costs that are 0.1 %
apart count as 1 to 600. The sharp one alone creeps along the edges where two vertices cost the same."""

OPTIONS = {"maxiter": 2000, "maxfun": 4000, "ftol": 1e-10, "gtol": 1e-9, "maxcor": 30}

SHARP_OPTIONS = OPTIONS | {"maxiter": 400, "maxfun": 800}
"""At each sharpness."""

DOUBT_OPTIONS = OPTIONS | {"maxiter": 300, "maxfun": 600, "ftol": 1e-7}
"""With doubt, where the last digits do not matter."""


class Refined(NamedTuple):
    """What the descent found."""

    gains: Gains
    iterations: int
    message: str
    """Why it ended, in the words of the minimiser."""


def refine(problem: Problem, start: Gains, doubt: float = 0.0, *, observer: bool = False) -> Refined:
    """Descend from `start`, which must be stable; see the module `doubt` for what that is.

    With `observer` it stays of that type: `start` must be, for one plant. InputError where scipy is not installed, and
    for a doubt on a polytope or of an observer; DesignError where the start is not stable under the doubt.
    """
    if doubt and len(problem.vertices) > 1:
        raise InputError("stationary: a descent with doubt is for one plant, not for a polytope")
    if doubt and observer:
        raise InputError("stationary: a descent with doubt is not for the observer type")
    if observer:
        return _descend(_Observer(problem, start), start, OPTIONS)
    if doubt:
        return _descend(_WithDoubt(problem, start, doubt), start, DOUBT_OPTIONS)
    if len(problem.vertices) > 1:
        return _sharper_and_sharper(problem, start)
    return _descend(_Nominal(problem, start), start, OPTIONS)


def _descend(search: _Nominal, start: Gains, options: Mapping[str, float]) -> Refined:
    found = minimiser()(search.cost, search.pack(start), jac=True, method="L-BFGS-B", options=options)
    return Refined(search.unpack(found.x), int(found.nit), str(found.message))


def _sharper_and_sharper(problem: Problem, start: Gains) -> Refined:
    """For a polytope; each time in coordinates that suit what was found by then."""
    found, iterations = Refined(start, 0, ""), 0
    for sharpness in SHARPNESSES:
        gains = found.gains
        balanced = rescaled(problem, gains, _covariance(problem.nominal, gains.F, gains.G))
        found = _descend(_Polytope(problem, start, sharpness), balanced, SHARP_OPTIONS)
        iterations += found.iterations
    return found._replace(iterations=iterations)


class _Nominal:
    """The true cost of one plant as a function of the free entries of F and G."""

    def __init__(self, problem: Problem, start: Gains) -> None:
        self._problem = problem
        self._free = problem.blocks
        self._size = int(self._free.F.sum())
        self._shapes = start.F.shape, start.G.shape, start.H.shape

    def pack(self, gains: Gains) -> Array:
        """The free entries in a row."""
        return np.concatenate((gains.F[self._free.F], gains.G[self._free.G]))

    def unpack(self, entries: Array) -> Gains:
        """The gains with these free entries and the best H."""
        F, G = self._dynamics(entries)
        return Gains(F, G, best_output(self._problem, _covariance(self._problem.nominal, F, G)))

    def cost(self, entries: Array) -> tuple[float, Array]:
        """J and its derivatives."""
        F, G = self._dynamics(entries)
        plant = self._problem.nominal
        if not _is_stable(F):
            return NO_COST, np.zeros_like(entries)
        P = _covariance(plant, F, G)
        J, slope = gradients(self._problem, plant, Gains(F, G, best_output(self._problem, P)), P)
        return J, self.pack(slope)

    def _dynamics(self, entries: Array) -> tuple[Array, Array]:
        F, G = np.zeros(self._shapes[0]), np.zeros(self._shapes[1])
        F[self._free.F] = entries[: self._size]
        G[self._free.G] = entries[self._size : self._size + int(self._free.G.sum())]
        return F, G


class _Observer(_Nominal):
    """The same of estimators that are unbiased whatever x does: F E - G C = E A, H = -I, so F_ii follows from the rest.

    F_ii = A + Σ_j G_ij C_j - Σ_{j≠i} F_ij
    """

    def __init__(self, problem: Problem, start: Gains) -> None:
        super().__init__(problem, start)
        n, nx = problem.nominal.n, problem.nominal.nx
        self._own = np.kron(np.eye(n), np.ones((nx, nx))).astype(bool)
        self._free = replace(self._free, F=self._free.F & ~self._own)
        self._size = int(self._free.F.sum())

    def unpack(self, entries: Array) -> Gains:
        """The gains with these free entries."""
        return Gains(*self._dynamics(entries), -np.eye(self._problem.size))

    def cost(self, entries: Array) -> tuple[float, Array]:
        """J and its derivatives: what moves F_ij or G_ij moves F_ii, too."""
        gains, plant = self.unpack(entries), self._problem.nominal
        if not _is_stable(gains.F):
            return NO_COST, np.zeros_like(entries)
        J, slope = gradients(self._problem, plant, gains, _covariance(plant, gains.F, gains.G))
        own = np.where(self._own, slope.F, 0.0) @ self._problem.E
        dF = slope.F - own @ self._problem.E.T
        return J, self.pack(Gains(dF, slope.G + own @ plant.stacked_C.T, slope.H))

    def _dynamics(self, entries: Array) -> tuple[Array, Array]:
        F, G = super()._dynamics(entries)
        problem, plant = self._problem, self._problem.nominal
        own = problem.E @ plant.A + G @ plant.stacked_C - F @ problem.E
        return F + np.where(self._own, own @ problem.E.T, 0.0), G


class _WithDoubt(_Nominal):
    """The same under doubt."""

    def __init__(self, problem: Problem, start: Gains, doubt: float) -> None:
        super().__init__(problem, start)
        self._doubted = Doubted(problem, doubt)

    def unpack(self, entries: Array) -> Gains:
        """The gains with these free entries and the best H under doubt."""
        F, G = self._dynamics(entries)
        P = self._doubted.covariance(F, G)
        if P is None:
            raise DesignError("the descent has no start: with so much doubt the estimators are not stable")
        return Gains(F, G, self._doubted.best_output(P))

    def cost(self, entries: Array) -> tuple[float, Array]:
        """J and its derivatives."""
        F, G = self._dynamics(entries)
        found = self._doubted.cost(F, G) if _is_stable(F) else None
        if found is None:
            return NO_COST, np.zeros_like(entries)
        return found[0], self.pack(found[1])


class _Polytope(_Nominal):
    """The soft maximum of the vertices' costs as a function of the free entries of F, G and H."""

    def __init__(self, problem: Problem, start: Gains, sharpness: float) -> None:
        super().__init__(problem, start)
        costs = [self._vertex(plant, start)[0] for plant in problem.vertices]
        self._sharpness = sharpness / max(costs)

    def pack(self, gains: Gains) -> Array:
        """The free entries in a row."""
        return np.concatenate((super().pack(gains), gains.H[self._free.H]))

    def unpack(self, entries: Array) -> Gains:
        """The gains with these free entries."""
        H = np.zeros(self._shapes[2])
        H[self._free.H] = entries[len(entries) - int(self._free.H.sum()) :]
        return Gains(*self._dynamics(entries), H)

    def cost(self, entries: Array) -> tuple[float, Array]:
        """log Σ_v exp(sharpness J_v) / sharpness, and its derivatives."""
        gains = self.unpack(entries)
        if not _is_stable(gains.F):
            return NO_COST, np.zeros_like(entries)
        found = [self._vertex(plant, gains) for plant in self._problem.vertices]
        costs = np.array([J for J, _ in found])
        shares = np.exp(self._sharpness * (costs - costs.max()))
        soft = costs.max() + np.log(shares.sum()) / self._sharpness
        slope: Array = (shares / shares.sum()) @ np.array([self.pack(slope) for _, slope in found])
        return float(soft), slope

    def _vertex(self, plant: Plant, gains: Gains) -> tuple[float, Gains]:
        return gradients(self._problem, plant, gains, _covariance(plant, gains.F, gains.G))


def _covariance(plant: Plant, F: Array, G: Array) -> Array:
    A_e, B_e = extended(plant, F, G)
    return lyapunov(A_e, B_e @ B_e.T)


def _is_stable(F: Array) -> bool:
    """Whether the stationary covariance can be computed with; the plants themselves are stable, `Problem` saw to it."""
    return bool(np.isfinite(F).all()) and spectral_radius(F) < STABLE
