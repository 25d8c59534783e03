"""The latencies and budgets of a summary, for programs and for people."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from simulations import MS, walk
from zfusion.drivers.metrics import NodeReport
from zfusion.drivers.simulated import Simulation
from zfusion.model.types import NodeId
from zfusion.report.summary import show_summary, summarize

LINKS: dict[str, Any] = {"delay": 0.004, "loss": 0.2, "edges": [{"from": 20, "delay": 0.012}]}


def simulated(**more: Any) -> tuple[dict[str, Any], dict[NodeId, list[NodeReport]]]:
    scenario = walk(steps=64, **more)
    simulation = Simulation(scenario)
    simulation.run()
    return summarize("r", scenario, simulation.reports, None, simulated=True), simulation.reports


def shown(summary: dict[str, Any], width: int = 80) -> str:
    console = Console(width=width, record=True, file=StringIO())
    show_summary(console, summary)
    return console.export_text()


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    return simulated(links=LINKS)[0]


def test_edges_tell_latencies_budgets_and_used_fractions(summary: dict[str, Any]) -> None:
    for edge in summary["edges"]:
        latency, delay = edge["latency_us"], 12_000 if edge["sender"] == "20" else 4_000
        assert latency["mean"] == delay
        assert latency["p50"] == pytest.approx(delay, rel=0.03)  # the histogram's resolution
        assert edge["used_fraction"] == edge["received"] / 64
        assert edge["budget_us"]["wire"] == 0
        assert edge["budget_us"]["computed"] == 0


def test_the_parts_of_all_stages_are_the_round(summary: dict[str, Any]) -> None:
    for receiver, rounds in summary["rounds"].items():
        assert rounds["rounds"] > 0
        of_sender: dict[str, float] = {}
        for edge in summary["edges"]:
            if edge["receiver"] == receiver:
                of_sender[edge["sender"]] = of_sender.get(edge["sender"], 0) + sum(edge["budget_us"].values())
        for total in of_sender.values():
            assert total == pytest.approx(rounds["round_us"], abs=0.02)
        assert 0 < rounds["waits_us"]["measurement"]["p50"] <= rounds["waits_us"]["measurement"]["p99"]


def test_people_are_shown_the_slowest_edges_in_80_columns(summary: dict[str, Any]) -> None:
    text = shown(summary)
    assert all(len(line) <= 80 for line in text.splitlines())
    table = text.split("latency, and what")[1].split("edges where")[0]
    assert "8 slowest of 20" in table
    rows = [line for line in table.splitlines() if "→" in line]
    assert len(rows) == 8
    assert sum(line.strip().startswith("20 →") for line in rows) == 4
    assert "by the links of the scenario:" in text


def test_where_messages_take_no_time_nothing_is_shown_of_it() -> None:
    assert "latency, and what" not in shown(simulated()[0])


def test_several_lives_are_told_as_one() -> None:
    kill = {"kind": "kill", "node": 30, "step": 20, "restart_after": 10}
    summary, reports = simulated(links={"delay": 0.002}, faults=[kill])
    assert len(reports[30]) == 2
    assert summary["restarts"] == 1
    assert summary["faults"] == [kill]
    assert "planned faults: 1 kill; 1 restarts" in shown(summary)
    for edge in summary["edges"]:
        assert edge["latency_us"]["mean"] == 2 * MS / 1000
        if edge["receiver"] == "30":
            assert sum(report.completed for report in reports[30]) == 54
            assert edge["used_fraction"] == edge["received"] / 54


def test_lives_that_ended_without_a_report_are_told_beside_the_sums_that_lack_them() -> None:
    scenario = walk(steps=64)
    simulation = Simulation(scenario)
    simulation.run()
    told = summarize("r", scenario, simulation.reports, None)
    assert told["unreported_lives"] == 0
    assert "without what" not in shown(told)
    killed = NodeReport.cut_short(30, {"born": 1, "step": 20, "completed": 19})
    of_nothing = NodeReport.of_nothing(30)  # it had nothing to tell, and did tell that
    told = summarize("r", scenario, {**simulation.reports, 30: [killed, of_nothing]}, None)
    assert told["unreported_lives"] == 1
    assert "  without what 1 life counted that ended without a report\n" in shown(told)


def test_latencies_between_machines_are_marked_with_what_their_clocks_may_differ_by() -> None:
    scenario = walk(steps=64, links={"delay": 0.002})
    simulation = Simulation(scenario)
    simulation.run()
    reports = simulation.reports
    reports[10][-1].clocks = {"20": {"offset_us": -1500.0, "uncertainty_us": 100.0}}
    summary = summarize("r", scenario, reports, None)
    edges = {(e["sender"], e["receiver"], e["stage"]): e for e in summary["edges"]}
    assert edges["20", "10", "measurement"]["latency_us"]["clock_error_us"] == 1600.0
    assert edges["20", "10", "measurement"]["clock"] == {"offset_us": -1500.0, "uncertainty_us": 100.0}
    assert edges["50", "10", "measurement"]["latency_us"]["clock_error_us"] is None
    assert "20 → 10 ?" in shown(summary)
