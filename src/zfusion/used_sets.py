"""Used sets: whose measurements a node used at each step of its life, as a run-length list.

A *used set* is the only trace that loss, lateness, a crash or a switched link leave in the mathematics
(docs/method.md). A node tells its own with every intermediate estimate, with a short history, so that its
neighbours can go on after messages were lost; what they still do not know is a gap here, to be asked for.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from zfusion.model.types import NodeId

UsedSet = tuple[NodeId, ...]
Run = tuple[int, UsedSet]
"""(first step, used set from that step on)."""

HISTORY_RUNS = 16
"""Runs that a message carries. Only changes start a run: with no event one run says all; with a change at every
step a neighbour may lose 16 messages in a row before it has to ask. A node that revises sends as many runs more as its
window has steps, so that every message says all that it can have changed since the one before."""

KEPT_RUNS = 16_384
"""Runs that a node remembers of itself and of each neighbour: some MB at the worst, and what one answer can carry."""

SHARED = 4096
"""Different used sets of which all runs share one tuple: there are few, and long histories repeat them."""


@lru_cache(maxsize=SHARED)
def _shared(used: UsedSet | None) -> UsedSet | None:
    """The same used set, as the object that stands for it."""
    return used


@dataclass(slots=True)
class History:
    """What is known of the used sets of one node from `born` to `last`, both included.

    `born` is the first step of the node's present life: before it, it used nothing.
    """

    born: int
    last: int = field(default=-1)
    """The last step of which anything is known; `born` - 1 where nothing is."""
    _starts: array[int] = field(default_factory=lambda: array("q"))
    _sets: list[UsedSet | None] = field(default_factory=list)
    """From each start to the next, or to `last`; None where it is not known. No two neighbours are equal."""

    def __post_init__(self) -> None:
        self.last = max(self.last, self.born - 1)

    def at(self, step: int) -> UsedSet | None:
        """The used set of `step`; None where it is not known."""
        if step >= self.last:
            return self._sets[-1] if step == self.last and self._sets else self._before(step)
        run = bisect_right(self._starts, step) - 1
        return self._sets[run] if run >= 0 else self._before(step)

    def first_unknown(self, start: int, end: int) -> int | None:
        """The first step in [start, end] whose used set is not known."""
        step = max(start, self.born)
        while step <= end:
            run = bisect_right(self._starts, step) - 1
            if step > self.last or run < 0 or self._sets[run] is None:
                return step
            step = self._end(run) + 1
        return None

    def learn(self, step: int, used: UsedSet, earlier: Sequence[Run] = (), window: int = 0) -> int | None:
        """Take in what a message of `step` says: the set of that step and the runs before it.

        `earlier` is ascending and speaks of every step from its first run's on, to `step` - 1. A sender that revises
        may, with each message, have used more in the `window` steps before it: of those that it may have revised
        since it was last heard, only what this message says is known. Returns the first step of which something else
        is known now, None where nothing is.
        """
        if window:
            if step <= self.last:
                return None  # what was heard since knows better
            first, revisable = earlier[0][0] if earlier else step, max(self.born, self.last + 1 - window)
            if first > revisable:
                return self.fill(((revisable, None), *earlier, (step, used)), step)
        if step == self.last + 1 and self._is_known(earlier):
            self._append(step, used)
            return step
        return self.fill((*earlier, (step, used)), step)

    def says(self, told: Sequence[Run], end: int) -> bool:
        """Whether what ascending runs say, of every step from the first one's on to `end`, is just what is known."""
        return self._first_difference(told, end) is None

    def fill(self, told: Sequence[tuple[int, UsedSet | None]], end: int) -> int | None:
        """Take in ascending runs that speak of every step from the first one's on, to `end`; None: not known any more.

        Where they contradict what was known they are right: a node knows best what it used. Returns as `learn`.
        """
        changed = self._first_difference(told, end)
        if changed is None:
            return None
        start = told[0][0]
        runs: list[tuple[int, UsedSet | None]] = [(self.last + 1, None)] if start > self.last + 1 else []
        runs.extend(told)
        if end < self.last:
            runs.append((end + 1, self.at(end + 1)))
            after = bisect_right(self._starts, end + 1)
            runs.extend(zip(self._starts[after:], self._sets[after:], strict=True))
        first = bisect_left(self._starts, start)
        del self._starts[first:], self._sets[first:]  # nothing before it is looked at: histories may be long
        for step, used in runs:
            if not self._sets or self._sets[-1] != used:
                self._starts.append(step)
                self._sets.append(_shared(used))
        excess = max(0, len(self._starts) - KEPT_RUNS)
        del self._starts[:excess], self._sets[:excess]
        self.last = max(self.last, end)
        return changed

    def runs(self, end: int, limit: int | None = None) -> list[Run]:
        """The known runs up to `end` that follow on one another, at most the last `limit` of them, ascending."""
        found: list[Run] = []
        for start, used in zip(reversed(self._starts), reversed(self._sets), strict=True):
            if start > end:
                continue
            if used is None or len(found) == limit:
                break
            found.append((start, used))
        return found[::-1]

    def _before(self, step: int) -> UsedSet | None:
        return () if step < self.born else None

    def _end(self, run: int) -> int:
        return self._starts[run + 1] - 1 if run + 1 < len(self._starts) else self.last

    def _is_known(self, told: Sequence[Run]) -> bool:
        """Whether `told` just repeats the last runs, as nearly every message does."""
        first = len(self._starts) - len(told)
        if first < 0:
            return False
        for run, start, used in zip(told, self._starts[first:], self._sets[first:], strict=True):
            if run[0] != start or run[1] != used:
                return False
        return True

    def _append(self, step: int, used: UsedSet) -> None:
        if not self._sets or self._sets[-1] != used:
            self._starts.append(step)
            self._sets.append(_shared(used))
            if len(self._starts) > KEPT_RUNS:
                del self._starts[0], self._sets[0]
        self.last = step

    def _first_difference(self, told: Sequence[tuple[int, UsedSet | None]], end: int) -> int | None:
        """The first step of [told[0].start, end] where `told` says something else than what is known."""
        for number, (start, used) in enumerate(told):
            stop = told[number + 1][0] if number + 1 < len(told) else end + 1
            step = start
            while step < stop:
                if self.at(step) != used:
                    return step
                if step > self.last:
                    break  # from here on nothing is known, which is what `told` says
                run = bisect_right(self._starts, step) - 1
                step = self._end(run) + 1
        return None


