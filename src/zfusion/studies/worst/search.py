"""The search for the worst choice of messages.

The gain of a message depends on what else is lost: a measurement hurts little as long as a neighbour's estimate
makes up for it, and much when that is lost, too, or when it is the tenth in a row. So a greedy search over single
messages misses what is worst. This one also takes, as one move, all messages of one link, of one sender or of one
receiver in a stretch of steps; each move is judged by its gain per message. Then a part of the choice is given back, at
random or where it hurts least, and spent anew, as long as there is time (large neighbourhood search; what is not worse
for the network is taken back).

Tiny problems are searched exhaustively.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from zfusion.methods.layout import Bools, Ints
from zfusion.model.streams import Seeds
from zfusion.model.types import Array
from zfusion.studies.worst.problem import Problem

EXHAUSTIVE = 20_000
"""Choices up to which all of them are looked at."""

STRETCHES = (1, 2, 4, 8, 16)
"""Lengths, in steps, of the stretches that are moves."""

APART = 4
"""Steps between two moves that are taken at once: nearer ones would change each other's gains."""

NEAR = 16
"""Steps from a message within which its loss is taken to change the gains of others noticeably."""

SHARE = 4
"""At most one in so many of the messages that are left to choose is chosen before gains are looked at again."""

AT_ONCE = 1024
"""Moves whose gains are looked at between two looks at the clock."""

GIVEN_BACK = 0.3
"""The part of a choice that is chosen anew, at most."""

CHANCES = 20
"""Random choices that are looked at, too."""

PATIENCE = 12
"""Attempts without success after which the search ends."""

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Found:
    """The worst choice that was found."""

    lost: Bools
    """(messages,)."""
    value: float
    exact: bool
    """Whether nothing can be worse: all choices were looked at."""
    looked_at: int
    """Choices whose objective was computed."""
    ran_out: bool
    """Whether time ended the search: with more of it, or on another machine, it may find something else."""


def find_worst(
    problem: Problem, count: int, *, seed: int = 0, limit_s: float = 60.0, exhaustive: int = EXHAUSTIVE
) -> Found:
    """The worst choice of at most `count` messages, after `limit_s` at the latest (but for a last look)."""
    arriving = np.flatnonzero(problem.arriving)
    count = min(count, len(arriving))
    nothing = np.zeros(len(problem.arriving), dtype=np.bool_)
    if not count:
        return Found(nothing, problem.value(nothing), True, 1, False)
    if sum(math.comb(len(arriving), size) for size in range(count + 1)) <= exhaustive:
        return _exhaustive(problem, arriving, count, nothing)
    return _Search(problem, count, seed, time.monotonic() + limit_s).run()


def random_values(problem: Problem, count: int, repetitions: int, seed: int) -> Array:
    """The objective for random choices of as many of the messages that arrive, (repetitions,)."""
    arriving = np.flatnonzero(problem.arriving)
    count = min(count, len(arriving))
    nothing = np.zeros(len(problem.arriving), dtype=np.bool_)
    if not count:
        return np.full(repetitions, problem.value(nothing))
    chosen = _drawn(problem, count, repetitions, Seeds(seed).generator("worst", "random"))
    return problem.value(nothing) + problem.gains(nothing, chosen)


def _drawn(problem: Problem, count: int, repetitions: int, rng: np.random.Generator) -> list[Ints]:
    arriving = np.flatnonzero(problem.arriving)
    return [rng.choice(arriving, size=count, replace=False) for _ in range(repetitions)]


def _exhaustive(problem: Problem, arriving: Ints, count: int, nothing: Bools) -> Found:
    """All sizes: to lose more may hurt less. A neighbour that knows less is more different, and may so help more."""
    sizes = range(1, count + 1)
    choices = [np.array(chosen) for size in sizes for chosen in combinations(arriving, size)]
    gains = problem.gains(nothing, choices)
    best = int(np.argmax(gains))
    lost = nothing.copy()
    if gains[best] > 0:
        lost[choices[best]] = True
    return Found(lost, problem.value(lost), True, len(choices), False)


