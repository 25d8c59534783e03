"""Which messages of a block of steps are lost."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from zfusion.links.chain import Chain, Uniforms
from zfusion.model.schema.links import BurstLoss, GilbertElliottSpec
from zfusion.model.types import Array

BAD = 1
"""The state of a link in which it loses more; 0 is the good one."""

Probabilities = Callable[[int], "float | Array"]
"""The probability of loss at the steps of a block: one for all, or (BLOCK,)."""


def loss_probabilities(loss: float | BurstLoss, uniforms: Uniforms) -> Probabilities:
    """The probability of loss step by step; `uniforms` are for the states of the edge, which its stages share."""
    if not isinstance(loss, BurstLoss):
        return lambda _: loss
    spec, states = loss.gilbert_elliott, gilbert_elliott(loss.gilbert_elliott, uniforms)
    by_state = np.array([spec.loss_good, spec.loss_bad])
    return lambda block: by_state[np.asarray(states(block))]


def gilbert_elliott(spec: GilbertElliottSpec, uniforms: Uniforms) -> Callable[[int], Sequence[int]]:
    """The states of the steps of a block; at step 1 as likely bad as in the long run."""
    bad = spec.to_bad / (spec.to_bad + spec.to_good)
    transition = ((1 - spec.to_bad, spec.to_bad), (spec.to_good, 1 - spec.to_good))
    return Chain((1 - bad, bad), transition, uniforms).block
