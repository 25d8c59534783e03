"""What delay and loss do to the errors, by theory: the mean error covariances over what a random network may do.

    P̄_k = E[P_k(U)],   U the used sets of a realisation of the links

P_k(U), the covariance of the error of the least-squares estimate given what was used, follows from the used sets alone
(`methods.ensemble`); no data are drawn. It is also what the nodes themselves report as P. The mean is taken

- exactly, from one realisation, where nothing is left to chance;
- exactly, over all combinations of messages, for the first steps, where messages are lost independently of each other
  and the combinations are few;
- over N realisations elsewhere: the very ones that simulations with the seeds s, s + 1, ..., s + N - 1 would meet,
  s being the scenario's.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from zfusion.drivers.workers import in_order
from zfusion.errors import InputError
from zfusion.methods.ensemble import Ensemble, copies_at_once
from zfusion.methods.layout import Bools
from zfusion.methods.neighbourhood import StepModels
from zfusion.model.scenario import Scenario
from zfusion.model.statistics import prior_moments, step_models
from zfusion.model.types import Array, NodeId
from zfusion.studies.certainty import certainty
from zfusion.studies.enumeration import ByNode, exact_means
from zfusion.studies.fates import Fate, covered, fate_of, method_network
from zfusion.studies.intervals import t_quantile

CONFIDENCE = 0.95

TOGETHER = 64
"""Realisations in one pass at most: more are hardly faster, and progress is told after each pass."""

WORTH_PROCESSES = 20_000
"""Realisations times steps times nodes from which on processes share the work: to start one takes a second."""

Progress = Callable[[int], None]
"""Told how many more realisations are done."""


@dataclass(frozen=True)
class Mean:
    """Mean error covariances of one stage of all nodes, steps 0, 1, ..."""

    covariance: Array
    """(steps + 1, m, nx, nx); NaN where there is no estimate in any realisation."""
    low: Array
    high: Array
    """Bounds of the mean of its trace, (steps + 1, m), with `CONFIDENCE`; equal to it where it is exact."""
    exact_steps: tuple[int, ...]
    """For each node, up to which step the mean is exact."""


@dataclass(frozen=True)
class UnderLinks:
    """The mean error covariances of a scenario under its links."""

    ids: tuple[NodeId, ...]
    samples: int
    """Realisations of the links; 1 where that is all there are."""
    intermediate: Mean
    distributed: Mean

    @property
    def exact(self) -> bool:
        """Whether nothing is left to chance."""
        return self.samples == 1


def under_links(scenario: Scenario, samples: int, *, jobs: int = 1, progress: Progress | None = None) -> UnderLinks:
    """The mean error covariances under the scenario's links, faults and deadlines, from `samples` >= 2 realisations.

    The same whatever `jobs`, the number of processes. For a method of one stage, `distributed` is `intermediate`.
    InputError for a method of which errors cannot be predicted so, or links that cannot be had.
    """
    if samples < 2:
        raise InputError(f"samples: expected 2 or more, for an interval (is {samples})")
    covered(scenario)
    known = certainty(scenario)
    ids = method_network(scenario).ids
    if known is not None and known.complete:
        moments = moments_of(scenario, [known.fate])
        all_steps = (scenario.steps,) * len(ids)
        return UnderLinks(ids, 1, *(part.mean(all_steps) for part in moments))
    parts = _sampled(scenario, range(scenario.seed, scenario.seed + samples), jobs, progress)
    none = (0,) * len(ids)
    means = [part.mean(none) for part in parts]
    if known is not None:
        exact = exact_means(scenario, known)
        means = [_with_exact(mean, by_node) for mean, by_node in zip(means, exact, strict=True)]
    return UnderLinks(ids, samples, *means)


@dataclass
class Moments:
    """Running mean of covariances, and mean and scatter of their traces, over realisations."""

    shape: tuple[int, ...]
    """(steps + 1, m, nx, nx)."""
    count: Array = field(init=False)
    covariance: Array = field(init=False)
    trace: Array = field(init=False)
    scatter: Array = field(init=False)
    """Sum of squared deviations of the traces from their mean."""

    def __post_init__(self) -> None:
        self.count, self.trace, self.scatter = (np.zeros(self.shape[:2]) for _ in range(3))
        self.covariance = np.zeros(self.shape)

    def add(self, step: int, P: Array, made: Bools) -> None:
        """Take in the covariances of one step, (copies, m, nx, nx), those that there are, (copies, m)."""
        other = Moments((1, *self.shape[1:]))
        other.count[0] = made.sum(axis=0)
        divisor = np.maximum(other.count[0], 1)
        weight = made / divisor
        other.covariance[0] = np.einsum("cm,cmab->mab", weight, P)
        trace = np.einsum("cmaa->cm", P)
        other.trace[0] = (weight * trace).sum(axis=0)
        other.scatter[0] = (made * (trace - other.trace[0]) ** 2).sum(axis=0)
        self._merge(slice(step, step + 1), other)

    def merge(self, other: Moments) -> None:
        """Take in the moments of other realisations."""
        self._merge(slice(None), other)

    def mean(self, exact_steps: tuple[int, ...]) -> Mean:
        """Mean and interval, by Student's t; without scatter where there was one realisation."""
        absent = self.count == 0
        covariance = np.where(absent[..., None, None], np.nan, self.covariance)
        trace = np.where(absent, np.nan, self.trace)
        quantiles = {n: t_quantile((1 + CONFIDENCE) / 2, int(n) - 1) for n in np.unique(self.count) if n > 1}
        quantile = np.vectorize(lambda n: quantiles.get(n, 0.0), otypes=[np.float64])(self.count)
        half = quantile * np.sqrt(self.scatter / (np.maximum(self.count - 1, 1) * np.maximum(self.count, 1)))
        return Mean(covariance, trace - half, trace + half, exact_steps)

    def _merge(self, rows: slice, other: Moments) -> None:
        """Chan, Golub, LeVeque: Updating formulae for computing sample variances, 1979."""
        total = self.count[rows] + other.count
        share = np.divide(other.count, total, out=np.zeros_like(total), where=total > 0)
        shift = other.trace - self.trace[rows]
        self.scatter[rows] += other.scatter + shift**2 * self.count[rows] * share
        self.trace[rows] += share * shift
        self.covariance[rows] += share[..., None, None] * (other.covariance - self.covariance[rows])
        self.count[rows] = total


