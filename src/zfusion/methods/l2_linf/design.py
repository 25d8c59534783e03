"""A design of the method `l2_linf`: made off-line, certified, kept in a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from zfusion.methods import design_files
from zfusion.methods.convex import DesignError
from zfusion.methods.family import Forecast
from zfusion.methods.l2_linf.alternation import alternate as alternated_gains
from zfusion.methods.l2_linf.lmi import SLACK_FAILURE, Designed, Form, diagonal_design, slack_design
from zfusion.methods.l2_linf.problem import Gains, Problem
from zfusion.methods.l2_linf.verify import certify, lower_bound, node_errors, radius, worst_disturbance
from zfusion.model.types import Array, NodeId, sorted_ids

METHOD = "l2_linf"

TAUS = (-0.3, -0.2, -0.1, -0.05, 0.0, 0.1)
"""What is tried of the slack's free number: γ is convex-looking in it, and flat near its best."""

TOLERANCE = 1e-4
"""By how much of itself the certified γ may exceed the designed one: the solver's accuracy where both are tight."""

FIELDS = ("form", "gamma", "certified", "radius", "worst", "worst_disturbance", "solver", "rounds", "solver_seconds")
OPTIONAL = ("tau", "lower_bound")


@dataclass(frozen=True, eq=False)
class Design(design_files.Stored):
    """The gains of all nodes by mode, and what is known of them."""

    ids: tuple[NodeId, ...]
    """The nodes, sorted: the order of all rows and columns."""
    problem: Problem
    gains: Gains
    form: str
    """"general" or "observer"."""
    gamma: float
    """What the convex design promised: sup |z̃(k)|² < γ² Σ |w|², in the mean over misses and modes."""
    certified: float
    """The same, for these very filters: the smallest that a full Lyapunov function proves."""
    radius: float
    """Mean-square spectral radius: below 1."""
    worst: float
    """What a disturbance reaches that does not see misses and modes: no γ below it is true."""
    worst_disturbance: Array
    """That disturbance, of unit energy, (horizon, nw)."""
    solver: str
    """Which one, and its verdict."""
    solver_seconds: float
    rounds: int = 0
    """Of the alternation."""
    tau: float | None = None
    """Of the slack; None where the Lyapunov function is the paper's diag(R, Q(s))."""
    lower_bound: float | None = None
    """What no linear filter can beat, where that is known."""

    @property
    def forecast(self) -> Forecast:
        """Of the one-step predictors; gammas are for disturbances in units of their standard deviations."""
        totals: dict[str, float | str | None] = {
            "gamma": self.gamma,
            "gamma_certified": self.certified,
            "gamma_reached": self.worst,
            "gamma_lower_bound": self.lower_bound,
            "radius": self.radius,
        }
        totals |= {"form": self.form, "tau": self.tau, "rounds": float(self.rounds)}
        totals |= {"solver": self.solver, "solver_seconds": self.solver_seconds}
        return Forecast(
            totals,
            {"mse": node_errors(self.problem, self.gains).tolist()},
            ("the method bounds the worst case; errors by node are those under the system's own noises",),
        )

    @property
    def fingerprint(self) -> str:
        """Of the problem that it solves."""
        return fingerprint(self.ids, self.problem)

    def edge(self, mode: int, receiver: NodeId, sender: NodeId) -> tuple[Array, Array]:
        """K_ij (nx, nx) and H_ij (nx, p_j) of a mode; ValueError for an unknown node."""
        i, j, nx = self.ids.index(receiver), self.ids.index(sender), self.problem.nx
        at = slice(i * nx, (i + 1) * nx)
        return self.gains.K[mode, at, j * nx : (j + 1) * nx], self.gains.H[mode, at, self.problem.rows(j)]

    def packed(self) -> bytes:
        """See `Stored`."""
        problem = self.problem
        arrays: dict[str, Any] = {"ids": design_files.stored_ids(self.ids), **self.gains._asdict(), "ny": problem.ny}
        arrays |= {
            f"plant_{name}": getattr(problem, name) for name in ("A", "B", "M", "arrival", "modes", "transition")
        }
        arrays |= {"plant_C": np.vstack(problem.C), "plant_D": problem.stacked_D}
        arrays |= {name: getattr(self, name) for name in FIELDS}
        arrays |= {name: value for name in OPTIONAL if (value := getattr(self, name)) is not None}
        return design_files.packed(METHOD, self.fingerprint, arrays)

    @classmethod
    def unpack(cls, content: design_files.Content, made_for: str | None = None) -> Self:
        """See `Stored`."""
        arrays: dict[str, Any] = design_files.unpack(content, METHOD, made_for)
        ends = np.cumsum(arrays["ny"]).tolist()
        rows = [slice(end - size, end) for end, size in zip(ends, arrays["ny"].tolist(), strict=True)]
        C, D = (tuple(arrays[f"plant_{name}"][at] for at in rows) for name in "CD")
        rest = (arrays[f"plant_{name}"] for name in ("M", "arrival", "modes", "transition"))
        problem = Problem(arrays["plant_A"], arrays["plant_B"], C, D, *rest)
        told = {name: arrays[name] for name in (*FIELDS, *OPTIONAL) if name in arrays}
        told = {name: value.tolist() if value.ndim == 0 else value for name, value in told.items()}
        return cls(tuple(arrays["ids"].tolist()), problem, Gains(arrays["K"], arrays["H"]), **told)


