"""The simulated world: the whole swarm in one process, in virtual time.

The nodes are the very nodes that run live; what is simulated is what carries their messages (`links`), their clocks,
and what happens to them by plan. A simulation is a function of the scenario and its seed: it reads no clock, and its
events happen in one order, by time and, at the same time, first come, first served, deadlines last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from zfusion import keys
from zfusion.drivers.account import Account, MakeMethod, make_node, truth_message
from zfusion.drivers.agenda import Action, Agenda
from zfusion.drivers.designs import content_of
from zfusion.drivers.meters import MARKED_EVERY
from zfusion.drivers.metrics import NodeReport
from zfusion.drivers.sources import Source, open_sources
from zfusion.links import Kill, Link, LinkNetwork, Timeline, links_of
from zfusion.links.protocol import EPOCH_NS
from zfusion.messages import decode_any, encode
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import Ask, Effect, Node
from zfusion.recording.keeping import Keeping
from zfusion.recording.writer import RecordingWriter
from zfusion.stages import ESTIMATE, Message

FREE_STEP_NS = 1_000_000
"""The shortest step of a free-running node, 1 ms, so that time goes on although computing takes none of it."""

ONE_CLOCK = {"offset_us": 0.0, "uncertainty_us": 0.0}
"""What there is between two clocks where nobody has set one wrong: they show the virtual time."""

Record = Callable[[str, bytes, int], None]
"""(key, payload, time) of every message, in order."""

Observe = Callable[[Message, int], None]
"""(message, time) of every message that a node publishes, in order."""


class _Life:
    """One node from its start to its end."""

    def __init__(self, node: Node, source: Source, now_ns: int, stages: Sequence[str]) -> None:
        self.node = node
        self.account = Account(node, source, now_ns, stages=stages, marked_every=MARKED_EVERY)
        self.meter = self.account.meter
        self.read, self.truth = source.read, source.truth
        self.alarm_ns: int | None = None
        """When the deadline is looked at next."""
        self.began_ns = now_ns
        self.busy = False
        """In a step."""
        self.heard: dict[tuple[NodeId, str], Message] = {}
        """The last message of each neighbour and stage."""
        self.clock_ns = 0
        """How far its clock is ahead."""
        self.slow_ns = 0
        """How much longer it takes before it publishes a message of a step."""
        self.told = 0
        """The last step whose faults have been told."""
        self.frozen = False
        """It does nothing: what comes waits."""
        self.waiting: list[tuple[bool, Action]] = []
        """What waits, and whether it is to come after all else."""


class Simulation:
    """A swarm in virtual time. `run` takes it to its end, or as far as it is told."""

    def __init__(
        self,
        scenario: Scenario,
        *,
        run: str = "simulation",
        link: Link | None = None,
        record: Record | None = None,
        sources: Mapping[NodeId, Source] | None = None,
        method: MakeMethod | None = None,
        observe: Observe | None = None,
    ) -> None:
        """`link`, `sources` (those of all nodes) and `method` where they are not to be the scenario's.

        Raises InputError for a source that cannot be opened, or does not exist outside a live run, and for links that
        cannot be had.
        """
        self._scenario, self._record, self._observe = scenario, record, observe
        self._link = links_of(scenario) if link is None else link
        self._timeline = Timeline(scenario)
        self._method = method
        self._graph = chosen(scenario).network(scenario.network)
        self._sources = open_sources(scenario, self._graph.ids) if sources is None else sources
        self._stages = [stage.name for stage in chosen(scenario).stages]
        self._exchanged = set(self._stages)
        self._key = partial(keys.stage_key, run)
        self._truth_key = keys.truth_key(run)
        self._topics: dict[tuple[NodeId, str], str] = {}
        self._truths = 0
        self._truth_step = 0
        """The last step of which the truth has been told."""
        epoch = scenario.timing.epoch_ns
        self.epoch_ns = EPOCH_NS if epoch is None else epoch
        """When step 0 is."""
        self._agenda = Agenda(self.epoch_ns)
        self._at = self._agenda.at
        self._alive: dict[NodeId, _Life] = {}
        self._lives: dict[NodeId, list[_Life]] = {node: [] for node in self._graph.ids}
        for node in self._graph.ids:
            self._start(node, born=1)

    @property
    def now_ns(self) -> int:
        """The virtual time."""
        return self._agenda.now_ns

    @property
    def reports(self) -> dict[NodeId, list[NodeReport]]:
        """How every life of every node went, so far; what the links did is told with a node's last life."""
        reports = {node: [life.account.report() for life in lives] for node, lives in self._lives.items()}
        if isinstance(self._link, LinkNetwork):
            for (sender, receiver), counter in self._link.counters.items():
                reports[receiver][-1].emulated[str(sender)] = dict(counter)
        if not any(fault.kind == "clock" for fault in self._scenario.faults):
            for report in (report for of_node in reports.values() for report in of_node):
                report.clocks = dict.fromkeys(report.edges, ONE_CLOCK)
        return reports

    @property
    def nodes(self) -> dict[NodeId, Node]:
        """Those that are alive; to be looked at only."""
        return {node: life.node for node, life in self._alive.items()}

    def run(self, until_ns: int | None = None) -> None:
        """Let everything happen that happens before a time; by default, until every node has taken its last step."""
        self._agenda.run(until_ns)

    def kill(self, node: NodeId) -> None:
        """End a node's life without warning. What it has sent is on its way; its neighbours notice at once.

        KeyError if it is not alive.
        """
        del self._alive[node]
        for listener in self._graph.listeners(node):
            if listener in self._alive:
                self._note_gone(self._alive[listener], node)

    def revive(self, node: NodeId) -> None:
        """Begin a new life of a node that was killed: with the next step, from the prior. KeyError if it is alive."""
        if node in self._alive:
            raise KeyError(f"node {node} is alive")
        self._revive(node, self._next_step())

    def close(self) -> None:
        """Let go of the sources."""
        for source in self._sources.values():
            source.close()

    def _start(self, node: NodeId, born: int) -> None:
        neighbours = [j for j in self._graph.neighbours(node) if j in self._alive] if self._lives[node] else None
        made = make_node(self._scenario, self._graph, node, born=born, expected=neighbours, method=self._method)
        life = self._alive[node] = _Life(made, self._sources[node], self.now_ns, self._stages)
        life.told = self._timeline.told_before(node, born)
        self._lives[node].append(life)
        self._carry_out(life, [made.event("started", self.now_ns, epoch_ns=self.epoch_ns)])
        self._schedule(life, born)

    def _next_step(self) -> int:
        """The first step that is still to come: the next one that is due, or that nobody has begun."""
        period = self._scenario.timing.period_ns
        if period is not None:
            return max(1, (self.now_ns - self.epoch_ns) // period + 1)
        return max((life.node.step for life in self._alive.values()), default=0) + 1

    def _revive(self, node: NodeId, born: int) -> None:
        self._start(node, born)
        for listener in self._graph.listeners(node):
            if listener in self._alive:
                self._note_back(self._alive[listener], node)

    def _note_gone(self, life: _Life, node: NodeId) -> None:
        if self._is_held(life, partial(self._note_gone, life, node)):
            return
        last = [decode_any(encode(message)) for (j, _), message in life.heard.items() if j == node]
        now = self.now_ns + life.clock_ns
        gone = life.node.event("gone", now, of=node, last=last)
        self._carry_out(life, [gone, *life.node.gone(node, now)])

    def _note_back(self, life: _Life, node: NodeId) -> None:
        if not self._is_held(life, partial(self._note_back, life, node)):
            life.node.back(node)

    def _schedule(self, life: _Life, step: int) -> None:
        """Have the node begin `step` when it is due by its clock."""
        period, now = self._scenario.timing.period_ns, self.now_ns
        if period is not None:
            due = self.epoch_ns + step * period
            at = due - self._timeline.clock_ns(life.node.id, step)
        else:
            due = at = now if step == life.node.born else life.began_ns + FREE_STEP_NS
        self._at(max(at, now), partial(self._begin, life, step, due))

    def _begin(self, life: _Life, step: int, due: int) -> None:
        node = life.node
        if self._is_held(life, partial(self._begin, life, step, due), last=True):
            return
        if self._timeline and self._suffer(life, step, due):
            return
        y = life.read(step, due)
        if step > self._truth_step:
            self._truth_step = step
            self._tell_truth(life, step)
        life.began_ns, life.busy = self.now_ns, True
        self._agenda.reach(step)
        life.meter.begin(step, self.now_ns + life.clock_ns)
        self._carry_out(life, node.begin(step, y, self.now_ns + life.clock_ns, due))

    def _suffer(self, life: _Life, step: int, due: int) -> bool:
        """What happens to a node that is to begin a step; whether it does not begin it now."""
        node, timeline = life.node.id, self._timeline
        life.clock_ns = timeline.clock_ns(node, step)
        since = life.told + 1
        self._tell_faults(life, step)
        for kill in timeline.kills(node):
            if since <= kill.step <= step:
                self._die(life, kill)
                return True
        for stop in timeline.stops(node):
            if since <= stop.first <= step < stop.end:
                life.frozen = True
                life.waiting.append((True, partial(self._begin, life, step, due)))
                self._when(stop.end, partial(self._thaw, life))
                return True
        life.slow_ns = timeline.slow_ns(node, step)
        return self._skips(life, step, due)

    def _tell_faults(self, life: _Life, step: int) -> None:
        """Tell what has begun and ended for a node up to a step."""
        node, since = life.node, life.told + 1
        life.told = step
        for data in self._timeline.events(node.id, step, since):
            self._publish(life, node.event("fault", self.now_ns + life.clock_ns, **data))

    def _skips(self, life: _Life, step: int, due: int) -> bool:
        """Whether a node leaves out a paced step because its whole period is over; it goes on with a later one."""
        timing = self._scenario.timing
        if timing.period_ns is None or timing.late == "wait":
            return False
        skipped = min((self.now_ns + life.clock_ns - due) // timing.period_ns, self._scenario.steps + 1 - step)
        if skipped > 0:
            life.account.skipped += skipped
            self._go_on(life, step + skipped)
        return skipped > 0

    def _die(self, life: _Life, kill: Kill) -> None:
        """The end of a life by plan; there may be another one."""
        node = life.node.id
        self._tell_arrivals(life, ended=True)
        self.kill(node)
        if kill.restart is not None and kill.restart <= self._scenario.steps:
            self._when(kill.restart, partial(self._live_again, node, kill.restart))

    def _live_again(self, node: NodeId, step: int) -> None:
        """Begin a new life, at `step` if that is still possible, otherwise as soon as it is; unless the run is over."""
        period = self._scenario.timing.period_ns
        in_time = period is not None and self.now_ns <= self.epoch_ns + step * period
        born = step if in_time else max(step, self._next_step())
        if node not in self._alive and born <= self._scenario.steps:
            self._revive(node, born)

    def _when(self, step: int, action: Action) -> None:
        """Put on the agenda for the time at which a step is due; where steps have none, for when somebody begins it."""
        period = self._scenario.timing.period_ns
        if period is None:
            self._agenda.at_step(step, action)
        else:
            self._at(max(self.now_ns, self.epoch_ns + step * period), action)

    def _is_held(self, life: _Life, action: Action, last: bool = False) -> bool:
        """Whether the node does not do this now: it is dead, or it stands still and does it later."""
        if self._alive.get(life.node.id) is not life:
            return True
        if life.frozen:
            life.waiting.append((last, action))
        return life.frozen

    def _thaw(self, life: _Life) -> None:
        """A node that stood still goes on: with what came meanwhile, then with what it had to do itself."""
        life.frozen = False
        waiting, life.waiting = life.waiting, []
        for _, action in sorted(waiting, key=lambda entry: entry[0]):
            action()

    def _tell_truth(self, life: _Life, step: int) -> None:
        x = life.truth(step)
        if x is not None and self._record is not None:
            self._record(self._truth_key, encode(truth_message(x, step, self._truths, self.now_ns)), self.now_ns)
            self._truths += 1

    def _deliver(self, receiver: NodeId, message: Message) -> None:
        life = self._alive.get(receiver)
        if life is None:
            return
        if life.frozen:
            life.waiting.append((False, partial(self._deliver_late, life, message, self.now_ns)))
        else:
            self._take(life, message, self.now_ns + life.clock_ns)

    def _deliver_late(self, life: _Life, message: Message, came_ns: int) -> None:
        """A message that came when the node stood still: it is in time if it came by the deadline, as it is live."""
        node, again = life.node, partial(self._deliver_late, life, message, came_ns)
        while not self._is_held(life, again):
            deadline, now = node.deadline, self.now_ns + life.clock_ns
            if deadline is None or came_ns + life.clock_ns <= deadline:
                self._take(life, message, now)
                return
            life.meter.there(now)
            self._carry_out(life, node.tick(deadline))

    def _take(self, life: _Life, message: Message, now: int) -> None:
        """Feed the node a message that is in time until its alarm rings: deadlines come last."""
        life.heard[message.node, message.stage] = message
        node = life.node
        taken = node.taken
        life.meter.there(now)
        effects = node.receive(message, now if node.deadline is None else min(now, node.deadline - 1))
        if node.taken != taken:
            life.meter.took(message, now, message.t_ns, now)
        self._carry_out(life, effects)

    def _carry_out(self, life: _Life, effects: list[Effect]) -> None:
        if life.slow_ns and any(self._takes_time(effect) for effect in effects):
            self._carry_out_slowly(life, effects)
            return
        for effect in effects:
            self._perform(life, effect)
        self._settle(life)

    def _carry_out_slowly(self, life: _Life, effects: list[Effect]) -> None:
        """One after the other, each message of a step so much later; meanwhile the node does nothing else."""
        life.frozen = True
        at = self.now_ns
        for effect in effects:
            at += life.slow_ns if self._takes_time(effect) else 0
            self._at(at, partial(self._perform_late, life, effect))
        self._at(at, partial(self._recover, life))

    def _takes_time(self, effect: Effect) -> bool:
        return not isinstance(effect, Ask) and (effect.stage in self._exchanged or effect.stage == ESTIMATE.name)

    def _perform_late(self, life: _Life, effect: Effect) -> None:
        if self._alive.get(life.node.id) is life:
            self._perform(life, effect)

    def _recover(self, life: _Life) -> None:
        if self._alive.get(life.node.id) is life:
            self._settle(life)
            self._thaw(life)

    def _perform(self, life: _Life, effect: Effect) -> None:
        if isinstance(effect, Ask):
            self._at(self.now_ns, partial(self._answer, life, effect.node))
        else:
            self._publish(life, effect)

    def _settle(self, life: _Life) -> None:
        """What comes next: the next step, or a deadline."""
        node = life.node
        if life.busy and node.stage is None:
            self._complete(life)
        elif node.deadline is not None:
            deadline = node.deadline - life.clock_ns
            if life.alarm_ns is None or deadline < life.alarm_ns:
                self._set_alarm(life, max(deadline, self.now_ns))

    def _publish(self, life: _Life, message: Message) -> None:
        sender, stage, now = message.node, message.stage, self.now_ns
        if message.t_ns != now + life.clock_ns:
            message = message._replace(t_ns=now + life.clock_ns)  # it was computed earlier
        if self._record is not None:
            topic = self._topics.get((sender, stage))
            if topic is None:
                topic = self._topics[sender, stage] = self._key(sender, stage)
            self._record(topic, encode(message), now)
        if self._observe is not None:
            self._observe(message, now)
        if "x" in message.fields:
            life.account.compare(message)
        if stage in self._exchanged or stage == ESTIMATE.name:
            life.meter.put(now + life.clock_ns)
        if stage in self._exchanged:
            for receiver in self._graph.listeners(sender):
                for arrival in self._link((sender, receiver), message, now):
                    self._at(arrival, partial(self._deliver, receiver, message))

    def _complete(self, life: _Life) -> None:
        """A step is done: on to the next, or the end."""
        node, now = life.node, self.now_ns
        life.busy = False
        life.account.complete(now, now - life.began_ns)
        life.meter.finish()
        self._tell_arrivals(life)
        self._go_on(life, node.step + 1)

    def _tell_arrivals(self, life: _Life, *, ended: bool = False) -> None:
        """Tell what was measured of the neighbours' messages, when it is time to."""
        for message in life.account.arrivals(self.now_ns + life.clock_ns, ended=ended):
            self._publish(life, message)

    def _go_on(self, life: _Life, step: int) -> None:
        """To a step, if there is one more."""
        if step <= self._scenario.steps:
            self._schedule(life, step)
        else:
            self._tell_faults(life, self._scenario.steps)
            self._tell_arrivals(life, ended=True)
            now = self.now_ns + life.clock_ns
            self._publish(life, life.node.event("stopped", now, **life.account.last_words()))

    def _answer(self, life: _Life, of: NodeId) -> None:
        """What a node that was asked for its used sets answers; queries are not the links' business: they arrive.

        Unless one of the two stands still, that is: then the question is lost, and asked again some time.
        """
        asked = self._alive.get(of)
        if asked is not None and not (asked.frozen or life.frozen):
            life.node.learn_history(of, *asked.node.tell_history())

    def _set_alarm(self, life: _Life, at: int) -> None:
        """Look at the node's deadline then. Deadlines mostly move on before they pass: one alarm a node is enough."""
        life.alarm_ns = at
        self._at(at, partial(self._ring, life, at), last=True)

    def _ring(self, life: _Life, at: int) -> None:
        if life.alarm_ns != at or self._is_held(life, partial(self._ring, life, at), last=True):
            return
        life.alarm_ns = None
        now = self.now_ns + life.clock_ns
        deadline = life.node.deadline
        if deadline is not None and deadline > now:
            self._set_alarm(life, deadline - life.clock_ns)
        else:
            life.meter.there(now)
            self._carry_out(life, life.node.tick(now))


def simulate(
    scenario: Scenario,
    *,
    run: str,
    output: Path | None = None,
    link: Link | None = None,
    sources: Mapping[NodeId, Source] | None = None,
    observe: Observe | None = None,
) -> dict[NodeId, list[NodeReport]]:
    """Run the scenario in virtual time, with a recording at `output` if that is given: how every life went.

    `link`, `sources` and `observe` as for `Simulation`. InputError for a source or links that cannot be had,
    RecordingError for a recording that cannot be made, RunError for one that cannot be written to its end.
    """
    link = links_of(scenario) if link is None else link
    if output is None:
        simulation = Simulation(scenario, run=run, link=link, sources=sources, observe=observe)
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
        stages=chosen(scenario).stages,
        design=content_of(scenario),
        facts={"world": "simulated"},
        keeping=Keeping(scenario.recording.compression),
    ) as writer:
        simulation = Simulation(scenario, run=run, link=link, record=writer.write, sources=sources, observe=observe)
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
