"""A space-time diagram: who sent what to whom and when it came, of a few rounds of one run.

Nodes are life lines, time goes to the right, and every message is an arrow from its sending to its arrival
(L. Lamport, Time, clocks, and the ordering of events in a distributed system, Comm. ACM 21 (1978) 558-565).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zfusion.model.types import NodeId
from zfusion.report.figures import style
from zfusion.report.figures.quantities import Quantity, in_seconds

MOST_ARROWS = 6000
"""Messages that a diagram shows at most: more are a black square."""

STUB = 0.45
"""How far towards the receiver the line of a message goes of which nobody knows when it came."""


class Fate(StrEnum):
    """What became of a message at one receiver."""

    USED = "used"
    LATE = "late"
    """It came, and was not used at its step."""
    REVISED = "revised"
    """It came late, and was taken in afterwards."""
    LOST = "lost"
    """It never came."""
    UNUSED = "not used"
    """Late or lost: which of them is not on the recording."""


@dataclass(frozen=True, slots=True)
class Flight:
    """One message on one edge; times in nanoseconds."""

    sender: NodeId
    receiver: NodeId
    stage: str
    step: int
    sent_ns: int
    arrived_ns: int | None
    """None where it never came, or nobody knows when."""
    fate: Fate


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened to a node: a restart, the beginning of a fault."""

    node: NodeId
    t_ns: int
    text: str


@dataclass(frozen=True, slots=True)
class Round:
    """When a step was due, and when its stages' deadlines pass; no deadlines in a free run."""

    step: int
    due_ns: int
    deadlines_ns: Mapping[str, int]


@dataclass(frozen=True)
class Diagram:
    """All that is drawn."""

    nodes: Sequence[NodeId]
    stages: Sequence[str]
    rounds: Sequence[Round]
    flights: Sequence[Flight]
    marks: Sequence[Mark] = ()
    title: str = ""
    lives: Mapping[NodeId, Sequence[tuple[int, int]]] = field(default_factory=dict)
    """From when to when each node was there, where that is known."""


class _Canvas:
    """The axes, with what turns times and nodes into places on them."""

    def __init__(self, ax: Axes, diagram: Diagram) -> None:
        self.ax = ax
        times = [f.sent_ns for f in diagram.flights]
        times += [f.arrived_ns for f in diagram.flights if f.arrived_ns is not None]
        times += [r.due_ns for r in diagram.rounds] + [d for r in diagram.rounds for d in r.deadlines_ns.values()]
        self.origin_ns = diagram.rounds[0].due_ns if diagram.rounds else min(times)
        self.span_ns = max(max(times) - min(times), 1)
        self.begin_ns, self.end_ns = min(times), max(times)
        self.time: Quantity = in_seconds("time", self.span_ns / 1e9)
        self.row = {node: -float(n) for n, node in enumerate(diagram.nodes)}
        self.colours = dict(zip(diagram.stages, style.colours(len(diagram.stages)), strict=True))

    def x(self, t_ns: int) -> float:
        return (t_ns - self.origin_ns) / 1e9 * self.time.scale

    def ends(self, flight: Flight) -> tuple[tuple[float, float], tuple[float, float]]:
        """Both ends of an arrow; of a message that never came, where its line breaks off."""
        start = (self.x(flight.sent_ns), self.row[flight.sender])
        if flight.arrived_ns is not None:
            return start, (self.x(flight.arrived_ns), self.row[flight.receiver])
        reach = 0.012 * self.span_ns / 1e9 * self.time.scale
        return start, (start[0] + reach, start[1] + STUB * (self.row[flight.receiver] - start[1]))


