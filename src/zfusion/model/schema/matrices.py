"""How a scenario writes matrices: fixed or random, constant or varying with time.

0.95   [[1, 1], [0, 1]]   { diagonal = [1, 1] }                        fixed
{ terms = [{ matrix = .., variables = [..] }, ..], variables = {..} }  random, by distribution
{ mean = .., covariance = .. }                                         random, by moments
{ sequence = [.., ..], after = "cycle" | "hold" }                      one for each step
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields
from functools import cached_property
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

import numpy as np
from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    PlainSerializer,
    PlainValidator,
    Tag,
    model_validator,
)

from zfusion.errors import Problem
from zfusion.model.distributions import Bernoulli, Discrete, Distribution, Exponential, Normal, Uniform
from zfusion.model.matrices import ByMoments, Fixed, RandomMatrix, Schedule, Terms
from zfusion.model.schema.base import Covariance, Matrix, Spec, shortest, vector
from zfusion.model.schema.problems import NOT_GIVEN, Faults, unknown_key
from zfusion.model.types import Array

T = TypeVar("T")
S = TypeVar("S")

LAWS: Mapping[str, type[Distribution]] = {
    "normal": Normal,
    "uniform": Uniform,
    "bernoulli": Bernoulli,
    "discrete": Discrete,
    "exponential": Exponential,
}
"""The distributions by the name that a scenario gives them; their parameters are the keys beside it."""

SHAPES: Mapping[str, Distribution] = {
    "normal": Normal(),
    "uniform": Uniform(-1.0, 1.0),
    "exponential": Exponential(1.0),
}
"""What a distribution's bare name stands for where mean and variance do not matter."""


def _distribution(value: object) -> Distribution:
    if isinstance(value, Distribution):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("expected a table { distribution = .., and its parameters }")
    law = LAWS.get(str(value.get("distribution")))
    if law is None:
        wrong = value.get("distribution", NOT_GIVEN)
        raise Faults([Problem("distribution", wrong, f"expected one of {', '.join(LAWS)}")])
    parameters = {key: item for key, item in value.items() if key != "distribution"}
    faults = list(_parameter_faults(law, parameters))
    if faults:
        raise Faults(faults)
    return law(**parameters)


def _parameter_faults(law: type[Distribution], parameters: Mapping[str, Any]) -> Iterator[Problem]:
    """Parameters that the law does not have, or that it needs, and lists that are not of numbers."""
    required = {parameter.name: parameter.default is MISSING for parameter in fields(law)}  # type: ignore[arg-type]
    for key, item in parameters.items():
        if key not in required:
            yield unknown_key(key, item, required)
        elif isinstance(item, list | tuple):
            try:
                vector(item)
            except ValueError as error:
                yield Problem(key, item, str(error))
    for key, is_required in required.items():
        if is_required and key not in parameters:
            yield Problem(key, NOT_GIVEN, "required")


def _written(law: Distribution) -> dict[str, Any]:
    name = next(name for name, known in LAWS.items() if type(law) is known)
    parameters = {parameter.name: getattr(law, parameter.name) for parameter in fields(law)}  # type: ignore[arg-type]
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in parameters.items()}
    return {"distribution": name, **plain}


DistributionSpec = Annotated[
    Distribution, PlainValidator(_distribution), PlainSerializer(_written, return_type=dict[str, Any])
]
"""{ distribution = "uniform", low = 0.3, high = 0.7 }, or in Python the distribution itself."""

ShapeSpec = Annotated[
    DistributionSpec, BeforeValidator(lambda value: SHAPES.get(value, value) if isinstance(value, str) else value)
]
"""The same where only the shape matters, so that "uniform" says enough."""


class TermSpec(Spec):
    """matrix times the product of the variables; a variable named n times counts to the power n."""

    matrix: Matrix
    variables: tuple[str, ...] = ()


class TermsSpec(Spec):
    """The sum of terms, with independent scalar variables drawn afresh at each step."""

    terms: Annotated[tuple[TermSpec, ...], Field(min_length=1)]
    variables: dict[str, DistributionSpec] = Field(default_factory=dict)

    @cached_property
    def numeric(self) -> RandomMatrix:
        """What the numerics work with."""
        terms = tuple((np.array(term.matrix), term.variables) for term in self.terms)
        return Terms(terms, self.variables)

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.numeric  # noqa: B018 - raises what is wrong with it
        return self


class MomentsSpec(Spec):
    """A random matrix of which mean and covariance of the entries, in row-major order, are known."""

    mean: Matrix
    covariance: Covariance

    @cached_property
    def numeric(self) -> RandomMatrix:
        """What the numerics work with."""
        return ByMoments(np.array(self.mean), np.array(self.covariance))

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.numeric  # noqa: B018 - raises what is wrong with it
        return self


