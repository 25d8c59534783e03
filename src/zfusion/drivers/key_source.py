"""Measurements that a user's own sensor program publishes on a Zenoh key.

A reading is a number or a list of numbers: JSON text, or msgpack where the message's encoding is
``application/msgpack``. What is no reading is counted and dropped.
"""

from __future__ import annotations

import threading
from collections import Counter
from functools import partial
from typing import Any

import zenoh

from zfusion.drivers.transport import on_zenoh_thread
from zfusion.errors import MessageError
from zfusion.messages import decode_reading
from zfusion.model.types import Array, NodeId

MSGPACK = "application/msgpack"


class KeySource:
    """The newest reading on a key, each taken once.

    A paced node takes what has come since its last step, None where nothing has; a free-running one waits up to
    `wait_s` for the next.
    """

    def __init__(self, session: zenoh.Session, node: NodeId, key: str, ny: int, wait_s: float) -> None:
        self.node = node
        self.counters: Counter[str] = Counter()
        """Messages that were no readings, by reason."""
        self._ny, self._wait_s = ny, wait_s
        self._newest: Array | None = None
        self._came = threading.Condition()
        self._subscriber = session.declare_subscriber(key, on_zenoh_thread(partial(KeySource._take, self)))

    def read(self, step: int, t_ns: int) -> Array | None:  # noqa: ARG002
        """The newest reading that was not taken yet, (ny,)."""
        with self._came:
            if self._newest is None and self._wait_s:
                self._came.wait(self._wait_s)
            reading, self._newest = self._newest, None
        return reading

    def truth(self, step: int) -> Array | None:  # noqa: ARG002
        """Nobody knows the state of a real thing."""
        return None

    def close(self) -> None:
        """Stop listening."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _take(self, sample: Any) -> None:
        try:
            reading = decode_reading(sample.payload.to_bytes(), str(sample.encoding).startswith(MSGPACK), self._ny)
        except MessageError as error:
            self.counters[error.reason] += 1
            return
        with self._came:
            self._newest = reading
            self._came.notify()
