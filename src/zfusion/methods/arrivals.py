"""Which messages of a step arrive at a node, where every link loses its message by itself with one probability."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from zfusion.errors import InputError

MOST_NEIGHBOURS = 12
"""A node with more has too many sets of arrivals to go through."""


def arrivals(others: Sequence[int], loss: float) -> Iterator[tuple[tuple[int, ...], float]]:
    """All sets of neighbours whose message arrives, and their probabilities; impossible ones left out.

    InputError for a probability that is none, and for a node with too many neighbours.
    """
    if not 0 <= loss <= 1:
        raise InputError(f"expected a loss probability from 0 to 1: {loss}")
    if len(others) > MOST_NEIGHBOURS:
        raise InputError(f"a node with {len(others)} neighbours: at most {MOST_NEIGHBOURS} can be gone through")
    for count in range(len(others) + 1):
        chance = (1 - loss) ** count * loss ** (len(others) - count)
        if chance > 0:
            for arrived in combinations(others, count):
                yield arrived, chance
