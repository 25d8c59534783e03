"""How long messages took: the distribution on every edge, and what the time went into."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zfusion.drivers.meters import PARTS
from zfusion.model.types import Array
from zfusion.report.figures import style
from zfusion.report.figures.quantities import in_seconds, spans_decades

OTHERS = "#BBBBBB"

MOST_POINTS = 250
"""Points of a distribution that are drawn."""

MOST_NAMED = 8
"""Lines that have a colour and a name of their own; of more, only the slowest do."""


MOST_BARS = 40
"""Edges that are drawn one below the other: more do not fit on a page."""


@dataclass(frozen=True)
class Sample:
    """Latencies of one edge in seconds, (n,), in any order, and how many messages never came."""

    label: str
    latencies_s: Array
    lost: int = 0


def draw_distributions(samples: Sequence[Sample], title: str = "") -> Figure:
    """The share of messages that took at most so long, a line for each edge; the lost ones keep it below one."""
    samples = [s for s in samples if np.isfinite(s.latencies_s).any()]
    with style.drawing():
        if not samples:
            return style.nothing("no latencies were measured")
        figure, [ax] = style.panels(1)
        every = np.concatenate([s.latencies_s[np.isfinite(s.latencies_s)] for s in samples])
        quantity = in_seconds("one-way latency", float(np.quantile(every, 0.99)))
        ranked = sorted(samples, key=lambda s: -float(np.nanmedian(s.latencies_s)))
        named = {s.label: style.COLOURS[n] for n, s in enumerate(ranked[:MOST_NAMED])}
        for sample in samples:
            values, share = _distribution(sample)
            values = values * quantity.scale
            colour = named.get(sample.label)
            look: dict[str, Any] = (
                {"color": colour, "linewidth": 1.4} if colour else {"color": OTHERS, "linewidth": 0.7, "zorder": 1}
            )
            ax.step(np.append(values[0], values), np.append(0.0, share), where="post", gid="edge", **look)
        if (every >= 0).all() and spans_decades((every * quantity.scale).tolist()):
            ax.set_xscale("log")
            style.tick_logarithmically(ax.xaxis)
        ax.set(xlabel=quantity.label, ylabel="fraction of messages", ylim=(0, 1.02), title=title)
        handles = [Line2D([], [], color=colour, linewidth=1.4, label=edge) for edge, colour in named.items()]
        if len(samples) > len(named):
            rest = f"{len(samples) - len(named)} faster edges"
            handles.append(Line2D([], [], color=OTHERS, linewidth=0.7, label=rest))
        ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), title="edge, slowest first")
        return figure


def _distribution(sample: Sample) -> tuple[Array, Array]:
    """Latencies in ascending order, and the share of all messages that took no longer; no more points than are seen."""
    values = np.sort(sample.latencies_s[np.isfinite(sample.latencies_s)])
    share = np.arange(1, len(values) + 1) / (len(values) + sample.lost)
    if len(values) > MOST_POINTS:
        chosen = np.unique(np.linspace(0, len(values) - 1, MOST_POINTS).round().astype(int))
        values, share = values[chosen], share[chosen]
    return values, share


PART_COLOURS = dict(
    zip(
        PARTS, (*style.COLOURS[:2], *style.COLOURS[3:5], style.COLOURS[2], "#C9C9C9", "#8A8A8A", "#000000"), strict=True
    )
)


@dataclass(frozen=True)
class Quantiles:
    """Of one edge's latencies, in seconds."""

    label: str
    median_s: float
    p90_s: float
    p99_s: float


def draw_quantiles(edges: Sequence[Quantiles]) -> Figure:
    """One line for each edge, slowest on top: from the median (dot) past the 90 % quantile (bar) to the 99 % one."""
    edges = sorted((e for e in edges if np.isfinite(e.median_s)), key=lambda e: -e.median_s)
    with style.drawing():
        if not edges:
            return style.nothing("no latencies were measured")
        shown_edges = edges[:MOST_BARS]
        quantity = in_seconds("one-way latency", max(e.p99_s for e in shown_edges))
        figure = Figure(figsize=(style.WIDTH_IN, 1.2 + 0.22 * len(shown_edges)), layout="constrained")
        ax = figure.subplots()
        rows = np.arange(len(shown_edges))
        low, middle, high = np.array([(e.median_s, e.p90_s, e.p99_s) for e in shown_edges]).T * quantity.scale
        ax.hlines(rows, low, high, color=style.COLOURS[0], linewidth=1.2, label="to the 99 % quantile")
        ax.plot(low, rows, "o", color=style.COLOURS[0], label="median", gid="median")
        ax.plot(middle, rows, "|", color=style.COLOURS[0], markersize=8, markeredgewidth=1.6, label="90 % quantile")
        ax.set_yticks(rows, [e.label for e in shown_edges])
        ax.invert_yaxis()
        ax.set_xlim(left=0)
        ax.set(xlabel=quantity.label, ylabel="edge")
        if len(edges) > len(shown_edges):
            style.note(ax, f"{len(edges) - len(shown_edges)} faster edges are left out")
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        return figure


def draw_budget(budgets: Mapping[str, Mapping[str, float]]) -> Figure:
    """One bar for each edge, of the parts (microseconds) that its mean round is made of.

    They are `PARTS`, in the order in which the time passes.
    """
    with style.drawing():
        if not budgets:
            return style.nothing("no latency budget was measured")
        parts = [part for part in PARTS if any(of.get(part) for of in budgets.values())]
        left_out = len(budgets) - MOST_BARS
        budgets = dict(list(budgets.items())[:MOST_BARS])
        quantity = in_seconds("time of a mean round", max(sum(of.values()) for of in budgets.values()) / 1e6)
        figure = Figure(figsize=(style.WIDTH_IN, 1.3 + 0.26 * len(budgets)), layout="constrained")
        ax = figure.subplots()
        if left_out > 0:
            style.note(ax, f"{left_out} more edges are left out")
        left = np.zeros(len(budgets))
        for part in parts:
            widths = np.array([of.get(part, 0.0) for of in budgets.values()]) * quantity.scale / 1e6
            ax.barh(range(len(budgets)), widths, left=left, color=PART_COLOURS[part], label=part, height=0.75, gid=part)
            left += widths
        ax.set_yticks(range(len(budgets)), list(budgets))
        ax.invert_yaxis()
        ax.grid(visible=False, axis="y")
        ax.set(xlabel=quantity.label, ylabel="edge")
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=6)
        return figure
