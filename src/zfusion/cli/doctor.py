"""The command doctor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from zfusion.cli.common import Json, RunName, ScenarioFile, finish, out

if TYPE_CHECKING:
    from zfusion.doctor.finding import Finding

MARKS = {"ok": "[green]ok[/]", "warning": "[yellow]warning[/]", "error": "[bold red]error[/]"}


def doctor(
    scenario: ScenarioFile,
    hosts: Annotated[Path | None, typer.Option(help="Hosts file (TOML), as for deploy.", show_default=False)] = None,
    host: Annotated[
        str | None, typer.Option(help="Which of the hosts this machine is.", show_default="by its address")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option(help="What deploy wrote: certificates are looked at.", show_default=False)
    ] = None,
    zenoh_config: Annotated[
        Path | None, typer.Option(help="Zenoh configuration to ask running nodes with.", show_default=False)
    ] = None,
    run: RunName = None,
    as_json: Json = False,
) -> None:
    """What would go wrong on this machine: each finding with its reason and its remedy. Changes nothing."""
    from zfusion.doctor.examine import Asked, examine
    from zfusion.doctor.finding import Severity

    findings = list(examine(Asked(scenario, hosts, host, folder, zenoh_config, run)))
    counts = {severity: sum(f.severity is severity for f in findings) for severity in Severity}
    result = {
        "errors": counts[Severity.ERROR],
        "warnings": counts[Severity.WARNING],
        "findings": [asdict(finding) for finding in findings],
    }
    finish(result, as_json, lambda: _show(findings))
    if not as_json:
        out.print(f"errors: {result['errors']}, warnings: {result['warnings']}")
    if result["errors"]:
        raise typer.Exit(1)


def _show(findings: Sequence[Finding]) -> None:
    """A list, by topics; reasons and remedies only where something is not well."""
    topic = None
    for finding in findings:
        if finding.topic != topic:
            topic = finding.topic
            out.print(f"[bold]{topic}[/]")
        lines = Table.grid(padding=(0, 1))
        lines.add_column(width=9, justify="right")
        lines.add_column(overflow="fold")
        lines.add_row(MARKS[finding.severity], escape(finding.what))
        for word, text in (("why", finding.why), ("do", finding.remedy)):
            if text:
                lines.add_row(f"[dim]{word}[/]", escape(text))
        out.print(lines)
