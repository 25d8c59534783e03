"""Two configurations on the same measurements, and what may be said of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from oracles import brute_force
from simulations import four_sensor, record, walk
from zfusion.drivers.rerun import on_recording, rerun, with_recorded_links
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError, ScenarioError
from zfusion.methods.prediction import predict
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Overrides, Scenario
from zfusion.recording import Recording
from zfusion.stages import Message
from zfusion.studies.compare import ALL, Comparison, Configuration, compare, compare_recordings
from zfusion.studies.settings import parse_settings, with_settings

STEPS = 12


def configurations(*changes: dict[str, Any], base: Scenario | None = None) -> list[Configuration]:
    base = base or walk(STEPS)
    return [Configuration(str(change), with_settings(base, change, "test")) for change in changes]


def test_mean_squared_errors_are_those_of_the_estimates() -> None:
    """Per node and seed, by hand from the messages of the same simulations."""
    chosen = configurations({"links.loss": 0.4}, {"method": "local"})
    [comparison] = compare(chosen, range(3), "mse")
    for side, configuration in enumerate(chosen):
        found: dict[Any, list[float]] = {i: [] for i in configuration.scenario.ids}
        for seed in range(3):
            scenario = configuration.scenario.with_overrides(seed=seed)
            path = SamplePath(scenario.system(), seed)

            def observe(message: Message, _now: int, path: SamplePath = path, found: Any = found) -> None:
                if message.stage == "estimate":
                    found[message.node].append(float(np.sum((message.fields["x"] - path.truth(message.step)) ** 2)))  # type: ignore[operator]

            Simulation(scenario, observe=observe).run()
        for i, squared in found.items():
            one = comparison.nodes[str(i)]
            assert (one.b if side else one.a) == pytest.approx(np.mean(squared), rel=1e-12)
    assert comparison.nodes[ALL].a == pytest.approx(np.mean([comparison.nodes[str(i)].a for i in walk().ids]))


def test_a_difference_that_theory_knows_is_told_and_lies_in_the_interval() -> None:
    """Isolated nodes against the network: predicted - local, averaged over nodes and steps."""
    chosen = configurations({}, {"method": "local"})
    [comparison] = compare(chosen, range(14), "mse")
    predicted = predict(walk(STEPS).system(), walk(STEPS).network, STEPS)
    more = np.einsum("kmaa->km", predicted.local - predicted.distributed)[1:].mean()
    whole = comparison.nodes[ALL]
    half = whole.mean_high - whole.mean
    assert abs(whole.mean - more) < 2.5 * half  # five standard errors: half is two of them
    assert whole.told_apart
    assert comparison.verdict.startswith("{} is better by ")
    assert "paired t" in comparison.verdict


def test_the_same_configuration_twice_is_the_same() -> None:
    chosen = configurations({"links.loss": 0.3}, {"links.loss": 0.3})
    [comparison] = compare(chosen, range(2), "disagreement")
    assert comparison.verdict.startswith("no difference at all")
    assert comparison.nodes[ALL].a > 0


def test_pairs_do_not_depend_on_the_number_of_processes() -> None:
    chosen = configurations({"links.loss": 0.3}, {"links.loss": 0.3, "timing.late": "wait"})
    one = compare(chosen, range(2), "nees")
    assert one == compare(chosen, range(2), "nees", jobs=2)


def test_several_are_compared_with_the_first() -> None:
    chosen = configurations({}, {"method": "local"}, {"method": "centralized"})
    both = compare(chosen, range(2))
    assert [(one.base, one.other) for one in both] == [
        ("{}", "{'method': 'local'}"),
        ("{}", "{'method': 'centralized'}"),
    ]
    assert both[0].nodes[ALL].a == both[1].nodes[ALL].a
    assert both[1].nodes[ALL].b < both[1].nodes[ALL].a < both[0].nodes[ALL].b


def test_a_nees_is_near_the_dimension_where_all_is_gaussian() -> None:
    """Chi-square of 2, of variance 4, at 12 steps x 10 seeds that hardly depend on each other."""
    [comparison] = compare(configurations({"links.loss": 0.3}, {}), range(10), "nees")
    whole = comparison.nodes[ALL]
    assert abs(whole.a - 2) < 5 * 2 / np.sqrt(120)
    assert abs(whole.b - 2) < 5 * 2 / np.sqrt(120)
    assert "better" not in comparison.verdict


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"steps": 5}, "steps"),
        ({"sensors.0.R": [[9.0]]}, "sensors"),
        ({"system.Q": [[1.0, 0.0], [0.0, 1.0]]}, "system"),
    ],
    ids=str,
)
def test_what_does_not_measure_the_same_is_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        compare(configurations({}, change), range(2))


def test_a_truth_that_is_not_known_is_refused(tmp_path: Path) -> None:
    with Recording.open(record(tmp_path / "r.mcap", walk(6))) as recording:
        chosen = configurations({}, {"links.loss": 0.5}, base=on_recording(recording))
    with pytest.raises(InputError, match="mse: the true state"):
        compare(chosen, range(2))
    assert compare(chosen, range(2), "disagreement")[0].nodes[ALL].n == 2
    with pytest.raises(InputError, match="seeds"):
        compare(chosen, range(1))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording, and what it would have been with a link that loses everything."""
    directory = tmp_path_factory.mktemp("pair")
    first, second = record(directory / "a.mcap", walk(60)), directory / "b.mcap"
    with Recording.open(first) as recording:
        links = {"links.edges": [{"from": 20, "to": 10, "loss": 1.0}, {"from": 50, "to": 10, "loss": 1.0}]}
        rerun(recording, with_settings(walk(60), links, "test"), second)
    return first, second