class _Search:
    """Greedy choice, then large neighbourhood search."""

    def __init__(self, problem: Problem, count: int, seed: int, until: float) -> None:
        self._problem, self._count, self._until = problem, count, until
        self._rng = Seeds(seed).generator("worst", "search")
        self._looked_at = 0
        self._moves = list(_moves(problem))
        self._spans = np.array([(steps.min(), steps.max()) for steps in map(problem.step_of, self._moves)])
        self._gains = np.full(len(self._moves), np.nan)
        self._gains_at: Bools = np.zeros(len(problem.arriving), dtype=np.bool_)
        """The choice that the gains belong to; NaN where they have to be computed."""

    def run(self) -> Found:
        """The best that is found."""
        nothing = np.zeros(len(self._problem.arriving), dtype=np.bool_)
        best = self._filled(nothing)
        value = self._problem.value(best)
        chance, chance_value = self._best_of_chance(nothing)
        if chance_value > value:
            best, value = chance, chance_value
        failures = 0
        while failures < PATIENCE and not self._is_over:
            other = self._filled(self._given_back(best))
            found = self._problem.value(other)
            if found > value * (1 + 1e-12):
                best, value, failures = other, found, 0
            else:
                failures += 1
        return Found(best, value, False, self._looked_at, self._is_over)

    def _best_of_chance(self, nothing: Bools) -> tuple[Bools, float]:
        """The worst of a few random choices: what is found must not be better for the network."""
        drawn = _drawn(self._problem, self._count, CHANCES, self._rng)
        gains = self._problem.gains(nothing, drawn)
        self._looked_at += len(drawn)
        lost = nothing.copy()
        lost[drawn[int(np.argmax(gains))]] = True
        return lost, self._problem.value(lost)

    @property
    def _is_over(self) -> bool:
        return time.monotonic() > self._until

    def _filled(self, lost: Bools) -> Bools:
        """Greedily, until the budget is spent or nothing hurts."""
        lost = lost.copy()
        while (left := self._count - int(lost.sum())) > 0:
            new = [move[~lost[move]] for move in self._moves]
            sizes = np.array([len(move) for move in new])
            gains = self._gains_of(lost, new, (sizes > 0) & (sizes <= left))
            hurting = np.flatnonzero(gains > 0)
            order = hurting[np.argsort(-gains[hurting] / sizes[hurting], kind="stable")]
            taken = self._taken([new[n] for n in order], max(1, left // SHARE))
            if self._is_over:  # no time to see what the others do after the first of them: take what seemed best
                taken = [new[n] for n in order]
            if not taken:
                break
            for move in taken:
                if int(lost.sum()) + len(move) <= self._count:
                    lost[move] = True
            if self._is_over:
                break
        return lost

    def _gains_of(self, lost: Bools, new: Sequence[Ints], possible: Bools) -> Array:
        """The gains of the possible moves, NaN for the others; those far from what has changed are what they were."""
        changed = np.unique(self._problem.step_of(np.flatnonzero(lost ^ self._gains_at)))
        first, last = self._spans.T
        if len(changed):
            following = np.searchsorted(changed, first - NEAR)
            near = changed[np.minimum(following, len(changed) - 1)]
            self._gains[(near >= first - NEAR) & (near <= last + NEAR)] = np.nan
        self._gains_at = lost.copy()
        wanted = np.flatnonzero(possible & np.isnan(self._gains))
        for start in range(0, len(wanted), AT_ONCE):
            if start and self._is_over:
                break
            some = wanted[start : start + AT_ONCE]
            self._gains[some] = self._problem.gains(lost, [new[n] for n in some])
            self._looked_at += len(some)
        return np.where(possible, self._gains, np.nan)

    def _taken(self, moves: Sequence[Ints], share: int) -> list[Ints]:
        """The best ones that are not near each other in time, about as many messages as the share."""
        taken: list[Ints] = []
        spans: list[tuple[int, int]] = []
        size = 0
        for move in moves:
            steps = self._problem.step_of(move)
            first, last = int(steps.min()) - APART, int(steps.max()) + APART
            if taken and size + len(move) > share:
                continue
            if all(last < begin or first > end for begin, end in spans):
                taken.append(move)
                spans.append((first + APART, last - APART))
                size += len(move)
            if size >= share:
                break
        return taken

    def _given_back(self, lost: Bools) -> Bools:
        """The choice without a part of it: single messages, those that hurt least, or all of a stretch of steps."""
        chosen = np.flatnonzero(lost)
        size = max(1, round(GIVEN_BACK * self._rng.random() * len(chosen)))
        kind = self._rng.integers(3)
        if kind == 0:
            back = self._rng.choice(chosen, size=size, replace=False)
        elif kind == 1:
            losses = -self._problem.gains(lost, [np.array([message]) for message in chosen])
            self._looked_at += len(chosen)
            back = chosen[np.argsort(losses, kind="stable")[:size]]
        else:
            steps = self._problem.step_of(chosen)
            around = steps[self._rng.integers(len(steps))]
            back = chosen[np.argsort(np.abs(steps - around), kind="stable")[:size]]
        kept = lost.copy()
        kept[back] = False
        return kept


def _moves(problem: Problem) -> Iterator[Ints]:
    """Message numbers: single ones; of one link, of one sender or one receiver, in a stretch of steps."""
    stages, steps, width = problem.shape
    arcs, arriving = problem.arcs, problem.arriving
    groups: list[list[int]] = [[at] for at in range(width) if not arcs.own[at]]
    for end in (0, 1):
        of_node: dict[object, list[int]] = {}
        for at, pair in enumerate(arcs.pairs):
            if not arcs.own[at]:
                of_node.setdefault(pair[end], []).append(at)
        groups += [group for group in of_node.values() if len(group) > 1]
    yield from (np.array([message]) for message in np.flatnonzero(arriving))
    for group in groups:
        for length in STRETCHES:
            for first in range(0, steps - length + 1, max(1, length // 2)):
                numbers = [
                    (stage * steps + step) * width + at
                    for stage in range(stages)
                    for step in range(first, first + length)
                    for at in group
                ]
                move = np.array([n for n in numbers if arriving[n]], dtype=np.intp)
                if len(move) > 1:
                    yield move
