"""What a scenario may say of the method `delay_aware`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

from zfusion.methods.delay_aware.parameters import SUM
from zfusion.model.checks import ModelError
from zfusion.model.types import NodeId

ESTIMATED = "estimated"

COMPANIONS = ("plain", "augmented", "stamped")

GAINS = ("stepwise", "constant")

LATEST = 15
"""Steps that a message may be late in any run."""


@dataclass(frozen=True)
class DelayAwareOptions:
    """Options of the filter. ModelError for what cannot be."""

    probabilities: Any = ESTIMATED
    """p_0, ..., p_L: that what a node receives of a neighbour at a step is so many steps old; the rest of 1: nothing
    comes. A list for all, a table with one for each sender, or "estimated": from the scenario's links."""
    delays: int | None = None
    """L, where it is not said by `probabilities`; by default the window of what may be late."""
    companion: str = "plain"
    """"plain": the filter of the source; "augmented": least squares without time stamps; "stamped": with them."""
    gain: str = "stepwise"
    """"stepwise": optimal at each step; "constant": the best constant one. Of the plain filter only."""
    noise: float = 0.0
    """Variance of the noise n that is received with, or in the place of, each component."""
    filtered: bool = True
    """Whether the estimate of a step uses what is received at it; otherwise it is the source's one-step prediction."""

    def __post_init__(self) -> None:
        if self.probabilities != ESTIMATED:
            object.__setattr__(self, "probabilities", _probabilities(self.probabilities))
        for name, known in (("companion", COMPANIONS), ("gain", GAINS)):
            if getattr(self, name) not in known:
                raise ModelError(name, getattr(self, name), f"expected one of {', '.join(known)}")
        if self.gain == "constant" and self.companion != "plain":
            raise ModelError("gain", self.gain, f"expected stepwise with companion = {self.companion!r}")
        delays = self.delays
        if delays is not None:
            if isinstance(delays, bool) or not isinstance(delays, int) or not 0 <= delays <= LATEST:
                raise ModelError("delays", delays, f"expected an integer from 0 to {LATEST}")
            if self.probabilities != ESTIMATED:
                raise ModelError(
                    "delays", delays, "expected none beside probabilities: the length of their list says it"
                )
        noise = self.noise
        if isinstance(noise, bool) or not isinstance(noise, int | float) or not (isfinite(noise) and noise >= 0):
            raise ModelError("noise", noise, "expected a variance, a number >= 0")
        if not isinstance(self.filtered, bool):
            raise ModelError("filtered", self.filtered, "expected true or false")

    @property
    def lateness(self) -> int:
        """The steps that a message may be late, as far as the options say."""
        if self.probabilities == ESTIMATED:
            return self.delays or 0
        lists = self.probabilities.values() if isinstance(self.probabilities, Mapping) else (self.probabilities,)
        return max(map(len, lists)) - 1

    def given(self, sender: NodeId) -> tuple[float, ...] | None:
        """What is given of the messages of a node; None where there is nothing."""
        if isinstance(self.probabilities, Mapping):
            found: tuple[float, ...] | None = self.probabilities.get(str(sender))
            return found
        return None if self.probabilities == ESTIMATED else tuple(self.probabilities)


def _probabilities(value: object) -> object:
    """A list as a tuple, a table of lists as a dict of tuples; ModelError for what is neither."""
    if not isinstance(value, Mapping):
        return _list("probabilities", value)
    if not value:
        raise ModelError("probabilities", value, "expected the probabilities of each sender in the table")
    return {str(sender): _list(f"probabilities.{sender}", given) for sender, given in value.items()}


def _list(field: str, value: object) -> tuple[float, ...]:
    listed = value if isinstance(value, list | tuple) else ()
    if not 1 <= len(listed) <= LATEST + 1 or any(isinstance(p, bool) or not isinstance(p, int | float) for p in listed):
        expected = f'expected 1 to {LATEST + 1} probabilities, a table of such lists, or "{ESTIMATED}"'
        raise ModelError(field, value, expected)
    if any(not 0 <= p <= 1 for p in listed):
        raise ModelError(field, value, "expected probabilities, from 0 to 1")
    if sum(listed) > 1 + SUM:
        raise ModelError(field, value, f"expected probabilities that add up to 1 or less, not to {sum(listed):g}")
    return tuple(map(float, listed))
