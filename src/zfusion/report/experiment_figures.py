"""Which figures an experiment's results make: from axes and metrics to lines, panels and maps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from zfusion.errors import ZfusionError
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import Array, NodeId
from zfusion.report.figures import curves, heat_map, latency, over_time, topology
from zfusion.report.figures.quantities import Quantity, axis, metric
from zfusion.report.figures.style import MOST_PANELS, Picture
from zfusion.report.results import NOTHING, Axis, Point, Results, Value, label_text
from zfusion.stages import ESTIMATE

MOST_LINES = 8
"""Lines in one panel: as many as there are colours that can be told apart."""

MOST_FIGURES = 3
"""Figures that one comparison of the errors is spread over, where there are more panels than fit; others have one."""

MOST_AXES = 4
"""Numeric axes against which everything is drawn."""

MOST_NETWORKS = 9

BEST_LABEL, WORST_LABEL = "centralised bound, every message arrives", "no network: each node by itself"

Values = Mapping[int, Value]


@dataclass(frozen=True)
class Measure:
    """One quantity of all points, and what is set beside it."""

    name: str
    """Of the files."""
    title: str
    quantity: Quantity
    values: Values
    reading: str
    predicted: Values | None = None
    bounds: Sequence[tuple[str, Values, bool]] = ()
    """(label, values, whether it is the better one)."""
    band: tuple[float, float] | None = None
    level: float | None = None
    share: bool = False


def error_measure(results: Results, stage: str = ESTIMATE.name) -> Measure | None:
    """The root mean squared error with all that is set beside it; None where the truth is not known."""
    values = results.values("rmse", stage)
    if not values:
        return None
    bounds = [
        (BEST_LABEL, rooted(results.values("bound_centralized")), True),
        (WORST_LABEL, rooted(results.values("bound_local")), False),
    ]
    return Measure(
        f"rmse-{stage}",
        f"Error of the {stage}",
        metric("rmse"),
        values,
        "Root mean squared error over steps and nodes. Filled markers are measured, with the confidence interval over "
        "the seeds; hollow ones on dashed lines are what the nodes' own covariances predict for the messages that they "
        "used. The dotted line is one filter that has every measurement in time, which no network beats; the line of "
        "dashes and dots is every node by itself. Where measured and predicted disagree by more than the interval, the "
        "covariances are not to be believed.",
        predicted=rooted(results.values("predicted_mse", stage)) or None,
        bounds=[bound for bound in bounds if bound[1]],
    )


def other_measures(results: Results) -> Iterator[Measure]:
    """What else is drawn against the axes, where the tables have it."""
    nees = results.values("nees")
    if nees:
        yield _nees_measure(results, nees)
    simple: tuple[tuple[str, str], ...] = (
        ("disagreement", "How far the nodes' estimates are from their mean, squared; 0 where all agree."),
        ("age", "How many steps old the newest measurement of another node is that has reached an estimate."),
    )
    for name, reading in simple:
        if values := results.values(name):
            quantity = metric(name)
            yield Measure(name, _capital(quantity.name), quantity, values, f"{reading} Bars are confidence intervals.")
    for stage in results.stages("used_fraction"):
        yield Measure(
            f"used-{stage}",
            f"Messages of stage {stage} that were used",
            metric("used_fraction"),
            results.values("used_fraction", stage),
            f"The fraction of the neighbours' {stage} messages that came before the deadline and went in.",
            share=True,
        )
    for stage in results.stages("latency_p50"):
        values = results.values("latency_p50", stage)
        means = [value.mean for value in values.values()]
        if not any(means):
            continue  # links that take no time
        quantity = metric("latency_p50", means)
        title = f"Latency of stage {stage}, median"
        yield Measure(f"latency-{stage}", title, quantity, values, "The median one-way latency of the messages.")
    yield from _cost_measures(results)


def _nees_measure(results: Results, nees: Values) -> Measure:
    bands = {(value.low, value.high) for value in results.values("nees_band").values()}
    dimensions = {value.mean for value in results.values("nees_band").values()}
    return Measure(
        "nees",
        "Consistency: NEES",
        metric("nees"),
        nees,
        "The squared error in units of the predicted covariance. It should be the dimension of the state (dotted): "
        "above, the nodes are too sure of themselves, below, too modest. The green band holds the mean over the seeds "
        "with a probability of 99 %, where errors are Gaussian and one step is taken from each run; time averages "
        "scatter less, heavy-tailed errors more.",
        band=next(iter(bands)) if len(bands) == 1 else None,
        level=next(iter(dimensions)) if len(dimensions) == 1 else None,
    )


def _cost_measures(results: Results) -> Iterator[Measure]:
    steps = {point.number: point.steps for point in results.points}
    for name, unit in (("messages", "messages/step"), ("bytes", "bytes/step")):
        values = {p: _scaled(value, 1 / steps[p]) for p, value in results.values(name, "").items() if p in steps}
        if values:
            reading = "Published by all nodes together, each message once however many nodes receive it."
            yield Measure(name, f"Cost: {name}", Quantity(f"{name} published", unit), values, reading)
    if results.timings:
        yield Measure(
            "rounds",
            "Speed",
            Quantity("rounds", "1/s"),
            results.timings,
            "Steps a second of wall-clock time on the machine that ran the experiment; another machine has others. In "
            "the simulated world it is the speed of the simulation, not of the network.",
        )


def against_axes(results: Results, measure: Measure, most_figures: int = 1) -> Iterator[Picture]:
    """The measure against every numeric axis; where there is none, against the axis with the most values."""
    numeric = [a for a in results.axes if a.numeric][:MOST_AXES]
    chosen = numeric or sorted(results.axes, key=lambda a: -len(a.labels))[:1]
    for against in chosen:
        yield from _against(results, measure, against, most_figures)


def _against(results: Results, measure: Measure, against: Axis, most_figures: int) -> Iterator[Picture]:
    others = [a for a in results.axes if a is not against]
    lines, split = _roles(others)
    frame, place = _frame(measure, against, lines)
    panels = [_panel(measure, title, points, lines, place) for title, points in _groups(results.points, split)]
    panels = [panel for panel in panels if panel.lines]
    chunks = [panels[n : n + MOST_PANELS] for n in range(0, len(panels), MOST_PANELS)]
    for number, chunk in enumerate(chunks[:most_figures]):
        part = f" ({number + 1} of {len(chunks)})" if len(chunks) > 1 else ""
        left_out = sum(map(len, chunks[most_figures:])) if number + 1 == most_figures else 0
        more = f" {left_out} more panels are not drawn; the tables have them." if left_out else ""
        suffix = f"-{number + 1}" if len(chunks) > 1 else ""
        yield Picture(
            f"{measure.name}-by-{_file_name(against.path)}{suffix}",
            f"{measure.title} against {frame.x.name}{part}",
            measure.reading + _seeds_note(measure.values) + more,
            curves.draw(chunk, frame),
        )


def _seeds_note(values: Values) -> str:
    if any(value.n == 1 for value in values.values()):
        return " One seed says nothing about the scatter: there are no intervals."
    return ""


def _frame(measure: Measure, against: Axis, lines: Axis | None) -> tuple[curves.Frame, Callable[[Point], float]]:
    """What the panels share, and where a point is on the x axis."""
    if against.numeric:
        numbers = [float(label) for label in against.labels]
        x, extent = axis(against.path, numbers), (min(numbers), max(numbers))

        def place(point: Point) -> float:
            return float(point.labels[against.path])

    else:
        x, extent = Quantity(against.name), None

        def place(point: Point) -> float:
            return float(against.labels.index(point.labels[against.path]))

    frame = curves.Frame(
        x,
        measure.quantity,
        legend="" if lines is None else _axis_label(lines),
        ordered=lines is not None and lines.numeric,
        extent=extent,
        ticks=() if against.numeric else [label_text(label) for label in against.labels],
        band=measure.band,
        band_label="99 % band of a consistent estimate",
        share=measure.share,
        level=measure.level,
    )
    return frame, place


def _panel(
    measure: Measure, title: str, points: Sequence[Point], lines: Axis | None, place: Callable[[Point], float]
) -> curves.Panel:
    drawn = []
    known = sorted((p for p in points if p.number in measure.values), key=place)
    for label in ("",) if lines is None else lines.labels:
        chosen = [p for p in known if lines is None or p.labels[lines.path] == label]
        if chosen:
            x = np.array([place(p) for p in chosen])
            mean, low, high, _ = np.array([measure.values[p.number] for p in chosen], dtype=float).T
            predicted = _column(measure.predicted, chosen)
            drawn.append(curves.Line(label_text(label), x, mean, low, high, predicted))
    bounds = [_bound(*bound, points, place) for bound in measure.bounds]
    return curves.Panel(title, drawn, [bound for bound in bounds if bound is not None])


def _column(values: Values | None, points: Sequence[Point]) -> Array | None:
    if values is None:
        return None
    return np.array([values.get(p.number, NOTHING).mean for p in points])


def _bound(
    label: str, values: Values, best: bool, points: Sequence[Point], place: Callable[[Point], float]
) -> curves.Bound | None:
    """A bound as a line over x; None where the lines of a panel do not have it in common."""
    found: dict[float, float] = {}
    for point in points:
        if point.number in values:
            value = values[point.number].mean
            if not math.isclose(found.setdefault(place(point), value), value, rel_tol=1e-9):
                return None
    if not found:
        return None
    x = np.array(sorted(found))
    return curves.Bound(label, x, np.array([found[at] for at in x]), best)


def _roles(others: Sequence[Axis]) -> tuple[Axis | None, list[Axis]]:
    """The axis whose values are lines of one panel, and those whose values are panels of their own.

    Lines are what is compared most easily: names before numbers, and rather more than few.
    """
    fitting = [a for a in others if len(a.labels) <= MOST_LINES]
    if not fitting:
        return None, list(others)
    lines = min(fitting, key=lambda a: (a.numeric, -len(a.labels)))
    return lines, [a for a in others if a is not lines]


def _groups(points: Sequence[Point], split: Sequence[Axis]) -> Iterator[tuple[str, list[Point]]]:
    """The points by their values of some axes, with those values in words."""
    groups: dict[tuple[str, ...], list[Point]] = {}
    for point in points:
        groups.setdefault(tuple(repr(point.labels[a.path]) for a in split), []).append(point)
    for group in groups.values():
        yield group[0].words(split), group


def heat_maps(results: Results, measure: Measure) -> Iterator[Picture]:
    """The measure over every pair of axes whose values are numbers, or some of whose labels are."""
    scales = [a for a in results.axes if len(_numbers(a)) > 1][:MOST_AXES]
    for x_axis, y_axis in combinations(scales, 2):
        split = [a for a in results.axes if a not in (x_axis, y_axis)]
        points = [p for p in results.points if all(_number(p.labels[a.path]) is not None for a in (x_axis, y_axis))]
        groups = [*_groups(points, split)]
        maps = [_map(title, group, x_axis, y_axis, measure.values) for title, group in groups[:MOST_PANELS]]
        x, y = (axis(a.path, _numbers(a)) for a in (x_axis, y_axis))
        more = f" {len(groups) - MOST_PANELS} more maps are not drawn." if len(groups) > MOST_PANELS else ""
        more += " Conditions to which no number belongs are left out." if len(points) < len(results.points) else ""
        yield Picture(
            f"{measure.name}-map-{_file_name(x_axis.path)}-{_file_name(y_axis.path)}",
            f"{measure.title} over {x.name} and {y.name}",
            "Each cell is the mean over the seeds for one pair of values, written in it; the brighter, the larger. "
            f"Hatched cells have no result. Cells are of one size, whatever the distance of their values.{more}",
            heat_map.draw(maps, x, y, measure.quantity),
        )


def _number(label: object) -> float | None:
    """What number a label is, None if it is none."""
    try:
        return float(str(label))
    except ValueError:
        return None


def _numbers(of: Axis) -> list[float]:
    return [number for number in map(_number, of.labels) if number is not None]


def _map(title: str, points: Sequence[Point], x_axis: Axis, y_axis: Axis, values: Values) -> heat_map.Map:
    x, y = (np.array(sorted(_numbers(a))) for a in (x_axis, y_axis))
    cells = np.full((len(y), len(x)), math.nan)
    for point in points:
        row, column = (
            int(np.searchsorted(of, float(str(point.labels[a.path])))) for of, a in ((y, y_axis), (x, x_axis))
        )
        cells[row, column] = values.get(point.number, NOTHING).mean
    return heat_map.Map(title, x, y, cells)


def errors_over_time(results: Results) -> Picture | None:
    """Mean squared errors at every step beside the predicted ones; of many points a choice from best to worst."""
    courses = results.courses()
    if not courses:
        return None
    ranked = sorted(courses, key=lambda point: float(np.nanmean(courses[point].error_sq)))
    chosen = [ranked[round(n)] for n in np.linspace(0, len(ranked) - 1, min(len(ranked), MOST_PANELS))]
    points = {point.number: point for point in results.points}
    drawn = [
        over_time.Course(points[n].words(results.axes), c.steps, c.error_sq, c.low, c.high, c.predicted)
        for n, c in ((n, courses[n]) for n in sorted(chosen))
    ]
    seeds = max(course.n for course in courses.values())
    has_band = any(np.isfinite(course.low).any() for course in drawn)
    band = f", {results.facts['confidence']:.0%} interval" if has_band else ""
    some = f" {len(chosen)} of {len(ranked)} conditions are shown, from the best to the worst."
    return Picture(
        "error-over-time",
        "Error over time",
        "The squared error of the final estimates at every step, averaged over nodes and seeds (line"
        f"{', with its interval shaded' if has_band else ''}), and the mean of what the nodes predicted (dashed). The "
        "line should scatter about the dashed one from the first step to the last."
        f"{some if len(chosen) < len(ranked) else ''}",
        over_time.draw(drawn, metric("mse").label, f"mean over seeds, n = {seeds}{band}", "predicted"),
    )


def networks(results: Results) -> Picture | None:
    """The graphs that there are, each in the condition in which its error is largest, with the nodes' own errors."""
    errors = results.values("rmse")
    worst: dict[str, tuple[Point, Scenario]] = {}
    for point in sorted(results.points, key=lambda p: -errors.get(p.number, NOTHING).mean):
        scenario = _scenario_of(results, point)
        if scenario is not None and point.number in errors:
            graph = chosen(scenario).network(scenario.network)
            worst.setdefault(repr(graph.neighbourhoods), (point, scenario))
    if not worst:
        return None
    graphs = []
    for point, scenario in sorted(worst.values(), key=lambda item: item[0].number)[:MOST_NETWORKS]:
        graph = chosen(scenario).network(scenario.network)
        rule = scenario.network_spec.model_dump(by_alias=True, exclude_none=True)
        at = topology.place(graph.ids, rule if graph == scenario.network else {})
        values: dict[NodeId, float] = {
            i: results.values("rmse", node=str(i)).get(point.number, NOTHING).mean for i in graph.ids
        }
        graphs.append((point.words(results.axes), graph, at, values))
    more = f" {len(worst) - MOST_NETWORKS} more graphs are not drawn." if len(worst) > MOST_NETWORKS else ""
    return Picture(
        "networks",
        "The networks, with the nodes coloured by their error",
        "Each graph is shown in the condition in which its error is largest. An arrow leads from a node to one that "
        "receives from it, a plain line both ways; the brighter a node, the larger its root mean squared error. Places "
        f"are those of the graph's generator where it has any, otherwise on a circle.{more}",
        topology.draw_many(graphs, metric("rmse")),
    )


