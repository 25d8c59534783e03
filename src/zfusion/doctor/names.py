"""The endpoints that processes here are to dial: whether their names are known, and anybody is reached there."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor

from zfusion.doctor.finding import Finding, Topic
from zfusion.doctor.ground import Place

TOPIC = Topic("names")

TIMEOUT_S = 2.0
"""How long a connection may take: a round trip around the world is a fifth of a second."""

AT_ONCE = 32
"""Connections that are tried at the same time."""


def check_names(endpoints: Collection[str], timeout_s: float = TIMEOUT_S) -> Iterator[Finding]:
    """What becomes of a TCP connection to each of the endpoints; nothing is sent over it."""
    places = {endpoint: place for endpoint in endpoints if (place := Place.of(endpoint)) is not None}
    if not places:
        return
    with ThreadPoolExecutor(min(AT_ONCE, len(places))) as pool:
        found = dict(zip(places, pool.map(lambda place: reach(place, timeout_s), places.values()), strict=True))
    there = [endpoint for endpoint, fault in found.items() if fault is None]
    silent = [endpoint for endpoint, fault in found.items() if fault == errno.ECONNREFUSED]
    if there:
        yield TOPIC.ok(f"somebody listens at {', '.join(there)}")
    if silent:
        yield TOPIC.ok(f"reached, and nobody listens there yet: {', '.join(silent)}")
    for endpoint, fault in found.items():
        if isinstance(fault, str):
            why = "nobody here can dial it: the nodes there are waited for in vain"
            yield TOPIC.error(
                f"{endpoint}: the name is not known here ({fault})", why, "correct it, or enter it in DNS or /etc/hosts"
            )
        elif fault not in {None, errno.ECONNREFUSED}:
            told = "no answer" if fault == errno.ETIMEDOUT else os.strerror(fault or 0)
            remedy = "see that the machine is up, and its firewall and the routes between let TCP to this port pass"
            yield TOPIC.error(
                f"{endpoint}: {told} within {timeout_s:g} s", "links to it do not come up: it is waited for", remedy
            )


def reach(place: Place, timeout_s: float) -> int | str | None:
    """None where somebody listens; the errno of a connection that did not come about; in words, an unknown name.

    Of endpoints that are not over TCP only the name is looked up.
    """
    try:
        found = socket.getaddrinfo(place.host, place.port, type=place.kind)
    except (OSError, UnicodeError) as error:  # of a label that is empty or too long
        return getattr(error, "strerror", None) or str(error)
    if place.kind != socket.SOCK_STREAM:
        return None
    fault: int | None = errno.EHOSTUNREACH
    for family, kind, protocol, _, address in found:
        try:
            with socket.socket(family, kind, protocol) as probe:
                probe.settimeout(timeout_s)
                probe.connect(address)
        except TimeoutError:
            fault = errno.ETIMEDOUT
        except OSError as error:
            fault = error.errno or errno.EIO
        else:
            return None
    return fault