def draw(diagram: Diagram) -> Figure:
    """The diagram. More messages than can be told apart are cut off at a round, which the panel says."""
    with style.drawing():
        if not diagram.nodes or not (diagram.flights or diagram.rounds):
            return style.nothing("there are no messages to show")
        diagram, left_out = _bounded(diagram)
        height = min(1.9 + 0.48 * len(diagram.nodes), 13.0)
        figure = Figure(figsize=(10.0, height), layout="constrained")
        ax = figure.subplots()
        canvas = _Canvas(ax, diagram)
        _draw_rounds(canvas, diagram)
        for node, row in canvas.row.items():
            _draw_life(canvas, row, diagram.lives.get(node), f"life-{node}")
        for stage in diagram.stages:
            _draw_arrows(canvas, [f for f in diagram.flights if f.stage == stage and _came_in_time(f)], stage)
        _draw_trouble(canvas, diagram.flights)
        _draw_marks(canvas, diagram.marks)
        ax.set_yticks([*canvas.row.values()], [f"node {n}" if isinstance(n, int) else n for n in canvas.row])
        ax.set_ylim(-len(diagram.nodes) + 0.35, 0.75)
        margin = 0.015 * canvas.span_ns
        ax.set_xlim(canvas.x(round(canvas.begin_ns - margin)), canvas.x(round(canvas.end_ns + margin)))
        ax.grid(visible=False)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0)
        first = f" since step {diagram.rounds[0].step} was due" if diagram.rounds else ""
        ax.set_xlabel(f"time{first} [{canvas.time.unit}]")
        ax.set_title(diagram.title + left_out, loc="left", pad=16)
        figure.legend(handles=_legend(canvas, diagram), loc="outside lower center", ncols=6)
        return figure


def _came_in_time(flight: Flight) -> bool:
    return flight.fate is Fate.USED


def _bounded(diagram: Diagram) -> tuple[Diagram, str]:
    """As many whole rounds as can be told apart, at least one."""
    if len(diagram.flights) <= MOST_ARROWS:
        return diagram, ""
    by_step: dict[int, int] = {}
    for flight in diagram.flights:
        by_step[flight.step] = by_step.get(flight.step, 0) + 1
    steps = sorted(by_step)
    totals = np.cumsum([by_step[s] for s in steps])
    kept = set(steps[: max(1, int(np.searchsorted(totals, MOST_ARROWS, side="right")))])
    until = max(f.sent_ns for f in diagram.flights if f.step in kept)
    cut = replace(
        diagram,
        rounds=[r for r in diagram.rounds if r.step in kept],
        flights=[f for f in diagram.flights if f.step in kept],
        marks=[m for m in diagram.marks if m.t_ns <= until],
    )
    return cut, f" (only steps {min(kept)} to {max(kept)}: more messages could not be told apart)"


