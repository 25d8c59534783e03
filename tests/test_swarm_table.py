"""What people are shown of a swarm that is looked at from outside."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from zfusion.drivers.observer import SeenNode
from zfusion.report.swarm_table import swarm_table
from zfusion.status import Counts, Phase, Status

EMPTY: dict[str, Any] = {name: {} for name in ("sent", "edges", "overheard", "incidents", "waits", "queues")}


def shown(clocks: dict[str, dict[str, float]]) -> str:
    """The table of a swarm of one node, on a wide terminal."""
    counts = Counts(host="here", skipped=0, elapsed_s=1.0, cpu_s=0.1, clocks=clocks, **EMPTY)
    status = Status(1, "f" * 64, Phase.RUNNING, 20, 1, None, {}, completed=20, counts=counts)
    node = SeenNode(present=True, seen=True, status=status, answered=True)
    observer = SimpleNamespace(run="r", nodes={"1": node}, recorder=None, missing=[], strangers=0)
    console = Console(width=160)
    with console.capture() as captured:
        console.print(swarm_table(cast(Any, observer), 160))
    return captured.get()


@pytest.mark.parametrize(
    ("offset_us", "uncertainty_us", "expected"),
    [
        (0.0, 0.0, "same"),
        (-120.4, 50.0, "-0.12 ± 0.05 ms"),
        (999_400.0, 50.0, "+999 ± 0.05 ms"),
        (999_600.0, 50.0, "+1.000 s"),
        (-3_600_000_000.0, 50.0, "-3600.000 s"),
    ],
)
def test_clocks_are_told_in_words_that_say_something(offset_us: float, uncertainty_us: float, expected: str) -> None:
    far = {"offset_us": offset_us, "uncertainty_us": uncertainty_us}
    table = shown({"2": {"offset_us": 1.0, "uncertainty_us": 1.0}, "3": far} if offset_us else {"3": far})
    assert re.search(rf" {re.escape(expected)} ", table), table
