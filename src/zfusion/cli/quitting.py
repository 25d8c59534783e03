"""When the user has had enough of something that goes on for ever: Ctrl-C, a signal, or the key q."""

from __future__ import annotations

import select
import sys
import time
from types import TracebackType
from typing import Any, Self

from zfusion.cli.common import on_signals

GLANCE_S = 0.1
"""How often it is looked for a key or a signal."""

KEYS = {"q", "Q", "\x04"}


class Quitting:
    """Use it in a `with`; a terminal is given back as it was."""

    def __init__(self) -> None:
        self.asked = False
        self._terminal: list[Any] | None = None

    def __enter__(self) -> Self:
        on_signals(self._ask)
        if sys.stdin is not None and sys.stdin.isatty() and sys.stdout.isatty():
            import termios
            import tty

            self._terminal = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin, termios.TCSADRAIN)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal is not None:
            import termios

            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)

    def look(self) -> bool:
        """Whether the user has had enough, without waiting."""
        return self.rest(0)

    def rest(self, seconds: float) -> bool:
        """Wait so long, or until the user has had enough; whether that is so."""
        end = time.monotonic() + seconds
        while not self.asked:
            left = min(GLANCE_S, max(0.0, end - time.monotonic()))
            if self._terminal is None:
                time.sleep(left)
            elif select.select([sys.stdin], [], [], left)[0] and sys.stdin.read(1) in KEYS:
                self.asked = True
            if time.monotonic() >= end:
                break
        return self.asked

    def _ask(self) -> None:
        self.asked = True
