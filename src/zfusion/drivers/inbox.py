"""Waiting on Zenoh: for one neighbour's next message, until a deadline, or until something else happens.

A message waits in a channel of its own key until it is wanted. Zenoh's channels can be waited on without a time limit
only; what ends a wait here is a *bell*: a message on the same key that never leaves this session, put there by a
watching thread. A wait is ended, too, when it has gone on for a while: a channel that nobody reads may be full by then,
and a full one holds up all that comes to this session.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple, TypeVar

import zenoh

from zfusion.drivers.clocks import Clock
from zfusion.drivers.transport import on_zenoh_thread

Content = TypeVar("Content")

Letter = tuple[bytes, int, int | None]
"""(payload, when it was looked at, when it had come to this machine: known where its sender asked for that stamp)."""

CHANNEL = 16_384
"""Messages of one key that wait here; beyond that they wait in the sockets, and then at the sender. Room for what a
swarm says while one of its nodes, just restarted, gets ready to follow it."""

STRETCH_NS = 10_000_000
"""How long a wait may go on before it is ended so that the other channels can be looked into: far longer than the waits
of a swarm in step, far shorter than deadlines of seconds."""

POSTED = 65_536
"""Messages that wait where they do not wait in channels; beyond it they are dropped, and counted."""

POSTED_BYTES = 256 << 20
"""And what all of them together may have: no sender is to fill the memory with few large ones. Seconds of a swarm whose
messages are as large as they may be."""

NEVER = 2**63
"""Later than every time on the clock, in nanoseconds."""


class Wake:
    """Ends another thread's wait, or its next one.

    Unlike `threading.Event` it may be used in a signal handler, whatever the thread that this interrupts is doing.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()

    def set(self) -> None:
        """End the wait. Twice is once."""
        with suppress(RuntimeError):  # it is set already
            self._lock.release()

    def wait(self, seconds: float) -> None:
        """Wait for `set`, at most so long."""
        self._lock.acquire(timeout=min(seconds, threading.TIMEOUT_MAX))


class Posted:
    """Messages from Zenoh's thread to its owner's, in the order of coming: bounded in number and in bytes."""

    def __init__(self) -> None:
        self._letters: deque[tuple[Any, bytes, int]] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._letters)

    def add(self, source: Any, data: bytes, time_ns: int) -> bool:
        """False where there is no room."""
        with self._lock:
            if len(self._letters) >= POSTED or self._bytes + len(data) > POSTED_BYTES:
                return False
            self._bytes += len(data)
            self._letters.append((source, data, time_ns))
            return True

    def take(self) -> tuple[Any, bytes, int] | None:
        """(source, payload, time) of the first, if there is one."""
        if not self._letters:
            return None
        with self._lock:
            letter = self._letters.popleft()
            self._bytes -= len(letter[1])
            return letter


class _Wait(NamedTuple):
    """One wait of the owner's thread; each is an object of its own."""

    key: str
    deadline_ns: int


