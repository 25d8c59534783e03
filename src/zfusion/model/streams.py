"""Random numbers by purpose: whoever asks for the same purpose and block gets the same ones, in any process.

Each purpose (the initial state, a variable of F, one white noise, a variable of sensor 3's H, ...) has generators of
its own, so that nobody's draws depend on who else draws. Each block of BLOCK steps has one too, so that the numbers of
late steps can be had without those of all earlier ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from hashlib import sha256
from itertools import islice
from typing import Generic, TypeVar

import numpy as np

from zfusion.model.checks import ModelError
from zfusion.model.matrices import Streams

T = TypeVar("T")

BLOCK = 256
"""Steps drawn at once: setting up a generator then costs 0.1 µs a step, and a block is drawn in well under 1 ms."""


class Seeds:
    """All random generators that come from one seed, an integer >= 0."""

    def __init__(self, seed: int) -> None:
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise ModelError("seed", seed, "expected an integer >= 0")
        self.seed = seed

    def generator(self, *purpose: str, block: int = 0) -> np.random.Generator:
        """The generator of a purpose for a block of steps, at its beginning."""
        digest = sha256(repr((purpose, block)).encode()).digest()[:16]
        key = np.frombuffer(digest, dtype="<u4").tolist()
        return np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed, spawn_key=key)))

    def streams(self, *purpose: str, block: int) -> Streams:
        """Generators by the names of variables: each begins once, and goes on where it is asked for again."""
        begun: dict[str, np.random.Generator] = {}

        def stream(name: str) -> np.random.Generator:
            if name not in begun:
                begun[name] = self.generator(*purpose, name, block=block)
            return begun[name]

        return stream


KEPT_ENDS = 1024
"""Blocks whose beginnings are remembered: 262 144 steps, seven hours at 10 Hz. Who goes back further begins anew."""


class Ends(Generic[T]):
    """What each block begins with, where that follows from the block before; the last few are remembered."""

    def __init__(self, first: T, end: Callable[[int], T]) -> None:
        """`first` is what block 0 begins with, `end` what a block ends with; it may ask what that block begins with."""
        self._end = end
        self._known: dict[int, T] = {0: first}

    def __call__(self, block: int) -> T:
        """What this block begins with."""
        if block not in self._known:
            for number in range(max(known for known in self._known if known < block), block):
                self.note(number + 1, self._end(number))
        return self._known[block]

    def note(self, block: int, begins_with: T) -> None:
        """What a block begins with is known."""
        self._known[block] = begins_with
        if len(self._known) > KEPT_ENDS:
            del self._known[next(islice(self._known, 1, None))]  # the first that was noted; block 0 stays


class Recent(Generic[T]):
    """Remembers the last few results of a function of the block number."""

    def __init__(self, make: Callable[[int], T], keep: int = 3) -> None:
        self._make = make
        self._keep = keep
        self._known: OrderedDict[int, T] = OrderedDict()

    def __call__(self, block: int) -> T:
        """The result for this block, made now unless it is among the last few asked for."""
        if block in self._known:
            self._known.move_to_end(block)
            return self._known[block]
        made = self._make(block)
        self._known[block] = made
        if len(self._known) > self._keep:
            self._known.popitem(last=False)
        return made
