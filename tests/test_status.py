"""What nodes and the recorder answer when they are asked: as bytes and back, and what is refused."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import msgpack
import pytest

from zfusion.errors import MessageError
from zfusion.status import Counts, Phase, RecorderStatus, Status

COUNTS = Counts(
    host="alpha",
    skipped=1,
    elapsed_s=12.5,
    cpu_s=0.25,
    sent={"estimate": 17},
    edges={"2": {"received": {"measurement": 16}, "lost": {"measurement": 1}}, "3": {"lost": {"measurement": 2}}},
    overheard={"wrong_node": 1},
    incidents={},
    waits={"measurement": {"0": 3, "320": 4}},
    clocks={"2": {"offset_us": -3.0, "uncertainty_us": 40.5}},
    queues={"ahead": 0},
)
STATUS = Status(1, "f" * 64, Phase.RUNNING, 18, 1, 5, {1: 7, 2: 8}, estimate={"x": [1.0], "sd": [0.5]}, counts=COUNTS)
RECORDER = RecorderStatus(messages=5, foreign=0, lost=1, waiting=2, path="run.mcap", host="beta")


def test_statuses_come_back_as_they_were() -> None:
    assert Status.decode(STATUS.encode()) == STATUS
    assert Status.decode(replace(STATUS, counts=None).encode()).counts is None
    assert RecorderStatus.decode(RECORDER.encode()) == RECORDER
    assert COUNTS.total("lost") == 3


def test_a_node_that_counts_nothing_yet_or_is_older_is_understood() -> None:
    raw = msgpack.unpackb(STATUS.encode())
    del raw["counts"], raw["estimate"]
    raw["beyond"] = "what a newer one may add"
    assert Status.decode(msgpack.packb(raw)) == replace(STATUS, counts=None, estimate={})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("estimate", "x"), [1]),
        (("estimate", "x"), [float("nan")]),
        (("estimate",), [1.0]),
        (("counts",), "many"),
        (("counts", "skipped"), True),
        (("counts", "elapsed_s"), float("inf")),
        (("counts", "host"), 5),
        (("counts", "sent", "estimate"), 1.5),
        (("counts", "edges", "2"), 3),
        (("counts", "edges", "2", "lost"), [1]),
        (("counts", "edges", "2", "lost", "measurement"), "1"),
        (("counts", "waits", "measurement", "-1"), 1),
        (("counts", "waits", "measurement", "99999"), 1),
        (("counts", "clocks", "2", "offset_us"), float("nan")),
    ],
)
def test_what_is_no_status_is_refused(path: tuple[str, ...], value: object) -> None:
    raw: dict[str, Any] = msgpack.unpackb(STATUS.encode())
    inner: Any = raw
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    with pytest.raises(MessageError):
        Status.decode(msgpack.packb(raw))


@pytest.mark.parametrize("name", asdict(RECORDER))
def test_what_is_no_recorders_status_is_refused(name: str) -> None:
    raw = asdict(RECORDER)
    for wrong in ({**raw, name: [1]}, {other: value for other, value in raw.items() if other != name}):
        with pytest.raises(MessageError):
            RecorderStatus.decode(msgpack.packb(wrong))
