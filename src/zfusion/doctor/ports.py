"""The endpoints that processes here are to listen at: whether they can be had."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from zfusion.doctor.finding import Finding, Topic
from zfusion.doctor.ground import Place

TOPIC = Topic("ports")

TABLES = {socket.SOCK_STREAM: ("tcp", "tcp6"), socket.SOCK_DGRAM: ("udp", "udp6")}


def check_ports(listens: Mapping[str, str], named: Iterable[str]) -> Iterator[Finding]:
    """`listens`: endpoints, and who is to listen there; `named` are those that somebody has written down.

    `launch` finds ports of its own for the others.
    """
    free, named = [], set(named)
    for endpoint, who in listens.items():
        place = Place.of(endpoint)
        if place is None:
            yield TOPIC.warning(
                f"{endpoint}, of {who}, was not tried", "it has no port", "see that it can be listened at"
            )
            continue
        fault = why_not(place)
        if fault is None:
            free.append(endpoint)
        else:
            yield _finding(f"{endpoint}, of {who}: {os.strerror(fault)}", fault, place, endpoint in named)
    if free:
        yield TOPIC.ok(f"free: {', '.join(free)}")


def why_not(place: Place) -> int | None:
    """The errno of trying to listen there; None where it can be done."""
    try:
        [(family, kind, protocol, _, address), *_] = socket.getaddrinfo(place.host, place.port, type=place.kind)
        with socket.socket(family, kind, protocol) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as Zenoh does
            probe.bind(address)
            if kind == socket.SOCK_STREAM:
                probe.listen(1)
    except (socket.gaierror, UnicodeError):
        return errno.EADDRNOTAVAIL
    except OSError as error:
        return error.errno or errno.EIO
    return None


def _finding(what: str, fault: int, place: Place, named: bool) -> Finding:
    if fault == errno.EADDRINUSE:
        user = user_of(place)
        what = f"{what}: by {user}" if user else f"{what}: by a process that only root can see"
        remedy = "end that process, or give another port (transport.endpoints, base_port; port in the hosts file)"
        if not named:
            why = "zfusion node cannot listen there; zfusion launch takes other ports"
            return TOPIC.warning(what, why, remedy)
        return TOPIC.error(what, "the node cannot listen there, and does not start", remedy)
    if fault in {errno.EACCES, errno.EPERM}:
        remedy = "a port from 1024 on, or the capability CAP_NET_BIND_SERVICE"
        return TOPIC.error(what, "ports below 1024 are only for whoever has the right", remedy)
    if fault == errno.EADDRNOTAVAIL:
        remedy = "correct the address (behind a NAT or in a container: bind in the hosts file)"
        return TOPIC.error(what, "this machine has no such address: nobody can listen at it", remedy)
    return TOPIC.error(what, "the node cannot listen there, and does not start", "give another endpoint")


def user_of(place: Place) -> str | None:
    """The process that has a port, as "name, pid 7"; None where that cannot be seen."""
    inodes = set(_sockets_at(place))
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            for file in (process / "fd").iterdir():
                if os.readlink(file).removeprefix("socket:[").removesuffix("]") in inodes:
                    return f"{(process / 'comm').read_text().strip()}, pid {process.name}"
    return None


def _sockets_at(place: Place) -> Iterator[str]:
    """The inodes of sockets that wait on a port, whatever the address."""
    for table in TABLES[place.kind]:
        with suppress(OSError):
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
                words = line.split()
                waits = words[3] in {"0A", "07"}  # TCP: LISTEN; UDP: bound
                if waits and int(words[1].rpartition(":")[2], 16) == place.port:
                    yield words[9]
