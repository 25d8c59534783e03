"""From the law of a delay to the delays of a block of steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from zfusion.model.schema.links import (
    ExponentialDelay,
    GammaDelay,
    LognormalDelay,
    MixtureDelay,
    NormalDelay,
    ParetoDelay,
    TraceDelay,
    UniformDelay,
)
from zfusion.model.streams import BLOCK
from zfusion.model.types import Array

LONGEST_S = 1e6
"""No message is on its way for longer, twelve days: heavy tails have no end, and time stamps do."""

Traces = Callable[[str, str | None], Array]
"""(file, column) -> the delays in it, (n,)."""


class Generators(Protocol):
    """The generators of one block of steps of one edge and stage, by purpose."""

    def __call__(self, *purpose: str) -> np.random.Generator:
        """The generator of a purpose, at its beginning."""


def delays_ns(law: Any, block: int, generators: Generators, traces: Traces) -> NDArray[np.int64]:
    """The delays of the BLOCK steps from block * BLOCK on, in nanoseconds."""
    seconds = np.minimum(_seconds(law, block, generators, traces), LONGEST_S)
    return np.rint(seconds * 1e9).astype(np.int64)


def _seconds(law: Any, block: int, generators: Generators, traces: Traces) -> Array:
    """The same in seconds, (BLOCK,)."""
    if isinstance(law, float):
        return np.full(BLOCK, law)
    if isinstance(law, MixtureDelay):
        return _mixed(law, block, generators, traces) + law.shift
    if isinstance(law, TraceDelay):
        return _traced(law, block, generators, traces(law.trace, law.column)) + law.shift
    with np.errstate(over="ignore"):  # too long for a float is too long, see LONGEST_S
        return _drawn(law, generators("drawn")) + float(law.shift)


def _drawn(law: Any, rng: np.random.Generator) -> Array:
    """Each law is a standard one, scaled: with the same seed, a change of scale stretches what is drawn."""
    match law:
        case UniformDelay():
            return law.low + (law.high - law.low) * rng.random(BLOCK)
        case NormalDelay():
            return np.maximum(law.mean + law.sd * rng.standard_normal(BLOCK), 0.0)
        case LognormalDelay():
            return law.median * np.exp(law.sigma * rng.standard_normal(BLOCK))
        case GammaDelay():
            return law.scale * rng.standard_gamma(law.shape, BLOCK)
        case ExponentialDelay():
            return law.mean * rng.standard_exponential(BLOCK)
        case ParetoDelay():
            tail: Array = (1.0 - rng.random(BLOCK)) ** (-1.0 / law.shape)
            return law.minimum * tail
    raise TypeError(f"{type(law).__name__} is no law of a delay")


def _mixed(law: MixtureDelay, block: int, generators: Generators, traces: Traces) -> Array:
    """For each step that of the component which is its turn."""
    weights = np.cumsum([component.weight for component in law.mixture])
    turns = np.searchsorted(weights, weights[-1] * generators("component").random(BLOCK), side="right")
    drawn = []
    for n, component in enumerate(law.mixture):

        def own(*purpose: str, n: int = n) -> np.random.Generator:
            return generators("component", str(n), *purpose)

        drawn.append(_seconds(component.delay, block, own, traces))
    chosen: Array = np.array(drawn)[np.minimum(turns, len(drawn) - 1), np.arange(BLOCK)]
    return chosen


def _traced(law: TraceDelay, block: int, generators: Generators, recorded: Array) -> Array:
    if law.order == "as_recorded":
        steps = np.arange(block * BLOCK, (block + 1) * BLOCK)
        return recorded[(steps - 1) % len(recorded)]
    return recorded[generators("drawn").integers(len(recorded), size=BLOCK)]
