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
    its events "revised"               the late messages that they name       its corrected estimates
                                       before the stage that they name ends

The node is given one neighbour more than it has, of which nothing is ever heard: so it goes on when told to, and not
before. Messages are taken as they come and forgotten when nobody needs them any more.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import cast

import numpy as np

from zfusion import keys
from zfusion.drivers.account import setting_of
from zfusion.drivers.lives import Doubt, Life, Place, Shelf
from zfusion.drivers.verdict import NAMED, TOLERANCE, Difference, Tally, Verdict
from zfusion.drivers.workers import in_order
from zfusion.errors import MessageError
from zfusion.gaps import MAX_LIVES
from zfusion.messages import Decoder, Reason, encode_any
from zfusion.methods import Fields, chosen
from zfusion.methods.check import check_method
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.node import Node, Patience
from zfusion.recording.provenance import arithmetic_differences
from zfusion.recording.reader import Recording
from zfusion.stages import ESTIMATE, EVENT, MEASUREMENT, REVISED, Message
from zfusion.status import HistoryAnswer

WAIT_STEPS = 2048
"""Steps of a node that wait for an input that is not on the recording yet, before it counts as missing: recorders
listen on a link for each node, and one may be ahead of the other by what fits into the links."""

LEAP = 1_000_000
"""Steps that a message may be ahead of all before it: days of sleep at a few steps a second. What says more is
somebody's attempt to keep us busy: a node goes through the steps that it slept through one by one."""

TIDY_EVERY = 256
"""Messages of a node after which what nobody needs any more of them is forgotten."""

_Order = tuple[int, int, int]
"""(step, stage, node), all as numbers."""


@dataclass(slots=True)
class _Part:
    """What was found of some of the nodes."""

    tallies: dict[NodeId, Tally]
    lives: int = 0
    first: tuple[_Order, Difference] | None = None
    """The first difference, and its place among all."""
    missing: list[str] = field(default_factory=list)
    missing_count: int = 0
    unreadable: int = 0

    def note(self, place: _Order, difference: Difference) -> None:
        """A difference was found."""
        if self.first is None or place < self.first[0]:
            self.first = (place, difference)


