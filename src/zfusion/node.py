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
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import cast

from zfusion.gaps import GapCounter
from zfusion.methods.protocol import Fields, Method, Outcome
from zfusion.model.types import Array, NodeId, sorted_ids
from zfusion.stages import ESTIMATE, EVENT, Message
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
"""Ids in one event that tells a history: about a kilobyte, where an event may have four."""


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
    missed: Counter[str] = field(default_factory=Counter)
    """By stage: not there at the deadline although expected."""
    refused: Counter[str] = field(default_factory=Counter)
    """By reason: duplicate, too_early, former_life, unannounced_life."""
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
    ) -> None:
        """`expected`: the neighbours that are there from the start (default: all); it waits for no others."""
        self.id = node
        self.born = born
        self.neighbours = tuple(j for j in sorted_ids(neighbourhood) if j != node)
        self.counters = {j: EdgeCounters() for j in self.neighbours}
        self.sent: Counter[str] = Counter()
        self.fallbacks = 0
        """Neighbours' estimates left out because their history was not known, counted once a step each."""
        self.strays = 0
        """Messages from no neighbour, or of no stage of the method."""
        self.completed = 0
        self.ledger = Ledger(node, born)
        self.step = born - 1
        self.deadline: int | None = None
        """When `tick` must be called; None while idle."""
        self.estimate: Outcome | None = None
        """Of the last completed step."""
        self._method = method
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
        self._lives_heard: dict[NodeId, int] = {}
        self._asked: dict[NodeId, int] = {}
        self._told: list[tuple[NodeId, int, int, Sequence[Run]]] = []

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
        counters.gaps[message.stage].observe(message.born, message.seq)
        present = self._stage if self._stage >= 0 else len(self._stages)
        late = step < self.step or (step == self.step and stage < present)
        self._note_presence(message, late)
        effects: list[Effect] = []
        if late:
            counters.late[message.stage] += 1
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
        """What it had said in advance of steps of the new life does not count any more: it says it again."""
        for at, messages in self._early.items():
            if at[0] >= born and messages.pop(j, None) is not None:
                self.counters[j].refused["former_life"] += 1
        for step, seen in self._seen.items():
            if step >= born:
                seen.difference_update([(stage, j) for stage in self._number.values()])

    def _note_presence(self, message: Message, late: bool) -> None:
        """Whose message it is, is there: wait for it, from the first step that it can be in time for."""
        j = message.node
        if self._lives.get(j) != message.born:
            self._lives[j] = message.born
            self._renewed.discard(j)
        if j not in self._expected and j in self._there:
            self._expected[j] = self.step + 1 if late else message.step

    def _accept(self, message: Message) -> None:
        """Into the present stage."""
        j = message.node
        self._arrived[j] = message.fields
        self._lives_heard[j] = message.born
        self._missing.discard(j)
        self.counters[j].received[message.stage] += 1

    def _open(self, stage: int, fields: Fields, now: int, effects: list[Effect]) -> None:
        """Publish the stage's message and take what came early for it."""
        self._stage = stage
        effects.append(self._message(self._stages[stage], fields, now))
        self._arrived = {self.id: fields}
        self._missing = {j for j, since in self._expected.items() if since <= self.step}
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
        if stage == len(self._stages) - 1 and self._told:
            self._take_histories(now, effects)
        result = self._method.advance(stage, self.step, arrived, self.ledger)
        if isinstance(result, Outcome):
            self._finish(result, now, effects)
        else:
            self._open(stage + 1, self._with_history(result), now, effects)

    def _learn(self, arrived: Mapping[NodeId, Fields]) -> None:
        """What the neighbours say they used."""
        for j in self.neighbours:
            fields = arrived.get(j)
            if fields is not None and "history" in fields:
                used, history = cast(UsedSet, fields["used"]), cast("Sequence[Run]", fields["history"])
                self.ledger.learn(j, self._lives_heard[j], self.step, used, history)

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
        return {**fields, "history": tuple(own.runs(self.step - 1, HISTORY_RUNS))}

    def _finish(self, outcome: Outcome, now: int, effects: list[Effect]) -> None:
        self._stage, self.deadline, self.estimate = -1, None, outcome
        self._missing = set()
        self.completed += 1
        self.fallbacks += len(outcome.excluded)
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
                for j in self._early.pop(at):
                    self.counters[j].late[self._stages[at[1]]] += 1
        self._seen.pop(step - REMEMBERED, None)
        if step > self.step + 1:
            self._seen = {at: seen for at, seen in self._seen.items() if at > step - REMEMBERED}


def _pieces(runs: Sequence[Run], end: int) -> Iterator[tuple[list[Run], int]]:
    """The runs up to `end` in pieces that name at most about NAMED ids each, and the last step of each piece."""
    piece: list[Run] = []
    named = 0
    for first, used in runs:
        if first > end:
            break
        if named >= NAMED:
            yield piece, first - 1
            piece, named = [], 0
        piece.append((first, used))
        named += 1 + len(used)
    if piece:
        yield piece, end
