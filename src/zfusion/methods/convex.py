"""Convex programs and minimisation: the only door to cvxpy and scipy, which are the extra `zfusion[design]`.

Nothing on-line needs them: a node runs with numpy and the gains that a design gave it.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zfusion.errors import InputError

MARGIN = 1e-7
"""What every linear matrix inequality keeps from being singular: >= MARGIN I. From 0 to 1e-6 no bound moves in its
fourth digit."""

SOLVERS: Sequence[tuple[str, dict[str, float]]] = (("CLARABEL", {}), ("SCS", {"eps": 1e-7, "time_limit_secs": 120.0}))
"""In the order in which they are tried, with their options. The second one takes up to a hundred times as long."""

ACCEPTED = ("optimal", "optimal_inaccurate")
"""Verdicts of a solver whose result is looked at; whoever designs computes the true cost again."""


class DesignError(InputError):
    """A method cannot be designed for what it was given; the message has the numbers."""


class Solved(NamedTuple):
    """How a convex program was solved."""

    solver: str
    status: str
    seconds: float
    """What the solver says that it took."""


def cvxpy() -> Any:
    """The package; InputError where it is not installed."""
    return _extra("cvxpy", "convex design")


def minimiser() -> Any:
    """`scipy.optimize.minimize`; InputError where scipy is not installed."""
    return _extra("scipy.optimize", "refinement").minimize


def solve(objective: Any, constraints: list[Any], failure: str) -> Solved:
    """Minimise the cvxpy expression `objective`; DesignError, which begins with `failure`, if no solver can."""
    cp = cvxpy()
    problem = cp.Problem(cp.Minimize(objective), constraints)
    verdicts = []
    for solver, options in SOLVERS:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that it is inaccurate, the status says too
                problem.solve(solver=solver, **options)
        except cp.error.SolverError as error:
            verdicts.append(f"{solver}: {error}")
            continue
        if problem.status in ACCEPTED:
            return Solved(solver, problem.status, float(problem.solver_stats.solve_time or 0.0))
        verdicts.append(f"{solver}: {problem.status}")
        if problem.status.startswith(("infeasible", "unbounded")):
            break  # another solver would only take longer to say the same
    raise DesignError(f"{failure} ({'; '.join(verdicts)})")


def positive(blocks: Sequence[Sequence[Any]]) -> Any:
    """The constraint that the symmetric block matrix is >= MARGIN I; blocks above the diagonal may be None."""
    cp = cvxpy()
    full = [[blocks[j][i].T if block is None else block for j, block in enumerate(row)] for i, row in enumerate(blocks)]
    return positive_matrix(cp.bmat(full))


def positive_matrix(matrix: Any) -> Any:
    """The constraint that `matrix`, symmetric but for rounding, is >= MARGIN I."""
    return (matrix + matrix.T) / 2 >> MARGIN * np.eye(matrix.shape[0])


def block_variable(mask: NDArray[np.bool_], rows: Sequence[int], columns: Sequence[int]) -> Any:
    """A matrix of blocks (rows[i], columns[j]): free where mask[i, j], zero elsewhere."""
    cp = cvxpy()
    return cp.bmat(
        [
            [cp.Variable((r, c)) if mask[i, j] else np.zeros((r, c)) for j, c in enumerate(columns)]
            for i, r in enumerate(rows)
        ]
    )


def _extra(module: str, purpose: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise InputError(f"{purpose} needs {package}: pip install 'zfusion[design]'") from None