def make_design(
    ids: tuple[NodeId, ...],
    problem: Problem,
    form: Form = Form.GENERAL,
    *,
    slack: bool = False,
    alternate: bool = False,
) -> Design:
    """Design filters for all modes.

    `slack`: a full Lyapunov function with a slack matrix, scanned over TAUS: better, and slower. `alternate`: go on
    with the alternation. DesignError where it is infeasible or the certificate contradicts the design; InputError
    without cvxpy.
    """
    if list(ids) != sorted_ids(ids) or len(ids) != problem.n:
        raise ValueError(f"expected {problem.n} ids in sorted order: {ids}")
    tau, designed = _scanned(problem, form) if slack else (None, diagonal_design(problem, form))
    gains, rounds = designed.gains, 0
    if alternate:
        gains, certificate, rounds = alternated_gains(problem, gains, form)
    else:
        certificate = certify(problem, gains)
    if not certificate.gamma <= designed.gamma * (1 + TOLERANCE):
        raise DesignError(
            f"numerical trouble: designed for gamma = {designed.gamma:.6g}, the analysis says {certificate.gamma:.6g}"
        )
    worst = worst_disturbance(problem, gains)
    return Design(
        ids,
        problem,
        gains,
        form=form.value,
        gamma=designed.gamma,
        certified=certificate.gamma,
        radius=radius(problem, gains),
        worst=worst.gain,
        worst_disturbance=worst.disturbance,
        solver=f"{designed.solved.solver}: {designed.solved.status}",
        solver_seconds=designed.solved.seconds,
        rounds=rounds,
        tau=tau,
        lower_bound=lower_bound(problem),
    )


def fingerprint(ids: tuple[NodeId, ...], problem: Problem) -> str:
    """Of a problem. Roots of the same covariances give the same: what counts is B Bᵀ, B Dᵀ and D Dᵀ."""
    B, D = problem.B, problem.stacked_D
    parts: list[tuple[str, object]] = [
        ("ids", str(ids)),
        ("A", problem.A),
        ("C", np.vstack(problem.C)),
        ("M", problem.M),
    ]
    parts += [("Q", B @ B.T), ("S", B @ D.T), ("R", D @ D.T), ("arrival", problem.arrival)]
    parts += [("modes", problem.modes > 0), ("transition", problem.transition)]
    return design_files.fingerprint(parts)


def _scanned(problem: Problem, form: Form) -> tuple[float, Designed]:
    """The best of the slack designs over TAUS."""
    found: list[tuple[float, Designed]] = []
    for tau in TAUS:
        try:
            found.append((tau, slack_design(problem, tau, form)))
        except DesignError:
            continue  # not every number has a design
    if not found:
        raise DesignError(f"{SLACK_FAILURE}: for none of tau = {', '.join(map(str, TAUS))}")
    return min(found, key=lambda pair: pair[1].gamma)
