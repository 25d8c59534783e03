"""What a recording tells of its run, taken out for a report: errors, what was used, latencies, events, messages.

Read once for what concerns the whole run, and once more for the messages of the few rounds that are drawn. What is no
legal message is counted, and nobody's input.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np

from zfusion import keys
from zfusion.drivers.replayed import recorded_scenario
from zfusion.errors import MessageError
from zfusion.messages import Decoder
from zfusion.methods import chosen
from zfusion.methods.check import deadline_ns
from zfusion.model.network import Edge, Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.recording.reader import Recording
from zfusion.report.figures.space_time import Fate, Flight, Mark, Round
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, TRUTH, TRUTH_SENDER, Message

TROUBLE = {"fault": 20, "started": 20, "gone": 10, "revised": 3, "history": 3}
"""How interesting a step is for an event; a message that was not used counts 1."""

SILENT = ("stopped",)
"""Events that are part of every run."""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a node told."""

    node: NodeId
    step: int
    born: int
    t_ns: int
    kind: str
    data: Mapping[str, Any]


@dataclass(slots=True)
class Estimates:
    """One node's estimates, in the order in which it told them."""

    steps: list[int] = field(default_factory=list)
    x: list[Array] = field(default_factory=list)
    P: list[Array] = field(default_factory=list)


@dataclass(frozen=True)
class Errors:
    """One node's errors where the truth is known; rows are steps, ascending."""

    steps: Array
    error: Array
    """x̂ - x, (n, nx)."""
    P: Array
    """What was predicted of them, (n, nx, nx)."""

    @property
    def squared(self) -> Array:
        """|x̂ - x|², (n,)."""
        return np.asarray((self.error**2).sum(axis=1))

    @property
    def predicted(self) -> Array:
        """trace P, (n,)."""
        return np.asarray(np.einsum("kaa->k", self.P))

    @property
    def sd(self) -> Array:
        """Standard deviations of the components, (n, nx)."""
        return np.asarray(np.sqrt(np.einsum("kaa->ka", self.P)))

    @property
    def nees(self) -> float | None:
        """Mean of (x̂ - x)ᵀ P⁻¹ (x̂ - x) / nx; None where some P is singular."""
        try:
            scaled = np.linalg.solve(self.P, self.error[:, :, None])[:, :, 0]
        except np.linalg.LinAlgError:
            return None
        return float(np.mean(np.sum(self.error * scaled, axis=1)) / self.error.shape[1])


@dataclass(slots=True)
class Channel:
    """One stage's messages on one edge."""

    used: int = 0
    """Steps at which the receiver used one."""
    unused: set[int] = field(default_factory=set)
    """Steps at which it used none, although one was sent."""
    latencies_ns: dict[int, int] = field(default_factory=dict)
    """By step; what the receiver told."""

    @property
    def expected(self) -> int:
        """Messages that were sent for steps that the receiver took."""
        return self.used + len(self.unused)