class Inbox:
    """The channels of a node, and its alarm clock. For one thread; `notify` is for all."""

    def __init__(self, session: zenoh.Session, clock: Clock | None = None) -> None:
        """All times are `clock`'s; by default the machine's."""
        self.notices: deque[Any] = deque()
        """What happened besides messages, in order; filled by `notify` from any thread."""
        self.posted = Posted()
        """What came from sources that are not read one by one."""
        self.overrun = 0
        """What came from them and was dropped, being too much."""
        self._session = session
        self._clock = clock or Clock()
        self._now = self._clock.now
        self._channels: dict[Hashable, Any] = {}
        self._keys: dict[Hashable, str] = {}
        self._bell = os.urandom(16)
        self._posters: list[Any] = []
        self._bells: list[threading.Thread] = []
        """That may still be ringing."""
        self._wait: _Wait | None = None
        self._alarm = Wake()
        self._nudge = Wake()
        self._wakes_ns = 0
        """When the watcher looks again, by itself."""
        self._open = True
        self._watcher = threading.Thread(target=self._watch, name="inbox", daemon=True)
        self._watcher.start()

    def subscribe(self, source: Hashable, key: str, capacity: int = CHANNEL, bell: str | None = None) -> None:
        """Receive what is published on `key`; `bell` is a key that it matches, where it is an expression."""
        self._channels[source] = self._session.declare_subscriber(key, zenoh.handlers.FifoChannel(capacity))
        self._keys[source] = bell or key

    def subscribe_posted(self, source: Hashable | None, key: str) -> None:
        """Have what is published on `key` go to `posted` as it comes; of no `source` but the key that it is on."""

        def post(sample: Any) -> None:
            data = sample.payload.to_bytes()
            if self.posted.add(str(sample.key_expr) if source is None else source, data, self._now()):
                self._alarm.set()
            else:
                self.overrun += 1

        self._posters.append(self._session.declare_subscriber(key, on_zenoh_thread(post)))

    def poll_sample(self, source: Hashable) -> Any | None:
        """The next message as Zenoh gives it, which may be the bell, if there is one."""
        return self._channels[source].handler.try_recv()

    def wait(self, source: Hashable, deadline_ns: int | None) -> Letter | None:
        """The next message; None when the deadline has passed, there is a notice, or for a change."""
        sample = self.wait_sample(source, deadline_ns)
        return None if sample is None else self._letter(sample)

    def wait_sample(self, source: Hashable, deadline_ns: int | None) -> Any | None:
        """The next message as Zenoh gives it, which may be the bell; None where there is a notice already."""
        channel = self._channels[source].handler
        sample = channel.try_recv()
        if sample is None:
            wait = self._wait = _Wait(self._keys[source], NEVER if deadline_ns is None else deadline_ns)
            if wait.deadline_ns <= self._wakes_ns:
                self._nudge.set()
            if not self.notices:
                sample = channel.recv()
            self._wait = None
        return sample

    def rest(self, until_ns: int, *, or_posted: bool = False) -> bool:
        """Sleep until a time; False if there is a notice before or, where that is asked for, something is posted."""
        while not self.notices and not (or_posted and self.posted):
            left_ns = until_ns - self._now()
            if left_ns <= 0:
                return True
            self._alarm.wait(left_ns / 1e9)
        return False

    def notify(self, notice: object) -> None:
        """Leave a notice and end whatever wait there is. For callbacks and signal handlers: it does not block."""
        self.notices.append(notice)
        self._alarm.set()
        self._nudge.set()

    def take_notices(self) -> Iterator[Any]:
        """The notices that are there now, taken as they are asked for; None, which only ends waits, is left out.

        Others may be left meanwhile, by any thread: they are for the next time.
        """
        for _ in range(len(self.notices)):
            notice = self.notices.popleft()
            if notice is not None:
                yield notice

    def arrived(self, source: Hashable, read: Callable[[bytes], Content | None]) -> Iterator[tuple[Content, Letter]]:
        """The messages that have arrived and of which `read` makes anything, taken as they are asked for.

        Ends after a whole channel at the latest: those who send may be quicker than we are.
        """
        receive = self._channels[source].handler.try_recv
        for _ in range(CHANNEL):
            sample = receive()
            if sample is None:
                return
            data: bytes = sample.payload.to_bytes()
            if data != self._bell and (content := read(data)) is not None:
                yield content, (data, self._now(), self._received(sample))

    def close(self) -> None:
        """Stop receiving; what is still in the channels is dropped."""
        self._open = False
        self._nudge.set()
        self._watcher.join()
        for channel in (*self._channels.values(), *self._posters):
            channel.undeclare()  # a session with a full channel would not close
        for bell in self._bells:
            bell.join()  # a session that is being used would not, either

    def _letter(self, sample: Any) -> Letter | None:
        """What is in a sample; None for the bell."""
        data: bytes = sample.payload.to_bytes()
        if data == self._bell:
            return None
        return data, self._now(), self._received(sample)

    def _received(self, sample: Any) -> int | None:
        stack = sample.timestamp_stack
        for record in () if stack is None else stack.records:
            if record.point == zenoh.InterceptionPoint.RECEIVE:
                stamp: int = record.timestamp().get_time_as_ntp64().as_nanos()
                return self._clock.of_machine(stamp)
        return None

    def _watch(self) -> None:
        seen = rung = None
        while self._open:
            self._wakes_ns = NEVER  # first of all, so that a wait that begins now does not rely on this look
            wait, now = self._wait, self._now()
            if wait is None:
                self._nudge.wait(threading.TIMEOUT_MAX)
                continue
            if wait is not rung and (wait is seen or now >= wait.deadline_ns or self.notices):
                self._ring(wait.key)
                rung = wait
            seen = wait
            wakes_ns = now + STRETCH_NS
            self._wakes_ns = min(wakes_ns, wait.deadline_ns) if wait is not rung else wakes_ns
            self._nudge.wait((self._wakes_ns - now) / 1e9)

    def _ring(self, key: str) -> None:
        """In a thread of its own: if the wait has just ended by itself the channel may be full, and hold it up."""
        put = partial(self._session.put, key, self._bell, allowed_destination=zenoh.Locality.SESSION_LOCAL)
        bell = threading.Thread(target=put, name="bell", daemon=True)
        self._bells = [bell, *(ringing for ringing in self._bells if ringing.is_alive())]
        bell.start()
