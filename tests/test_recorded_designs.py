"""Designs on recordings: a recording alone is enough to compute its estimates again, wherever its files have gone."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmi_examples import EXAMPLES, example
from zfusion.drivers import designs
from zfusion.drivers.designs import content_of, design_of, handed_on, with_design
from zfusion.drivers.replayed import recorded_scenario, verify
from zfusion.drivers.rerun import rerun
from zfusion.drivers.simulated import simulate
from zfusion.errors import InputError
from zfusion.methods.design_files import DesignFileError
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.recording import Recording
from zfusion.studies.contestants import field_of_recording

pytest.importorskip("cvxpy")

STEPS = 12


@pytest.fixture(scope="module")
def content() -> bytes:
    """What a file of the example's design holds."""
    made = content_of(example("stationary"))
    assert made is not None
    return made


@pytest.fixture
def no_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing can be designed any more."""
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    designs._designed.cache_clear()


def recorded(directory: Path, name: str, **changes: Any) -> Path:
    """A recording of a lossy run of the example, moved away from where it was made."""
    (directory / "away").mkdir(exist_ok=True)
    scenario = example(name, steps=STEPS, **changes).with_overrides(loss=0.2)
    simulate(scenario, run="r", output=directory / "here.mcap")
    return (directory / "here.mcap").rename(directory / "away" / "there.mcap")


@pytest.mark.parametrize("name", ["stationary", "l2_linf"])
def test_a_design_made_at_the_start_is_on_the_recording(name: str, tmp_path: Path) -> None:
    path = recorded(tmp_path, name)
    with pytest.MonkeyPatch.context() as patch, Recording.open(path) as recording:
        patch.setitem(sys.modules, "cvxpy", None)
        designs._designed.cache_clear()
        verdict = verify(recording)
        assert recording.design is not None
        assert recorded_scenario(recording).fingerprint == example(name).with_overrides(loss=0.2).fingerprint
    assert verdict.verified
    assert verdict.identical == 2 * 4 * STEPS


def test_a_recording_is_verified_without_the_design_file(content: bytes, no_solver: None, tmp_path: Path) -> None:
    """Neither the file that the scenario names is there, nor a solver that could make another."""
    path = recorded_and_deleted(tmp_path, content)
    with Recording.open(path) as recording:
        scenario = recorded_scenario(recording)
        assert scenario.method.design is not None
        assert not Path(scenario.method.design).exists()
        assert verify(recording).identical == 2 * 4 * STEPS
        assert verify(recording, jobs=2).identical == 2 * 4 * STEPS
    bare = Scenario.from_toml(scenario.to_toml())
    assert bare.fingerprint != scenario.fingerprint
    with pytest.raises(DesignFileError, match="there is no such file"):
        design_of(bare)


def test_what_if_uses_the_design_that_is_on_the_recording(content: bytes, no_solver: None, tmp_path: Path) -> None:
    with Recording.open(recorded_and_deleted(tmp_path, content)) as recording:
        assert recording.design == content
        rerun(recording, {"loss": 0.5}, tmp_path / "again.mcap")
        field = field_of_recording(recording, ["stationary", "local", "l2_linf"], tmp_path)
    assert [one.label for one in field.contestants] == ["stationary", "local"]
    assert "cvxpy" in field.refused["l2_linf"]
    assert (tmp_path / "0.npz").read_bytes() == content
    with Recording.open(tmp_path / "again.mcap") as again:
        assert again.design == content
        assert verify(again).verified


def recorded_and_deleted(directory: Path, content: bytes) -> Path:
    """A recording of a run from a design file that is gone."""
    file = directory / "design.npz"
    file.write_bytes(content)
    path = recorded(directory, "stationary", method={"name": "stationary", "design": str(file)})
    file.unlink()
    designs._designed.cache_clear()
    return path


def test_a_design_goes_with_a_scenario_as_far_as_it_is_one_for_it(content: bytes) -> None:
    old = example("stationary").carrying(content)
    assert handed_on(old, old.with_overrides(seed=5, loss=0.3, steps=3)).carried_design == content
    for change in (
        {"network": {"generator": "complete"}},
        {"method": {"name": "stationary", "options": {"exchange_measurements": False}}},
        {"method": {"name": "stationary", "design": "other.npz"}},
        {"method": "local"},
    ):
        assert handed_on(old, example("stationary", **change)).carried_design is None


def test_a_carried_design_is_checked_like_a_file(content: bytes, tmp_path: Path) -> None:
    other = example("stationary", network={"generator": "complete"}).carrying(content)
    with pytest.raises(DesignFileError, match=r"the recording's design: designed for another system, network"):
        design_of(other)
    with pytest.raises(InputError, match="not a design file"):
        design_of(example("stationary").carrying(b"nothing"))
    kept = with_design(example("stationary").carrying(content), tmp_path / "d.npz")
    assert (tmp_path / "d.npz").read_bytes() == content
    assert kept.method.design == str(tmp_path / "d.npz")


def test_a_design_has_the_same_bits_from_a_file_as_when_it_is_made(tmp_path: Path) -> None:
    """Else the covariances of a run and of its replay would differ in their last digits."""
    scenario = load_scenario(EXAMPLES / "stationary.toml")
    made, loaded = design_of(scenario), design_of(with_design(scenario, tmp_path / "d.npz"))
    assert made is not loaded
    for one, other in zip(made.problem.nominal.V, loaded.problem.nominal.V, strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(made.gains, loaded.gains, strict=True):
        np.testing.assert_array_equal(one, other)


def test_other_methods_have_no_design_on_their_recordings(tmp_path: Path) -> None:
    simulate(load_scenario(EXAMPLES / "four_sensor.toml", steps=3), run="r", output=tmp_path / "r.mcap")
    with Recording.open(tmp_path / "r.mcap") as recording:
        assert recording.design is None
