"""How late messages come, in steps: with which probability what a node receives in a step is so many steps old.

A node closes a stage a time D after each step is due, steps are T apart, and a message is sent when its step is due. Of
what comes between two closings the newest message counts. With F_l = Prob{delay <= D + l T}, q = 1 - loss:

    messages overtake     p_j = q (F_j - F_{j-1}) Π_{l<j} (1 - q (F_l - F_{l-1}))
    none overtakes        p_j = q g_j [ F_j Π_{l>j} a_l - F_{j-1} Π_{l>=j} a_l ],   a_l = 1 - q + q F_l,
                          g_j = (1-q)^j + Σ_{i=1..j} (1-q)^{i-1} q (1 - F_{j-i})     (the next one is later still)

exactly, for independent delays. Where there is no such formula (bursts of losses, bandwidth, duplicates, switching
topologies, gamma laws, what a recording measured) the links are asked about some thousand messages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import lru_cache
from math import erf, exp, log, sqrt
from typing import Any, NamedTuple

import numpy as np

from zfusion.links.measured import MeasuredLinks
from zfusion.links.network import LinkNetwork, links_of
from zfusion.links.protocol import EPOCH_NS, Edge, Link
from zfusion.links.rules import Rules
from zfusion.links.traces import read_trace
from zfusion.methods import chosen
from zfusion.methods.check import deadline_ns
from zfusion.model.scenario import Scenario
from zfusion.model.schema.links import (
    BurstLoss,
    ExponentialDelay,
    LognormalDelay,
    MixtureDelay,
    NormalDelay,
    ParetoDelay,
    TraceDelay,
    UniformDelay,
)
from zfusion.model.types import NodeId
from zfusion.recording.reader import Recording
from zfusion.stages import Message

SAMPLES = 4096
"""Messages that the links are asked about: probabilities are right to 0.008 (one sigma) or better."""

OLDEST = 10_000
"""Steps after which a message that has not come counts as one that never does."""

KEPT = 256
"""Nodes of which a process keeps the probabilities: those of a swarm."""

SAME = 1e-16
"""A probability that is nearer to 1 is 1."""

Probabilities = tuple[float, ...]
"""p_0, ..., p_L."""

Cdf = Callable[[int], float]
"""Time in ns -> the probability that a delay is not longer."""


class Pace(NamedTuple):
    """When a stage is closed."""

    period_ns: int
    deadline_ns: int
    """After its step was due."""

    @classmethod
    def of(cls, scenario: Scenario) -> Pace:
        """Of the first stage of the scenario's method; nodes that wait are taken to wait as long as they may."""
        timing = scenario.timing
        if timing.period_ns is None or timing.late == "wait":
            return cls(timing.timeout_ns, timing.timeout_ns)
        return cls(timing.period_ns, deadline_ns(scenario, chosen(scenario).stages[0].name))


@lru_cache(maxsize=KEPT)
def arrival_probabilities(scenario: Scenario, node: NodeId, most: int) -> Mapping[NodeId, Probabilities]:
    """p_0 to p_`most` of the measurements of each neighbour, as the scenario's links have it, without its faults.

    What is drawn for the run itself has no part in it. InputError for a trace or recording that cannot be read.
    """
    graph = chosen(scenario).network(scenario.network)
    edges = [(j, node) for j in graph.neighbours(node) if j != node]
    if scenario.links.recorded is not None:
        return _of_recorded(scenario, edges, most)
    found, link = {}, None
    for edge in edges:
        exact = _exact(scenario, edge, most)
        if exact is None:
            other = scenario.model_copy(update={"seed": scenario.seed + 1, "faults": ()})
            link = link or links_of(other)
            exact = sampled(other, link, edge, range(1, SAMPLES + 1), most)
        found[edge[0]] = exact
    return found


def _of_recorded(scenario: Scenario, edges: list[Edge], most: int) -> dict[NodeId, Probabilities]:
    assert scenario.links.recorded is not None  # the caller has looked
    with Recording.open(scenario.absolute(scenario.links.recorded.recording)) as recording:
        return of_measured(scenario, MeasuredLinks.of(recording), edges, most)


def of_measured(
    scenario: Scenario, measured: MeasuredLinks, edges: list[Edge], most: int
) -> dict[NodeId, Probabilities]:
    """The same as frequencies, from how the measurements of a run that was recorded came."""
    link, stage = LinkNetwork(scenario, measured), chosen(scenario).stages[0].name
    last = max((step for (_, of), steps in measured.passages.items() if of == stage for step in steps), default=1)
    return {edge[0]: sampled(scenario, link, edge, range(1, last + 1), most) for edge in edges}


