"""What docs/tutorial_own_sensor.md tells people to write, written and run."""

import re
from pathlib import Path

import numpy as np

from zfusion.drivers.simulated import Simulation
from zfusion.drivers.sources import open_source
from zfusion.model.scenario import load_scenario

DOCS = Path(__file__).parent.parent / "docs"


def test_the_two_sensors_of_the_tutorial_run(tmp_path):
    text = (DOCS / "tutorial_own_sensor.md").read_text()
    for language, name in (("python", "my_sensors.py"), ("toml", "my.toml")):
        [block] = re.findall(rf"```{language}\n(# {name}\n.*?)```", text, re.DOTALL)
        (tmp_path / name).write_text(block)
    scenario = load_scenario(tmp_path / "my.toml", steps=5)
    slow = open_source(scenario, "slow")
    assert slow.read(1, 0).shape == (1,)
    assert open_source(scenario, "fast").read(1, 0).shape == (1,)
    simulation = Simulation(scenario)
    simulation.run()
    estimates = [node.estimate for node in simulation.nodes.values()]
    assert [node.completed for node in simulation.nodes.values()] == [5, 5]
    assert all(np.isfinite(estimate.x).all() for estimate in estimates)


def test_the_model_in_the_tutorial_is_that_of_the_example():
    text = (DOCS / "tutorial_own_sensor.md").read_text()
    example = load_scenario(DOCS.parent / "examples" / "host.toml").system()
    assert example.F.items[0].mean.tolist() == [[1, 0.2], [0, 0.9]]
    assert example.noise.covariances(5, []).Q.tolist() == [[0.002, 0], [0, 0.01]]
    assert "F = [[1, 0.2], [0, 0.9]]\nQ = { diagonal = [0.002, 0.01] }" in text
