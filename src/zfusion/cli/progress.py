"""A bar that shows how far a long computation is, on a terminal only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.progress import Progress

from zfusion.cli.common import err


@contextmanager
def progress(text: str, total: int) -> Iterator[Callable[[int], None]]:
    """Gives a function that is told how many more of `total` are done."""
    with Progress(console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(text, total=total)

        def advance(more: int) -> None:
            bar.advance(task, more)

        yield advance