class _Verifier:
    """Lives all lives of some of the nodes on a recording again."""

    def __init__(self, scenario: Scenario, nodes: Collection[NodeId], complete: bool, tolerance: float | None) -> None:
        self._scenario, self._complete, self._tolerance = scenario, complete, tolerance
        self._method = chosen(scenario)
        self._graph = self._method.network(scenario.network)
        self._tables = {stage.name: stage for stage in (*self._method.stages, ESTIMATE, REVISED, EVENT)}
        self._first = self._method.stages[0]
        self._stages = [stage.name for stage in self._method.stages]
        self._published = [*self._stages, ESTIMATE.name]
        self._order = {stage: number for number, stage in enumerate((*self._published, REVISED.name))}
        self._window = scenario.timing.revised_steps
        self._takers = {EVENT.name: self._take_event, REVISED.name: self._take_correction}
        self._nobody = _another_id(self._graph.ids)
        self._heard = {j for node in nodes for j in self._graph.neighbours(node)}
        """The nodes themselves, and those whose messages are their inputs."""
        self._shelves = {node: Shelf(self._published) for node in self._heard}
        self._lives: dict[NodeId, dict[int, Life]] = {node: {} for node in self._graph.ids}
        self._newest = 0
        self._done = dict.fromkeys(nodes, 0)
        self._untidy = dict.fromkeys(self._heard, 0)
        self._waiting: dict[Place, list[Life]] = {}
        self._part = _Part({node: Tally() for node in nodes})

    def taker(self, topic: str) -> Callable[[bytes], None] | None:
        """What takes the messages of a topic in; None where they are of no importance."""
        try:
            key = keys.parse(topic)
            node = self._scenario.node_id(key.node or "")
        except (MessageError, KeyError):
            return None
        if key.stage not in self._tables or (node not in self._heard and key.stage != EVENT.name):
            return None
        if key.stage == REVISED.name and node not in self._done:
            return None
        decode = self._decoder(node, key.stage).decode
        take = self._takers.get(key.stage, self._take_message)

        def decode_and_take(data: bytes) -> None:
            try:
                take(decode(data))
            except MessageError:
                self._part.unreadable += node in self._done

        return decode_and_take

    def finish(self) -> _Part:
        """Nothing more comes: live again what is left. What was found."""
        for node in self._done:
            for life in self._lives[node].values():
                self._go_on(life, ended=True)
                self._settle(life)
                self._leave_open(life)
            self._part.lives += len(self._lives[node])
        return self._part

    def _decoder(self, node: NodeId, stage: str) -> Decoder:
        system = self._scenario.system()
        sizes = system.sizes(node)
        return Decoder(self._tables[stage], node, sizes=sizes, ids=self._graph.neighbours(node))

    def _take_message(self, message: Message) -> None:
        node, stage, step = message.node, message.stage, message.step
        if step > self._newest + LEAP:
            raise MessageError(Reason.OUT_OF_RANGE, f"step {step} after {self._newest}")
        life = self._life(node, message.born)
        if step <= life.done or not self._shelves[node].put(message):
            return
        self._newest = max(self._newest, step)
        waiters = self._waiting.pop((node, stage, step), ())
        if life.over:
            self._miss(life, f"{stage} of node {node}, step {step}, in its time: it comes when that life is over")
            self._part.tallies[node].unverifiable += self._order[stage] > 0
        elif node in self._done:
            life.begin(step)
            self._go_on(life)
        for waiter in waiters:
            waiter.awaits = None
            self._go_on(waiter)
        self._untidy[node] += 1
        if self._untidy[node] == TIDY_EVERY:
            self._tidy(node)

    def _take_event(self, message: Message) -> None:
        life = self._life(message.node, message.born)
        if message.node in self._done:
            self._settle(life, proven=not self._count(life, message))
        data = cast("dict[str, object]", message.fields["data"])
        if message.fields["kind"] == "history":
            of = self._neighbour(message.node, data)
            answer = HistoryAnswer.from_map(data, frozenset(self._graph.neighbours(of)))
            life.told.setdefault(message.step, []).append((of, answer))
        elif message.fields["kind"] == "revised":
            place = message.step, _stage_in(data)
            life.taken.setdefault(place, []).extend(_taken(data, self._graph.neighbours(message.node)))
        elif message.fields["kind"] == "gone":
            of = self._neighbour(message.node, data)
            if of in self._heard:
                self._take_last_words(of, data.get("last"))

    def _take_correction(self, message: Message) -> None:
        life = self._life(message.node, message.born)
        self._count(life, message)
        made = cast(int, message.fields["at"])
        life.corrections.setdefault((made, message.step), message)
        if made <= life.done:
            self._judge_corrections(life)

    def _neighbour(self, node: NodeId, data: Mapping[str, object]) -> NodeId:
        """The neighbour that an event is about."""
        of = data.get("of")
        if not isinstance(of, int | str) or of not in self._graph.neighbours(node):
            raise MessageError(Reason.UNKNOWN_ID, f"an event about {of!r}")
        return of

    def _take_last_words(self, node: NodeId, last: object) -> None:
        """What somebody heard last of a node that died: it may never have come to the recorder."""
        for payload in last if isinstance(last, list) else ():
            for stage in self._stages:
                with suppress(MessageError):
                    message = self._decoder(node, stage).decode(encode_any(payload))
                    if self._shelves[node].said(stage, message.step, message.born) is None:
                        self._take_message(message)

    def _life(self, node: NodeId, born: int) -> Life:
        lives = self._lives[node]
        life = lives.get(born)
        if life is None:
            if len(lives) == MAX_LIVES:
                raise MessageError(Reason.OUT_OF_RANGE, f"more than {MAX_LIVES} lives")
            life = lives[born] = Life(node, born, self._tolerance)
        return life

    def _go_on(self, life: Life, ended: bool = False) -> None:
        """Live the steps again that can be: those of which all is there, or of which nothing more is to be expected."""
        steps = life.steps
        while steps:
            if not ended and not self._can_go_on(life, steps[0]):
                return
            step = steps.pop(0)
            if life.node is None:
                self._finish_former_lives(life)
            self._live(life, step, last=ended and not steps)
            life.done = step
            self._done[life.id] = max(self._done[life.id], step)
        if ended:
            self._give_up(life)
            life.over = True

    def _can_go_on(self, life: Life, step: int) -> bool:
        """Whether the step is over and its inputs are there, or have been waited for long enough."""
        later = len(life.steps) - 1
        if later >= WAIT_STEPS:
            self._give_up(life)
            return True
        if life.awaits is not None or (
            not later and self._shelves[life.id].said(ESTIMATE.name, step, life.born) is None
        ):
            return False
        life.awaits = self._lacking(life, step)
        if life.awaits is not None:
            self._waiting.setdefault(life.awaits, []).append(life)
        return life.awaits is None

    def _give_up(self, life: Life) -> None:
        """Wait no longer."""
        if life.awaits is not None:
            waiting = self._waiting[life.awaits]
            waiting.remove(life)
            if not waiting:
                del self._waiting[life.awaits]
            life.awaits = None

    def _lacking(self, life: Life, step: int) -> Place | None:
        """The first input of a step that is not there."""
        own = self._shelves[life.id]
        for stage, following in zip(self._stages, self._published[1:], strict=True):
            told = own.said(following, step, life.born)
            inputs = [] if told is None else [(step, _inputs(told)), *life.taken.get((step, stage), ())]
            for of, senders in inputs:
                for j in senders:
                    if j != life.id and of not in self._shelves[j].by_stage[stage]:
                        return j, stage, of
        return None

    def _finish_former_lives(self, life: Life) -> None:
        """A life that broke off within a step has that left: live it again while its inputs are still there."""
        for former in self._lives[life.id].values():
            if former.born < life.born and not former.over:
                self._go_on(former, ended=True)

    def _live(self, life: Life, step: int, last: bool) -> None:
        """Live one step again. In the `last` of a life the last stages may be missing: it came no further."""
        shelf = self._shelves[life.id]
        said = [shelf.said(stage, step, life.born) for stage in self._published]
        for message in filter(None, said):
            self._count(life, message)
        node = life.node = life.node or self._make(life)
        for of, answer in life.told.pop(step, ()):
            node.learn_history(of, answer.born, answer.end, answer.runs)
        begun = node.begin(step, self._measured(life, said[0], said[1]), 0)
        if said[0] is not None and self._first is not MEASUREMENT:  # what it says beside the measurement itself
            self._judge(life, said[0], next(m for m in begun if isinstance(m, Message) and m.stage == said[0].stage))
        for number, stage in enumerate(self._stages):
            following = said[number + 1]
            if following is not None:
                self._feed(life, node, stage, step, _inputs(following))
                effects = [effect for effect in node.tick(number + 1) if isinstance(effect, Message)]
                self._judge(life, following, next(again for again in effects if again.stage == following.stage))
                life.corrected |= {(step, again.step): again for again in effects if again.stage == REVISED.name}
            elif last and not any(said[number + 1 :]):
                return
            else:  # whose messages it used nobody knows; what is missing is counted when the next of its kind comes
                life.doubt = Doubt.MISSING
                heard = (j for j in node.neighbours if j != self._nobody and step in self._shelves[j].by_stage[stage])
                self._feed(life, node, stage, step, heard)
                node.tick(number + 1)
        if self._window:
            self._judge_corrections(life, step)

    def _make(self, life: Life) -> Node:
        method = self._method(setting_of(self._scenario, self._graph, life.id, life.born))
        return Node(
            life.id,
            (*self._graph.neighbours(life.id), self._nobody),
            method,
            Patience((1,) * len(self._stages), paced=False),  # stage n, begun at time n, ends at time n + 1
            born=life.born,
            expected=(self._nobody,),
            window=self._window,
        )

    def _measured(self, life: Life, measurement: Message | None, following: Message | None) -> Array | None:
        """The own measurement; if it is not there, a stand-in where there was one."""
        if measurement is not None:
            return cast("Array | None", measurement.fields["y"])
        life.doubt = Doubt.MISSING  # it is counted when the next comes
        return self._stand_in(life.id) if following is not None and life.id in _inputs(following) else None

    def _feed(self, life: Life, node: Node, stage: str, step: int, senders: Iterable[NodeId]) -> None:
        """Give the node the messages of its neighbours that it used in a stage, and those that it took in late.

        Of one sender those of a former life first: as they came.
        """
        now = self._order[stage]
        late = [(j, of) for of, ids in life.taken.pop((step, stage), ()) for j in ids]
        inputs = (self._input(life, j, stage, of) for j, of in (*late, *((j, step) for j in senders)) if j != life.id)
        for message in sorted((message for message in inputs if message is not None), key=attrgetter("born")):
            j = message.node
            if life.heard.setdefault(j, message.born) != message.born:
                life.heard[j] = message.born
                node.gone(j, now)
            node.receive(message, now)

    def _input(self, life: Life, j: NodeId, stage: str, step: int) -> Message | None:
        """What a neighbour said, or what stands for it if it is not there."""
        shelf = self._shelves[j]
        message = shelf.by_stage[stage].get(step) or self._missed(life, j, stage, step)
        if message is not None and (stage, step) in shelf.disputed:
            self._miss(life, f"which {stage} of node {j}, step {step}, node {life.id} used: there are two")
        return message

    def _missed(self, life: Life, j: NodeId, stage: str, step: int) -> Message | None:
        """Note an input that is missing. For a measurement there is a stand-in: the covariances come out right then."""
        newest = max(self._shelves[j].by_stage[stage], default=0)
        cut_off = not self._complete and newest < step
        self._miss(life, f"{stage} of node {j}, step {step}, which node {life.id} used", cut_off=cut_off)
        if stage != MEASUREMENT.name or self._first is not MEASUREMENT:
            return None
        born = life.heard.get(j, max((born for born in self._lives[j] if born <= step), default=1))
        return Message(j, step, stage, 0, born, 0, {"y": self._stand_in(j)})

    def _stand_in(self, node: NodeId) -> Array:
        return np.zeros(self._scenario.system().by_id[node].ny)

    def _judge_corrections(self, life: Life, until: int | None = None) -> None:
        """Compare the corrected estimates that are there; those of long ago that nobody told are forgotten."""
        until = life.done if until is None else until
        for place in sorted(place for place in life.corrections if place[0] <= until):
            self._judge(life, life.corrections.pop(place), life.corrected.pop(place, None))
        for place in [place for place in life.corrected if place[0] <= until - WAIT_STEPS]:
            del life.corrected[place]

    def _judge(self, life: Life, told: Message, again: Message | None) -> None:
        """Compare what the node said with what it says; a corrected estimate may be none that comes out."""
        tally, stage = self._part.tallies[life.id], told.stage
        nothing: Fields = {"at": None}
        again_fields = nothing if again is None else again.fields
        found = ("at", None) if again is None else life.comparison.differs(stage, told.fields, again_fields)
        if found is None:
            tally.identical += 1
        elif life.doubt is Doubt.CUT_OFF:
            tally.cut_off += 1
        elif life.doubt is Doubt.MISSING:
            tally.unverifiable += 1
        else:
            name, ulps = found
            here = Difference(life.id, life.born, told.step, stage, name, told.fields[name], again_fields[name], ulps)
            life.differences += 1
            life.first = life.first or here

    def _settle(self, life: Life, proven: bool = True) -> None:
        """Count a life's differences as that, or, where an event is missing that may explain them, as unverifiable."""
        tally = self._part.tallies[life.id]
        if proven:
            tally.different += life.differences
            if life.first is not None:
                self._part.note(self._place(life.first), life.first)
        else:
            tally.unverifiable += life.differences
        life.differences, life.first = 0, None

    def _leave_open(self, life: Life) -> None:
        """Count the corrected estimates of a step of which nothing else was told any more: it broke off in it."""
        tally, count = self._part.tallies[life.id], len(life.corrections)
        if self._complete:
            tally.unverifiable += count
        else:
            tally.cut_off += count

    def _place(self, difference: Difference) -> _Order:
        return difference.step, self._order[difference.stage], self._graph.ids.index(difference.node)

    def _count(self, life: Life, message: Message) -> bool:
        """Notice by the sender's counter what is missing before a message; whether something is."""
        stage, expected = message.stage, life.counters.get(message.stage, 0)
        lost = message.seq - expected
        if lost >= 0:
            life.counters[stage] = message.seq + 1
        if lost > 0:
            what = f"{lost} x {stage} of node {life.id} before step {message.step}"
            if stage == REVISED.name:
                self._name_missing(what)  # nothing depends on it
            else:
                self._miss(life, what)
            if self._order.get(stage, 0) > 0:
                self._part.tallies[life.id].unverifiable += lost
        return lost > 0

    def _miss(self, life: Life, what: str, cut_off: bool = False) -> None:
        """Something that this life depends on is not there: from now on a difference proves nothing."""
        if cut_off:
            life.doubt = life.doubt or Doubt.CUT_OFF
            return
        life.doubt = Doubt.MISSING
        self._name_missing(what)

    def _name_missing(self, what: str) -> None:
        self._part.missing_count += 1
        if len(self._part.missing) < NAMED:
            self._part.missing.append(what)

    def _tidy(self, node: NodeId) -> None:
        """Forget messages that all who could use them are past, or that are long over."""
        self._untidy[node] = 0
        users = [self._done[i] for i in (node, *self._graph.listeners(node)) if i in self._done]
        self._shelves[node].forget(max(min(users), max(self._done.values()) - 2 * WAIT_STEPS) - self._window)


