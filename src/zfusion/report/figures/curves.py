"""A quantity against what was varied: error against delay, against loss, and whatever else has a number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from zfusion.model.types import Array
from zfusion.report.figures import style
from zfusion.report.figures.quantities import Quantity, spans_decades

DODGE = 0.012
"""How far lines are moved apart, as a fraction of the axis, so that intervals at the same place do not hide each
other; much less than the distance of values."""

CATEGORY_WIDTH = 0.5
"""The same where x is not a number and its values are 1 apart."""

LEGEND_COLUMNS = 3


@dataclass(frozen=True)
class Line:
    """One line: `mean` at every `x`, (n,), with an interval where `low` and `high` are finite."""

    label: str
    x: Array
    mean: Array
    low: Array
    high: Array
    predicted: Array | None = None
    """The same by theory."""


@dataclass(frozen=True)
class Bound:
    """What is set beside the lines of a panel: one number, or one at every `x`."""

    label: str
    x: Array
    value: Array
    best: bool
    """Whether it is the better of the two: no estimate can be better than this one."""


@dataclass(frozen=True)
class Panel:
    """Lines that are compared with each other."""

    title: str
    lines: Sequence[Line]
    bounds: Sequence[Bound] = ()


@dataclass(frozen=True)
class Frame:
    """What all panels of a figure share."""

    x: Quantity
    y: Quantity
    legend: str = ""
    """What the lines differ in."""
    ordered: bool = False
    """Whether the lines' labels are numbers in ascending order: then their colours are, too."""
    extent: tuple[float, float] | None = None
    """Lowest and highest x, where also values without a result are to have their place."""
    ticks: Sequence[str] = ()
    """Names of x = 0, 1, 2, ..., where x is not a number."""
    band: tuple[float, float] | None = None
    """Where the quantity belongs, if all is well."""
    band_label: str = ""
    share: bool = False
    """Whether the quantity is a share of one."""
    level: float | None = None
    """The one value where the quantity belongs."""


def draw(panels: Sequence[Panel], frame: Frame) -> Figure:
    """The lines with their intervals, one panel beside the other, on common axes, with one legend below."""
    panels = [panel for panel in panels if any(np.isfinite(line.mean).any() for line in panel.lines)]
    with style.drawing():
        if not panels:
            return style.nothing("there are no finite values to show")
        figure, axes = style.panels(len(panels))
        labels = list(dict.fromkeys(line.label for panel in panels for line in panel.lines))
        colours = dict(zip(labels, style.colours(len(labels), frame.ordered), strict=True))
        markers = {label: style.marker(number) for number, label in enumerate(labels)}
        every_x = np.concatenate([line.x for panel in panels for line in panel.lines]) * frame.x.scale
        logarithmic = not frame.ticks and spans_decades(every_x.tolist())
        for ax, panel in zip(axes, panels, strict=True):
            style.title(ax, panel.title, len(panels))
            _draw_bounds(ax, panel, frame)
            for line in panel.lines:
                number = labels.index(line.label)
                if frame.ticks:
                    place = line.x + CATEGORY_WIDTH * _side(number, len(labels))
                else:
                    place = _dodged(line.x * frame.x.scale, _side(number, len(labels)), every_x, logarithmic)
                _draw_line(ax, line, place, frame, colours[line.label], markers[line.label])
            missing = sum(int((~np.isfinite(line.mean)).sum()) for line in panel.lines)
            if missing:
                style.note(ax, f"{missing} not finite")
        _limits(axes, panels, frame, logarithmic)
        style.label_axes(figure, axes, frame.x.label, frame.y.label)
        _legend(figure, panels, frame, colours, markers)
        return figure


def _draw_line(ax: Axes, line: Line, x: Array, frame: Frame, colour: str, marker: str) -> None:
    mean, low, high = (values * frame.y.scale for values in (line.mean, line.low, line.high))
    below, above = (np.where(np.isfinite(d), np.maximum(d, 0), np.nan) for d in (mean - low, high - mean))
    joined = "none" if frame.ticks else "-"
    drawn = ax.errorbar(
        x, mean, np.array([below, above]), color=colour, marker=marker, linestyle=joined, capsize=2.5,
        elinewidth=0.9, label=line.label,
    )  # fmt: skip
    drawn.lines[0].set_gid("measured")
    if line.predicted is not None and np.isfinite(line.predicted).any():
        ax.plot(x, line.predicted * frame.y.scale, color=colour, gid="predicted", **_predicted_look(frame, marker))


def _predicted_look(frame: Frame, marker: str) -> dict[str, Any]:
    """Dashed, with hollow markers; a dash at each place where nothing may be joined."""
    if frame.ticks:
        return {"linestyle": "none", "marker": "_", "markersize": 13, "markeredgewidth": 1.6, "zorder": 3}
    return {"linestyle": "--", "linewidth": 1.1, "marker": marker, "markersize": 3.5, "markerfacecolor": "white",
            "zorder": 1.9}  # fmt: skip


