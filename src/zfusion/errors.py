"""Every error that zfusion raises on purpose, by whose fault it is.

    ZfusionError
    ├── InputError           what the user gave is wrong; nothing was started            (exit code 2)
    │   ├── ModelError       a number of the model that cannot be (`model.checks`)
    │   ├── DesignError      a method that cannot be designed for what it was given (`methods.convex`)
    │   ├── DesignFileError  a design file that is missing, damaged, or of something else (`methods.design_files`)
    │   ├── ScenarioError    a scenario file or object: names file, field, value, expectation
    │   └── RecordingError   a recording that is missing, damaged or of another version
    ├── RunError             what was started failed                                     (exit code 1)
    └── MessageError         bytes from a peer that are not a legal message              (counted, never fatal)

The command line exits with an error's `exit_code`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from reprlib import repr as short


class ZfusionError(Exception):
    """The root: `except ZfusionError` catches all that zfusion raises on purpose."""

    exit_code = 1


class InputError(ZfusionError):
    """What the user gave is wrong, and nothing has been started."""

    exit_code = 2


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong in an input: where, what is there, what is expected."""

    field: str
    """Path of the field, as in the file: ``sensors[2].H``."""
    value: object
    expected: str

    def __str__(self) -> str:
        shown = repr(self.value)
        if len(shown) > 80:
            shown = shown[:77] + "..."
        return f"{self.field}: {self.expected} (is {shown})"


class ScenarioError(InputError):
    """A scenario that cannot be run; `problems` lists every field that is wrong."""

    def __init__(self, source: str, problems: Iterable[Problem]) -> None:
        self.source = source
        self.problems = tuple(problems)
        super().__init__("\n".join(f"{source}: {problem}" for problem in self.problems))


class RecordingError(InputError):
    """A recording that cannot be read: missing, damaged, not zfusion's, or of another version."""


class RunError(ZfusionError):
    """Something that was started did not end well."""


class MessageError(ZfusionError):
    """Bytes from a peer that are not a legal message: ``MessageError(reason, detail, *values)``.

    `reason` is the counter they are counted under. `detail` says more of it; {} in it are what `values` look like, cut
    short, when somebody wants to read it. Nobody does where such messages are counted only, and a flood of them is to
    cost as little as can be: nothing is done with any of it before.
    """

    @property
    def reason(self) -> str:
        """What they are counted under."""
        reason: str = self.args[0]
        return reason

    def __str__(self) -> str:
        reason, *more = self.args
        if not more:
            return str(reason)
        detail, *values = more
        return f"{reason}: {detail.format(*map(short, values)) if values else detail}"
