"""Zenoh sessions as zfusion wants them.

Peers with explicit endpoints, no multicast, no gossip: a node is linked to whom its scenario names and to nobody else.
A session is open at once, whether or not the others are there yet; links come up in the background as they appear, and
liveliness tokens say who is there (docs/live.md).
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import socket
import stat
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, cast

os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx: (handover: app), acc: (handover: app), net: (handover: app), tx: (worker_threads: 1), "
    "app: (worker_threads: 1, max_blocking_threads: 50))",
)
# Two threads for Zenoh's tasks: a node has a few small messages at a time, and threads only pass them on. Sending has
# one of its own: the other may have to wait for a place in the queue of a link, as when it ends a query that this node
# has answered, and would wait for itself if it had to make that place. Beside them there are those that wait for
# something, of which Zenoh makes more and more where links come and go under load.

import zenoh

from zfusion.drivers.credentials import RENEW, Credentials, dialled_at, prove
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.probe import Prober, Route, Waiting
from zfusion.drivers.settings import LOOK, base_settings
from zfusion.errors import InputError

log = logging.getLogger(__name__)

HEAPS = 2
"""Of the C library, in the place of eight a processor. Zenoh works with some dozens of threads that come and go, and
each of them fills whatever heap it finds free: a recorder of 32 nodes was at 117 MiB after a quarter of an hour and
growing, 69 MiB of them in 15 heaps."""

_M_ARENA_MAX = -8

with suppress(OSError, AttributeError):  # other C libraries than glibc do not have it
    ctypes.CDLL(None).mallopt(_M_ARENA_MAX, HEAPS)

SOON = timedelta(days=14)
"""How long before it expires a certificate is spoken of."""

UNREACHED = "Unable to connect to any of"
"""What Zenoh says when a client reaches none of its routers."""

FLOWS = ("ingress", "egress")
"""The ways that a rule of Zenoh's is about where it does not say which."""

AGAIN_S = 0.25
"""How soon a client tries its routers again."""

RECEIPT = zenoh.TimestampInstrumentationBuilder().set_receive(True).build()
"""Has the receiving session stamp a message when it comes: 5 to 10 µs of work at each end."""


def open_session(
    endpoints: Endpoints,
    *,
    low_latency: bool = False,
    config_file: Path | None = None,
    mode: str = "peer",
    name: str | None = None,
    looks: bool = False,
) -> zenoh.Session:
    """An open Zenoh session; InputError, naming the endpoint or file, where Zenoh refuses it.

    A user's `config_file` comes first; the endpoints, where given, replace its own. Where it has certificates they are
    proven first, as those of `name` where there are rules about names. One that only `looks` has no time for those who
    say nothing.
    """
    config = _config(endpoints, config_file, mode, low_latency)
    for path, value in LOOK.items() if looks else ():
        config.insert_json5(path, json.dumps(value))
    _prove(config, name)
    try:
        return _opened(config)
    except zenoh.ZError as error:
        where = ", ".join(f"{end} {', '.join(_endpoints(config, end)) or 'nothing'}" for end in ("listen", "connect"))
        by = "" if config_file is None else f" by {config_file}"
        raise InputError(f"Zenoh session{by} ({where}): {_reason(error)}") from None


def prober(endpoints: Endpoints, config_file: Path | None = None) -> Prober:
    """What can say why those that a session dials do not come; given what the session is opened with."""
    return _prober(_config(endpoints, config_file=config_file))


def may_ask(key: str, config_file: Path | None) -> bool:
    """Whether the rules in a session's configuration let it ask about a key; InputError where it is none."""
    default, exceptions = _permissions(config_file, "query")
    excepted = any(zenoh.KeyExpr(about).includes(zenoh.KeyExpr(key)) for about in exceptions)
    return excepted == (default == "deny")


@contextmanager
def closing(session: zenoh.Session) -> Iterator[zenoh.Session]:
    """Close a session in the end.

    One with a link to somebody who is cut off may not close within Zenoh's ten seconds. That is told, and no reason to
    lose what its process has to report: the link ends with the process.
    """
    try:
        yield session
    finally:
        try:
            session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            log.warning("not all links were closed: %s", _reason(error))


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


