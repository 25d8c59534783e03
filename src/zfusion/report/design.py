"""Predicted error covariances, for programs and for people."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from math import isnan
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from zfusion.methods.prediction import Prediction
from zfusion.model.types import Array
from zfusion.studies.sensitivity import CONFIDENCE, Mean, UnderLinks

SHOWN_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Steps that the table shows, and the last one."""

SHOWN_NODES = 32

KINDS = ("local", "intermediate", "distributed", "centralized")


def as_json_object(prediction: Prediction, under: UnderLinks | None = None) -> dict[str, Any]:
    """nodes, steps, error_covariance {local, intermediate, distributed, centralized}; under_links where given.

    The first three are [step][node][nx][nx], the last [step][nx][nx]; step 0 is included.

    under_links has samples, exact, confidence; mean {intermediate, distributed}, covariances as above; low and high,
    likewise, [step][node]: the interval of the mean of their traces; exact_steps, likewise, [node]: up to which step
    nothing is estimated. None where a node has no estimate in any realisation.
    """
    told: dict[str, Any] = {
        "nodes": list(prediction.ids),
        "steps": len(prediction.centralized) - 1,
        "error_covariance": {
            "local": prediction.local.tolist(),
            "intermediate": prediction.intermediate.tolist(),
            "distributed": prediction.distributed.tolist(),
            "centralized": prediction.centralized.tolist(),
        },
    }
    return told if under is None else told | {"under_links": _told_under_links(under)}


def _told_under_links(under: UnderLinks) -> dict[str, Any]:
    stages = {"intermediate": under.intermediate, "distributed": under.distributed}
    return {
        "samples": under.samples,
        "exact": under.exact,
        "confidence": CONFIDENCE,
        "mean": {name: _finite(mean.covariance) for name, mean in stages.items()},
        "low": {name: _finite(mean.low) for name, mean in stages.items()},
        "high": {name: _finite(mean.high) for name, mean in stages.items()},
        "exact_steps": {name: list(mean.exact_steps) for name, mean in stages.items()},
    }


def _finite(values: Array) -> list[Any]:
    """As lists, None for what is not there."""
    listed: list[Any] = values.tolist()
    return _without_nan(listed) if np.isnan(values).any() else listed


def _without_nan(values: Any) -> Any:
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return None if isnan(values) else values


def show_prediction(console: Console, name: str, prediction: Prediction, under: UnderLinks | None = None) -> None:
    """Print mean squared errors, trace P: their mean over the nodes by step, and by node at the last step."""
    steps = len(prediction.centralized) - 1
    ideal = {kind: np.einsum("...aa->...", getattr(prediction, kind)) for kind in KINDS}
    console.print(f"[bold]{name}[/]   predicted mean squared error, trace P")
    shown = sorted({s for s in (0, *SHOWN_STEPS) if s < steps} | {steps})
    nodes = list(enumerate(prediction.ids[:SHOWN_NODES]))
    if under is None:
        by_step, by_node = _table("mean over the nodes", "step", KINDS), _table(f"at step {steps}", "node", KINDS[:-1])
        for step in shown:
            by_step.add_row(str(step), *(f"{np.mean(ideal[kind][step]):.6g}" for kind in KINDS))
        for position, node in nodes:
            by_node.add_row(str(node), *(f"{ideal[kind][steps][position]:.6g}" for kind in KINDS[:-1]))
    else:
        stages = {"intermediate": under.intermediate, "distributed": under.distributed}
        headings = [heading for stage in stages for heading in (stage, "under links")]
        by_step, by_node = _table("mean over the nodes", "step", headings), _table(f"at step {steps}", "node", headings)
        for step in shown:
            pairs = [(f"{np.mean(ideal[kind][step]):.6g}", _over_nodes(mean, step)) for kind, mean in stages.items()]
            by_step.add_row(str(step), *chain(*pairs))
        for position, node in nodes:
            pairs = [
                (f"{ideal[kind][steps][position]:.6g}", _with_margin(mean, steps, position))
                for kind, mean in stages.items()
            ]
            by_node.add_row(str(node), *chain(*pairs))
    console.print(by_step)
    console.print(by_node)
    if len(prediction.ids) > SHOWN_NODES:
        console.print(f"... and {len(prediction.ids) - SHOWN_NODES} more nodes (--json has all)")
    if under is not None:
        bounds = {kind: float(np.mean(ideal[kind][steps])) for kind in ("local", "centralized")}
        console.print(f"without a network {bounds['local']:.6g}, with all measurements {bounds['centralized']:.6g}")
        console.print(_how_known(under), soft_wrap=True)


def _table(title: str, first: str, headings: Iterable[str]) -> Table:
    table = Table(title=title, title_justify="left")
    for heading in (first, *headings):
        table.add_column(heading, justify="left" if heading == "node" else "right")
    return table


def _over_nodes(mean: Mean, step: int) -> str:
    there = ~np.isnan(mean.low[step])
    return f"{np.mean((mean.low + mean.high)[step][there] / 2):.6g}" if there.any() else "-"


def _with_margin(mean: Mean, step: int, position: int) -> str:
    low, high = mean.low[step, position], mean.high[step, position]
    if np.isnan(low):
        return "-"
    middle, margin = (low + high) / 2, (high - low) / 2
    return f"{middle:.6g} ± {margin:.1g}" if margin else f"{middle:.6g}"


def _how_known(under: UnderLinks) -> str:
    if under.exact:
        return "under these links: exact, as nothing is left to chance"
    steps = min(under.distributed.exact_steps)
    exact = f"; exact up to step {steps}, over all that can happen" if steps else ""
    of = f"{CONFIDENCE:.0%} confidence interval of the mean"
    return f"under these links: means over {under.samples} realisations, ± {of}{exact}"
