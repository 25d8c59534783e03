"""The node: one sensor's part of the swarm as a state machine without input or output. The file to read first.

A node goes through the stages of its method at every step. In each it publishes one message, waits for those of its
neighbours, and goes on when all that it expects are there or the stage's deadline has passed:

    idle ── begin(k, y) ──► stage 0 ── all there, or deadline ──► stage 1 ── ... ──► estimate published, idle

The rule it keeps: **the same inputs in the same order give the same outputs, bit for bit.** It reads no clock (time
is an argument), opens no socket, draws no random number, and folds neighbours in sorted order, never in order of
arrival. So it runs unchanged under a live, a simulated and a replayed network, and a replay that feeds it what
its own messages say it used reproduces them.

What is used of a neighbour is decided in one place: what has arrived when a stage closes (`_close`). All else that
can happen to a message ends in a counter: late, duplicate, too early, from a former life, from a stranger.

A node with a `window` *revises*: what comes late, but within so many steps, it takes in when the same stage closes
again. Late measurements when the first stage does (`_revise`): then its filter stands where it would have stood had
they been in time. Late messages of the last stage when that does (`_correct`), to correct the estimates of past steps.
It tells of both in events "revised", from which a replay knows what came when.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import cast

from zfusion.gaps import GapCounter
from zfusion.methods.protocol import Fields, Method, Outcome, Revising, Selective, Wary
from zfusion.model.types import Array, NodeId, sorted_ids
from zfusion.stages import ESTIMATE, EVENT, REVISED, Message
from zfusion.used_sets import HISTORY_RUNS, Ledger, Run, UsedSet

LOOKAHEAD = 64
"""Steps ahead of its own for which a node keeps a neighbour's message. A neighbour that hears it is at most one
stage ahead; more happens after a pause, or where someone lies about the step: that must not fill the memory."""

REMEMBERED = 64
"""Past steps in which a message that comes again is told from one that comes late."""

NEVER = 2**63
"""A step that does not come."""

ASK_AGAIN = 32
"""Steps after which a history that was asked for and has not come is asked for again."""

ANSWERS = 1024
"""Answers to questions for a history that wait for the step's end; nobody has so many neighbours."""

NAMED = 128
"""Ids in one event that tells a history or a revision: about a kilobyte, where an event may have four."""

BETTER = 1e-9
"""The part by which the trace of its P must be smaller for a corrected estimate to be told: less is rounding."""


@dataclass(frozen=True, slots=True)
class Ask:
    """An effect: `node`'s history from step `first` on is wanted; the answer goes to `learn_history`."""

    node: NodeId
    first: int


Effect = Message | Ask


@dataclass(frozen=True, slots=True)
class Patience:
    """How long each stage waits, in nanoseconds, one entry a stage."""

    waits_ns: tuple[int, ...]
    """Increasing, from the step's start, if `paced`; each from its own stage's start otherwise."""
    paced: bool


@dataclass(slots=True)
class EdgeCounters:
    """What became of one neighbour's messages here."""

    received: Counter[str] = field(default_factory=Counter)
    """By stage: in time, and used."""
    late: Counter[str] = field(default_factory=Counter)
    """By stage: first seen when the stage was over."""
    revised: Counter[str] = field(default_factory=Counter)
    """By stage: of the late, those that a node that revises has taken in after all."""
    too_late: Counter[str] = field(default_factory=Counter)
    """By stage: of the late, those that came when the window of a node that revises was over."""
    stale: Counter[str] = field(default_factory=Counter)
    """By stage: of the late within the window, those that could not be used: the sender has used more since than they
    were computed with, or it is not known what that was."""
    missed: Counter[str] = field(default_factory=Counter)
    """By stage: not there at the deadline although expected."""
    refused: Counter[str] = field(default_factory=Counter)
    """By reason: duplicate, too_early, former_life, unannounced_life; and those of the method (`Wary`)."""
    gaps: defaultdict[str, GapCounter] = field(default_factory=lambda: defaultdict(GapCounter))
    """By stage: the account of the sender's own counter, which tells what was lost on the way."""


