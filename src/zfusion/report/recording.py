"""What is on a recording, for people."""

from __future__ import annotations

import json
from datetime import UTC, datetime

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.recording.cut import Cut
from zfusion.recording.info import RecordingInfo
from zfusion.recording.merge import Merged
from zfusion.recording.recover import Recovery

SHOWN = 10
"""Places of damage that are shown one by one."""


def show_info(console: Console, told: RecordingInfo) -> None:
    """Print what `zfusion info` says."""
    start = datetime.fromtimestamp(told.start_ns / 1e9, UTC)
    console.print(f"[bold]{told.run}[/]   {told.method}   seed {told.seed}")
    console.print(f"{told.messages} messages, {told.duration_ns / 1e9:.2f} s from {start:%Y-%m-%d %H:%M:%S} UTC")
    console.print(
        f"{told.size_bytes} bytes, {'complete' if told.complete else 'not complete'}; {told.lost} messages lost"
    )
    if len(told.files) > 1:
        console.print(f"in {len(told.files)} files, the last one {told.files[-1]}", soft_wrap=True)
    if told.derived:
        console.print(f"{told.derived['kind']} from {', '.join(json.loads(told.derived['sources']))}", soft_wrap=True)
    if told.note:
        console.print(f"[yellow]{escape(told.note)}[/]")
    table = Table()
    for name in ("topic", "messages", "lost", "duplicates", "restarts", "unreadable"):
        table.add_column(name, justify="left" if name == "topic" else "right")
    for topic in told.topics:
        gaps = topic.gaps
        numbers = (topic.messages, gaps.lost, gaps.duplicates, gaps.restarts, gaps.unreadable)
        table.add_row(escape(topic.topic.removeprefix(f"zfusion/{told.run}/")), *map(str, numbers))
    console.print(table)
    console.print("made with " + ", ".join(f"{name} {version}" for name, version in told.versions.items()))


def show_recovery(console: Console, told: Recovery) -> None:
    """Print what `zfusion recover` saved, and what it could not."""
    console.print(f"{told.messages} messages in {told.output}", soft_wrap=True)
    console.print(f"{told.kept_bytes} of {told.size_bytes} bytes hold what was written, {told.chunks} chunks")
    if told.written is not None:
        console.print(f"the recorder had written {told.written} messages")
    for loss in told.dropped[:SHOWN]:
        console.print(
            f"[yellow]lost: {loss.length} bytes at byte {loss.position}: {escape(loss.why)}[/]", soft_wrap=True
        )
    if told.dropped_places > SHOWN:
        console.print(f"... and {told.dropped_places - SHOWN} more places, {told.dropped_bytes} bytes in all")
    if told.repeated_chunks:
        console.print(f"{told.repeated_chunks} chunks were there twice")
    for number, count in told.orphaned.items():
        console.print(f"[yellow]lost: {count} messages of channel {number}, which is declared nowhere[/]")
    if told.end_is_missing:
        console.print(
            "its end is missing: what came after the recorder's last flush, and the accounts of what was sent"
        )
    if told.lossy:
        console.print(f"messages missing by the senders' counters: {told.lost_by_counters}")


def show_merged(console: Console, told: Merged) -> None:
    """Print what `zfusion merge` made."""
    console.print(f"{told.messages} messages of {len(told.sources)} files in {told.output}", soft_wrap=True)
    console.print(f"{told.duplicates} were there more than once, {told.still_twice} still are")
    if told.conflicts:
        console.print(f"[yellow]{told.conflicts} differ between recordings, on {', '.join(told.conflicting)}[/]")


def show_cut(console: Console, told: Cut) -> None:
    """Print what `zfusion cut` made."""
    console.print(f"{told.what}: {told.messages} messages in {told.output}", soft_wrap=True)
    if told.without_step:
        console.print(f"{told.without_step} messages say no step, and are left out")
    console.print(told.provable)
