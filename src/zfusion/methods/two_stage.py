"""The two-stage distributed fusion filter, and its special cases `local` and `centralized`.

Stage 1: every node filters with the measurements of its neighbourhood. Stage 2: it fuses its neighbours'
intermediate estimates with the matrix weights that are optimal for what each of them really used.

Source: Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332; see `covariances`
and `fusion` for the equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import numpy as np

from zfusion.methods.covariances import State
from zfusion.methods.fusion import fuse, fusion_weights
from zfusion.methods.least_squares import LeastSquaresFilter
from zfusion.methods.neighbourhood import Neighbourhood, StepModels
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.model.network import Network
from zfusion.model.statistics import PriorMoments, prior_moments, step_models
from zfusion.model.types import Array, NodeId
from zfusion.stages import INTERMEDIATE, MEASUREMENT, Stage
from zfusion.used_sets import Ledger, UsedSet


class Centralized:
    """Every node filters with all measurements: one stage, the bound that no network can beat."""

    name: ClassVar[str] = "centralized"
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT,)

    @staticmethod
    def network(graph: Network) -> Network:
        """The graph whose neighbourhoods the method uses, given the scenario's."""
        return Network.complete(graph.ids)

    def __init__(self, setting: Setting) -> None:
        system, node = setting.system, setting.node
        self._node = node
        neighbourhood = setting.network.neighbours(node)
        self._neighbourhood = neighbourhood
        sizes = {j: system.by_id[j].ny for j in neighbourhood}
        self._models = StepModels(lambda: step_models(system, neighbourhood))
        start = prior_moments(system) if setting.born == 1 else self._models.at(setting.born - 1)[1]
        self._filter = LeastSquaresFilter(neighbourhood, sizes, start.mean, start.covariance)

    def begin(self, step: int, y: Array | None) -> Fields:  # noqa: ARG002
        """The measurement, as it is."""
        return {"y": y}

    def skip(self, step: int) -> None:
        """Go through a step without measurements."""
        self._filter.step(self._models.at(step)[0], {})

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Filter with what arrived."""
        used = self._filter_step(step, arrived)
        return Outcome(self._filter.x, self._filter.P, used)

    def _filter_step(self, step: int, arrived: Mapping[NodeId, Fields]) -> UsedSet:
        measurements: dict[NodeId, Array] = {}
        for j in self._neighbourhood:  # in sorted order, whatever the order of arrival
            y = arrived[j]["y"] if j in arrived else None
            if y is not None:
                measurements[j] = cast(Array, y)
        self._filter.step(self._models.at(step)[0], measurements)
        return tuple(measurements)


class Local(Centralized):
    """Every node filters with its own measurements and nothing else: what a network is worth, by contrast."""

    name: ClassVar[str] = "local"

    @staticmethod
    def network(graph: Network) -> Network:
        """No links at all."""
        return Network.isolated(graph.ids)


class TwoStage(Centralized):
    """The method of the paper, exact for whatever used sets the network leaves."""

    name: ClassVar[str] = "two_stage"
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT, INTERMEDIATE)

    @staticmethod
    def network(graph: Network) -> Network:
        """The scenario's graph."""
        return graph

    def __init__(self, setting: Setting) -> None:
        super().__init__(setting)
        system, network = setting.system, setting.network
        sensors = network.two_hop(self._node)
        self._neighbours = Neighbourhood(
            self._node,
            {j: network.neighbours(j) for j in self._neighbourhood},
            {j: system.by_id[j].ny for j in sensors},
            lambda: step_models(system, sensors),
            prior_moments(system),
        )
        self._others = tuple(j for j in self._neighbourhood if j != self._node)
        self._weights: _Weights | None = None

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:
        """Stage 0: the intermediate estimate; stage 1: the estimate."""
        if stage == 0:
            used = self._filter_step(step, arrived)
            return {"x": self._filter.x, "used": used}
        self._neighbours.follow(step, ledger)
        known = self._neighbours.exact(step)
        others = self._others
        if len(arrived) == len(self._neighbourhood) and known.issuperset(others):
            x, P = self._fuse(step, others, arrived)
            return Outcome(x, P, self._neighbourhood)
        others = tuple(j for j in others if j in arrived)
        fused = tuple(j for j in others if j in known)
        excluded = tuple(j for j in others if j not in known)
        x, P = self._fuse(step, fused, arrived)
        used = tuple(j for j in self._neighbourhood if j == self._node or j in fused)
        ask = {j: first for j in excluded if (first := self._neighbours.missing(j, step, ledger)) is not None}
        return Outcome(x, P, used, excluded, ask)

    def _fuse(self, step: int, fused: UsedSet, arrived: Mapping[NodeId, Fields]) -> tuple[Array, Array]:
        if not fused:
            return self._filter.x, self._filter.P
        prior = self._neighbours.moments(step)
        kept = self._weights
        if kept is None or not kept.serve(self._neighbours.state, fused, prior):
            weights, covariance = fusion_weights(self._neighbours.joint(fused), prior.covariance)
            kept = self._weights = _Weights(self._neighbours.state, fused, prior, weights, covariance)
        estimates = [cast(Array, arrived[j]["x"]) for j in fused]
        return fuse(self._filter.x, estimates, prior.mean, kept.weights), kept.covariance


@dataclass(frozen=True)
class _Weights:
    """Weights of a fusion, and what they were computed from."""

    state: State
    fused: UsedSet
    prior: PriorMoments
    weights: Array
    covariance: Array

    def serve(self, state: State, fused: UsedSet, prior: PriorMoments) -> bool:
        """Whether the weights are still those of this fusion."""
        return (
            state is self.state
            and fused == self.fused
            and (prior is self.prior or np.array_equal(prior.covariance, self.prior.covariance))
        )