class Node:
    """One node in one life. Inputs return the effects to carry out, in order.

    Raises ValueError where a driver breaks the protocol (a step begun twice or backwards): never for anything that a
    peer sends.
    """

    def __init__(
        self,
        node: NodeId,
        neighbourhood: Collection[NodeId],
        method: Method,
        patience: Patience,
        *,
        born: int = 1,
        expected: Collection[NodeId] | None = None,
        window: int = 0,
    ) -> None:
        """`expected`: the neighbours that are there from the start (default: all); it waits for no others.

        `window`: by how many steps a message may be late and be taken in; more than 0 with a `Revising` method only,
        made for the same.
        """
        self.id = node
        self.born = born
        self.neighbours = tuple(j for j in sorted_ids(neighbourhood) if j != node)
        self.counters = {j: EdgeCounters() for j in self.neighbours}
        self.sent: Counter[str] = Counter()
        self.fallbacks = 0
        """Neighbours' estimates left out because their history was not known, counted once a step each."""
        self.strays = 0
        """Messages from no neighbour, or of no stage of the method."""
        self.taken = 0
        """Messages that were taken in, in time or late: all that were neither strays nor refused, but for those that
        the method itself refuses."""
        self.incidents: Counter[str] = Counter()
        """What was out of the ordinary with the method, by name."""
        self.completed = 0
        self.ledger = Ledger(node, born, window)
        self.step = born - 1
        self.deadline: int | None = None
        """When `tick` must be called; None while idle."""
        self.estimate: Outcome | None = None
        """Of the last completed step."""
        self._method = method
        self._wary = method if isinstance(method, Wary) else None
        self._selective = method if isinstance(method, Selective) else None
        self._stages = [stage.name for stage in method.stages]
        self._number = {name: number for number, name in enumerate(self._stages)}
        self._patience = patience
        self._stage = -1
        self._start = 0
        self._arrived: dict[NodeId, Fields] = {}
        self._missing: set[NodeId] = set()
        self._early: dict[tuple[int, int], dict[NodeId, Message]] = {}
        self._seen: dict[int, set[tuple[int, NodeId]]] = {}
        self._expected = dict.fromkeys(self.neighbours if expected is None else expected, born)
        self._there = set(self._expected)
        self._renewed: set[NodeId] = set()
        self._lives: dict[NodeId, int] = {}
        self._heard: dict[NodeId, Message] = {}
        """The last message of each that was used."""
        self._asked: dict[NodeId, int] = {}
        self._told: list[tuple[NodeId, int, int, Sequence[Run]]] = []
        self._window = window
        self._late: dict[int, dict[int, dict[NodeId, Message]]] = {}
        """By stage and step: what came late and is to be taken in."""
        self._estimated: dict[int, _Estimated] = {}
        """The steps within the window of which an estimate was told."""
        self._revised_from = NEVER
        """The first step of which measurements were taken in since the last estimate."""

    @property
    def stage(self) -> str | None:
        """The stage whose messages are awaited; None while idle."""
        return self._stages[self._stage] if self._stage >= 0 else None

    @property
    def awaiting(self) -> tuple[NodeId, ...]:
        """The neighbours whose message of the present stage is expected and not there."""
        return tuple(j for j in self.neighbours if j in self._missing) if self._missing else ()

    @property
    def silent(self) -> tuple[NodeId, ...]:
        """The neighbours that are not waited for at this step: gone, or not heard of since they came back."""
        return tuple(j for j in self.neighbours if self._expected.get(j, NEVER) > self.step)

    def begin(self, step: int, y: Array | None, now: int, start: int | None = None) -> list[Effect]:
        """Begin a step with the own measurement, None where the sensor has none.

        `start` is when the step was due, for a paced node; by default it is `now`. Steps between the last one and this
        one were slept through: nothing was used in them.
        """
        if self._stage >= 0 or step <= self.step:
            raise ValueError(f"node {self.id}: step {step} begun at step {self.step}, stage {self.stage}")
        for skipped in range(self.step + 1, step):
            self._method.skip(skipped)
            self.ledger.learn(self.id, self.born, skipped, ())
        self._forget_before(step)
        self.step = step
        self._start = now if start is None else start
        effects: list[Effect] = []
        self._open(0, self._method.begin(step, y), now, effects)
        self._close_ready(now, effects)
        return effects

    def receive(self, message: Message, now: int) -> list[Effect]:
        """Take in a neighbour's message, well-formed but otherwise anything."""
        j, step = message.node, message.step
        counters = self.counters.get(j)
        stage = self._number.get(message.stage)
        if counters is None or stage is None:
            self.strays += 1
            return []
        refusal = self._refusal(message, stage)
        if refusal is not None:
            counters.refused[refusal] += 1
            return []
        self.taken += 1
        counters.gaps[message.stage].observe(message.born, message.seq)
        present = self._stage if self._stage >= 0 else len(self._stages)
        late = step < self.step or (step == self.step and stage < present)
        self._note_presence(message, late)
        effects: list[Effect] = []
        if late:
            self._note_late(message, stage)
        elif step > self.step or stage > self._stage:
            self._early.setdefault((step, stage), {})[j] = message
        else:
            self._accept(message)
            self._close_ready(now, effects)
        return effects

    def tick(self, now: int) -> list[Effect]:
        """Close what can be closed by `now`: stages that are complete, or whose deadline has passed."""
        effects: list[Effect] = []
        self._close_ready(now, effects)
        return effects

    def gone(self, node: NodeId, now: int) -> list[Effect]:
        """A neighbour is no longer there: do not wait for it. It may come back in a new life."""
        self._there.discard(node)
        self._expected.pop(node, None)
        self._renewed.add(node)
        self._missing.discard(node)
        return self.tick(now)

    def back(self, node: NodeId) -> None:
        """A neighbour is there (again): wait for it from the first step on of which it is heard."""
        self._there.add(node)

    def learn_history(self, of: NodeId, born: int, end: int, runs: Sequence[Run]) -> None:
        """The answer to an `Ask`: `of`'s used sets up to `end`; taken in, and told, when the last stage closes."""
        if of in self.counters and runs and len(self._told) < ANSWERS:
            self._told.append((of, born, end, runs))

    def tell_history(self) -> tuple[int, int, list[Run]]:
        """What a neighbour that asks is to learn: born, end and runs of the own used sets.

        What may still be revised is not in it: nobody could tell with which message it goes together.
        """
        own = self.ledger.of(self.id)
        assert own is not None  # the ledger begins with it
        end = max(own.last - self._window, self.born - 1)
        return self.born, end, own.runs(end)

    def event(self, kind: str, now: int, **details: object) -> Message:
        """A message on the node's event key."""
        return self._message(EVENT.name, {"kind": kind, "data": details}, now)

    def _refusal(self, message: Message, stage: int) -> str | None:
        """Why a message is not taken in, not even as late; None where it is new and of the sender's present life.

        Of steps that are long over, nobody remembers what came: a message of them is late, each time it comes.
        """
        j, step = message.node, message.step
        life = self._lives.get(j, message.born)
        if message.born < life:
            return "former_life"
        if message.born > life:
            if j not in self._renewed:
                return "unannounced_life"  # nobody begins anew without having been gone
            self._forget_former_life(j, message.born)
        if step > self.step + LOOKAHEAD:
            return "too_early"
        if step > self.step - REMEMBERED:
            seen = self._seen.get(step)
            if seen is None:
                seen = self._seen[step] = set()
            if (stage, j) in seen:
                return "duplicate"
            seen.add((stage, j))
        return None

    def _forget_former_life(self, j: NodeId, born: int) -> None:
        """What it had said in advance of steps of the new life does not count any more: it says it again.

        Nor does what came late and was not taken in yet: one is never heard again once the other has been.
        """
        for at, messages in self._early.items():
            if at[0] >= born and messages.pop(j, None) is not None:
                self.counters[j].refused["former_life"] += 1
        for step, seen in self._seen.items():
            if step >= born:
                seen.difference_update([(stage, j) for stage in self._number.values()])
        for late in self._late.values():
            for messages in late.values():
                messages.pop(j, None)

    def _note_presence(self, message: Message, late: bool) -> None:
        """Whose message it is, is there: wait for it, from the first step that it can be in time for."""
        j = message.node
        if self._lives.get(j) != message.born and message.step >= self.born:  # what is older tells of no present life
            self._lives[j] = message.born
            self._renewed.discard(j)
        if j not in self._expected and j in self._there:
            self._expected[j] = self.step + 1 if late else message.step

    def _accept(self, message: Message) -> None:
        """Into the present stage, unless the method refuses it; then there is nothing more to wait for, either."""
        j = message.node
        self._missing.discard(j)
        refusal = self._wary.refuses(self._stage, message.fields) if self._wary else None
        if refusal is not None:
            self.counters[j].refused[refusal] += 1
            return
        self._arrived[j] = message.fields
        self._heard[j] = message
        self.counters[j].received[message.stage] += 1

    def _open(self, stage: int, fields: Fields, now: int, effects: list[Effect]) -> None:
        """Publish the stage's message and take what came early for it."""
        self._stage = stage
        effects.append(self._message(self._stages[stage], fields, now))
        self._arrived = {self.id: fields}
        unheard = self._selective.unheard(self.step) if self._selective else ()
        self._missing = {j for j, since in self._expected.items() if since <= self.step and j not in unheard}
        self.deadline = self._patience.waits_ns[stage] + (self._start if self._patience.paced else now)
        for message in self._early.pop((self.step, stage), {}).values():
            self._accept(message)

    def _close_ready(self, now: int, effects: list[Effect]) -> None:
        """Close one stage after the other, as long as all is there or the time is up."""
        while self._stage >= 0 and (not self._missing or (self.deadline is not None and now >= self.deadline)):
            self._close(now, effects)

    def _close(self, now: int, effects: list[Effect]) -> None:
        """Go on with what has arrived: here, and nowhere else, it is decided what is used."""
        stage, name, arrived = self._stage, self._stages[self._stage], self._arrived
        for j in self._missing:
            self.counters[j].missed[name] += 1
        if stage > 0:
            self._learn(arrived)
        elif self._late:
            self._revise(now, effects)
        if stage == len(self._stages) - 1 and self._told:
            self._take_histories(now, effects)
        result = self._method.advance(stage, self.step, arrived, self.ledger)
        if isinstance(result, Outcome):
            self._finish(result, now, effects)
        else:
            self._open(stage + 1, self._with_history(result), now, effects)

    def _note_late(self, message: Message, stage: int) -> None:
        """Count what is late; if it is within the window, keep it until its stage closes again."""
        counters, step = self.counters[message.node], message.step
        refusal = self._wary.refuses(stage, message.fields) if self._window and self._wary else None
        if refusal is not None:
            counters.refused[refusal] += 1
            return
        counters.late[message.stage] += 1
        if not self._window or step < self.born or stage not in (0, len(self._stages) - 1):
            return
        if message.born != self._lives.get(message.node):
            return  # its sender's new life was heard before this could be used
        if step < self._closing(stage) - self._window:
            counters.too_late[message.stage] += 1
        else:
            self._late.setdefault(stage, {}).setdefault(step, {})[message.node] = message

    def _closing(self, stage: int) -> int:
        """The step whose `stage` closes next, if none is slept through."""
        return self.step if 0 <= self._stage <= stage else self.step + 1

    def _pop_late(self, stage: int) -> dict[int, dict[NodeId, Message]]:
        """What came late of a stage that closes now, by step, ascending; what is too late by now is counted."""
        late = self._late.pop(stage, {})
        for step in [step for step in late if step < self.step - self._window]:
            for message in late.pop(step).values():
                self.counters[message.node].too_late[message.stage] += 1
        return {step: late[step] for step in sorted(late) if late[step]}

    def _revise(self, now: int, effects: list[Effect]) -> None:
        """Go back to the steps of which measurements came late, and forward again with them."""
        late = self._pop_late(0)
        fields = {step: {j: message.fields for j, message in messages.items()} for step, messages in late.items()}
        taken = cast(Revising, self._method).revise(fields)
        own = self.ledger.of(self.id)
        assert own is not None  # the ledger begins with it
        for step, ids in taken.items():
            for j in ids:
                self.counters[j].revised[self._stages[0]] += 1
            used = own.at(step)
            if used is not None:
                self.ledger.revise(step, tuple(sorted_ids({*used, *ids})))
            self._revised_from = min(step, self._revised_from)
        self._tell_taken(self._stages[0], taken, now, effects)

    def _tell_taken(self, stage: str, taken: Mapping[int, UsedSet], now: int, effects: list[Effect]) -> None:
        """What was late and is taken in, in events of bounded size."""
        for piece in _bounded(taken.items()):
            effects.append(self.event("revised", now, stage=stage, taken=piece))

    def _learn(self, arrived: Mapping[NodeId, Fields]) -> None:
        """What the neighbours say they used."""
        for j in self.neighbours:
            fields = arrived.get(j)
            if fields is not None and "history" in fields:
                used, history = cast(UsedSet, fields["used"]), cast("Sequence[Run]", fields["history"])
                self.ledger.learn(j, self._heard[j].born, self.step, used, history)

    def _take_histories(self, now: int, effects: list[Effect]) -> None:
        """Histories that were asked for enter here, and are told, in events of bounded size: a replay needs them."""
        for of, born, end, runs in self._told:
            for first_runs, last in _pieces(runs, min(end, self.step)):
                if self.ledger.fill(of, born, last, first_runs):
                    effects.append(self.event("history", now, of=of, born=born, end=last, runs=first_runs))
        self._told = []

    def _with_history(self, fields: Fields) -> Fields:
        """The stage's fields; where they tell a used set, with the runs before it."""
        used = fields.get("used")
        if used is None:
            return fields
        self.ledger.learn(self.id, self.born, self.step, cast(UsedSet, used))
        own = self.ledger.of(self.id)
        assert own is not None  # the ledger begins with it
        return {**fields, "history": tuple(own.runs(self.step - 1, HISTORY_RUNS + self._window))}

    def _correct(self, now: int, effects: list[Effect]) -> None:
        """Tell better estimates of past steps, where what has come since makes them better."""
        late = self._pop_late(len(self._stages) - 1) if len(self._stages) > 1 else {}
        late = {step: messages for step, messages in late.items() if step in self._estimated}
        for step, messages in late.items():
            self._estimated[step].heard.update(messages)
        self._tell_taken(self._stages[-1], {step: tuple(sorted_ids(late[step])) for step in late}, now, effects)
        for step, estimated in self._estimated.items():
            if step < self._revised_from and step not in late:
                continue
            outcome = cast(Revising, self._method).correct(step, self._agreeing(estimated.heard))
            for j, message in late.get(step, {}).items():
                counters = self.counters[j]
                (counters.revised if j in outcome.used else counters.stale)[message.stage] += 1
            variance = float(outcome.P.trace())
            if variance < (1 - BETTER) * estimated.variance:
                estimated.variance = variance
                excluded = tuple(j for j in self.neighbours if j in estimated.heard and j not in outcome.used)
                fields = {"x": outcome.x, "P": outcome.P, "used": outcome.used, "excluded": excluded, "at": self.step}
                effects.append(self._message(REVISED.name, fields, now)._replace(step=step))
        self._revised_from = NEVER

    def _agreeing(self, heard: Mapping[NodeId, Message]) -> dict[NodeId, Fields]:
        """The messages of the last stage that were computed with just what is known of their senders now."""
        agreeing = {}
        for j, message in heard.items():
            used, history = cast(UsedSet, message.fields["used"]), cast("Sequence[Run]", message.fields["history"])
            if self.ledger.agrees(j, message.born, message.step, used, history):
                agreeing[j] = message.fields
        return agreeing

    def _remember(self, outcome: Outcome) -> None:
        """Keep what it takes to correct this step's estimate later."""
        heard = {j: self._heard[j] for j in self._arrived if j != self.id} if len(self._stages) > 1 else {}
        self._estimated[self.step] = _Estimated(heard, float(outcome.P.trace()))
        for step in [step for step in self._estimated if step < self.step + 1 - self._window]:
            del self._estimated[step]

    def _finish(self, outcome: Outcome, now: int, effects: list[Effect]) -> None:
        if self._window:
            self._correct(now, effects)
            self._remember(outcome)
        self._stage, self.deadline, self.estimate = -1, None, outcome
        self._missing = set()
        self.completed += 1
        self.fallbacks += len(outcome.excluded)
        self.incidents.update(outcome.incidents)
        fields = {"x": outcome.x, "P": outcome.P, "used": outcome.used, "excluded": outcome.excluded}
        effects.append(self._message(ESTIMATE.name, fields, now))
        for j, first in outcome.ask.items():
            if self.step - self._asked.get(j, -ASK_AGAIN) >= ASK_AGAIN:
                self._asked[j] = self.step
                effects.append(Ask(j, first))

    def _message(self, stage: str, fields: Fields, now: int) -> Message:
        seq = self.sent[stage]
        self.sent[stage] = seq + 1
        return Message(self.id, max(self.step, self.born), stage, seq, self.born, now, fields)

    def _forget_before(self, step: int) -> None:
        """Drop what was kept for steps that are over; what came early for them has become late."""
        if self._early:
            for at in [at for at in self._early if at[0] < step]:
                for message in self._early.pop(at).values():
                    self._note_late(message, at[1])
        self._seen.pop(step - REMEMBERED, None)
        if step > self.step + 1:
            self._seen = {at: seen for at, seen in self._seen.items() if at > step - REMEMBERED}


@dataclass(slots=True)
class _Estimated:
    """A past step of which an estimate was told."""

    heard: dict[NodeId, Message]
    """The neighbours' messages of its last stage, in time or late."""
    variance: float
    """Trace of P of the last estimate that was told of it."""


def _pieces(runs: Sequence[Run], end: int) -> Iterator[tuple[list[Run], int]]:
    """The runs up to `end` in pieces of bounded size, and the last step of each piece."""
    pieces = list(_bounded([run for run in runs if run[0] <= end]))
    for piece, following in pairwise(pieces):
        yield piece, following[0][0] - 1
    if pieces:
        yield pieces[-1], end


def _bounded(named_at: Iterable[tuple[int, UsedSet]]) -> Iterator[list[tuple[int, UsedSet]]]:
    """Steps with ids, in pieces that name at most about NAMED ids each."""
    piece: list[tuple[int, UsedSet]] = []
    named = 0
    for step, ids in named_at:
        if named >= NAMED:
            yield piece
            piece, named = [], 0
        piece.append((step, ids))
        named += 1 + len(ids)
    if piece:
        yield piece
