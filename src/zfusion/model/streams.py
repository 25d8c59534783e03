"""Random numbers by purpose: whoever asks for the same purpose and block gets the same ones, in any process.

Each purpose (the initial state, a variable of F, one white noise, a variable of sensor 3's H, ...) has generators of
its own, so that nobody's draws depend on who else draws. Each block of BLOCK steps has one too, so that the numbers of
late steps can be had without those of all earlier ones.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from hashlib import sha256
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
