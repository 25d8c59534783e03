"""What every world does for a node, wherever its messages come from: making it, and keeping account of it."""

from __future__ import annotations

from collections.abc import Collection
from typing import cast

from zfusion.drivers.metrics import Errors, Latencies, NodeReport, Pace, edge_report, told_estimate
from zfusion.drivers.sources import Source
from zfusion.methods import METHODS, Setting
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.node import Node, Patience
from zfusion.stages import TRUTH, TRUTH_SENDER, Message


def make_node(
    scenario: Scenario, graph: Network, node: NodeId, *, born: int = 1, expected: Collection[NodeId] | None = None
) -> Node:
    """A node of the scenario at the beginning of a life; `graph` is the method's.

    `born` and `expected` as for `Node`. KeyError for a node that is not there.
    """
    method = METHODS[scenario.method.name]
    return Node(
        node,
        graph.neighbours(node),
        method(Setting(node, scenario.system(), graph, born)),
        patience_of(scenario),
        born=born,
        expected=expected,
    )


def patience_of(scenario: Scenario) -> Patience:
    """How long the nodes of the scenario wait: until the stages' deadlines, or so long in each."""
    timing = scenario.timing
    stages = [stage.name for stage in METHODS[scenario.method.name].stages]
    if timing.period_ns is None:
        return Patience((timing.timeout_ns,) * len(stages), paced=False)
    return Patience(tuple(timing.deadline_ns(stage) for stage in stages), paced=True)


def truth_message(x: Array, step: int, seq: int, t_ns: int) -> Message:
    """What tells that the true state at `step` was x, (nx,)."""
    return Message(TRUTH_SENDER, step, TRUTH.name, seq, 1, t_ns, {"x": x})


class Account:
    """What is measured of one life of a node, beside what the node itself counts."""

    def __init__(self, node: Node, source: Source, begun_ns: int) -> None:
        self.skipped = 0
        """Steps that it did not take because their time was over."""
        self._node, self._source = node, source
        self._begun_ns = begun_ns
        self._errors: dict[str, Errors] = {}
        self._paces = [Pace(begun_ns)]

    def compare(self, message: Message) -> None:
        """Set an estimate, of whatever stage, beside the truth, where that is known."""
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

    def report(self) -> NodeReport:
        """What became of it all so far."""
        node, latencies = self._node, Latencies()
        for pace in self._paces:
            latencies.merge(pace.latencies.sparse())
        return NodeReport(
            node=node.id,
            born=node.born,
            step=node.step,
            completed=node.completed,
            skipped=self.skipped,
            elapsed_s=(max(pace.ended_ns for pace in self._paces) - self._begun_ns) / 1e9,
            sent=dict(node.sent),
            edges=edge_report(node),
            fallbacks=node.fallbacks,
            errors={stage: errors.summary() for stage, errors in self._errors.items()},
            latency=latencies.told(),
            overheard=dict(self._source.counters),
            estimate=told_estimate(node),
            settled=self._paces[-1].told() if len(self._paces) > 1 else {},
        )

    def last_words(self) -> dict[str, object]:
        """What a node tells when it leaves."""
        report = self.report()
        return {"sent": report.sent, "edges": report.edges, "completed": report.completed, "skipped": report.skipped}
