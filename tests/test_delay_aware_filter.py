"""The method `delay_aware` at its nodes: what it receives, what it predicts, replays, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from typer.testing import CliRunner

from simulations import walk
from zfusion.cli import app
from zfusion.drivers.account import setting_of
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import simulate
from zfusion.drivers.sources import open_sources
from zfusion.errors import InputError
from zfusion.links.punctuality import arrival_probabilities
from zfusion.methods import chosen
from zfusion.methods.check import check_method
from zfusion.methods.convex import DesignError
from zfusion.methods.delay_aware import joint
from zfusion.methods.delay_aware.filter import DELAY_AWARE, DelayAware
from zfusion.methods.delay_aware.mapping import Model, check_noises
from zfusion.methods.delay_aware.options import DelayAwareOptions
from zfusion.methods.protocol import Outcome, Setting
from zfusion.model.checks import ModelError
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.noise import CovarianceNoise
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.types import Array, NodeId
from zfusion.recording import Recording
from zfusion.report.summary import notes_of
from zfusion.stages import ESTIMATE, Message

FOUR = Path(__file__).parents[1] / "examples" / "four_sensor.toml"
STABLE: dict[str, Any] = {
    "F": [[0.7, 0.2], [-0.1, 0.6]],
    "Q": [[0.2, 0.01], [0.01, 0.1]],
    "initial_mean": [3.0, -1.0],
    "initial_covariance": [[2.0, 0.3], [0.3, 1.0]],
}
REVISE = {"rate_hz": 50.0, "late": "revise", "window": 4}
LATE = {"delay": {"distribution": "lognormal", "median": 0.02, "sigma": 0.8}, "loss": 0.1, "reorder": True}


def scenario(steps: int = 60, links: dict[str, Any] | None = None, **options: Any) -> Scenario:
    method = {"name": "delay_aware", "options": options}
    return walk(steps, method=method, timing=REVISE, system=STABLE, links=LATE if links is None else links)


def varied(given: Scenario, **more: Any) -> Scenario:
    return Scenario.model_validate({**given.model_dump(by_alias=True, exclude_unset=True), **more})


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"companion": "augmented"},
        {"companion": "stamped"},
        {"gain": "constant", "filtered": False, "probabilities": [0.2, 0.4, 0.1]},
        {"probabilities": [0.2, 0.0, 0.1], "noise": 0.01},
    ],
)
def test_a_run_with_late_messages_is_replayed_bit_for_bit(options: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    fault = [{"kind": "kill", "node": 20, "step": 20, "restart_after": 3}]
    told = varied(scenario(**options), faults=fault)
    reports = simulate(told, run="r", output=path)
    assert (
        sum(
            edge["revised"].get("measurement", 0)
            for lives in reports.values()
            for r in lives
            for edge in r.edges.values()
        )
        > 20
    )
    with Recording.open(path) as recording:
        verdict = verify(recording)
    assert verdict.verified
    assert verdict.unverifiable == 0
    assert verdict.identical > 250


def estimates(told: Scenario) -> dict[tuple[NodeId, int], Message]:
    """What the nodes of a simulation estimate, by node and step."""
    found: dict[tuple[NodeId, int], Message] = {}

    def observe(message: Message, _: int) -> None:
        if message.stage == ESTIMATE.name:
            found[message.node, message.step] = message

    simulate(told, run="r", observe=observe)
    return found


def test_with_time_stamps_it_is_least_squares_with_all_that_came() -> None:
    """The filter of the complete graph that goes back and forward again has the same estimates, by another route."""
    links = {**LATE, "reorder": False}
    one = scenario(80, links, companion="stamped")
    one = varied(one, network={"generator": "complete"})
    other = varied(one, method="centralized")
    found, expected = estimates(one), estimates(other)
    assert found.keys() == expected.keys()
    for place, message in found.items():
        for name in ("x", "P"):
            np.testing.assert_allclose(message.fields[name], expected[place].fields[name], rtol=0, atol=1e-9)


@pytest.mark.parametrize("companion", ["plain", "augmented"])
@pytest.mark.parametrize("reorder", [False, True])
def test_errors_in_a_swarm_are_those_that_are_predicted(companion: str, reorder: bool) -> None:
    """Probabilities are estimated, packets have one delay each, which the filter takes to be drawn anew at each step.

    Means over stretches of 50 steps, far longer than errors remember: 5 sigma, and 6 % for what it takes them to be.
    """
    links = {**LATE, "reorder": reorder}
    told = scenario(1001, links, companion=companion)
    errors: list[float] = []
    traces: list[float] = []
    truth = open_sources(told, told.ids)[10].truth

    def observe(message: Message, _: int) -> None:
        if message.stage == ESTIMATE.name and message.node == 10 and message.step > 1:
            x, P = cast(Array, message.fields["x"]), cast(Array, message.fields["P"])
            errors.append(float(((cast(Array, truth(message.step)) - x) ** 2).sum()))
            traces.append(float(P.trace()))

    simulate(told, run="r", observe=observe)
    differences = (np.array(errors) - traces).reshape(20, 50).mean(axis=1)
    sigma = differences.std(ddof=1) / np.sqrt(20)
    assert abs(differences.mean()) < 5 * sigma + 0.06 * np.mean(traces)


def node(companion: str = "plain", probabilities: Any = (0.5, 0.3, 0.1), **more: Any) -> DelayAware:
    known = scenario()
    options = DelayAwareOptions(probabilities=probabilities, companion=companion)
    return DelayAware(Setting(10, known.system(), known.network, window=4, options=options, **more))


def said(value: float) -> dict[str, object]:
    return {"y": np.full(1, value)}


def told(method: DelayAware, step: int, *, late: Any = None, now: Any = None, y: Any = 0.3) -> Outcome:
    own = None if y is None else np.full(1, y)
    fields = method.begin(step, own)
    if late:
        method.revise(late)
    outcome = method.advance(0, step, {10: fields, **(now or {})}, None)  # type: ignore[arg-type]
    assert isinstance(outcome, Outcome)
    return outcome


def test_of_several_the_newest_is_received() -> None:
    first, second = node(), node()
    for method in (first, second):
        told(method, 1)
        told(method, 2)
    method = first
    method.begin(3, np.full(1, 0.3))
    taken = method.revise({1: {50: said(7.0)}, 2: {50: said(4.0), 20: {"y": None}}})
    assert taken == {2: (50,)}
    outcome = method.advance(0, 3, {10: said(0.3)}, None)  # type: ignore[arg-type]
    again = told(second, 3, late={2: {50: said(4.0)}})
    np.testing.assert_array_equal(outcome.x, again.x)  # type: ignore[union-attr]
    late, now = told(first, 4, late={3: {50: said(9.0)}}, now={50: said(1.0)}), told(second, 4, now={50: said(1.0)})
    np.testing.assert_array_equal(late.x, now.x)
    assert late.used == (10, 50)


def test_with_stamps_all_that_come_are_received() -> None:
    method, other = node("stamped"), node("stamped")
    for one in (method, other):
        told(one, 1)
        told(one, 2)
    method.begin(3, np.full(1, 0.3))
    assert method.revise({1: {50: said(7.0)}, 2: {50: said(4.0), 20: {"y": np.ones(2)}}}) == {1: (50,), 2: (20, 50)}
    both = method.advance(0, 3, {10: said(0.3)}, None)
    newest = told(other, 3, late={2: {50: said(4.0), 20: {"y": np.ones(2)}}})
    assert both.P.trace() < newest.P.trace()  # type: ignore[union-attr]


@pytest.mark.parametrize("companion", ["plain", "augmented", "stamped"])
def test_what_is_too_old_is_not_taken(companion: str) -> None:
    method = node(companion)
    for step in range(1, 5):
        told(method, step)
    method.begin(5, None)
    assert method.revise({2: {50: said(7.0)}}) == {}


@pytest.mark.parametrize("companion", ["plain", "augmented", "stamped"])
def test_steps_slept_through_are_predictions(companion: str) -> None:
    """Nothing was received, and that is known: as a Kalman filter that predicts."""
    method = node(companion)
    before = told(method, 1)
    method.skip(2)
    method.begin(3, None)
    F, Q = np.array(STABLE["F"]), np.array(STABLE["Q"])
    x, P = method._core.x, method._core.P
    for _ in range(2):
        before = before._replace(x=F @ before.x, P=F @ before.P @ F.T + Q)
    np.testing.assert_allclose(x, before.x, atol=1e-13)
    np.testing.assert_allclose(P, before.P, atol=1e-13)


def test_past_estimates_stand() -> None:
    method = node()
    first = told(method, 1)
    told(method, 2, late={1: {50: said(1.0)}})
    assert method.correct(1, {}) is first


def test_a_sensor_without_a_reading_brings_nothing() -> None:
    """The node knows that it had none, and does not take it for a reading of zero."""
    alone = node(probabilities=(0.0,))
    outcome = told(alone, 1, y=None)
    prior = scenario().system()
    F = np.array(STABLE["F"])
    np.testing.assert_allclose(outcome.x, F @ prior.initial_mean, atol=1e-13)
    assert outcome.used == ()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"probabilities": [0.6, 0.5]}, "probabilities: expected probabilities that add up to 1 or less, not to 1.1"),
        ({"probabilities": [1.5]}, "probabilities: expected probabilities, from 0 to 1"),
        ({"probabilities": []}, "probabilities: expected 1 to 16 probabilities"),
        ({"probabilities": "guessed"}, "probabilities: expected 1 to 16 probabilities"),
        ({"probabilities": {"20": [True]}}, r"probabilities\.20: expected 1 to 16"),
        ({"probabilities": {}}, "probabilities: expected the probabilities of each sender"),
        ({"companion": "other"}, "companion: expected one of plain, augmented, stamped"),
        ({"gain": "fixed"}, "gain: expected one of stepwise, constant"),
        ({"gain": "constant", "companion": "stamped"}, "gain: expected stepwise with companion"),
        ({"delays": 16}, "delays: expected an integer from 0 to 15"),
        ({"delays": 2, "probabilities": [1.0]}, "delays: expected none beside probabilities"),
        ({"noise": -1.0}, "noise: expected a variance"),
        ({"filtered": 1}, "filtered: expected true or false"),
        ({"delay": 1}, "delay: expected an option of delay_aware"),
    ],
)
def test_options_that_cannot_be_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        DELAY_AWARE.choose(options)


@pytest.mark.parametrize(
    ("unfit", "words"),
    [
        (partial(scenario, probabilities=[0.1] * 6), "timing.window: expected late = .*window of 5 at least"),
        (
            partial(varied, scenario(), timing={}, method={"name": "delay_aware", "options": {"delays": 1}}),
            "timing.window",
        ),
        (partial(scenario, probabilities={"20": [1.0]}), "probabilities: expected those of node"),
        (partial(scenario, probabilities={"99": [1.0]}), "probabilities.99: expected the id of a sensor"),
        (
            partial(
                varied,
                scenario(),
                system={**STABLE, "F": [[1.1, 0.0], [0.0, 0.5]]},
                method={"name": "delay_aware", "options": {"gain": "constant"}},
            ),
            r"bounded \(radius 1.21\)",
        ),
        (partial(load_scenario, FOUR, method="delay_aware"), "needs process noise uncorrelated with the measurement"),
    ],
)
def test_scenarios_that_it_cannot_stand_are_refused(unfit: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_method(unfit(), "scenario")


def test_nothing_known_of_the_links_is_refused() -> None:
    with pytest.raises(InputError, match="nothing is known of the links: give probabilities"):
        node(probabilities="estimated")


def test_probabilities_are_each_senders_own() -> None:
    method = node(probabilities={"20": [0.5, 0.2], "50": [0.1]}, born=1)
    rows = method._model.rows
    np.testing.assert_array_equal(method._p[:, rows[10]], [[1.0], [0.0]])
    np.testing.assert_array_equal(method._p[:, rows[20]], [[0.5, 0.5], [0.2, 0.2]])
    np.testing.assert_array_equal(method._p[:, rows[50]], [[0.1], [0.0]])


def test_a_state_that_grows_is_told_in_every_summary() -> None:
    """Where something is random; with the sensors' gains known and time stamps there is nothing to tell."""
    growing = STABLE | {"F": [[1.02, 0.2], [0.0, 0.6]]}
    for options, told in (
        ({"probabilities": [0.6, 0.2, 0.1]}, True),
        ({}, True),
        ({"probabilities": [1.0]}, False),
        ({"companion": "stamped"}, False),
    ):
        given = Scenario.model_validate(
            {**SURE, "system": growing, "method": {"name": "delay_aware", "options": options}}
        )
        warned = [note for note in notes_of(given) if "grows without bound" in note]
        assert bool(warned) == told
        assert all("spectral radius 1.0404, not below 1" in note for note in warned)
        assert notes_of(varied(given, system=STABLE)) == [DELAY_AWARE.note]
    random = scenario()  # of which the sensors' gains are random
    assert len(notes_of(varied(random, system=growing))) == 2
    assert len(notes_of(random)) == 1


