"""What a scenario may say of the method `stationary`, and the design that this makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

from zfusion.methods.stationary.design import Design, fingerprint, make_design
from zfusion.methods.stationary.lmi import Choice, Gramian
from zfusion.methods.stationary.mapping import problem_of
from zfusion.methods.stationary.polytope import Vertex, check_inside, vertices_of
from zfusion.methods.stationary.problem import Problem
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
    vertices: Sequence[Mapping[str, object]] | None = None
    """Of a polytope of systems for all of which one design is to be good; see the module `polytope`."""

    def __post_init__(self) -> None:
        known = [gramian.value for gramian in Gramian]
        if self.gramian not in known:
            raise ModelError("gramian", self.gramian, f"expected one of {known}")
        for field in fields(self):
            value = getattr(self, field.name)
            allowed = (bool, type(None)) if field.name == "refine" else (bool,)
            if field.name not in ("gramian", "doubt", "vertices") and not isinstance(value, allowed):
                raise ModelError(field.name, value, "expected true or false")
        doubt = self.doubt
        if doubt is not None and (isinstance(doubt, bool) or not isinstance(doubt, int | float) or not doubt >= 0):
            raise ModelError("doubt", doubt, "expected a number >= 0")
        if self.polytope and (doubt or self.observer):
            name = "doubt" if doubt else "observer"
            raise ModelError(name, getattr(self, name), "expected none of it beside vertices: it is for one system")

    @cached_property
    def polytope(self) -> tuple[Vertex, ...]:
        """The vertices; none where there is one system. ModelError for what is no vertex."""
        return () if self.vertices is None else vertices_of(self.vertices)

    @property
    def choice(self) -> Choice:
        """Of the convex design; InputError for what does not go together."""
        return Choice(Gramian(self.gramian), self.plain, self.worst_node, self.observer)

    def problem(self, system: System, network: Network) -> Problem:
        """What is designed for; InputError as `problem_of`."""
        return problem_of(system, network, exchange_measurements=self.exchange_measurements, vertices=self.polytope)

    def fingerprint(self, system: System, network: Network) -> str:
        """Of what is designed for; InputError as `problem_of`."""
        return fingerprint(system.ids, self.problem(system, network))

    def design(self, system: System, network: Network) -> Design:
        """Design the network: seconds to minutes. DesignError and InputError as `problem_of` and `make_design`."""
        problem = self.problem(system, network)
        if self.polytope:
            check_inside(problem)
        return make_design(system.ids, problem, self.choice, refine=self.refine, doubt=self.doubt)
