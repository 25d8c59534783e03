"""The files: whether they are right, and whether the method accepts them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from zfusion.deploy.hosts import HostsFile
from zfusion.doctor.finding import Finding, Topic
from zfusion.drivers.designs import design_of
from zfusion.errors import InputError, ScenarioError
from zfusion.links import links_of
from zfusion.methods import chosen
from zfusion.methods.check import check_method
from zfusion.model.scenario import Scenario, load_scenario

TOPIC = Topic("scenario")
Read = TypeVar("Read")

NOTHING_STARTS = "nothing starts with it"


def check_scenario(path: Path) -> tuple[Scenario | None, list[Finding]]:
    """The scenario, and what is to be said of it; None where it cannot be run."""

    def read() -> Scenario:
        scenario = load_scenario(path)
        check_method(scenario, str(path))
        links_of(scenario)
        return scenario

    scenario, findings = _read(read)
    if scenario is None:
        return None, findings
    kind = (
        "free-running" if scenario.timing.period_ns is None else f"{1e9 / scenario.timing.period_ns:g} steps a second"
    )
    said = f"{path}: {len(scenario.ids)} nodes, method {scenario.method.name}, {kind}"
    return scenario, [TOPIC.ok(said), *_design(scenario)]


def check_hosts(path: Path, scenario: Scenario) -> tuple[HostsFile | None, list[Finding]]:
    """The hosts file, and what is to be said of it; None where it cannot be used."""
    hosts, findings = _read(lambda: HostsFile.load(path, scenario))
    if hosts is None:
        return None, findings
    return hosts, [TOPIC.ok(f"{path}: {len(hosts.hosts)} hosts, {hosts.topology}")]


def _read(read: Callable[[], Read]) -> tuple[Read | None, list[Finding]]:
    try:
        return read(), []
    except ScenarioError as error:
        wrong = [f"{error.source}: {problem.field} is {problem.value!r:.80}" for problem in error.problems]
        remedies = [problem.expected for problem in error.problems]
        found = zip(wrong, remedies, strict=True)
        return None, [TOPIC.error(what, NOTHING_STARTS, remedy) for what, remedy in found]
    except InputError as error:
        return None, [TOPIC.error(str(error), NOTHING_STARTS, "correct what it names")]


def _design(scenario: Scenario) -> Iterator[Finding]:
    if chosen(scenario).family.designer is None:
        return
    if scenario.method.design is None:
        why = "launch designs it when it starts, which may take minutes; nodes on other machines need the same file"
        remedy = f"zfusion design SCENARIO --method {scenario.method.name} -o design.npz, and name it in method.design"
        yield TOPIC.warning(f"{scenario.method.name} has no design file", why, remedy)
        return
    try:
        design_of(scenario)
    except InputError as error:
        yield TOPIC.error(str(error), "its nodes refuse to start", "make it anew: zfusion design SCENARIO -o FILE")
    else:
        yield TOPIC.ok(f"design {scenario.method.design}")