def _draw_bounds(ax: Axes, panel: Panel, frame: Frame) -> None:
    for bound in panel.bounds:
        value = bound.value * frame.y.scale
        finite = value[np.isfinite(value)]
        if not finite.size:
            continue
        look: dict[str, Any] = dict(zip(("color", "linestyle"), _bound_look(bound), strict=True))
        if np.ptp(finite) <= 1e-9 * abs(finite[0]):
            ax.axhline(float(finite[0]), linewidth=1.2, gid="bound", **look)
        else:
            ax.plot(bound.x * frame.x.scale, value, linewidth=1.2, gid="bound", **look)
    if frame.band is not None:
        ax.axhspan(*frame.band, color="#009E73", alpha=0.15, linewidth=0, gid="band")
    if frame.level is not None:
        ax.axhline(frame.level, color=style.BEST, linewidth=0.9, linestyle=":", gid="level")


def _bound_look(bound: Bound) -> tuple[str, style.LineStyle]:
    return (style.BEST, ":") if bound.best else (style.WORST, "-.")


def _side(number: int, count: int) -> float:
    """Where line `number` of `count` stands beside the others, from -1/2 to 1/2."""
    return number / (count - 1) - 0.5 if count > 1 else 0.0


def _dodged(x: Array, shift: float, every_x: Array, logarithmic: bool) -> Array:
    """x of a line, moved a little so that the intervals of several stand side by side."""
    if logarithmic:
        width = math.log(float(np.nanmax(every_x)) / float(np.nanmin(every_x)))
        return np.asarray(x * math.exp(shift * DODGE * width))
    distinct = np.unique(every_x[np.isfinite(every_x)])
    nearest = float(np.diff(distinct).min()) if distinct.size > 1 else 1.0
    width = float(np.ptp(distinct)) if distinct.size > 1 else 1.0
    return np.asarray(x + shift * min(DODGE * width, 0.3 * nearest))


def _limits(axes: Sequence[Axes], panels: Sequence[Panel], frame: Frame, logarithmic: bool) -> None:
    numbers = [line.mean for panel in panels for line in panel.lines]
    numbers += [bound.value for panel in panels for bound in panel.bounds]
    values = np.concatenate(numbers) * frame.y.scale
    values = values[np.isfinite(values)]
    for ax in axes[:1]:  # the axes are shared
        if logarithmic:
            ax.set_xscale("log")
            style.tick_logarithmically(ax.xaxis)
        elif not frame.ticks:
            ax.xaxis.set_major_locator(MaxNLocator(8 if len(axes) == 1 else 5, steps=[1, 2, 2.5, 5, 10]))
            _widen(ax, frame)
        if spans_decades(values.tolist()):
            ax.set_yscale("log")
            style.tick_logarithmically(ax.yaxis)
        elif frame.share:
            ax.set_ylim(-0.03, 1.03)
        elif values.size and 0 <= values.min() < 0.5 * values.max():
            ax.set_ylim(bottom=0)
    for ax in axes:
        if frame.ticks:
            long = max(map(len, frame.ticks)) * len(frame.ticks) > 60 / min(len(axes), style.COLUMNS)
            ax.set_xticks(
                range(len(frame.ticks)), frame.ticks, rotation=30 if long else 0, ha="right" if long else "center"
            )
            ax.set_xlim(-0.5, len(frame.ticks) - 0.5)


def _widen(ax: Axes, frame: Frame) -> None:
    if frame.extent is not None and frame.extent[0] < frame.extent[1]:
        low, high = (end * frame.x.scale for end in frame.extent)
        margin = 0.04 * (high - low)
        ax.set_xlim(low - margin, high + margin)


def _legend(
    figure: Figure, panels: Sequence[Panel], frame: Frame, colours: dict[str, str], markers: dict[str, str]
) -> None:
    joined: style.LineStyle = "none" if frame.ticks else "-"
    handles = [
        Line2D([], [], color=colour, marker=markers[label], linestyle=joined, label=label or "measured")
        for label, colour in colours.items()
    ]
    if any(line.predicted is not None for panel in panels for line in panel.lines):
        handles.append(Line2D([], [], color=style.BEST, label="predicted", **_predicted_look(frame, "o")))
    for label, look in {b.label: _bound_look(b) for panel in panels for b in panel.bounds}.items():
        handles.append(Line2D([], [], color=look[0], linestyle=look[1], linewidth=1.2, label=label))
    if frame.band is not None:
        handles.append(Line2D([], [], color="#009E73", alpha=0.3, linewidth=7, label=frame.band_label))
    if handles:
        figure.legend(
            handles=handles, loc="outside lower center", ncols=min(LEGEND_COLUMNS, len(handles)), title=frame.legend
        )
