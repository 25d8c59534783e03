"""What a node measures of its neighbours' messages: how long they take, and what a round's time goes into.

The clock readings of a round, on the node's own clock, are its *marks*:

    begun ─ put ─────────────────────────────── there ─ put ─────────── ... ─ there ─ put
            stage 0                             stage 0 closes           last stage closes, estimate

and of each neighbour's message of a stage: sent (the sender's stamp), received (at this machine), due (when link
emulation lets go of it), looked at. Brought into order and between the marks of the stage, they cut the round into the
parts of PARTS, which so add up to the round by construction, to the nanosecond.

All in bounded memory: histograms and sums, and for the recording a batch of latencies that is told every so often.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from zfusion.drivers.metrics import Latencies
from zfusion.model.types import NodeId
from zfusion.stages import Message

MARKED_EVERY = 16
"""Rounds of a free-running node from one to the next whose budget is kept: Zenoh's stamp of what it receives costs
sender and receiver 5 to 10 µs a message."""

BATCH_STEPS = 64
"""Steps after which the latencies are told."""

BATCH = 3000
"""Latencies in one message, of at most 16 bytes each: it stays below what a free map may have."""

MOST_PENDING = 4096
"""Latencies of one channel that wait to be told: only somebody who repeats old steps without end makes so many."""

MOST_BUDGETS = 256
"""Channels up to which a node's last words have their budgets: at most 20 kB of the 64 that they may have."""

PARTS = ("computed", "behind", "wire", "injected", "queued", "waited", "missing", "finished")
"""What a stage's share of a round goes into, seen from one neighbour: `computed`, own work before the own message is
put; `behind`, the neighbour had not sent its message yet; on the `wire`; held by link emulation (`injected`); received
and not looked at yet (`queued`); `waited` for others after this one's message was there; `missing`: all of the stage,
where nothing came before the round was over; `finished`: after the last stage, until the estimate is put."""


class _Channel:
    """One neighbour's messages of one stage."""

    __slots__ = ("budget", "latencies", "pending", "stage", "total_ns")

    def __init__(self, stage: int) -> None:
        self.stage = stage
        self.pending: dict[int, int] = {}
        """Step -> latency, not told yet."""
        self.latencies = Latencies()
        self.total_ns = 0
        self.budget = [0] * len(PARTS)
        """Nanoseconds of each part, over the marked rounds."""

    def fold(self) -> dict[int, int]:
        """Count what is pending, and let go of it."""
        pending, self.pending = self.pending, {}
        if pending:
            self.latencies.add_all(list(pending.values()))
            self.total_ns += sum(pending.values())
        return pending


_Row = tuple[_Channel, int, int, int, int]
"""A message of a marked round: its channel; sent, received, due, looked at."""


