"""Who receives from whom, with the nodes coloured by a number: how far off they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure

from zfusion.model.network import Network, points_in_square
from zfusion.model.types import Array, NodeId
from zfusion.report.figures import style
from zfusion.report.figures.quantities import Quantity, shown

UNKNOWN = "#DDDDDD"
"""Colour of a node without a value."""

ARROWS = 400
"""One-way edges up to which arrows are drawn; of more, the heads would hide the lines."""


def place(ids: Sequence[NodeId], graph: Mapping[str, object]) -> Array:
    """Where to draw the nodes, (m, 2): as the graph's rule has them, otherwise on a circle.

    `graph` is the description in the scenario, as plain data. Rows are in the order of `ids`, which are sorted.
    """
    m = len(ids)
    match graph:
        case {"generator": "grid"}:
            columns = graph.get("columns") or math.ceil(math.sqrt(m))
            assert isinstance(columns, int)
            return np.array([(n % columns, -(n // columns)) for n in range(m)], dtype=float)
        case {"generator": "random_geometric"}:
            seed = graph.get("seed", 0)
            assert isinstance(seed, int)
            return points_in_square(m, seed)
        case {"generator": "line"}:
            return np.array([(n, 0.35 * (n % 2)) for n in range(m)], dtype=float)
        case {"generator": "star"}:
            hub = graph.get("hub", ids[0])
            others = iter(_circle(m - 1))
            return np.array([(0.0, 0.0) if i == hub else next(others) for i in ids])
    return _circle(m)


def draw(network: Network, at: Array, values: Mapping[NodeId, float], quantity: Quantity, title: str = "") -> Figure:
    """The graph, with nodes at `at`, (m, 2), in the colour of their value; grey where there is none."""
    with style.drawing():
        figure = Figure(figsize=(6.2, 5.2), layout="constrained")
        ax = figure.subplots()
        figure.suptitle(title)
        panel(ax, network, at, values, _scale([values]))
        _colour_bar(figure, [ax], _scale([values]), quantity)
        return figure


def draw_many(graphs: Sequence[tuple[str, Network, Array, Mapping[NodeId, float]]], quantity: Quantity) -> Figure:
    """Several graphs beside each other, (title, network, places, values), on one colour scale."""
    with style.drawing():
        if not graphs:
            return style.nothing("there are no networks to show")
        columns = min(len(graphs), style.COLUMNS)
        rows = -(-len(graphs) // columns)
        figure = Figure(figsize=(max(style.WIDTH_IN, 3.4 * columns), 3.3 * rows), layout="constrained")
        axes: list[Axes] = list(figure.subplots(rows, columns, squeeze=False).ravel())
        scale = _scale([values for *_, values in graphs])
        for ax, (title, network, at, values) in zip(axes, graphs, strict=False):
            style.title(ax, title, len(graphs))
            panel(ax, network, at, values, scale)
        for unused in axes[len(graphs) :]:
            unused.set_axis_off()
        _colour_bar(figure, axes, scale, quantity)
        return figure


def panel(ax: Axes, network: Network, at: Array, values: Mapping[NodeId, float], scale: Normalize) -> None:
    """One graph on axes of its own."""
    ids = network.ids
    rank = {i: n for n, i in enumerate(ids)}
    senders = {i: set(network.neighbours(i)) for i in ids}
    both = [(a, b) for a, b in network.links() if a in senders[b] and b in senders[a]]
    one_way = [(j, i) for i in ids for j in network.neighbours(i) if j != i and i not in senders[j]]
    crowded = len(both) + len(one_way) > 150
    width, alpha = (0.4, 0.35) if crowded else (1.0, 0.8)
    segments = [at[[rank[a], rank[b]]] for a, b in (both if len(one_way) <= ARROWS else [*both, *one_way])]
    ax.add_collection(LineCollection(segments, colors=style.GREY, linewidths=width, alpha=alpha, zorder=1, gid="links"))
    size = float(np.clip(900 / math.sqrt(len(ids)), 28, 430))
    radius = math.sqrt(size / math.pi)
    for sender, receiver in one_way if len(one_way) <= ARROWS else ():
        ax.annotate(
            "", xy=tuple(at[rank[receiver]]), xytext=tuple(at[rank[sender]]), zorder=1,
            arrowprops={"arrowstyle": "-|>", "color": style.GREY, "linewidth": width, "alpha": alpha,
                        "shrinkA": radius, "shrinkB": radius + 1, "mutation_scale": 9},
        )  # fmt: skip
    numbers = np.array([values.get(i, math.nan) for i in ids])
    scalar = ScalarMappable(scale, style.SCALE)
    faces = [to_hex(scalar.to_rgba(v)) if math.isfinite(v) else UNKNOWN for v in numbers.tolist()]  # type: ignore[arg-type]
    ax.scatter(at[:, 0], at[:, 1], s=size, c=faces, edgecolors="white", linewidths=0.8, zorder=2, gid="nodes")
    if len(ids) <= 64:
        _name_nodes(ax, ids, at, faces, size)
    ax.set_axis_off()
    ax.set_aspect("equal")
    ax.margins(0.14)


def _name_nodes(ax: Axes, ids: Sequence[NodeId], at: Array, faces: Sequence[str], size: float) -> None:
    """Ids in the nodes where they fit, beside them where they do not."""
    within = max(len(str(i)) for i in ids) * 6.5 < 2 * math.sqrt(size / math.pi) * 1.1
    for i, (x, y), face in zip(ids, at.tolist(), faces, strict=True):
        if within:
            ax.text(x, y, str(i), ha="center", va="center", fontsize=8, color=style.ink_on(face), zorder=3)
        else:
            ax.annotate(
                str(i), (x, y), xytext=(0, math.sqrt(size / math.pi) + 1), textcoords="offset points",
                ha="center", va="bottom", fontsize=6.5, zorder=3,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.4},
            )  # fmt: skip


def _circle(m: int) -> Array:
    """m points on a circle, clockwise from the top."""
    angle = np.pi / 2 - 2 * np.pi * np.arange(m) / max(m, 1)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _scale(of: Sequence[Mapping[NodeId, float]]) -> Normalize:
    finite = [v for values in of for v in values.values() if math.isfinite(v)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
    return Normalize(low, high if high > low else low + max(abs(low), 1.0) * 1e-6)


def _colour_bar(figure: Figure, axes: Sequence[Axes], scale: Normalize, quantity: Quantity) -> None:
    bar = figure.colorbar(ScalarMappable(scale, style.SCALE), ax=list(axes), label=quantity.label, shrink=0.75)
    bar.outline.set_visible(False)
    assert scale.vmin is not None
    assert scale.vmax is not None
    if scale.vmax - scale.vmin <= 2e-6 * max(abs(scale.vmin), 1.0):
        bar.set_ticks([scale.vmin], labels=[shown(scale.vmin)])