class Ledger:
    """What one node knows of the used sets in its neighbourhood, its own included.

    Where nodes revise what they used up to `window` steps ago, it holds, of each neighbour, what its last message in
    time was computed with: what that neighbour may have revised since is not what it told before.
    """

    def __init__(self, own: NodeId, born: int, window: int = 0) -> None:
        self.own, self._window = own, window
        self._of: dict[NodeId, History] = {own: History(born)}
        self._changed: dict[NodeId, int] = {}

    def of(self, node: NodeId) -> History | None:
        """The history of a node's present life; None where nothing was heard of it yet."""
        return self._of.get(node)

    def learn(self, node: NodeId, born: int, step: int, used: UsedSet, earlier: Sequence[Run] = ()) -> None:
        """Take in what a message of `node`, in the life that began at `born`, says of `step` and before."""
        history = self._of.get(node)
        if history is None or history.born < born:
            history = self._of[node] = History(born)
            self._note(node, born)
        elif history.born > born:
            return  # a former life speaks: its neighbours have begun anew with the present one
        self._note(node, history.learn(step, used, earlier, 0 if node == self.own else self._window))

    def fill(self, node: NodeId, born: int, end: int, runs: Sequence[Run]) -> bool:
        """Take in an answer about the present life of `node`; False where it says nothing that counts.

        An answer is of another moment than the messages: it counts for what was final at that of the last one.
        """
        history = self._of.get(node)
        if history is None or history.born != born:
            return False
        if self._window:
            end = min(end, history.last - self._window)
            runs = [run for run in runs if run[0] <= end]
            if not runs:
                return False
        self._note(node, history.fill(runs, end))
        return True

    def revise(self, step: int, used: UsedSet) -> None:
        """The node itself has used more at a past step than it had."""
        self._note(self.own, self._of[self.own].fill([(step, used)], step))

    def agrees(self, node: NodeId, born: int, step: int, used: UsedSet, earlier: Sequence[Run]) -> bool:
        """Whether what a message of `step` was computed with is, up to that step, what is known of `node` now.

        What it does not speak of was final then: a message speaks of all steps that could still be revised.
        """
        history = self._of.get(node)
        if history is None or history.born != born:
            return False
        told = (*earlier, (step, used))
        return told[0][0] <= max(born, step + 1 - self._window) and history.says(told, step)

    def take_changes(self) -> dict[NodeId, int]:
        """For each node of which something new is known since the last call: the first step it concerns."""
        changes, self._changed = self._changed, {}
        return changes

    def _note(self, node: NodeId, step: int | None) -> None:
        if step is not None:
            self._changed[node] = min(step, self._changed.get(node, step))