def verify(recording: Recording, *, tolerance: float | None = None, jobs: int = 1) -> Verdict:
    """Recompute every intermediate and final estimate on a recording, of all nodes and lives, and compare.

    Bit for bit; where the recording was made with other versions or on another kind of machine (`Verdict.arithmetic`
    tells what is other), within `TOLERANCE`; within `tolerance`, relative, if that is given. What cannot be
    recomputed because an input is missing is counted, and named, as that; what the end of a recording that was
    broken off leaves open, as that.

    Reads the recording once, in memory that does not grow with its length; with `jobs` > 1, so many processes do so,
    each for some of the nodes. ScenarioError if its scenario cannot be read by this version, InputError if it does not
    know the method, RecordingError if the file has changed, RunError if one of these processes dies.
    """
    scenario = recorded_scenario(recording)
    arithmetic = arithmetic_differences(recording.metadata)
    if tolerance is None and arithmetic:
        tolerance = TOLERANCE
    jobs = max(1, min(jobs, len(scenario.ids)))
    if jobs == 1:
        parts = [_verify_some(recording, scenario, scenario.ids, tolerance)]
    else:
        shares = [scenario.ids[n::jobs] for n in range(jobs)]
        parts = list(in_order(partial(_verify_file, recording.path, tolerance), shares, jobs))
    tallies = {node: tally for part in parts for node, tally in part.tallies.items()}
    missing = [what for part in parts for what in part.missing]
    firsts = sorted(filter(None, (part.first for part in parts)), key=itemgetter(0))
    return Verdict(
        nodes={node: tallies[node] for node in scenario.ids},
        lives=sum(part.lives for part in parts),
        first=firsts[0][1] if firsts else None,
        missing=tuple(missing[:NAMED]),
        missing_count=sum(part.missing_count for part in parts),
        unreadable=sum(part.unreadable for part in parts),
        arithmetic=arithmetic,
        tolerance=tolerance,
        note=recording.note,
    )


