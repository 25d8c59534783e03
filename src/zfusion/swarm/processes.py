"""Which processes a swarm on this machine is made of: their commands, and where they find each other."""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from zfusion.drivers.endpoints import dialled
from zfusion.drivers.registry import Entry
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.swarm.child import Child
from zfusion.swarm.netns.addresses import places
from zfusion.swarm.ports import free_endpoints

ZFUSION = (sys.executable, "-m", "zfusion")


@dataclass(frozen=True, slots=True)
class Processes:
    """Those of one run."""

    run: str
    scenario: Scenario
    network: Child | None
    """What joins the nodes' namespaces, where they have any."""
    recorder: Child | None
    nodes: Mapping[NodeId, Child]
    dials: Mapping[NodeId, str]
    """Where every node is dialled by those that only look, as the recorder does."""
    recorder_listens: str | None
    """Where observers reach the recorder: peers pass nothing on."""

    @property
    def everybody(self) -> list[Child]:
        """In the order in which they are started."""
        return [child for child in (self.network, self.recorder, *self.nodes.values()) if child is not None]

    def entry(self) -> Entry:
        """What observers on this machine need in order to look at the run."""
        transport, network = self.scenario.transport, self.network
        own = None if network is not None else transport.zenoh_config
        enter = network.status.get("enter", ()) if network is not None else ()
        return Entry(
            run=self.run,
            scenario=self.scenario.name,
            endpoints={str(i): endpoint for i, endpoint in self.dials.items()},
            recorder=self.recorder_listens,
            low_latency=transport.preset == "lowlatency",
            config=str(self.scenario.absolute(own)) if own else None,
            enter=tuple(enter[len(self.scenario.ids)]) if enter else (),
        )


def processes(
    scenario: Scenario,
    file: Path,
    *,
    run: str,
    logs: Path,
    recording: Path | None = None,
    netns: str | None = None,
    health_s: float = 0.0,
) -> Processes:
    """The processes of a run whose scenario is in `file`: see `LaunchOptions`. InputError where no ports are free."""
    listens, dials = _endpoints(scenario, netns)
    configured = netns is None and scenario.transport.zenoh_config is not None
    common = [str(file), "--run", run]
    nodes: dict[NodeId, Child] = {}
    for place, i in enumerate(scenario.ids):
        command = [*ZFUSION, "node", *common, "--id", str(i)]
        if not configured:
            command += _each("--listen", dict.fromkeys((listens[i], dials[i])))
            command += _each("--connect", dialled(scenario, i, listens))
        command += ["--await-recorder"] if recording is not None else []
        command += ["--no-emulation"] if netns is not None else []
        command += ["--health", str(health_s)] if health_s else []
        nodes[i] = Child(f"node {i}", i, command, logs / f"node-{i}.log", place)
    recorder, recorder_listens = None, None
    if recording is not None:
        command = [*ZFUSION, "record", *common, "-o", str(recording)]
        recorder_listens = ""
        if not configured:
            [recorder_listens] = free_endpoints(1)
            command += _each("--connect", [dials[i] for i in scenario.ids])
            command += ["--listen", recorder_listens]
        recorder = Child("the recorder", None, command, logs / "recorder.log", len(scenario.ids))
    network = None
    if netns is not None:
        command = [*ZFUSION, "network", *common, *(["--kind", netns] if netns != "auto" else [])]
        network = Child("the network", None, command, logs / "network.log")
    return Processes(run, scenario, network, recorder, nodes, dials, recorder_listens)


def _endpoints(scenario: Scenario, netns: str | None) -> tuple[Mapping[NodeId, str], Mapping[NodeId, str]]:
    """Where every node is dialled by the others, and where by the recorder."""
    ids = scenario.ids
    if netns is not None:
        where = places(ids)
        return {p.node: p.endpoint for p in where}, {p.node: p.recorder_dials for p in where}
    listens = dict(zip(ids, free_endpoints(len(ids)), strict=True)) | scenario.transport.endpoints
    return listens, listens


def _each(option: str, values: Collection[str]) -> list[str]:
    return [word for value in values for word in (option, value)]
