"""The two-stage distributed fusion filter, and its special cases `local` and `centralized`.

Stage 1: every node filters with the measurements of its neighbourhood. Stage 2: it fuses its neighbours'
intermediate estimates with the matrix weights that are optimal for what each of them really used.

Source: Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332; see `covariances`
and `fusion` for the equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, cast

import numpy as np

from zfusion.methods.covariances import State
from zfusion.methods.family import Family
from zfusion.methods.fusion import fuse, fusion_weights
from zfusion.methods.least_squares import LeastSquaresFilter, Standing
from zfusion.methods.neighbourhood import Neighbourhood, StepModels
from zfusion.methods.packing import IMPOSSIBLE, too_large
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
    revises: ClassVar[bool] = True

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
        self._window = setting.window
        self._past = {setting.born - 1: _Past({}, self._filter.standing)}
        """The last steps, as far as they may be gone back to, and the one before them."""

    def refuses(self, stage: int, fields: Fields) -> str | None:
        """Numbers that are too large to be computed with: one of them, and no later estimate would be a number."""
        return IMPOSSIBLE if too_large(fields, "y" if stage == 0 else "x") else None

    def begin(self, step: int, y: Array | None) -> Fields:  # noqa: ARG002
        """The measurement, as it is."""
        return {"y": y}

    def skip(self, step: int) -> None:
        """Go through a step without measurements."""
        self._take_step(step, {})

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        """Go back to before the first step of which something is new, and forward again with it."""
        past, new = self._past, dict[int, dict[NodeId, Array]]()
        for step in sorted(late):
            found = self._measurements(late[step])
            found = {j: y for j, y in found.items() if j not in past[step].measurements}
            if found:
                new[step] = found
        if new:
            first, end = min(new), max(past) + 1
            self._filter.return_to(past[first - 1].standing)
            for step in range(first, end):
                both = {**past[step].measurements, **new.get(step, {})}
                self._take_step(step, {j: both[j] for j in self._neighbourhood if j in both})
        return {step: tuple(found) for step, found in new.items()}

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:  # noqa: ARG002
        """What the filter has for that step by now."""
        past = self._past[step]
        return Outcome(past.standing.x, past.standing.P, tuple(past.measurements))

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Filter with what arrived."""
        used = self._filter_step(step, arrived)
        return Outcome(self._filter.x, self._filter.P, used)

    def _filter_step(self, step: int, arrived: Mapping[NodeId, Fields]) -> UsedSet:
        measurements = self._measurements(arrived)
        self._take_step(step, measurements)
        return tuple(measurements)

    def _measurements(self, arrived: Mapping[NodeId, Fields]) -> dict[NodeId, Array]:
        measurements: dict[NodeId, Array] = {}
        for j in self._neighbourhood:  # in sorted order, whatever the order of arrival
            y = arrived[j]["y"] if j in arrived else None
            if y is not None:
                measurements[j] = cast(Array, y)
        return measurements

    def _take_step(self, step: int, measurements: Mapping[NodeId, Array]) -> None:
        self._filter.step(self._models.at(step)[0], measurements)
        if self._window:
            self._past[step] = _Past(measurements, self._filter.standing)
            self._past.pop(step - self._window - 1, None)


class _Past(NamedTuple):
    """What a step was made of, and where the filter stood after it."""

    measurements: Mapping[NodeId, Array]
    standing: Standing


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
            revisable=setting.window,
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

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:
        """Fuse the own estimate, as it would be now, with the others of that step whose covariances are known."""
        own, at = self._past[step].standing, self._neighbours.at(step)
        fused = () if at is None else tuple(j for j in self._others if j in heard and at.knows(j))
        x, P = own.x, own.P
        if at is not None and fused:
            prior = self._neighbours.moments(step)
            weights, P = fusion_weights(self._neighbours.joint(fused, at.state), prior.covariance)
            x = fuse(x, [cast(Array, heard[j]["x"]) for j in fused], prior.mean, weights)
        return Outcome(x, P, tuple(j for j in self._neighbourhood if j == self._node or j in fused))

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


TWO_STAGE, LOCAL, CENTRALIZED = (
    Family(
        method.name,
        method,
        stages=lambda _, stages=method.stages: stages,  # type: ignore[misc]
        network=method.network,
        revises=method.revises,
    )
    for method in (TwoStage, Local, Centralized)
)
