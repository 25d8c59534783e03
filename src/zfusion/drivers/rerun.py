"""What if: the measurements of a recording through another method, graph or network, in the simulated world.

The new recording has the old measurements, and its scenario says where they are from; so it can be verified, and
rerun, like any other.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import zip_longest
from math import sqrt
from pathlib import Path
from typing import Any, cast

from zfusion import keys
from zfusion.drivers.designs import handed_on
from zfusion.drivers.metrics import Errors, NodeReport
from zfusion.drivers.replayed import recorded_scenario
from zfusion.drivers.simulated import simulate
from zfusion.drivers.sources import TableSource
from zfusion.errors import InputError, MessageError
from zfusion.links import Link
from zfusion.messages import Decoder
from zfusion.methods import chosen as method_of
from zfusion.model.scenario import Overrides, Scenario
from zfusion.model.types import Array, NodeId
from zfusion.recording.paths import refuse_to_replace
from zfusion.recording.reader import Recording
from zfusion.stages import ARRIVALS, ESTIMATE, MEASUREMENT, TRUTH, TRUTH_SENDER, Message


@dataclass(slots=True)
class Change:
    """How one node's estimates differ between a recording and its rerun."""

    compared: int = 0
    """Steps of which both have an estimate."""
    squared: float = 0.0
    """Sum of |new - old|^2 over them."""
    before: Mapping[str, float] = field(default_factory=dict)
    """Errors of the recorded estimates against the truth, as `Errors.summary`; count 0 where it is not known."""
    after: Mapping[str, float] = field(default_factory=dict)
    """Errors of the new ones."""

    @property
    def rms(self) -> float | None:
        """Root of the mean of |new - old|^2; None where there was nothing to compare."""
        return sqrt(self.squared / self.compared) if self.compared else None

    def add(self, difference: Array) -> None:
        """Count new - old, (nx,), of one step."""
        self.compared += 1
        self.squared += float(difference @ difference)

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        return {"compared": self.compared, "rms": self.rms, "before": dict(self.before), "after": dict(self.after)}


@dataclass(frozen=True, slots=True)
class Rerun:
    """What became of a rerun."""

    scenario: Scenario
    reports: dict[NodeId, list[NodeReport]]
    changes: dict[NodeId, Change]

    def as_dict(self) -> dict[str, Any]:
        """The comparison as plain data, for JSON."""
        return {str(node): change.as_dict() for node, change in self.changes.items()}


@dataclass(slots=True)
class Recorded:
    """What a recording has for the sensors and the state of a scenario."""

    measurements: dict[NodeId, dict[int, Array]]
    truths: dict[int, Array] = field(default_factory=dict)
    steps: int = 0
    """The last step that any of the nodes began."""
    refused: Counter[NodeId] = field(default_factory=Counter)
    """Messages that are no measurements of the scenario's sensor."""


def rerun(
    recording: Recording,
    scenario: Scenario | Overrides,
    output: Path,
    *,
    link: Link | None = None,
    run: str | None = None,
) -> Rerun:
    """Run another scenario, or the recorded one with overrides, on the recorded measurements; write `output`.

    The sensors of the scenario must be on the recording; it may leave some out. Nodes that had no reading then have
    none now. As many steps as are recorded, at most as many as the scenario has; `link` in the place of the scenario's
    links decides which messages arrive, and when. `run` names the new run, by default the old one's name with "-rerun".

    InputError for a sensor that is not on the recording, or not of the size that the scenario says, or if `output`
    is the recording itself; otherwise as `simulate`.
    """
    refuse_to_replace(output, recording.not_to_replace)
    old = recorded_scenario(recording)
    wanted = scenario if isinstance(scenario, Scenario) else handed_on(old, old.with_overrides(**scenario))
    recorded = read_recorded(recording, wanted)
    new = _on_recording(wanted, recording.path, min(wanted.steps, recorded.steps))
    sources = {i: TableSource(recorded.measurements[i], recorded.truths, recorded.refused[i]) for i in new.ids}
    name = keys.check_run(run or f"{recording.metadata['run']}-rerun")
    reports = simulate(new, run=name, output=output, link=link, sources=sources)
    with Recording.open(output) as again:
        changes = _compare(recording, old, again, new, recorded.truths)
    return Rerun(new, reports, changes)


def with_recorded_links(scenario: Scenario, recording: Recording) -> Scenario:
    """The scenario with the latencies and losses that the recording measured in the place of its links.

    InputError where it has measured none.
    """
    if not any(topic.endswith(f"/{ARRIVALS.name}") for topic in recording.topics):
        raise InputError(f"{recording.path}: no latencies were measured in it: it has no messages {ARRIVALS.name!r}")
    document = tomllib.loads(scenario.anchored().to_toml())
    document["links"] = {"recorded": {"recording": str(recording.path.absolute())}}
    return handed_on(scenario, Scenario.model_validate(document))


