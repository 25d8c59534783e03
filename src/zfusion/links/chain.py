"""A Markov chain with one state a step, from step 1 on, of which any step may be asked for in any order."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate

from zfusion.model.streams import BLOCK, Ends, Recent

Uniforms = Callable[[int], Sequence[float]]
"""The BLOCK random numbers, uniform in [0, 1), of a block of steps."""


class Chain:
    """States 0, 1, ...: `initial` are the probabilities at step 1, row i of `transition` those after state i.

    The state at step k is a function of those random numbers that belong to the steps up to k: earlier blocks are gone
    through once, and of the last of them only the last state is kept (`Ends`).
    """

    def __init__(self, initial: Sequence[float], transition: Sequence[Sequence[float]], uniforms: Uniforms) -> None:
        self._initial = tuple(accumulate(initial))
        self._rows = [tuple(accumulate(row)) for row in transition]
        self._uniforms = uniforms
        self._before = Ends(-1, lambda number: self._run(number)[-1])
        """The state at the end of the block before."""
        self._recent = Recent(self._states)

    def __call__(self, step: int) -> int:
        """The state at a step >= 1."""
        return self.block(step // BLOCK)[step % BLOCK]

    def block(self, number: int) -> Sequence[int]:
        """The states at the BLOCK steps from number * BLOCK on; what stands at step 0 means nothing."""
        return self._recent(number)

    def _states(self, number: int) -> list[int]:
        states = self._run(number)
        self._before.note(number + 1, states[-1])
        return states

    def _run(self, number: int) -> list[int]:
        rows, most = self._rows, len(self._rows) - 1
        cumulative = rows[self._before(number)] if number else self._initial
        states = []
        for n, u in enumerate(self._uniforms(number)):
            # rounding may leave the sum of a row a little below 1, and u above it
            state = min(bisect_right(cumulative, u), most)
            states.append(state)
            if n or number:
                cumulative = rows[state]
        return states
