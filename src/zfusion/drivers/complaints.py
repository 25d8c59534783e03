"""Says what is refused, without saying it a thousand times: counters are looked at now and then."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping

log = logging.getLogger(__name__)

EVERY_NS = 10_000_000_000
"""From one complaint about somebody to the next."""


class Complaints:
    """Warnings in the log about counters that grow, at most one in a while about each source."""

    def __init__(self) -> None:
        self._told: dict[str, Counter[str]] = {}
        self._next_ns: dict[str, int] = {}

    def look(self, now_ns: int, refused: Mapping[str, Mapping[str, int]], *, ended: bool = False) -> None:
        """Complain about what came since the last time, by source; when it has `ended`, whenever that was."""
        for source, counts in refused.items():
            told = self._told.get(source)
            if not counts or told == counts or (not ended and now_ns < self._next_ns.get(source, 0)):
                continue
            new = Counter(counts) - (told or Counter())
            self._told[source], self._next_ns[source] = Counter(counts), now_ns + EVERY_NS
            reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(new.items()))
            log.warning("refused from %s: %s (%d so far)", source, reasons, sum(counts.values()))
