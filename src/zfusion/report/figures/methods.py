"""Methods beside each other: errors, by node too, whose covariances can be believed, and error against traffic."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from zfusion.model.types import Array
from zfusion.report.figures import curves
from zfusion.report.figures.quantities import Quantity, metric
from zfusion.report.figures.style import Picture
from zfusion.studies.compare import ALL
from zfusion.studies.intervals import Interval
from zfusion.studies.method_comparison import BELIEVED, MethodComparison

MOST_NODES = 32

HERE, IDEAL = "this network", "ideal network"

INTERVALS = "Bars are 95 % intervals"


def pictures(found: MethodComparison) -> Iterator[Picture]:
    """The figures of a comparison."""
    labels = [standing.label for standing in found.standings]
    over = Quantity("method")
    error = metric("mse")
    local, best = found.local[ALL], found.centralized
    lines = [_line(HERE, [standing.mse for standing in found.standings])]
    twins = [standing.ideal_mse for standing in found.standings]
    if any(twin is not None for twin in twins):
        lines.append(_line(IDEAL, twins))
    at = np.arange(len(labels), dtype=np.float64)
    bounds = [
        curves.Bound("alone (predicted)", at, np.full(len(at), local), best=False),
        curves.Bound("centre (predicted)", at, np.full(len(at), best), best=True),
    ]
    yield Picture(
        "methods-error",
        "Error by method",
        f"Mean squared error over all nodes and steps. {INTERVALS} over the {found.unit}s; nobody can be below the "
        "centre, and a method above the line of being alone is worth nothing here.",
        curves.draw([curves.Panel("", lines, bounds)], curves.Frame(over, error, ticks=labels)),
    )
    yield Picture(
        "methods-nees",
        "Whose covariance can be believed",
        "Normalised squared error over the dimension of the state: 1 where the reported covariance is that of the "
        f"errors, above where it is optimistic, below where it is pessimistic. {INTERVALS}.",
        curves.draw(
            [curves.Panel("", [_line("", [standing.nees for standing in found.standings])])],
            curves.Frame(
                over,
                Quantity("NEES / dimension"),
                ticks=labels,
                band=(1 - BELIEVED, 1 + BELIEVED),
                band_label=f"right within {BELIEVED:.0%}",
                level=1.0,
            ),
        ),
    )
    yield _by_node(found, error)
    yield _against_traffic(found, error)


def _line(label: str, intervals: Sequence[Interval | None]) -> curves.Line:
    rows = [(np.nan,) * 3 if one is None else (one.mean, *_ends(one)) for one in intervals]
    mean, low, high = np.array(rows, dtype=np.float64).T
    return curves.Line(label, np.arange(len(rows), dtype=np.float64), mean, low, high)


def _ends(one: Interval) -> tuple[float, float]:
    return (np.nan if one.low is None else one.low, np.nan if one.high is None else one.high)


def _by_node(found: MethodComparison, error: Quantity) -> Picture:
    nodes = [node for node in found.local if node != ALL]
    shown = nodes[:MOST_NODES]
    at, nothing = np.arange(len(shown), dtype=np.float64), np.full(len(shown), np.nan)
    lines = [
        curves.Line(one.label, at, np.array([one.by_node.get(node, np.nan) for node in shown]), nothing, nothing)
        for one in found.standings
    ]
    bounds = [
        curves.Bound("alone (predicted)", at, np.array([found.local[node] for node in shown]), best=False),
        curves.Bound("centre (predicted)", at, np.full(len(shown), found.centralized), best=True),
    ]
    more = "" if len(shown) == len(nodes) else f" The first {MOST_NODES} nodes only."
    return Picture(
        "methods-by-node",
        "Error by node",
        f"Mean squared error of every node under every method, beside being alone and a centre.{more}",
        curves.draw([curves.Panel("", lines, bounds)], curves.Frame(Quantity("node"), error, ticks=shown)),
    )


def _against_traffic(found: MethodComparison, error: Quantity) -> Picture:
    def point(value: float) -> Array:
        return np.array([value])

    lines = [
        curves.Line(one.label, point(one.bytes), point(one.mse.mean), *(point(end) for end in _ends(one.mse)))
        for one in found.standings
    ]
    traffic = Quantity("bytes a step, all edges", "kB", 1e-3)
    return Picture(
        "methods-traffic",
        "Error against traffic",
        f"What a method sends, and what that buys: down and to the left is better. {INTERVALS}.",
        curves.draw([curves.Panel("", lines)], curves.Frame(traffic, error)),
    )