SURE: dict[str, Any] = {
    "timing": REVISE,
    "network": {"generator": "ring"},
    "sensors": [{"ids": [1, 2, 3], "H": [[1.0, 0.5]], "R": 0.5}],
}


def test_what_its_predictions_take_for_granted_is_told(tmp_path: Path) -> None:
    """Not that every message is there."""
    given = Scenario.model_validate(
        SURE
        | {"system": STABLE, "links": LATE, "method": {"name": "delay_aware", "options": {"probabilities": [0.6, 0.3]}}}
    )
    (tmp_path / "s.toml").write_text(given.to_toml())
    result = CliRunner().invoke(app, ["design", str(tmp_path / "s.toml"), "--method", "delay_aware", "--json"])
    remarks = json.loads(result.stdout)["remarks"]
    assert any("with delays and losses as the option probabilities says" in remark for remark in remarks)
    assert not any("every message" in remark for remark in remarks)


def test_errors_are_forecast() -> None:
    """The same as the predictions that a node that runs ends with."""
    given = scenario(300, probabilities=[0.5, 0.3, 0.1], filtered=False)
    family = chosen(given).family
    assert family.forecast is not None
    forecast = family.forecast(chosen(given).options, given.system(), given.network)
    last = estimates(given)
    for i, mse, constant in zip(given.ids, forecast.nodes["mse"], forecast.nodes["constant_mse"], strict=True):
        assert cast(Array, last[i, 300].fields["P"]).trace() == pytest.approx(mse, rel=1e-10)
        assert constant <= mse * (1 + 1e-12)
    with pytest.raises(InputError, match="where the probabilities are given"):
        family.forecast(DelayAwareOptions(), given.system(), given.network)


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ({"Q1": Schedule.constant(0.01 * np.eye(2))}, "white noises; these are correlated with themselves"),
        ({"R1": {(10, 20): Schedule.constant(np.full((1, 2), 0.01))}}, "white noises; these are correlated"),
        ({"S0": {10: Schedule.constant(np.full((2, 1), 0.01))}}, "process noise uncorrelated"),
        ({"S1": {10: Schedule((np.zeros((2, 1)), np.full((2, 1), 0.01)))}}, "process noise uncorrelated"),
    ],
)
def test_correlated_noises_are_refused(noise: dict[str, Any], words: str) -> None:
    system = scenario().system()
    own = {(i, i): Schedule.constant(0.3 * np.eye(n)) for i, n in system.noise.sizes.items()}
    made = CovarianceNoise(Schedule.constant(np.array(STABLE["Q"])), own, **noise)
    with pytest.raises(DesignError, match=words):
        check_noises(replace(system, noise=made))


