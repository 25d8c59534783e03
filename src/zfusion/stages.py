"""What nodes say to each other: messages, and the stages that they belong to, as tables.

A *stage* is one exchange within a step. A method declares its stages with these tables; the wire format, the JSON
Schemas on a recording and the exports are derived from them, and nothing else knows how many stages there are or
what they carry. This file knows no bytes: those are `zfusion.messages`' business.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from zfusion.model.types import NodeId

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""Names of stages and fields: they are parts of Zenoh keys, column names and identifiers."""

HEADER = ("v", "node", "step", "t_ns", "seq", "born")
"""The names that every payload begins with, whatever its stage."""

RESERVED = frozenset((*HEADER, "run", "shape"))
"""Names that a stage's own fields cannot have."""

TRUTH_SENDER = "truth"
"""The `node` of the messages that tell the true state: no node of the network, and never in a node's key."""


class Kind(Enum):
    """What a field's value is: in Python, and in brackets on the wire."""

    VECTOR = "vector"
    """Read-only float64 array (n,)   [list of floats]."""
    OPTIONAL_VECTOR = "vector or nil"
    """The same, or None where there is none   [list of floats, or nil]."""
    MATRIX = "matrix"
    """Read-only float64 array (rows, columns)   [row-major list of floats, and ``shape: [rows, columns]``]."""
    IDS = "node ids"
    """Tuple of node ids, ascending, each once   [list of ids]."""
    STEP = "step"
    """A step k >= 1, int   [int]."""
    HISTORY = "history"
    """Tuple of (first step, ids), ascending, all before the message's step   [list of [first step, list of ids]]."""
    TEXT = "text"
    """Short str   [str]."""
    MAP = "map"
    """dict of str to what JSON can say   [map]."""


_AXES = {Kind.VECTOR: 1, Kind.OPTIONAL_VECTOR: 1, Kind.MATRIX: 2}


@dataclass(frozen=True, slots=True)
class Field:
    """One named value that a stage's messages carry.

    `shape` has a length for each axis of a vector or matrix: a number, or a name (``"nx"``, ``"ny"``) whose value
    depends on the sender and is given where messages are decoded. ValueError for a table that cannot be.
    """

    name: str
    kind: Kind
    shape: tuple[str | int, ...] = ()
    meaning: str = ""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name) or self.name in RESERVED:
            raise ValueError(f"field name {self.name!r}: expected letters, digits, _, and none of {sorted(RESERVED)}")
        if len(self.shape) != _AXES.get(self.kind, 0):
            raise ValueError(f"field {self.name}: a {self.kind.value} does not have the shape {self.shape}")

    def lengths(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """The shape in numbers, with the names looked up in `sizes`; KeyError for a name that is not there."""
        return tuple(axis if isinstance(axis, int) else sizes[axis] for axis in self.shape)


@dataclass(frozen=True, slots=True)
class Stage:
    """One exchange within a step: the last part of its keys, and what its messages carry."""

    name: str
    fields: tuple[Field, ...]
    meaning: str = ""

    def __post_init__(self) -> None:
        names = [field.name for field in self.fields]
        if not NAME.fullmatch(self.name):
            raise ValueError(f"stage name {self.name!r}: expected letters, digits and _")
        if len(set(names)) != len(names):
            raise ValueError(f"stage {self.name}: a field twice in {names}")
        if sum(field.kind is Kind.MATRIX for field in self.fields) > 1:
            raise ValueError(f"stage {self.name}: more than one matrix, where `shape` tells of one")


class Message(NamedTuple):
    """One message: who said what of which step. (A named tuple: built ten times a round, three times as fast.)"""

    node: NodeId
    step: int
    """k >= 1."""
    stage: str
    seq: int
    """How many messages the sender had put on this key, in its present life, before this one: 0, 1, 2, ..."""
    born: int
    """First step of the sender's present life: more than 1 after a restart."""
    t_ns: int
    """The sender's clock when it sent, in nanoseconds."""
    fields: Mapping[str, object]
    """The stage's own values, as their kinds say."""


MEASUREMENT = Stage(
    "measurement",
    (Field("y", Kind.OPTIONAL_VECTOR, ("ny",), "the sensor's reading of this step; nil if it had none"),),
    "what a sensor measured",
)
INTERMEDIATE = Stage(
    "intermediate",
    (
        Field("x", Kind.VECTOR, ("nx",), "the estimate from the neighbourhood's measurements"),
        Field("used", Kind.IDS, (), "whose measurements of this step went in"),
        Field("history", Kind.HISTORY, (), "the same of earlier steps: each run holds until the next begins"),
    ),
    "the estimate from what the neighbourhood measured, and what it was made of",
)
ESTIMATE = Stage(
    "estimate",
    (
        Field("x", Kind.VECTOR, ("nx",), "the fused estimate"),
        Field("P", Kind.MATRIX, ("nx", "nx"), "its predicted error covariance"),
        Field("used", Kind.IDS, (), "whose intermediate estimates were fused"),
        Field("excluded", Kind.IDS, (), "whose arrived but were left out, their used sets being unknown"),
    ),
    "the node's result",
)
REVISED = Stage(
    "revised",
    (
        Field("x", Kind.VECTOR, ("nx",), "the corrected estimate of a past step"),
        Field("P", Kind.MATRIX, ("nx", "nx"), "its predicted error covariance"),
        Field("used", Kind.IDS, (), "whose messages of that step went in"),
        Field("excluded", Kind.IDS, (), "whose had come by then but were left out: the senders have since used more"),
        Field("at", Kind.STEP, (), "the step at whose end it was made"),
    ),
    "an estimate of a past step, corrected by what came late",
)
EVENT = Stage(
    "event",
    (
        Field("kind", Kind.TEXT, (), "what happened"),
        Field("data", Kind.MAP, (), "its particulars"),
    ),
    "something out of the ordinary that happened to a node",
)
ARRIVALS = Stage(
    "arrivals",
    (
        Field(
            "data",
            Kind.MAP,
            (),
            "edges: a list of {from, stage, steps: [[first, count], ...], latency_ns: [...]}, one latency a step",
        ),
    ),
    "how long its neighbours' messages took to a node, of many steps at once",
)
TRUTH = Stage("truth", (Field("x", Kind.VECTOR, ("nx",), "the true state"),), "the state itself, where it is known")

BUILT_IN = (MEASUREMENT, INTERMEDIATE, ESTIMATE, REVISED, EVENT, ARRIVALS, TRUTH)
"""The stages that a recording may hold whatever the method; a method may add its own."""
