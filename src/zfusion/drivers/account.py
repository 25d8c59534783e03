"""What every world does for a node, wherever its messages come from: making it, and keeping account of it."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import cast

from zfusion.drivers.designs import design_of
from zfusion.drivers.meters import Meter
from zfusion.drivers.metrics import Errors, Latencies, NodeReport, Pace, edge_report, told_estimate
from zfusion.drivers.sources import Source
from zfusion.links import Topology
from zfusion.links.punctuality import arrival_probabilities
from zfusion.methods import Setting, chosen
from zfusion.methods.check import deadline_ns
from zfusion.methods.protocol import Method
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.node import Node, Patience
from zfusion.stages import ARRIVALS, ESTIMATE, INTERMEDIATE, REVISED, TRUTH, TRUTH_SENDER, Message
from zfusion.status import Counts

COMPARED = (INTERMEDIATE.name, ESTIMATE.name, REVISED.name)
"""Stages whose x is an estimate of the state at their step."""

MakeMethod = Callable[[Setting], Method]
"""What a node computes with, made anew for each of its lives."""


def make_node(
    scenario: Scenario,
    graph: Network,
    node: NodeId,
    *,
    born: int = 1,
    expected: Collection[NodeId] | None = None,
    method: MakeMethod | None = None,
) -> Node:
    """A node of the scenario at the beginning of a life; `graph` is the method's.

    `born` and `expected` as for `Node`; `method` in the place of the scenario's, of the same stages. KeyError for a
    node that is not there.
    """
    method = method or chosen(scenario)
    window = scenario.timing.revised_steps
    return Node(
        node,
        graph.neighbours(node),
        method(setting_of(scenario, graph, node, born)),
        patience_of(scenario),
        born=born,
        expected=expected,
        window=window,
    )


def setting_of(scenario: Scenario, graph: Network, node: NodeId, born: int) -> Setting:
    """What the method of a node may know at the beginning of a life; `graph` is the method's."""
    return Setting(
        node,
        scenario.system(),
        graph,
        born,
        scenario.timing.revised_steps,
        design=design_of(scenario),
        mode=Topology(scenario).mode,
        punctuality=lambda most: arrival_probabilities(scenario, node, most),
    )


def patience_of(scenario: Scenario) -> Patience:
    """How long the nodes of the scenario wait: until the stages' deadlines, or so long in each."""
    timing = scenario.timing
    stages = [stage.name for stage in chosen(scenario).stages]
    if timing.period_ns is None or timing.late == "wait":
        return Patience((timing.timeout_ns,) * len(stages), paced=False)
    return Patience(tuple(deadline_ns(scenario, stage) for stage in stages), paced=True)


def truth_message(x: Array, step: int, seq: int, t_ns: int) -> Message:
    """What tells that the true state at `step` was x, (nx,)."""
    return Message(TRUTH_SENDER, step, TRUTH.name, seq, 1, t_ns, {"x": x})


class Account:
    """What is measured of one life of a node, beside what the node itself counts."""

    def __init__(
        self, node: Node, source: Source, begun_ns: int, *, stages: Sequence[str] = (), marked_every: int = 1
    ) -> None:
        """`stages` are those whose messages are exchanged; `marked_every` as for `Meter`."""
        self.skipped = 0
        """Steps that it did not take because their time was over."""
        self.meter = Meter(node.neighbours, stages, marked_every=marked_every)
        self._node, self._source = node, source
        self._begun_ns = begun_ns
        self._errors: dict[str, Errors] = {}
        self._paces = [Pace(begun_ns)]

    def compare(self, message: Message) -> None:
        """Set an estimate beside the truth, where that is known; what else a method calls x is none of the state."""
        if message.stage not in COMPARED:
            return
        truth = self._source.truth(message.step)
        if truth is None:
            return
        errors = self._errors.get(message.stage)
        if errors is None:
            errors = self._errors[message.stage] = Errors()
        errors.add(cast(Array, message.fields["x"]) - truth, cast("Array | None", message.fields.get("P")))

    def settle(self, now_ns: int) -> None:
        """From here on the pace is told apart, too: what a swarm does once it is warm."""
        self._paces.append(Pace(now_ns))

    def complete(self, now_ns: int, latency_ns: int) -> None:
        """A step was completed, so long after its measurement."""
        self._paces[-1].add(now_ns, latency_ns)

    def arrivals(self, now_ns: int, *, ended: bool = False) -> Iterator[Message]:
        """The messages that tell the latencies measured since the last ones; none most of the time, see `Meter`."""
        node = self._node
        for data in self.meter.batch(ended=ended):
            seq = node.sent[ARRIVALS.name]
            node.sent[ARRIVALS.name] = seq + 1
            yield Message(node.id, max(node.step, node.born), ARRIVALS.name, seq, node.born, now_ns, {"data": data})

    def latencies(self) -> Latencies:
        """From measurement to estimate, of all steps so far."""
        latencies = Latencies()
        for pace in self._paces:
            latencies.merge(pace.latencies.sparse())
        return latencies

    def report(self) -> NodeReport:
        """What became of it all so far."""
        node = self._node
        return NodeReport(
            node=node.id,
            born=node.born,
            step=node.step,
            completed=node.completed,
            skipped=self.skipped,
            elapsed_s=self.elapsed_s,
            sent=dict(node.sent),
            edges=edge_report(node),
            fallbacks=node.fallbacks,
            errors={stage: errors.summary() for stage, errors in self._errors.items()},
            latency=self.latencies().told(),
            overheard=dict(self._source.counters),
            estimate=told_estimate(node),
            settled=self._paces[-1].told() if len(self._paces) > 1 else {},
            measured=self.meter.told(),
            incidents=dict(node.incidents),
        )

    @property
    def elapsed_s(self) -> float:
        """From the start of its first step to the end of its last."""
        return (max(pace.ended_ns for pace in self._paces) - self._begun_ns) / 1e9

    def counts(self) -> Counts:
        """What was counted so far, for those who look on; cheap."""
        node = self._node
        return Counts(
            host=platform.node(),
            skipped=self.skipped,
            elapsed_s=self.elapsed_s,
            cpu_s=time.process_time(),
            sent=dict(node.sent),
            edges=edge_report(node),
            overheard=dict(self._source.counters),
            incidents=dict(node.incidents),
            waits=self.meter.waits(),
            clocks={},
            queues={},
        )

    def last_words(self) -> dict[str, object]:
        """What a node tells when it leaves."""
        report = self.report()
        counted = {"sent": report.sent, "edges": report.edges, "completed": report.completed, "skipped": report.skipped}
        return {**counted, "budget": self.meter.budgets()}
