"""What is still to happen in the simulated world, and when it is."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush

Action = Callable[[], None]


class Agenda:
    """Actions in one order: by time and, at the same time, first come, first served, and those that are last, last."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns
        """The virtual time."""
        self._dated: list[tuple[int, bool, int, Action]] = []
        self._entries = 0
        self._awaited: list[tuple[int, Action]] = []

    def at(self, time_ns: int, action: Action, last: bool = False) -> None:
        """Put down for a time; `last`: behind all else that happens then."""
        self._entries += 1
        heappush(self._dated, (time_ns, last, self._entries, action))

    def at_step(self, step: int, action: Action) -> None:
        """Put down for when `step` is reached, or, at the latest, for when nothing else happens."""
        self._awaited.append((step, action))

    def reach(self, step: int) -> None:
        """Somebody begins a step: let happen what waits for that."""
        if not self._awaited:
            return
        due = [action for at, action in self._awaited if at <= step]
        self._awaited = [(at, action) for at, action in self._awaited if at > step]
        for action in due:
            self.at(self.now_ns, action)

    def run(self, until_ns: int | None = None) -> None:
        """Let everything happen that happens before a time; by default, until there is nothing left."""
        dated = self._dated
        while dated or self._awaited:
            if not dated:
                self.reach(min(step for step, _ in self._awaited))
            elif until_ns is None or dated[0][0] < until_ns:
                self.now_ns, _, _, action = heappop(dated)
                action()
            else:
                break
        if until_ns is not None:
            self.now_ns = max(self.now_ns, until_ns)
