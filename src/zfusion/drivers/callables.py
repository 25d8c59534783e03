"""Measurements from a function of the user's: one that reads a device, a file, the machine itself.

def read(step, t_ns, node, **options):
    return 21.5            # a number, as many as the sensor has components, or None: no reading now
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from zfusion.errors import InputError, RunError
from zfusion.model.types import Array, NodeId

SIGNATURE = "read(step, t_ns, node, **options)"

NOT_FINITE = "not_finite"
"""Counts readings with a NaN or an infinity in them: what drivers of devices return when there is nothing to read."""

_numbers = count(1)
"""Makes the names of modules loaded from files differ, so that each sensor has the file's variables to itself."""


class CallableSource:
    """A user's function, called once a step."""

    def __init__(self, function: str, node: NodeId, ny: int, options: Mapping[str, Any]) -> None:
        """`function` is "module:function" or "path/to/file.py:function". InputError if it cannot be called so."""
        self.counters: Counter[str] = Counter()
        self._name, self._node, self._ny, self._options = function, node, ny, dict(options)
        self._function = _load(function)
        self._check_signature()

    def read(self, step: int, t_ns: int) -> Array | None:
        """What the function returns, (ny,); None where that is None or not finite (which is counted).

        RunError, naming function, sensor and step, where it raises or returns something else.
        """
        try:
            value = self._function(step, t_ns, self._node, **self._options)
        except Exception as error:
            raise RunError(f"{self._place(step)}: {_told(error)}") from error
        if value is None:
            return None
        try:
            y = as_measurement(value, self._ny)
        except ValueError as error:
            raise RunError(f"{self._place(step)}: {error}") from None
        if not np.isfinite(y).all():
            self.counters[NOT_FINITE] += 1
            return None
        return y

    def truth(self, step: int) -> Array | None:  # noqa: ARG002
        """Nobody knows it."""
        return None

    def close(self) -> None:
        """Nothing is held."""

    def _place(self, step: int) -> str:
        return f"{self._name}, sensor {self._node}, step {step}"

    def _check_signature(self) -> None:
        try:
            signature = inspect.signature(self._function)
        except ValueError:
            return  # some functions written in C do not tell
        try:
            signature.bind(1, 0, self._node, **self._options)
        except TypeError as error:
            given = f" with the options {', '.join(self._options)}" if self._options else ""
            raise InputError(f"{self._name}: cannot be called as {SIGNATURE}{given}: {error}") from None


def as_measurement(value: object, ny: int) -> Array:
    """A number (for ny = 1) or ny of them as float64, (ny,), not necessarily finite; ValueError for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "biuf" or array.shape not in ([(), (1,)] if ny == 1 else [(ny,)]):
        wanted = "a number" if ny == 1 else f"{ny} numbers"
        raise ValueError(f"expected {wanted} or None, not {_short(value)}")
    return np.array(array, dtype=np.float64).reshape(ny)


def _load(function: str) -> Callable[..., Any]:
    place, _, name = function.rpartition(":")
    try:
        module = _from_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    except Exception as error:
        raise InputError(f"{function}: cannot be imported: {_told(error)}") from error
    found: object = getattr(module, name, None)
    if not callable(found):
        what = "has no" if found is None else "has something else than a function under the name"
        raise InputError(f"{function}: {place} {what} {name!r}")
    return found


def _from_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    spec = importlib.util.spec_from_file_location(f"{path.stem}_{next(_numbers)}", path)
    assert spec is not None  # the name ends in .py
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses, pickle and others look for it
    spec.loader.exec_module(module)
    return module


def _told(error: Exception) -> str:
    """What was raised, and the last place in the user's code on the way there."""
    where = ""
    for frame in traceback.extract_tb(error.__traceback__):
        if frame.filename != __file__ and "importlib" not in frame.filename:
            where = f" ({Path(frame.filename).name}, line {frame.lineno})"
    return f"{type(error).__name__}: {error}{where}"


def _short(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
