"""The network's process: makes the namespaces, tells the launcher how to enter them, and is the network between them.

Everything hangs on this one process: when it is gone, however it went, so are namespaces, devices and packets.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from typing import Any, Protocol

from zfusion.errors import InputError
from zfusion.links import LinkNetwork
from zfusion.links.rules import PACKETS, Rules
from zfusion.model.scenario import Scenario
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.addresses import Place, places
from zfusion.swarm.netns.choice import INSTEAD, Kind, check, choose
from zfusion.swarm.netns.netem import NetemNetwork, leaf
from zfusion.swarm.netns.tun import TunNetwork
from zfusion.swarm.netns.wires import wire_up

RIGHTS = "root (CAP_SYS_ADMIN and CAP_NET_ADMIN), or user namespaces"


class Joined(Protocol):
    """Namespaces that packets pass between."""

    def carry(self) -> None:
        """Carry packets until `stop`."""

    def stop(self) -> None:
        """End `carry`, from any thread."""

    def report(self) -> Mapping[str, Any]:
        """What went over it."""


class Network:
    """The network of one run."""

    def __init__(self, scenario: Scenario, wanted: Kind | None) -> None:
        """InputError where this machine, or this user, cannot have it; nothing is left of it then."""
        check(scenario)
        self._period_ns, self._steps = scenario.timing.period_ns, scenario.steps
        self._epoch_ns: int | None = None
        where = places(scenario.ids)
        try:
            self._in_user_namespace = _enter_a_namespace()
            self.choice = choose(scenario, wanted)
            self._namespaces = {place.node: kernel.new_namespace() for place in where}
            self._recorders = kernel.new_namespace()
            wire_up(where, self._namespaces)
            self._joined = self._join(scenario, where)
        except OSError as error:
            raise InputError(f"the kernel refuses: {error.strerror}; {INSTEAD}") from None
        except InputError as error:
            raise InputError(f"{error}; {INSTEAD}") from None

    def carry(self) -> None:
        """Carry packets until `stop`."""
        self._joined.carry()

    def stop(self) -> None:
        """End `carry`, from any thread."""
        self._joined.stop()

    def hear(self, word: Mapping[str, Any]) -> None:
        """The launcher says when step 0 is, from which on cuts and topologies are known; None: there are none now."""
        self._epoch_ns = word["epoch_ns"]

    def status(self) -> Mapping[str, Any]:
        """kind and why; enter: the words before a command that is to run in a node's namespace, in order of the nodes.

        The last are those for the recorder's.
        """
        process = f"/proc/{os.getpid()}"
        user = [f"--user={process}/ns/user", "--preserve-credentials"] if self._in_user_namespace else []
        namespaces = (*self._namespaces.values(), self._recorders)
        enter = [["nsenter", *user, f"--net={process}/fd/{namespace}", "--"] for namespace in namespaces]
        return {**self.choice._asdict(), "enter": enter}

    def report(self) -> Mapping[str, Any]:
        """What went over it: kind, why and what this kind of network counts."""
        return {**self.choice._asdict(), **self._joined.report()}

    def _join(self, scenario: Scenario, where: list[Place]) -> Joined:
        if self.choice.kind == "netem":
            return NetemNetwork(where, self._namespaces, lambda edge: leaf(Rules.of(scenario.links, edge, PACKETS)))
        links = LinkNetwork(scenario)
        return TunNetwork(where, self._namespaces, lambda edge: links.packet_model(edge, self._step_at))

    def _step_at(self, now_ns: int) -> int:
        """The step at a time; 0 before the first, after the last, and while nobody has said when they are.

        After the last no link is cut any more: the nodes are to hear each other out.
        """
        if self._epoch_ns is None or self._period_ns is None:
            return 0
        step = max(0, (now_ns - self._epoch_ns) // self._period_ns)
        return step if step <= self._steps else 0


def _enter_a_namespace() -> bool:
    """Be where nothing is reached by accident, with the rights to make more of it; True in a user namespace of its own.

    InputError where that cannot be.
    """
    if sys.platform != "linux":
        raise InputError("network namespaces are Linux's")
    if shutil.which("nsenter") is None:
        raise InputError("there is no nsenter (of util-linux)")
    try:
        kernel.new_namespace()
    except PermissionError:
        pass
    else:
        return False
    try:
        kernel.own_user_namespace()
        kernel.new_namespace()
    except OSError as error:
        raise InputError(f"network namespaces need {RIGHTS}: {error.strerror}") from None
    return True
