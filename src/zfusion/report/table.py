"""The live table: what a person sees while a swarm runs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId

REFRESH_HZ = 4

SHOWN_COMPONENTS = 3
"""Components of an estimate that fit into a line."""


class Watched(Protocol):
    """What the table shows of a process."""

    status: Mapping[str, Any]
    restarts: int

    @property
    def running(self) -> bool:
        """Whether the process is there."""


def shown_estimate(estimate: Mapping[str, Sequence[float]]) -> str:
    """The first components of an estimate, each with the standard deviation of its error."""
    pairs = list(zip(estimate.get("x", ()), estimate.get("sd", ()), strict=True))
    shown = ", ".join(f"{x:.3g} ± {sd:.2g}" for x, sd in pairs[:SHOWN_COMPONENTS])
    return shown + (", ..." if len(pairs) > SHOWN_COMPONENTS else "")


class LiveTable:
    """A table that redraws itself on a terminal; elsewhere only messages are printed."""

    def __init__(self, console: Console, scenario: Scenario, run: str, *, enabled: bool = True) -> None:
        self._console, self._scenario, self._run = console, scenario, run
        self._live = Live(console=console, refresh_per_second=REFRESH_HZ, transient=True)
        self._enabled = enabled and console.is_terminal
        self._began = time.monotonic()
        self._drawn = 0.0

    def __enter__(self) -> Self:
        if self._enabled:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def message(self, text: str) -> None:
        """Print something above the table."""
        self._console.print(Text(text, style="yellow"))

    def update(self, nodes: Mapping[NodeId, Watched], recorder: Watched | None) -> None:
        """Redraw, a few times a second at most."""
        now = time.monotonic()
        if not self._enabled or now - self._drawn < 1 / REFRESH_HZ:
            return
        self._drawn = now
        self._live.update(self._render(nodes, recorder, now - self._began))

    def _render(self, nodes: Mapping[NodeId, Watched], recorder: Watched | None, elapsed: float) -> Group:
        steps = self._scenario.steps
        table = Table(title=f"{self._run}   {self._scenario.method.name}   {elapsed:.0f} s")
        for name in ("node", "state", "step", "fallbacks", "restarts", "estimate ± sd"):
            table.add_column(name, justify="left" if name in {"node", "state", "estimate ± sd"} else "right")
        shown = list(nodes.items())[: max(4, self._console.height - 8)]
        for node, child in shown:
            status = child.status
            state = str(status.get("phase", "starting")) if child.running else "ended"
            table.add_row(
                str(node),
                state,
                f"{status.get('step', 0)}/{steps}",
                str(status.get("fallbacks", 0)),
                str(child.restarts),
                shown_estimate(status.get("estimate", {})),
            )
        lines: list[Table | Text] = [table]
        if len(shown) < len(nodes):
            lines.append(Text(f"... and {len(nodes) - len(shown)} more nodes"))
        if recorder is not None:
            lines.append(Text(f"recorded: {recorder.status.get('messages', 0)} messages"))
            if recorder.status.get("stopped"):
                lines.append(Text(f"recording stopped: {recorder.status['stopped']}", style="bold red"))
        return Group(*lines)
