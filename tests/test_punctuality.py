"""How late messages come: formulas beside what the links do, and beside what a recording measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulations import record, walk
from zfusion.links import MeasuredLinks, links_of
from zfusion.links.punctuality import SAMPLES, arrival_probabilities, of_measured, sampled
from zfusion.model.scenario import Scenario
from zfusion.recording import Recording

MOST = 3
TRACE = "0.004\n0.011\n0.03\n0.02\n0.05\n"


def scenario(**links: Any) -> Scenario:
    timing = {"rate_hz": 50.0, "late": "revise", "window": MOST}
    return walk(100, method={"name": "delay_aware", "options": {}}, timing=timing, links=links)


SWITCHING = {
    "modes": [{"edges": []}, {"generator": "ring"}],
    "markov": {"transition": [[0.5, 0.5]] * 2, "initial": [0.5, 0.5]},
}
LAWS: list[Any] = [
    0.03,
    {"distribution": "uniform", "low": 0.0, "high": 0.05},
    {"distribution": "normal", "mean": 0.02, "sd": 0.01, "shift": 0.002},
    {"distribution": "lognormal", "median": 0.02, "sigma": 0.8},
    {"distribution": "exponential", "mean": 0.03},
    {"distribution": "pareto", "minimum": 0.008, "shape": 2.0},
    {"mixture": [{"weight": 3.0, "delay": 0.001}, {"weight": 1.0, "delay": 0.03}], "shift": 0.004},
    {"trace": "delays.txt"},
]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("reorder", [False, True])
def test_formulas_are_the_frequencies_of_the_links(
    law: Any, reorder: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frequencies in 16 stretches of 256 messages each: 6 sigma of the stretches' means."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "delays.txt").write_text(TRACE)
    told = scenario(delay=law, loss=0.2, reorder=reorder)
    link = links_of(told)
    parts = [sampled(told, link, (20, 10), range(1 + 256 * n, 257 + 256 * n), MOST) for n in range(16)]
    found, sigma = np.mean(parts, axis=0), np.std(parts, axis=0, ddof=1) / 4
    exact = np.array(arrival_probabilities(told, 10, MOST)[20])
    assert exact.sum() <= 1 + 1e-12
    assert (np.abs(found - exact) <= 6 * sigma + 2e-3 * (exact > 0)).all()  # a stretch's first steps lack older ones


def test_nothing_is_sampled_where_there_is_a_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zfusion.links.punctuality.links_of", None)
    told = scenario(delay=0.0, loss=0.25)
    assert arrival_probabilities(told, 10, MOST) == dict.fromkeys((20, 50), (0.75, 0.0, 0.0, 0.0))
    late = scenario(delay=0.02 * 1.45, loss=0.25)  # to the nanosecond at the closing of the next step
    assert arrival_probabilities(late, 10, MOST)[20] == (0.0, 0.75, 0.0, 0.0)


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ({"loss": {"gilbert_elliott": {"to_bad": 0.1, "to_good": 0.3}}}, (0.75, 0.0)),
        ({"loss": 0.25, "duplicate": 0.5}, (0.75, 0.0)),
        ({"delay": {"distribution": "gamma", "shape": 1.0, "scale": 0.03}, "reorder": True}, None),
        ({"topology": SWITCHING}, (0.5, 0.0)),
    ],
)
def test_what_has_no_formula_is_sampled(links: Any, expected: tuple[float, ...] | None) -> None:
    """Not with the run's own draws. A binomial's 6 sigma; bursts of 2.5 steps have 5 times the variance."""
    told = scenario(**links)
    found = arrival_probabilities(told, 10, 1)[20]
    if expected is None:  # gamma of shape 1 is exponential
        other = scenario(delay={"distribution": "exponential", "mean": 0.03}, reorder=True)
        expected = arrival_probabilities(other, 10, 1)[20]
    np.testing.assert_allclose(found, expected, atol=6 * np.sqrt(5 * 0.25 / SAMPLES))
    assert found != sampled(told, links_of(told), (20, 10), range(1, SAMPLES + 1), 1)


def test_what_a_recording_measured_is_counted(tmp_path: Path) -> None:
    """Of each message that came, how late it was: the same as from the links that it came by."""
    links: dict[str, Any] = {"delay": {"distribution": "exponential", "mean": 0.02}, "loss": 0.1, "reorder": True}
    told = scenario(**links)
    path = record(tmp_path / "run.mcap", told)
    with Recording.open(path) as recording:
        measured = MeasuredLinks.of(recording)
    edges = [(j, 10) for j in (20, 50)]
    found = of_measured(told, measured, edges, MOST)
    for edge in edges:
        ideal = sampled(told, links_of(told), edge, range(1, 101), MOST)
        np.testing.assert_allclose(found[edge[0]], ideal, atol=0.031)  # what was on its way at the end
        assert sum(found[edge[0]]) > 0.5
    again = scenario(recorded={"recording": str(path)})
    assert arrival_probabilities(again, 10, MOST) == found


def test_nodes_that_wait_take_nothing_late() -> None:
    timing = {"free_run": True, "timeout_s": 0.03}
    told = walk(10, method={"name": "delay_aware"}, timing=timing, links={"delay": 0.02, "loss": 0.1})
    assert arrival_probabilities(told, 10, 0)[20] == pytest.approx((0.9,))
