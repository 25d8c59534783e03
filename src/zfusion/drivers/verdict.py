"""Comparing what was published with what is recomputed, and the verdict that comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from zfusion.methods.protocol import Fields
from zfusion.model.types import Array, NodeId

TOLERANCE = 1e-9
"""What results may differ by on another kind of machine, relative to the largest number that the field has held in that
life: rounding of 1e-16 that a recursion and a fusion make larger, and a settled covariance that is settled to 1e-14."""

NAMED = 20
"""Missing inputs that a verdict names; of the others it tells how many."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A field of a published message that comes out otherwise."""

    node: NodeId
    born: int
    """The life: its first step."""
    step: int
    stage: str
    field: str
    recorded: object
    recomputed: object
    ulps: int | None
    """How many floating-point numbers apart the two are, at most; None where that is no question of rounding."""

    def __str__(self) -> str:
        apart = "" if self.ulps is None else f", {self.ulps} ulp apart"
        return (
            f"node {self.node}, step {self.step}, {self.stage}.{self.field}: recorded {_shown(self.recorded)}, "
            f"recomputed {_shown(self.recomputed)}{apart}"
        )


@dataclass(slots=True)
class Tally:
    """Published messages of one node, intermediate and final estimates."""

    identical: int = 0
    different: int = 0
    unverifiable: int = 0
    """They depend on something that should be on the recording and is not."""
    cut_off: int = 0
    """They depend on something that came after the end of a recording that was broken off."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of recomputing every published message."""

    nodes: Mapping[NodeId, Tally]
    lives: int
    """Lives of nodes on the recording: as many as nodes, and one more for every restart."""
    first: Difference | None
    """The difference of the lowest step; of the first stage and node in it."""
    missing: tuple[str, ...]
    """What is not on the recording, in words: the first few."""
    missing_count: int
    unreadable: int
    """Messages on the nodes' keys that are no legal messages of theirs: they are nobody's input."""
    arithmetic: Mapping[str, tuple[str, str]]
    """What of versions and machine is not as it was for the recording: name to (recorded, here)."""
    tolerance: float | None
    """What numbers may differ by, relatively, and count as identical; None: by not a bit."""
    note: str
    """What is and what is not on a recording that was broken off; empty for one that is finished."""

    @property
    def identical(self) -> int:
        """Messages that come out as they were published."""
        return sum(tally.identical for tally in self.nodes.values())

    @property
    def different(self) -> int:
        """Messages that come out otherwise."""
        return sum(tally.different for tally in self.nodes.values())

    @property
    def unverifiable(self) -> int:
        """Messages that cannot be recomputed because something is missing."""
        return sum(tally.unverifiable for tally in self.nodes.values())

    @property
    def cut_off(self) -> int:
        """Messages that cannot be recomputed because the recording ends."""
        return sum(tally.cut_off for tally in self.nodes.values())

    @property
    def verified(self) -> bool:
        """Whether everything that could be recomputed came out as it was, and there was something."""
        return not self.different and self.identical > 0

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        first = None
        if self.first is not None:
            first = asdict(self.first) | {
                "recorded": _plain(self.first.recorded),
                "recomputed": _plain(self.first.recomputed),
            }
        return {
            "verified": self.verified,
            "identical": self.identical,
            "different": self.different,
            "unverifiable": self.unverifiable,
            "cut_off": self.cut_off,
            "nodes": {str(node): asdict(tally) for node, tally in self.nodes.items()},
            "lives": self.lives,
            "first_difference": first,
            "missing": list(self.missing),
            "missing_count": self.missing_count,
            "unreadable": self.unreadable,
            "arithmetic": {name: list(both) for name, both in self.arithmetic.items()},
            "tolerance": self.tolerance,
            "note": self.note,
        }


@dataclass(slots=True)
class Comparison:
    """Compares one life's messages with what is recomputed, bit for bit or within a relative tolerance."""

    tolerance: float | None
    _largest: dict[tuple[str, str], float] = field(default_factory=dict)

    def differs(self, stage: str, recorded: Fields, recomputed: Fields) -> tuple[str, int | None] | None:
        """The first field that is different, and by how many ulps where it is numbers; None if there is none."""
        for name, value in recorded.items():
            other = recomputed[name]
            if isinstance(value, np.ndarray) and isinstance(other, np.ndarray):
                if value.shape == other.shape and value.tobytes() == other.tobytes():
                    if self.tolerance is not None:
                        self._near(stage, name, value, other)
                elif value.shape != other.shape or not self._near(stage, name, value, other):
                    return name, ulps_apart(value, other)
            elif value != other:
                return name, None
        return None

    def _near(self, stage: str, name: str, value: Array, other: Array) -> bool:
        if self.tolerance is None:
            return False
        largest = max(self._largest.get((stage, name), 0.0), float(np.max(np.abs(value), initial=0.0)))
        self._largest[stage, name] = largest
        return bool(np.max(np.abs(value - other), initial=0.0) <= self.tolerance * largest)


EXACT = Comparison(None)


def ulps_apart(a: Array, b: Array) -> int | None:
    """The most floating-point numbers between two entries of arrays; None if they are of different shapes."""
    if a.shape != b.shape:
        return None
    return max((abs(_rank(x) - _rank(y)) for x, y in zip(a.ravel(), b.ravel(), strict=True)), default=0)


def _rank(x: np.float64) -> int:
    """The place of x among the floating-point numbers, counted from zero; -0 and 0 have the same."""
    bits = int(x.view(np.int64))
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF)


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _shown(value: object) -> str:
    """All digits, but not of everything."""
    text = repr(_plain(value))
    return text if len(text) <= 200 else text[:197] + "..."
