"""Every method as a swarm of processes over Zenoh, recorded, and proven by its recording; and in bad weather."""

from __future__ import annotations

import tomllib
from pathlib import Path
from shutil import rmtree
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarms import launch, recorded, run_name, variant
from zfusion.drivers.designs import modes_of
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import simulate
from zfusion.links import Topology
from zfusion.methods import METHODS
from zfusion.methods.check import check_method
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import Array
from zfusion.recording import Recording
from zfusion.stages import Message

SCENARIO = """
seed = 3
[network]
generator = "complete"
[system]
F = [[0.9, 0.2], [0, 0.8]]
Q = { diagonal = [0.1, 0.2] }
initial_mean = [1.0, 0.0]
initial_covariance = { diagonal = [1.0, 1.0] }
[[sensors]]
id = 1
H = [[1.0, 0.5]]
R = 0.5
[[sensors]]
id = 2
H = [[1.0, 0.5]]
R = 0.3
"""
"""Stable, constant, white and uncorrelated, everybody measures the same: there is no method that cannot stand it."""

OPTIONS: dict[str, dict[str, Any]] = {
    "consensus": {"rounds": 2, "step_size": "tuned"},
    "hybrid_consensus": {"rounds": 2},
    "l2_linf": {"output": [[1.0, 0.0]]},
}
"""Where it is not the defaults."""

PROVEN_ELSEWHERE = ("two_stage", "local", "centralized")
"""In the tests of the live swarm itself."""

NAMES = [name for name in METHODS if name not in PROVEN_ELSEWHERE]
UNDESIGNED = [name for name in NAMES if METHODS[name].designer is None]
STEPS = 8


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("methods") / "base.toml"
    path.write_text('name = "base"\n' + SCENARIO)
    return path


def test_each_method_runs_live_and_its_recording_proves_it(base: Path, tmp_path: Path) -> None:
    """One after the other in one test: what takes time is to start the processes."""
    for name in UNDESIGNED:
        scenario = variant(tmp_path, name, base, method={"name": name, "options": OPTIONS.get(name, {})})
        file = tmp_path / f"{name}.mcap"
        result = launch(tmp_path, scenario, "--free-run", "--steps", STEPS, "--record", file)
        assert result.code == 0, (name, result.err)
        assert result.summary["completed_steps"] == {"1": STEPS, "2": STEPS}
        assert not result.summary["refused"]
        assert_proven(file, name, 2 * STEPS * len(METHODS[name].choose(OPTIONS.get(name, {})).stages))


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example of `l2_linf`: four nodes, sensors that miss, a topology that a Markov chain switches."""
    pytest.importorskip("cvxpy")
    return Path(__file__).parents[1] / "examples" / "l2_linf.toml"


def test_a_switching_topology_is_live_the_same_at_all_nodes(designed: Path, tmp_path: Path) -> None:
    """Every process draws the chain by itself; a node uses just whom the mode of the step has, in step with all others.

    Free-running: no node waits for what the mode does not have. The recording proves it without the logs of the run.
    """
    scenario = variant(tmp_path, "switching", designed)
    file, run = tmp_path / "switching.mcap", run_name("switching")
    result = launch(tmp_path, scenario, "--free-run", "--steps", SWITCHED, "--record", file, run=run)
    assert result.code == 0, result.err
    assert set(result.summary["completed_steps"].values()) == {SWITCHED}
    assert not result.summary["refused"]
    assert not any(edge["missed"] for edge in result.summary["edges"])
    document = load_scenario(scenario)
    modes = [Topology(document).mode(k) for k in range(1, SWITCHED + 1)]
    assert set(modes) == {0, 1}
    networks = modes_of(document).networks
    used = {
        (m.payload["node"], m.payload["step"]): tuple(m.payload["used"])
        for m in recorded(file)
        if m.topic.endswith("/estimate")
    }
    for k, mode in enumerate(modes, 1):
        assert {i: used[i, k] for i in document.ids} == {i: networks[mode].neighbours(i) for i in document.ids}
    rmtree(next(tmp_path.glob("*.logs")))
    assert_proven(file, "l2_linf", 2 * 4 * SWITCHED)


SWITCHED = 20


@pytest.mark.parametrize("name", ["stationary", "l2_linf"])
def test_a_designed_method_is_live_where_messages_are_lost(
    name: str, designed: Path, base: Path, tmp_path: Path
) -> None:
    """At a rate, with a fifth of the messages lost: the recording alone proves every estimate."""
    method = {"name": name, "options": OPTIONS.get(name, {})}
    links, timing = {"loss": 0.2}, {"rate_hz": 50.0}
    given = {"links": links} if name == "l2_linf" else {"links": links, "method": method}
    file = tmp_path / "lossy.mcap"
    scenario = variant(tmp_path, "lossy", designed if name == "l2_linf" else base, timing=timing, **given)
    result = launch(tmp_path, scenario, "--steps", SWITCHED, "--record", file)
    assert result.code == 0, result.err
    assert sum(edge.get("lost", 0) for edge in result.summary["emulated"]) > 0
    assert_proven(file, name, SWITCHED)


def assert_proven(file: Path, name: str, least: int) -> None:
    """All estimates of a recording come out as they were, bit for bit."""
    with Recording.open(file) as recording:
        verdict = verify(recording)
    assert (verdict.different, verdict.missing_count) == (0, 0), name
    assert verdict.identical >= least, name


def foul(name: str, seed: int, loss: float, delay_ms: int, kill: int, restart: int) -> Scenario:
    """Four nodes in a ring, with losses, delays of up to several steps, a node that dies and, perhaps, comes back."""
    document = tomllib.loads('name = "foul"' + SCENARIO)
    document |= {"seed": seed, "steps": 16, "network": {"generator": "ring"}}
    document["sensors"] = [{"id": i, "H": [[1.0, 0.5]], "R": 0.5} for i in (1, 2, 3, 4)]
    document["method"] = {"name": name, "options": OPTIONS.get(name, {})}
    document["timing"] = {"rate_hz": 100.0}
    document["links"] = {
        "loss": loss,
        "delay": {"distribution": "exponential", "mean": delay_ms / 1000},
        "duplicate": 0.1,
        "reorder": True,
    }
    back = {"restart_after": restart} if restart else {}
    document["faults"] = [
        {"kind": "kill", "node": 2, "step": kill, **back},
        {"kind": "stop", "node": 3, "step": 5, "steps": 3},
    ]
    return Scenario.model_validate(document)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    loss=st.sampled_from([0.0, 0.2, 0.7]),
    delay_ms=st.integers(1, 25),
    kill=st.integers(1, 12),
    restart=st.integers(0, 4),
)
def test_no_weather_is_too_bad(
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    seed: int,
    loss: float,
    delay_ms: int,
    kill: int,
    restart: int,
) -> None:
    if METHODS[name].designer is not None:
        pytest.importorskip("cvxpy")  # one design for all, as it depends on nothing that varies here
    scenario = foul(name, seed, loss, delay_ms, kill, restart)
    check_method(scenario, "foul")
    file = tmp_path_factory.mktemp("foul") / "foul.mcap"
    found: list[bool] = []

    def observe(message: Message, _: int) -> None:
        if message.stage == "estimate":
            P = cast(Array, message.fields["P"])
            found.append(bool(np.isfinite(cast(Array, message.fields["x"])).all() and np.linalg.eigvalsh(P)[0] > 0))

    simulate(scenario, run="r", output=file, observe=observe)
    assert len(found) > 30
    assert all(found)
    assert_proven(file, name, 30)
