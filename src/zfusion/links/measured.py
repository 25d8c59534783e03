"""What was measured of a network, as a network: a recorded run's own latencies and losses once more.

A recording tells how long messages took (stage "arrivals"), which of them were used in time (the used sets), and when
steps were due. What was used was there by its stage's deadline, and what was not used was not, whatever the last
microseconds before a deadline were spent on: where the two disagree, the used sets are right.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

from zfusion import keys
from zfusion.errors import MessageError
from zfusion.links.protocol import EPOCH_NS, Edge
from zfusion.messages import Decoder
from zfusion.methods import chosen
from zfusion.methods.check import deadline_ns
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, Message

Place = tuple[Edge, str]
"""(edge, stage)."""


class Passage(NamedTuple):
    """How one message came, in nanoseconds."""

    latency_ns: int
    """From when it was sent."""
    after_ns: int
    """From when its step was due; in a free-running swarm, whose steps have no times, the latency once more."""


@dataclass(frozen=True, slots=True)
class MeasuredLinks:
    """The links of a run that was recorded: each message arrives as it did then, `Link` of them all.

    In a paced swarm each arrives so long after its step was due: so what was in time, late or lost is the same,
    although a simulated node needs no time to compute. In a free-running one, and for whoever asks for `latency_ns`,
    so long after it was sent.
    """

    passages: Mapping[Place, Mapping[int, Passage]] = field(default_factory=dict)
    """By step, of the messages that came."""
    epoch_ns: int = EPOCH_NS
    """When step 0 is, in the run that these are links of."""
    period_ns: int | None = None
    """None: free-running."""

    @classmethod
    def of(cls, recording: Recording, *, epoch_ns: int | None = None) -> MeasuredLinks:
        """What a recording measured, for a run whose step 0 is at `epoch_ns`: by default, a simulation of the same.

        ScenarioError if the recording's scenario cannot be read.
        """
        scenario = Scenario.from_toml(recording.scenario_toml, str(recording.path), recording.path.absolute().parent)
        if epoch_ns is None:
            epoch_ns = EPOCH_NS if scenario.timing.epoch_ns is None else scenario.timing.epoch_ns
        return cls(_read(recording, scenario).passages(scenario), epoch_ns, scenario.timing.period_ns)

    def __call__(self, edge: Edge, message: Message, sent_ns: int, /) -> Sequence[int]:
        """See `Link`."""
        passage = self.passages.get((edge, message.stage), {}).get(message.step)
        if passage is None:
            return ()
        if self.period_ns is None:
            return (sent_ns + max(0, passage.latency_ns),)
        return (max(sent_ns, self.epoch_ns + message.step * self.period_ns + passage.after_ns),)

    def latency_ns(self, edge: Edge, stage: str, step: int) -> int | None:
        """How long a message was on its way; None if it did not arrive."""
        passage = self.passages.get((edge, stage), {}).get(step)
        return None if passage is None else max(0, passage.latency_ns)


class _Found:
    """What a recording tells of how its messages came."""

    def __init__(self, stages: Collection[str]) -> None:
        self.stages = tuple(stages)
        self.epoch_ns = 0
        self.sent: dict[Place, dict[int, int]] = {}
        """By edge and stage, step -> when it was sent."""
        self.latencies: dict[Place, dict[int, int]] = {}
        self.used: dict[tuple[NodeId, str], dict[int, frozenset[NodeId]]] = {}
        """By receiver and stage, step -> whose messages it had in time."""

    def passages(self, scenario: Scenario) -> dict[Place, dict[int, Passage]]:
        """How each message came."""
        passages: dict[Place, dict[int, Passage]] = {}
        for place, sent in self.sent.items():
            found = ((step, self._passage(scenario, place, step, sent_ns)) for step, sent_ns in sent.items())
            passages[place] = {step: passage for step, passage in found if passage is not None}
        return passages

    def _passage(self, scenario: Scenario, place: Place, step: int, sent_ns: int) -> Passage | None:
        (sender, receiver), stage = place
        latency = self.latencies.get(place, {}).get(step)
        used = self.used.get((receiver, stage), {}).get(step)
        if used is None or (latency is None and sender not in used):
            return None  # the receiver did not take the step, or it never came
        period = scenario.timing.period_ns
        if period is None:
            return Passage(latency or 0, latency or 0)
        due, deadline = self.epoch_ns + step * period, deadline_ns(scenario, stage)
        after = deadline if latency is None else sent_ns + latency - due
        after = min(after, deadline) if sender in used else max(after, deadline + 1)
        return Passage(due + after - sent_ns if latency is None else latency, after)


def _read(recording: Recording, scenario: Scenario) -> _Found:
    method = chosen(scenario)
    graph = method.network(scenario.network)
    stages = [stage.name for stage in method.stages]
    before = dict(zip([*stages[1:], ESTIMATE.name], stages, strict=True))
    """Stage -> the one before it, whose used set it tells."""
    listeners = {j: [i for i in graph.listeners(j) if i != j] for j in graph.ids}
    found = _Found(stages)
    for message in _messages(recording, scenario):
        node, stage, step = message.node, message.stage, message.step
        if stage == ARRIVALS.name:
            _note_arrivals(found, node, cast("Mapping[str, Any]", message.fields["data"]))
        elif stage == EVENT.name and message.fields["kind"] == "started":
            epoch_ns = cast("Mapping[str, Any]", message.fields["data"]).get("epoch_ns")
            found.epoch_ns = epoch_ns if type(epoch_ns) is int else found.epoch_ns
        if stage in stages:
            for i in listeners[node]:
                found.sent.setdefault(((node, i), stage), {}).setdefault(step, message.t_ns)
        if stage in before:
            told = [cast("tuple[NodeId, ...]", message.fields.get(name, ())) for name in ("used", "excluded")]
            found.used.setdefault((node, before[stage]), {})[step] = frozenset(told[0] + told[1])
    return found


def _messages(recording: Recording, scenario: Scenario) -> Iterator[Message]:
    """All legal messages of the scenario's nodes."""
    method, system, run = chosen(scenario), scenario.system(), recording.metadata["run"]
    graph = method.network(scenario.network)
    decoders = {
        keys.stage_key(run, i, stage.name): Decoder(stage, i, sizes=system.sizes(i), ids=graph.neighbours(i))
        for i in graph.ids
        for stage in (*method.stages, ESTIMATE, EVENT, ARRIVALS)
    }
    for topic, data, *_ in recording.records(decoders):
        try:
            yield decoders[topic].decode(data)
        except MessageError:
            continue  # not of the run


def _note_arrivals(found: _Found, node: NodeId, data: Mapping[str, Any]) -> None:
    for sender, stage, step, latency in read_arrivals(data):
        edge: Edge = (sender, node)
        found.latencies.setdefault((edge, stage), {}).setdefault(step, latency)


def read_arrivals(data: Mapping[str, Any]) -> Iterator[tuple[NodeId, str, int, int]]:
    """(sender, stage, step, latency in ns) of each latency that the data of a message "arrivals" tell.

    What is not written like that is skipped: it may be somebody else's word.
    """
    edges = data.get("edges")
    for edge in edges if isinstance(edges, list) else ():
        match edge:
            case {
                "from": int() | str() as sender,
                "stage": str() as stage,
                "steps": [*steps],
                "latency_ns": [*latencies],
            }:
                runs = [run for run in steps if isinstance(run, list) and [*map(type, run)] == [int, int]]
                of_steps = (step for first, count in runs for step in range(first, first + count))
                pairs = zip(of_steps, latencies, strict=False)
                yield from ((sender, stage, step, latency) for step, latency in pairs if type(latency) is int)
