"""The summary of a run: what arrived, what did not, and how far off the estimates were."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from zfusion.drivers.meters import add_up
from zfusion.drivers.metrics import Latencies, NodeReport, RecorderReport
from zfusion.links import Timeline
from zfusion.methods import chosen
from zfusion.methods.prediction import predict
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.report.latency import emulated, of_edge, of_node, show_latencies
from zfusion.report.table import shown_estimate
from zfusion.stages import ESTIMATE

MOST_PREDICTED = 100_000
"""Nodes times steps up to which a summary predicts the errors: a few seconds."""

DESIGNED = {"intermediate": "intermediate", ESTIMATE.name: "distributed"}
"""Stages, and what of a design predicts their errors."""

HEADINGS = {"intermediate": "intermed."}
"""Stages by shorter names, so that the table fits into 80 columns."""


TOLD_OF_RECORDER = ("files", "unrecorded", "overrun", "foreign", "stopped")
"""Of its report."""

CLOCK_COUNTERS = ("clock_jumps", "clock_offset_exceeded")
"""Of the nodes' reports."""

LATE_FATES = {"revised": "taken in", "too_late": "beyond the window", "stale": "of no use any more"}
"""What becomes of late messages where nodes revise, in words."""


@dataclass(frozen=True, slots=True)
class Edge:
    """What became of one stage's messages on one edge, from the two ends' own counters."""

    sender: str
    receiver: str
    stage: str
    sent: int
    received: int
    late: int
    lost: int
    missed: int
    """Not there at the deadline, whatever the reason."""
    recorded: int | None
    used_fraction: float | None
    latency_us: dict[str, Any]
    budget_us: dict[str, float]
    clock: dict[str, float]
    """These as `latency.of_edge`."""


