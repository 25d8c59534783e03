"""What a fuzzer drives: everything that reads what peers send, and a node among neighbours that say anything.

Each target takes bytes, and everything that happens follows from them: Hypothesis finds them in the test suite, and for
longer, guided by coverage, Atheris does (`pip install atheris`):

    python tests/fuzzing.py wire -max_total_time=600
    python tests/fuzzing.py node -max_total_time=600
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import msgpack
import numpy as np

from bad_weather import IDS, NEIGHBOURS, NETWORK, make, path, system_and_stack, told
from zfusion import keys
from zfusion.errors import MessageError
from zfusion.messages import Decoder, decode_any, decode_reading, encode, encode_any, read_stamp
from zfusion.model.types import NodeId
from zfusion.node import LOOKAHEAD, REMEMBERED, Node
from zfusion.stages import BUILT_IN, INTERMEDIATE, MEASUREMENT, TRUTH, TRUTH_SENDER, Message, Stage
from zfusion.status import Counts, HistoryAnswer, Phase, RecorderStatus, Status

T = TypeVar("T")

SIZES = {"nx": 2, "ny": 1}
NUMBERS = (0, 1, 2, 3, -1, 63, 64, 2**31, 2**53 - 1, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
FLOATS = (0.0, -0.0, 1.0, -1e3, 1e-308, 5e-324, 1e150, 1e308, -1.7e308, float("nan"), float("inf"))
ODD = (
    None,
    True,
    "",
    "2",
    "\ud7ff",
    b"",
    b"\xff",
    [],
    {},
    [[]],
    {"x": []},
    msgpack.Timestamp(1),
    msgpack.ExtType(5, b""),
)


class Choices:
    """Decisions taken from bytes; when they run out, always the first."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> bool:
        return self._at < len(self._data)

    def below(self, limit: int) -> int:
        self._at += 1
        return self._data[self._at - 1] % limit if self._at <= len(self._data) else 0

    def of(self, values: Sequence[T]) -> T:
        return values[self.below(len(values))]

    def some(self, values: Sequence[T]) -> list[T]:
        bits = self.below(256)
        return [value for n, value in enumerate(values) if bits >> n & 1]

    def rest(self) -> bytes:
        return self._data[self._at :]


# what reads bytes


def legal() -> list[dict[str, Any]]:
    """A legal map of every kind that goes over the wire."""
    head = {"v": 1, "node": 2, "step": 9, "t_ns": 10**18, "seq": 7, "born": 3}
    matrix = {"P": [4.0, 1.0, 1.0, 3.0], "shape": [2, 2]}
    edges = {"3": {"lost": {"measurement": 1}}}
    counts = Counts("h", 0, 1.5, 0.5, {"measurement": 3}, edges, {}, {}, {"measurement": {"7": 2}}, {}, {"held": 1})
    status = Status(2, "f" * 64, Phase.RUNNING, 9, 3, 10**18, {1: 5, 2: 6}, machine="m", counts=counts)
    return [
        head | {"y": [1.5]},
        head | {"x": [0.5, 2.0], "used": [2, 3], "history": [[3, [2, 3, 4]], [6, []]]},
        head | matrix | {"x": [0.5, 2.0], "used": [2, 4], "excluded": [3]},
        head | matrix | {"x": [0.5, 2.0], "used": [2, 4], "excluded": [3], "at": 12},
        head | {"kind": "late", "data": {"from": 3, "why": ["x", None, True, 1.5]}},
        head | {"node": TRUTH_SENDER, "x": [0.5, 2.0]},
        decode_any(status.encode()),
        {"born": 3, "end": 9, "runs": [[3, [2, 3]], [5, []], [7, [2, 3, 4]]]},
        decode_any(RecorderStatus(5, 0, 0, 1, "x.mcap", "h").encode()),
        {"from": 2, "started": 10**18, "leaving": False},
    ]


