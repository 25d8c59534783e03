"""The worst network that was found, as a file of links: with it, any simulation or replay finds the same number.

What is claimed of it is what the very nodes report, or err by, under the links of the file: they are run once more,
in the simulated world. The search's own number, by the recursion, differs by rounding only, unless nodes that wait for
what is lost, or links that hold messages up, make other messages late.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import tomli_w

from zfusion.drivers.simulated import Simulation
from zfusion.drivers.sources import Source, open_sources
from zfusion.errors import InputError
from zfusion.methods import chosen
from zfusion.methods.check import deadline_ns
from zfusion.model.scenario import ITEMS_ON_LINES, Scenario
from zfusion.model.schema.run import NANOSECONDS
from zfusion.model.types import Array, NodeId
from zfusion.stages import ESTIMATE, Message
from zfusion.studies.worst.problem import Data, Objective, Problem
from zfusion.studies.worst.search import Found, find_worst, random_values

REPETITIONS = 50
"""Random choices with which the worst one is compared."""


@dataclass(frozen=True)
class Report:
    """The worst network that was found, and what others are like."""

    objective: Objective
    budget: int
    """Messages that could be chosen."""
    sent: int
    """Messages that there are."""
    chosen: int
    nothing: float
    """The objective if none is lost but those that the scenario's links lose."""
    random_mean: float
    random_highest: float
    """For random choices of the same size: mean and highest."""
    repetitions: int
    searched: float
    """For the worst choice that was found, by the search's own account."""
    worst: float
    """The same in a simulation with the witness: what is claimed."""
    exact: bool
    """Whether all choices were looked at."""
    ran_out: bool
    """Whether time ended the search."""
    looked_at: int
    by_receiver: Mapping[str, int]
    """Chosen messages by the node that they do not reach."""
    links: Mapping[str, Any]
    """The witness, as a file of links holds it."""

    def as_dict(self) -> dict[str, Any]:
        """As plain data, for JSON."""
        names = [name for name in self.__dataclass_fields__ if name != "links"]
        return {**{name: getattr(self, name) for name in names}, "by_receiver": dict(self.by_receiver)}


def worst_network(
    scenario: Scenario,
    budget: float,
    *,
    objective: Objective = "predicted",
    nodes: Collection[NodeId] | None = None,
    delay_s: float | None = None,
    limit_s: float = 60.0,
    seed: int | None = None,
) -> Report:
    """The worst choice of at most a part `budget`, in (0, 1], of all messages, under the scenario's own links.

    They are lost, or late by `delay_s`; `nodes` are those whose errors count. `seed` is that of the search, by default
    the scenario's.

    InputError where it cannot be searched for: a budget of less than one message, a delay that is not too long, a truth
    that is not known, a policy by which late messages are not lost.
    """
    if delay_s is not None:
        _check_delay(scenario, delay_s)
    data = _data(scenario) if objective == "measured" or not scenario.truth_known else None
    problem = Problem(scenario, objective=objective, nodes=nodes, data=data)
    count = int(budget * problem.sent + 1e-9)
    if not count:
        raise InputError(f"budget: expected at least one of {problem.sent} messages (is {budget:g})")
    seed = scenario.seed if seed is None else seed
    found = find_worst(problem, count, seed=seed, limit_s=limit_s)
    random = random_values(problem, count, REPETITIONS, seed)
    links = _links(problem, found, delay_s)
    nothing = np.zeros(len(problem.arriving), dtype=np.bool_)
    return Report(
        objective=objective,
        budget=count,
        sent=problem.sent,
        chosen=int(found.lost.sum()),
        nothing=problem.value(nothing),
        random_mean=float(random.mean()),
        random_highest=float(random.max()),
        repetitions=REPETITIONS,
        searched=found.value,
        worst=simulated_objective(_with_links(scenario, links), objective, nodes),
        exact=found.exact,
        ran_out=found.ran_out,
        looked_at=found.looked_at,
        by_receiver=_by_receiver(problem, found),
        links=links,
    )


