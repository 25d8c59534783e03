"""Links and faults in the scenario file: how they are written, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from simulations import EXAMPLE, walk
from zfusion.drivers.simulated import simulate
from zfusion.errors import ScenarioError
from zfusion.links import Timeline
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.schema import EdgeLinks, ExponentialDelay, KillFault, LinksSpec, UniformDelay

LINKS: dict[str, Any] = {
    "delay": {
        "mixture": [
            {"weight": 1, "delay": 0.1},
            {"weight": 2.5, "delay": {"trace": "rtt.csv", "column": "rtt", "order": "as_recorded"}},
            {"weight": 1, "delay": {"distribution": "lognormal", "median": 0.1, "sigma": 0.5, "shift": 0.01}},
        ]
    },
    "loss": {"gilbert_elliott": {"to_bad": 0.1, "to_good": 0.5}},
    "duplicate": 0.01,
    "bandwidth": {"rate_bps": 1e6},
    "edges": [
        {"from": 20, "to": [10, 30], "stages": "measurement", "delay": 0.05, "reorder": True},
        {"to": 10, "delay": {"trace": "/data/rtt.txt"}},
    ],
    "topology": {
        "modes": [{"edges": [[10, 20]]}, {"generator": "ring"}],
        "markov": {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [1, 0]},
    },
}
FAULTS: list[dict[str, Any]] = [
    {"kind": "kill", "node": 30, "step": 5, "restart_after": 4},
    {"kind": "stop", "node": 10, "at_s": 0.5, "for_s": 0.1},
    {"kind": "slow", "node": 10, "step": 5, "steps": 3, "delay_s": 0.1},
    {"kind": "clock", "node": 20, "step": 5, "offset_s": -0.1},
    {"kind": "cut", "from": 20, "step": 1, "steps": 3},
    {"kind": "partition", "groups": [[10, 20], [30]], "step": 7},
]
EVERYTHING = {"links": LINKS, "faults": FAULTS}


def said(**document: Any) -> list[str]:
    """All that is wrong, as it is said."""
    with pytest.raises(ScenarioError) as caught:
        walk(**document)
    return [str(problem) for problem in caught.value.problems]


# --- as it is written ---


def test_all_of_it_is_written_as_it_was_read() -> None:
    scenario = walk(**EVERYTHING)
    again = Scenario.from_toml(scenario.to_toml())
    assert again == scenario
    assert again.fingerprint == scenario.fingerprint
    assert again.to_toml() == scenario.to_toml()
    assert "from = 20\nto = [10, 30]" in scenario.to_toml()


def test_it_is_built_by_hand_as_well() -> None:
    links = LinksSpec(
        delay=UniformDelay(low=0.0, high=0.1), edges=(EdgeLinks.model_validate({"from": 10, "loss": 0.5}),)
    )
    faults = (KillFault(node=10, step=3),)
    by_hand = walk(links=links, faults=faults)
    table = {"distribution": "uniform", "low": 0.0, "high": 0.1}
    assert by_hand == walk(
        links={"delay": table, "edges": [{"from": 10, "loss": 0.5}]}, faults=[{"kind": "kill", "node": 10, "step": 3}]
    )
    assert Scenario.from_toml(by_hand.to_toml()) == by_hand


def test_what_is_not_given_is_not_written() -> None:
    assert walk().links == LinksSpec()
    assert "links" not in walk().to_toml()
    assert "faults" not in walk().to_toml()


def test_paths_are_the_scenarios(tmp_path: Path) -> None:
    scenario = Scenario.from_toml(walk(**EVERYTHING).to_toml(), directory=tmp_path)
    anchored = scenario.anchored()
    assert f'trace = "{tmp_path}/rtt.csv"' in anchored.to_toml()
    assert 'trace = "/data/rtt.txt"' in anchored.to_toml()
    assert anchored.fingerprint == scenario.fingerprint
    recorded = Scenario.from_toml(walk(links={"recorded": {"recording": "x.mcap"}}).to_toml(), directory=tmp_path)
    assert recorded.anchored().links.recorded.recording == f"{tmp_path}/x.mcap"


@pytest.mark.parametrize(
    "changes",
    [
        {"links": {"loss": 0.1}},
        {"links": {"delay": 0.1}},
        {"links": {"edges": [{"from": 10, "loss": 0.0}]}},
        {"links": {"reorder": True}},
        {"links": {"topology": {"modes": [{"edges": []}], "schedule": [{"step": 1, "mode": 0}]}}},
        {"faults": [{"kind": "kill", "node": 10, "step": 3}]},
    ],
)
def test_what_happens_on_the_way_is_in_the_fingerprint(changes: dict[str, Any]) -> None:
    assert walk(**changes).fingerprint != walk().fingerprint


def test_how_it_is_written_is_not_in_the_fingerprint() -> None:
    assert walk(links={}, faults=[]).fingerprint == walk().fingerprint
    assert walk(links={"loss": 0.0, "delay": 0}).fingerprint == walk().fingerprint
    one, two = ({"edges": [{"from": ends, "loss": 0.5}]} for ends in (10, [10]))
    assert walk(links=one).fingerprint == walk(links=two).fingerprint


# --- in the place of what the scenario says ---


def test_a_file_of_links_stands_in_the_place_of_the_scenarios(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    file = tmp_path / "deep" / "links.toml"
    file.write_text('[links]\ndelay = { trace = "rtt.txt" }\n')
    scenario = walk(**EVERYTHING).with_overrides(links=file)
    assert scenario.links == LinksSpec.model_validate({"delay": {"trace": str(tmp_path / "deep" / "rtt.txt")}})
    assert scenario.faults == walk(**EVERYTHING).faults
    file.write_text('[[faults]]\nkind = "kill"\nnode = 10\nstep = 2\n')
    other = walk(**EVERYTHING).with_overrides(links=file)
    assert other.links == walk(**EVERYTHING).links
    assert other.faults == (KillFault(node=10, step=2),)


def test_the_loss_of_the_links_alone() -> None:
    scenario = walk(**EVERYTHING).with_overrides(loss=0.25)
    assert scenario.links.loss == 0.25
    assert scenario.links.delay == walk(**EVERYTHING).links.delay
    assert load_scenario(EXAMPLE, loss=0.5).links == LinksSpec(loss=0.5)


def test_a_loss_beside_links_that_are_none(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text("links = 5\n" + EXAMPLE.read_text())
    with pytest.raises(ScenarioError, match="links: expected a table"):
        load_scenario(file, loss=0.1)


def test_a_file_of_links_and_a_loss(tmp_path: Path) -> None:
    file = tmp_path / "links.toml"
    file.write_text("[links]\nloss = 0.5\ndelay = { distribution = 'exponential', mean = 0.1 }\n")
    assert walk().with_overrides(links=file, loss=0.1).links == LinksSpec(loss=0.1, delay=ExponentialDelay(mean=0.1))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[links\n", "links.toml: line 1, column 7: expected valid TOML"),
        ("[link]\nloss = 0.1\n", "links.toml: link: unknown key; did you mean 'links'?"),
        ("[links]\nloss = 2.0\n", "links.toml: links.loss: expected a number <= 1 (is 2.0)"),
        ("[[links.edges]]\nfrom = 99\nloss = 0.1\n", "four_sensor.toml with "),
        ("[[faults]]\nkind = 'kil'\n", "links.toml: faults[0].kind: expected one of 'kill', 'stop', 'slow', 'clock'"),
    ],
)
def test_what_is_wrong_with_a_file_of_links(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "links.toml"
    file.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(EXAMPLE, links=file)
    assert expected in str(caught.value)
    with pytest.raises(ScenarioError, match="expected a file of links that can be read: No such file"):
        load_scenario(EXAMPLE, links=tmp_path / "nowhere.toml")


# --- what is wrong ---


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ({"delay": -0.1}, "links.delay: expected a number >= 0 (is -0.1)"),
        ({"delay": "fast"}, "links.delay: expected seconds, or a table with one of distribution, mixture and trace"),
        ({"delay": True}, "links.delay: expected seconds, or a table with one of distribution, mixture and trace"),
        ({"delay": {"distribution": "cauchy"}}, "links.delay.distribution: expected one of 'uniform', 'normal'"),
        ({"delay": {"distribution": "uniform", "low": 2, "high": 1}}, "links.delay.high: expected a number >= low, 2"),
        (
            {"delay": {"distribution": "normal", "mean": 0.1, "sd": -1}},
            "links.delay.sd: expected a number >= 0 (is -1)",
        ),
        (
            {"delay": {"distribution": "gamma", "shape": 0, "scale": 1}},
            "links.delay.shape: expected a number > 0 (is 0)",
        ),
        ({"delay": {"distribution": "exponential", "rate": 1.0}}, "links.delay.rate: unknown key; expected one of"),
        ({"delay": {"mixture": []}}, "links.delay.mixture: expected at least 1 item(s) (is [])"),
        (
            {"delay": {"mixture": [{"weight": 0, "delay": 0.1}]}},
            "links.delay.mixture[0].weight: expected a number > 0 (is 0)",
        ),
        (
            {"delay": {"mixture": [{"weight": 1, "delay": {"mixture": [{"weight": 1, "delay": 0.1}]}}]}},
            "links.delay.mixture[0].delay: expected seconds, or a table with one of distribution and trace",
        ),
        ({"delay": {"trace": "x", "order": "sorted"}}, "links.delay.order: expected 'random' or 'as_recorded'"),
        ({"loss": 1.1}, "links.loss: expected a number <= 1 (is 1.1)"),
        ({"loss": float("nan")}, "links.loss: expected a number"),
        (
            {"loss": {"gilbert_elliott": {"to_bad": 0, "to_good": 0}}},
            "links.loss.gilbert_elliott: expected to_bad or to_good > 0",
        ),
        ({"duplicate": 2}, "links.duplicate: expected a number <= 1 (is 2)"),
        ({"bandwidth": {"rate_bps": 0}}, "links.bandwidth.rate_bps: expected a number > 0 (is 0)"),
        ({"bandwidth": {"rate_bps": 1, "queue": -1}}, "links.bandwidth.queue: expected a number >= 0 (is -1)"),
        ({"edges": [{"from": 10}]}, "links.edges[0]: expected one or more of delay, loss"),
        ({"edges": [{"from": [], "loss": 0.1}]}, "links.edges[0].from: expected at least 1 item(s) (is [])"),
        ({"edges": [{"from": 11, "loss": 0.1}]}, "links.edges[0].from: expected the id of a sensor (is 11)"),
        ({"edges": [{"from": 10, "to": 30, "loss": 0.1}]}, "links.edges[0]: expected ends of an edge of the network"),
        ({"recorded": {"recording": "x.mcap"}, "loss": 0.1}, "links: expected either recorded or loss, not both"),
        ({"topology": {"modes": [{"generator": "ring"}]}}, "links.topology: expected either schedule or markov"),
        (
            {"topology": {"modes": [{"generator": "complete"}], "schedule": [{"step": 1, "mode": 0}]}},
            "links.topology.modes[0]: expected a sub-graph of the network, which does not have the edge (is [30, 10])",
        ),
        (
            {"topology": {"modes": [{"edges": [[10, 11]]}], "schedule": [{"step": 1, "mode": 0}]}},
            "links.topology.modes[0].edges[0]: there is no node 11 (is [10, 11])",
        ),
        (
            {"topology": {"modes": [{"edges": []}], "schedule": [{"step": 2, "mode": 1}]}},
            "links.topology.schedule[0].mode: expected the number of a mode, 0 to 0 (is 1)",
        ),
        (
            {"topology": {"modes": [{"edges": []}], "schedule": [{"step": 1, "mode": 0}, {"step": 1, "mode": 0}]}},
            "links.topology.schedule[1].step: expected a step after 1 (is 1)",
        ),
        (
            {"topology": {"modes": [{"edges": []}], "markov": {"transition": [[0.5]], "initial": [1]}}},
            "links.topology.markov.transition[0]: expected probabilities that add up to 1 (is [0.5])",
        ),
        (
            {"topology": {"modes": [{"edges": []}], "markov": {"transition": [[1]], "initial": [1, 0]}}},
            "links.topology.markov.initial: expected 1 probabilities, one a mode (is [1.0, 0.0])",
        ),
    ],
)
def test_links_that_cannot_be(links: dict[str, Any], expected: str) -> None:
    assert any(problem.startswith(expected) for problem in said(links=links)), said(links=links)


@pytest.mark.parametrize(
    ("faults", "expected"),
    [
        ([{"kind": "kill", "node": 11, "step": 1}], "faults[0].node: expected the id of a sensor (is 11)"),
        ([{"kind": "kill", "node": 10}], "faults[0]: expected either step or at_s"),
        ([{"kind": "kill", "node": 10, "step": 0}], "faults[0].step: expected a number >= 1 (is 0)"),
        ([{"kind": "stop", "node": 10, "step": 1}], "faults[0]: expected steps or for_s"),
        ([{"kind": "slow", "node": 10, "step": 1}], "faults[0].delay_s: required"),
        (
            [{"kind": "cut", "from": 10, "step": 1, "steps": 1, "for_s": 1.0}],
            "faults[0]: expected either steps or for_s",
        ),
        ([{"kind": "cut", "from": 10, "to": 40, "step": 1}], "faults[0]: expected ends of an edge of the network"),
        (
            [{"kind": "partition", "groups": [[10, 20], [20]], "step": 1}],
            "faults[0].groups[1]: expected each node in one group only (is 20)",
        ),
        (
            [{"kind": "partition", "groups": [[10, 20, 30, 40, 50]], "step": 1}],
            "faults[0].groups: expected another group, or nodes in none",
        ),
        (
            [{"kind": "kill", "node": 10, "step": 8}, {"kind": "kill", "node": 10, "step": 5, "restart_after": 4}],
            "faults[0]: expected a kill of node 10 after the one before, which lasts until step 9 (is 8)",
        ),
        (
            [{"kind": "kill", "node": 10, "step": 8}, {"kind": "kill", "node": 10, "step": 9}],
            "faults[1]: expected a kill of node 10 after the one before, which lasts for ever (is 9)",
        ),
    ],
)
def test_faults_that_cannot_be(faults: list[dict[str, Any]], expected: str) -> None:
    assert any(problem.startswith(expected) for problem in said(faults=faults)), said(faults=faults)


def test_free_running_steps_have_no_times() -> None:
    faults = [{"kind": "stop", "node": 10, "at_s": 1.0, "for_s": 1.0}]
    assert said(faults=faults, timing={"free_run": True}) == [
        "faults[0].at_s: expected steps: free-running ones have no times (is 1.0)",
        "faults[0].for_s: expected steps: free-running ones have no times (is 1.0)",
    ]
    with pytest.raises(ScenarioError, match="free-running"):
        walk(faults=faults).with_overrides(free_run=True)


def test_all_that_is_wrong_is_said_at_once() -> None:
    found = said(
        links={"loss": 2, "edges": [{"from": 10, "dealy": 1}]},
        faults=[{"kind": "kill", "node": 11, "step": 1}],
        steps=0,
    )
    assert [problem.partition(":")[0] for problem in found] == [
        "steps",
        "links.loss",
        "links.edges[0].dealy",
        "faults[0].node",
    ]


# --- the examples ---


@pytest.mark.parametrize("path", sorted((EXAMPLE.parent / "links").glob("*.toml")), ids=lambda path: path.stem)
def test_the_examples_are_legal_and_do_something(path: Path) -> None:
    scenario = load_scenario(EXAMPLE, links=path)
    assert scenario.fingerprint != load_scenario(EXAMPLE).fingerprint
    assert not Timeline(scenario).beyond(scenario.steps)
    reports = simulate(scenario.with_overrides(steps=30), run="r")
    assert sum(report.completed for lives in reports.values() for report in lives) > 0.7 * 4 * 30