def _verify_file(path: Path, tolerance: float | None, nodes: Sequence[NodeId]) -> _Part:
    """What a process of its own does."""
    with Recording.open(path) as recording:
        return _verify_some(recording, recorded_scenario(recording), nodes, tolerance)


def _verify_some(recording: Recording, scenario: Scenario, nodes: Sequence[NodeId], tolerance: float | None) -> _Part:
    verifier = _Verifier(scenario, nodes, recording.complete, tolerance)
    takers = {topic: take for topic in recording.topics if (take := verifier.taker(topic)) is not None}
    for record in recording.records(takers):
        takers[record.topic](record.data)
    return verifier.finish()


def recorded_scenario(recording: Recording) -> Scenario:
    """The scenario of a recording, with the design that is on it; ScenarioError if it cannot be read here."""
    scenario = Scenario.from_toml(
        recording.scenario_toml, f"{recording.path}: scenario.toml", recording.path.absolute().parent
    )
    check_method(scenario, f"{recording.path}: scenario.toml")
    return scenario if recording.design is None else scenario.carrying(recording.design)


def _inputs(message: Message) -> tuple[NodeId, ...]:
    """Whose messages of the stage before went into a message, or came with them."""
    used = cast("tuple[NodeId, ...]", message.fields["used"])
    return (*used, *cast("tuple[NodeId, ...]", message.fields.get("excluded", ())))


def _stage_in(data: Mapping[str, object]) -> str:
    """The stage that an event "revised" is about."""
    stage = data.get("stage")
    if not isinstance(stage, str):
        raise MessageError(Reason.WRONG_TYPE, f"an event about the stage {stage!r}")
    return stage


def _taken(data: Mapping[str, object], legal: Collection[NodeId]) -> Iterator[tuple[int, tuple[NodeId, ...]]]:
    """Of which steps whose messages an event "revised" says were taken in."""
    taken = data.get("taken")
    for run in taken if isinstance(taken, list) else ():
        match run:
            case [int(step), list(ids)] if all(type(i) in (int, str) and i in legal for i in ids):
                yield step, tuple(ids)
            case _:
                raise MessageError(Reason.WRONG_TYPE, f"taken: {run!r:.80}")


def _another_id(ids: Sequence[NodeId]) -> NodeId:
    """An id, of the same kind, that is none of these."""
    texts = [i for i in ids if isinstance(i, str)]
    return "-" + "-".join(texts) if texts else 1 + max(i for i in ids if isinstance(i, int))
