"""What is on a recording, for people."""

from __future__ import annotations

from datetime import UTC, datetime

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.recording.info import RecordingInfo


def show_info(console: Console, told: RecordingInfo) -> None:
    """Print what `zfusion info` says."""
    start = datetime.fromtimestamp(told.start_ns / 1e9, UTC)
    console.print(f"[bold]{told.run}[/]   {told.method}   seed {told.seed}")
    console.print(f"{told.messages} messages, {told.duration_ns / 1e9:.2f} s from {start:%Y-%m-%d %H:%M:%S} UTC")
    console.print(
        f"{told.size_bytes} bytes, {'complete' if told.complete else 'broken off'}; {told.lost} messages lost"
    )
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
