"""What docs/methods/add_a_method.md tells people to write, written and run."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import simulate
from zfusion.errors import ScenarioError
from zfusion.methods import METHODS
from zfusion.methods.check import check_method
from zfusion.model.scenario import load_scenario
from zfusion.recording import Recording

PAGE = Path(__file__).parents[1] / "docs" / "methods" / "add_a_method.md"


@pytest.fixture
def scenario(tmp_path, monkeypatch):
    text = PAGE.read_text()
    for language, name in (("python", "my_method.py"), ("toml", "my_scenario.toml")):
        [block] = re.findall(rf"```{language}\n(# {name}\n.*?)```", text, re.DOTALL)
        (tmp_path / name).write_text(block)
    monkeypatch.setitem(METHODS, "opinions", None)  # as it was before, afterwards
    runpy.run_path(str(tmp_path / "my_method.py"))
    return load_scenario(tmp_path / "my_scenario.toml")


def test_the_method_of_the_page_runs_and_its_recording_proves_it(scenario, tmp_path):
    check_method(scenario, "my_scenario.toml")
    lossy = scenario.model_copy(update={"links": type(scenario.links)(loss=0.3)})
    reports = simulate(lossy, run="r", output=tmp_path / "r.mcap")
    assert all(life.completed == 20 for lives in reports.values() for life in lives)
    assert all(np.isfinite(life.estimate["x"]).all() for lives in reports.values() for life in lives)
    with Recording.open(tmp_path / "r.mcap") as recording:
        verdict = verify(recording)
    assert (verdict.different, verdict.missing_count) == (0, 0)
    assert verdict.identical == 2 * 4 * 20


def test_its_option_is_checked(scenario):
    wrong = scenario.model_copy(update={"method": type(scenario.method)(name="opinions", options={"stubborn": 2})})
    with pytest.raises(ScenarioError, match=r"method\.options\.stubborn: expected a number from 0 to 1"):
        check_method(wrong, "my_scenario.toml")


def test_every_method_but_the_special_cases_has_a_page():
    covered = {page.stem for page in PAGE.parent.glob("*.md")} | {"two_stage", "local", "centralized"}
    assert set(METHODS) <= covered