def test_what_varies_has_no_constant_gain() -> None:
    system = scenario().system()
    F = Schedule((Fixed(np.array(STABLE["F"])), Fixed(0.5 * np.eye(2))), 0, "cycle")
    model = Model(replace(system, F=F), (10,))
    with pytest.raises(DesignError, match="needs constant matrices; F varies"):
        model.stationary(np.ones((1, 1)))


@pytest.mark.parametrize("companion", ["plain", "augmented"])
def test_resting_changes_no_estimate(companion: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gains are kept once they have settled; a step without a reading unsettles them."""
    rng = np.random.default_rng(8)
    readings = [None if step in (120, 121, 150) else float(rng.standard_normal()) for step in range(1, 260)]
    heard = [{50: said(float(rng.standard_normal()))} if rng.random() < 0.6 else {} for _ in readings]
    found = {}
    for settled in (joint.SETTLED, -1.0):
        monkeypatch.setattr(joint, "SETTLED", settled)
        method, rested = node(companion), 0
        outcomes = []
        for step, (y, now) in enumerate(zip(readings, heard, strict=True), 1):
            outcomes.append(told(method, step, now=now, y=y))
            rested += cast(Any, method._core)._at_rest
        assert (rested > 60) == (settled > 0)
        found[settled] = outcomes
    for one, other in zip(*found.values(), strict=True):
        np.testing.assert_allclose(one.x, other.x, atol=1e-12)
        np.testing.assert_allclose(one.P, other.P, atol=1e-12)


def test_the_example_reckons_with_its_links() -> None:
    """Of the packets that come the newest: 0.6, 0.4 * 0.25, 0.4 * 0.75 * 0.1, and likewise of the other sensor."""
    example = load_scenario(FOUR.with_name("delay_aware.toml"))
    check_method(example, "example")
    found = arrival_probabilities(example, 3, 2)
    np.testing.assert_allclose(found[1], [0.6, 0.1, 0.03], atol=1e-14)
    np.testing.assert_allclose(found[2], [0.5, 0.15, 0.0525], atol=1e-14)
    method = chosen(example)(setting_of(example, chosen(example).network(example.network), 3, 1))
    assert isinstance(method, DelayAware)
    np.testing.assert_allclose(method._p, [[0.6, 0.5, 0.5, 1.0], [0.1, 0.15, 0.15, 0.0], [0.03, 0.0525, 0.0525, 0.0]])