def _decoder(stage: Stage) -> Decoder:
    return Decoder(stage, TRUTH_SENDER if stage is TRUTH else 2, sizes=SIZES, ids=NEIGHBOURS[2])


READERS: list[Callable[[bytes], object]] = [
    *(_decoder(stage).decode for stage in BUILT_IN),
    decode_any,
    read_stamp,
    Status.decode,
    RecorderStatus.decode,
    lambda data: HistoryAnswer.decode(data, frozenset(NEIGHBOURS[2])),
    lambda data: decode_reading(data, True, 1),
    lambda data: decode_reading(data, False, 1),
    lambda data: keys.parse(data.decode(errors="replace")),
    lambda data: keys.parse_token(data.decode(errors="replace")),
]


def wire(data: bytes) -> Counter[str]:
    """Alter a legal message, and have all readers read it: they do, or refuse it with MessageError and nothing else."""
    choices = Choices(data)
    value: Any = choices.of(legal())
    for _ in range(choices.below(4)):
        value = altered(choices, value)
    seen: Counter[str] = Counter()
    with suppress(OverflowError, ValueError):  # what msgpack itself cannot say
        raw = cut(choices, msgpack.packb(value))
        for read in READERS:
            try:
                read(raw)
                seen["read"] += 1
            except MessageError as error:
                seen[error.reason] += 1
    for read in READERS:  # and whatever bytes the fuzzer likes
        with suppress(MessageError):
            read(choices.rest())
    return seen


def altered(choices: Choices, value: Any) -> Any:
    """The value with something else in one place of it, at whatever depth."""
    if isinstance(value, dict) and value and choices.below(8):
        name = choices.of(list(value))
        act = choices.below(4)
        rest = {key: item for key, item in value.items() if key != name}
        return (
            rest if act == 0 else rest | {choices.of([*ODD[:6], 7]): value[name]} if act == 1
            else value | {name: altered(choices, value[name])}
        )  # fmt: skip
    if isinstance(value, list) and value and choices.below(8):
        at = choices.below(len(value))
        act = choices.below(4)
        middle = [[], [value[at]] * 2, value * choices.below(200), [altered(choices, value[at])]][act]
        return value[:at] + middle + value[at + 1 :]
    deep: Any = 0
    for _ in range(choices.below(12)):
        deep = [deep]
    return choices.of([*NUMBERS, *FLOATS, *ODD, "x" * 300, deep, {"a": deep}])


