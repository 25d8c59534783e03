"""What a replay proved or changed, for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.drivers.rerun import Rerun
from zfusion.drivers.verdict import Verdict


def show_verdict(console: Console, verdict: Verdict) -> None:
    """Print what `zfusion replay --verify` found."""
    counts = {
        "identical": verdict.identical,
        "different": verdict.different,
        "unverifiable": verdict.unverifiable,
        "cut off": verdict.cut_off,
    }
    shown = [f"{count} {name}" for name, count in counts.items() if count or name in {"identical", "different"}]
    console.print(f"[bold]{', '.join(shown)}[/]")
    if verdict.tolerance is not None:
        console.print(f"compared within {verdict.tolerance:g}, not bit for bit: made on another kind of machine")
        for name, (recorded, here) in verdict.arithmetic.items():
            console.print(f"  {name}: recorded with {escape(recorded)}, here {escape(here)}")
    if verdict.first is not None:
        console.print(f"first difference: {escape(str(verdict.first))}", soft_wrap=True)
    for missing in verdict.missing:
        console.print(f"missing: {escape(missing)}", soft_wrap=True)
    if verdict.missing_count > len(verdict.missing):
        console.print(f"... and {verdict.missing_count - len(verdict.missing)} more")
    if verdict.note:
        console.print(escape(verdict.note), soft_wrap=True)


def show_rerun(console: Console, done: Rerun, output: Path) -> None:
    """Print how the estimates of a rerun differ from the recorded ones."""
    table = Table()
    for name in ("node", "steps compared", "rms difference", "rmse recorded", "rmse now", "change"):
        table.add_column(name, justify="left" if name == "node" else "right")
    for node, change in done.changes.items():
        rms = "-" if change.rms is None else f"{change.rms:.5g}"
        before, after = change.before, change.after
        table.add_row(str(node), str(change.compared), rms, _rmse(before), _rmse(after), _change(before, after))
    console.print(table)
    console.print(f"recording: {output}", soft_wrap=True)


def _rmse(errors: Mapping[str, float]) -> str:
    return f"{errors['rmse']:.5g}" if "rmse" in errors else "-"


def _change(before: Mapping[str, float], after: Mapping[str, float]) -> str:
    if not before.get("rmse") or "rmse" not in after:
        return "-"
    return f"{after['rmse'] / before['rmse'] - 1:+.1%}"
