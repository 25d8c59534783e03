"""Which network it is to be, and why; and what no network of packets can be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from zfusion.errors import InputError, Problem, ScenarioError
from zfusion.links.rules import PACKETS, Rules
from zfusion.links.timeline import Timeline
from zfusion.model.network import Edge
from zfusion.model.scenario import Scenario
from zfusion.swarm.netns import netem

Kind = Literal["tun", "netem"]

INSTEAD = "without --netns the same links are emulated at the receivers"
"""What to do where there can be no namespaces."""


class Choice(NamedTuple):
    """The kind of network, and why it is this one."""

    kind: Kind
    why: str


def check(scenario: Scenario) -> None:
    """ScenarioError for what a network of namespaces cannot be or do."""
    problems = list(_problems(scenario))
    if problems:
        raise ScenarioError("--netns", problems)


def choose(scenario: Scenario, wanted: Kind | None, missing: Callable[[], str | None] = netem.missing) -> Choice:
    """netem where the kernel has it and it can express the links, else TUN devices; or what is `wanted`.

    `missing` says why there can be no netem. InputError where netem is wanted and cannot be.
    """
    if wanted == "tun":
        return Choice("tun", "as asked for")
    why_not = _beyond_netem(scenario)
    if why_not is None:
        reason = missing()
        why_not = None if reason is None else f"there is no netem ({reason})"
    if wanted == "netem" and why_not is not None:
        raise InputError(f"{why_not}; --netns-with tun carries the packets in user space")
    if why_not is None:
        return Choice("netem", "as asked for" if wanted else "the kernel has netem")
    return Choice("tun", why_not)


def edges(scenario: Scenario) -> Iterator[Edge]:
    """All pairs: packets go both ways on every link, whoever listens."""
    return ((a, b) for a in scenario.ids for b in scenario.ids if a != b)


def _beyond_netem(scenario: Scenario) -> str | None:
    if scenario.links.topology is not None:
        return "netem has no switching topology"
    if any(Timeline(scenario).cuts(edge) for edge in edges(scenario)):
        return "netem has no cuts and partitions at steps"
    for a, b in edges(scenario):
        for what in netem.inexpressible(Rules.of(scenario.links, (a, b), PACKETS)):
            return f"netem cannot do {what} (link {a} -> {b})"
    return None


def _problems(scenario: Scenario) -> Iterator[Problem]:
    links = scenario.links
    for n, exception in enumerate(links.edges):
        if exception.stages is not None:
            expected = "expected no stages: packets have none; " + INSTEAD
            yield Problem(f"links.edges[{n}].stages", list(exception.stages), expected)
    if any(Rules.of(links, edge, PACKETS).duplicate for edge in edges(scenario)):
        yield Problem("links.duplicate", links.duplicate, f"expected 0: TCP makes one of two packets; {INSTEAD}")
    if links.recorded is not None:
        expected = f"expected links by their rules: messages were recorded, not packets; {INSTEAD}"
        yield Problem("links.recorded", links.recorded.recording, expected)
    if scenario.timing.period_ns is None:
        if links.topology is not None:
            yield Problem("links.topology", "switching", "expected paced steps: packets go by the time, give a rate")
        for n, fault in enumerate(scenario.faults):
            if fault.kind in {"cut", "partition"}:
                yield Problem(f"faults[{n}]", fault.kind, "expected paced steps: packets go by the time, give a rate")
    for i in scenario.ids:
        if scenario.source_of(i).kind == "zenoh":
            expected = "expected a source that needs no network: nobody outside can reach a node in its namespace"
            yield Problem(f"source of node {i}", "zenoh", expected)
            return