def on_recording(recording: Recording, scenario: Scenario | None = None) -> Scenario:
    """The recorded scenario, or another one, with the recording as the source of all measurements and of the truth.

    Of as many steps as are recorded, at most as many as it has. InputError as `rerun`.
    """
    wanted = recorded_scenario(recording) if scenario is None else scenario
    return _on_recording(wanted, recording.path, min(wanted.steps, read_recorded(recording, wanted).steps))


def _on_recording(scenario: Scenario, path: Path, steps: int) -> Scenario:
    """The scenario with the recording as the source of all its measurements."""
    document = tomllib.loads(scenario.anchored().to_toml())
    for sensor in document["sensors"]:
        sensor.pop("source", None)
    document |= {"source": {"kind": "mcap", "recording": str(path.absolute())}, "steps": steps}
    return handed_on(scenario, Scenario.model_validate(document))


def read_recorded(recording: Recording, scenario: Scenario) -> Recorded:
    """All measurements and truths, of two of one step the first; InputError for a sensor of which there is nothing."""
    system, run = scenario.system(), recording.metadata["run"]
    readers: dict[str, tuple[NodeId, Decoder]] = {
        keys.stage_key(run, i, MEASUREMENT.name): (
            i,
            Decoder(MEASUREMENT, i, sizes={"ny": system.by_id[i].ny}, beside=True),
        )
        for i in scenario.ids
    }
    readers[keys.truth_key(run)] = (TRUTH_SENDER, Decoder(TRUTH, TRUTH_SENDER, sizes={"nx": system.nx}))
    recorded = Recorded({i: {} for i in scenario.ids})
    found: set[NodeId] = set()
    refusals: dict[NodeId, str] = {}
    for topic, data, *_ in recording.records(readers):
        sender, decoder = readers[topic]
        try:
            message = decoder.decode(data)
        except MessageError as error:
            recorded.refused[sender] += 1
            refusals.setdefault(sender, str(error))
            continue
        found.add(sender)
        _keep(recorded, message)
    for i in scenario.ids:
        if i not in found:
            why = refusals.get(i, "there are none")
            raise InputError(f"{recording.path}: no measurements of sensor {i} of the scenario: {why}")
    return recorded


def _keep(recorded: Recorded, message: Message) -> None:
    if message.stage == TRUTH.name:
        recorded.truths.setdefault(message.step, cast(Array, message.fields["x"]))
        return
    recorded.steps = max(recorded.steps, message.step)
    y = cast("Array | None", message.fields["y"])
    if y is not None:
        recorded.measurements[message.node].setdefault(message.step, y)


def _compare(
    before: Recording, old: Scenario, after: Recording, new: Scenario, truths: Mapping[int, Array]
) -> dict[NodeId, Change]:
    """The estimates of two recordings, side by side: each is read once, with no more kept than one is ahead."""
    changes: dict[NodeId, Change] = {i: Change() for i in new.ids}
    errors = {i: (Errors(), Errors()) for i in new.ids}
    ahead: tuple[dict[_Place, Array], dict[_Place, Array]] = ({}, {})
    for pair in zip_longest(_estimates(before, old, new), _estimates(after, new, new)):
        for side, message in enumerate(pair):
            if message is None:
                continue
            x, place = cast(Array, message.fields["x"]), (message.node, message.step)
            truth = truths.get(message.step)
            if truth is not None and truth.shape == x.shape:
                errors[message.node][side].add(x - truth, cast(Array, message.fields["P"]))
            other = ahead[1 - side].pop(place, None)
            if other is None:
                ahead[side][place] = x
            elif other.shape == x.shape:
                changes[message.node].add(x - other)
    for i, change in changes.items():
        change.before, change.after = (one.summary() for one in errors[i])
    return changes


_Place = tuple[NodeId, int]


def _estimates(recording: Recording, scenario: Scenario, chosen: Scenario) -> Iterator[Message]:
    """The estimates of those nodes that both scenarios have."""
    run, system = recording.metadata["run"], scenario.system()
    graph = method_of(scenario).network(scenario.network)
    decoders = {
        keys.stage_key(run, i, ESTIMATE.name): Decoder(ESTIMATE, i, sizes={"nx": system.nx}, ids=graph.neighbours(i))
        for i in scenario.ids
        if i in chosen.ids
    }
    for topic, data, *_ in recording.records(decoders):
        with suppress(MessageError):
            yield decoders[topic].decode(data)
