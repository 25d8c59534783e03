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
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from zfusion.gaps import GapCounter
from zfusion.methods.protocol import Fields, Method, Outcome
from zfusion.model.types import Array, NodeId, sorted_ids
from zfusion.stages import ESTIMATE, EVENT, Message
from zfusion.used_sets import HISTORY_RUNS, Ledger, Run

LOOKAHEAD = 64
"""Steps ahead of its own for which a node keeps a neighbour's message. A neighbour that hears it is at most one
stage ahead; more happens after a pause, or where someone lies about the step: that must not fill the memory."""

REMEMBERED = 64
"""Past steps in which a message that comes again is told from one that comes late."""

NEVER = 2**63
"""A step that does not come."""

ASK_AGAIN = 32
"""Steps after which a history that was asked for and has not come is asked for again."""


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
    """By reason: duplicate, too_early, former_life, stray."""
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
        self._early: dict[tuple[int, int], dict[NodeId, Message]] = {}
        self._expected = dict.fromkeys(self.neighbours if expected is None else expected, born)
        self._there = set(self._expected)
        self._renewed: set[NodeId] = set()
        self._lives: dict[NodeId, int] = {}
        self._seen: dict[tuple[int, int], set[NodeId]] = {}
        self._asked: dict[NodeId, int] = {}
        self._told: list[tuple[NodeId, int, int, Sequence[Run]]] = []

    @property
    def stage(self) -> str | None:
        """The stage whose messages are awaited; None while idle."""
        return self._stages[self._stage] if self._stage >= 0 else None

    @property
    def awaiting(self) -> tuple[NodeId, ...]:
        """The neighbours whose message of the present stage is expected and not there."""
        expected, step, arrived = self._expected, self.step, self._arrived
        return tuple(j for j in self.neighbours if j not in arrived and expected.get(j, NEVER) <= step)

    @property
    def silent(self) -> tuple[NodeId, ...]:
        """The neighbours that are not waited for at this step: gone, or not heard of since they came back."""
        return tuple(j for j in self.neighbours if self._expected.get(j, NEVER) > self.step)

    def begin(self, step: int, y: Array | None, now: int, start: int | None = None) -> list[Effect]:
        """Begin a step with the own measurement, None where the sensor has none.

        `start` is when the step was due, for a paced node; by default it is `now`.
        """
        if self._stage >= 0 or step <= self.step:
            raise ValueError(f"node {self.id}: step {step} begun at step {self.step}, stage {self.stage}")
        self.step = step
        self._start = now if start is None else start
        self._forget_before(step)
        effects: list[Effect] = []
        self._open(0, self._method.begin(step, y), now, effects)
        return effects

    def receive(self, message: Message, now: int) -> list[Effect]:
        """Take in a neighbour's message, well-formed but otherwise anything."""
        counters = self.counters.get(message.node)
        stage = self._number.get(message.stage)
        if counters is None or stage is None:
            return []
        refusal = self._refusal(message, stage)
        if refusal is not None:
            counters.refused[refusal] += 1
            return []
        at, present = (
            (message.step, stage),
            (self.step, self._stage if self._stage >= 0 else len(self._stages)),
        )
        counters.gaps[message.stage].observe(message.born, message.seq)
        self._note_presence(message, late=at < present)
        if at < present:
            counters.late[message.stage] += 1
        elif at > present:
            self._early.setdefault(at, {})[message.node] = message
        else:
            self._arrived[message.node] = message.fields
            counters.received[message.stage] += 1
            return self.tick(now)
        return []

    def tick(self, now: int) -> list[Effect]:
        """Close what can be closed by `now`: stages that are complete, or whose deadline has passed."""
        effects: list[Effect] = []
        while self._stage >= 0 and (
            not self.awaiting or (self.deadline is not None and now >= self.deadline)
        ):
            self._close(now, effects)
        return effects

    def gone(self, node: NodeId, now: int) -> list[Effect]:
        """A neighbour is no longer there: do not wait for it. It may come back in a new life."""
        self._there.discard(node)
        self._expected.pop(node, None)
        self._renewed.add(node)
        return self.tick(now)

    def back(self, node: NodeId) -> None:
        """A neighbour is there (again): wait for it from the first step on of which it is heard."""
        self._there.add(node)

    def learn_history(self, of: NodeId, born: int, end: int, runs: Sequence[Run]) -> None:
        """The answer to an `Ask`: `of`'s used sets up to `end`; taken in, and told, when the last stage closes."""
        if of in self.counters and runs:
            self._told.append((of, born, end, runs))

    def event(self, kind: str, now: int, **details: object) -> Message:
        """A message on the node's event key."""
        return self._message(EVENT.name, {"kind": kind, "data": details}, now)

    def _refusal(self, message: Message, stage: int) -> str | None:
        """Why a message is not taken in, not even as late; None where it is new and of the sender's present life."""
        j = message.node
        life = self._lives.get(j, message.born)
        if message.born < life:
            return "former_life"
        if message.born > life and j not in self._renewed:
            return "unannounced_life"  # nobody begins anew without having been gone
        if message.step > self.step + LOOKAHEAD:
            return "too_early"
        seen = self._seen.setdefault((message.step, stage), set())
        if j in seen or message.step <= self.step - REMEMBERED:
            return "duplicate"
        seen.add(j)
        return None

    def _note_presence(self, message: Message, late: bool) -> None:
        """Whose message it is, is there: wait for it, from the first step that it can be in time for."""
        j = message.node
        self._lives[j] = message.born
        self._renewed.discard(j)
        if j in self._there and j not in self._expected:
            self._expected[j] = self.step + 1 if late else message.step

    def _open(self, stage: int, fields: Fields, now: int, effects: list[Effect]) -> None:
        """Publish the stage's message and take what came early for it."""
        self._stage = stage
        name = self._stages[stage]
        effects.append(self._message(name, fields, now))
        self._arrived = {self.id: fields}
        for j, message in self._early.pop((self.step, stage), {}).items():
            self._arrived[j] = message.fields
            self.counters[j].received[name] += 1
        self.deadline = self._patience.waits_ns[stage] + (self._start if self._patience.paced else now)
        effects.extend(self.tick(now))

    def _close(self, now: int, effects: list[Effect]) -> None:
        """Go on with what has arrived: here, and nowhere else, it is decided what is used."""
        stage, name, arrived = self._stage, self._stages[self._stage], self._arrived
        for j in self.awaiting:
            self.counters[j].missed[name] += 1
        last = stage == len(self._stages) - 1
        if stage > 0:
            self._learn(arrived)
        if last:
            self._take_histories(now, effects)
        result = self._method.advance(stage, self.step, arrived, self.ledger)
        if isinstance(result, Outcome):
            self._finish(result, now, effects)
            return
        self._open(stage + 1, self._with_history(result), now, effects)

    def _learn(self, arrived: Mapping[NodeId, Fields]) -> None:
        """What the neighbours say they used."""
        for j in self.neighbours:
            fields = arrived.get(j)
            if fields is not None and "history" in fields:
                self.ledger.learn(j, self._lives[j], self.step, fields["used"], fields["history"])  # type: ignore[arg-type]

    def _take_histories(self, now: int, effects: list[Effect]) -> None:
        """Histories that were asked for enter here, and are told, so that a replay knows of them."""
        for of, born, end, runs in self._told:
            self.ledger.learn(of, born, end, runs[-1][1], runs[:-1])
            effects.append(self.event("history", now, of=of, born=born, end=end, runs=runs))
        self._told = []

    def _with_history(self, fields: Fields) -> Fields:
        """The stage's fields; where they tell a used set, with the runs before it."""
        if "used" not in fields:
            return fields
        used = fields["used"]
        self.ledger.learn(self.id, self.born, self.step, used)  # type: ignore[arg-type]
        own = self.ledger.of(self.id)
        assert own is not None  # the ledger begins with it
        return {**fields, "history": tuple(own.runs(self.step - 1, HISTORY_RUNS))}

    def _finish(self, outcome: Outcome, now: int, effects: list[Effect]) -> None:
        self._stage, self.deadline, self.estimate = -1, None, outcome
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
        return Message(
            node=self.id, step=max(self.step, self.born), stage=stage, seq=seq, born=self.born, t_ns=now, fields=fields
        )

    def _forget_before(self, step: int) -> None:
        """Drop what was kept for steps that are over; what came early for them has become late."""
        for at in [at for at in self._early if at < (step, 0)]:
            for j in self._early.pop(at):
                self.counters[j].late[self._stages[at[1]]] += 1
        for at in [at for at in self._seen if at[0] <= step - REMEMBERED]:
            del self._seen[at]
