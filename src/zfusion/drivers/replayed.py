"""The replayed world: every published message recomputed from a recording.

A node is a function of its inputs, and what they were is on the recording: its own measurement, and of its
neighbours' messages those that the next message says were used. So each life of each node is lived again by a node
of the same making that is fed just these, step by step, and what it says is compared with what was said.

    of step k                          is fed                                    and must say again
    ------------------------------------------------------------------------------------------------
    its measurement                    to `begin`
    neighbours' measurements           those in `used` of its intermediate       its intermediate
    neighbours' intermediates          those in `used`, `excluded` of estimate   its estimate
    its events "history"               to `learn_history`, before the estimate

The node is given one neighbour more than it has, of which nothing is ever heard: so it goes on when told to, and not
before. Messages are taken as they come and forgotten when nobody needs them any more.
"""

from __future__ import annotations

from bisect import insort
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from typing import cast

import numpy as np

from zfusion import keys
from zfusion.drivers.verdict import NAMED, TOLERANCE, Comparison, Difference, Tally, Verdict
from zfusion.errors import InputError, MessageError
from zfusion.gaps import MAX_LIVES
from zfusion.messages import Decoder, Reason
from zfusion.methods import METHODS, Setting
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.node import Effect, Node, Patience
from zfusion.recording.provenance import arithmetic_differences
from zfusion.recording.reader import Recording
from zfusion.stages import ESTIMATE, EVENT, MEASUREMENT, Message
from zfusion.status import HistoryAnswer

WAIT_STEPS = 2048
"""Steps of a node that wait for an input that is not on the recording yet, before it counts as missing: recorders
listen on a link for each node, and one may be ahead of the other by what fits into the links."""

TIDY_EVERY = 256
"""Messages of a node after which what nobody needs any more of them is forgotten."""


class _Doubt(Enum):
    """Why a difference proves nothing."""

    MISSING = "something that should be on the recording is not"
    CUT_OFF = "the recording ends before something that it depends on"


class _Life:
    """One life of a node: what is on the recording of it, and the node that lives it again."""

    def __init__(self, node: NodeId, born: int, stages: Iterable[str], tolerance: float | None) -> None:
        self.id, self.born = node, born
        self.messages: dict[str, dict[int, Message]] = {stage: {} for stage in stages}
        """By stage and step."""
        self.twice: set[tuple[str, int]] = set()
        """(stage, step) of which there are two, that differ."""
        self.told: defaultdict[int, list[tuple[NodeId, HistoryAnswer]]] = defaultdict(list)
        """By step: histories that were asked for."""
        self.steps: list[int] = []
        """Begun, and not lived again yet; ascending."""
        self.done = born - 1
        """The last step that was lived again."""
        self.awaits: tuple[NodeId, str, int] | None = None
        """The input that it waits for: (sender, stage, step)."""
        self.counters: dict[str, int] = {}
        """By stage: the number of the next message."""
        self.doubt: _Doubt | None = None
        self.comparison = Comparison(tolerance)
        self.node: Node | None = None
        self.lives: dict[NodeId, int] = {}
        """The neighbours' lives that it has heard."""

    def take(self, message: Message) -> bool:
        """Take a message of this life in; False where it is old, or here already."""
        stage, step = message.stage, message.step
        known = self.messages[stage].get(step)
        if known is not None and Comparison(None).differs(stage, known.fields, message.fields):
            self.twice.add((stage, step))
        if known is not None or step <= self.done:
            return False
        self.messages[stage][step] = message
        if not self.steps or step > self.steps[-1]:
            self.steps.append(step)
        elif step not in self.steps:
            insort(self.steps, step)
        return True

    def forget(self, floor: int) -> None:
        """Drop what is of steps up to `floor`."""
        for stage, messages in self.messages.items():
            self.messages[stage] = {step: message for step, message in messages.items() if step > floor}


_Take = Callable[[bytes], None]


