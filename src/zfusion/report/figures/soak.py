"""Quantities of many processes over a long run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zfusion.model.types import Array
from zfusion.report.figures import style
from zfusion.report.figures.quantities import spans_decades

MOST_POINTS = 600
"""Samples that a line shows; of more, means over as many equal blocks."""

PANEL_HEIGHT_IN = 2.0

DASHES: tuple[style.LineStyle, ...] = ("-", "--", "-.", ":")
"""No colour carries a meaning alone, and lines may lie on one another."""

UNITS = (("h", 3600.0, 7200.0), ("min", 60.0, 180.0), ("s", 1.0, 0.0))
"""Of the time axis, in seconds, and the least length of a run from which on each is used."""


@dataclass(frozen=True)
class Line:
    """A quantity of one process, (n,), or the median of many with the range from the least to the most of them."""

    label: str
    t_s: Array
    values: Array
    low: Array | None = None
    high: Array | None = None


@dataclass(frozen=True)
class Panel:
    """Lines that share an axis."""

    y: str
    lines: Sequence[Line]
    logarithmic: bool = False
    """Where its values span decades."""


def draw(panels: Sequence[Panel], warm_up_s: float) -> Figure:
    """One panel below the other over a common time; what is not judged is shaded."""
    with style.drawing():
        panels = [panel for panel in panels if any(np.isfinite(line.values).any() for line in panel.lines)]
        if not panels:
            return style.nothing("there are no samples to show")
        figure = Figure(figsize=(style.WIDTH_IN, 0.7 + PANEL_HEIGHT_IN * len(panels)), layout="constrained")
        axes: list[Axes] = list(figure.subplots(len(panels), 1, sharex=True, squeeze=False).ravel())
        longest = max(float(line.t_s[-1]) for panel in panels for line in panel.lines)
        unit, scale = next((name, size) for name, size, least in UNITS if longest >= least)
        for ax, panel in zip(axes, panels, strict=True):
            for number, line in enumerate(panel.lines):
                _draw(ax, line, number, scale)
            ax.axvspan(0, warm_up_s / scale, color=style.GREY, alpha=0.10, linewidth=0)
            if panel.logarithmic and spans_decades(_positive(panel)):
                ax.set_yscale("log")
                style.tick_logarithmically(ax.yaxis)
            else:
                ax.set_ylim(0, None if ax.dataLim.y1 > 0 else 1)
            ax.set_xlim(0, longest / scale)
            ax.set_ylabel(panel.y)
            ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes[-1].set_xlabel(f"time [{unit}]")
        return figure


def _positive(panel: Panel) -> list[float]:
    drawn = (values for line in panel.lines for values in (line.values, line.low, line.high) if values is not None)
    values = np.concatenate(list(drawn))
    return [value for value in values.tolist() if value > 0]


def _draw(ax: Axes, line: Line, number: int, scale: float) -> None:
    colour, dashes = style.COLOURS[number % len(style.COLOURS)], DASHES[number % len(DASHES)]
    t, values = _blocks(line.t_s) / scale, _blocks(line.values)
    if line.low is not None and line.high is not None:
        ax.fill_between(t, _blocks(line.low), _blocks(line.high), color=colour, alpha=0.2, linewidth=0, gid="range")
    ax.plot(t, values, color=colour, linestyle=dashes, linewidth=1.2, label=line.label, gid="measured")


def _blocks(values: Array) -> Array:
    if len(values) <= MOST_POINTS:
        return values
    return np.array([np.nanmean(b) if np.isfinite(b).any() else np.nan for b in np.array_split(values, MOST_POINTS)])
