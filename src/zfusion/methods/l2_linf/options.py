"""What a scenario may say of the method `l2_linf`, and the design that this makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from zfusion.methods.l2_linf.design import Design, fingerprint, make_design
from zfusion.methods.l2_linf.lmi import Form
from zfusion.methods.l2_linf.mapping import problem_of
from zfusion.model.checks import ModelError, finite_array
from zfusion.model.network import Network
from zfusion.model.system import System


@dataclass(frozen=True)
class L2LinfOptions:
    """Options of the design. ModelError for what cannot be."""

    form: str = "general"
    """Or "observer"."""
    slack: bool = False
    """See `make_design`, as for the next one."""
    alternate: bool = False
    output: Sequence[Sequence[float]] | None = None
    """M, (nz, nx): what of the state the bound is about; by default all of it."""

    def __post_init__(self) -> None:
        known = [form.value for form in Form]
        if self.form not in known:
            raise ModelError("form", self.form, f"expected one of {known}")
        for name in ("slack", "alternate"):
            if not isinstance(getattr(self, name), bool):
                raise ModelError(name, getattr(self, name), "expected true or false")
        if self.output is not None:
            finite_array("output", np.asarray(self.output), (None, None))

    def fingerprint(self, system: System, modes: Sequence[Network], transition: ArrayLike = ((1.0,),)) -> str:
        """Of what is designed for; InputError as `problem_of`."""
        return fingerprint(system.ids, problem_of(system, modes, transition, self.output))

    def design(self, system: System, modes: Sequence[Network], transition: ArrayLike = ((1.0,),)) -> Design:
        """Design filters for all modes. DesignError and InputError as `problem_of` and `make_design`."""
        problem = problem_of(system, modes, transition, self.output)
        return make_design(system.ids, problem, Form(self.form), slack=self.slack, alternate=self.alternate)