def latencies_by_edge(results: Results) -> Iterator[Picture]:
    """Quantiles of the latencies on every edge, in the condition in which they are largest."""
    edges = results.senders("latency_p50")
    for stage in dict.fromkeys(stage for *_, stage in edges):
        of_stage = [(sender, node) for sender, node, s in edges if s == stage]
        totals: dict[int, float] = {}
        for sender, node in of_stage:
            for point, value in results.values("latency_p99", stage, node, sender).items():
                totals[point] = max(totals.get(point, 0.0), value.mean)
        if not any(totals.values()):
            continue
        worst = max(totals, key=lambda point: totals[point])
        quantiles = [
            latency.Quantiles(
                f"{sender} → {node}",
                *(
                    results.values(name, stage, node, sender).get(worst, NOTHING).mean
                    for name in ("latency_p50", "latency_p90", "latency_p99")
                ),
            )
            for sender, node in of_stage
        ]
        where = next(p for p in results.points if p.number == worst).words(results.axes)
        yield Picture(
            f"latency-edges-{stage}",
            f"Latency by edge, {stage}",
            "For each edge, sender → receiver, the median, the 90 % and the 99 % quantile of the one-way latency, "
            f"means over the seeds{f', in the condition with the largest: {where}' if where else ''}.",
            latency.draw_quantiles(quantiles),
        )


def _scenario_of(results: Results, point: Point) -> Scenario | None:
    """The point's scenario; None where its file is gone or of another version."""
    try:
        return load_scenario(results.scenario_file(point))
    except ZfusionError:
        return None


def rooted(values: Values) -> dict[int, Value]:
    """The roots of mean squares and of their intervals."""

    def root(square: float) -> float:
        return math.sqrt(square) if square >= 0 else math.nan

    return {p: Value(root(of.mean), root(of.low), root(of.high), of.n) for p, of in values.items()}


def _scaled(value: Value, factor: float) -> Value:
    return Value(value.mean * factor, value.low * factor, value.high * factor, value.n)


def _axis_label(of: Axis) -> str:
    return axis(of.path, [1.0]).label if of.numeric else of.name


def _file_name(path: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in path)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
