"""The simulated world: the whole swarm in one process, in virtual time.

The nodes are the very nodes that run live; what is simulated is what carries their messages (`links`), the clock, and
who is there. A simulation is a function of the scenario, the link and its seed: it reads no clock, and its events
happen in one order, by time and, at the same time, first come, first served, deadlines last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from heapq import heappop, heappush
from pathlib import Path

from zfusion import keys
from zfusion.drivers.account import Account, make_node, truth_message
from zfusion.drivers.links import Link, ideal
from zfusion.drivers.metrics import NodeReport
from zfusion.drivers.sources import Source, open_sources
from zfusion.messages import decode_any, encode
from zfusion.methods import METHODS
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import Ask, Effect, Node
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import Message

EPOCH_NS = 946_684_800_000_000_000
"""When step 0 is, where the scenario does not say: the beginning of the year 2000."""

FREE_STEP_NS = 1_000_000
"""The shortest step of a free-running node, 1 ms, so that time goes on although computing takes none of it."""

Record = Callable[[str, bytes, int], None]
"""(key, payload, time) of every message, in order."""

_Action = Callable[[], None]


class _Life:
    """One node from its start to its end."""

    def __init__(self, node: Node, source: Source, now_ns: int) -> None:
        self.node = node
        self.account = Account(node, source, now_ns)
        self.read, self.truth = source.read, source.truth
        self.alarm_ns: int | None = None
        """When the deadline is looked at next."""
        self.began_ns = now_ns
        self.busy = False
        """In a step."""
        self.heard: dict[tuple[NodeId, str], Message] = {}
        """The last message of each neighbour and stage."""


class Simulation:
    """A swarm in virtual time. `run` takes it to its end, or as far as it is told."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        run: str = "simulation",
        link: Link = ideal,
        record: Record | None = None,
        sources: Mapping[NodeId, Source] | None = None,
    ) -> None:
        """`sources` are those of all nodes, where they are not to be the scenario's.

        Raises InputError for a source that cannot be opened, or does not exist outside a live run.
        """
        self._scenario, self._link, self._record = scenario, link, record
        self._graph = METHODS[scenario.method.name].network(scenario.network)
        self._sources = open_sources(scenario, self._graph.ids) if sources is None else sources
        self._exchanged = {stage.name for stage in METHODS[scenario.method.name].stages}
        self._key = partial(keys.stage_key, run)
        self._truth_key = keys.truth_key(run)
        self._topics: dict[tuple[NodeId, str], str] = {}
        self._truths = 0
        epoch = scenario.timing.epoch_ns
        self.epoch_ns = EPOCH_NS if epoch is None else epoch
        """When step 0 is."""
        self.now_ns = self.epoch_ns
        """The virtual time."""
        self._agenda: list[tuple[int, bool, int, _Action]] = []
        self._entries = 0
        self._alive: dict[NodeId, _Life] = {}
        self._lives: dict[NodeId, list[_Life]] = {node: [] for node in self._graph.ids}
        for node in self._graph.ids:
            self._start(node, born=1)

    @property
    def reports(self) -> dict[NodeId, list[NodeReport]]:
        """How every life of every node went, so far."""
        return {node: [life.account.report() for life in lives] for node, lives in self._lives.items()}

    @property
    def nodes(self) -> dict[NodeId, Node]:
        """Those that are alive; to be looked at only."""
        return {node: life.node for node, life in self._alive.items()}

    def run(self, until_ns: int | None = None) -> None:
        """Let everything happen that happens before a time; by default, until every node has taken its last step."""
        agenda = self._agenda
        while agenda and (until_ns is None or agenda[0][0] < until_ns):
            self.now_ns, _, _, action = heappop(agenda)
            action()
        if until_ns is not None:
            self.now_ns = max(self.now_ns, until_ns)

    def kill(self, node: NodeId) -> None:
        """End a node's life without warning. What it has sent is on its way; its neighbours notice at once.

        KeyError if it is not alive.
        """
        del self._alive[node]
        for listener in self._graph.listeners(node):
            life = self._alive.get(listener)
            if life is not None:
                last = [decode_any(encode(message)) for (j, _), message in life.heard.items() if j == node]
                gone = life.node.event("gone", self.now_ns, of=node, last=last)
                self._carry_out(life, [gone, *life.node.gone(node, self.now_ns)])

    def revive(self, node: NodeId) -> None:
        """Begin a new life of a node that was killed: with the next step, from the prior. KeyError if it is alive."""
        if node in self._alive:
            raise KeyError(f"node {node} is alive")
        period = self._scenario.timing.period_ns
        if period is not None:
            born = max(1, (self.now_ns - self.epoch_ns) // period + 1)
        else:
            born = max((life.node.step for life in self._alive.values()), default=0) + 1
        self._start(node, born)
        for listener in self._graph.listeners(node):
            if listener in self._alive:
                self._alive[listener].node.back(node)

    def close(self) -> None:
        """Let go of the sources."""
        for source in self._sources.values():
            source.close()

    def _start(self, node: NodeId, born: int) -> None:
        neighbours = [j for j in self._graph.neighbours(node) if j in self._alive] if self._lives[node] else None
        made = make_node(self._scenario, self._graph, node, born=born, expected=neighbours)
        life = self._alive[node] = _Life(made, self._sources[node], self.now_ns)
        self._lives[node].append(life)
        self._carry_out(life, [made.event("started", self.now_ns, epoch_ns=self.epoch_ns)])
        self._schedule(life, born)

    def _schedule(self, life: _Life, step: int) -> None:
        """Have the node begin `step` when it is due."""
        period = self._scenario.timing.period_ns
        if period is not None:
            due = self.epoch_ns + step * period
        else:
            due = self.now_ns if step == life.node.born else life.began_ns + FREE_STEP_NS
        self._at(max(due, self.now_ns), partial(self._begin, life, step, due))

    def _begin(self, life: _Life, step: int, due: int) -> None:
        node, now = life.node, self.now_ns
        if self._alive.get(node.id) is not life:
            return
        y = life.read(step, due)
        if node.id == self._graph.ids[0]:
            self._tell_truth(life, step)
        life.began_ns, life.busy = now, True
        self._carry_out(life, node.begin(step, y, now, due))

    def _tell_truth(self, life: _Life, step: int) -> None:
        x = life.truth(step)
        if x is not None and self._record is not None:
            self._record(self._truth_key, encode(truth_message(x, step, self._truths, self.now_ns)), self.now_ns)
            self._truths += 1

    def _deliver(self, receiver: NodeId, message: Message) -> None:
        life = self._alive.get(receiver)
        if life is not None:
            life.heard[message.node, message.stage] = message
            self._carry_out(life, life.node.receive(message, self.now_ns))

    def _carry_out(self, life: _Life, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Ask):
                self._at(self.now_ns, partial(self._answer, life, effect.node))
            else:
                self._publish(life, effect)
        node = life.node
        if life.busy and node.stage is None:
            self._complete(life)
        elif node.deadline is not None and (life.alarm_ns is None or node.deadline < life.alarm_ns):
            self._set_alarm(life, node.deadline)

    def _publish(self, life: _Life, message: Message) -> None:
        sender, stage, now = message.node, message.stage, self.now_ns
        if self._record is not None:
            topic = self._topics.get((sender, stage))
            if topic is None:
                topic = self._topics[sender, stage] = self._key(sender, stage)
            self._record(topic, encode(message), now)
        if "x" in message.fields:
            life.account.compare(message)
        if stage in self._exchanged:
            for receiver in self._graph.listeners(sender):
                for arrival in self._link((sender, receiver), message, now):
                    self._at(arrival, partial(self._deliver, receiver, message))

    def _complete(self, life: _Life) -> None:
        """A step is done: on to the next, or the end."""
        node, now = life.node, self.now_ns
        life.busy = False
        life.account.complete(now, now - life.began_ns)
        if node.step < self._scenario.steps:
            self._schedule(life, node.step + 1)
        else:
            self._carry_out(life, [node.event("stopped", now, **life.account.last_words())])

    def _answer(self, life: _Life, of: NodeId) -> None:
        """What a node that was asked for its used sets answers; queries are not the links' business: they arrive."""
        asked = self._alive.get(of)
        own = asked.node.ledger.of(of) if asked is not None else None
        if asked is not None and own is not None:
            life.node.learn_history(of, asked.node.born, own.last, own.runs(own.last))

    def _set_alarm(self, life: _Life, at: int) -> None:
        """Look at the node's deadline then. Deadlines mostly move on before they pass: one alarm a node is enough."""
        life.alarm_ns = at
        self._at(at, partial(self._ring, life, at), last=True)

    def _ring(self, life: _Life, at: int) -> None:
        if life.alarm_ns != at or self._alive.get(life.node.id) is not life:
            return
        life.alarm_ns = None
        deadline = life.node.deadline
        if deadline is not None and deadline > at:
            self._set_alarm(life, deadline)
        else:
            self._carry_out(life, life.node.tick(at))

    def _at(self, time_ns: int, action: _Action, last: bool = False) -> None:
        """Put on the agenda; `last`: behind all else that happens at that time."""
        self._entries += 1
        heappush(self._agenda, (time_ns, last, self._entries, action))


def simulate(
    scenario: Scenario,
    *,
    run: str,
    output: Path | None = None,
    link: Link = ideal,
    sources: Mapping[NodeId, Source] | None = None,
) -> dict[NodeId, list[NodeReport]]:
    """Run the scenario in virtual time, with a recording at `output` if that is given: how every life went.

    `sources` as for `Simulation`. InputError for a source that cannot be opened, RecordingError for a recording that
    cannot be made, RunError for one that cannot be written to its end.
    """
    if output is None:
        simulation = Simulation(scenario, run=run, link=link, sources=sources)
        try:
            simulation.run()
        finally:
            simulation.close()
        return simulation.reports
    method = scenario.method.name
    with RecordingWriter(
        output,
        scenario_toml=scenario.anchored().to_toml(),
        run=run,
        method=method,
        seed=scenario.seed,
        stages=METHODS[method].stages,
        facts={"world": "simulated"},
    ) as writer:
        simulation = Simulation(scenario, run=run, link=link, record=writer.write, sources=sources)
        try:
            simulation.run()
        finally:
            simulation.close()
        reports = simulation.reports
        writer.finish(sent=_sent(scenario, run, reports))
    return reports


def _sent(scenario: Scenario, run: str, reports: Mapping[NodeId, list[NodeReport]]) -> dict[str, dict[int, int]]:
    """How many messages every life put on every key."""
    sent: dict[str, dict[int, int]] = {}
    for node in scenario.ids:
        for report in reports[node]:
            for stage, count in report.sent.items():
                sent.setdefault(keys.stage_key(run, node, stage), {})[report.born] = count
    return sent
