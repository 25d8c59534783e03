"""Mean error covariances over everything that can happen to a few messages, each case weighted by its probability.

Where messages are lost independently of each other, what one node's estimate depends on at step k are the messages of
the first stage, up to step k, to the nodes whose estimates it fuses, and those of the last stage to itself at step k.
For the first steps these are few enough to go through all their combinations.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np

from zfusion.methods.ensemble import Arcs, Ensemble
from zfusion.methods.layout import Bools
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.statistics import PriorMoments, StepModel, step_models
from zfusion.model.types import Array, NodeId
from zfusion.studies.certainty import Certainty
from zfusion.studies.fates import method_network

COMBINATIONS = 1 << 12
"""Combinations of used sets, for one node, that are gone through: a tenth of a second's work."""

TOLD = 4
"""How many times as many they may be with those of the last stage, which need no filters of their own."""

TOGETHER = 512
"""Combinations in one pass: to set up filters for more takes longer than to use them."""

FURTHEST = 64
"""Steps up to which it is done where few messages are left to chance: what is certain anyway needs no enumeration."""

ByNode = list[Array]
"""For each node: covariances of steps 1, 2, ... as far as they are there, (steps, nx, nx)."""


def exact_means(scenario: Scenario, known: Certainty, limit: int = COMBINATIONS) -> tuple[ByNode, ByNode]:
    """The mean covariances of the first steps, intermediate and distributed, over all combinations of messages.

    As many steps as at most `limit` combinations allow, and not beyond the first that some node begins anew or misses.
    """
    network = method_network(scenario)
    whole = known.fate.made.all(axis=1) & ~known.fate.begins.any(axis=1)
    steps = scenario.steps if whole.all() else int(np.argmin(whole))
    enumeration = _Enumeration(scenario, network, known, steps, limit)
    intermediate = [enumeration.of_intermediate(i) for i in network.ids]
    return intermediate, [enumeration.of_distributed(i) for i in network.ids]


@dataclass(frozen=True)
class _Enumeration:
    """Goes through combinations of the messages that one node's estimates depend on."""

    scenario: Scenario
    network: Network
    known: Certainty
    steps: int
    limit: int

    def of_intermediate(self, node: NodeId) -> Array:
        """Mean covariances of a node's intermediate estimates, (steps, nx, nx)."""
        places = self._arcs_to([node])
        counts = _counts(self.known.used[: self.steps, places])
        used, weights = _combinations(self.known.used[: int((counts <= self.limit).sum()), places])
        means = np.zeros((used.shape[1], *self._shape))
        for part, share, ensemble in self._passes([node], used, weights, fusing=()):
            for k, (model, _) in enumerate(self._models[: used.shape[1]]):
                ensemble.advance(model, part[:, k])
                means[k] += np.tensordot(share, ensemble.intermediate[:, 0], 1)
        return means

    def of_distributed(self, node: NodeId) -> Array:
        """Mean covariances of its fused estimates, (steps, nx, nx)."""
        near = self.network.neighbours(node)
        places, heard = self._arcs_to(near), self._arcs_to([node])
        counts = _counts(self.known.used[: self.steps, places])
        last = 2.0 ** _open(self.known.told[: self.steps, heard]).sum(axis=1)
        possible = (counts <= self.limit) & (counts * last <= TOLD * self.limit)
        steps = int(np.argmin(possible)) if not possible.all() else len(possible)
        used, weights = _combinations(self.known.used[:steps, places])
        columns = [places.index(at) for at in heard]
        means = np.zeros((steps, *self._shape))
        for part, share, ensemble in self._passes(near, used, weights, fusing=[node]):
            for k, (model, moments) in enumerate(self._models[:steps]):
                ensemble.advance(model, part[:, k])
                told, chances = _combinations(self.known.told[k, heard])
                for row, chance in zip(told, chances, strict=True):
                    by_arc = np.zeros(part[:, k].shape, dtype=np.bool_)
                    by_arc[:, columns] = row
                    means[k] += chance * np.tensordot(share, ensemble.fused(by_arc, moments)[:, 0], 1)
        return means

    def _passes(
        self, followed: Collection[NodeId], used: Bools, weights: Array, fusing: Collection[NodeId]
    ) -> Iterator[tuple[Bools, Array, Ensemble]]:
        """The combinations in parts of one size, each with filters at step 0; what fills up the last has no weight."""
        size = min(TOGETHER, len(weights))
        missing = -len(weights) % size
        used = np.concatenate((used, used[:1].repeat(missing, axis=0)))
        weights = np.concatenate((weights, np.zeros(missing)))
        near = {i: self.network.neighbours(i) for i in followed}
        ensemble = Ensemble(self.scenario.system(), near, size, fusing)
        start = ensemble.state
        for first in range(0, len(weights), size):
            ensemble.state = start
            yield used[first : first + size], weights[first : first + size], ensemble

    def _arcs_to(self, receivers: Collection[NodeId]) -> list[int]:
        return [at for at, (i, _) in enumerate(self._pairs) if i in receivers]

    @cached_property
    def _pairs(self) -> Sequence[tuple[NodeId, NodeId]]:
        return Arcs(self.network.neighbourhoods).pairs

    @cached_property
    def _models(self) -> Sequence[tuple[StepModel, PriorMoments]]:
        return list(islice(step_models(self.scenario.system(), self.network.ids), min(self.steps, FURTHEST)))

    @cached_property
    def _shape(self) -> tuple[int, int]:
        nx = self.scenario.system().nx
        return nx, nx


def _open(probabilities: Array) -> Bools:
    return (probabilities > 0) & (probabilities < 1)


def _counts(probabilities: Array) -> Array:
    """How many combinations there are up to each step, (steps,), of events of these probabilities, (steps, n)."""
    counts: Array = 2.0 ** np.cumsum(_open(probabilities).sum(axis=1))
    counts[FURTHEST:] = np.inf
    return counts


def _combinations(probabilities: Array) -> tuple[Bools, Array]:
    """All that can be, (combinations, *shape), of independent events of these probabilities; and how likely each is."""
    flat = probabilities.reshape(-1)
    at = np.flatnonzero(_open(flat))
    table = np.tile(flat == 1, (2 ** len(at), 1))
    table[:, at] = np.arange(2 ** len(at))[:, None] >> np.arange(len(at)) & 1
    weights = np.where(table[:, at], flat[at], 1 - flat[at]).prod(axis=1)
    return table.reshape(len(table), *probabilities.shape), weights
