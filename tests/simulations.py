"""Scenarios to simulate, links with a will of their own, and recordings that somebody has tampered with."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from zfusion.drivers.simulated import Simulation, simulate
from zfusion.links import Edge, Link
from zfusion.messages import decode_any, encode_any
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import NodeId
from zfusion.recording import Keeping, Record, Recording, RecordingWriter
from zfusion.stages import Message

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"

MS = 1_000_000

Payload = dict[str, Any]


def four_sensor(steps: int = 30, **overrides: Any) -> Scenario:
    """The published example: everything correlated, four nodes, a directed graph."""
    return load_scenario(EXAMPLE, steps=steps, **overrides)


def walk(steps: int = 30, names: bool = False, **more: Any) -> Scenario:
    """Position and velocity, all noises white and Gaussian, five nodes in a ring, measurements of one and two."""
    ids: list[NodeId] = ["ada", "bob", "cyd", "dan", "eve"] if names else [10, 20, 30, 40, 50]
    H = ([[1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0]], [[1.0, 0.5]], [[1.0, 0.0]])
    document: dict[str, Any] = {
        "name": "walk",
        "seed": 4,
        "steps": steps,
        "timing": {"rate_hz": 50.0},
        "network": {"generator": "ring"},
        "system": {
            "F": [[1.0, 0.1], [0.0, 0.95]],
            "Q": [[0.02, 0.01], [0.01, 0.1]],
            "initial_mean": [3.0, -1.0],
            "initial_covariance": [[2.0, 0.3], [0.3, 1.0]],
        },
        "sensors": [{"id": i, "H": h, "R": (0.3 * np.eye(len(h))).tolist()} for i, h in zip(ids, H, strict=True)],
    }
    return Scenario.model_validate(document | more)


def by_rule(rule: Callable[[Edge, Message], int | None]) -> Link:
    """A link that delays every message by what the rule says, in nanoseconds; None loses it."""

    def link(edge: Edge, message: Message, sent_ns: int) -> Sequence[int]:
        delay = rule(edge, message)
        return () if delay is None else (sent_ns + delay,)

    return link


def losing(probability: float, seed: int) -> Link:
    """A link that loses each message with a probability, and delivers the others at once."""

    def rule(edge: Edge, message: Message) -> int | None:
        lost = Random(repr((seed, edge, message.stage, message.step))).random() < probability
        return None if lost else 0

    return by_rule(rule)


def record(path: Path, scenario: Scenario, link: Link | None = None) -> Path:
    """The recording of a simulation."""
    simulate(scenario, run="r", output=path, link=link)
    return path


def record_story(
    path: Path, scenario: Scenario, tell: Callable[[Simulation], None], link: Link | None = None
) -> Simulation:
    """The recording of a simulation in which something happens; `tell` runs it as far as it wants, then it ends."""
    with writer_for(path, scenario) as writer:
        simulation = Simulation(scenario, run="r", link=link, record=writer.write)
        tell(simulation)
        simulation.run()
    return simulation


def writer_for(path: Path, scenario: Scenario, keeping: Keeping | None = None) -> RecordingWriter:
    """A recording of run "r", to be written to."""
    toml = scenario.anchored().to_toml()
    facts = {"run": "r", "method": scenario.method.name}
    return RecordingWriter(path, scenario_toml=toml, seed=scenario.seed, keeping=keeping, **facts)


def records(path: Path) -> list[Record]:
    """All that is on a recording."""
    with Recording.open(path) as recording:
        return list(recording.records())


def payloads(path: Path, stage: str, node: object = None) -> list[Payload]:
    """The messages of a stage, of all nodes or of one."""
    suffix = f"/{stage}" if node is None else f"/node/{node}/{stage}"
    return [decode_any(record.data) for record in records(path) if record.topic.endswith(suffix)]


def rewrite(path: Path, target: Path, change: Callable[[Record], Iterable[Record]]) -> Path:
    """A recording with the same scenario, in which every record is replaced by what `change` makes of it."""
    with Recording.open(path) as recording:
        scenario = Scenario.from_toml(recording.scenario_toml)
        with writer_for(target, scenario) as writer:
            for old in recording.records():
                for new in change(old):
                    writer.write(new.topic, new.data, new.log_time_ns)
    return target


def without(path: Path, target: Path, *lost: tuple[object, str, int]) -> Path:
    """A recording without some messages, each given by node, stage and step."""

    def change(old: Record) -> list[Record]:
        payload = decode_any(old.data)
        *_, node, stage = old.topic.split("/")
        return [] if any((node, stage, payload["step"]) == (str(n), s, k) for n, s, k in lost) else [old]

    return rewrite(path, target, change)


def altered(
    path: Path, target: Path, place: tuple[object, str, int], change: Callable[[Payload], Mapping[str, Any]]
) -> Path:
    """A recording in which one message (node, stage, step) says something else: what `change` makes of it."""
    node, stage, step = place

    def rewritten(old: Record) -> list[Record]:
        payload = decode_any(old.data)
        if not old.topic.endswith(f"/node/{node}/{stage}") or payload["step"] != step:
            return [old]
        return [old._replace(data=encode_any(payload | dict(change(payload))))]

    return rewrite(path, target, rewritten)
