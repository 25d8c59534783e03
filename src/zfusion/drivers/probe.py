"""Why somebody whom this process dials does not come: Zenoh keeps trying, and says nothing.

The same endpoint is dialled once more, beside Zenoh and by the standard library: a TCP connection, and with TLS a
handshake with this process' own certificate. What that fails with is the reason, where there is one to be seen from
here; whom others dial, they can tell.
"""

from __future__ import annotations

import logging
import re
import socket
import ssl
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from zfusion.drivers.credentials import Credentials, common_name_of, reason_of

log = logging.getLogger(__name__)

WORD_NS = 5_000_000_000
"""How often who waits for others says for whom."""

PATIENCE_S = 2.0
"""How long a connection may take that is only to show why there is none."""

ALERT_S = 0.5
"""How soon the other end says, after its handshake, that it does not want this certificate."""

NO_CONNECTION: dict[type[OSError], str] = {
    TimeoutError: "nobody answers: is the host up, and the port open?",
    socket.gaierror: "its name cannot be looked up",
    ConnectionRefusedError: "the connection is refused: nothing listens there",
}

ENDPOINT = re.compile(r"(tcp|tls)/(?:\[([^\]]+)\]|([^:/?#\[\]]+)):(\d+)(?:[?#].*)?")


@dataclass(frozen=True, slots=True)
class Route:
    """Somebody whom this process dials."""

    endpoint: str
    credentials: Credentials | None = None
    """What it shows there, where links are TLS."""
    names: frozenset[str] = frozenset()
    """The common names that its rules know; none where there are no rules."""


def trouble(route: Route) -> str | None:
    """Why there is no link to somebody, in words; None where nothing is to be seen of that from here."""
    found = ENDPOINT.fullmatch(route.endpoint)
    if found is None:
        return None
    protocol, host = found[1], found[2] or found[3]
    try:
        with socket.create_connection((host, int(found[4])), PATIENCE_S) as link:
            if protocol == "tcp" or route.credentials is None:
                return None
            return _trouble_of_tls(link, route, route.credentials, host)
    except OSError as error:
        reasons = (reason for kind, reason in NO_CONNECTION.items() if isinstance(error, kind))
        return next(reasons, f"no connection: {error.strerror or error}")


def _trouble_of_tls(link: socket.socket, route: Route, credentials: Credentials, host: str) -> str | None:
    context = ssl.create_default_context(cafile=str(credentials.authority))
    context.load_cert_chain(credentials.certificate, credentials.key)
    try:
        with context.wrap_socket(link, server_hostname=host) as secured:
            name = common_name_of(secured.getpeercert() or {})
            if route.names and name not in route.names:
                return f"it is {name!r}, of whom this process' rules know nothing"
            secured.settimeout(ALERT_S)
            return None if secured.recv(1) else "it hangs up"
    except TimeoutError:
        return None  # it waits for Zenoh's greeting
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is refused here: {reason_of(error)}"
    except ssl.SSLError as error:
        return f"it refuses this process' certificate, or TLS: {(error.reason or str(error)).replace('_', ' ').lower()}"


class Prober:
    """Says in the log why there is no link, when asked to, on a thread of its own."""

    def __init__(self, routes: Sequence[Route]) -> None:
        self._routes = routes
        self._thread: threading.Thread | None = None

    def look(self) -> None:
        """Look into all routes, unless that is being done already."""
        if self._routes and (self._thread is None or not self._thread.is_alive()):
            self._thread = threading.Thread(target=self._look, name="probe", daemon=True)
            self._thread.start()

    def _look(self) -> None:
        for route in self._routes:
            why = trouble(route)
            if why is not None:
                log.warning("%s: %s", route.endpoint, why)


class Waiting:
    """Says, now and then, for whom this process waits, and has the reason looked for."""

    def __init__(self, prober: Prober, due_ns: int) -> None:
        """`due_ns` is when it is said for the first time, on the caller's clock."""
        self.due_ns = due_ns
        self._prober = prober

    def tell(self, now_ns: int, missing: Callable[[], Sequence[str]], *, linked: bool = False) -> None:
        """Say who is `missing`, if it is time to; where all are `linked`, no link is looked into."""
        if now_ns < self.due_ns:
            return
        self.due_ns = now_ns + WORD_NS
        log.warning("waiting for %s", ", ".join(missing()))
        if not linked:
            self._prober.look()