def summarize(
    run: str,
    scenario: Scenario,
    reports: Mapping[NodeId, Sequence[NodeReport]],
    recorder: RecorderReport | None,
    *,
    failures: Sequence[str] = (),
    interrupted: bool = False,
    simulated: bool = False,
    logs: str | None = None,
    network: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The summary as plain data: what ``--json`` prints.

    run, method, nodes, steps, completed_steps {node}, messages {sent, recorded: {stage: count}}, unreported_lives:
    those that told no counters, being killed, so that all sums, as `sent`, lack what was theirs; lost, late,
    revised, too_late, stale (`EdgeCounters`), refused and incidents by name, clock_jumps and clock_offset_exceeded,
    rounds_per_s, latency_us {p50, p99} from measurement to estimate, settled: both for the second half of the steps,
    and cpu_us, what a step costs a node; rmse {stage: {node}} where the truth is known, predicted_rmse {stage: {node}},
    recording, recorder (`RecorderReport`); the verdict on each edge, with its latencies and budget; rounds {node}
    (`latency.of_node`); emulated, faults, network: what links, plans and network namespaces did; notes on the method.
    """
    lives = [report for of_node in reports.values() for report in of_node]
    sent: Counter[str] = Counter()
    for report in lives:
        sent.update(report.sent)
    edges = list(_edges(reports, recorder, to_the_end=not interrupted))
    settled = [report.settled for report in lives if report.settled]
    return {
        "run": run,
        "method": scenario.method.name,
        "notes": notes_of(scenario),
        "nodes": list(scenario.ids),
        "steps": scenario.steps,
        "completed_steps": {str(i): sum(r.completed for r in reports.get(i, ())) for i in scenario.ids},
        "messages": {"sent": dict(sent), "recorded": dict(recorder.recorded) if recorder else {}},
        **_counted(lives, edges, recorder),
        "unreported_lives": sum(report.cut for report in lives),
        "restarts": sum(max(0, len(of_node) - 1) for of_node in reports.values()),
        "rounds_per_s": _rate((report.completed, report.elapsed_s) for report in lives),
        "latency_us": _quantiles(report.latency for report in lives),
        "settled": {
            "rounds_per_s": _rate((pace["completed"], pace["elapsed_s"]) for pace in settled),
            "latency_us": _quantiles(pace["latency"] for pace in settled),
            "cpu_us": _cpu(settled),
        },
        "rmse": _by_stage(reports, "mse"),
        "predicted_rmse": _by_stage(reports, "predicted_mse"),
        "nees": _nees(reports),
        "design_rmse": _design(scenario, reports),
        "estimates": {str(i): lives[-1].estimate for i, lives in reports.items() if lives},
        "recording": recorder.path if recorder else None,
        "lost_on_recording": dict(recorder.lost) if recorder else {},
        "recorder": {name: getattr(recorder, name) for name in TOLD_OF_RECORDER} if recorder else {},
        "edges": [asdict(edge) for edge in edges],
        "rounds": {str(i): of_node(lives) for i, lives in reports.items()},
        "emulated": emulated(reports),
        "faults": [dict(planned.told) for planned in Timeline(scenario).planned],
        "interrupted": interrupted,
        "simulated": simulated,
        "failures": list(failures),
        "logs": logs,
        "network": network,
    }


def _counted(lives: Sequence[NodeReport], edges: Sequence[Edge], recorder: RecorderReport | None) -> dict[str, Any]:
    """What was lost, late, refused or left out, in all."""
    return {
        "lost": sum(edge.lost for edge in edges) + sum(recorder.lost.values() if recorder else ()),
        "late": sum(edge.late for edge in edges),
        **{kind: _of_all_edges(lives, kind) for kind in LATE_FATES},
        "missed": sum(edge.missed for edge in edges),
        "refused": _refused(lives),
        "fallbacks": sum(report.fallbacks for report in lives),
        "incidents": _incidents(lives),
        "skipped": sum(report.skipped for report in lives),
        **{name: sum(getattr(report, name) for report in lives) for name in CLOCK_COUNTERS},
    }


def notes_of(scenario: Scenario) -> list[str]:
    """What a user of the scenario's method must know of every run."""
    method = chosen(scenario)
    note = method.family.note
    warnings = method.family.warnings(method.options, scenario.system(), method.network(scenario.network))
    return [*([note] if note else []), *warnings]


def _edges(
    reports: Mapping[NodeId, Sequence[NodeReport]], recorder: RecorderReport | None, *, to_the_end: bool
) -> Iterable[Edge]:
    """The verdict on every edge and stage, over all lives whose ends were told.

    Only in a run that went to its end (`to_the_end`) were the last messages on every edge waited for.
    """
    by_text = {str(i): lives for i, lives in reports.items()}
    for receiver, lives in by_text.items():
        total = add_up(report.measured for report in lives)
        for sender in dict.fromkeys(j for report in lives for j in report.edges):
            told = [report.edges[sender] for report in lives if sender in report.edges]
            senders_lives = by_text.get(sender, ())
            for stage in dict.fromkeys(s for edge in told for s in edge["heard"]):
                count: dict[str, Any] = {
                    kind: sum(edge[kind].get(stage, 0) for edge in told)
                    for kind in ("received", "late", "missed", "lost")
                }
                if to_the_end:
                    count["lost"] += _lost_at_the_end(stage, lives, senders_lives, sender)
                yield Edge(
                    sender,
                    receiver,
                    stage,
                    sent=sum(report.sent.get(stage, 0) for report in senders_lives),
                    recorded=None if recorder is None else recorder.by_key.get(f"{sender}/{stage}", 0),
                    **count,
                    **of_edge(lives, total, sender, stage, count["received"]),
                )


def _lost_at_the_end(stage: str, lives: Sequence[NodeReport], senders_lives: Sequence[NodeReport], sender: str) -> int:
    """What the sender put on its key after the last message that came, less what is of steps the receiver never took.

    Known only where both lived once: of a life that was cut short nobody told the totals.
    """
    if len(lives) != 1 or len(senders_lives) != 1:
        return 0
    [receiver], [told] = lives, senders_lives
    unread = max(0, told.step - receiver.step)
    return max(0, told.sent.get(stage, 0) - receiver.edges[sender]["heard"].get(stage, 0) - unread)


def _incidents(lives: Iterable[NodeReport]) -> dict[str, int]:
    """What was out of the ordinary with the method, in all nodes together."""
    total: Counter[str] = Counter()
    for report in lives:
        total.update(report.incidents)
    return dict(total)


def _refused(lives: Iterable[NodeReport]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for report in lives:
        total.update(report.overheard)
        for edge in report.edges.values():
            total.update(edge["refused"])
    return dict(total)


def _rate(paces: Iterable[tuple[int, float]]) -> float | None:
    """Steps a second of the slowest node, from the steps and the seconds of those that took any."""
    rates = [completed / elapsed_s for completed, elapsed_s in paces if completed and elapsed_s > 0]
    return round(min(rates), 2) if rates else None


def _cpu(paces: Sequence[Mapping[str, Any]]) -> float | None:
    """Microseconds of CPU of a node's process for a step."""
    steps = sum(pace["completed"] for pace in paces)
    return round(1e6 * sum(pace["cpu_s"] for pace in paces) / steps, 1) if steps else None


def _of_all_edges(lives: Iterable[NodeReport], kind: str) -> int:
    """How many messages of all stages met with that."""
    return sum(sum(edge.get(kind, {}).values()) for report in lives for edge in report.edges.values())


def _quantiles(latencies: Iterable[Mapping[str, int]]) -> dict[str, float | None]:
    merged = Latencies()
    for counts in latencies:
        merged.merge({int(number): count for number, count in counts.items()})
    return {"p50": merged.quantile_us(0.5), "p99": merged.quantile_us(0.99)}


def _by_stage(reports: Mapping[NodeId, Sequence[NodeReport]], squared: str) -> dict[str, dict[str, float]]:
    """Stage -> node -> root of the mean over all lives of a mean squared error."""
    found: dict[str, dict[str, float]] = {}
    for node, lives in reports.items():
        for stage in dict.fromkeys(s for report in lives for s in report.errors):
            told = [report.errors[stage] for report in lives if squared in report.errors.get(stage, {})]
            count = sum(errors["count"] for errors in told)
            if count:
                mean = sum(errors[squared] * errors["count"] for errors in told) / count
                found.setdefault(stage, {})[str(node)] = math.sqrt(mean)
    return found


def _design(scenario: Scenario, reports: Mapping[NodeId, Sequence[NodeReport]]) -> dict[str, dict[str, float]]:
    """What was predicted before the run, with nothing lost: kind -> node -> root of the mean of trace P over the steps.

    Empty where there is no truth to set it beside, or where it would take longer than a summary may.
    """
    steps = max((report.step for lives in reports.values() for report in lives), default=0)
    if not scenario.truth_known or not 0 < steps * len(scenario.ids) <= MOST_PREDICTED:
        return {}
    prediction = predict(scenario.system(), scenario.network, steps)
    kinds = {kind: getattr(prediction, kind)[1:] for kind in ("local", "intermediate", "distributed")}
    every = np.repeat(prediction.centralized[1:, None], len(scenario.ids), axis=1)
    return {
        kind: {
            str(node): math.sqrt(float(np.mean(np.einsum("kaa->k", of_kind[:, position]))))
            for position, node in enumerate(prediction.ids)
        }
        for kind, of_kind in (kinds | {"centralized": every}).items()
    }


def _nees(reports: Mapping[NodeId, Sequence[NodeReport]]) -> dict[str, float]:
    """Node -> mean normalised squared error of its estimates; near nx where its covariances can be believed."""
    found = {}
    for node, lives in reports.items():
        told = [report.errors[ESTIMATE.name] for report in lives if "nees" in report.errors.get(ESTIMATE.name, {})]
        count = sum(errors["count"] for errors in told)
        if count:
            found[str(node)] = sum(errors["nees"] * errors["count"] for errors in told) / count
    return found


def show_summary(console: Console, summary: Mapping[str, Any]) -> None:
    """The summary for people."""
    console.print(f"[bold]{summary['run']}[/]   {summary['method']}")
    console.print(_table_of_errors(summary))
    if summary["design_rmse"]:
        bounds = {kind: list(summary["design_rmse"][kind].values()) for kind in ("local", "centralized")}
        told = ", ".join(f"{kind} {_number(sum(of) / len(of))}" for kind, of in bounds.items())
        console.print(f"predicted rmse without a network and with a centre, mean of the nodes: {told}")
    _show_traffic(console, summary)
    for note in summary["notes"]:
        console.print(f"note: {note}", soft_wrap=True)
    for failure in summary["failures"]:
        console.print(f"[bold red]failed:[/] {escape(failure)}", soft_wrap=True)
    if summary["recording"]:
        console.print(f"recording: {summary['recording']}", soft_wrap=True)
    if summary["logs"] and summary["failures"]:
        console.print(f"logs: {summary['logs']}", soft_wrap=True)


def _table_of_errors(summary: Mapping[str, Any]) -> Table:
    """Root mean square errors by node and stage, each beside what was predicted."""
    columns: dict[str, Mapping[str, float]] = {}
    design = summary["design_rmse"] if summary["method"] == "two_stage" else {}
    for stage, of_nodes in summary["rmse"].items():
        heading = HEADINGS.get(stage, stage)
        columns[f"{heading}\nrmse"] = of_nodes
        beforehand = design.get(DESIGNED.get(stage, ""))
        columns[f"{heading}\npredicted"] = beforehand or summary["predicted_rmse"].get(stage, {})
    if summary["nees"]:
        columns[f"{ESTIMATE.name}\nnees"] = summary["nees"]
    last = {} if summary["rmse"] else summary["estimates"]
    table = Table()
    for name in ("node", "steps", *columns):
        table.add_column(name, justify="left" if name == "node" else "right")
    if last:
        table.add_column("last estimate ± sd")
    for node in map(str, summary["nodes"]):
        cells = [_number(column.get(node)) for column in columns.values()]
        cells += [shown_estimate(last.get(node, {}))] if last else []
        table.add_row(node, str(summary["completed_steps"][node]), *cells)
    return table


def _show_traffic(console: Console, summary: Mapping[str, Any]) -> None:
    sent, recorded = summary["messages"]["sent"], summary["messages"]["recorded"]
    counts = ", ".join(f"{count} {stage}" for stage, count in sent.items())
    console.print(f"sent: {counts or 'nothing is known'}")
    if lives := summary["unreported_lives"]:
        console.print(f"  without what {lives} {'life' if lives == 1 else 'lives'} counted that ended without a report")
    if recorded:
        missing = sum(summary["lost_on_recording"].values())
        console.print(f"recorded: {sum(recorded.values())} messages, {missing} missing")
        reasons = {"not written": "unrecorded", "too much for the recorder": "overrun"}
        dropped = [f"{summary['recorder'][of]} {what}" for what, of in reasons.items() if summary["recorder"].get(of)]
        if dropped:
            console.print(f"  of these: {', '.join(dropped)}")
    trouble = {name: summary[name] for name in ("lost", "late", "missed", "fallbacks", "skipped")}
    trouble |= {f"late but {said}": summary[kind] for kind, said in LATE_FATES.items() if summary[kind]}
    console.print(", ".join(f"{count} {name}" for name, count in trouble.items()))
    if summary["refused"]:
        console.print("refused: " + ", ".join(f"{count} {reason}" for reason, count in summary["refused"].items()))
    if summary["incidents"]:
        told = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in summary["incidents"].items())
        console.print(f"steps of the method's own: {told}")
    latency = summary["latency_us"]
    if summary["rounds_per_s"] and latency["p50"] is not None and not summary["simulated"]:
        console.print(
            f"{summary['rounds_per_s']:.1f} steps/s; measurement to estimate "
            f"{latency['p50']:.0f} µs (p50), {latency['p99']:.0f} µs (p99)"
        )
    if summary["clock_jumps"] or summary["clock_offset_exceeded"]:
        console.print(
            f"clocks: {summary['clock_jumps']} jumps seen by nodes; "
            f"{summary['clock_offset_exceeded']} readings of neighbours' beyond the limit"
        )
    _show_misfortune(console, summary)
    show_latencies(console, summary, HEADINGS)
    holes = [edge for edge in summary["edges"] if edge["lost"] or edge["late"] or edge["missed"]]
    if holes:
        console.print("edges where something did not arrive in time:")
        table = Table()
        for name in ("edge", "stage", "sent", "received", "late", "lost", "missed"):
            table.add_column(name, justify="left" if name in {"edge", "stage"} else "right")
        for edge in holes:
            numbers = [str(edge[name]) for name in ("sent", "received", "late", "lost", "missed")]
            table.add_row(f"{edge['sender']} → {edge['receiver']}", edge["stage"], *numbers)
        console.print(table)


def _show_misfortune(console: Console, summary: Mapping[str, Any]) -> None:
    """What the scenario did to messages, nodes and links."""
    total: Counter[str] = Counter()
    for edge in summary["emulated"]:
        total.update({reason: count for reason, count in edge.items() if isinstance(count, int)})
    if total:
        told = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in total.items())
        console.print(f"by the links of the scenario: {told}")
    if summary["network"] and "edges" in summary["network"]:
        _show_packets(console, summary["network"])
    if summary["faults"]:
        kinds = Counter(fault["kind"] for fault in summary["faults"])
        told = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        console.print(f"planned faults: {told}; {summary['restarts']} restarts")


def _show_packets(console: Console, network: Mapping[str, Any]) -> None:
    """What the network between the namespaces did to packets."""
    total: Counter[str] = Counter({"strays": network["strays"], "overrun": network["overrun"]})
    for edge in network["edges"]:
        total.update({what: count for what, count in edge.items() if what not in {"from", "to", "bytes"}})
    packets = total.pop("packets", 0)
    dropped = "".join(f", {count} {what.replace('_', ' ')}" for what, count in total.items() if count)
    late = network["late_us"]["p99"]
    carried = "" if late is None else f"; carried up to {late:.0f} µs later than said (p99)"
    console.print(f"network namespaces, {network['kind']}: {packets} packets{dropped}{carried}")


def show_node_report(console: Console, report: Mapping[str, Any]) -> None:
    """How one node went, for people."""
    console.print(f"node {report['node']}: {report['completed']} steps in {report['elapsed_s']:.1f} s")
    for stage, errors in report["errors"].items():
        if "rmse" in errors:
            console.print(f"  rmse {stage}: {_number(errors['rmse'])}")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
