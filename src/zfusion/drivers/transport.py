"""Zenoh sessions as zfusion wants them.

Peers with explicit endpoints, no multicast, no gossip: a node is linked to whom its scenario names and to nobody else.
A session is open at once, whether or not the others are there yet; links come up in the background as they appear, and
liveliness tokens say who is there (docs/live.md).
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import stat
import struct
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx: (handover: app), acc: (handover: app), tx: (handover: app), net: (handover: app), "
    "app: (worker_threads: 1, max_blocking_threads: 50))",
)
# One thread for all of Zenoh's tasks: a node has a few small messages at a time, and threads only pass them on. Beside
# it there are those that wait for something, of which it makes more and more where links come and go under load.

import zenoh

from zfusion.drivers.endpoints import Endpoints
from zfusion.errors import InputError

HEAPS = 2
"""Of the C library, in the place of eight a processor. Zenoh works with some dozens of threads that come and go, and
each of them fills whatever heap it finds free: a recorder of 32 nodes was at 117 MiB after a quarter of an hour and
growing, 69 MiB of them in 15 heaps."""

_M_ARENA_MAX = -8

with suppress(OSError, AttributeError):  # other C libraries than glibc do not have it
    ctypes.CDLL(None).mallopt(_M_ARENA_MAX, HEAPS)

RETRY = {"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5}
"""A neighbour that comes up soon is linked within 20 ms, one that was away for long within a quarter of a second."""

LEASE_MS = 2000
"""A peer that neither closes nor answers (stopped, cut off) counts as gone after this; one that dies, at once."""

BLOCK_US = 60_000_000
"""How long a put may wait for a full link before Zenoh closes it and drops what is queued. Links are full when a peer
is slower than we are, which is no reason to lose its messages."""

MAX_RECEIVED = 16 << 20
"""Bytes of the largest message that a session puts together: what is larger is dropped piece by piece. Sixteen times
what zfusion's messages may have: too large ones are to be counted, but not to fill the memory."""

LOW_LATENCY = {"transport/unicast/qos/enabled": False, "transport/unicast/lowlatency": True}
"""About a third off a round trip. Both ends must have it, messages of 48 KiB and more vanish, priorities do too."""


RECEIPT = zenoh.TimestampInstrumentationBuilder().set_receive(True).build()
"""Has the receiving session stamp a message when it comes: 5 to 10 µs of work at each end."""


def open_session(
    endpoints: Endpoints, *, low_latency: bool = False, config_file: Path | None = None, mode: str = "peer"
) -> zenoh.Session:
    """An open Zenoh session; InputError, naming the endpoint or file, where Zenoh refuses it.

    A user's `config_file` comes first; the endpoints, where given, replace its own.
    """
    config = _base_config(config_file, mode, low_latency)
    if endpoints.listen:
        config.insert_json5("listen/endpoints", json.dumps(list(endpoints.listen)))
    if endpoints.connect:
        config.insert_json5("connect/endpoints", json.dumps(list(endpoints.connect)))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = f"listen {_listed(endpoints.listen)}, connect {_listed(endpoints.connect)}"
        raise InputError(f"Zenoh session ({where}): {_reason(error)}") from None


def never_linger() -> None:
    """Have no stream socket that this process has by now hold up the thread that closes it.

    Zenoh has a socket that is closed wait ten seconds for what the peer has not acknowledged, on the thread that all
    links share (its issues 1101 and 2350): one neighbour that is cut off would take the others with it. The kernel
    delivers what can be delivered all the same.
    """
    for number in map(int, os.listdir("/dev/fd")):
        with suppress(OSError):  # closed since it was listed
            if stat.S_ISSOCK(os.fstat(number).st_mode):
                with socket.socket(fileno=os.dup(number)) as link:
                    if link.type == socket.SOCK_STREAM and link.family in {socket.AF_INET, socket.AF_INET6}:
                        link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))


def publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """A publisher to the other sessions on `key`: nothing waits for a batch, nothing is dropped for being too much."""
    return session.declare_publisher(
        key,
        express=True,
        congestion_control=zenoh.CongestionControl.BLOCK,
        allowed_destination=zenoh.Locality.REMOTE,
        encoding=zenoh.Encoding("application/msgpack"),
    )


def on_zenoh_thread(callback: Callable[[Any], None]) -> Any:
    """A callback run on Zenoh's own thread, for one that only leaves a notice.

    (A thread of its own, Zenoh's default, would keep the process from exiting.)
    """
    return zenoh.handlers.Callback(callback, indirect=False)


def _base_config(config_file: Path | None, mode: str, low_latency: bool) -> zenoh.Config:
    if config_file is not None:
        try:
            config = zenoh.Config.from_file(str(config_file))
        except zenoh.ZError as error:
            raise InputError(f"{config_file}: not a Zenoh configuration: {_reason(error)}") from None
        config.insert_json5("timestamping/enabled", "true")
        return config
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 1,  # nothing is scouted: do not wait for it
        "listen/endpoints": [],
        "connect/endpoints": [],
        "connect/timeout_ms": -1,  # keep trying, in the background
        "connect/exit_on_failure": False,
        "connect/retry": RETRY,
        "timestamping/enabled": True,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_US,
        "transport/link/rx/max_message_size": MAX_RECEIVED,
        "transport/shared_memory/enabled": False,
    }
    for key, value in (settings | (LOW_LATENCY if low_latency else {})).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _listed(endpoints: Sequence[str]) -> str:
    return ", ".join(endpoints) or "nothing"


def _reason(error: Exception) -> str:
    """Zenoh's own words, without the source positions that it adds."""
    return str(error).split(" at /")[0].strip()


class Republisher:
    """Puts payloads on given keys, as their first senders did."""

    def __init__(self, session: zenoh.Session, keys: Iterable[str]) -> None:
        self._publishers = {key: publisher(session, key) for key in keys}

    @property
    def heard(self) -> bool:
        """Whether anybody subscribes to any of the keys."""
        # the stubs say bool; it is an object, always true, that has the answer
        return any(cast(Any, each.matching_status).matching for each in self._publishers.values())

    def put(self, key: str, data: bytes) -> None:
        """Put a payload on one of the keys."""
        self._publishers[key].put(data)
