"""Standard output, which may be closed, or be a file on a disk that is full: that is said in a line, and no more."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from zfusion.errors import RunError


class Output:
    """Stands for a stream. RunError where it cannot be written; a reader that has gone ends the process with 1."""

    def __init__(self, stream: TextIO | None) -> None:
        """None: it was closed before this process began."""
        self.stream = stream

    def write(self, text: str) -> int:
        """As a stream's."""
        if self.stream is None:
            raise RunError("standard output cannot be written: it is closed")
        with self._told(self.stream):
            return self.stream.write(text)

    def flush(self) -> None:
        """As a stream's."""
        if self.stream is not None:
            with self._told(self.stream):
                self.stream.flush()

    def isatty(self) -> bool:
        """As a stream's."""
        return self.stream is not None and self.stream.isatty()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    @contextmanager
    def _told(self, stream: TextIO) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            _discard(stream)
            if isinstance(error, BrokenPipeError):
                sys.exit(1)
            raise RunError(f"standard output cannot be written: {error.strerror}") from None


def _discard(stream: TextIO) -> None:
    """Have what waits in a stream go nowhere: Python would try it again at its end, and complain again."""
    with suppress(OSError):  # it has no file
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextmanager
def checked_output() -> Iterator[None]:
    """Have standard output checked meanwhile, and at the end whether all has been written."""
    output = Output(sys.stdout)
    sys.stdout = output
    try:
        yield
    except SystemExit:  # as commands end
        output.flush()
        raise
    finally:
        sys.stdout = output.stream