def sampled(scenario: Scenario, link: Link, edge: Edge, steps: range, most: int) -> Probabilities:
    """The same for one edge as frequencies, over these steps."""
    pace, sender = Pace.of(scenario), edge[0]
    stage, y = chosen(scenario).stages[0].name, np.zeros(scenario.system().by_id[sender].ny)
    newest: dict[int, int] = {}
    for seq, step in enumerate(steps):
        due = EPOCH_NS + step * pace.period_ns
        arrivals = link(edge, Message(sender, step, stage, seq, 1, due, {"y": y}), due)
        if arrivals:
            late = max(0, -(-(min(arrivals) - due - pace.deadline_ns) // pace.period_ns))
            newest[step + late] = max(step, newest.get(step + late, 0))
    ages = Counter(at - step for at, step in newest.items() if at in steps)
    return tuple(ages[j] / len(steps) for j in range(most + 1))


def _exact(scenario: Scenario, edge: Edge, most: int) -> Probabilities | None:
    """By formula; None where there is none."""
    links = scenario.links
    rules = Rules.of(links, edge, chosen(scenario).stages[0].name)
    if (
        isinstance(rules.loss, BurstLoss)
        or rules.duplicate
        or rules.bandwidth is not None
        or links.topology is not None
    ):
        return None
    cdf = _cdf(rules.delay, scenario)
    if cdf is None:
        return None
    pace = Pace.of(scenario)
    arrived = [cdf(pace.deadline_ns + age * pace.period_ns) for age in range(most + 1)]
    while not rules.reorder and arrived[-1] < 1 - SAME and len(arrived) < OLDEST:
        arrived.append(cdf(pace.deadline_ns + len(arrived) * pace.period_ns))
    given = (arrived, 1.0 - rules.loss)
    return _overtaking(*given) if rules.reorder else _in_order(*given, most)


def _overtaking(arrived: list[float], q: float) -> Probabilities:
    comes = q * np.diff(arrived, prepend=0.0)
    newer = np.concatenate(([1.0], np.cumprod(1 - comes)[:-1]))
    return tuple((comes * newer).tolist())


def _in_order(arrived: list[float], q: float, most: int) -> Probabilities:
    F, lost = np.array(arrived), 1.0 - q
    passed = lost + q * F
    older = np.append(np.cumprod(passed[::-1])[::-1], 1.0)
    """Π_{l>=j} a_l."""
    found = []
    for j in range(most + 1):
        blocked = lost**j + sum(lost ** (i - 1) * q * (1 - F[j - i]) for i in range(1, j + 1))
        before = F[j - 1] * older[j] if j else 0.0
        found.append(float(max(0.0, q * blocked * (F[j] * older[j + 1] - before))))
    return tuple(found)


def _cdf(law: Any, scenario: Scenario) -> Cdf | None:
    """The distribution function of a law of delays; None for one without a simple one."""
    if isinstance(law, float | int):
        return lambda t: float(round(law * 1e9) <= t)
    if isinstance(law, MixtureDelay):
        return _mixture(law, scenario)
    shift = round(law.shift * 1e9)
    if isinstance(law, TraceDelay):
        if law.order != "random":
            return None
        recorded = np.rint(read_trace(str(scenario.absolute(law.trace)), law.column) * 1e9)
        return lambda t: float(np.mean(recorded <= t - shift))
    own = _drawn(law)
    return None if own is None else lambda t: own((t - shift) / 1e9) if t >= shift else 0.0


def _mixture(law: MixtureDelay, scenario: Scenario) -> Cdf | None:
    parts = [(component.weight, _cdf(component.delay, scenario)) for component in law.mixture]
    total, shift = sum(weight for weight, _ in parts), round(law.shift * 1e9)
    known = [(weight / total, cdf) for weight, cdf in parts if cdf is not None]
    if len(known) < len(parts):
        return None
    return lambda t: sum(weight * cdf(t - shift) for weight, cdf in known)


def _drawn(law: Any) -> Callable[[float], float] | None:
    """Of seconds, >= 0."""
    match law:
        case UniformDelay(low=low, high=high):
            return lambda s: float(s >= low) if high == low else min(max((s - low) / (high - low), 0.0), 1.0)
        case NormalDelay(mean=mean, sd=sd):
            return lambda s: _normal(s - mean, sd)
        case LognormalDelay(median=median, sigma=sigma):
            return lambda s: _normal(log(s / median), sigma) if s > 0 else 0.0
        case ExponentialDelay(mean=mean):
            return lambda s: 1.0 - exp(-s / mean)
        case ParetoDelay(minimum=minimum, shape=shape):
            return lambda s: 1.0 - (minimum / s) ** shape if s > minimum else 0.0
    return None


def _normal(deviation: float, sd: float) -> float:
    return float(deviation >= 0) if sd == 0 else 0.5 * (1.0 + erf(deviation / (sd * sqrt(2.0))))


__all__ = ["Pace", "Probabilities", "arrival_probabilities", "of_measured", "sampled"]