class Meter:
    """The measurements of one life of a node. Times are readings of its own clock, in nanoseconds."""

    def __init__(self, neighbours: Collection[NodeId], stages: Sequence[str], *, marked_every: int = 1) -> None:
        """Keeps the budget of every `marked_every`-th round."""
        self._stages = tuple(stages)
        self._channels = {(j, name): _Channel(number) for j in neighbours for number, name in enumerate(stages)}
        self._marked_every = marked_every
        self._step = 0
        self._marks: list[int] = []
        self._there_ns = 0
        self._rows: dict[int, list[_Row]] = {}
        self._waits = [Latencies() for _ in stages]
        self._pending_waits: list[list[int]] = [[] for _ in stages]
        self._rounds = 0
        self._rounds_ns = 0
        self._told_at = 0

    def marks(self, step: int) -> bool:
        """Whether the budget of that round is kept."""
        return step % self._marked_every == 0

    def begin(self, step: int, now_ns: int) -> None:
        """A round begins."""
        self._step, self._marks = step, [now_ns]

    def there(self, now_ns: int) -> None:
        """What may close a stage was there then: a message, the deadline."""
        self._there_ns = now_ns

    def put(self, now_ns: int) -> None:
        """The own message of the next stage, or the estimate, was put."""
        marks = self._marks
        if len(marks) > 1:
            marks.append(max(marks[-1], self._there_ns))
        elif not marks:
            return
        marks.append(max(marks[-1], now_ns))

    def took(self, message: Message, looked_ns: int, received_ns: int | None = None, due_ns: int | None = None) -> None:
        """The node took in a message, in time or late, that was looked at then.

        `received_ns`, when it had come to this machine, and `due_ns`, when link emulation let go of it, where known.
        """
        channel = self._channels[message.node, message.stage]
        step, sent_ns = message.step, message.t_ns
        if len(channel.pending) < MOST_PENDING:
            channel.pending.setdefault(step, (looked_ns if due_ns is None else due_ns) - sent_ns)
        if step % self._marked_every == 0 and step >= self._step:
            received_ns = looked_ns if received_ns is None else received_ns
            due_ns = received_ns if due_ns is None else due_ns
            self._rows.setdefault(step, []).append((channel, sent_ns, received_ns, due_ns, looked_ns))

    def finish(self) -> None:
        """The round is over."""
        marks, stages = self._marks, len(self._stages)
        if len(marks) == 2 * stages + 2:
            for stage, waits in enumerate(self._pending_waits):
                waits.append(marks[2 * stage + 2] - marks[2 * stage + 1])
            if self.marks(self._step):
                self._budget(marks)
        self._marks = []
        if self._rows:
            for step in [step for step in self._rows if step <= self._step]:
                del self._rows[step]

    def batch(self, *, ended: bool = False) -> Iterator[dict[str, object]]:
        """The maps of latencies that are to be told now, none most of the time; when it has `ended`, of all the rest.

        Each is {"edges": [{"from": node, "stage": name, "steps": [[first, count], ...], "latency_ns": [...]}, ...]}.
        """
        if not ended and self._step < self._told_at + BATCH_STEPS:
            return
        self._told_at = self._step
        self._fold_waits()
        folded = ((j, stage, channel.fold()) for (j, stage), channel in self._channels.items())
        yield from _batches(folded)

    def waits(self) -> dict[str, dict[str, int]]:
        """How long each stage was open, {stage: `Latencies.told`}, up to now."""
        self._fold_waits()
        return {stage: waits.told() for stage, waits in zip(self._stages, self._waits, strict=True)}

    def told(self) -> dict[str, Any]:
        """All of it as plain data, to be added up by `report.latency`.

        edges {neighbour: {stage: {latency, total_ns, budget_ns {part: sum}}}}, waits {stage: latency}, and of the
        rounds whose budget was kept: rounds, rounds_ns.
        """
        edges: dict[str, dict[str, Any]] = {}
        for (j, stage), channel in self._channels.items():
            edges.setdefault(str(j), {})[stage] = {
                "latency": channel.latencies.told(),
                "total_ns": channel.total_ns,
                "budget_ns": dict(zip(PARTS, channel.budget, strict=True)),
            }
        return {"edges": edges, "waits": self.waits(), "rounds": self._rounds, "rounds_ns": self._rounds_ns}

    def budgets(self) -> dict[str, Any]:
        """What goes on a recording: rounds whose budget was kept, and edges {neighbour: {stage: nanoseconds of PARTS}}.

        Without edges where they are more than fit beside all else that a node tells when it leaves.
        """
        edges: dict[str, dict[str, list[int]]] = {}
        if len(self._channels) <= MOST_BUDGETS:
            for (j, stage), channel in self._channels.items():
                edges.setdefault(str(j), {})[stage] = list(channel.budget)
        return {"rounds": self._rounds, "edges": edges}

    def _fold_waits(self) -> None:
        for waits, pending in zip(self._waits, self._pending_waits, strict=True):
            waits.add_all(pending)
            pending.clear()

    def _budget(self, marks: Sequence[int]) -> None:
        """Cut the round into its parts, for every channel."""
        self._rounds += 1
        self._rounds_ns += marks[-1] - marks[0]
        rows = {row[0]: row for row in reversed(self._rows.get(self._step, ()))}  # of two, the first counts
        last = len(self._stages) - 1
        for channel in self._channels.values():
            before, put, closed = marks[2 * channel.stage], marks[2 * channel.stage + 1], marks[2 * channel.stage + 2]
            budget, row = channel.budget, rows.get(channel)
            budget[0] += put - before
            if row is None:
                budget[6] += closed - put
            else:
                at = put
                for part, time in enumerate(row[1:], start=1):
                    then = min(max(time, at), closed)
                    budget[part] += then - at
                    at = then
                budget[5] += closed - at
            if channel.stage == last:
                budget[7] += marks[-1] - closed


def _batches(folded: Iterable[tuple[NodeId, str, Mapping[int, int]]]) -> Iterator[dict[str, object]]:
    edges: list[dict[str, object]] = []
    room = BATCH
    for j, stage, latencies in folded:
        left = sorted(latencies.items())
        while left:
            now, left = left[:room], left[room:]
            steps = runs_of([step for step, _ in now])
            edges.append({"from": j, "stage": stage, "steps": steps, "latency_ns": [ns for _, ns in now]})
            room -= len(now)
            if not room:
                yield {"edges": edges}
                edges, room = [], BATCH
    if edges:
        yield {"edges": edges}


def runs_of(steps: Sequence[int]) -> list[list[int]]:
    """Ascending steps, each once, as [first, count] of the runs that they make."""
    if steps and steps[-1] - steps[0] == len(steps) - 1:
        return [[steps[0], len(steps)]]
    runs: list[list[int]] = []
    for step in steps:
        if runs and step == sum(runs[-1]):
            runs[-1][1] += 1
        else:
            runs.append([step, 1])
    return runs


def add_up(measured: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What several lives of a node `told`, as if they had been one."""
    edges: dict[str, dict[str, Any]] = {}
    waits: dict[str, Counter[str]] = {}
    rounds = rounds_ns = 0
    for told in filter(None, measured):
        rounds, rounds_ns = rounds + told["rounds"], rounds_ns + told["rounds_ns"]
        for stage, counts in told["waits"].items():
            waits.setdefault(stage, Counter()).update(counts)
        for j, stages in told["edges"].items():
            for stage, edge in stages.items():
                total = edges.setdefault(j, {}).setdefault(
                    stage, {"latency": Counter(), "total_ns": 0, "budget_ns": Counter()}
                )
                total["latency"].update(edge["latency"])
                total["total_ns"] += edge["total_ns"]
                total["budget_ns"].update(edge["budget_ns"])
    return {"edges": edges, "waits": waits, "rounds": rounds, "rounds_ns": rounds_ns}
