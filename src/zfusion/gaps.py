"""What got lost on the way to an observer, from the senders' own counters.

A sender numbers what it puts on a key 0, 1, 2, ... (`seq`), anew in each of its lives (`born`). So whoever receives
can tell exactly what is missing, without asking: numbers before the first that came, numbers between, and, where the
sender's final count is known, numbers after the last.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field

MAX_LIVES = 1024
"""Lives of one sender that are told apart; a node is not restarted so often, a forger's messages are."""

MAX_HOLES = 1024
"""Separate holes remembered in one life, for messages that come late; the oldest are given up for lost beyond that."""


LIVES_WITH_HOLES = 4
"""Last lives of a sender of which holes are remembered: of those before, nothing that is late comes any more."""


@dataclass(frozen=True, slots=True)
class Gaps:
    """The account of one key: of what the sender put on it, what came and what did not."""

    received: int = 0
    """Different messages that came."""
    duplicates: int = 0
    """Messages that came again."""
    reordered: int = 0
    """Messages, among the received, that came after a later one."""
    lost_before: int = 0
    """Missing before the first that came of each life: the observer was late."""
    lost_between: int = 0
    """Missing between the first and the last that came of each life."""
    lost_after: int = 0
    """Missing after the last that came; 0 where the sender's count is not known."""
    restarts: int = 0
    """Lives beyond the first."""
    unreadable: int = 0
    """Messages without legal counters, which are in no other number."""

    @property
    def lost(self) -> int:
        """All that is known to be missing."""
        return self.lost_before + self.lost_between + self.lost_after


@dataclass(slots=True)
class _Life:
    """What came of one life of a sender."""

    next: int = 0
    """One more than the highest number that came."""
    lowest: int = -1
    """The lowest number that came."""
    received: int = 0
    duplicates: int = 0
    reordered: int = 0
    given_up: int = 0
    """Numbers missing in holes that are no longer remembered."""
    given_up_before: int = 0
    """Of these, those before the lowest that came."""
    holes: list[tuple[int, int]] = field(default_factory=list)
    """[start, stop) of the missing numbers below `next`, ascending."""

    def observe(self, seq: int) -> None:
        """Account for a number that is not `next`, or is the first of all."""
        if seq >= self.next:
            if seq > self.next:
                self.holes.append((self.next, seq))
            self.next = seq + 1
            self.lowest = seq if self.lowest < 0 else self.lowest
            self.received += 1
        elif self._fill(seq):
            self.lowest = min(self.lowest, seq)
            self.received += 1
            self.reordered += 1
        else:
            self.duplicates += 1
        if len(self.holes) > MAX_HOLES:
            start, stop = self.holes.pop(0)
            self.given_up += stop - start

    def missing(self) -> tuple[int, int]:
        """Numbers missing before the lowest that came, and between it and the highest."""
        before = self.given_up_before + sum(stop - start for start, stop in self.holes if stop <= self.lowest)
        return before, self.given_up + sum(stop - start for start, stop in self.holes) - before

    def give_up(self) -> None:
        """Remember how many numbers are missing, and not which."""
        before, between = self.missing()
        self.given_up_before, self.given_up, self.holes = before, before + between, []

    def _fill(self, seq: int) -> bool:
        """Take `seq` out of its hole; False if it is in none."""
        place = bisect_right(self.holes, seq, key=lambda hole: hole[0]) - 1
        if place < 0 or seq >= self.holes[place][1]:
            return False
        start, stop = self.holes[place]
        self.holes[place : place + 1] = [hole for hole in ((start, seq), (seq + 1, stop)) if hole[0] < hole[1]]
        return True


class GapCounter:
    """Keeps the account of one key. `observe` is called for every message, `gaps` at any time."""

    __slots__ = ("_born", "_life", "_lives", "_unreadable")

    def __init__(self) -> None:
        self._born = 0
        self._life = _Life()
        self._lives: dict[int, _Life] = {}
        self._unreadable = 0

    def observe(self, born: int, seq: int) -> None:
        """A message came with these counters."""
        if born != self._born and not self._turn_to(born):
            self._unreadable += 1
            return
        life = self._life
        if seq == life.next and seq:
            life.next += 1
            life.received += 1
        else:
            life.observe(seq)

    def expects(self, born: int, seq: int) -> bool:
        """Whether a message with these counters would be the next one in order."""
        return born == self._born and seq == self._life.next

    def observe_unreadable(self) -> None:
        """A message came that has no legal counters."""
        self._unreadable += 1

    @property
    def heard(self) -> int:
        """One more than the highest number that came in the present life."""
        return self._life.next

    def gaps(self, sent: Mapping[int, int] | None = None) -> Gaps:
        """The account so far; `sent` tells how many messages the sender had put on the key, by its lives' `born`."""
        sent = sent or {}
        lives = self._lives
        missing = [life.missing() for life in lives.values()]
        return Gaps(
            received=sum(life.received for life in lives.values()),
            duplicates=sum(life.duplicates for life in lives.values()),
            reordered=sum(life.reordered for life in lives.values()),
            lost_before=sum(before for before, _ in missing),
            lost_between=sum(between for _, between in missing),
            lost_after=sum(max(0, n - (lives[born].next if born in lives else 0)) for born, n in sent.items()),
            restarts=max(0, len(lives.keys() | sent.keys()) - 1),
            unreadable=self._unreadable,
        )

    def _turn_to(self, born: int) -> bool:
        """Make `born` the present life; False if there are too many."""
        if born not in self._lives:
            if len(self._lives) == MAX_LIVES:
                return False
            self._lives[born] = _Life()
            for former in list(self._lives.values())[-LIVES_WITH_HOLES - 1 : -LIVES_WITH_HOLES]:
                former.give_up()
        self._born, self._life = born, self._lives[born]
        return True
