"""What the tests of deployed swarms share: folders as `zfusion deploy` writes them, run here, and raw sessions."""

from __future__ import annotations

import json
import signal
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import tomli_w
import zenoh

from namespaces import Hosts
from swarms import ZFUSION, Command, Recorded, run_name, variant
from zfusion.deploy.folders import write
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.plan import Plan, Process
from zfusion.drivers.settings import base_settings
from zfusion.model.scenario import load_scenario
from zfusion.swarm.ports import free_endpoints

SPREAD: Mapping[str, Mapping[str, Any]] = {
    "a": {"nodes": [1, 2]},
    "b": {"nodes": [3], "recorder": True},
    "c": {"nodes": [4], "observer": True},
}
"""The four sensors of the example on three hosts; the first is the router's, where there is one."""


def free_port(number: int) -> int:
    """The first of so many ports in a row that nobody listens on now."""
    while True:
        port = int(free_endpoints(1)[0].rpartition(":")[2])
        with ExitStack() as stack:
            try:
                for n in range(number):
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", port + n))
            except OSError:
                continue
            return port


def hosts_document(topology: str = "direct", **changes: Any) -> dict[str, Any]:
    """A hosts file for `SPREAD`, all on this machine."""
    port = free_port(2 * len(SPREAD))
    hosts = {
        name: {
            "address": "127.0.0.1",
            "port": port + 2 * n,
            "router": topology == "router" and name == "a",
            **host,
        }
        for n, (name, host) in enumerate(SPREAD.items())
    }
    return {"run": run_name("deployed"), "topology": topology, "hosts": hosts, **changes}


def planned(
    directory: Path,
    document: Mapping[str, Any],
    scenario: Path | None = None,
    *,
    free_run: bool | None = None,
    **changes: Any,
) -> Plan:
    """The plan of a hosts file for a scenario, by default a variant of the four-sensor example."""
    path = directory / "hosts.toml"
    path.write_text(tomli_w.dumps(document))
    loaded = load_scenario(scenario or variant(directory, "field", **changes), free_run=free_run)
    return Plan(loaded, HostsFile.load(path, loaded), document["run"])


def deployed(directory: Path, document: Mapping[str, Any], **changes: Any) -> Plan:
    """A plan whose folders are in ``out``."""
    plan = planned(directory, document, **changes)
    write(plan, directory / "out")
    return plan


def process(plan: Plan, name: str) -> Process:
    """The process of a plan that is called so."""
    return next(one for one in plan.processes if one.name == name)


class Swarm:
    """The processes of a deployed swarm, each started in its host's folder as its README says."""

    def __init__(self, plan: Plan, out: Path, hosts: Hosts | None = None) -> None:
        """`out` has the hosts' folders; `hosts` are those that they are on."""
        self.plan, self.out = plan, out
        self.commands: dict[str, Command] = {}
        self._hosts = hosts
        for one in plan.processes:
            if one.kind in {"node", "recorder", "router"}:
                self.start(one)

    def start(self, one: Process) -> None:
        """Start a process, or start it again."""
        words = [*self.plan.command(one)[1:], *(["--json"] if one.kind != "router" else [])]
        entrance = () if self._hosts is None else self._hosts.entrance(one.host)
        self.commands[one.name] = Command(self.out / one.host, *words, program=(*entrance, *ZFUSION))

    def steps_taken(self) -> bool:
        """Whether messages are on the recording."""
        return self.recording.exists() and self.recording.stat().st_size > 20_000

    @property
    def recording(self) -> Path:
        """The recorder's file."""
        return self.out / process(self.plan, "recorder").host / "recordings" / f"{self.plan.run}.mcap"

    def ended(self) -> dict[str, dict[str, Any]]:
        """Wait for the nodes and the recorder to end by themselves, well; what they reported."""
        reports = {}
        for name, command in self.commands.items():
            if not name.startswith("router"):
                result = command.wait()
                assert result.code == 0, (name, result.err)
                reports[name] = result.summary
        return reports

    def interrupt(self) -> None:
        """Ctrl-C for all nodes."""
        for name, command in self.commands.items():
            if name.startswith("node"):
                command.interrupt()

    def kill(self) -> None:
        """Leave nothing running."""
        for command in self.commands.values():
            if command.process.poll() is None:
                command.process.kill()
            command.process.wait()


@contextmanager
def swarm(plan: Plan, out: Path, hosts: Hosts | None = None) -> Iterator[Swarm]:
    """A deployed swarm that runs; routers are stopped, well, at the end."""
    running = Swarm(plan, out, hosts)
    try:
        yield running
        for name, command in running.commands.items():
            if name.startswith("router"):
                command.process.send_signal(signal.SIGTERM)
                assert command.wait().code == 0, command.said()
    finally:
        running.kill()


def refusals(reports: Mapping[str, Mapping[str, Any]]) -> dict[tuple[str, str], dict[str, int]]:
    """(node's process, neighbour) -> what the node has refused of it, by reason; where that is anything."""
    return {
        (name, other): edge["refused"]
        for name, report in reports.items()
        if name.startswith("node")
        for other, edge in report["edges"].items()
        if edge["refused"]
    }


def senders(messages: Iterable[Recorded]) -> set[tuple[str, str]]:
    """(node whose key it is, node that says that it has sent) of recorded messages."""
    return {(m.topic.split("/")[3], str(m.payload["node"])) for m in messages if "/node/" in m.topic}


def tls_files(folder: Path, name: str, ca: Path | None = None) -> dict[str, Any]:
    """Zenoh's settings of TLS with the files of a process, or of somebody who has stolen them."""
    certificate, key = str(folder / f"{name}.pem"), str(folder / f"{name}.key")
    return {
        "root_ca_certificate": str(ca or folder / "ca.pem"),
        "enable_mtls": True,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }


@contextmanager
def intruder(endpoint: str, tls: Mapping[str, Any] | None) -> Iterator[zenoh.Session]:
    """A raw Zenoh session without any rules, linked to one endpoint; ZError where that lets nobody like it in."""
    config = zenoh.Config()
    settings = base_settings("client") | {"connect/endpoints": [endpoint], "connect/exit_on_failure": True}
    for path, value in (settings | ({} if tls is None else {"transport/link/tls": tls})).items():
        config.insert_json5(path, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    """What is answered to a query; an error that Zenoh itself answers is no answer."""
    replies = session.get(key, timeout=5.0, consolidation=zenoh.ConsolidationMode.NONE)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