class _Verifier:
    """Lives all lives of a recording again."""

    def __init__(self, scenario: Scenario, complete: bool, tolerance: float | None) -> None:
        self._scenario, self._complete, self._tolerance = scenario, complete, tolerance
        self._method = METHODS[scenario.method.name]
        self._graph = self._method.network(scenario.network)
        self._stages = [stage.name for stage in self._method.stages]
        self._published = [*self._stages, ESTIMATE.name]
        self._order = {stage: number for number, stage in enumerate(self._published)}
        self._nobody = _another_id(self._graph.ids)
        self._lives: dict[NodeId, dict[int, _Life]] = {node: {} for node in self._graph.ids}
        self._done = dict.fromkeys(self._graph.ids, 0)
        self._untidy = dict.fromkeys(self._graph.ids, 0)
        self._waiting: dict[tuple[NodeId, str, int], list[_Life]] = {}
        self.tallies = {node: Tally() for node in self._graph.ids}
        self.first: Difference | None = None
        self.missing: list[str] = []
        self.missing_count = 0
        self.unreadable = 0

    @property
    def lives(self) -> int:
        """Lives of nodes on the recording so far."""
        return sum(map(len, self._lives.values()))

    def taker(self, topic: str) -> _Take | None:
        """What takes the messages of a topic in; None where they are of no importance."""
        try:
            key = keys.parse(topic)
            node = self._scenario.node_id(key.node or "")
        except (MessageError, KeyError):
            return None
        system, graph = self._scenario.system(), self._graph
        sizes, ids = {"nx": system.nx, "ny": system.by_id[node].ny}, graph.neighbours(node)
        tables = {stage.name: stage for stage in (*self._method.stages, ESTIMATE, EVENT)}
        if key.stage not in tables:
            return None
        decode = Decoder(tables[key.stage], node, sizes=sizes, ids=ids).decode
        take = self._take_event if key.stage == EVENT.name else self._take_message

        def decode_and_take(data: bytes) -> None:
            try:
                take(decode(data))
            except MessageError:
                self.unreadable += 1

        return decode_and_take

    def finish(self) -> None:
        """Nothing more comes: live again what is left."""
        self._waiting.clear()
        for lives in self._lives.values():
            for life in lives.values():
                self._go_on(life, ended=True)

    def _take_message(self, message: Message) -> None:
        node, stage, step = message.node, message.stage, message.step
        life = self._life(node, message.born)
        if not life.take(message):
            return
        waiters = self._waiting.pop((node, stage, step), None)
        self._go_on(life)
        for waiter in waiters or ():
            waiter.awaits = None
            self._go_on(waiter)
        self._untidy[node] += 1
        if self._untidy[node] == TIDY_EVERY:
            self._tidy(node)

    def _take_event(self, message: Message) -> None:
        life = self._life(message.node, message.born)
        self._count(life, message)
        if message.fields["kind"] != "history":
            return
        data = cast("dict[str, object]", message.fields["data"])
        of = cast(NodeId, data.get("of"))
        if of not in self._graph.neighbours(message.node):
            raise MessageError(Reason.UNKNOWN_ID, f"history of {of!r}")
        answer = HistoryAnswer.from_map(data, frozenset(self._graph.neighbours(of)))
        life.told[message.step].append((of, answer))

    def _life(self, node: NodeId, born: int) -> _Life:
        lives = self._lives[node]
        life = lives.get(born)
        if life is None:
            if len(lives) == MAX_LIVES:
                raise MessageError(Reason.OUT_OF_RANGE, f"more than {MAX_LIVES} lives")
            life = lives[born] = _Life(node, born, self._published, self._tolerance)
        return life

    def _go_on(self, life: _Life, ended: bool = False) -> None:
        """Live the steps again that can be: those of which all is there, or nothing more is to be expected."""
        while life.steps:
            step = life.steps[0]
            if not ended:
                if len(life.steps) == 1 and step not in life.messages[ESTIMATE.name]:
                    return
                if len(life.steps) <= WAIT_STEPS:
                    if life.awaits is not None:
                        return
                    life.awaits = self._lacking(life, step)
                    if life.awaits is not None:
                        self._waiting.setdefault(life.awaits, []).append(life)
                        return
            del life.steps[0]
            self._finish_former_lives(life)
            self._live(life, step, last=ended and not life.steps)
            life.done = step
            self._done[life.id] = max(self._done[life.id], step)

    def _lacking(self, life: _Life, step: int) -> tuple[NodeId, str, int] | None:
        """The first input of a step that is not there."""
        for stage, following in zip(self._stages, self._published[1:], strict=True):
            message = life.messages[following].get(step)
            for j in () if message is None else _inputs(message):
                if j != life.id and not any(step in other.messages[stage] for other in self._lives[j].values()):
                    return j, stage, step
        return None

    def _finish_former_lives(self, life: _Life) -> None:
        """A life that broke off within a step has that left: live it again while its inputs are still there."""
        if life.node is None:
            for former in self._lives[life.id].values():
                if former.born < life.born and former.steps:
                    self._go_on(former, ended=True)

    def _live(self, life: _Life, step: int, last: bool) -> None:
        """Live one step again. In the `last` of a life the last stages may be missing: it came no further."""
        chain = [life.messages[stage].get(step) for stage in self._published]
        for message in filter(None, chain):
            self._count(life, message)
        node = life.node = life.node or self._make(life)
        for of, answer in life.told.pop(step, ()):
            node.learn_history(of, answer.born, answer.end, answer.runs)
        measured, first = chain[0], chain[1]
        if measured is not None:
            y = measured.fields["y"]
        else:
            y = self._stand_in(life.id) if first is not None and life.id in _inputs(first) else None
        node.begin(step, y, 0)  # type: ignore[arg-type]
        for number, stage in enumerate(self._stages):
            told = chain[number + 1]
            if told is None and last and not any(chain[number + 1 :]):
                return
            if told is None:
                life.doubt = _Doubt.MISSING  # whose messages were used, nobody knows: it is counted when the next comes
            self._feed(life, node, stage, step, told)
            said = node.tick(number + 1)
            if told is not None:
                self._judge(life, told, said)

    def _make(self, life: _Life) -> Node:
        method = self._method(Setting(life.id, self._scenario.system(), self._graph, life.born))
        return Node(
            life.id,
            (*self._graph.neighbours(life.id), self._nobody),
            method,
            Patience((1,) * len(self._stages), paced=False),  # stage n, begun at time n, ends at time n + 1
            born=life.born,
            expected=(self._nobody,),
        )

    def _feed(self, life: _Life, node: Node, stage: str, step: int, told: Message | None) -> None:
        """Give the node what it used of its neighbours in a stage, as `told`; all there is, where nobody told."""
        now = self._order[stage]
        for j in node.neighbours if told is None else _inputs(told):
            if j in (life.id, self._nobody):
                continue
            message = self._find(life, j, stage, step, wanted=told is not None)
            if message is None:
                continue
            if life.lives.setdefault(j, message.born) != message.born:
                life.lives[j] = message.born
                node.gone(j, now)
            node.receive(message, now)

    def _find(self, life: _Life, j: NodeId, stage: str, step: int, wanted: bool) -> Message | None:
        """A neighbour's message. Where there is none: a stand-in for a measurement, so that at least the covariances

        come out right; None for what there can be none for.
        """
        found = [other.messages[stage][step] for other in self._lives[j].values() if step in other.messages[stage]]
        if found:
            if len(found) > 1 or any((stage, step) in other.twice for other in self._lives[j].values()):
                self._miss(life, f"which {stage} of node {j}, step {step}, node {life.id} used: there are two")
            return found[0]
        if not wanted:
            return None
        newest = max((at for other in self._lives[j].values() for at in other.messages[stage]), default=0)
        cut_off = not self._complete and newest < step
        self._miss(life, f"{stage} of node {j}, step {step}, which node {life.id} used", cut_off=cut_off)
        if stage != MEASUREMENT.name:
            return None
        born = life.lives.get(j, max((born for born in self._lives[j] if born <= step), default=1))
        return Message(j, step, stage, 0, born, 0, {"y": self._stand_in(j)})

    def _stand_in(self, node: NodeId) -> object:
        return np.zeros(self._scenario.system().by_id[node].ny)

    def _judge(self, life: _Life, told: Message, said: Sequence[Effect]) -> None:
        tally = self.tallies[life.id]
        again = next(effect for effect in said if isinstance(effect, Message) and effect.stage == told.stage)
        found = life.comparison.differs(told.stage, told.fields, again.fields)
        if found is None:
            tally.identical += 1
        elif life.doubt is _Doubt.CUT_OFF:
            tally.cut_off += 1
        elif life.doubt is _Doubt.MISSING:
            tally.unverifiable += 1
        else:
            tally.different += 1
            name, ulps = found
            difference = Difference(
                life.id, life.born, told.step, told.stage, name, told.fields[name], again.fields[name], ulps
            )
            if self.first is None or self._place(difference) < self._place(self.first):
                self.first = difference

    def _place(self, difference: Difference) -> tuple[int, int, int]:
        return difference.step, self._order[difference.stage], self._graph.ids.index(difference.node)

    def _count(self, life: _Life, message: Message) -> None:
        """Notice by the sender's counter what is missing before a message."""
        stage = message.stage
        lost = message.seq - life.counters.get(stage, 0)
        life.counters[stage] = max(message.seq + 1, life.counters.get(stage, 0))
        if lost > 0:
            self._miss(life, f"{lost} x {stage} of node {life.id} before step {message.step}")
            if stage in self._published[1:]:
                self.tallies[life.id].unverifiable += lost

    def _miss(self, life: _Life, what: str, cut_off: bool = False) -> None:
        """Something that this life depends on is not there: from now on a difference proves nothing."""
        if life.doubt is not _Doubt.MISSING:
            life.doubt = _Doubt.CUT_OFF if cut_off else _Doubt.MISSING
        if not cut_off:
            self.missing_count += 1
            if len(self.missing) < NAMED:
                self.missing.append(what)

    def _tidy(self, node: NodeId) -> None:
        """Forget messages that all who could use them are past, or that are long over."""
        self._untidy[node] = 0
        users = (node, *self._graph.listeners(node))
        floor = max(min(self._done[i] for i in users), max(self._done.values()) - 2 * WAIT_STEPS)
        for life in self._lives[node].values():
            life.forget(floor)


