"""Who is linked to whom, where everybody listens and whom they dial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from zfusion.methods import chosen
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where a session listens and whom it dials, as Zenoh endpoints (``tcp/127.0.0.1:7450``)."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()


def links_of(scenario: Scenario) -> Sequence[tuple[NodeId, NodeId]]:
    """The pairs of nodes that have a link: the neighbours in the method's graph, or all, as the scenario says."""
    graph = chosen(scenario).network(scenario.network)
    return Network.complete(graph.ids).links() if scenario.transport.mesh == "full" else graph.links()


def linked(scenario: Scenario, node: NodeId) -> tuple[NodeId, ...]:
    """The nodes that `node` has a link with."""
    return tuple(a if b == node else b for a, b in links_of(scenario) if node in (a, b))


def listens_at(scenario: Scenario) -> dict[NodeId, str]:
    """Where every node listens, as the scenario says."""
    return {i: scenario.endpoint(i) for i in scenario.ids}


def dialled(scenario: Scenario, node: NodeId, listens: Mapping[NodeId, str]) -> tuple[str, ...]:
    """Whom `node` dials: of two linked nodes the one with the larger id does, so that there is one link."""
    rank = {i: number for number, i in enumerate(scenario.ids)}
    return tuple(listens[j] for j in linked(scenario, node) if rank[j] < rank[node])


def endpoints_of(
    scenario: Scenario, node: NodeId, listen: Sequence[str] | None = None, connect: Sequence[str] | None = None
) -> Endpoints:
    """Where a node listens and whom it dials: what is given, and else what the scenario says.

    A user's own Zenoh configuration, where the scenario names one, rules alone unless endpoints are given.
    """
    if scenario.transport.zenoh_config and not listen and not connect:
        return Endpoints()
    listens = listens_at(scenario)
    return Endpoints(
        tuple(listen or (listens[node],)),
        dialled(scenario, node, listens) if connect is None else tuple(connect),
    )


def recorder_endpoints(
    scenario: Scenario, connect: Sequence[str] | None = None, listen: Sequence[str] | None = None
) -> Endpoints:
    """Whom the recorder dials: every node, for peers pass nothing on."""
    if scenario.transport.zenoh_config and not listen and not connect:
        return Endpoints()
    return Endpoints(tuple(listen or ()), tuple(connect or listens_at(scenario).values()))
