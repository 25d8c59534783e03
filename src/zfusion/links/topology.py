"""Which edges there are at a step, where the topology switches."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable

from zfusion.links.chain import Chain
from zfusion.model.network import Edge
from zfusion.model.scenario import Scenario
from zfusion.model.schema.links import SwitchSpec
from zfusion.model.streams import BLOCK, Seeds
from zfusion.model.types import NodeId


class Topology:
    """The modes of a scenario's topology, one a step: the same at all nodes, in any process."""

    def __init__(self, scenario: Scenario) -> None:
        """Without `[links.topology]`, all edges of the network are there always."""
        spec = scenario.links.topology
        self._network = scenario.network
        self._carried: list[frozenset[Edge]] = []
        self._mode: Callable[[int], int] = lambda _: 0
        if spec is None:
            return
        ids = tuple(i for sensor in scenario.sensors for i in sensor.members)
        for graph in spec.modes:
            network = graph.network(ids)
            self._carried.append(frozenset((j, i) for i in network.ids for j in network.neighbours(i)))
        if spec.markov is not None:
            seeds = Seeds(scenario.seed)
            chain = Chain(
                spec.markov.initial,
                spec.markov.transition,
                lambda block: seeds.generator("link", "topology", block=block).random(BLOCK).tolist(),
            )
            self._mode = chain
        else:
            self._mode = _scheduled(spec.schedule or ())

    @property
    def switches(self) -> bool:
        """Whether there are modes at all."""
        return bool(self._carried)

    def mode(self, step: int) -> int:
        """The number of the mode at a step >= 1; 0 where the topology does not switch."""
        return self._mode(step)

    def carries(self, edge: Edge, step: int) -> bool:
        """Whether the edge is there at a step.

        Edges that are not the network's, which a method may have all the same, are always there.
        """
        if not self._carried or not self._is_known(*edge):
            return True
        return edge in self._carried[self._mode(step)]

    def _is_known(self, sender: NodeId, receiver: NodeId) -> bool:
        return sender in self._network.neighbours(receiver)


def _scheduled(switches: tuple[SwitchSpec, ...]) -> Callable[[int], int]:
    steps, modes = [switch.step for switch in switches], [switch.mode for switch in switches]
    return lambda step: modes[bisect_right(steps, step) - 1]
