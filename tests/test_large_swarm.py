"""As many nodes as fit on a small machine."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import tomli_w

from swarms import launch, recorded, run_name, zfusion

NODES = 32

SCENARIO = {
    "name": "ring",
    "seed": 3,
    "timing": {"free_run": True, "timeout_s": 60.0},
    "network": {"generator": "ring", "reach": 2},
    "system": {
        "F": [[1.0, 0.1], [0.0, 0.95]],
        "Q": [[0.02, 0.01], [0.01, 0.1]],
        "initial_covariance": [[2.0, 0.0], [0.0, 1.0]],
    },
    "sensors": [{"count": NODES, "H": [[1.0, 0.0]], "R": 0.5}],
}


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_thirty_two_nodes_run_without_drama(tmp_path: Path) -> None:
    path, steps = tmp_path / "ring.toml", 20
    path.write_text(tomli_w.dumps(SCENARIO))
    began = time.time_ns()
    result = launch(tmp_path, path, "--steps", steps, "--record", "ring.mcap", run=run_name("ring"))
    assert result.code == 0, result.err
    summary = result.summary
    assert set(summary["completed_steps"].values()) == {steps}
    assert len(summary["completed_steps"]) == NODES
    assert (summary["lost"], summary["late"], summary["missed"], summary["fallbacks"]) == (0, 0, 0, 0)
    assert summary["messages"]["sent"] == summary["messages"]["recorded"]
    assert all(edge["received"] == steps for edge in summary["edges"])
    assert len(summary["edges"]) == NODES * 4 * 2
    first = next(m for m in recorded(tmp_path / "ring.mcap") if m.topic.endswith("/estimate"))
    assert (first.publish_time - began) / 1e9 < 60  # a few seconds where nothing else runs
    assert zfusion(tmp_path, "replay", "ring.mcap", "--verify", "--json").code == 0
