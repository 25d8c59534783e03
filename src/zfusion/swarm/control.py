"""The line between a launcher and the processes that it started: JSON, a line a message, over a socket pair.

    child -> launcher    {"status": {...}}  {"report": {...}}  {"error": "...", "exit_code": 2}
    launcher -> child    {"epoch_ns": ...}  stop

When the launcher is gone, however it went, the child reads the end of the line and stops.
"""

from __future__ import annotations

import ctypes
import json
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

STOP = b"stop\n"

MAX_LINE = 1 << 20
"""Longest message from a child: the report of a node with thousands of neighbours."""

_PR_SET_PDEATHSIG = 1


class ChildEnd:
    """A child's end of the line."""

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._lock = threading.Lock()
        self._unsent = b""

    def tell(self, **message: object) -> None:
        """Send a message; nothing happens where the launcher is gone.

        A status is not sent while the line is full of older ones: a launcher that stands still is not to hold up its
        swarm. Everything else waits for room.
        """
        with self._lock:
            try:
                if "status" not in message:
                    self._socket.sendall(self._unsent + json.dumps(message).encode() + b"\n")
                    self._unsent = b""
                    return
                if not self._unsent:
                    self._unsent = json.dumps(message).encode() + b"\n"
                self._unsent = self._unsent[self._socket.send(self._unsent, socket.MSG_DONTWAIT) :]
            except BlockingIOError:  # the line is full
                return
            except OSError:
                self._unsent = b""

    def on_stop(self, stop: Callable[[], None], hear: Callable[[Mapping[str, Any]], None] = lambda _: None) -> None:
        """Have `stop` called, from another thread, when the launcher says so or is gone; `hear`, what else it says."""
        threading.Thread(target=self._listen, args=(stop, hear), name="control", daemon=True).start()

    def _listen(self, stop: Callable[[], None], hear: Callable[[Mapping[str, Any]], None]) -> None:
        with (
            suppress(OSError),
            self._socket.makefile("rb", buffering=0) as lines,
        ):  # gone: the same as the end of the line
            for line in lines:
                if line == STOP:
                    break
                hear(json.loads(line))
        stop()


class LauncherEnd:
    """The launcher's end of the line to one child."""

    def __init__(self) -> None:
        """Makes the pair; `child` is to be passed on and then closed here."""
        self.socket, self.child = socket.socketpair()
        self._received = b""

    def stop(self) -> None:
        """Ask the child to stop."""
        self._send(STOP)

    def tell(self, **message: object) -> None:
        """Send a message; nothing happens where the child is gone."""
        self._send(json.dumps(message).encode() + b"\n")

    def _send(self, line: bytes) -> None:
        with suppress(OSError):  # it is gone already
            self.socket.sendall(line)

    def messages(self) -> Iterator[Mapping[str, Any]]:
        """What the child has said since the last call, without waiting."""
        while True:
            try:
                data = self.socket.recv(65536, socket.MSG_DONTWAIT)
            except (BlockingIOError, ConnectionError):
                break
            if not data:
                break
            self._received += data
        *lines, self._received = self._received.split(b"\n")
        if len(self._received) > MAX_LINE:
            self._received = b""
        for line in lines:
            yield json.loads(line)

    def close(self) -> None:
        """Close this end."""
        self.socket.close()


def on_death_of_parent(what: signal.Signals) -> None:
    """Have the kernel signal this process when the one that started it dies (Linux; elsewhere the line's end must do).

    For processes that may be stopped or stuck when that happens: SIGKILL for those that have nothing to save, SIGCONT
    for those that have.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, what)