def subscribable(config_file: Path) -> list[str] | None:
    """The key expressions that the rules of a configuration let its process subscribe to; None without such rules."""
    default, exceptions = _permissions(config_file, "declare_subscriber")
    return sorted(exceptions) if default == "deny" else None


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


def _config(
    endpoints: Endpoints, config_file: Path | None = None, mode: str = "peer", low_latency: bool = False
) -> zenoh.Config:
    config = _base_config(config_file, mode, low_latency)
    for what, given in (("listen", endpoints.listen), ("connect", endpoints.connect)):
        if given:
            try:
                config.insert_json5(f"{what}/endpoints", json.dumps(list(given)))
            except zenoh.ZError:
                expected = "expected Zenoh endpoints, like tcp/10.0.0.1:7450"
                raise InputError(f"{what}: {expected} (is {', '.join(given)})") from None
    return config


def _opened(config: zenoh.Config) -> zenoh.Session:
    """A session; a client's when one of its routers is there, which Zenoh does not wait for."""
    waiting = Waiting(_prober(config), time.monotonic_ns())
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            if _setting(config, "mode") != "client" or UNREACHED not in str(error):
                raise
        waiting.tell(time.monotonic_ns(), lambda: ["a router"])
        time.sleep(AGAIN_S)


def _permissions(config_file: Path | None, message: str) -> tuple[str, set[str]]:
    """What the rules of a configuration say of sending such a message: by default, and on which keys the contrary."""
    rules = _setting(_config(Endpoints(), config_file), "access_control")
    if not rules["enabled"]:
        return "allow", set()
    contrary = (rule for rule in rules["rules"] or () if rule["permission"] != rules["default_permission"])
    about = (rule for rule in contrary if message in rule["messages"] and "egress" in (rule["flows"] or FLOWS))
    return rules["default_permission"], {key for rule in about for key in rule["key_exprs"]}


def _setting(config: zenoh.Config, path: str) -> Any:
    return json.loads(config.get_json(path))


def _prober(config: zenoh.Config) -> Prober:
    credentials = Credentials.of(_setting(config, "transport/link/tls"))
    subjects = _setting(config, "access_control/subjects") or []
    names = frozenset(name for subject in subjects for name in subject.get("cert_common_names") or ())
    connecting = credentials[-1] if credentials else None
    return Prober([Route(endpoint, connecting, names) for endpoint in _endpoints(config, "connect")])


def _endpoints(config: zenoh.Config, end: str) -> list[str]:
    """Where a session of this configuration will "listen", or whom it will "connect" to."""
    endpoints = _setting(config, f"{end}/endpoints")
    if isinstance(endpoints, dict):  # by the mode of the session
        endpoints = endpoints.get(_setting(config, "mode") or "peer", [])
    return [endpoint for endpoint in endpoints if isinstance(endpoint, str)]


def _base_config(config_file: Path | None, mode: str, low_latency: bool) -> zenoh.Config:
    if config_file is not None:
        try:
            config = zenoh.Config.from_file(str(config_file))
        except zenoh.ZError as error:
            raise InputError(f"{config_file}: not a Zenoh configuration: {_reason(error)}") from None
        config.insert_json5("timestamping/enabled", "true")
        return config
    config = zenoh.Config()
    for key, value in base_settings(mode, low_latency=low_latency).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _prove(config: zenoh.Config, name: str | None) -> None:
    """See that the certificates of a configuration are good, before Zenoh waits with them for ever."""
    by_names = _setting(config, "access_control/enabled")
    tls = _setting(config, "transport/link/tls")
    for credentials in Credentials.of(tls):
        address = dialled_at(_setting(config, "metadata")) if credentials == Credentials.at(tls, "listen") else None
        proven = prove(credentials, common_name=name if by_names else None, address=address)
        left = proven.ends - datetime.now(UTC)
        if left < SOON:
            log.warning("%s expires in %d days: %s", credentials.certificate, left.days, RENEW)


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