class SequenceSpec(Spec, Generic[T]):
    """One for each step, from the first on at which it is needed, and then round again or the last for ever."""

    sequence: Annotated[tuple[T, ...], Field(min_length=1)]
    after: Literal["cycle", "hold"]


def _kind_of_random(value: object) -> str:
    keys = set(value) if isinstance(value, Mapping) else set[str]()
    if isinstance(value, SequenceSpec) or "sequence" in keys:
        return "<sequence>"
    if isinstance(value, TermsSpec) or keys & {"terms", "variables"}:
        return "<terms>"
    if isinstance(value, MomentsSpec) or keys & {"mean", "covariance"}:
        return "<moments>"
    return "<matrix>"


def _kind_of_fixed(value: object) -> str:
    kind = _kind_of_random(value)
    return kind if kind == "<sequence>" else "<matrix>"


AnyMatrix = Annotated[
    Annotated[Matrix, Tag("<matrix>")]
    | Annotated[TermsSpec, Tag("<terms>")]
    | Annotated[MomentsSpec, Tag("<moments>")],
    Discriminator(_kind_of_random),
]
"""A matrix, random or not."""

RandomOverTime = Annotated[
    Annotated[Matrix, Tag("<matrix>")]
    | Annotated[TermsSpec, Tag("<terms>")]
    | Annotated[MomentsSpec, Tag("<moments>")]
    | Annotated[SequenceSpec[AnyMatrix], Tag("<sequence>")],
    Discriminator(_kind_of_random),
]
"""A matrix, random or not, or a sequence of such."""

MatrixOverTime = Annotated[
    Annotated[Matrix, Tag("<matrix>")] | Annotated[SequenceSpec[Matrix], Tag("<sequence>")],
    Discriminator(_kind_of_fixed),
]
"""A matrix or a sequence of matrices."""

CovarianceOverTime = Annotated[
    Annotated[Covariance, Tag("<matrix>")] | Annotated[SequenceSpec[Covariance], Tag("<sequence>")],
    Discriminator(_kind_of_fixed),
]
"""A covariance matrix or a sequence of such."""


def items_of(value: Any) -> tuple[Any, ...]:
    """What a sequence consists of; of anything else, the thing itself."""
    return value.sequence if isinstance(value, SequenceSpec) else (value,)


def shape_of(matrix: Any) -> tuple[int, int]:
    """Rows and columns of a matrix, random or not."""
    if isinstance(matrix, TermsSpec | MomentsSpec):
        return matrix.numeric.shape
    return len(matrix), len(matrix[0])


def shape_problems(field: str, value: Any, wanted: tuple[int | None, int | None]) -> Iterator[Problem]:
    """A problem for each item of `value`, which stands at `field`, that has not the wanted shape (None: any)."""
    items = items_of(value)
    for n, item in enumerate(items):
        shape = shape_of(item)
        if any(want not in (None, got) for want, got in zip(wanted, shape, strict=True)):
            where = f"{field}.sequence[{n}]" if isinstance(value, SequenceSpec) else field
            given = shortest(item) if isinstance(item, tuple) else f"{shape[0]} x {shape[1]}"
            yield Problem(where, given, f"expected a {_text(wanted)} matrix, not a {_text(shape)} one")


def _text(shape: tuple[int | None, int | None]) -> str:
    rows, columns = ("n" if size is None else str(size) for size in shape)
    return f"{rows} x {columns}"


def random_schedule(value: Any, first: int) -> Schedule[RandomMatrix]:
    """The numerics' schedule, beginning at step `first`, of matrices that may be random."""
    return _schedule(value, _random_matrix, first)


def fixed_schedule(value: Any, first: int) -> Schedule[Array]:
    """The numerics' schedule of matrices, from step 0; `first` is the step to which the first one belongs."""
    schedule = _schedule(value, np.array, 0)
    items = schedule.items
    for _ in range(first if len(items) > 1 else 0):
        items = (items[-1], *items[:-1]) if schedule.after == "cycle" else (items[0], *items)
    return Schedule(items, 0, schedule.after)


def _random_matrix(spec: Any) -> RandomMatrix:
    if isinstance(spec, TermsSpec | MomentsSpec):
        return spec.numeric
    return Fixed(np.array(spec))


def _schedule(value: Any, built: Callable[[Any], S], first: int) -> Schedule[S]:
    items = tuple(built(item) for item in items_of(value))
    after: Literal["cycle", "hold"] = value.after if isinstance(value, SequenceSpec) else "hold"
    return Schedule(items, first, after)
