"""The hosts file: which processes of a swarm run on which machine, how they are reached, and how they are secured."""

from __future__ import annotations

import ipaddress
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field

from zfusion.errors import Problem, ScenarioError
from zfusion.keys import NAME as RUN_NAME
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.schema.base import Flag, Id, Spec
from zfusion.model.schema.faults import StopFault
from zfusion.model.types import NodeId
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH

Topology = Literal["direct", "router"]
"""Linked nodes have a link of their own; or all have one to the router, or routers, only."""

HOST_NAME = re.compile(
    r"(?=.{1,253}\Z)[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?)*"
)
"""What a name in the DNS looks like."""

FOLDER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,50}")
"""Hosts give their names to folders, and to the common names of routers, which have at most 64 characters."""

TAKEN = frozenset({"ca"})
"""Names of folders that are no host's."""

LONGEST_ID = 57
"""Characters of a node's id: ``sensor-<id>`` is a common name, of 64 at most."""

MAX_PORT = 65_535

DEFAULT_PORT = 7450

A_LIFE = 36_500
"""Days: a hundred years."""

POD = "zfusion-node"
"""The StatefulSet of the nodes; a pod's name ends with its number."""

RECORDER_POD = "zfusion-recorder"

SERVICE = "zfusion-nodes"
"""By which pods have names: ``POD-NUMBER.SERVICE``."""


def _bind(value: str) -> str:
    address = _as_ip(value)
    if address is not None:
        if "%" in value:
            raise ValueError("expected an address without a zone: each machine has its own names for those")
        return str(address)
    if not HOST_NAME.fullmatch(value) or value.replace(".", "").isdecimal():
        raise ValueError("expected an IP address, or a name like 'sensor-1.example.org'")
    return value.lower()  # capitals make no other name


def _address(value: str) -> str:
    address = _as_ip(value)
    if address is not None and (address.is_unspecified or address.is_multicast):
        raise ValueError("expected the address of one machine, by which others reach it")
    return _bind(value)