def write_witness(report: Report) -> str:
    """The text of the file of links."""
    head = (
        f"# {report.chosen} of {report.sent} messages, the worst found for the {report.objective} mean squared error:\n"
        f"# {report.worst:.17g}, where it is {report.nothing:.6g} without, "
        f"and {report.random_mean:.6g} on average for random choices of as many.\n\n"
    )
    return head + ITEMS_ON_LINES.sub(_on_one_line, tomli_w.dumps({"links": report.links}))


def _on_one_line(items: re.Match[str]) -> str:
    return f"[{', '.join(item.strip() for item in items[1].split(',') if item.strip())}]"


def simulated_objective(
    scenario: Scenario,
    objective: Objective,
    nodes: Collection[NodeId] | None = None,
) -> float:
    """The mean over all estimates of some nodes of trace P, or of |x̂ - x|², in a simulation of the scenario."""
    sources = open_sources(scenario, scenario.ids)
    values: list[float] = []

    def observe(message: Message, _now_ns: int) -> None:
        if message.stage == ESTIMATE.name and (nodes is None or message.node in nodes):
            values.append(_squared(message, objective, sources[message.node]))

    simulation = Simulation(scenario, sources=sources, observe=observe)
    try:
        simulation.run()
    finally:
        simulation.close()
    return float(np.mean(values))


def _squared(message: Message, objective: Objective, source: Source) -> float:
    if objective == "predicted":
        return float(cast(Array, message.fields["P"]).trace())
    truth = source.truth(message.step)
    assert truth is not None  # the problem has looked
    error = cast(Array, message.fields["x"]) - truth
    return float(error @ error)


def _data(scenario: Scenario) -> Data:
    sources = open_sources(scenario, scenario.ids)
    steps = range(1, scenario.steps + 1)
    readings = {i: {k: source.read(k, 0) for k in steps} for i, source in sources.items()}
    truth = {k: sources[scenario.ids[0]].truth(k) for k in steps}
    for source in sources.values():
        source.close()
    return Data({i: _those_there(of) for i, of in readings.items()}, _those_there(truth))


def _those_there(values: Mapping[int, Array | None]) -> dict[int, Array]:
    return {k: value for k, value in values.items() if value is not None}


def _check_delay(scenario: Scenario, delay_s: float) -> None:
    timing = scenario.timing
    if timing.period_ns is None or timing.late != "drop":
        raise InputError(
            'delay: expected steps that have times, and timing.late = "drop": else nothing is late for good'
        )
    longest_s = max(deadline_ns(scenario, stage.name) for stage in chosen(scenario).stages) / NANOSECONDS
    if not delay_s > longest_s:
        raise InputError(f"delay: expected more than the last deadline, {longest_s:g} s (is {delay_s:g})")


def _links(problem: Problem, found: Found, delay_s: float | None) -> dict[str, Any]:
    """The scenario's links, and the chosen messages by name; what is late holds nothing up unless it is said to."""
    document = tomllib.loads(problem.scenario.anchored().to_toml()).get("links", {})
    fate = {"lost": True} if delay_s is None else {"delay": float(delay_s)}
    if delay_s is not None and not document:
        document["reorder"] = True
    named = [{**place, **fate} for place in _messages(problem, found)]
    return {**document, "messages": [*document.get("messages", ()), *named]}


def _messages(problem: Problem, found: Found) -> Iterator[dict[str, Any]]:
    lost = found.lost.reshape(problem.shape)
    for at, (receiver, sender) in enumerate(problem.arcs.pairs):
        for number, stage in enumerate(problem.stages):
            steps = [int(step) + 1 for step in np.flatnonzero(lost[number, :, at])]
            if steps:
                yield {"from": sender, "to": receiver, "stage": stage, "steps": steps}


def _by_receiver(problem: Problem, found: Found) -> dict[str, int]:
    counts = {str(i): 0 for i in problem.network.ids}
    for rule in _messages(problem, found):
        counts[str(rule["to"])] += len(rule["steps"])
    return counts


def _with_links(scenario: Scenario, links: Mapping[str, Any]) -> Scenario:
    document = tomllib.loads(scenario.anchored().to_toml()) | {"links": links}
    return Scenario.from_toml(tomli_w.dumps(document), "witness")
