"""Who runs where: the processes of a deployed swarm, where they listen, whom they dial and how they are started.

Of two linked nodes the one with the larger id dials. Recorder and observers dial every node, for peers pass nothing on.
With routers, everybody is a client of the routers; of two routers the one whose host's name is larger dials.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from zfusion.deploy.hosts import HostsFile
from zfusion.drivers.credentials import OBSERVER_NAME, RECORDER_NAME, node_name
from zfusion.drivers.endpoints import dialled
from zfusion.model.scenario import Scenario
from zfusion.model.schema import ZenohSource
from zfusion.model.types import NodeId

Kind = Literal["node", "recorder", "observer", "router", "sensor"]
"""A sensor is a program of the user's, which publishes the readings of a node whose source is a Zenoh key."""

SCENARIO = "scenario.toml"
"""In a host's folder, as all paths below."""

RECORDINGS = "recordings"


@dataclass(frozen=True, slots=True)
class Process:
    """One process of the swarm."""

    kind: Kind
    host: str
    node: NodeId | None
    """Of a node, and of a sensor the one that it publishes for; None else."""
    mode: Literal["peer", "client", "router"]
    """What it is in Zenoh."""
    listen: tuple[str, ...]
    """Zenoh endpoints: ``tls/10.0.0.1:7450``."""
    connect: tuple[str, ...]

    @property
    def name(self) -> str:
        """Its files' name and its certificate's common name: all observers share theirs."""
        match self.kind:
            case "recorder":
                return RECORDER_NAME
            case "observer":
                return OBSERVER_NAME
            case "router":
                return f"router-{self.host}"
        assert self.node is not None  # it is a node's or a sensor's
        return node_name(self.node) if self.kind == "node" else f"sensor-{self.node}"

    @property
    def zenoh_file(self) -> str:
        """Its Zenoh configuration."""
        return f"zenoh/{self.name}.json5"

    @property
    def certificate(self) -> str:
        """Its certificate."""
        return f"tls/{self.name}.pem"

    @property
    def key(self) -> str:
        """Its private key."""
        return f"tls/{self.name}.key"


@dataclass(frozen=True)
class Plan:
    """A swarm on its hosts."""

    scenario: Scenario
    hosts: HostsFile
    run: str

    @cached_property
    def processes(self) -> tuple[Process, ...]:
        """All: routers, the recorder, nodes by id, sensors, observers; in this order nobody has to wait for long."""
        return (*self._routers(), *self._recorder(), *self._nodes(), *self._sensors(), *self._observers())

    def on(self, host: str) -> tuple[Process, ...]:
        """Those on a host."""
        return tuple(process for process in self.processes if process.host == host)

    @property
    def secured(self) -> bool:
        """Whether links are TLS."""
        return self.hosts.security.enabled

    @property
    def recorded(self) -> bool:
        """Whether there is a recorder for the nodes to wait for."""
        return any(host.recorder for host in self.hosts.hosts.values())

    def command(self, process: Process) -> tuple[str, ...]:
        """The words that start a process, in its host's folder; none for a sensor, which is the user's own.

        Observers are started by whoever wants to look.
        """
        config = ("--zenoh-config", process.zenoh_file)
        common = (SCENARIO, "--run", self.run, *config)
        match process.kind:
            case "router":
                return ("zfusion", "router", *config)
            case "recorder":
                return ("zfusion", "record", *common, "-o", f"{RECORDINGS}/{self.run}.mcap", "--keep")
            case "observer":
                return ("zfusion", "top", *common)
            case "sensor":
                return ()
        waits = ("--await-recorder",) if self.recorded else ()
        return ("zfusion", "node", *common, "--id", str(process.node), *waits)

    @cached_property
    def _listens(self) -> Mapping[NodeId, tuple[str, str]]:
        """Where each node listens, and where it is dialled, in a direct topology."""
        found = {}
        for host in self.hosts.hosts.values():
            for n, i in enumerate(i for i in self.scenario.ids if i in host.nodes):
                at = self._endpoint(host.listens_at, host.port + n), self._endpoint(host.address, host.port + n)
                found[i] = at
        return found

    @cached_property
    def doors(self) -> Mapping[str, NodeId]:
        """Where nodes are dialled, and which is there; routers' clients are dialled nowhere."""
        direct = self.hosts.topology == "direct"
        return {reached: i for i, (_, reached) in self._listens.items()} if direct else {}

    @cached_property
    def _routers_at(self) -> Mapping[str, str]:
        """Where the router of each host that has one is dialled."""
        hosts = self.hosts.hosts.items()
        return {name: self._endpoint(host.address, host.port) for name, host in sorted(hosts) if host.router}

    def _nodes(self) -> Iterator[Process]:
        for i in self.scenario.ids:
            host = self.hosts.host_of(i)
            if self.hosts.topology == "router":
                yield self._client("node", host, i)
                continue
            at = {j: reached for j, (_, reached) in self._listens.items()}
            yield Process("node", host, i, "peer", (self._listens[i][0],), dialled(self.scenario, i, at))

    def _recorder(self) -> Iterator[Process]:
        yield from (self._reader("recorder", name) for name, host in self.hosts.hosts.items() if host.recorder)

    def _observers(self) -> Iterator[Process]:
        yield from (self._reader("observer", name) for name, host in self.hosts.hosts.items() if host.observer)

    def _sensors(self) -> Iterator[Process]:
        for i in self.scenario.ids:
            if isinstance(self.scenario.source_of(i), ZenohSource):
                host = self.hosts.host_of(i)
                if self.hosts.topology == "router":
                    yield self._client("sensor", host, i)
                else:
                    yield Process("sensor", host, i, "peer", (), (self._listens[i][1],))

    def _reader(self, kind: Kind, host: str) -> Process:
        if self.hosts.topology == "router":
            return self._client(kind, host, None)
        return Process(kind, host, None, "peer", (), tuple(self._listens[i][1] for i in self.scenario.ids))

    def _client(self, kind: Kind, host: str, node: NodeId | None) -> Process:
        """A client of the routers: that of its own host first, where there is one."""
        routers = sorted(self._routers_at, key=lambda name: (name != host, name))
        return Process(kind, host, node, "client", (), tuple(self._routers_at[name] for name in routers))

    def _routers(self) -> Iterator[Process]:
        for name in self._routers_at:
            host = self.hosts.hosts[name]
            smaller = tuple(at for other, at in self._routers_at.items() if other < name)
            yield Process("router", name, None, "router", (self._endpoint(host.listens_at, host.port),), smaller)

    def _endpoint(self, address: str, port: int) -> str:
        where = f"[{address}]" if ":" in address else address
        return f"{'tls' if self.secured else 'tcp'}/{where}:{port}"
