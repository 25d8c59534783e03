"""What becomes of the messages of one stage on one edge, drawn by blocks of steps.

What is drawn for a message is a function of the scenario's seed, the edge, the stage and the step: each purpose (delay,
loss, ...) has a generator of its own for every block, so that nothing depends on what else is asked for, nor when.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from zfusion.links.delays import delays_ns
from zfusion.links.losses import Probabilities, loss_probabilities
from zfusion.links.protocol import Edge
from zfusion.links.rules import PACKETS, Rules
from zfusion.links.timeline import Timeline
from zfusion.links.topology import Topology
from zfusion.links.traces import read_trace
from zfusion.model.scenario import Scenario
from zfusion.model.schema.base import Spec
from zfusion.model.schema.links import TraceDelay
from zfusion.model.schema.run import NANOSECONDS
from zfusion.model.streams import BLOCK, Recent, Seeds
from zfusion.model.types import Array


class Measured(Protocol):
    """Latencies that were measured, which stand in the place of what would be drawn."""

    def latency_ns(self, edge: Edge, stage: str, step: int) -> int | None:
        """How long the message was on its way; None if it did not arrive."""


class Block(NamedTuple):
    """What becomes of the messages of BLOCK steps, one entry a step."""

    delays: list[tuple[int, ...]]
    """In nanoseconds, one for each time that the message comes; empty: it is lost."""
    cut: list[bool] | None
    """Whether the link carries nothing; None: it always does."""


class Lane:
    """The messages of one stage on one edge."""

    def __init__(self, rules: Rules, blocks: Callable[[int], Block]) -> None:
        self.rules = rules
        self._blocks = blocks
        self._number = -1
        self._block = Block([], None)

    def fate(self, step: int) -> tuple[int, ...] | None:
        """The delays of what comes of the message; empty if it is lost, None if the link is cut."""
        number, n = divmod(step, BLOCK)
        if number != self._number:
            self._number, self._block = number, self._blocks(number)
        delays, cut = self._block
        return None if cut is not None and cut[n] else delays[n]


class Lanes:
    """Makes the lanes of a scenario's links.

    Raises InputError for a trace that cannot be read.
    """

    def __init__(self, scenario: Scenario, measured: Measured | None) -> None:
        self.links = scenario.links
        self.timeline, self.topology = Timeline(scenario), Topology(scenario)
        self._seeds = Seeds(scenario.seed)
        self._measured = measured
        self._traces: dict[tuple[str, str | None], Array] = {}
        self._absolute = scenario.absolute
        for trace in _traces_in(self.links):
            self._trace(trace.trace, trace.column)

    def lane(self, edge: Edge, stage: str) -> Lane:
        """What an edge does to the messages of a stage, cuts included."""
        rules = Rules.of(self.links, edge, stage)
        delays = self._delays_of(rules, edge, stage)
        cuts = self.timeline.cuts(edge)
        named = self._named(edge, stage)

        def block(number: int) -> Block:
            steps = range(number * BLOCK, (number + 1) * BLOCK)
            cut = None
            if cuts or self.topology.switches:
                carries = partial(self.topology.carries, edge)
                cut = [any(p.at(step) for p in cuts) or not carries(max(step, 1)) for step in steps]
            drawn = delays(number)
            return Block([named.get(k, fate) for k, fate in zip(steps, drawn, strict=True)] if named else drawn, cut)

        return Lane(rules, Recent(block))

    def _named(self, edge: Edge, stage: str) -> dict[int, tuple[int, ...]]:
        """What becomes of the messages that are named one by one, by step."""
        return {
            step: () if rule.delay is None else (round(rule.delay * NANOSECONDS),)
            for rule in self.links.messages
            if (rule.sender, rule.receiver, rule.stage) == (*edge, stage)
            for step in rule.steps
        }

    def packets(self, edge: Edge) -> Lane:
        """What an edge does to packets, by their number; without cuts, which go by the step."""
        rules = Rules.of(self.links, edge, PACKETS)
        delays = self._delays_of(rules, edge, PACKETS)
        return Lane(rules, Recent(lambda number: Block(delays(number), None)))

    def _delays_of(self, rules: Rules, edge: Edge, stage: str) -> Callable[[int], list[tuple[int, ...]]]:
        measured = self._measured
        if measured is not None:
            return partial(_measured_delays, measured, edge, stage)
        ends = tuple(map(str, edge))
        of_edge = PACKETS if stage == PACKETS else "state"
        chance = loss_probabilities(
            rules.loss, lambda block: self._seeds.generator("link", of_edge, *ends, block=block).random(BLOCK).tolist()
        )
        return partial(self._draw, rules, chance, (*ends, stage))

    def _draw(self, rules: Rules, chance: Probabilities, place: tuple[str, ...], number: int) -> list[tuple[int, ...]]:
        def generator(purpose: str, *more: str) -> np.random.Generator:
            return self._seeds.generator("link", purpose, *place, *more, block=number)

        delays = delays_ns(rules.delay, number, partial(generator, "delay"), self._trace).tolist()
        fates: list[tuple[int, ...]] = [(delay,) for delay in delays]
        if rules.duplicate:
            twice = (generator("duplicate").random(BLOCK) < rules.duplicate).tolist()
            seconds = delays_ns(rules.delay, number, partial(generator, "second"), self._trace).tolist()
            fates = [(*fate, seconds[n]) if twice[n] else fate for n, fate in enumerate(fates)]
        probability = chance(number)
        if np.any(probability):
            lost = (generator("loss").random(BLOCK) < probability).tolist()
            fates = [() if lost[n] else fate for n, fate in enumerate(fates)]
        return fates

    def _trace(self, path: str, column: str | None) -> Array:
        known = self._traces.get((path, column))
        if known is None:
            known = self._traces[path, column] = read_trace(str(self._absolute(path)), column)
        return known


def _measured_delays(measured: Measured, edge: Edge, stage: str, number: int) -> list[tuple[int, ...]]:
    latencies = (measured.latency_ns(edge, stage, step) for step in range(number * BLOCK, (number + 1) * BLOCK))
    return [() if latency is None else (latency,) for latency in latencies]


def _traces_in(value: object) -> Iterator[TraceDelay]:
    """All traces in a piece of a scenario, however deep."""
    if isinstance(value, TraceDelay):
        yield value
    elif isinstance(value, Spec):
        yield from _traces_in(tuple(getattr(value, name) for name in value.model_fields_set))
    elif isinstance(value, tuple):
        for item in value:
            yield from _traces_in(item)
