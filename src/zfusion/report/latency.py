"""How long messages took, and what the time of a round went into: from what the nodes measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from zfusion.drivers.meters import add_up
from zfusion.drivers.metrics import Latencies, NodeReport
from zfusion.model.types import NodeId

MOST_SHOWN = 8
"""Rows of the table for people; all of them are in ``--json``."""

SHOWN = {
    "behind": "behind",
    "wire": "wire",
    "injected": "held",
    "queued": "queued",
    "waited": "waited",
    "missing": "none",
}
"""Parts of a budget that differ between edges, and their headings."""

MEANING = {
    "behind": "not sent yet",
    "injected": "by link emulation",
    "queued": "there, not looked at",
    "waited": "for the slowest",
    "missing": "nothing came",
}
"""What is not plain from its heading."""


def of_edge(
    lives: Sequence[NodeReport], total: Mapping[str, Any], sender: str, stage: str, used: int
) -> dict[str, Any]:
    """What the lives of a receiver measured (`add_up`: `total`) of a sender's messages of a stage; it used so many.

    latency_us {mean, p50, p90, p99, clock_error_us: by how much the two clocks may differ, None where nobody knows},
    budget_us {part: mean over the rounds whose budget was kept}, used_fraction of its steps, clock {offset_us,
    uncertainty_us} of the sender's against the receiver's.
    """
    completed = sum(report.completed for report in lives)
    clock = _clock(lives, sender)
    found = {"used_fraction": used / completed if completed else None, "clock": clock}
    edge = total["edges"].get(sender, {}).get(stage)
    if edge is None:
        return {**found, "latency_us": {}, "budget_us": {}}
    count = sum(edge["latency"].values())
    error = abs(clock["offset_us"]) + clock["uncertainty_us"] if clock else None
    latency = {"mean": round(edge["total_ns"] / count / 1000, 1) if count else None, "clock_error_us": error}
    budget = {part: round(ns / total["rounds"] / 1000, 3) for part, ns in edge["budget_ns"].items() if total["rounds"]}
    return {**found, "latency_us": _quantiles(edge["latency"]) | latency, "budget_us": budget}


def of_node(lives: Sequence[NodeReport]) -> dict[str, Any]:
    """What a node measured of its rounds: waits_us {stage: p50, p90, p99}; round_us, the mean, of so many rounds.

    And queues {ahead, held}: how many messages waited at the most.
    """
    total = add_up(report.measured for report in lives)
    rounds = total["rounds"]
    return {
        "waits_us": {stage: _quantiles(counts) for stage, counts in total["waits"].items()},
        "round_us": round(total["rounds_ns"] / rounds / 1000, 3) if rounds else None,
        "rounds": rounds,
        "queues": {name: max(r.queues.get(name, 0) for r in lives) for name in _names(lives)},
    }


def _names(lives: Sequence[NodeReport]) -> list[str]:
    return list(dict.fromkeys(name for report in lives for name in report.queues))


def emulated(reports: Mapping[NodeId, Sequence[NodeReport]]) -> list[dict[str, Any]]:
    """What link emulation did with the messages of each edge, where it did anything."""
    found = []
    for receiver, lives in reports.items():
        counts: dict[str, dict[str, int]] = {}
        for report in lives:
            for sender, reasons in report.emulated.items():
                of_sender = counts.setdefault(sender, {})
                for reason, count in reasons.items():
                    of_sender[reason] = of_sender.get(reason, 0) + count
        found += [{"sender": j, "receiver": str(receiver), **reasons} for j, reasons in counts.items() if reasons]
    return found


def show_latencies(console: Console, summary: Mapping[str, Any], headings: Mapping[str, str]) -> None:
    """The slowest edges, and what the time went into, for people."""
    edges = [edge for edge in summary["edges"] if edge["latency_us"].get("p99") and edge["budget_us"]]
    if not any(edge["latency_us"]["mean"] for edge in edges):
        return
    edges.sort(key=lambda edge: -edge["latency_us"]["p99"])
    parts = [part for part in SHOWN if any(edge["budget_us"].get(part) for edge in edges)]
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("edge", "stage", "p50", "p99", *(SHOWN[part] for part in parts)):
        table.add_column(name, justify="left" if name in {"edge", "stage"} else "right")
    for edge in edges[:MOST_SHOWN]:
        latency, budget = edge["latency_us"], edge["budget_us"]
        unsure = " ?" if latency["clock_error_us"] is None or latency["clock_error_us"] > latency["p50"] / 10 else ""
        cells = [f"{latency[q]:.0f}" for q in ("p50", "p99")] + [f"{budget.get(part, 0):.0f}" for part in parts]
        name = f"{edge['sender']} → {edge['receiver']}{unsure}"
        table.add_row(name, headings.get(edge["stage"], edge["stage"]), *cells)
    more = f" ({MOST_SHOWN} slowest of {len(edges)})" if len(edges) > MOST_SHOWN else ""
    console.print(f"latency, and what a stage's time goes into, in µs{more}:")
    console.print(table)
    meaning = [f"{SHOWN[part]}: {MEANING[part]}" for part in parts if part in MEANING]
    console.print(f"({'; '.join(meaning)})", style="dim")


def _clock(lives: Sequence[NodeReport], sender: str) -> dict[str, float]:
    """As the last life found it that found anything."""
    return next((report.clocks[sender] for report in reversed(lives) if report.clocks.get(sender)), {})


def _quantiles(counts: Mapping[str, int]) -> dict[str, float | None]:
    latencies = Latencies({int(number): count for number, count in counts.items()})
    return {f"p{round(100 * q)}": latencies.quantile_us(q) for q in (0.5, 0.9, 0.99)}
