"""What an observer has seen of a swarm: as a table for people, as plain data for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from rich import box
from rich.cells import cell_len
from rich.console import Group
from rich.table import Table
from rich.text import Text

from zfusion.drivers.observer import Observer, SeenNode, SeenRecorder
from zfusion.report.messages_shown import printable
from zfusion.report.table import shown_estimate
from zfusion.status import Counts, Phase

WIDE = 110
"""Columns of a terminal from which on a table tells more."""

ESTIMATE = "estimate ± sd"

SPARE = ("machine", "clock", "CPU s", "skipped", "missed", "refused", "fallb.", "late", ESTIMATE, "lost", "rate/s")
"""Columns that a narrow terminal does without, the first of them first."""

LEAST_ESTIMATE = 10
"""Characters of an estimate from which on it is worth a column."""

MOST_MACHINE = 16
"""Characters of a machine's name that are shown."""

GAP = 2
"""Columns of the terminal between two of the table's; half of it on either edge."""

SECONDS_US = 999_500
"""From which offset on clocks are apart by seconds: how sure that is does not matter then."""

STYLES = {"running": "green", "recording": "green", "joining": "yellow", "silent": "yellow", "done": "blue"}
ABSENT = {"missing": "red", "gone": "red", "left": "dim"}

KINDS = ("received", "late", "missed", "lost", "refused")


def seen_swarm(observer: Observer) -> dict[str, Any]:
    """All of it as plain data: run, at, nodes {id: state, phase, step, rate_hz, ...}, recorder, missing, notes."""
    return {
        "run": observer.run,
        "at": datetime.now(UTC).isoformat(),
        "nodes": {name: _node(node) for name, node in observer.nodes.items()},
        "recorder": None if observer.recorder is None else _recorder(observer.recorder),
        "missing": observer.missing,
        "notes": notes_on(observer),
    }


def swarm_table(observer: Observer, width: int, height: int | None = None) -> Group:
    """The same as a table that fits into the columns, and into the lines where they are limited."""
    wide = width >= WIDE
    shown = list(observer.nodes.items())
    if height is not None and len(shown) > (room := max(4, height - 8)):
        ended = {"running", "left"}
        shown = sorted(shown, key=lambda item: item[1].state in ended)[:room]  # trouble first
    table = _table([_row(name, node, wide) for name, node in shown], width, wide)
    table.title = Text(f"{observer.run}", style="bold")
    lines: list[Table | Text] = [table]
    if len(shown) < len(observer.nodes):
        lines.append(Text(f"... and {len(observer.nodes) - len(shown)} more nodes"))
    if observer.recorder is not None:
        lines.append(_recorder_line(observer.recorder))
    lines += [Text(f"missing: {', '.join(map(printable, observer.missing))}", style="red")] if observer.missing else []
    lines += [Text(printable(note), style="yellow") for note in notes_on(observer)]
    return Group(*lines)


def _table(rows: Sequence[Sequence[Text | str]], width: int, wide: bool) -> Table:
    """As much of the rows as fits; who a node is, its state and its step in any case."""
    numbers = ["step", "rate/s", "fallb.", "lost", "late", "refused"]
    numbers += ["missed", "skipped", "CPU s", "clock"] if wide else []
    names = ["node", "state", *numbers, *(["machine"] if wide else []), ESTIMATE]
    cells = [dict(zip(names, row, strict=False)) for row in rows]  # who has told nothing has a name and a state only
    widths = {name: max(cell_len(name), *(cell_len(str(row.get(name, ""))) for row in cells), 0) for name in names}
    if wide:
        widths["machine"] = min(MOST_MACHINE, widths["machine"])
    whole, widths[ESTIMATE] = widths[ESTIMATE], LEAST_ESTIMATE
    for name in SPARE:
        if sum(widths.values()) + GAP * len(widths) > width:
            widths.pop(name, None)
    if ESTIMATE in widths:  # what is left is its
        widths[ESTIMATE] = min(whole, LEAST_ESTIMATE + width - sum(widths.values()) - GAP * len(widths))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True, title_justify="left")
    for name, most in widths.items():
        justify: Literal["left", "right"] = "right" if name in numbers else "left"
        table.add_column(name, justify=justify, no_wrap=True, overflow="ellipsis", max_width=most)
    for row in cells:
        table.add_row(*(row.get(name, "") for name in widths))
    return table