def moments_of(scenario: Scenario, fates: Sequence[Fate]) -> tuple[Moments, Moments]:
    """Of the intermediate and the distributed covariances, over some realisations of the scenario's network."""
    network, system = method_network(scenario), scenario.system()
    m, copies = len(network.ids), len(fates)
    parts = tuple(Moments((scenario.steps + 1, m, system.nx, system.nx)) for _ in range(2))
    start = np.broadcast_to(system.initial_covariance, (copies, m, system.nx, system.nx))
    for part in parts:
        part.add(0, start, np.ones((copies, m), dtype=np.bool_))
    for k, (intermediate, distributed) in enumerate(covariances(scenario, fates), start=1):
        made = np.array([fate.made[k - 1] for fate in fates])
        parts[0].add(k, intermediate, made)
        parts[1].add(k, distributed, made)
    return parts[0], parts[1]


def covariances(scenario: Scenario, fates: Sequence[Fate]) -> Iterator[tuple[Array, Array]]:
    """For each step from 1 on, P of the intermediate and of the distributed estimates, each (fates, m, nx, nx).

    Those of nodes that are not there mean nothing (`Fate.made`).
    """
    network, system = method_network(scenario), scenario.system()
    ensemble = Ensemble(system, network.neighbourhoods, len(fates), fusing=network.ids)
    used, told, begins = (np.array([getattr(fate, name) for fate in fates]) for name in ("used", "told", "begins"))
    late = _late(fates)
    models, initial = StepModels(lambda: step_models(system, network.ids)), prior_moments(system)
    states, window = {0: ensemble.state}, scenario.timing.revised_steps
    for k in range(1, scenario.steps + 1):
        first = k
        for copy, step, arc in late.get(k, ()):  # what came late: back to its step, and forward again
            used[copy, step - 1, arc] = True
            first = min(first, step)
        for step in range(first, k + 1):
            ensemble.state = states[step - 1]
            if begins[:, step - 1].any():
                ensemble.forget(begins[:, step - 1], models.at(step - 1)[1] if step > 1 else initial)
            ensemble.advance(models.at(step)[0], used[:, step - 1])
            states[step] = ensemble.state
        states.pop(k - window - 1, None)
        yield ensemble.intermediate, ensemble.fused(told[:, k - 1], models.at(k)[1])


def _late(fates: Sequence[Fate]) -> Mapping[int, Sequence[tuple[int, int, int]]]:
    """By the step at which it is taken in: (fate, step of the measurement, arc)."""
    late: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for copy, fate in enumerate(fates):
        for at, step, arc in fate.taken:
            late[at].append((copy, step, arc))
    return late


def _sampled(scenario: Scenario, seeds: Sequence[int], jobs: int, progress: Progress | None) -> tuple[Moments, Moments]:
    """The moments over the seeds, added up in one order whoever computes them."""
    size = max(1, min(TOGETHER, copies_at_once(scenario.system(), method_network(scenario).neighbourhoods)))
    shares = [seeds[n : n + size] for n in range(0, len(seeds), size)]
    work = len(seeds) * scenario.steps * len(scenario.ids)
    jobs = min(jobs, len(shares)) if work >= WORTH_PROCESSES else 1
    parts = None
    for share, done in zip(shares, in_order(partial(_moments_of_seeds, scenario), shares, jobs), strict=True):
        if parts is None:
            parts = done
        else:
            for part, more in zip(parts, done, strict=True):
                part.merge(more)
        if progress is not None:
            progress(len(share))
    assert parts is not None  # there is a seed
    return parts


def _moments_of_seeds(scenario: Scenario, seeds: Sequence[int]) -> tuple[Moments, Moments]:
    return moments_of(scenario, [fate_of(scenario.with_overrides(seed=seed)) for seed in seeds])


def _with_exact(mean: Mean, by_node: ByNode) -> Mean:
    """The sampled means with the exact ones in their place, as far as these go."""
    covariance, low, high = mean.covariance.copy(), mean.low.copy(), mean.high.copy()
    for position, exact in enumerate(by_node):
        rows = slice(1, 1 + len(exact))
        covariance[rows, position] = exact
        low[rows, position] = high[rows, position] = np.einsum("kaa->k", exact)
    return Mean(covariance, low, high, tuple(map(len, by_node)))
