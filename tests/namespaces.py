"""Hosts made of network namespaces, each with an address of its own, on one bridge; nothing of them stays."""

from __future__ import annotations

import os
import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from ipaddress import IPv4Interface
from typing import Any

from zfusion.errors import InputError
from zfusion.swarm.netns import kernel
from zfusion.swarm.netns.wires import run, veth

NETWORK = "10.77.0"
"""The hosts' addresses are .1, .2, ... in it; it is nobody else's, as the namespaces are joined with nothing else."""

DEVICE = "eth0"


def in_a_thread_of_its_own(function: Callable[[], Any]) -> Any:
    """What a function returns that may change the namespace of the thread that it runs in; or its exception."""
    outcome: list[Any] = []

    def call() -> None:
        try:
            outcome.append(function())
        except (OSError, InputError) as error:
            outcome.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    return outcome[0]


class Hosts:
    """Some hosts on one network."""

    def __init__(self, names: Iterable[str]) -> None:
        """OSError or InputError where the kernel refuses."""
        self.addresses = {name: f"{NETWORK}.{n}" for n, name in enumerate(names, 1)}
        self._open: list[int] = []
        self._namespaces: dict[str, int] = {}
        made = in_a_thread_of_its_own(self._make)
        if isinstance(made, Exception):
            self.close()
            raise made

    def entrance(self, name: str) -> tuple[str, ...]:
        """The words before a command that have it run on a host."""
        return ("nsenter", f"--net=/proc/{os.getpid()}/fd/{self._namespaces[name]}", "--")

    def close(self) -> None:
        """Take them away; what still runs on them keeps them."""
        for descriptor in self._open:
            os.close(descriptor)
        self._open.clear()

    def _make(self) -> None:
        for name in self.addresses:
            self._namespaces[name] = self._new()
        self.hub = self._new()  # this thread stays in it
        run("ip", list(self._bridge()))
        for name, address in self.addresses.items():
            with kernel.inside(self._namespaces[name]):
                kernel.set_address(DEVICE, IPv4Interface(f"{address}/24"))

    def _new(self) -> int:
        self._open.append(kernel.new_namespace())
        return self._open[-1]

    def _bridge(self) -> Iterator[str]:
        yield "link add name bridge type bridge"
        yield "link set dev bridge up"
        for n, name in enumerate(self.addresses):
            yield veth(f"p{n}", DEVICE, self._namespaces[name])
            yield f"link set dev p{n} master bridge"
            yield f"link set dev p{n} up"


@contextmanager
def hosts(names: Iterable[str]) -> Iterator[Hosts]:
    """Hosts, for as long as they are needed."""
    made = Hosts(names)
    try:
        yield made
    finally:
        made.close()


def why_none() -> str | None:
    """Why there can be no such hosts here; None where there can be."""
    try:
        with hosts(["a"]) as made:
            words = made.entrance("a")
            subprocess.run([*words, "true"], check=True, capture_output=True)
    except (OSError, InputError, subprocess.CalledProcessError) as error:
        return str(error)
    return None
