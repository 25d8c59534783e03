"""What a check gives."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARNING = "warning"
    """It may go wrong, or only some of what zfusion does will."""
    ERROR = "error"
    """It will go wrong."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    topic: str
    severity: Severity
    what: str
    """What was looked at, and how it is."""
    why: str = ""
    """Why it matters; nothing where it is well."""
    remedy: str = ""
    """What to do about it."""


@dataclass(frozen=True, slots=True)
class Topic:
    """Makes the findings of one topic."""

    name: str

    def ok(self, what: str) -> Finding:
        """It is well."""
        return Finding(self.name, Severity.OK, what)

    def warning(self, what: str, why: str, remedy: str) -> Finding:
        """It may go wrong."""
        return Finding(self.name, Severity.WARNING, what, why, remedy)

    def error(self, what: str, why: str, remedy: str) -> Finding:
        """It will go wrong."""
        return Finding(self.name, Severity.ERROR, what, why, remedy)
