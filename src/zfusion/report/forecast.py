"""What is known of a method's errors before it runs, for programs and for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.methods.family import Forecast
from zfusion.model.types import NodeId

SHOWN_NODES = 32


@dataclass(frozen=True)
class Foretold:
    """A forecast, and where it is from."""

    scenario: str
    method: str
    ids: Sequence[NodeId]
    forecast: Forecast
    remarks: Sequence[str] = ()
    """Beside those of the forecast."""
    seconds: float | None = None
    """That the design took."""
    file: Path | None = None
    """Where it is."""

    def as_dict(self) -> dict[str, Any]:
        """method, nodes [{node, ...}], network {...}, remarks [...], and of a design seconds and file."""
        columns = self.forecast.nodes
        rows = [
            {"node": node, **{name: values[n] for name, values in columns.items()}} for n, node in enumerate(self.ids)
        ]
        told: dict[str, Any] = {"method": self.method, "network": dict(self.forecast.network), "nodes": rows}
        told["remarks"] = [*self.forecast.remarks, *self.remarks]
        if self.seconds is not None:
            told |= {"seconds": self.seconds, "file": None if self.file is None else str(self.file)}
        return told


def show_forecast(console: Console, told: Foretold) -> None:
    """Print a table by node, and what holds for the network."""
    took = "" if told.seconds is None else f"   designed in {told.seconds:.2f} s"
    console.print(f"[bold]{escape(told.scenario)}[/]   {told.method}{took}")
    columns = told.forecast.nodes
    if columns:
        table = Table()
        for heading in ("node", *map(_words, columns)):
            table.add_column(heading, justify="left" if heading == "node" else "right")
        for n, node in enumerate(told.ids[:SHOWN_NODES]):
            table.add_row(escape(str(node)), *(_shown(values[n]) for values in columns.values()))
        console.print(table)
        if len(told.ids) > SHOWN_NODES:
            console.print(f"... and {len(told.ids) - SHOWN_NODES} more nodes (--json has all)")
    for name, value in _known(told.forecast.network).items():
        console.print(f"{_words(name)}: {_shown(value)}")
    for remark in (*told.forecast.remarks, *told.remarks):
        console.print(escape(remark), soft_wrap=True)
    if told.file is not None:
        console.print(f"saved: {escape(str(told.file))}", soft_wrap=True)


def _known(network: Mapping[str, float | str | None]) -> dict[str, float | str]:
    return {name: value for name, value in network.items() if value is not None}


def _words(name: str) -> str:
    return name.replace("_", " ")


def _shown(value: float | str) -> str:
    return escape(value) if isinstance(value, str) else f"{value:.6g}"
