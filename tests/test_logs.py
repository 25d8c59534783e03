"""Logs: every record says run, node and step; JSON is one object a line; nothing is said a thousand times."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path

import pytest

from swarms import Command, client, endpoints, run_name, variant, wait_until, zfusion
from zfusion.cli.logs import Context, JsonFormatter, LineFormatter
from zfusion.drivers.complaints import EVERY_NS, Complaints


def test_the_processes_of_a_launch_log_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's garbage on a neighbour's key is in the log: once, with how much it was."""
    monkeypatch.delenv("ZFUSION_LOG", raising=False)
    scenario, run = variant(tmp_path, "logging", timing={"rate_hz": 20.0}), run_name("logging")
    command = Command(
        tmp_path, "--log-format", "json", "launch", scenario, "--json", "--run", run, "--steps", 1_000_000
    )
    log = tmp_path / "recordings" / f"{run}.logs" / "node-1.log"
    wait_until(lambda: log.exists() and "begins with step" in log.read_text(), "node 1 begins")
    with client(endpoints(scenario)["1"]) as session:
        forger = session.declare_publisher(f"zfusion/{run}/node/2/measurement")
        wait_until(lambda: forger.matching_status.matching, "node 1 listens to it")
        while "refused from node 2" not in log.read_text():
            forger.put(b"\xc1")
    command.interrupt()
    result = command.wait()
    assert result.code == 0
    for path in log.parent.glob("*.log"):
        records = [json.loads(line) for line in path.read_text().splitlines()]
        assert records
        assert {record["run"] for record in records} == {run}
        assert {record.get("node") for record in records} == {
            int(path.stem.removeprefix("node-")) if path.stem.startswith("node") else None
        }
    told = [json.loads(line) for line in log.read_text().splitlines()]
    warned = [record for record in told if record["message"].startswith("refused from node 2")]
    assert warned[0]["level"] == "warning"
    assert warned[0]["step"] > 0
    assert "not_a_map" in warned[0]["message"]
    assert len(warned) <= 2  # when it began, and what came since at the end
    refused = result.summary["refused"]["not_a_map"]
    assert f"({refused} so far)" in warned[-1]["message"]


def test_the_environment_says_the_form_and_errors_keep_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZFUSION_LOG", "json")
    [line] = zfusion(tmp_path, "simulate", "missing.toml").err.splitlines()
    assert json.loads(line)["level"] == "error"
    monkeypatch.setenv("ZFUSION_LOG", "xml")
    assert zfusion(tmp_path, "simulate", "missing.toml").code == 2


def test_records_have_their_context_and_their_failure() -> None:
    context = Context()
    context.run, context.node, context.step = "run", 3, lambda: 17
    try:
        raise ValueError("why")
    except ValueError:
        record = logging.LogRecord("zfusion", logging.ERROR, "", 0, "what %s", ("happened",), sys.exc_info())
    assert context.filter(record)
    told = json.loads(JsonFormatter().format(record))
    assert told["message"] == "what happened"
    assert (told["run"], told["node"], told["step"]) == ("run", 3, 17)
    assert "ValueError: why" in told["exception"]
    line, *trace = LineFormatter().format(record).splitlines()
    assert line.endswith("Z ERROR run=run node=3 step=17: what happened")
    assert trace[-1] == "ValueError: why"


def test_complaints_are_few_and_complete(caplog: pytest.LogCaptureFixture) -> None:
    complaints = Complaints()
    for n in range(1, 1001):
        complaints.look(n, {"node 2": {"duplicate": n}, "node 3": {}})
    complaints.look(EVERY_NS + 1, {"node 2": {"duplicate": 1000, "wrong_node": 2}})
    complaints.look(EVERY_NS + 2, {"node 2": {"duplicate": 1001, "wrong_node": 2}}, ended=True)
    assert caplog.messages == [
        "refused from node 2: 1 duplicate (1 so far)",
        "refused from node 2: 999 duplicate, 2 wrong_node (1002 so far)",
        "refused from node 2: 1 duplicate (1003 so far)",
    ]
