"""What the tests of recordings share: traffic, and files of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from zfusion import keys
from zfusion.messages import encode
from zfusion.recording import Recording, RecordingWriter
from zfusion.stages import TRUTH_SENDER, Message

START_NS = 1_790_000_000_000_000_000
SCENARIO_TOML = 'name = "test"  # é\n'

Sent = list[tuple[str, bytes, int]]
"""(topic, payload, arrival)"""


def traffic(steps: int, nodes: tuple[int, ...] = (1, 2)) -> Sent:
    """What two nodes and the truth put on their keys, and when it came, 7 us after it was sent."""
    random = np.random.default_rng(5)
    sent: Sent = []
    for step in range(1, steps + 1):
        at = START_NS + step * 1_000_000
        truth = Message(TRUTH_SENDER, step, "truth", step - 1, 1, at, {"x": random.normal(size=2)})
        sent.append((keys.truth_key("r"), encode(truth), at + 7_000))
        for node in nodes:
            contents: dict[str, dict[str, object]] = {
                "measurement": {"y": random.normal(size=1) if step % 3 else None},
                "estimate": {"x": random.normal(size=2), "P": random.normal(size=(2, 2)), "used": (1,), "excluded": ()},
            }
            for stage, fields in contents.items():
                message = Message(node, step, stage, step - 1, 1, at, fields)
                sent.append((keys.stage_key("r", node, stage), encode(message), at + 7_000))
    return sent


def open_writer(path: Path, **more: Any) -> RecordingWriter:
    facts: dict[str, Any] = {"scenario_toml": SCENARIO_TOML, "run": "r", "method": "two_stage", "seed": 7}
    return RecordingWriter(path, **(facts | more))


def record(path: Path, sent: Sent, flush_every: int = 10**9, **more: Any) -> Path:
    with open_writer(path, **more) as writer:
        for number, message in enumerate(sent):
            writer.write(*message)
            if number % flush_every == flush_every - 1:
                writer.flush()
    return path


def contents(recording: Recording) -> Sent:
    return [(r.topic, r.data, r.log_time_ns) for r in recording.records()]


def read(path: Path) -> Sent:
    with Recording.open(path) as recording:
        return contents(recording)


def read_plainly(path: Path) -> Sent:
    """With nothing but the stock reader."""
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.data, message.log_time) for _, channel, message in messages]