def _as_ip(value: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(value)
    except ValueError:
        return None


def _run(value: str) -> str:
    if not RUN_NAME.fullmatch(value):
        raise ValueError("expected 1 to 100 letters, digits, '_', '-' or '.', not beginning with '-' or '.'")
    return value


Address = Annotated[str, Field(strict=True), AfterValidator(_address)]
Bind = Annotated[str, Field(strict=True), AfterValidator(_bind)]
Port = Annotated[int, Field(strict=True, ge=1, le=MAX_PORT)]
Days = Annotated[int, Field(strict=True, ge=1, le=A_LIFE)]


class HostSpec(Spec):
    """One machine and what runs on it.

    In a direct topology its nodes listen at `port`, `port + 1`, ..., in the order of their ids; a router at `port`.
    """

    address: Address
    """By which the others reach it: an IP address, or a name that they can look up."""
    bind: Bind | None = None
    """The address to listen at where that is another one: behind a NAT, in a container (``0.0.0.0``: at all)."""
    nodes: tuple[Id, ...] = ()
    recorder: Flag = False
    observer: Flag = False
    router: Flag = False
    port: Port = DEFAULT_PORT

    @property
    def listens_at(self) -> str:
        """The address that its processes listen at."""
        return self.bind or self.address


class AuthoritySpec(Spec):
    """A user's own CA, which is to sign: files, relative to the hosts file."""

    PATHS = ("certificate", "key")

    certificate: str
    key: str


class SecuritySpec(Spec):
    """TLS on every link with a certificate for every process, and rules for who may say what to whom."""

    PATHS = ("certificates",)

    enabled: Flag = True
    days: Days = 825
    """How long certificates are valid that are made here."""
    ca: AuthoritySpec | None = None
    """By default one is made, in ``ca/``."""
    certificates: str | None = None
    """A directory of a user's own: ``ca.pem``, and ``PROCESS.pem`` and ``PROCESS.key`` for every process."""
    observer_reads: tuple[str, ...] = ("status", "estimate", "event")
    """What an observer is given: names of stages, ``truth``, ``status``, ``history``."""


class HostsFile(Spec):
    """A hosts file."""

    run: Annotated[str, Field(strict=True), AfterValidator(_run)] | None = None
    """The run's name; by default that of the scenario's file."""
    topology: Topology = "direct"
    hosts: Annotated[dict[str, HostSpec], Field(default_factory=dict)]
    kubernetes: Flag = False
    """Instead of hosts: a pod for every node, whose number is the node's id, and one for the recorder."""
    security: SecuritySpec = SecuritySpec()

    @classmethod
    def load(cls, path: Path, scenario: Scenario) -> Self:
        """The file at `path`, checked by itself and against the scenario.

        ScenarioError with everything that is wrong; paths in it are made absolute.
        """
        try:
            document = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            expected = f"expected a hosts file that can be read: {reason}"
            raise ScenarioError(str(path), [Problem("file", str(path), expected)]) from None
        except tomllib.TOMLDecodeError as error:
            raise ScenarioError(str(path), [Problem("file", str(path), f"expected valid TOML: {error}")]) from None
        hosts = cls._read(document, str(path))
        problems = list(_kind(hosts, scenario))
        if not problems:
            placed = pods(scenario) if hosts.kubernetes else hosts.hosts
            hosts = hosts.model_copy(update={"hosts": placed})
            problems += problems_of(hosts, scenario)
        if problems:
            raise ScenarioError(str(path), problems)
        return hosts._anchored(path.parent.absolute())

    def _anchored(self, directory: Path) -> Self:
        def here(path: str) -> str:
            return str(directory / path)

        security = self.security.with_paths(here)
        ca = None if security.ca is None else security.ca.with_paths(here)
        return self.model_copy(update={"security": security.model_copy(update={"ca": ca})})

    def host_of(self, node: NodeId) -> str:
        """The name of the host that runs a node."""
        return next(name for name, host in self.hosts.items() if node in host.nodes)


def pods(scenario: Scenario) -> dict[str, HostSpec]:
    """The pods of a scenario, as hosts."""
    nodes = {f"{POD}-{i}": HostSpec(address=f"{POD}-{i}.{SERVICE}", bind="0.0.0.0", nodes=(i,)) for i in scenario.ids}
    return {**nodes, RECORDER_POD: HostSpec(address=f"{RECORDER_POD}-0.{SERVICE}", recorder=True)}


def _kind(hosts: HostsFile, scenario: Scenario) -> Iterator[Problem]:
    """Either hosts or pods."""
    if not hosts.kubernetes:
        if not hosts.hosts:
            yield Problem("hosts", {}, "expected a table [hosts.NAME] for each, or kubernetes = true")
        return
    if hosts.hosts:
        yield Problem("hosts", sorted(hosts.hosts), "expected none where kubernetes = true")
    if hosts.topology != "direct":
        yield Problem("topology", hosts.topology, 'expected "direct" where kubernetes = true')
    ids = scenario.ids
    if isinstance(ids[0], str) or list(ids) != [ids[0] + n for n in range(len(ids))]:
        expected = "expected a scenario whose ids are consecutive numbers: a pod's number is its node's id"
        yield Problem("kubernetes", list(ids), expected)


def problems_of(hosts: HostsFile, scenario: Scenario) -> Iterator[Problem]:
    """What is wrong with a hosts file whose single fields are right."""
    yield from _placement(hosts, scenario)
    yield from _roles(hosts)
    yield from _ports(hosts)
    yield from _security(hosts.security, readable(scenario))
    yield from _scenario(scenario)


def _scenario(scenario: Scenario) -> Iterator[Problem]:
    """What a scenario may have where there is a launcher only."""
    if scenario.transport.zenoh_config is not None:
        expected = "expected a scenario without transport.zenoh_config: the configurations are written here"
        yield Problem("scenario", scenario.transport.zenoh_config, expected)
    for n, fault in enumerate(scenario.faults):
        if isinstance(fault, StopFault):
            expected = "expected no stop: there is no launcher on hosts that could set the node going again"
            yield Problem(f"scenario: faults[{n}]", fault.kind, expected)


def _placement(hosts: HostsFile, scenario: Scenario) -> Iterator[Problem]:
    """Every node on exactly one host."""
    places: dict[NodeId, str] = {}
    for name, host in hosts.hosts.items():
        for n, i in enumerate(host.nodes):
            field = f"hosts.{name}.nodes[{n}]"
            if i not in scenario.ids:
                yield Problem(field, i, f"expected a node of the scenario: {', '.join(map(str, scenario.ids))}")
            elif i in places:
                yield Problem(field, i, f"expected each node once, this one is on {places[i]} already")
            elif len(str(i)) > LONGEST_ID:
                yield Problem(field, i, f"expected an id of at most {LONGEST_ID} characters: it is in a certificate")
            places.setdefault(i, name)
    absent = [i for i in scenario.ids if i not in places]
    if absent:
        yield Problem("hosts", sorted(hosts.hosts), f"expected node {', '.join(map(str, absent))} on one of them")


def _roles(hosts: HostsFile) -> Iterator[Problem]:
    """Names, and what but nodes runs on the hosts."""
    recorder = None
    for name, host in hosts.hosts.items():
        field = f"hosts.{name}"
        if not FOLDER.fullmatch(name) or name in TAKEN:
            yield Problem(field, name, "expected a name of at most 51 letters, digits, '_' and '-', and not 'ca'")
        if not (host.nodes or host.recorder or host.observer or host.router):
            yield Problem(field, name, "expected something to run: nodes, recorder, observer or router")
        if host.recorder and recorder is not None:
            yield Problem(f"{field}.recorder", True, f"expected one recorder at most, {recorder} has one")
        recorder = name if host.recorder else recorder
        if host.router and hosts.topology == "direct":
            yield Problem(f"{field}.router", True, 'expected no router where topology = "direct"')
    if hosts.topology == "router" and not any(host.router for host in hosts.hosts.values()):
        yield Problem("topology", hosts.topology, "expected a host with router = true")


def listening(host: HostSpec, topology: Topology) -> int:
    """How many ports, from its first one on, a host listens at."""
    return len(host.nodes) if topology == "direct" else int(host.router)


def _ports(hosts: HostsFile) -> Iterator[Problem]:
    users: dict[tuple[str, int], str] = {}
    for name, host in hosts.hosts.items():
        number = listening(host, hosts.topology)
        if host.port + number - 1 > MAX_PORT:
            yield Problem(f"hosts.{name}.port", host.port, f"expected room for {number} ports up to {MAX_PORT}")
            continue
        others = {users[host.address, host.port + n] for n in range(number) if (host.address, host.port + n) in users}
        if others:
            expected = f"expected ports that {', '.join(sorted(others))} at the same address does not use"
            yield Problem(f"hosts.{name}.port", host.port, expected)
        users |= {(host.address, host.port + n): name for n in range(number)}


def readable(scenario: Scenario) -> tuple[str, ...]:
    """What an observer can be given."""
    stages = [stage.name for stage in (*chosen(scenario).stages, ESTIMATE, EVENT, ARRIVALS, REVISED)]
    return (*stages, *([TRUTH.name] if scenario.truth_known else []), "status", "history")


def _security(security: SecuritySpec, known: tuple[str, ...]) -> Iterator[Problem]:
    for n, name in enumerate(security.observer_reads):
        if name not in known:
            yield Problem(f"security.observer_reads[{n}]", name, f"expected one of {', '.join(known)}")
    if security.ca is not None and security.certificates is not None:
        expected = "expected either ca, to sign certificates, or certificates that are there already"
        yield Problem("security.certificates", security.certificates, expected)
    given: Mapping[str, object] = {"ca": security.ca, "certificates": security.certificates}
    for name, value in given.items():
        if value is not None and not security.enabled:
            yield Problem(f"security.{name}", value, "expected none where enabled = false")