class RunFacts:
    """All of a run but its single messages."""

    def __init__(self, recording: Recording) -> None:
        """Reads the recording. Raises as `recorded_scenario` does."""
        self.recording = recording
        self.scenario: Scenario = recorded_scenario(recording)
        method = chosen(self.scenario)
        self.network: Network = method.network(self.scenario.network)
        """The method's graph."""
        self.stages = tuple(stage.name for stage in method.stages)
        """Those that are exchanged, in order."""
        self._tables = {s.name: s for s in (*method.stages, ESTIMATE, EVENT, ARRIVALS)}
        self.truths: dict[int, Array] = {}
        self.estimates: dict[NodeId, Estimates] = {i: Estimates() for i in self.network.ids}
        self.channels: dict[tuple[Edge, str], Channel] = {
            ((j, i), stage): Channel()
            for i in self.network.ids for j in self.network.neighbours(i) if j != i for stage in self.stages
        }  # fmt: skip
        self.sent: defaultdict[tuple[NodeId, str], set[int]] = defaultdict(set)
        """(node, stage) -> steps of which there is a message."""
        self.events: list[Event] = []
        self.lives: dict[tuple[NodeId, int], tuple[int, int]] = {}
        """(node, first step) -> first and last time at which it said something."""
        self.trouble: Counter[int] = Counter()
        """How interesting each step is."""
        self.told_until: dict[NodeId, int] = {}
        """By receiver: up to which step it told latencies."""
        self.unreadable = 0
        self.last_step = 0
        self.to_recorder_ns: dict[NodeId, list[int]] = {i: [] for i in self.network.ids}
        """By sender: how long its messages took to the recorder, the difference of two clocks."""
        for message, log_time_ns in self._messages():
            self._take(message, log_time_ns)
        for ((sender, _), stage), channel in self.channels.items():
            channel.unused &= self.sent[sender, stage]  # nobody can use what a dead node did not say
            self.trouble.update(channel.unused)

    @cached_property
    def errors(self) -> dict[NodeId, Errors]:
        """By node, where there is anything to compare."""
        found = {}
        for node, told in self.estimates.items():
            known = [n for n, step in enumerate(told.steps) if step in self.truths]
            if known:
                steps = np.array([told.steps[n] for n in known])
                order = np.argsort(steps, kind="stable")
                error = np.array([told.x[n] - self.truths[told.steps[n]] for n in known])
                P = np.array([told.P[n] for n in known])
                found[node] = Errors(steps[order], error[order], P[order])
        return found

    @property
    def has_latencies(self) -> bool:
        """Whether the nodes told how long messages took."""
        return any(channel.latencies_ns for channel in self.channels.values())

    @property
    def epoch_ns(self) -> int | None:
        """When step 0 was, where the nodes said so."""
        for event in self.events:
            if event.kind == "started" and isinstance(event.data.get("epoch_ns"), int):
                return cast(int, event.data["epoch_ns"])
        return None

    def interesting(self, count: int) -> range:
        """So many successive steps: those in which the most went wrong, else around the worst error, else the first."""
        last = max(self.last_step, 1)
        width = min(count, last)
        if self.trouble:
            score = np.zeros(last + 1)
            for step, weight in self.trouble.items():
                if 1 <= step <= last:
                    score[step] += weight
            sums = np.convolve(score[1:], np.ones(width), mode="valid")
            first = 1 + int(np.argmax(sums))
            lead = min(width - 1, max(0, int(np.argmax(score[first : first + width] > 0)) - 1))
            first = min(first + lead, last - width + 1)
        elif self.errors:
            worst = max((float(e.squared.max()), int(e.steps[int(e.squared.argmax())])) for e in self.errors.values())
            first = min(max(1, worst[1] - width // 2), last - width + 1)
        else:
            first = 1
        return range(first, first + width)

    def marks(self) -> list[Mark]:
        """The events in a few words."""
        return [Mark(e.node, e.t_ns, words) for e in self.events if (words := event_words(e))]

    def presence(self) -> dict[NodeId, list[tuple[int, int]]]:
        """By node, from when to when each of its lives was heard of."""
        found: dict[NodeId, list[tuple[int, int]]] = {i: [] for i in self.network.ids}
        for (node, _), span in sorted(self.lives.items(), key=lambda life: life[1]):
            found[node].append(span)
        return found

    def rounds(self, steps: range, flights: Sequence[Flight]) -> list[Round]:
        """When these steps were due, and their deadlines; in a free run, when their first message was sent."""
        timing, epoch = self.scenario.timing, self.epoch_ns
        rounds = []
        for step in steps:
            if timing.period_ns is not None and epoch is not None:
                due = epoch + step * timing.period_ns
                waits = timing.late == "wait"
                deadlines = {} if waits else {s: due + deadline_ns(self.scenario, s) for s in self.stages}
                rounds.append(Round(step, due, deadlines))
            elif sent := [f.sent_ns for f in flights if f.step == step]:
                rounds.append(Round(step, min(sent), {}))
        return rounds

    def flights(self, steps: range) -> list[Flight]:
        """The messages of these steps on every edge, and what became of each."""
        sent: dict[tuple[NodeId, str, int], tuple[int, int]] = {}
        used: dict[tuple[NodeId, str, int], set[NodeId]] = {}
        for message, log_time_ns in self._messages():
            if message.step in steps and message.stage in (*self.stages, ESTIMATE.name):
                sent.setdefault((message.node, message.stage, message.step), (message.t_ns, log_time_ns))
                if (before := self._before(message.stage)) is not None:
                    used[message.node, before, message.step] = set(_inputs(message))
        revised = self._revised()
        flights = []
        for ((j, i), stage), channel in self.channels.items():
            for step in steps:
                if (j, stage, step) in sent:
                    taken = used.get((i, stage, step))
                    is_revised = j in revised.get((i, step), ()) and stage == self.stages[0]
                    flight = self._flight((j, i), stage, step, sent[j, stage, step], channel, taken, is_revised)
                    flights += [flight] if flight else []
        return flights

    def _flight(
        self,
        edge: Edge,
        stage: str,
        step: int,
        times_ns: tuple[int, int],
        channel: Channel,
        taken: set[NodeId] | None,
        is_revised: bool,
    ) -> Flight | None:
        """What became of a message; None where the receiver was not there and nothing came."""
        sender, receiver = edge
        sent_ns, log_time_ns = times_ns
        latency_ns = channel.latencies_ns.get(step)
        arrived_ns = None if latency_ns is None else sent_ns + latency_ns
        if taken is not None and sender in taken:
            return Flight(sender, receiver, stage, step, sent_ns, arrived_ns or log_time_ns, Fate.USED)
        if is_revised:
            return Flight(sender, receiver, stage, step, sent_ns, arrived_ns, Fate.REVISED)
        if arrived_ns is not None:
            return Flight(sender, receiver, stage, step, sent_ns, arrived_ns, Fate.LATE)
        if taken is None:
            return None
        known = step <= self.told_until.get(receiver, 0)
        return Flight(sender, receiver, stage, step, sent_ns, None, Fate.LOST if known else Fate.UNUSED)

    def _messages(self) -> Iterator[tuple[Message, int]]:
        """All legal messages of the run, with the recorder's times."""
        decoders = dict(self._decoders())
        self.unreadable = 0
        for record in self.recording.records(decoders):
            try:
                yield decoders[record.topic].decode(record.data), record.log_time_ns
            except MessageError:
                self.unreadable += 1

    def _decoders(self) -> Iterator[tuple[str, Decoder]]:
        system = self.scenario.system()
        for topic in self.recording.topics:
            with suppress(MessageError, KeyError):
                key = keys.parse(topic)
                if key.stage == TRUTH.name and key.node is None:
                    yield topic, Decoder(TRUTH, TRUTH_SENDER, sizes={"nx": system.nx})
                elif key.stage in self._tables:
                    node = self.scenario.node_id(key.node or "")
                    sizes = system.sizes(node)
                    table, ids = self._tables[key.stage], self.network.neighbours(node)
                    yield topic, Decoder(table, node, sizes=sizes, ids=ids)

    def _take(self, message: Message, log_time_ns: int) -> None:
        if message.stage == TRUTH.name:
            self.truths.setdefault(message.step, cast(Array, message.fields["x"]))
            return
        life = message.node, message.born
        first, last = self.lives.get(life, (message.t_ns, message.t_ns))
        self.lives[life] = (min(first, message.t_ns), max(last, message.t_ns))
        if message.stage == EVENT.name:
            self._take_event(message)
        elif message.stage == ARRIVALS.name:
            self._take_arrivals(message)
        else:
            self.sent[message.node, message.stage].add(message.step)
            self.to_recorder_ns[message.node].append(log_time_ns - message.t_ns)
            self.last_step = max(self.last_step, message.step)
            self._count_inputs(message)
            if message.stage == ESTIMATE.name:
                told = self.estimates[message.node]
                told.steps.append(message.step)
                told.x.append(cast(Array, message.fields["x"]))
                told.P.append(cast(Array, message.fields["P"]))

    def _take_event(self, message: Message) -> None:
        kind, data = cast(str, message.fields["kind"]), cast("Mapping[str, Any]", message.fields["data"])
        self.events.append(Event(message.node, message.step, message.born, message.t_ns, kind, data))
        if kind in TROUBLE and (kind != "started" or message.born > 1):
            self.trouble[message.step] += TROUBLE[kind]

    def _take_arrivals(self, message: Message) -> None:
        data = cast("Mapping[str, Any]", message.fields["data"])
        with suppress(KeyError, TypeError, ValueError):  # another version's
            for edge in data["edges"]:
                channel = self.channels.get(((edge["from"], message.node), edge["stage"]))
                steps = [step for first, count in edge["steps"] for step in range(first, first + count)]
                if channel is not None:
                    channel.latencies_ns |= dict(zip(steps, edge["latency_ns"], strict=True))
                self.told_until[message.node] = max(self.told_until.get(message.node, 0), message.step)

    def _count_inputs(self, message: Message) -> None:
        before = self._before(message.stage)
        if before is None:
            return
        inputs = set(_inputs(message))
        for j in self.network.neighbours(message.node):
            if j != message.node:
                channel = self.channels[(j, message.node), before]
                if j in inputs:
                    channel.used += 1
                else:
                    channel.unused.add(message.step)

    def _before(self, stage: str) -> str | None:
        """The exchanged stage whose messages went into those of `stage`."""
        order = (*self.stages, ESTIMATE.name)
        place = order.index(stage)
        return order[place - 1] if place else None

    def _revised(self) -> dict[tuple[NodeId, int], set[NodeId]]:
        """(receiver, step) -> whose late measurements it took in afterwards."""
        found: defaultdict[tuple[NodeId, int], set[NodeId]] = defaultdict(set)
        for event in self.events:
            if event.kind == "revised":
                with suppress(KeyError, TypeError, ValueError):
                    for step, ids in event.data["taken"]:
                        found[event.node, step].update(ids)
        return found


def event_words(event: Event) -> str:
    """An event in a few words; empty for one that is part of every run."""
    data = event.data
    match event.kind:
        case "started":
            return f"restarted, step {event.born}" if event.born > 1 else ""
        case "gone":
            return f"{data.get('of')} is gone"
        case "fault":
            fault = data.get("fault")
            kind = fault.get("kind", "fault") if isinstance(fault, Mapping) else fault
            return f"{kind} {data.get('phase', '')}".strip()
        case "revised":
            steps = sorted({step for step, _ in data.get("taken", ())})
            return f"revised step {', '.join(map(str, steps))}" if steps else "revised"
        case "history":
            return f"history of {data.get('of')} learnt"
        case kind:
            return "" if kind in SILENT else kind


def _inputs(message: Message) -> Iterable[NodeId]:
    """Whose messages of the stage before had come in time."""
    used = cast("tuple[NodeId, ...]", message.fields.get("used", ()))
    return (*used, *cast("tuple[NodeId, ...]", message.fields.get("excluded", ())))