def test_recordings_of_the_same_measurements(pair: tuple[Path, Path], tmp_path: Path) -> None:
    with Recording.open(pair[0]) as one, Recording.open(pair[1]) as other:
        [comparison] = compare_recordings([one, other], "disagreement")
        [errors] = compare_recordings([one, other], "mse")
    assert (comparison.unit, comparison.nodes[ALL].n) == ("stretch", 12)
    assert errors.nodes["30"].mean == 0.0  # two links away: nothing changes
    assert errors.nodes["10"].above + errors.nodes["10"].below == 12
    assert comparison.nodes["10"].told_apart
    different = record(tmp_path / "c.mcap", walk(60, seed=5))
    with (
        Recording.open(pair[0]) as one,
        Recording.open(different) as other,
        pytest.raises(InputError, match="sensor 10"),
    ):
        compare_recordings([one, other])
    short = record(tmp_path / "d.mcap", walk(9))
    with Recording.open(short) as one, pytest.raises(InputError, match="10 steps or more"):
        compare_recordings([one, one])
    four = record(tmp_path / "e.mcap", four_sensor(9))
    with (
        Recording.open(four) as one,
        Recording.open(short) as other,
        pytest.raises(InputError, match="not the sensors"),
    ):
        compare_recordings([one, other])


def test_a_link_that_had_been_slow_is_what_the_projection_says(tmp_path: Path) -> None:
    """What if 20 -> 10 had had 12 ms: too long for the measurements (9 ms), not for the estimates (18 ms)."""
    scenario, steps = walk(8), 8
    with Recording.open(record(tmp_path / "a.mcap", scenario)) as recording:
        links = {"links.edges": [{"from": 20, "to": 10, "delay": 0.012}]}
        done = rerun(recording, with_settings(scenario, links, "test"), tmp_path / "b.mcap")
    stacked = brute_force.stack(scenario.system(), steps)
    used = brute_force.always(scenario.network.neighbourhoods, steps)
    used |= {(10, k): (10, 50) for k in range(1, steps + 1)}
    heard = brute_force.always(scenario.network.neighbourhoods, steps)
    estimates = {i: brute_force.intermediate(stacked, i, used) for i in scenario.ids}
    path = SamplePath(scenario.system(), scenario.seed)
    Y = stacked.vector({(i, k): path.measurement(i, k) for i in scenario.ids for k in range(1, steps + 1)})
    changes = []
    for i in scenario.ids:
        x = brute_force.fused(stacked, estimates, i, heard).values(stacked, Y)
        error = x[1:] - np.array([path.truth(k) for k in range(1, steps + 1)])
        assert done.changes[i].after["mse"] == pytest.approx(float((error**2).sum(axis=1).mean()), rel=1e-8)
        changes.append(done.changes[i].rms)
    assert changes[0] > 0  # type: ignore[operator]
    assert changes[2] == 0.0  # node 30 hears neither of them


def test_the_measured_latencies_of_a_recording_make_the_same_run_again(tmp_path: Path) -> None:
    slow = walk(20).with_overrides(delay=0.002).with_overrides(loss=0.2)
    with Recording.open(record(tmp_path / "a.mcap", slow)) as recording:
        again = with_recorded_links(walk(20), recording)
        done = rerun(recording, again, tmp_path / "b.mcap")
        other = rerun(recording, Overrides(links=None, loss=0.0, delay=0.0), tmp_path / "c.mcap")
    assert all(change.rms == 0.0 for change in done.changes.values())
    assert all(change.rms != 0.0 for change in other.changes.values())


def test_settings_are_paths_and_values() -> None:
    assert parse_settings(["timing.late = revise", "links.loss=0.5", "network={ generator = 'ring' }"], "--a") == {
        "timing.late": "revise",
        "links.loss": 0.5,
        "network": {"generator": "ring"},
    }
    for wrong in ("late", "=3"):
        with pytest.raises(InputError, match="--a: expected a setting"):
            parse_settings([wrong], "--a")


def test_another_policy_inherits_nothing_that_goes_with_the_first() -> None:
    revising = with_settings(walk(), {"timing.late": "revise", "timing.window": 4}, "test")
    assert with_settings(revising, {"timing.late": "drop"}, "test").timing.window == 8
    fractions = with_settings(walk(), {"timing.deadlines": {"measurement": 0.3}}, "test")
    assert not with_settings(fractions, {"timing.late": "wait"}, "test").timing.deadlines
    with pytest.raises(ScenarioError, match="method"):
        with_settings(walk(), {"method": "magic"}, "somewhere")
    with pytest.raises(ScenarioError, match="somewhere"):
        with_settings(walk(), {"sensors.9.R": 1.0}, "somewhere")


def test_verdicts_are_sentences() -> None:
    from zfusion.studies.paired import paired

    def verdict(a: list[float], b: list[float]) -> str:
        return Comparison("mse", "A", "B", "seed", {ALL: paired(a, b, 0.95)}).verdict

    assert verdict([1.0, 1.0, 1.0], [0.88, 0.87, 0.89]) == (
        "B is better by 12 % (95% CI 9.5..14 %, of the mean over 3 seeds, paired t)"
    )
    assert verdict([1.0, 1.0, 1.0], [1.12, 1.13, 1.11]).startswith("A is better by 12 %")
    assert verdict([1.0, 1.0], [1.1, 0.9]).startswith("no difference can be told: |difference| < ")
    heavy = verdict([1.0] * 5, [2.0, 2.0, 2.0, 2.001, 1e6])
    assert heavy.startswith("no difference can be told (of the median over 5 seeds")
