"""What is looked at: a scenario, perhaps a hosts file, and what of it is this machine's business."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from zfusion.deploy.plan import RECORDINGS, Plan, Process
from zfusion.drivers.endpoints import dialled, listens_at
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId

ENDPOINT = re.compile(r"(?P<protocol>[a-z][a-z0-9_-]*)/(?P<host>\[[^\]]+\]|[^:/?#]+):(?P<port>\d+)([?#].*)?")

STREAMS = frozenset({"tcp", "tls", "ws"})
"""Protocols over TCP; the others that have ports are over UDP."""


@dataclass(frozen=True, slots=True)
class Place:
    """A Zenoh endpoint that has a port."""

    protocol: str
    host: str
    port: int

    @classmethod
    def of(cls, endpoint: str) -> Place | None:
        """None for what has no port, like ``unixsock-stream/file``."""
        found = ENDPOINT.fullmatch(endpoint)
        return found and cls(found["protocol"], found["host"].strip("[]"), int(found["port"]))

    @property
    def kind(self) -> socket.SocketKind:
        """What kind of socket it is."""
        return socket.SOCK_STREAM if self.protocol in STREAMS else socket.SOCK_DGRAM


def is_own(host: str) -> bool:
    """Whether an address, or the address of a name, is one of this machine's."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, UnicodeError):
        return False
    return True


@dataclass(frozen=True)
class Ground:
    """What is looked at."""

    scenario: Scenario
    run: str
    plan: Plan | None = None
    """Who runs where, by a hosts file; without one, all that listens at an address of this machine runs here."""
    host: str | None = None
    """Which of the hosts this machine is; None: none of them, or there is no hosts file."""
    folder: Path | None = None
    """This host's folder, as it was deployed."""
    zenoh_config: Path | None = None
    """With which a running swarm is asked."""

    @cached_property
    def processes(self) -> tuple[Process, ...]:
        """The processes here, by the plan."""
        return () if self.plan is None or self.host is None else self.plan.on(self.host)

    @cached_property
    def nodes(self) -> tuple[NodeId, ...]:
        """The nodes that run here."""
        if self.plan is not None:
            nodes = (process.node for process in self.processes if process.kind == "node")
            return tuple(node for node in nodes if node is not None)
        where = {i: Place.of(endpoint) for i, endpoint in listens_at(self.scenario).items()}
        return tuple(i for i, place in where.items() if place is None or is_own(place.host))

    @cached_property
    def records(self) -> bool:
        """Whether a recorder runs here."""
        if self.plan is not None:
            return any(process.kind == "recorder" for process in self.processes)
        return self.scenario.recording.enabled

    @cached_property
    def several_machines(self) -> bool:
        """Whether the swarm is on more than this machine."""
        if self.plan is not None:
            return len(self.plan.hosts.hosts) > 1 or self.host is None
        return len(self.nodes) < len(self.scenario.ids)

    @property
    def in_cluster(self) -> bool:
        """Whether the swarm is where this machine is not: in a cluster of Kubernetes."""
        return self.plan is not None and self.plan.hosts.kubernetes and self.host is None

    @cached_property
    def listens(self) -> dict[str, str]:
        """Endpoints that processes here listen at, and whose they are, in words."""
        if self.plan is not None:
            return {endpoint: process.name for process in self.processes for endpoint in process.listen}
        listens = listens_at(self.scenario)
        return {} if self.scenario.transport.zenoh_config else {listens[i]: f"node {i}" for i in self.nodes}

    @cached_property
    def dials(self) -> tuple[str, ...]:
        """Endpoints elsewhere that processes here dial; where this machine is none of the hosts, all of them.

        None where that is because they are pods: who is not in the cluster does not know their names.
        """
        if self.in_cluster:
            return ()
        if self.plan is not None:
            processes = self.processes or self.plan.processes
            dials = [endpoint for process in processes for endpoint in process.connect]
        else:
            listens = listens_at(self.scenario)
            dials = [endpoint for i in self.nodes for endpoint in dialled(self.scenario, i, listens)]
            dials += listens.values() if self.records else ()
        return tuple(dict.fromkeys(endpoint for endpoint in dials if endpoint not in self.listens))

    @cached_property
    def doors(self) -> dict[str, NodeId]:
        """Behind which of these endpoints there is a node, and which."""
        if self.plan is None:
            own = self.scenario.transport.zenoh_config is not None
            return {} if own else {endpoint: i for i, endpoint in listens_at(self.scenario).items()}
        here = {endpoint: one.node for one in self.processes for endpoint in one.listen if one.node is not None}
        return {**self.plan.doors, **here}

    @property
    def recordings(self) -> Path:
        """The directory that the recording goes to."""
        recording = self.scenario.recording
        if self.folder is not None:
            return self.folder / RECORDINGS
        if recording.path is not None:
            return self.scenario.absolute(recording.path).parent
        return self.scenario.absolute(recording.directory) if recording.directory else Path(RECORDINGS)


def host_here(plan: Plan) -> str | None:
    """The host of a plan whose address is this machine's; None where there is none, or more than one."""
    own = [name for name, host in plan.hosts.hosts.items() if is_own(host.address)]
    return own[0] if len(own) == 1 else None
