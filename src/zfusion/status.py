"""What a node answers when it is asked: how it is doing, and what its used sets were."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from importlib.metadata import version
from typing import Any

from zfusion.errors import MessageError
from zfusion.messages import VERSION, Reason, decode_any, encode_any
from zfusion.model.types import NodeId
from zfusion.used_sets import Run


class Phase(StrEnum):
    """Where a node is in its life."""

    JOINING = "joining"
    """Waiting for its neighbours and for the recorder."""
    RUNNING = "running"
    DONE = "done"
    """Has taken its last step and stays until its neighbours have its last messages."""


@dataclass(frozen=True, slots=True)
class Status:
    """How a node is doing."""

    node: NodeId
    fingerprint: str
    """Of its scenario: nodes that differ in it are not of one swarm."""
    phase: Phase
    step: int
    born: int
    epoch_ns: int | None
    """When step 1 begins, on everybody's clock; None until it is agreed."""
    ready: Mapping[NodeId, int]
    """Who is known to have found all its neighbours, with the start of its process (ns): it tells lives apart."""
    completed: int = 0
    fallbacks: int = 0
    estimate: Mapping[str, list[float]] = field(default_factory=dict)
    """The last one, where there is one: x, and sd, the standard deviations of its errors. For people to look at."""
    machine: str | None = None
    """Nodes that tell the same here count the same time; None where nothing can be said."""
    line_ns: int = 0
    """Where the node's time line begins, on that count."""
    clock_jumps: int = 0
    """How often its machine's clock was seen to jump."""
    clock_offset_exceeded: int = 0
    """Readings of neighbours' clocks that were beyond what is allowed."""
    heard_ns: int = 0
    """When the question was heard that this answers, and when the answer was told, on the node's clock."""
    told_ns: int = 0
    zfusion: str = version("zfusion")
    wire: int = VERSION

    @property
    def identity(self) -> tuple[str, int, str]:
        """What all nodes of a swarm must have in common: version, wire format, scenario."""
        return (self.zfusion, self.wire, self.fingerprint)

    def encode(self) -> bytes:
        """As bytes."""
        return encode_any({**asdict(self), "phase": str(self.phase), "ready": list(self.ready.items())})

    @classmethod
    def decode(cls, data: bytes) -> Status:
        """From bytes; MessageError if they are no status."""
        raw = decode_any(data)
        try:
            status = cls(
                node=_id(raw["node"]),
                fingerprint=_typed(raw, "fingerprint", str),
                phase=Phase(_typed(raw, "phase", str)),
                step=_typed(raw, "step", int),
                born=_typed(raw, "born", int),
                epoch_ns=None if raw["epoch_ns"] is None else _typed(raw, "epoch_ns", int),
                ready={_id(i): int(start) for i, start in _typed(raw, "ready", list)},
                completed=_typed(raw, "completed", int),
                fallbacks=_typed(raw, "fallbacks", int),
                machine=None if raw["machine"] is None else _typed(raw, "machine", str),
                line_ns=_typed(raw, "line_ns", int),
                clock_jumps=_typed(raw, "clock_jumps", int),
                clock_offset_exceeded=_typed(raw, "clock_offset_exceeded", int),
                heard_ns=_typed(raw, "heard_ns", int),
                told_ns=_typed(raw, "told_ns", int),
                zfusion=_typed(raw, "zfusion", str),
                wire=_typed(raw, "wire", int),
            )
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, str(missing)) from None
        except (TypeError, ValueError) as error:
            raise MessageError(Reason.WRONG_TYPE, str(error)) from None
        return status


@dataclass(frozen=True, slots=True)
class HistoryAnswer:
    """A node's used sets in its present life, up to `end`, as far back as it knows them."""

    born: int
    end: int
    runs: Sequence[Run]

    def encode(self) -> bytes:
        """As bytes."""
        return encode_any({"born": self.born, "end": self.end, "runs": list(self.runs)})

    @classmethod
    def decode(cls, data: bytes, legal: frozenset[NodeId]) -> HistoryAnswer:
        """From bytes; MessageError if they are no history whose used sets are drawn from `legal`."""
        return cls.from_map(decode_any(data), legal)

    @classmethod
    def from_map(cls, raw: Mapping[str, Any], legal: frozenset[NodeId]) -> HistoryAnswer:
        """From what `encode` put into a map; MessageError as `decode`."""
        try:
            born, end, told = _typed(raw, "born", int), _typed(raw, "end", int), _typed(raw, "runs", list)
        except KeyError as missing:
            raise MessageError(Reason.MISSING_FIELD, str(missing)) from None
        runs: list[Run] = []
        previous = born - 1
        for run in told:
            if type(run) is not list or len(run) != 2 or type(run[0]) is not int or type(run[1]) is not list:
                raise MessageError(Reason.WRONG_TYPE, "runs: expected [first step, node ids]")
            first, used = run
            if not previous < first <= end:
                raise MessageError(Reason.BAD_HISTORY, f"a run from {first} after {previous}, up to {end}")
            if not legal.issuperset(map(_id, used)):
                raise MessageError(Reason.UNKNOWN_ID, str(used))
            runs.append((first, tuple(used)))
            previous = first
        return cls(born, end, tuple(runs))


def _id(value: object) -> NodeId:
    if type(value) is int or type(value) is str:
        return value
    raise MessageError(Reason.WRONG_TYPE, f"{value!r} is no node id")


def _typed(raw: Mapping[str, Any], name: str, expected: type) -> Any:
    value = raw[name]
    if type(value) is not expected:
        raise MessageError(Reason.WRONG_TYPE, f"{name}: expected {expected.__name__}, is {value!r:.80}")
    return value
