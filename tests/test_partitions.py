"""Hosts that are cut off and come back, and links that carry one way only.

    python -m pytest -m long tests/test_partitions.py

Needs network namespaces.
"""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

import pytest

from exactness import Exactness
from swarms import launch, recorded, variant, zfusion
from test_netns_swarm import TROUBLE

pytestmark = pytest.mark.long

EVERYBODY = {1: [1, 2, 3], 2: [2, 3, 4], 3: [1, 3, 4], 4: [1, 2, 4]}
SLOW = {"timing": {"rate_hz": 20.0}}

PARTINGS: dict[str, list[dict[str, Any]]] = {
    "a host": [{"kind": "partition", "step": 21, "steps": 70, "groups": [[1]]}],
    "one way": [{"kind": "cut", "from": 2, "to": 1, "step": 21, "steps": 70}],
}


def assert_right(directory: Path, path: Path) -> None:
    """Every estimate on the recording comes out of a replay bit for bit, and is the least-squares one."""
    verdict = zfusion(directory, "replay", path, "--verify", "--json")
    assert verdict.code == 0, verdict.out
    assert (verdict.summary["different"], verdict.summary["unverifiable"]) == (0, 0)
    assert Exactness(path).assert_sample(Random(1), 25)["estimates"] > 50


@pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")
@pytest.mark.parametrize("what", PARTINGS)
def test_who_is_cut_off_is_missed_and_taken_back(tmp_path: Path, what: str) -> None:
    scenario = variant(tmp_path, "parted", links={"delay": 0.002}, faults=PARTINGS[what], **SLOW)
    result = launch(tmp_path, scenario, "--netns-with", "tun", "--steps", 160, "--record", "x.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["failures"] == []
    used: dict[int, dict[int, list[int]]] = {i: {} for i in EVERYBODY}
    for m in recorded(tmp_path / "x.mcap"):
        if m.topic.endswith("/intermediate"):
            used[m.payload["node"]][m.payload["step"]] = m.payload["used"]
    # TCP needs both ways: where one is cut, the acknowledgements of the other do not come, and its link is given up.
    assert all(2 not in ids for step, ids in used[1].items() if 24 <= step <= 88)
    assert EVERYBODY[1] in [ids for step, ids in used[1].items() if step > 92]
    missed = {(e["sender"], e["receiver"]): e["missed"] + e["lost"] for e in summary["edges"]}
    assert missed["2", "1"] > 0
    assert_right(tmp_path, tmp_path / "x.mcap")
