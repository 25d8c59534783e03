"""Tells whoever supervises this process how it is doing: systemd by datagrams, a container's probes by a file.

    systemd      READY=1 when it is doing its work, STATUS= what that is, STOPPING=1 when it begins to end, WATCHDOG=1
                 as often as ``WATCHDOG_USEC`` asks for; to the socket that ``NOTIFY_SOCKET`` names
    health file  the same, as JSON, in the file that ``ZFUSION_HEALTH_FILE`` names; ``zfusion health`` reads it

The protocol is a datagram of a few words, https://www.freedesktop.org/software/systemd/man/sd_notify.html. The packages
that speak it have not been released for years, or are bindings of systemd's library, which a container does not have.

What shows that the process lives is a timer's signal, which Python handles on the main thread: between two steps, and
while that thread waits for a message, however long it does; not when it is stuck.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import socket
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zfusion.drivers import registry
from zfusion.drivers.metrics import RecorderReport
from zfusion.errors import InputError
from zfusion.status import Phase, Status

log = logging.getLogger(__name__)

HEALTH_FILE = "ZFUSION_HEALTH_FILE"
"""The environment variable that names the health file."""

BEAT_S = 2.0
"""How often the health file is written at least."""

SEND_S = 1.0
"""How long systemd may take to make room for a datagram; a few hundred fit."""

SAY_NS = 1_000_000_000
"""How often the step is told: people look at it."""


@dataclass(frozen=True, slots=True)
class Health:
    """How a process says that it is doing."""

    ready: bool
    """Whether it is doing its work: joined, not leaving yet."""
    status: str
    """In words."""
    pid: int
    at_ns: int
    """When, on the clock that never jumps, which all processes of a machine have in common."""
    birth: str | None = None
    """What tells the process from others that had, or will have, its id; None where it was not told."""

    @classmethod
    def read(cls, path: Path) -> Health:
        """What the file says; InputError where there is none, or something else."""
        try:
            told = json.loads(path.read_text())
            health = cls(**told)
            for name, kind in (("ready", bool), ("status", str), ("pid", int), ("at_ns", int)):
                if type(told[name]) is not kind:
                    raise TypeError(name)
            if not isinstance(health.birth, str | None):
                raise TypeError("birth")
        except OSError as error:
            raise InputError(f"{path}: no health file that can be read: {error.strerror}") from None
        except (ValueError, TypeError, KeyError):
            raise InputError(f"{path}: expected a health file, as processes write it into {HEALTH_FILE}") from None
        return health

    @property
    def gone(self) -> bool:
        """Whether the process has ended; for a reader on the machine, or in the container, that it is in."""
        return self.birth is not None and registry.birth(self.pid) != self.birth

    @property
    def age_s(self) -> float:
        """Seconds since it was told."""
        return (time.monotonic_ns() - self.at_ns) / 1e9


class Supervisor:
    """Whoever wants to know how this process is doing; may be nobody. A context manager: leaving it is stopping."""

    def __init__(self, address: str | None = None, file: Path | None = None, watchdog_s: float | None = None) -> None:
        """`address` is systemd's, `watchdog_s` the longest that it waits for a sign of life.

        InputError where the address is none.
        """
        self._address = None if address is None else _address(address)
        self._file = file
        beats = [BEAT_S] if file is not None else []
        if watchdog_s is not None and address is not None:
            beats.append(watchdog_s / 2)
        self._beat_s = min(beats, default=None)
        self._ready = self._stopping = self._busy = self._failed = False
        self._status = "starting"
        self._unsaid: list[str] = []
        self._said_ns = 0

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> Self:
        """The one that the environment names; InputError where it does so wrongly."""
        file, usec = environment.get(HEALTH_FILE), environment.get("WATCHDOG_USEC")
        watchdog_s = None
        if usec is not None and environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid()):
            if not usec.isdecimal() or not int(usec):
                raise InputError(f"WATCHDOG_USEC: expected microseconds, above 0 (is {usec!r})")
            watchdog_s = int(usec) / 1e6
        return cls(environment.get("NOTIFY_SOCKET") or None, Path(file) if file else None, watchdog_s)

    @property
    def there(self) -> bool:
        """Whether anybody wants to know."""
        return self._address is not None or self._file is not None

    def __enter__(self) -> Self:
        if self._beat_s is not None:
            signal.signal(signal.SIGALRM, lambda *_: self._beat())
            signal.setitimer(signal.ITIMER_REAL, self._beat_s, self._beat_s)
        if self.there:
            self._say("starting")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.there:
            self.stopping("ended" if error is None else f"failed: {error}")
        if self._beat_s is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)

    def ready(self, status: str) -> None:
        """The process does its work now, which is `status`; may be told again and again."""
        first, self._ready = not self._ready, True
        if first or time.monotonic_ns() - self._said_ns >= SAY_NS:
            self._say(status, "READY=1" if first else "")

    def waiting(self, status: str) -> None:
        """The process is on its way to its work, or not doing it at present."""
        if status != self._status:
            self._say(status)

    def stopping(self, status: str) -> None:
        """The process begins to end."""
        first, self._stopping, self._ready = not self._stopping, True, False
        self._say(status, "STOPPING=1" if first else "")

    def node(self, status: Status) -> None:
        """A node is doing so."""
        match status.phase:
            case Phase.JOINING:
                self.waiting("joining: waits for its neighbours")
            case Phase.RUNNING:
                told = f"{status.completed} completed, {status.fallbacks} fallbacks"
                self.ready(f"running: step {status.step}, {told}")
            case Phase.DONE:
                self.stopping(f"done: {status.completed} completed; stays until all have its last messages")

    def recorder(self, report: RecorderReport) -> None:
        """A recorder is doing so."""
        self.ready(f"recording: {report.messages} messages")

    def _say(self, status: str, news: str = "") -> None:
        self._status, self._said_ns = " ".join(status.split()), time.monotonic_ns()
        if news:
            self._unsaid.append(news)
        self._tell(f"STATUS={self._status}")

    def _beat(self) -> None:
        if not self._busy:  # what this has interrupted is a sign of life itself
            self._tell("WATCHDOG=1")

    def _tell(self, words: str) -> None:
        """Tell systemd, and write the file; once in the log where one of them fails: it is no reason to end."""
        self._busy = True
        for tell in (self._send, self._write):
            try:
                tell(words)
            except OSError as error:
                if not self._failed:
                    log.warning("cannot tell how this process is doing: %s", error)
                self._failed = True
        self._busy = False

    def _send(self, words: str) -> None:
        """To systemd, with the news that it could not be told before."""
        if self._address is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.settimeout(SEND_S)
            sender.sendto("\n".join((*self._unsaid, words)).encode(), self._address)
        self._unsaid.clear()

    def _write(self, _words: str) -> None:
        """To the file, whole."""
        if self._file is None:
            return
        pid = os.getpid()
        health = Health(self._ready, self._status, pid, time.monotonic_ns(), registry.birth(pid))
        whole = self._file.with_name(f".{self._file.name}.{pid}")
        whole.write_text(json.dumps(asdict(health)))
        whole.replace(self._file)


def verdict(health: Health, *, alive: bool, within_s: float) -> tuple[bool, dict[str, Any]]:
    """Whether a process is well, or at least `alive`: there, and has shown so `within_s`; and what is known of it."""
    gone = health.gone
    well = not gone and health.age_s <= within_s and (alive or health.ready)
    status = f"gone; its last word: {health.status}" if gone else health.status
    return well, {"ok": well, "ready": health.ready, "status": status, "age_s": round(health.age_s, 3)}


def _address(text: str) -> str | bytes:
    """A socket's address as systemd writes it: a path, or with ``@`` for the zero byte of an abstract one."""
    if text.startswith("@") and len(text) > 1:
        return b"\0" + text[1:].encode()
    if text.startswith("/"):
        return text
    raise InputError(f"NOTIFY_SOCKET: expected a path, or '@' and a name (is {text!r})")
