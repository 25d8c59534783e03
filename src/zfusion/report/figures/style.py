"""What all figures have in common: size, colours that colour-blind people can tell apart, and how they are saved.

Colours: M. Okabe, K. Ito, Color Universal Design (2008), without their yellow, which is too faint on white paper. What
has an order is coloured by a scale that gets darker evenly (viridis). No colour carries a meaning alone: lines have
markers, what is late is dashed, what is lost is a cross.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from zfusion.report.figures.quantities import shown

LineStyle = Literal["-", "--", "-.", ":", "none"]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6BB1")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
SCALE = "viridis"
BEST, WORST, GREY, ALARM = "#444444", "#999999", "#777777", "#B40426"
"""Lines of the two bounds, what is said in passing, what went wrong."""

WIDTH_IN = 7.2
"""Of a figure with one panel, in inches: a page's text, and legible on a screen."""

PANEL_IN = (3.6, 2.9)
"""Of one of several panels."""

TITLE_CHARACTERS = 42
"""That fit above a panel, in one line."""

COLUMNS = 3
MOST_PANELS = 12
"""Panels that a figure has at most: four rows fit on a page."""

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial", "sans-serif"],
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "text.parse_math": False,
}
"""Text stays text in an SVG file: it can be searched, and edited for a paper. It is never taken for mathematics: names
of nodes and runs are anybody's."""

PNG_DPI = 160


@dataclass(frozen=True)
class Picture:
    """A figure and what goes with it."""

    name: str
    """Of its files, without suffix; also its anchor in a report."""
    title: str
    reading: str
    """How to read it, in a few sentences."""
    figure: Figure

    def save(self, directory: Path) -> tuple[Path, Path]:
        """Write it as SVG and PNG; the two paths. OSError if they cannot be written."""
        directory.mkdir(parents=True, exist_ok=True)
        svg, png = directory / f"{self.name}.svg", directory / f"{self.name}.png"
        svg.write_text(self.svg, encoding="utf-8")
        with drawing(self.name):
            self.figure.savefig(png, dpi=PNG_DPI, metadata={"Software": None})
        return svg, png

    @cached_property
    def svg(self) -> str:
        """The figure as SVG; the same bytes every time."""
        text = io.StringIO()
        with drawing(self.name):
            engine = self.figure.get_layout_engine()
            if engine is not None:  # once is enough: it takes longer than drawing
                engine.execute(self.figure)
                self.figure.set_layout_engine("none")
            self.figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Title": self.title})
        return _with_different_ids(text.getvalue())

    def inline(self) -> str:
        """The figure as an element of an HTML page on which there are others: ids of its own, no prologue."""
        text = self.svg[self.svg.index("<svg") :]
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = re.sub(r'\bid="', f'id="{self.name}.', text)
        return re.sub(r'(href="#|url\(#)', rf"\g<1>{self.name}.", text)


def _with_different_ids(svg: str) -> str:
    """Artists of one kind have one name in a figure; in a file no two elements may."""
    seen: Counter[str] = Counter()

    def numbered(found: re.Match[str]) -> str:
        seen[found[1]] += 1
        return found[0] if seen[found[1]] == 1 else f' id="{found[1]}-{seen[found[1]]}"'

    return re.sub(r' id="([^"]+)"', numbered, svg)


@contextmanager
def drawing(salt: str = "zfusion") -> Iterator[None]:
    """Draw and save in our style, whatever the user's own settings are; `salt` makes the ids in an SVG reproducible."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(STYLE)
        mpl.rcParams["svg.hashsalt"] = salt
        yield


def panels(
    count: int, *, panel: tuple[float, float] = PANEL_IN, single: tuple[float, float] = (WIDTH_IN, 4.0)
) -> tuple[Figure, list[Axes]]:
    """A figure with `count` >= 1 panels side by side that share their axes; to be called while `drawing`."""
    columns = min(count, COLUMNS if count != 4 else 2)
    rows = -(-count // columns)
    size = single if count == 1 else (max(WIDTH_IN, panel[0] * columns), panel[1] * rows + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    axes: list[Axes] = list(grid.ravel())
    for unused in axes[count:]:
        unused.set_axis_off()
    for above in axes[max(0, count - columns) : count]:
        above.xaxis.set_tick_params(labelbottom=True)
    return figure, axes[:count]


def label_axes(figure: Figure, axes: Sequence[Axes], x: str, y: str) -> None:
    """Label the axes that all panels share: x below every column, y once."""
    columns = {ax.get_subplotspec().colspan.start: ax for ax in axes}  # type: ignore[union-attr]
    for lowest in columns.values():
        lowest.set_xlabel(x)
    if len(axes) == 1:
        axes[0].set_ylabel(y)
    else:
        figure.supylabel(y, fontsize=9.0)


def title(ax: Axes, text: str, of: int) -> None:
    """Say above a panel, one of so many, what it is of; in as many lines as it takes."""
    width = TITLE_CHARACTERS if of > 1 else 2 * TITLE_CHARACTERS
    ax.set_title("\n".join(textwrap.wrap(text, width)), loc="left", fontsize=8.0 if of > 1 else 9.0)


def note(ax: Axes, text: str) -> None:
    """Say something above a panel, at its right end, in passing."""
    ax.set_title(text, loc="right", fontsize=7, color=GREY)


def tick_logarithmically(axis: Axis) -> None:
    """Give a logarithmic axis ticks with their numbers written out: at 1, 2 and 5 times powers of ten, or, over many
    decades, at powers of ten."""
    low, high = sorted(axis.get_view_interval())
    decades = math.log10(high / low) if low > 0 else math.inf
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 3 else (1.0,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: shown(value)))
    axis.set_minor_formatter(NullFormatter())


def nothing(reason: str) -> Figure:
    """What stands where there is nothing to draw."""
    figure = Figure(figsize=(WIDTH_IN, 1.4))
    figure.text(0.5, 0.5, reason, ha="center", va="center", color=GREY, fontsize=10)
    return figure


def colours(count: int, ordered: bool = False) -> list[str]:
    """So many colours; `ordered` ones, or more than there are names for, from a scale."""
    if not ordered and count <= len(COLOURS):
        return list(COLOURS[:count])
    scale = mpl.colormaps[SCALE]
    return [to_hex(scale(where)) for where in np.linspace(0.0, 0.88, max(count, 1))]


def ink_on(colour: str) -> str:
    """Black or white, whichever can be read on a colour."""
    red, green, blue = to_rgb(colour)
    return "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "white"


def marker(number: int) -> str:
    """The marker of line `number`."""
    return MARKERS[number % len(MARKERS)]
