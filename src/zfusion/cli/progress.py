"""What shows that a long computation goes on, and how far it is, on a terminal only."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer

from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from zfusion.cli.common import err
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario

PATIENCE_S = 1.0
"""How long something may take before it is said what it is."""


@contextmanager
def progress(text: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Gives a function that is told how many more of `total`, if that is known, are done."""
    with Progress(console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(text, total=total)

        def advance(more: int) -> None:
            bar.advance(task, more)

        yield advance


@contextmanager
def waiting(text: str) -> Iterator[None]:
    """Says, from a second on and on a terminal only, what is waited for and how long already."""
    shown = Progress(SpinnerColumn(), TextColumn(text), TimeElapsedColumn(), console=err, transient=True)
    shown.add_task(text, total=None)
    late = Timer(PATIENCE_S, shown.start)
    late.daemon = True
    if err.is_terminal:
        late.start()
    try:
        yield
    finally:
        late.cancel()
        if err.is_terminal:
            late.join()
        shown.stop()


def design_first(scenario: Scenario) -> None:
    """Make or read the design of the scenario's method, if it has one, so that what comes next finds it."""
    from zfusion.drivers.designs import design_of

    if chosen(scenario).family.designer is not None:
        with waiting(designing(scenario)):
            design_of(scenario)


def designing(scenario: Scenario) -> str:
    """What is waited for while a method is designed."""
    return f"designing {scenario.method.name} for {len(scenario.ids)} nodes"