def notes_on(observer: Observer) -> list[str]:
    """What is wrong with what was seen, in words."""
    notes = [f"node {name}: {node.problem}" for name, node in observer.nodes.items() if node.problem]
    told = {name: node.status for name, node in observer.nodes.items() if node.status is not None and node.present}
    versions = {name: status.zfusion for name, status in told.items()}
    if len(set(versions.values())) > 1:
        notes.append("not of one version: " + ", ".join(f"node {name} {v}" for name, v in versions.items()))
    prints = {name: status.fingerprint[:12] for name, status in told.items()}
    if len(set(prints.values())) > 1:
        notes.append("not of one scenario: " + ", ".join(f"node {name} {p}" for name, p in prints.items()))
    if observer.strangers:
        notes.append(f"{observer.strangers} tokens or answers that are none of zfusion's")
    return notes


def _node(node: SeenNode) -> dict[str, Any]:
    rate = node.rate_hz
    told: dict[str, Any] = {"state": node.state, "rate_hz": None if rate is None else round(rate, 3)}
    status = node.status
    if status is None:
        return told
    told |= {
        "phase": str(status.phase),
        "step": status.step,
        "born": status.born,
        "completed": status.completed,
        "fallbacks": status.fallbacks,
        "clock_jumps": status.clock_jumps,
        "estimate": dict(status.estimate),
        "zfusion": status.zfusion,
        "fingerprint": status.fingerprint,
    }
    if status.counts is not None:
        told |= {kind: status.counts.total(kind) for kind in KINDS} | asdict(status.counts)
    return told


def _recorder(recorder: SeenRecorder) -> dict[str, Any]:
    return {"state": recorder.state, **({} if recorder.status is None else asdict(recorder.status))}


def _row(name: str, node: SeenNode, wide: bool) -> list[Text | str]:
    status, rate = node.status, node.rate_hz
    row: list[Text | str] = [printable(name), _state(node.state)]
    if status is None:
        return row
    counts = status.counts
    row += [str(status.step), "" if rate is None else f"{rate:.4g}", str(status.fallbacks)]
    kinds = ("lost", "late", "refused", "missed") if wide else ("lost", "late", "refused")
    row += [_worrying(counts, kind) for kind in kinds]
    if wide:
        row += ["", "", "", ""] if counts is None else _particulars(counts)
    row.append(shown_estimate(status.estimate))
    if not node.present and status.phase is not Phase.DONE:
        return [row[0], row[1], *(Text(str(cell), style="dim") for cell in row[2:])]
    return row


def _particulars(counts: Counts) -> list[Text | str]:
    return [str(counts.skipped), f"{counts.cpu_s:.1f}", _clock(counts.clocks), printable(counts.host)]


def _state(state: str) -> Text:
    return Text(state, style=STYLES.get(state) or ABSENT[state])


def _worrying(counts: Counts | None, kind: str) -> Text | str:
    if counts is None:
        return ""
    total = counts.total(kind) + (sum(counts.overheard.values()) if kind == "refused" else 0)
    return Text(str(total), style="yellow") if total else "0"


def _clock(clocks: Mapping[str, Mapping[str, float]]) -> str:
    """The largest offset to a neighbour's clock, and by how much it may be wrong."""
    if not clocks:
        return "?"
    offset, unsure = max(((c["offset_us"], c["uncertainty_us"]) for c in clocks.values()), key=lambda c: abs(c[0]))
    if abs(offset) >= SECONDS_US:
        return f"{offset / 1e6:+.3f} s"
    return f"{offset / 1000:+.3g} ± {unsure / 1000:.1g} ms" if offset or unsure else "same"


def _recorder_line(recorder: SeenRecorder) -> Text:
    line = Text("recorder: ").append(_state(recorder.state))
    if (status := recorder.status) is not None:
        line.append(f"   {status.messages} messages, {status.lost} lost, {status.foreign} foreign, ")
        line.append(f"{status.waiting} waiting   {printable(Path(status.path).name)}")
    line.no_wrap, line.overflow = True, "ellipsis"
    return line
