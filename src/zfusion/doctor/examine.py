"""All checks, in the order in which somebody would look."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from zfusion.deploy.plan import Plan
from zfusion.doctor.certificates import check_certificates
from zfusion.doctor.clocks import check_clock, check_source, discipline
from zfusion.doctor.disk import bytes_per_step, check_disk
from zfusion.doctor.finding import Finding, Severity, Topic
from zfusion.doctor.ground import Ground, Place, host_here
from zfusion.doctor.limits import (
    available_memory,
    check_files,
    check_governor,
    check_memory,
    check_processors,
    step_seconds,
)
from zfusion.doctor.names import TIMEOUT_S, check_names, reach
from zfusion.doctor.namespaces import check_namespaces
from zfusion.doctor.ports import check_ports
from zfusion.doctor.running import check_running
from zfusion.doctor.scenario import check_hosts, check_scenario
from zfusion.doctor.versions import check_versions
from zfusion.drivers.clock_watch import clock_limit_ns
from zfusion.drivers.endpoints import linked
from zfusion.errors import InputError
from zfusion.keys import check_run

HOSTS = Topic("hosts")


@dataclass(frozen=True, slots=True)
class Asked:
    """What is to be looked at."""

    scenario: Path
    hosts: Path | None = None
    host: str | None = None
    """Which of the hosts this machine is; by default the one whose address it has."""
    folder: Path | None = None
    """What ``zfusion deploy`` wrote: this host's folder, or the one that holds it."""
    zenoh_config: Path | None = None
    run: str | None = None


def examine(asked: Asked) -> Iterator[Finding]:
    """Everything that can be said; what depends on a file that is wrong is left out."""
    yield from check_versions()
    scenario, findings = check_scenario(asked.scenario)
    yield from findings
    if scenario is None:
        return
    plan = None
    run = check_run(asked.run or scenario.name)
    if asked.hosts is not None:
        hosts, findings = check_hosts(asked.hosts, scenario)
        yield from findings
        if hosts is None:
            return
        run = check_run(asked.run or hosts.run or asked.scenario.stem)
        plan = Plan(scenario, hosts, run)
    host = None if plan is None else _host(asked, plan)
    ground = Ground(scenario, run, plan, host, _folder(asked.folder, host), asked.zenoh_config)
    if plan is not None:
        yield _told(ground)
    yield from _network(ground)
    yield from _machine(ground)


def _host(asked: Asked, plan: Plan) -> str | None:
    """Which host this is; InputError for one that is none of the plan's."""
    if asked.host is not None and asked.host not in plan.hosts.hosts:
        raise InputError(f"--host: expected one of {', '.join(plan.hosts.hosts)} (is {asked.host!r})")
    return asked.host or host_here(plan)


def _folder(folder: Path | None, host: str | None) -> Path | None:
    return folder if folder is None or host is None or not (folder / host).is_dir() else folder / host


def _told(ground: Ground) -> Finding:
    if ground.host is not None:
        said = ", ".join(process.name for process in ground.processes) or "nothing"
        return HOSTS.ok(f"this machine is {ground.host}, and runs {said}")
    if ground.in_cluster:
        why = "their names are known in the cluster only: neither these nor what runs there were looked at"
        return HOSTS.warning("this machine is none of the pods", why, "look at them with kubectl, or run it in one")
    why = "what a host listens at, its certificates and limits were not looked at"
    return HOSTS.warning("this machine is not one, and only one, of the hosts", why, "--host NAME, or run it there")


def _network(ground: Ground) -> Iterator[Finding]:
    """Ports, names, certificates, clocks, and nodes that run."""
    scenario, limit = ground.scenario, clock_limit_ns(ground.scenario)
    named = ground.listens if ground.plan is not None else scenario.transport.endpoints.values()
    yield from check_ports(ground.listens, named)
    if ground.several_machines:
        yield from check_names(ground.dials)
    if ground.plan is not None and ground.plan.secured and ground.host is not None:
        if ground.folder is None:
            why = "links are TLS: a process whose certificate is no good refuses to start"
            yield Topic("certificates").warning("no folder was looked at", why, "--folder with what deploy wrote")
        else:
            processes = [process for process in ground.processes if process.kind != "sensor"]
            address = ground.plan.hosts.hosts[ground.host].address
            yield from check_certificates(ground.folder, processes, address)
    yield from check_clock(discipline(), limit, several_machines=ground.several_machines)
    yield from check_source()
    endpoints = [*ground.listens, *ground.dials]
    places = {endpoint: place for endpoint in endpoints if (place := Place.of(endpoint)) is not None}
    yield from check_running(ground, [e for e, place in places.items() if reach(place, TIMEOUT_S) is None], limit)


def _machine(ground: Ground) -> Iterator[Finding]:
    """Disk, limits, namespaces."""
    scenario = ground.scenario
    period_ns = scenario.timing.period_ns
    rate_hz = None if period_ns is None else 1e9 / period_ns
    if ground.records:
        yield from check_disk(ground.recordings, bytes_per_step(scenario), rate_hz, scenario.steps)
    if ground.nodes or ground.records:
        links = [len(linked(scenario, i)) + 1 for i in ground.nodes] + [len(scenario.ids)] * ground.records
        yield from check_files(max(links))
    if ground.nodes:
        yield from check_memory(len(ground.nodes), available_memory())
        processors = len(os.sched_getaffinity(0))
        yield from check_processors(len(ground.nodes), rate_hz, step_seconds(scenario), processors)
        yield from check_governor()
    if not ground.several_machines:
        yield from check_namespaces(scenario)


def worst(findings: list[Finding]) -> Severity:
    """The worst of them."""
    return max((finding.severity for finding in findings), key=list(Severity).index, default=Severity.OK)
