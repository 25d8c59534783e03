"""What a scenario may say of the method `stationary`, and the design that this makes."""

from __future__ import annotations

from dataclasses import dataclass, fields

from zfusion.methods.stationary.design import Design, fingerprint, make_design
from zfusion.methods.stationary.lmi import Choice, Gramian
from zfusion.methods.stationary.mapping import problem_of
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System


@dataclass(frozen=True)
class StationaryOptions:
    """Options of the design, and one of the filter. ModelError for what cannot be."""

    gramian: str = "observability"
    """Or "controllability"."""
    plain: bool = False
    """See `Choice`, as for the next two."""
    worst_node: bool = False
    observer: bool = False
    exchange_measurements: bool = True
    """Whether neighbours' measurements are used, or their ξ only."""
    refine: bool | None = None
    """See `make_design`, as for the next one."""
    doubt: float | None = None
    filtered: bool = False
    """Whether the estimate uses the step's measurements: x̂_{k/k} in the place of the method's one-step predictor."""

    def __post_init__(self) -> None:
        known = [gramian.value for gramian in Gramian]
        if self.gramian not in known:
            raise ModelError("gramian", self.gramian, f"expected one of {known}")
        for field in fields(self):
            value = getattr(self, field.name)
            allowed = (bool, type(None)) if field.name == "refine" else (bool,)
            if field.name not in ("gramian", "doubt") and not isinstance(value, allowed):
                raise ModelError(field.name, value, "expected true or false")
        doubt = self.doubt
        if doubt is not None and (isinstance(doubt, bool) or not isinstance(doubt, int | float) or not doubt >= 0):
            raise ModelError("doubt", doubt, "expected a number >= 0")

    @property
    def choice(self) -> Choice:
        """Of the convex design; InputError for what does not go together."""
        return Choice(Gramian(self.gramian), self.plain, self.worst_node, self.observer)

    def fingerprint(self, system: System, network: Network) -> str:
        """Of what is designed for; InputError as `problem_of`."""
        problem = problem_of(system, network, exchange_measurements=self.exchange_measurements)
        return fingerprint(system.ids, problem)

    def design(self, system: System, network: Network) -> Design:
        """Design the network: seconds to minutes. DesignError and InputError as `problem_of` and `make_design`."""
        problem = problem_of(system, network, exchange_measurements=self.exchange_measurements)
        return make_design(system.ids, problem, self.choice, refine=self.refine, doubt=self.doubt)
