"""Predicted error covariances, for programs and for people."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from zfusion.methods.prediction import Prediction

SHOWN_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Steps that the table shows, and the last one."""

SHOWN_NODES = 32


def as_json_object(prediction: Prediction) -> dict[str, Any]:
    """nodes, steps, error_covariance {local, intermediate, distributed, centralized}.

    The first three are [step][node][nx][nx], the last [step][nx][nx]; step 0 is included.
    """
    return {
        "nodes": list(prediction.ids),
        "steps": len(prediction.centralized) - 1,
        "error_covariance": {
            "local": prediction.local.tolist(),
            "intermediate": prediction.intermediate.tolist(),
            "distributed": prediction.distributed.tolist(),
            "centralized": prediction.centralized.tolist(),
        },
    }


def show_prediction(console: Console, name: str, prediction: Prediction) -> None:
    """Print mean squared errors, trace P: their mean over the nodes by step, and by node at the last step."""
    steps = len(prediction.centralized) - 1
    console.print(f"[bold]{name}[/]   predicted mean squared error, trace P")
    by_step = Table(title="mean over the nodes", title_justify="left")
    for heading in ("step", "local", "intermediate", "distributed", "centralized"):
        by_step.add_column(heading, justify="right")
    traces = {
        kind: np.einsum("...aa->...", getattr(prediction, kind))
        for kind in ("local", "intermediate", "distributed", "centralized")
    }
    for step in sorted({s for s in (0, *SHOWN_STEPS) if s < steps} | {steps}):
        cells = [f"{np.mean(traces[kind][step]):.6g}" for kind in traces]
        by_step.add_row(str(step), *cells)
    console.print(by_step)
    by_node = Table(title=f"at step {steps}", title_justify="left")
    for heading in ("node", "local", "intermediate", "distributed"):
        by_node.add_column(heading, justify="left" if heading == "node" else "right")
    for position, node in enumerate(prediction.ids[:SHOWN_NODES]):
        cells = [f"{traces[kind][steps][position]:.6g}" for kind in ("local", "intermediate", "distributed")]
        by_node.add_row(str(node), *cells)
    console.print(by_node)
    if len(prediction.ids) > SHOWN_NODES:
        console.print(f"... and {len(prediction.ids) - SHOWN_NODES} more nodes (--json has all)")