def _draw_rounds(canvas: _Canvas, diagram: Diagram) -> None:
    """A line where each step is due, with its number above; on every life line a tick at every deadline."""
    sparse = max(1, len(diagram.rounds) // 16)
    for number, this in enumerate(diagram.rounds):
        x = canvas.x(this.due_ns)
        canvas.ax.axvline(x, color="#D0D0D0", linewidth=0.8, zorder=0, gid="round")
        if number % sparse == 0:
            canvas.ax.annotate(
                f"k = {this.step}", (x, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 2),
                textcoords="offset points", fontsize=7.5, color=style.GREY, ha="left", va="bottom",
            )  # fmt: skip
    for stage, colour in canvas.colours.items():
        ticks = [canvas.x(r.deadlines_ns[stage]) for r in diagram.rounds if stage in r.deadlines_ns]
        if ticks:
            places, rows = np.meshgrid(ticks, list(canvas.row.values()))
            canvas.ax.scatter(
                places.ravel(), rows.ravel(), marker="|", s=60, color=colour, linewidths=1.6, zorder=2.5,
                gid=f"deadline-{stage}",
            )  # fmt: skip


def _draw_life(canvas: _Canvas, row: float, spans: Sequence[tuple[int, int]] | None, gid: str) -> None:
    """A line while the node was there, dots while it was not."""
    look: dict[str, Any] = {"color": "#AAAAAA", "zorder": 1}
    if spans is None:
        canvas.ax.axhline(row, linewidth=0.8, gid=gid, **look)
        return
    canvas.ax.axhline(row, linewidth=0.7, linestyle=(0, (1, 5)), **look)
    ends = [(canvas.x(first), canvas.x(last)) for first, last in spans]
    lines = LineCollection([[(a, row), (b, row)] for a, b in ends], linewidths=0.9, gid=gid, **look)
    canvas.ax.add_collection(lines, autolim=False)


def _draw_arrows(canvas: _Canvas, flights: Sequence[Flight], stage: str) -> None:
    if not flights:
        return
    ends = np.array([canvas.ends(flight) for flight in flights])
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    crowded = len(flights) > 400
    canvas.ax.quiver(
        *start.T, *way.T, angles="xy", scale_units="xy", scale=1, units="inches", width=(0.5 if crowded else 0.9) / 72,
        headwidth=5, headlength=6.5, headaxislength=6, color=canvas.colours[stage],
        alpha=0.45 if crowded else 0.85, zorder=3, gid=f"used-{stage}",
    )  # fmt: skip


_LOOK: dict[Fate, tuple[str, style.LineStyle, str]] = {
    Fate.LATE: (style.ALARM, "--", ">"),
    Fate.REVISED: (style.COLOURS[7], "--", "o"),
    Fate.LOST: (style.ALARM, ":", "x"),
    Fate.UNUSED: (style.ALARM, ":", "x"),
}
"""Colour, line and end of what did not come in time."""


def _draw_trouble(canvas: _Canvas, flights: Sequence[Flight]) -> None:
    for fate, (colour, line, end) in _LOOK.items():
        concerned = [canvas.ends(flight) for flight in flights if flight.fate is fate]
        if not concerned:
            continue
        canvas.ax.add_collection(
            LineCollection(concerned, colors=colour, linestyles=line, linewidths=1.1, zorder=4, gid=fate.value),
            autolim=False,
        )
        x, y = np.array([finish for _, finish in concerned]).T
        canvas.ax.scatter(
            x, y, marker=end, s=26, color=colour, linewidths=1.4 if end == "x" else 0.5, zorder=5,
            gid=f"{fate.value}-end",
        )  # fmt: skip


def _draw_marks(canvas: _Canvas, marks: Sequence[Mark]) -> None:
    """A diamond on the life line, with its words; those of one place are put on one label."""
    placed: dict[tuple[NodeId, int], list[Mark]] = {}
    slot = max(1, canvas.span_ns // 40)
    shown = [m for m in marks if m.node in canvas.row and canvas.begin_ns <= m.t_ns <= canvas.end_ns]
    for mark in shown:
        placed.setdefault((mark.node, (mark.t_ns - canvas.begin_ns) // slot), []).append(mark)
        canvas.ax.scatter(
            [canvas.x(mark.t_ns)], [canvas.row[mark.node]], marker="D", s=34, color="#000000", zorder=6, gid="mark"
        )
    for (node, where), of_slot in placed.items():
        right = where > 30
        canvas.ax.annotate(
            ", ".join(dict.fromkeys(m.text for m in of_slot)), (canvas.x(of_slot[0].t_ns), canvas.row[node]),
            xytext=(0 if right else 5, 6), textcoords="offset points", ha="right" if right else "left", va="bottom",
            fontsize=7, zorder=7, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
        )  # fmt: skip


def _legend(canvas: _Canvas, diagram: Diagram) -> list[Line2D]:
    deadlines = {stage for r in diagram.rounds for stage in r.deadlines_ns}
    handles = [
        Line2D([], [], color=colour, marker=">", markersize=4, label=stage) for stage, colour in canvas.colours.items()
    ]
    handles += [
        Line2D([], [], color=colour, marker="|", linestyle="none", markersize=8, markeredgewidth=1.6,
               label=f"deadline of {stage}")
        for stage, colour in canvas.colours.items() if stage in deadlines
    ]  # fmt: skip
    fates = {flight.fate for flight in diagram.flights}
    handles += [
        Line2D([], [], color=colour, linestyle=line, marker=end, markersize=5, label=_WORDS[fate])
        for fate, (colour, line, end) in _LOOK.items() if fate in fates
    ]  # fmt: skip
    if diagram.marks:
        handles.append(Line2D([], [], color="black", marker="D", linestyle="none", markersize=5, label="event"))
    return handles


_WORDS = {
    Fate.LATE: "late, not used",
    Fate.REVISED: "late, taken in afterwards",
    Fate.LOST: "lost",
    Fate.UNUSED: "not used (late or lost)",
}
