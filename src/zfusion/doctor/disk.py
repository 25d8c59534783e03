"""Room and speed where the recording goes, against what the swarm will say."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zfusion.doctor.finding import Finding, Topic
from zfusion.messages import encode
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.stages import ESTIMATE, TRUTH, TRUTH_SENDER, Field, Kind, Message, Stage

TOPIC = Topic("disk")

AROUND = 40
"""Bytes that a recording has around each message, beside its share of the index."""

PROBE = 8 << 20
"""Bytes that are written to see how fast that goes."""

DAY_S = 86_400


class Room(NamedTuple):
    """What there is for a recording."""

    free: int
    """Bytes."""
    speed: float
    """Bytes a second that reach the disk."""


def bytes_per_step(scenario: Scenario) -> int:
    """What a step's messages take on a recording, before it is compressed."""
    graph, system = chosen(scenario).network(scenario.network), scenario.system()
    total = 0
    for i in scenario.ids:
        for stage in (*chosen(scenario).stages, ESTIMATE):
            total += _size(stage, i, system.sizes(i), graph.neighbours(i))
    return total + (_size(TRUTH, TRUTH_SENDER, {"nx": system.nx}, ()) if scenario.truth_known else 0)


def _size(stage: Stage, sender: NodeId, sizes: dict[str, int], ids: tuple[NodeId, ...]) -> int:
    fields = {field.name: _value(field, sizes, ids) for field in stage.fields}
    return len(encode(Message(sender, 1000, stage.name, 1000, 1, time.time_ns(), fields))) + AROUND


def _value(field: Field, sizes: dict[str, int], ids: tuple[NodeId, ...]) -> object:
    """A value of the size that such values have."""
    match field.kind:
        case Kind.VECTOR | Kind.OPTIONAL_VECTOR | Kind.MATRIX:
            return np.full(field.lengths(sizes), 0.1)
        case Kind.IDS:
            return ids
        case Kind.HISTORY:
            return ((1, ids),)
        case Kind.STEP:
            return 1000
        case Kind.TEXT:
            return ""
    return {}


def room(directory: Path) -> Room:
    """Measured, with a file that is gone afterwards; OSError where none can be written."""
    directory = _existing(directory)
    with tempfile.NamedTemporaryFile(dir=directory, prefix=".zfusion-doctor-") as file:
        began = time.perf_counter()
        for _ in range(8):
            file.write(os.urandom(PROBE // 8))
        file.flush()
        os.fsync(file.fileno())
        speed = PROBE / (time.perf_counter() - began)
    return Room(shutil.disk_usage(directory).free, speed)


def _existing(directory: Path) -> Path:
    """The directory, or the one that it would be made in."""
    directory = directory.absolute()
    while not directory.exists():
        directory = directory.parent
    return directory


def check_disk(directory: Path, per_step: int, rate_hz: float | None, steps: int) -> Iterator[Finding]:
    """`rate_hz`: steps a second; None in free running."""
    try:
        there = room(directory)
    except OSError as error:
        remedy = "make room, give the right to write, or record elsewhere (recording.directory, --record)"
        yield TOPIC.error(
            f"{directory}: {error.strerror}", "there is no recording, and launch refuses to start", remedy
        )
        return
    yield from judge(directory, there, per_step, rate_hz, steps)


def judge(directory: Path, there: Room, per_step: int, rate_hz: float | None, steps: int) -> Iterator[Finding]:
    """What the room means for a run."""
    whole = per_step * steps
    said = f"{directory}: {_bytes(there.free)} free; a step is {_bytes(per_step)}, {steps} steps {_bytes(whole)}"
    lasts_s = None if rate_hz is None else there.free / (per_step * rate_hz)
    full = "" if lasts_s is None else f", full after {lasts_s / 3600:.3g} h"
    if whole > there.free:
        why = f"the disk is full before the run is over{full}; compression makes it a little better"
        yield TOPIC.error(said, why, "make room, record elsewhere, or take fewer steps")
    elif lasts_s is not None and lasts_s < DAY_S:
        why = f"with --forever it is{full}"
        yield TOPIC.warning(said, why, "make room, or record elsewhere (recording.directory, --record)")
    else:
        yield TOPIC.ok(said + full)
    if rate_hz is not None and there.speed < 2 * per_step * rate_hz:
        why = f"the run makes {_bytes(per_step * rate_hz)} a second: the recorder falls behind"
        yield TOPIC.error(f"{directory}: takes {_bytes(there.speed)} a second", why, "record to a faster disk")
    else:
        yield TOPIC.ok(f"{directory}: takes {_bytes(there.speed)} a second")


def _bytes(number: float) -> str:
    for unit in ("bytes", "kB", "MB", "GB"):
        if number < 1000:
            return f"{number:.3g} {unit}"
        number /= 1000
    return f"{number:.3g} TB"
