"""How regularly keys are published: as a table, and as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from zfusion import keys
from zfusion.drivers.rhythm import Rhythm
from zfusion.report.messages_shown import printable

PREFIXES = "kMGT"


def rhythms_told(rhythms: Mapping[str, Rhythm], dropped: int) -> dict[str, Any]:
    """keys {key: `Rhythm.told`}, and dropped: what came and was not looked at, here."""
    return {"keys": {key: rhythm.told() for key, rhythm in sorted(rhythms.items())}, "dropped": dropped}


def rhythm_table(rhythms: Mapping[str, Rhythm], dropped: int, width: int) -> Group:
    """The same for people; intervals in ms."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    table.add_column("key", no_wrap=True, overflow="ellipsis")
    narrow = width < 100
    for name in ("n", "rate/s", "mean", "min", "max", "std ms", "B/s", "lost", *(() if narrow else ("broken",))):
        table.add_column(name, justify="right", no_wrap=True)
    for key, rhythm in sorted(rhythms.items()):
        told = rhythm.told()
        lost = Text(str(told["lost"]), style="yellow") if told["lost"] else Text("0")
        cells = [
            str(told["messages"]),
            _number(told["rate_hz"]),
            *(_number(told[name], 1e3) for name in ("mean_s", "min_s", "max_s", "std_s")),
            _bytes(told["bytes_per_s"]),
        ]
        broken = [] if narrow else [str(told["unreadable"])]
        table.add_row(_short(key), *cells, lost, *broken)
    lines: list[Table | Text] = [table]
    if not rhythms:
        lines.append(Text("nothing yet"))
    if dropped:
        lines.append(Text(f"{dropped} messages dropped here: they come faster than they are counted", style="yellow"))
    return Group(*lines)


def _short(key: str) -> str:
    """Without what all keys of a run begin with."""
    first, *more = key.split("/", 2)
    return printable(more[1] if first == keys.ROOT and len(more) == 2 else key)


def _number(value: float | None, unit: float = 1.0) -> str:
    return "" if value is None else f"{value * unit:.4g}"


def _bytes(value: float | None) -> str:
    if value is None:
        return ""
    prefix = ""
    for larger in PREFIXES:
        if value < 1000:
            break
        value, prefix = value / 1000, larger
    return f"{value:.3g}{prefix}"
