"""Turns whatever was wrong with a document into problems in the user's words, each at its place in the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, NamedTuple

from pydantic import ValidationError

from zfusion.errors import Problem
from zfusion.model.checks import ModelError

Path = tuple[str | int, ...]
"""Keys and list indices from the document's root."""

WORDS: Mapping[str, str] = {
    "missing": "required",
    "float_type": "expected a number",
    "int_type": "expected a whole number",
    "bool_type": "expected true or false",
    "string_type": "expected text",
    "finite_number": "expected a finite number",
    "greater_than": "expected a number > {gt:g}",
    "greater_than_equal": "expected a number >= {ge:g}",
    "less_than_equal": "expected a number <= {le:g}",
    "literal_error": "expected {expected}",
    "tuple_type": "expected a list",
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "model_attributes_type": "expected a table",
    "too_short": "expected at least {min_length} item(s)",
    "too_long": "expected at most {max_length} items",
}
"""What to say for each kind of failure that the schema can produce; the braces are pydantic's own details."""


class Located(NamedTuple):
    """A problem, where it is in the document, and whether it is just a key too many."""

    path: Path
    problem: Problem
    is_unknown_key: bool = False


class _NotGiven:
    def __repr__(self) -> str:
        return "not given"


NOT_GIVEN = _NotGiven()
"""The value of a problem with a key that is missing."""


class Faults(ValueError):
    """Several problems found by one validator, their fields relative to what it was given."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


def text_of(path: Path) -> str:
    """The path as written in messages: ``sensors[2].H``."""
    parts = (f"[{key}]" if isinstance(key, int) else f".{_key(key)}" for key in path)
    return "".join(parts).removeprefix(".")


def _key(key: str) -> str:
    """A key on one line, whatever is in it."""
    return key if key and key.isprintable() else repr(key)


def below(prefix: str, problem: Problem) -> Problem:
    """The problem with its field, relative to `prefix`, made absolute."""
    joined = prefix + problem.field if problem.field.startswith("[") else f"{prefix}.{problem.field}"
    return Problem(joined.strip("."), problem.value, problem.expected)


def unknown_key(key: str, value: object, known: Iterable[str]) -> Problem:
    """The problem of a key that means nothing here, with the one that was probably meant."""
    known = sorted(known)
    meant = get_close_matches(key, known, n=1) or [name for name in known if name.lower() == key.lower()]
    hint = f"did you mean {meant[0]!r}?" if meant else f"expected one of {', '.join(known)}"
    return Problem(text_of((key,)), value, f"unknown key; {hint}")


def located(error: ValidationError, document: object, keys_of: Mapping[int, Iterable[str]]) -> Iterator[Located]:
    """All problems of a failed validation of `document`.

    `keys_of` has, by identity of a table in the document, the keys that are known in it.
    """
    for fault in error.errors(include_url=False):
        path = _path(document, fault["loc"], keep_last=fault["type"] == "missing")
        value = NOT_GIVEN if fault["type"] == "missing" else fault["input"]
        context = fault.get("ctx", {})
        if fault["type"] == "too_short" and len(fault["input"]) >= context["min_length"]:
            continue  # pydantic counts only the items that are right; the others have their own faults
        if fault["type"] == "extra_forbidden":
            known = keys_of.get(id(_at(document, path[:-1])), ())
            problem = unknown_key(str(path[-1]), value, known)
            yield Located(path, below(text_of(path[:-1]), problem), is_unknown_key=True)
        elif fault["type"] == "value_error":
            for problem in _raised(context["error"], value):
                yield Located(path, below(text_of(path), problem))
        elif "discriminator" in context:
            yield Located(path, below(text_of(path), _no_alternative(value, context)))
        else:
            words = WORDS.get(fault["type"], fault["msg"]).format_map(context)
            yield Located(path, Problem(text_of(path), value, words))


def _no_alternative(value: object, context: Mapping[str, Any]) -> Problem:
    """The problem of a table whose key that says which of several alternatives it is says none of them."""
    key = context["discriminator"].strip("'")
    if not isinstance(value, Mapping):
        return Problem("", value, f"expected a table with the key {key!r}")
    if key not in value:
        return Problem(key, NOT_GIVEN, "required")
    return Problem(key, value[key], f"expected one of {context['expected_tags']}")


def _raised(error: ValueError, value: object) -> Iterable[Problem]:
    """The problems that a validator of ours raised about `value`."""
    if isinstance(error, Faults):
        return error.problems
    if isinstance(error, ModelError):
        return (error.problem,)
    return (Problem("", value, str(error)),)


def _path(document: object, location: tuple[str | int, ...], keep_last: bool) -> Path:
    """pydantic's location without what is not in the document: the labels of alternatives, "<sequence>" and such."""
    path: list[str | int] = []
    place = document
    for n, step in enumerate(location):
        key = step
        if isinstance(place, Mapping) and str(key) in place:
            key = str(key)  # ids that are numbers are text where they are keys
        inside = _contains(place, key)
        if inside:
            place = place[key]  # type: ignore[index]
        if inside or (keep_last and n == len(location) - 1):
            path.append(key)
    return tuple(path)


def _contains(place: object, key: str | int) -> bool:
    if isinstance(place, Mapping):
        return key in place
    return isinstance(key, int) and isinstance(place, list | tuple) and key < len(place)


def _at(document: Any, path: Path) -> Any:
    for key in path:
        document = document[key]
    return document


def without(document: Any, paths: Iterable[Path]) -> Any:
    """A copy of the document, tables and lists only, without what stands at `paths`."""
    dropped = set(paths)

    def copied(place: Any, path: Path) -> Any:
        if isinstance(place, Mapping):
            return {key: copied(item, (*path, key)) for key, item in place.items() if (*path, key) not in dropped}
        if isinstance(place, list | tuple):
            return [copied(item, (*path, n)) for n, item in enumerate(place)]
        return place

    return copied(document, ())
