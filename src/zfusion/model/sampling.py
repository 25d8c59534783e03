"""Truth and measurements of a simulated run: every process can make its own, and all agree.

    x_{k+1} = F_k x_k + w_k,   y^i_k = H^i_k x_k + v^i_k

Nothing passes between the processes but the seed. What one asks for changes nothing of what another gets.
"""

from __future__ import annotations

from functools import partial
from math import inf

import numpy as np

from zfusion.errors import RunError
from zfusion.model.checks import semidefinite_factor
from zfusion.model.matrices import RandomMatrix, Schedule, Streams
from zfusion.model.streams import BLOCK, Ends, Recent, Seeds
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId


class SamplePath:
    """One realisation of a system, given by its seed (an integer >= 0), the same bits in every process.

    Made in blocks of BLOCK steps as they are asked for, of which the last few are kept. Steps may come in any order:
    going far forward rolls the state through all steps between (once), going back makes one block again. For this, the
    states of the last KEPT_ENDS blocks are remembered; going back further rolls from the beginning. RunError at the
    step at which an unstable state leaves the range of floating-point numbers.
    """

    def __init__(self, system: System, seed: int) -> None:
        self._system = system
        self._seeds = Seeds(seed)
        self._noise = system.noise.sampler(self._seeds)
        self._entries = Ends(self._initial_state(), self._end)
        """The states before the first step of each block; x_0 itself for the first block."""
        self._lost_at: float = inf
        self._states = Recent(self._roll)
        self._measurements = {i: Recent(partial(self._measurement_block, i)) for i in system.ids}

    def truth(self, k: int) -> Array:
        """x_k, (nx,), read-only, for k >= 0."""
        return self._at(self._states, k, 0)

    def measurement(self, i: NodeId, k: int) -> Array:
        """y^i_k, (ny_i,), read-only, for k >= 1; KeyError for an unknown sensor."""
        return self._at(self._measurements[i], k, 1)

    def _at(self, blocks: Recent[Array], k: int, first: int) -> Array:
        if k < first:
            raise ValueError(f"there is no step {k}: the first is {first}")
        block, row = divmod(k, BLOCK)
        value: Array = blocks(block)[row]
        self._check_not_lost(k)
        return value

    def _check_not_lost(self, k: int) -> None:
        if k >= self._lost_at:
            raise RunError(f"the true state has left the range of floating-point numbers at step {self._lost_at}")

    def _initial_state(self) -> Array:
        factor = semidefinite_factor(self._system.initial_covariance)
        standard = self._seeds.generator("initial state").standard_normal(factor.shape[1])
        return self._system.initial_mean + factor @ standard

    def _end(self, block: int) -> Array:
        end: Array = self._roll(block)[-1].copy()
        self._check_not_lost((block + 1) * BLOCK)
        return end

    def _roll(self, block: int) -> Array:
        """x_k for the steps k of a block, (BLOCK, nx), from the state before."""
        state = self._entries(block)
        noises = self._noise.process(block)
        transitions = _draw(self._system.F, block * BLOCK - 1, self._seeds.streams("F", block=block))
        states = np.empty_like(noises)
        with np.errstate(over="ignore", invalid="ignore"):
            for row, (transition, noise) in enumerate(zip(transitions, noises, strict=True)):
                if row > 0 or block > 0:
                    state = transition @ state + noise
                states[row] = state
        lost = ~np.isfinite(states).all(axis=1)
        if lost.any():
            self._lost_at = min(self._lost_at, block * BLOCK + int(lost.argmax()))
        states.setflags(write=False)
        return states

    def _measurement_block(self, i: NodeId, block: int) -> Array:
        """y^i_k for the steps k of a block, (BLOCK, ny_i); that of k = 0 means nothing."""
        streams = self._seeds.streams("sensor", str(i), block=block)
        matrices = _draw(self._system.by_id[i].H, block * BLOCK, streams)
        with np.errstate(over="ignore", invalid="ignore"):
            measurements: Array = np.einsum("kij,kj->ki", matrices, self._states(block)) + self._noise.sensor(i, block)
        measurements.setflags(write=False)
        return measurements


def _draw(schedule: Schedule[RandomMatrix], first: int, streams: Streams) -> Array:
    """The matrices of BLOCK steps from `first` on, (BLOCK, rows, columns); before the schedule begins, any."""
    if len(schedule.items) == 1:
        return schedule.items[0].sample(streams, BLOCK)
    indices = schedule.indices(first, BLOCK)
    matrices = np.empty((BLOCK, *schedule.items[0].shape))
    for index in np.unique(indices):
        at = indices == index
        matrices[at] = schedule.items[index].sample(streams, int(at.sum()))
    return matrices
