"""Figures show the numbers that they are given, with names and units, and survive what is odd."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from zfusion.model.network import Network
from zfusion.report.figures import curves, heat_map, latency, over_time, space_time, topology
from zfusion.report.figures.quantities import Quantity, axis, in_seconds, metric, shown
from zfusion.report.figures.space_time import Diagram, Fate, Flight, Mark, Round
from zfusion.report.figures.style import COLOURS, Picture, colours

X = np.array([0.0, 0.01, 0.02, 0.04])
DELAY = axis("links.delay", X.tolist())
RMSE = metric("rmse")


def found(figure: Figure, gid: str) -> list[Any]:
    return [artist for artist in figure.findobj(Artist) if artist.get_gid() == gid]


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.findobj(Text) if text.get_text()}


def line(label: str, level: float, *, predicted: bool = True, interval: float = 0.1) -> curves.Line:
    mean = level + X
    return curves.Line(label, X, mean, mean - interval, mean + interval, mean * 1.1 if predicted else None)


def frame(**more: Any) -> curves.Frame:
    return curves.Frame(DELAY, RMSE, **more)


def picture(figure: Figure, name: str = "some") -> Picture:
    return Picture(name, "Some title", "How to read it.", figure)


# --- a quantity against an axis -----------------------------------------------------------------------------------


def test_a_curve_has_the_numbers_their_intervals_and_what_is_beside_them() -> None:
    bounds = [
        curves.Bound("best", X, np.full(4, 0.5), True),
        curves.Bound("worst", X, np.full(4, 3.0), False),
        curves.Bound("not constant", X, X + 2.0, False),
    ]
    figure = curves.draw([curves.Panel("", [line("drop", 1.0)], bounds)], frame())
    [measured] = found(figure, "measured")
    assert np.allclose(measured.get_xdata(), 1e3 * X)
    assert np.allclose(measured.get_ydata(), 1.0 + X)
    [bars] = [c for c in figure.axes[0].collections if len(c.get_segments()) == 4]
    assert np.allclose([segment[:, 1] for segment in bars.get_segments()], np.column_stack([0.9 + X, 1.1 + X]))
    [predicted] = found(figure, "predicted")
    assert np.allclose(predicted.get_ydata(), 1.1 * (1.0 + X))
    assert [np.unique(b.get_ydata()).tolist() for b in found(figure, "bound")][:2] == [[0.5], [3.0]]
    assert np.allclose(found(figure, "bound")[2].get_ydata(), X + 2.0)
    assert {"link delay [ms]", "root mean squared error [unit of the state]", "drop", "predicted", "best"} <= texts(
        figure
    )
    low, high = figure.axes[0].get_ylim()
    assert low <= 0.5
    assert high > 3.0


@pytest.mark.parametrize("count", [1, 2, 8, 11])
def test_every_line_has_a_colour_and_a_marker_of_its_own(count: int) -> None:
    lines = [line(f"policy {n}", 1.0 + n) for n in range(count)]
    figure = curves.draw([curves.Panel("", lines)], frame(legend="policy"))
    measured: list[Line2D] = found(figure, "measured")
    assert len({m.get_color() for m in measured}) == count
    assert len({(m.get_color(), m.get_marker()) for m in measured}) == count
    assert {f"policy {n}" for n in range(count)} <= texts(figure)
    assert "policy" in texts(figure)
    places = np.array([m.get_xdata() for m in measured])
    assert np.ptp(places, axis=0).max() <= 0.02 * 1e3 * np.ptp(X)  # moved apart, but not to another value


def test_panels_share_their_axes() -> None:
    panels = [curves.Panel(f"network = {n}", [line("drop", 1.0 + n)]) for n in range(5)]
    figure = curves.draw(panels, frame())
    drawn = [ax for ax in figure.axes if ax.lines]
    assert len(drawn) == 5
    assert len({ax.get_ylim() for ax in drawn}) == 1
    assert {f"network = {n}" for n in range(5)} <= texts(figure)
    assert {DELAY.label, RMSE.label} <= texts(figure)


def test_names_on_an_axis_are_not_joined() -> None:
    x = np.arange(3.0)
    lines = [curves.Line(label, x, x + n, x + n, x + n, x) for n, label in enumerate(("drop", "revise"))]
    figure = curves.draw(
        [curves.Panel("", lines)], curves.Frame(Quantity("network"), RMSE, ticks=["ring", "grid", "all"])
    )
    assert {m.get_linestyle() for m in found(figure, "measured")} == {"None"}
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["ring", "grid", "all"]
    first, second = (m.get_xdata() for m in found(figure, "measured"))
    assert (second > first).all()
    assert np.allclose(np.round(first), x)


def test_what_is_not_finite_is_left_out_and_told() -> None:
    mean = np.array([1.0, math.nan, 2.0, math.inf])
    nothing = np.full(4, math.nan)
    figure = curves.draw([curves.Panel("", [curves.Line("one seed", X, mean, nothing, nothing)])], frame())
    assert "2 not finite" in texts(figure)
    bars = [segment for c in figure.axes[0].collections for segment in c.get_segments()]
    assert not np.isfinite(
        np.concatenate([np.ravel(bar) for bar in bars])[1::2]
    ).any()  # no interval, not one of length 0
    assert "one seed" in picture(figure).svg
    empty = curves.draw([curves.Panel("", [curves.Line("", X, nothing, nothing, nothing)])], frame())
    assert "there are no finite values to show" in texts(empty)
    assert "there are no finite values to show" in texts(curves.draw([], frame()))


def test_orders_of_magnitude_are_drawn_on_a_logarithmic_axis() -> None:
    wide = curves.Line("", np.array([1e-3, 1e-2, 1e-1]), *(np.array([0.1, 10.0, 1000.0]),) * 3)
    ax = curves.draw([curves.Panel("", [wide])], frame()).axes[0]
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    ax = curves.draw([curves.Panel("", [line("", 1.0)])], frame()).axes[0]
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "linear")


def test_the_band_where_a_quantity_belongs() -> None:
    figure = curves.draw([curves.Panel("", [line("", 1.0)])], frame(band=(0.9, 1.2), band_label="99 % band", level=1.0))
    [band] = found(figure, "band")
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx((0.9, 1.2))
    assert found(figure, "level")[0].get_ydata()[0] == 1.0
    assert "99 % band" in texts(figure)


def test_values_without_a_result_keep_their_place_on_the_axis() -> None:
    only = curves.Line("", X[:1], *(np.ones(1),) * 3)
    low, high = curves.draw([curves.Panel("", [only])], frame(extent=(0.0, 0.04))).axes[0].get_xlim()
    assert low < 0
    assert high > 40


# --- maps, time, latencies, graphs ----------------------------------------------------------------------------------


def test_a_map_has_its_values_written_in_it() -> None:
    values = np.array([[1.0, 2.0, math.nan], [3.25, 4.0, 5.0]])
    x, y = np.array([0.0, 0.01, 0.02]), np.array([0.3, 0.6])
    deadline = axis("timing.deadlines.measurement", y.tolist())
    figure = heat_map.draw([heat_map.Map("late = drop", x, y, values)], DELAY, deadline, RMSE)
    written = {t.get_position(): t.get_text() for t in found(figure, "value")}
    assert written == {(0, 0): "1", (1, 0): "2", (0, 1): "3.25", (1, 1): "4", (2, 1): "5"}
    assert {"link delay [ms]", "deadline of stage measurement [periods]", RMSE.label, "late = drop"} <= texts(figure)
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["0", "10", "20"]
    assert "there are no finite values to show" in texts(heat_map.draw([], DELAY, deadline, RMSE))


def test_errors_over_time_with_band_and_prediction() -> None:
    k = np.arange(1.0, 51.0)
    course = over_time.Course("delay = 0", k, k / 50, k / 50 - 0.1, k / 50 + 0.1, k / 40)
    figure = over_time.draw([course], "error [m]", "mean", "predicted")
    assert np.allclose(found(figure, "measured")[0].get_ydata(), k / 50)
    assert np.allclose(found(figure, "predicted")[0].get_ydata(), k / 40)
    assert len(found(figure, "interval")) == 1
    assert {"step k", "error [m]", "mean", "predicted", "delay = 0"} <= texts(figure)


def test_long_runs_are_averaged_over_blocks_and_say_so() -> None:
    k = np.arange(1.0, 8001.0)
    nothing = np.full(8000, math.nan)
    figure = over_time.draw([over_time.Course("", k, k, nothing, nothing, k)], "error", "mean", "predicted")
    [measured] = found(figure, "measured")
    assert len(measured.get_ydata()) == over_time.MOST_POINTS
    assert np.allclose(measured.get_xdata(), measured.get_ydata())
    assert "means over 10 steps" in texts(figure)


def test_an_error_within_its_standard_deviations() -> None:
    k = np.arange(1.0, 21.0)
    envelopes = [over_time.Envelope(f"component {n}", k, np.sin(k), np.full(20, 0.5)) for n in range(2)]
    figure = over_time.draw_envelopes(envelopes, "error [m]")
    assert np.allclose(found(figure, "measured")[1].get_ydata(), np.sin(k))
    vertices = found(figure, "interval")[0].get_paths()[0].vertices[:, 1]
    assert (vertices.min(), vertices.max()) == (-1.0, 1.0)


def test_a_distribution_of_latencies_ends_below_one_where_messages_were_lost() -> None:
    samples = [
        latency.Sample("1 → 2", np.array([3e-3, 1e-3, 2e-3]), lost=1),
        latency.Sample("2 → 1", np.array([5e-3, math.nan])),
        latency.Sample("3 → 1", np.array([])),
    ]
    figure = latency.draw_distributions(samples)
    first, second = found(figure, "edge")
    assert np.allclose(first.get_xdata(), [1.0, 1.0, 2.0, 3.0])
    assert np.allclose(first.get_ydata(), [0.0, 0.25, 0.5, 0.75])
    assert np.allclose(second.get_ydata(), [0.0, 1.0])
    assert {"one-way latency [ms]", "fraction of messages", "1 → 2", "2 → 1"} <= texts(figure)
    assert "no latencies were measured" in texts(latency.draw_distributions([]))


def test_of_many_edges_the_slowest_are_named() -> None:
    samples = [latency.Sample(f"{n} → 0", np.array([n * 1e-3])) for n in range(1, 21)]
    drawn = texts(latency.draw_distributions(samples))
    assert {"20 → 0", "13 → 0", "12 faster edges"} <= drawn
    assert "12 → 0" not in drawn


def test_quantiles_by_edge_slowest_first() -> None:
    edges = [latency.Quantiles("1 → 2", 1e-3, 2e-3, 3e-3), latency.Quantiles("2 → 1", 4e-3, 5e-3, 6e-3)]
    figure = latency.draw_quantiles(edges)
    assert np.allclose(found(figure, "median")[0].get_xdata(), [4.0, 1.0])
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["2 → 1", "1 → 2"]


def test_the_parts_of_a_budget_stand_end_to_end() -> None:
    figure = latency.draw_budget(
        {"1 → 2": {"computed": 100.0, "wire": 300.0, "waited": 600.0}, "2 → 1": {"wire": 50.0}}
    )
    bars = {(gid, n): bar for gid in ("computed", "wire", "waited") for n, bar in enumerate(found(figure, gid))}
    ends = [(bars[part, 0].get_x(), bars[part, 0].get_width()) for part in ("computed", "wire", "waited")]
    assert np.allclose(ends, [(0.0, 0.1), (0.1, 0.3), (0.4, 0.6)])
    assert {"time of a mean round [ms]", "computed", "wire", "waited"} <= texts(figure)
    assert "queued" not in texts(figure)


GRAPHS: list[tuple[Network, dict[str, object]]] = [
    (Network.grid(range(1, 13)), {"generator": "grid"}),
    (Network.random_geometric(range(1, 33), 0.3, 5), {"generator": "random_geometric", "radius": 0.3, "seed": 5}),
    (Network.star(["hub", "a", "b"], "hub"), {"generator": "star", "hub": "hub"}),
    (Network.complete(range(1, 33)), {"generator": "complete"}),
    (Network.from_edges((1, 2, 3), [(1, 2), (2, 3)]), {"edges": [[1, 2], [2, 3]]}),
]


@pytest.mark.parametrize(("network", "graph"), GRAPHS)
def test_a_graph_has_all_its_nodes_and_links(network: Network, graph: dict[str, object]) -> None:
    at = topology.place(network.ids, graph)
    values = {i: float(n) for n, i in enumerate(network.ids)}
    figure = topology.draw(network, at, values, RMSE)
    [nodes] = found(figure, "nodes")
    assert np.allclose(nodes.get_offsets(), at)
    assert len({tuple(face) for face in nodes.get_facecolors()}) == len(network.ids)
    assert len({tuple(np.round(p, 9)) for p in at.tolist()}) == len(network.ids)
    arrows = [a for a in figure.findobj(Text) if getattr(a, "arrow_patch", None) is not None]
    [links] = found(figure, "links")
    assert len(links.get_segments()) + len(arrows) == len(network.links())
    assert {str(i) for i in network.ids} <= texts(figure)
    assert RMSE.label in texts(figure)


def test_places_are_the_generators_own() -> None:
    graph = {"generator": "random_geometric", "radius": 0.4, "seed": 3}
    network = Network.random_geometric(range(1, 21), 0.4, 3)
    at = topology.place(network.ids, graph)
    near = {(a, b) for a, b in network.links()}
    rank = {i: n for n, i in enumerate(network.ids)}
    for a in network.ids:
        for b in network.ids:
            if a < b:  # type: ignore[operator]
                assert ((a, b) in near) == (math.dist(at[rank[a]], at[rank[b]]) <= 0.4)


def test_a_node_without_a_value_is_grey() -> None:
    network = Network.ring((1, 2, 3))
    figure = topology.draw_many([("ring", network, topology.place(network.ids, {}), {1: 1.0, 2: math.nan})], RMSE)
    faces = found(figure, "nodes")[0].get_facecolors()
    assert np.allclose(faces[1], faces[2])
    assert not np.allclose(faces[0], faces[1])


# --- space and time -------------------------------------------------------------------------------------------------


PERIOD = 50_000_000
DEADLINES = {"measurement": 20_000_000, "intermediate": 45_000_000}


def diagram(flights: list[Flight], steps: int = 2, marks: tuple[Mark, ...] = ()) -> Diagram:
    rounds = [
        Round(k, k * PERIOD, {stage: k * PERIOD + wait for stage, wait in DEADLINES.items()})
        for k in range(1, steps + 1)
    ]
    return Diagram((1, 2, "x"), ("measurement", "intermediate"), rounds, flights, marks, "a run")


def test_an_arrow_leads_from_its_sending_to_its_arrival() -> None:
    sent = PERIOD + 1_000_000
    flights = [
        Flight(1, 2, "measurement", 1, sent, sent + 5_000_000, Fate.USED),
        Flight(2, 1, "measurement", 1, sent, sent + 30_000_000, Fate.LATE),
        Flight(1, "x", "measurement", 1, sent, sent + 25_000_000, Fate.REVISED),
        Flight(2, "x", "intermediate", 1, sent, None, Fate.LOST),
    ]
    figure = space_time.draw(diagram(flights, marks=(Mark(2, 2 * PERIOD, "restarted, step 2"),)))
    [used] = found(figure, "used-measurement")
    assert (used.X[0], used.Y[0], used.U[0], used.V[0]) == pytest.approx((1.0, 0.0, 5.0, -1.0))
    [late] = found(figure, "late")
    assert np.allclose(late.get_segments(), [[(1.0, -1.0), (31.0, 0.0)]])
    assert late.get_linestyle()[0][1] is not None  # dashed
    [revised] = found(figure, "revised")
    assert np.allclose(revised.get_segments()[0][1], (26.0, -2.0))
    [(_, end)] = found(figure, "lost")[0].get_segments()
    assert -2.0 < end[1] < -1.0  # it does not reach its receiver
    assert len(found(figure, "lost-end")) == 1
    for stage, wait in DEADLINES.items():
        [ticks] = found(figure, f"deadline-{stage}")
        expected = {(n * 50 + wait / 1e6, -float(row)) for n in range(2) for row in range(3)}
        assert {tuple(np.round(at, 6)) for at in ticks.get_offsets()} == expected
    words = {"node 1", "node 2", "x", "k = 1", "k = 2", "restarted, step 2", "time since step 1 was due [ms]", "a run"}
    assert words | {"late, not used", "late, taken in afterwards", "lost", "deadline of measurement"} <= texts(figure)


def test_more_messages_than_can_be_told_apart_are_cut_off_at_a_round() -> None:
    def flights() -> Iterator[Flight]:
        for step in range(1, 9):
            for n in range(1000):
                yield Flight(1, 2, "measurement", step, step * PERIOD + n, step * PERIOD + n + 1000, Fate.USED)

    figure = space_time.draw(diagram(list(flights()), steps=8))
    [used] = found(figure, "used-measurement")
    assert len(used.X) == 6000
    assert any("only steps 1 to 6" in text for text in texts(figure))


def test_a_diagram_of_nothing() -> None:
    assert "there are no messages to show" in texts(space_time.draw(Diagram((1, 2), ("measurement",), [], [])))
    assert found(space_time.draw(diagram([])), "round")


# --- files ----------------------------------------------------------------------------------------------------------


def test_files_are_the_same_every_time(tmp_path: Path) -> None:
    def saved(directory: str) -> list[bytes]:
        figure = curves.draw([curves.Panel("", [line("drop", 1.0)])], frame())
        return [path.read_bytes() for path in picture(figure).save(tmp_path / directory)]

    svg, png = saved("a")
    assert saved("b") == [svg, png]
    assert png.startswith(b"\x89PNG")
    ElementTree.fromstring(svg)
    assert b"link delay [ms]" in svg  # text stays text


def test_pictures_on_one_page_have_ids_of_their_own() -> None:
    figure = curves.draw([curves.Panel("", [line("a <b> & $x$", 1.0)])], frame())
    first, second = picture(figure, "first").inline(), picture(figure, "second").inline()
    assert "&lt;b&gt; &amp; $x$" in first
    for name, text in (("first", first), ("second", second)):
        ids = re.findall(r'\bid="([^"]+)"', text)
        used = re.findall(r'(?:href="#|url\(#)([^")]+)', text)
        assert ids
        assert used
        assert all(i.startswith(f"{name}.") for i in ids)
        assert set(used) <= set(ids)
        ElementTree.fromstring(text)
        assert not re.search(r'(?:src|href)="(?!#)', text)


# --- words and colours ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "values", "label"),
    [
        ("links.delay", [0.0, 0.02], "link delay [ms]"),
        ("links.delay", [0.0, 2.0], "link delay [s]"),
        ("links.delay", [0.0, 2e-4], "link delay [µs]"),
        ("links.loss", [0.0, 0.2], "loss probability of a message [1]"),
        ("timing.deadlines.measurement", [0.3], "deadline of stage measurement [periods]"),
        ("timing.rate_hz", [20.0], "rate [Hz]"),
        ("timing.timeout_s", [20.0], "timeout [s]"),
        ("sensors[2].R", [1.0], "sensors[2].R"),
    ],
)
def test_axes_have_names_and_units(path: str, values: list[float], label: str) -> None:
    assert axis(path, values).label == label


def test_a_scale_belongs_to_its_unit() -> None:
    assert (in_seconds("t", 0.02).unit, in_seconds("t", 0.02).scale) == ("ms", 1e3)
    assert metric("latency_p50", [0.003]).label == "one-way latency, median [ms]"
    assert metric("something_new_us").label == "something new [µs]"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1"), (0.12345, "0.123"), (12.345, "12.3"), (1234.5, "1234"), (1e-5, "1.00e-05"),
     (-0.5, "-0.5"), (1e6, "1.00e+06"), (math.nan, "–"), (100.0, "100")],
)  # fmt: skip
def test_numbers_are_short(value: float, text: str) -> None:
    assert shown(value) == text


def test_colours_can_be_told_apart_without_seeing_colour() -> None:
    """As grey, neighbours in an ordered scale differ evenly; named colours are never more than there are markers."""
    rgb = np.array([[int(c[n : n + 2], 16) / 255 for n in (1, 3, 5)] for c in colours(6, ordered=True)])
    grey = rgb @ [0.299, 0.587, 0.114]
    assert (np.diff(grey) > 0.05).all()
    assert colours(len(COLOURS)) == list(COLOURS)
