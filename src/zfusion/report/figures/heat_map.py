"""A quantity over two numbers that were varied, as a map with its values written in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from zfusion.model.types import Array
from zfusion.report.figures import style
from zfusion.report.figures.quantities import Quantity, shown, spans_decades

MOST_ANNOTATED = 12
"""Columns up to which the values are written into their cells; beyond, they would run into each other."""


@dataclass(frozen=True)
class Map:
    """`values[row, column]` belongs to y[row], x[column]; NaN where there is none."""

    title: str
    x: Array
    y: Array
    values: Array


def draw(maps: Sequence[Map], x: Quantity, y: Quantity, z: Quantity) -> Figure:
    """The maps on one colour scale; cells are as wide as each other, however far apart their numbers are."""
    finite = np.concatenate([m.values[np.isfinite(m.values)] for m in maps]) * z.scale if maps else np.empty(0)
    with style.drawing():
        if not finite.size:
            return style.nothing("there are no finite values to show")
        figure, axes = style.panels(len(maps), panel=(4.2, 3.6), single=(style.WIDTH_IN, 4.6))
        norm = LogNorm if spans_decades(finite.tolist()) else Normalize
        scale = norm(float(finite.min()), float(finite.max()) if np.ptp(finite) else float(finite.min()) + 1e-12)
        for ax, panel in zip(axes, maps, strict=True):
            image = ax.imshow(
                np.ma.masked_invalid(panel.values * z.scale),
                origin="lower",
                aspect="auto",
                cmap=style.SCALE,
                norm=scale,
            )
            style.title(ax, panel.title, len(maps))
            ax.grid(visible=False)
            ax.set_xticks(range(len(panel.x)), [shown(v * x.scale) for v in panel.x])
            ax.set_yticks(range(len(panel.y)), [shown(v * y.scale) for v in panel.y])
            _write_values(ax, panel.values * z.scale, scale)
        style.label_axes(figure, axes, x.label, y.label)
        bar = figure.colorbar(image, ax=list(axes), label=z.label, shrink=0.9)
        bar.outline.set_visible(False)
        if isinstance(scale, LogNorm):
            style.tick_logarithmically(bar.ax.yaxis)
        return figure


def _write_values(ax: Axes, values: Array, scale: Normalize) -> None:
    """The number in every cell, dark on light or light on dark; where there is none, hatching."""
    dense = values.shape[1] > MOST_ANNOTATED
    for (row, column), value in np.ndenumerate(values):
        if not np.isfinite(value):
            cell = Rectangle((column - 0.5, row - 0.5), 1, 1, hatch="///", fill=False, edgecolor="#BBBBBB", linewidth=0)
            ax.add_patch(cell)
        elif not dense:
            ink = style.ink_on(to_hex(mpl.colormaps[style.SCALE](scale(value))))
            size = 8 if values.shape[1] <= 6 else 6.5
            ax.text(
                column, row, shown(value), ha="center", va="center", fontsize=size, gid="value",
                color=ink,
            )  # fmt: skip
