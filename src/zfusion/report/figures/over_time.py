"""Errors over time, beside what was predicted of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from zfusion.model.types import Array
from zfusion.report.figures import style
from zfusion.report.figures.quantities import spans_decades

MOST_POINTS = 800
"""Steps that a line shows; of more, means over as many equal blocks: more cannot be seen, and makes large files."""


@dataclass(frozen=True)
class Course:
    """A quantity at every step, (n,), with an interval where `low` and `high` are finite, and what was predicted."""

    title: str
    steps: Array
    mean: Array
    low: Array
    high: Array
    predicted: Array


@dataclass(frozen=True)
class Envelope:
    """One component of one node's error at every step, and the standard deviation that the node told with it, (n,)."""

    title: str
    steps: Array
    error: Array
    sd: Array


def draw(courses: Sequence[Course], y: str, measured: str, predicted: str) -> Figure:
    """One panel a course: the line, its band, and the predicted curve; `y` labels the axis."""
    with style.drawing():
        courses = [course for course in courses if np.isfinite(course.mean).any()]
        if not courses:
            return style.nothing("there are no errors to show: the truth is not known")
        figure, axes = style.panels(len(courses))
        for ax, course in zip(axes, courses, strict=True):
            style.title(ax, course.title, len(courses))
            steps, mean, low, high, theory = _blocks(
                course.steps, course.mean, course.low, course.high, course.predicted
            )
            if np.isfinite(low).any():
                ax.fill_between(steps, low, high, color=style.COLOURS[0], alpha=0.22, linewidth=0, gid="interval")
            ax.plot(steps, mean, color=style.COLOURS[0], linewidth=1.1, label=measured, gid="measured")
            if np.isfinite(theory).any():
                ax.plot(
                    steps, theory, color=style.COLOURS[1], linestyle="--", linewidth=1.4, label=predicted,
                    gid="predicted",
                )  # fmt: skip
            _tell_blocks(ax, course.steps, steps)
        predictions = np.concatenate([c.predicted for c in courses])
        if spans_decades(predictions.tolist()):  # single errors come close to zero by chance
            axes[0].set_yscale("log")
            style.tick_logarithmically(axes[0].yaxis)
        else:
            axes[0].set_ylim(bottom=0)
        axes[0].xaxis.set_major_locator(MaxNLocator(8 if len(axes) == 1 else 5, integer=True))
        style.label_axes(figure, axes, "step k", y)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        return figure


def draw_envelopes(envelopes: Sequence[Envelope], y: str) -> Figure:
    """One panel each, one below the other: the error within plus and minus two standard deviations."""
    with style.drawing():
        if not envelopes:
            return style.nothing("there are no errors to show: the truth is not known")
        figure = Figure(figsize=(style.WIDTH_IN, 1.0 + 1.9 * len(envelopes)), layout="constrained")
        axes: list[Axes] = list(figure.subplots(len(envelopes), 1, sharex=True, squeeze=False).ravel())
        for ax, envelope in zip(axes, envelopes, strict=True):
            steps, error, sd = _thin(envelope.steps, envelope.error, envelope.sd)
            ax.set_title(envelope.title, loc="left")
            ax.fill_between(
                steps, -2 * sd, 2 * sd, color=style.COLOURS[1], alpha=0.18, linewidth=0, gid="interval",
                label="±2 predicted standard deviations",
            )  # fmt: skip
            ax.axhline(0, color=style.GREY, linewidth=0.6)
            ax.plot(steps, error, color=style.COLOURS[0], linewidth=1.0, gid="measured", label="error x̂ − x")
            ax.set_ylabel(y)
        axes[-1].set_xlabel("step k")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=2)
        return figure


def _blocks(steps: Array, *series: Array) -> tuple[Array, ...]:
    """Means over equal blocks of steps, where there are more than can be seen."""
    size = -(-len(steps) // MOST_POINTS)
    if size <= 1:
        return (np.asarray(steps, dtype=float), *series)
    starts = np.arange(0, len(steps), size)
    counts = np.diff(np.append(starts, len(steps)))
    return tuple(np.add.reduceat(np.asarray(s, dtype=float), starts) / counts for s in (steps, *series))


def _thin(*series: Array) -> tuple[Array, ...]:
    """Every so many-th entry: an error that changes its sign is not to be averaged away."""
    stride = -(-len(series[0]) // MOST_POINTS)
    return tuple(s[::stride] for s in series)


def _tell_blocks(ax: Axes, steps: Array, drawn: Array) -> None:
    if len(drawn) < len(steps):
        style.note(ax, f"means over {-(-len(steps) // MOST_POINTS)} steps")
