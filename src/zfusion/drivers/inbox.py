"""Waiting on Zenoh: for one neighbour's next message, until a deadline, or until something else happens.

A message waits in a channel of its own key until it is wanted, so that a node which is ahead of its listeners is
held back by them, not by memory. Zenoh's channels can be waited on without a time limit only; what ends the wait
here is a *bell*: a message on the same key that never leaves this session, put there by a watching thread.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeVar

import zenoh

Channel = TypeVar("Channel", bound=Hashable)

CHANNEL = 256
"""Messages of one key that wait here; beyond that they wait in the sockets, and then at the sender."""

ECHO_S = 0.002
"""After this the bell is rung again if it was not heeded: the wait may have begun just after it."""


class Inbox:
    """The channels of a node, and its alarm clock."""

    def __init__(self, session: zenoh.Session) -> None:
        self.notices: deque[Any] = deque()
        """What happened besides messages, in order; filled by `notify` from any thread."""
        self._session = session
        self._channels: dict[Hashable, Any] = {}
        self._keys: dict[Hashable, str] = {}
        self._bell = os.urandom(16)
        self._waiting_on: str | None = None
        self._deadline_s = float("inf")
        self._target_s = float("inf")
        self._rung = False
        self._alarm = threading.Event()
        self._changed = threading.Condition()
        self._open = True
        self._watcher = threading.Thread(target=self._watch, name="inbox", daemon=True)
        self._watcher.start()

    def subscribe(self, source: Hashable, key: str, capacity: int = CHANNEL, bell: str | None = None) -> None:
        """Receive what is published on `key`; `bell` is a key that it matches, where it is an expression."""
        self._channels[source] = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(capacity))
        self._keys[source] = bell or key

    def poll(self, source: Hashable) -> bytes | None:
        """The next message, if there is one."""
        while (sample := self.poll_sample(source)) is not None:
            data: bytes = sample.payload.to_bytes()
            if data != self._bell:
                return data
        return None

    def poll_sample(self, source: Hashable) -> Any | None:
        """The next message as Zenoh gives it, which may be the bell, if there is one."""
        return self._channels[source].handler.try_recv()

    def wait(self, source: Hashable, deadline_ns: int | None) -> bytes | None:
        """The next message; None when the deadline has passed (wall clock) or there is a notice."""
        sample = self.wait_sample(source, deadline_ns)
        if sample is None:
            return None
        data: bytes = sample.payload.to_bytes()
        return None if data == self._bell else data

    def wait_sample(self, source: Hashable, deadline_ns: int | None) -> Any | None:
        """The next message as Zenoh gives it, which may be the bell; None where there is a notice already."""
        channel = self._channels[source].handler
        sample = channel.try_recv()
        if sample is None:
            self._set_deadline(deadline_ns)
            self._waiting_on = self._keys[source]
            if not self.notices:
                sample = channel.recv()
            self._waiting_on = None
            self._deadline_s = float("inf")
        return sample

    def rest(self, until_ns: int) -> bool:
        """Sleep until a time (wall clock); False if there is a notice before."""
        while not self.notices:
            left = (until_ns - time.time_ns()) / 1e9
            if left <= 0:
                return True
            self._alarm.wait(left)
            self._alarm.clear()
        return False

    def notify(self, notice: object) -> None:
        """Leave a notice and end whatever wait there is. For callbacks: it neither blocks nor calls Zenoh."""
        self.notices.append(notice)
        self._alarm.set()
        with self._changed:
            self._rung = True
            self._changed.notify()

    def drain(self, sources: Iterable[Channel], take: Callable[[Channel, bytes], None]) -> None:
        """Take all that has arrived from the given sources."""
        for source in sources:
            while (data := self.poll(source)) is not None:
                take(source, data)

    def close(self) -> None:
        """Stop receiving; what is still in the channels is dropped."""
        self._open = False
        with self._changed:
            self._changed.notify()
        self._watcher.join()
        for channel in self._channels.values():
            while channel.handler.try_recv() is not None:
                pass
            channel.undeclare()

    def _set_deadline(self, deadline_ns: int | None) -> None:
        """Deadlines mostly grow: the watcher, asleep until an earlier one, finds the later one by itself."""
        if deadline_ns is None:
            return
        left_s = (deadline_ns - time.time_ns()) / 1e9
        with self._changed:
            self._deadline_s = time.monotonic() + left_s
            if self._deadline_s < self._target_s:
                self._changed.notify()

    def _watch(self) -> None:
        while self._open:
            with self._changed:
                left_s = self._deadline_s - time.monotonic()
                if left_s > 0 and not self._rung:
                    self._target_s = self._deadline_s
                    self._changed.wait(None if left_s == float("inf") else left_s)
                    continue
            key = self._waiting_on
            if key is not None:
                self._session.put(key, self._bell, allowed_destination=zenoh.Locality.SESSION_LOCAL)
            with self._changed:
                self._changed.wait(ECHO_S)
                self._rung = bool(self.notices)
