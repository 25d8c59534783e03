"""Playing a recording: its messages once more, on the same keys, with the spacing that they had.

A `Player` owns the replay's time: it alone knows which moment of the recording is now. What it plays onto is a
function that takes key and payload, and the clock is given too.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Protocol

from zfusion import keys
from zfusion.errors import InputError, MessageError
from zfusion.messages import decode_any
from zfusion.recording.reader import Record, Recording

NANOSECONDS = 1_000_000_000

_EVER = 2**64


class Clock(Protocol):
    """What tells the time, and lets it pass."""

    def now_ns(self) -> int:
        """A time that only goes forward, from whenever on."""

    def wait(self, changed: threading.Condition, timeout_ns: int | None) -> None:
        """Wait, with `changed` held, until it is notified or the time has passed; None: until it is notified."""


class MonotonicClock:
    """The real one."""

    def now_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def wait(self, changed: threading.Condition, timeout_ns: int | None) -> None:
        """See `Clock`."""
        changed.wait(None if timeout_ns is None else timeout_ns / NANOSECONDS)


@dataclass(frozen=True, slots=True)
class Extent:
    """A part of a recording; what is None does not limit it. InputError where nothing can be in it."""

    start_s: float | None = None
    """Seconds after the first message."""
    end_s: float | None = None
    """Likewise; what comes exactly then is not in it."""
    first_step: int | None = None
    last_step: int | None = None
    """In it."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("seconds", self.start_s, self.end_s),
            ("steps", self.first_step, self.last_step),
        ):
            if (low is not None and low < 0) or (high is not None and high < (low or 0)):
                raise InputError(
                    f"{name}: expected a start that is not negative, and an end after it ({low} to {high})"
                )

    def records(self, recording: Recording, topics: Collection[str] | None) -> Iterator[Record]:
        """The messages in it, on these topics."""
        start = recording.start_ns + round((self.start_s or 0.0) * NANOSECONDS)
        end = _EVER if self.end_s is None else recording.start_ns + round(self.end_s * NANOSECONDS)
        records = recording.records(topics, start, end)
        if self.first_step is None and self.last_step is None:
            return records
        return (record for record in records if self._has_step(record.data))

    def _has_step(self, data: bytes) -> bool:
        try:
            step = decode_any(data).get("step")
        except MessageError:
            return False
        first, last = self.first_step or 0, _EVER if self.last_step is None else self.last_step
        return isinstance(step, int) and first <= step <= last


def choose_topics(
    recording: Recording,
    *,
    nodes: Collection[str] = (),
    stages: Collection[str] = (),
    patterns: Collection[str] = (),
) -> list[str]:
    """The recording's topics of these nodes (ids as text) and stages that match one of the patterns.

    An empty collection chooses all; in patterns `*` stands for any characters, `/` included. The truth is a stage of
    no node. InputError if there is no such topic.
    """
    chosen = [topic for topic in recording.topics if _is_chosen(topic, nodes, stages, patterns)]
    if not chosen:
        raise InputError(
            f"{recording.path}: none of its topics is chosen; it has {', '.join(recording.topics) or 'none'}"
        )
    return chosen


def _is_chosen(topic: str, nodes: Collection[str], stages: Collection[str], patterns: Collection[str]) -> bool:
    try:
        key = keys.parse(topic)
    except MessageError:
        key = keys.Key("", None, "")
    return (
        (not nodes or key.node in nodes)
        and (not stages or key.stage in stages)
        and (not patterns or any(fnmatchcase(topic, pattern) for pattern in patterns))
    )


class Player:
    """Plays a recording. `run` does it; `pause`, `resume` and `stop` may be called from any thread meanwhile."""

    def __init__(
        self,
        recording: Recording,
        put: Callable[[str, bytes], None],
        *,
        speed: float = 1.0,
        extent: Extent | None = None,
        topics: Collection[str] | None = None,
        loop: bool = False,
        clock: Clock | None = None,
    ) -> None:
        """Play onto `put(key, payload)`, `speed` times as fast as it was; 0: as fast as `put` takes it.

        `loop` begins again when all is played. InputError for a negative speed.
        """
        if not 0.0 <= speed < float("inf"):
            raise InputError(f"speed: expected a number >= 0, 0 for as fast as possible (is {speed})")
        self.played = 0
        """Messages that were put."""
        self.position_ns = recording.start_ns
        """Log time of the last of them."""
        self._recording, self._put, self._speed, self._loop = recording, put, speed, loop
        self._extent, self._topics = extent or Extent(), topics
        self._clock = clock or MonotonicClock()
        self._changed = threading.Condition()
        self._stopped = False
        self._paused = False
        self._behind_ns = 0
        """What the clock shows when the recording's first moment is now; a pause moves it on."""

    def run(self) -> int:
        """Play to the end, or until stopped: the number of messages that were put.

        InputError if there is nothing to play; RecordingError if the file has changed meanwhile.
        """
        while self._play_once() and self._loop:
            pass
        return self.played

    def pause(self) -> None:
        """Let the replay's time stand still."""
        with self._changed:
            self._paused = True
            self._changed.notify_all()

    def resume(self) -> None:
        """Let it go on from there."""
        with self._changed:
            self._paused = False
            self._changed.notify_all()

    def stop(self) -> None:
        """End before the next message."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _play_once(self) -> bool:
        """Play all once; False if stopped."""
        begin_ns: int | None = None
        for topic, data, log_time_ns, *_ in self._extent.records(self._recording, self._topics):
            if begin_ns is None:
                begin_ns = log_time_ns
                self._behind_ns = self._clock.now_ns()
            if not self._wait_for(log_time_ns - begin_ns):
                return False
            self._put(topic, data)
            self.position_ns = log_time_ns
            self.played += 1
        if begin_ns is None:
            raise InputError(f"{self._recording.path}: there is nothing to play in this part of it")
        return True

    def _wait_for(self, moment_ns: int) -> bool:
        """Wait for a moment of the replay's time; False if stopped before."""
        with self._changed:
            while not self._stopped:
                if self._paused:
                    self._stand_still()
                    continue
                if not self._speed:
                    return True
                left = self._behind_ns + round(moment_ns / self._speed) - self._clock.now_ns()
                if left <= 0:
                    return True
                self._clock.wait(self._changed, left)
        return False

    def _stand_still(self) -> None:
        """Wait until no longer paused; the time that passes is not the replay's."""
        since = self._clock.now_ns()
        while self._paused and not self._stopped:
            self._clock.wait(self._changed, None)
        self._behind_ns += self._clock.now_ns() - since