def verify(recording: Recording, *, tolerance: float | None = None) -> Verdict:
    """Recompute every intermediate and final estimate on a recording, of all nodes and lives, and compare.

    Bit for bit; where the recording was made with other versions or on another kind of machine (`Verdict.arithmetic`
    tells what is other), within `TOLERANCE`; within `tolerance`, relative, if that is given. What cannot be
    recomputed because an input is missing is counted, and named, as that; what the end of a recording that was
    broken off leaves open, as that.

    Reads the recording once, in memory that does not grow with its length. ScenarioError if its scenario cannot be
    read by this version, InputError if it does not know the method, RecordingError if the file has changed.
    """
    scenario = recorded_scenario(recording)
    arithmetic = arithmetic_differences(recording.metadata)
    if tolerance is None and arithmetic:
        tolerance = TOLERANCE
    verifier = _Verifier(scenario, recording.complete, tolerance)
    takers = {topic: take for topic in recording.topics if (take := verifier.taker(topic)) is not None}
    for record in recording.records(takers):
        takers[record.topic](record.data)
    verifier.finish()
    return Verdict(
        nodes=verifier.tallies,
        lives=verifier.lives,
        first=verifier.first,
        missing=tuple(verifier.missing),
        missing_count=verifier.missing_count,
        unreadable=verifier.unreadable,
        arithmetic=arithmetic,
        tolerance=tolerance,
        note=recording.note,
    )


def recorded_scenario(recording: Recording) -> Scenario:
    """The scenario of a recording; ScenarioError if it cannot be read, InputError for an unknown method."""
    scenario = Scenario.from_toml(
        recording.scenario_toml, f"{recording.path}: scenario.toml", recording.path.absolute().parent
    )
    if scenario.method.name not in METHODS:
        known = ", ".join(METHODS)
        raise InputError(f"{recording.path}: its method is {scenario.method.name!r}; this zfusion knows {known}")
    return scenario


def _inputs(message: Message) -> tuple[NodeId, ...]:
    """Whose messages of the stage before went into a message, or came with them."""
    used = cast("tuple[NodeId, ...]", message.fields["used"])
    return (*used, *cast("tuple[NodeId, ...]", message.fields.get("excluded", ())))


def _another_id(ids: Sequence[NodeId]) -> NodeId:
    """An id, of the same kind, that is none of these."""
    texts = [i for i in ids if isinstance(i, str)]
    return "-" + "-".join(texts) if texts else 1 + max(i for i in ids if isinstance(i, int))
