"""What a node tells whoever watches it over a long run: what it has counted so far, and what waits in it now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zfusion.drivers.account import Account
from zfusion.drivers.metrics import edge_report
from zfusion.node import Node

QUEUES = ("ahead", "held", "posted", "notices")
"""What waits in a node: messages that are too far ahead for it, that emulated links hold, or that wait to be sorted in
there; and news of its neighbours that it has not looked at."""

EDGE_COUNTERS = ("received", "late", "missed", "lost", "refused")
"""Of a node's in-edges, summed over all of them."""

COUNTERS = ("step", "completed", "skipped", *EDGE_COUNTERS, "fallbacks", "strays", "overrun")
"""Of one life of a node."""


def health(node: Node, account: Account, *, queues: Mapping[str, int], overrun: int, now_ns: int) -> dict[str, Any]:
    """All of COUNTERS since the life began, `queues` as they are, and t_ns; as plain data.

    Histograms as `Latencies.told`, since the life began: `round`, from measurement to estimate; `waits` {stage}.
    """
    edges = edge_report(node).values()
    return {
        "t_ns": now_ns,
        "step": node.step,
        "completed": node.completed,
        "skipped": account.skipped,
        **{name: sum(sum(edge[name].values()) for edge in edges) for name in EDGE_COUNTERS},
        "fallbacks": node.fallbacks,
        "strays": node.strays,
        "overrun": overrun,
        **queues,
        "round": account.latencies().told(),
        "waits": account.meter.waits(),
    }
