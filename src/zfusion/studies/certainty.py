"""Which messages of a scenario are certain to arrive in time, or certain not to, whatever is drawn for the links.

Used sets follow from what the real nodes do between the extremes: in steps that have times and under deadlines, a
message that takes longer only ever makes others later. So where all delays at their shortest and all at their longest
give the same used sets, all delays in between do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

import numpy as np

from zfusion.links import Edge
from zfusion.links.rules import Rules
from zfusion.links.traces import read_trace
from zfusion.methods import chosen
from zfusion.methods.ensemble import Arcs
from zfusion.model.scenario import Scenario
from zfusion.model.schema.links import (
    BurstLoss,
    EdgeLinks,
    MixtureDelay,
    NormalDelay,
    TraceDelay,
    UniformDelay,
)
from zfusion.model.types import Array
from zfusion.studies.fates import Fate, fate_of, method_network

Place = tuple[Edge, str]
"""An edge and a stage."""

Bounds = tuple[float, float]
"""The shortest and the longest that a delay can be, in seconds."""


@dataclass(frozen=True)
class Certainty:
    """What is known of the fate of all messages without drawing anything."""

    fate: Fate
    """Of the messages if none is lost by chance."""
    used: Array
    """The probability that the receiver uses the measurement, (steps, arcs)."""
    told: Array
    """The probability that it fuses the intermediate estimate, (steps, arcs)."""

    @property
    def complete(self) -> bool:
        """Whether nothing at all is left to chance."""
        return not any(((p > 0) & (p < 1)).any() for p in (self.used, self.told))


def certainty(scenario: Scenario) -> Certainty | None:
    """What is certain, and with which probability every single message is lost, independently of all others.

    None where messages depend on one another by chance: losses in bursts, switching at random, delays that may or may
    not be too long, queues.
    """
    rules = _rules(scenario)
    chance = [rule for rule in rules.values() if _is_random(rule)]
    if not chance and not _switches_at_random(scenario):
        fate = fate_of(scenario)
        return Certainty(fate, fate.used.astype(np.float64), fate.told.astype(np.float64))
    if _switches_at_random(scenario) or not _is_monotone(scenario, rules):
        return None
    bounds = {place: _bounds(rule.delay, scenario) for place, rule in rules.items()}
    if not all(isfinite(longest) for _, longest in bounds.values()):
        return None
    loss = {place: _loss(rule) for place, rule in rules.items()}
    first = chosen(scenario).stages[0].name
    best = fate_of(_extreme(scenario, lambda place: (bounds[place][0], float(loss[place] == 1))))
    slow = fate_of(_extreme(scenario, lambda place: (bounds[place][1], float(loss[place] == 1))))
    bare = fate_of(
        _extreme(
            scenario,
            lambda place: (bounds[place][1], float(loss[place] > 0 if place[1] == first else loss[place] == 1)),
        )
    )
    if not (_same(best, slow) and np.array_equal(best.told, bare.told)):
        return None
    return Certainty(best, *_probabilities(scenario, best, loss))


def _probabilities(scenario: Scenario, best: Fate, loss: Mapping[Place, float]) -> tuple[Array, Array]:
    arcs = Arcs(method_network(scenario).neighbourhoods)
    stages = [stage.name for stage in chosen(scenario).stages]
    kept = {
        stage: np.tile([1.0 if i == j else 1.0 - loss[(j, i), stage] for i, j in arcs.pairs], (scenario.steps, 1))
        for stage in stages
    }
    for rule in scenario.links.messages:  # what is said of a message by name is not left to chance
        arc = arcs.place.get((rule.receiver, rule.sender))
        if arc is not None and rule.stage in kept:
            kept[rule.stage][[step - 1 for step in rule.steps if step <= scenario.steps], arc] = 1.0
    return best.used * kept[stages[0]], best.told * kept[stages[-1]]


def _rules(scenario: Scenario) -> dict[Place, Rules]:
    network = method_network(scenario)
    return {
        ((j, i), stage.name): Rules.of(scenario.links, (j, i), stage.name)
        for i in network.ids
        for j in network.neighbours(i)
        for stage in chosen(scenario).stages
        if i != j
    }


def _is_random(rules: Rules) -> bool:
    delay = rules.delay
    fixed = isinstance(delay, float) or (isinstance(delay, TraceDelay) and delay.order == "as_recorded")
    return not fixed or _loss(rules) not in (0.0, 1.0) or (rules.bandwidth is not None and 0 < rules.duplicate < 1)


def _loss(rules: Rules) -> float:
    """The probability of loss; NaN for bursts, which make losses depend on one another."""
    if not isinstance(rules.loss, BurstLoss):
        return rules.loss
    states = rules.loss.gilbert_elliott
    return states.loss_good if states.loss_good == states.loss_bad else float("nan")


def _switches_at_random(scenario: Scenario) -> bool:
    topology = scenario.links.topology
    return topology is not None and topology.markov is not None


def _is_monotone(scenario: Scenario, rules: dict[Place, Rules]) -> bool:
    """Whether a message that comes later, or not at all, never makes another one come in time, or a queue shorter."""
    timing = scenario.timing
    plain = all(rule.bandwidth is None and _loss(rule) == _loss(rule) for rule in rules.values())
    return plain and timing.period_ns is not None and timing.late == "drop"


def _bounds(delay: Any, scenario: Scenario) -> Bounds:
    if isinstance(delay, float):
        return delay, delay
    low, high = _bounds_of_law(delay, scenario)
    return low + delay.shift, high + delay.shift


def _bounds_of_law(delay: Any, scenario: Scenario) -> Bounds:
    match delay:
        case UniformDelay():
            return delay.low, delay.high
        case NormalDelay(sd=0.0):
            return (max(0.0, delay.mean),) * 2
        case TraceDelay():
            values = read_trace(str(scenario.absolute(delay.trace)), delay.column)
            return float(values.min()), float(values.max())
        case MixtureDelay():
            parts = [_bounds(component.delay, scenario) for component in delay.mixture]
            return min(low for low, _ in parts), max(high for _, high in parts)
    return 0.0, inf


def _extreme(scenario: Scenario, rule: Callable[[Place], tuple[float, float]]) -> Scenario:
    """The scenario with the delay and the loss, in place of what is drawn, that the rule gives an edge and stage."""
    exceptions = []
    for (edge, stage), rules in _rules(scenario).items():
        delay, loss = rule((edge, stage))
        spec = {"from": edge[0], "to": edge[1], "stages": stage, "delay": delay, "loss": loss, "reorder": rules.reorder}
        exceptions.append(EdgeLinks.model_validate({**spec, "duplicate": 0.0}))
    links = scenario.links.model_copy(update={"edges": tuple(exceptions)})
    return scenario.model_copy(update={"links": links})


def _same(one: Fate, other: Fate) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("used", "told", "made", "begins"))