def cut(choices: Choices, raw: bytes) -> bytes:
    """The bytes, or some of them otherwise."""
    act, at = choices.below(8), choices.below(256) * max(1, len(raw) // 256) % max(1, len(raw))
    if act == 0:
        return raw[:at]
    if act == 1:
        return raw[:at] + bytes([choices.below(256)]) + raw[at + 1 :]
    if act == 2:  # lists, maps and texts that are said to be huge
        return raw[:at] + choices.of([b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"]) + b"\xff\xff\xff\xff" + raw[at:]
    return raw


# a node among neighbours that say anything

DECODERS = {
    (j, stage.name): Decoder(stage, j, sizes=system_and_stack()[0].sizes(j), ids=NEIGHBOURS[j])
    for j in IDS
    for stage in (MEASUREMENT, INTERMEDIATE)
}


def node(data: bytes) -> Node:
    """Drive a node by a fuzzer's decisions, and see that it keeps its books and its covariances."""
    choices = Choices(data)
    window = choices.of([0, 3])
    subject, now = make(choices.of(IDS), window=window, paced=bool(choices.below(2))), 0
    delivered: Counter[NodeId] = Counter()
    while choices.left:
        now += 1
        act = choices.below(10)
        j = choices.of(subject.neighbours)
        effects: Any = []
        if act < 2 and subject.stage is None and subject.step < 40:
            step = subject.step + choices.of([1, 1, 1, 2, 5])
            effects = subject.begin(step, path().measurement(subject.id, min(step, 40)), now)
        elif act == 2 and subject.deadline is not None:
            now = max(now, subject.deadline)
            effects = subject.tick(now)
        elif act == 3:
            effects = subject.gone(j, now)
        elif act == 4:
            subject.back(j)
        elif act == 5:
            answer(choices, subject, j)
        else:
            message = lie(choices, subject, j)
            if message is not None:
                delivered[j] += 1
                effects = subject.receive(message, now)
        check(told(effects))
    check_books(subject, delivered)
    return subject


def lie(choices: Choices, subject: Node, j: NodeId) -> Message | None:
    """A message of a neighbour's that its decoder lets pass, and that is otherwise anything; None: it does not."""
    stage = choices.of([MEASUREMENT, INTERMEDIATE])
    step = max(1, choices.of([0, 0, 0, 1, -1, 2, -3, LOOKAHEAD, LOOKAHEAD + 1, -REMEMBERED, 2**52]) + subject.step)
    born = max(1, choices.of([1, 1, 1, step, step - 3, step // 2]))
    size = system_and_stack()[0].nx if stage is INTERMEDIATE else system_and_stack()[0].sizes(j)["ny"]
    vector = np.array([choices.of(FLOATS[:9]) for _ in range(size)])
    fields: dict[str, object] = {"y": vector if choices.below(8) else None}
    if stage is INTERMEDIATE:
        starts = sorted({max(born, step - 1 - choices.below(12)) for _ in range(choices.below(4))} - {step})
        runs = tuple((start, tuple(choices.some(NEIGHBOURS[j]))) for start in starts)
        fields = {"x": vector, "used": tuple(choices.some(NEIGHBOURS[j])), "history": runs}
    message = Message(j, step, stage.name, choices.of([0, 1, 2, step, 2**52]), born, choices.of(NUMBERS[:4]), fields)
    try:
        return DECODERS[j, stage.name].decode(encode(message))
    except MessageError:
        return None


def answer(choices: Choices, subject: Node, j: NodeId) -> None:
    """What a neighbour answers that is asked for its history, if it can be read."""
    born, end = choices.below(20), subject.step + choices.of([0, 0, 1, -1, 5, -5, 2**40])
    starts = sorted({born + choices.below(20) for _ in range(choices.below(5))})
    raw = {"born": born, "end": end, "runs": [[start, choices.some(NEIGHBOURS[j])] for start in starts]}
    try:
        said = HistoryAnswer.decode(encode_any(raw), frozenset(NEIGHBOURS[j]))
    except MessageError:
        return
    subject.learn_history(j, said.born, said.end, said.runs)


def check(messages: list[Message]) -> None:
    """Whatever was said to the node, what it says is legal, and its covariances are covariances."""
    for message in messages:
        encode(message)
        if message.stage in ("estimate", "revised"):
            P: Any = message.fields["P"]
            assert np.isfinite(P).all()
            assert (P == P.T).all()
            assert np.linalg.eigvalsh(P)[0] >= -1e-9 * np.abs(P).max()


def check_books(subject: Node, delivered: Counter[NodeId]) -> None:
    """Every message is in one counter or still kept, and what is kept is bounded."""
    kept: Counter[NodeId] = Counter()
    for early in subject._early.values():
        kept.update(early.keys())
    for j, edge in subject.counters.items():
        assert edge.received.total() + edge.late.total() + edge.refused.total() + kept[j] == delivered[j]
    assert len(subject._early) <= 2 * (LOOKAHEAD + 1)
    assert len(subject._seen) <= LOOKAHEAD + REMEMBERED + 1
    assert set(NETWORK.neighbours(subject.id)) >= subject.counters.keys()


TARGETS: dict[str, Callable[[bytes], object]] = {"wire": wire, "node": node}

if __name__ == "__main__":
    import atheris

    target = TARGETS[sys.argv.pop(1)]
    atheris.instrument_all()
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
