"""What all pieces of a scenario are made of: the base class, numbers, ids and matrices."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    model_validator,
)

from zfusion.errors import Problem, ScenarioError
from zfusion.model.checks import covariance_matrix
from zfusion.model.schema.problems import Located, located
from zfusion.model.types import NodeId

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
"""What things may be called, as their names become segments of key expressions and of file names."""


@dataclass
class Reading:
    """One reading of a document: where it comes from, and which keys are known in which of its tables."""

    source: str
    keys_of: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """By the identity of the table."""


class Spec(BaseModel):
    """A piece of a scenario: immutable, and a key that it does not know is an error.

    Building one, by `Piece(key=..)` or `Piece.model_validate({..})`, raises ScenarioError with all problems.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())

    TAG: ClassVar[str | None] = None
    """The field that says which of several alternatives this is; it is written even if it was not given."""

    PATHS: ClassVar[tuple[str, ...]] = ()
    """The fields that name files, relative to the directory of the scenario."""

    def __init__(self, /, **data: Any) -> None:
        self._read(data, type(self).__name__, self)

    # Tells pydantic that it need not come back here for the pieces inside a piece.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def model_post_init(self, _: Any, /) -> None:
        """Sees to it that the tag is written."""
        if self.TAG is not None:
            self.model_fields_set.add(self.TAG)

    def with_paths(self, changed: Callable[[str], str]) -> Self:
        """The same with every path replaced by what `changed` makes of it."""
        paths = {name: getattr(self, name) for name in self.PATHS}
        return self.model_copy(update={name: changed(path) for name, path in paths.items() if path is not None})

    def paths(self) -> list[str]:
        """The files that it names, pieces within it included."""
        found: list[str] = []

        def note(path: str) -> str:
            found.append(path)
            return path

        self.with_paths(note)
        return found

    @classmethod
    def model_validate(cls, obj: Any, **_: Any) -> Self:
        """The piece that `obj`, a table as read from a TOML file, describes."""
        return cls._read(obj, cls.__name__)

    @classmethod
    def _read(cls, document: Any, source: str, instance: Self | None = None) -> Self:
        reading = Reading(source)
        try:
            piece: Self = cls.__pydantic_validator__.validate_python(document, self_instance=instance, context=reading)
        except ValidationError as error:
            found = list(located(error, document, reading.keys_of))
            raise ScenarioError(source, cls._all_problems(document, found)) from None
        return piece

    @classmethod
    def _all_problems(cls, document: Any, found: list[Located]) -> list[Problem]:  # noqa: ARG003
        """The problems to report; a piece may add those that it can still find beside them."""
        return [located.problem for located in found]

    @model_validator(mode="before")
    @classmethod
    def _note_keys(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(info.context, Reading):
            fields = cls.model_fields.items()
            info.context.keys_of[id(value)] = tuple(spec.alias or name for name, spec in fields)
        return value


Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Flag = Annotated[bool, Field(strict=True)]
Natural = Annotated[int, Field(strict=True, ge=0)]
Count = Annotated[int, Field(strict=True, ge=1)]


def _node_id(value: object) -> NodeId:
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    if isinstance(value, str) and value.isdecimal():
        raise ValueError("expected an id that is a number to stand without quotes")
    if isinstance(value, str) and NAME.fullmatch(value):
        return value
    raise ValueError("expected a whole number >= 0 or a name of letters, digits, '_', '.' and '-'")


Id = Annotated[NodeId, PlainValidator(_node_id)]


def _name(value: str) -> str:
    if not NAME.fullmatch(value):
        raise ValueError("expected a name of letters, digits, '_', '.' and '-'")
    return value


Name = Annotated[str, AfterValidator(_name)]


Rows = tuple[tuple[float, ...], ...]

A_MATRIX = "expected a number or a matrix as a list of rows of numbers"
A_VECTOR = "expected a number or a list of numbers"
A_TABLE = "expected a number, a list of rows, or a table of diagonal, sequence, terms, or mean and covariance"


def _matrix(value: Any) -> Rows:
    """A number, rows of numbers, or {diagonal = numbers}, as rows of floats; ValueError if it is neither."""
    if isinstance(value, Mapping):
        if set(value) != {"diagonal"}:
            raise ValueError(A_TABLE)
        diagonal = _numbers(value["diagonal"], A_VECTOR)
        size = range(len(diagonal))
        return tuple(tuple(diagonal[i] if i == j else 0.0 for j in size) for i in size)
    given = [[value]] if _is_number(value) else _plain_list(value, A_MATRIX)
    rows = tuple(_numbers(row, A_MATRIX) for row in given)
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"{A_MATRIX}, all equally long")
    return rows


def vector(value: Any) -> tuple[float, ...]:
    """A number or a list of numbers, as floats; ValueError if it is neither."""
    return _numbers([value] if _is_number(value) else value, A_VECTOR)


def _numbers(value: Any, wanted: str) -> tuple[float, ...]:
    entries = _plain_list(value, wanted)
    if not all(_is_number(entry) for entry in entries):
        raise ValueError(wanted)
    try:
        numbers = tuple(float(entry) for entry in entries)
    except OverflowError:  # a whole number beyond all floats
        numbers = (inf,)
    if not all(map(isfinite, numbers)):
        raise ValueError(f"{wanted}, all of them finite")
    return numbers


def _plain_list(value: Any, wanted: str) -> Sequence[Any]:
    """The list or numpy array `value` as a list, of at least one item."""
    items = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(items, list | tuple) or not items:
        raise ValueError(wanted)
    return items


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _semidefinite(rows: Rows) -> Rows:
    if len(rows) == len(rows[0]) == 1 and rows[0][0] < 0:
        raise ValueError("expected a variance >= 0")
    covariance_matrix("", rows)
    return rows


def shortest(rows: Rows) -> float | list[list[float]]:
    """As it is written: a 1 x 1 matrix as a number."""
    return rows[0][0] if len(rows) == len(rows[0]) == 1 else [list(row) for row in rows]


Matrix = Annotated[Rows, PlainValidator(_matrix), PlainSerializer(shortest, return_type=Any)]
"""Rows of numbers; a number stands for a 1 x 1 matrix, {diagonal = [...]} for a diagonal one."""

Covariance = Annotated[
    Rows,
    PlainValidator(lambda value: _semidefinite(_matrix(value))),
    PlainSerializer(shortest, return_type=Any),
]
"""A Matrix that is symmetric and positive semi-definite."""

Vector = Annotated[
    tuple[float, ...],
    PlainValidator(vector),
    PlainSerializer(lambda vector: vector[0] if len(vector) == 1 else list(vector), return_type=Any),
]
"""Numbers; a single one may stand without brackets."""


def _plain(value: object) -> object:
    """Refuses what a TOML file could not hold."""
    match value:
        case bool() | int() | str():
            return value
        case float() if isfinite(value):
            return value
        case list() | tuple():
            return [_plain(item) for item in value]
        case dict() if all(isinstance(key, str) for key in value):
            return {key: _plain(item) for key, item in value.items()}
    raise ValueError("expected text, finite numbers, true or false, lists and tables of these")


Options = Annotated[dict[str, Any], AfterValidator(_plain)]
"""A free table, handed as it is to whom it is meant for."""
