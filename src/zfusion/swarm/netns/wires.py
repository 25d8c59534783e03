"""The recorder's wires: from its namespace a veth pair to every node, so that what it hears is not delayed or lost.

They do not pass through the network between the nodes, whatever that is, and do not burden it.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from shutil import which

from zfusion.errors import InputError
from zfusion.model.types import NodeId
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.addresses import Place

SYSTEM_PATH = "/usr/sbin:/sbin"
"""Where `tc` is, and what is not on everybody's PATH."""

NODES_END = "recorder"
"""The device at the node's end; at the recorder's they are numbered."""


def wire_up(places: Sequence[Place], namespaces: Mapping[NodeId, int]) -> None:
    """Make the wires, in this thread's namespace, the recorder's. InputError or OSError where the kernel refuses."""
    run("ip", list(pairs(places, namespaces)))
    for place in places:
        at_node, at_recorder = place.wire
        kernel.set_address(_recorders_end(place), at_recorder)
        with kernel.inside(namespaces[place.node]):
            kernel.set_address(NODES_END, at_node)


def pairs(places: Sequence[Place], namespaces: Mapping[NodeId, int]) -> Iterator[str]:
    """The commands for `ip`."""
    for place in places:
        yield veth(_recorders_end(place), NODES_END, namespaces[place.node])


def veth(name: str, peer: str, namespace: int) -> str:
    """The command that makes a veth pair: `name` here, `peer` in the namespace of that descriptor."""
    return f"link add name {name} type veth peer name {peer} netns /proc/{os.getpid()}/fd/{namespace}"


def run(program: str, commands: Sequence[str]) -> None:
    """Have `ip` or `tc` carry out commands in this thread's namespace; InputError with its words where it does not."""
    path = f"{os.environ.get('PATH', os.defpath)}:{SYSTEM_PATH}"
    try:
        done = subprocess.run(
            [which(program, path=path) or program, "-batch", "-"],
            input="\n".join(commands),
            capture_output=True,
            text=True,
            check=False,
        )
    except FileNotFoundError:
        raise InputError(f"there is no {program} (of iproute2)") from None
    if done.returncode:
        said = next(iter(done.stderr.splitlines()), f"exit code {done.returncode}")
        raise InputError(f"{program}: {said.removeprefix('Error: ')}")


def _recorders_end(place: Place) -> str:
    return f"node{place.number}"
