"""The method `consensus` at its nodes: the reference table, invariants, limits, losses, what it tells and refuses."""

from __future__ import annotations

import tomllib
from pathlib import Path
from random import Random
from typing import Any, cast

import numpy as np
import pytest
from rich.console import Console

from white_networks import Lost, Swarm, sampled, textbook, white_system
from zfusion.drivers.simulated import Simulation, simulate
from zfusion.drivers.sources import open_sources
from zfusion.errors import InputError
from zfusion.methods import METHODS
from zfusion.methods.consensus.forecast import observed_of
from zfusion.methods.consensus.method import Consensus, ConsensusOptions
from zfusion.methods.consensus.mixing import Mixing
from zfusion.methods.consensus.prediction import alone, error_covariances, tuned_step
from zfusion.methods.packing import unpacked
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.report.summary import show_summary, summarize
from zfusion.stages import Message

EXAMPLE = Path(__file__).parents[1] / "examples" / "consensus.toml"
A, WP = np.array([[0.95, 0.10], [-0.10, 0.95]]), 0.1 * np.eye(2)
Q = [(0.5 + 0.25 * i) * np.array([[1, 0.1 * i], [0.1 * i, 1.2]]) for i in range(5)]
GRAPH = Network.from_edges(range(5), [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)], undirected=True)
BACK = np.linalg.inv(A)
BEFORE = BACK @ (np.eye(2) - WP) @ BACK.T
"""The covariance of the state a step before it is the unit matrix."""


def example(R: Any = None) -> System:
    return white_system(A, WP, [np.eye(2)] * 5, Q if R is None else R, P0=BEFORE)


def data(steps: int) -> list[dict[NodeId, Array | None]]:
    t = np.arange(steps)
    return [{i: np.array([np.sin(0.2 * k + i), np.cos(0.3 * k - 0.5 * i)]) for i in range(5)} for k in t]


TABLE = {
    0: {
        "x": ([0.2946308741, 0.7839154297], [0.1388800716, 0.4941477047]),
        "M": ([1.3580576542, -0.1205940131, 1.1317147118], [1.1680085230, -0.1606586414, 0.9733404358]),
        "s": ([0.2363194933, 0.6100511908], [0.1534466705, 0.4421566175]),
        "central": [0.2697537164, 0.5018623255],
        "P": (0.2805133924, 0.3218265143, 0.3132122525),
    },
    1: {
        "x": ([0.3742440190, 0.7245766061], [0.2204345555, 0.6968293328]),
        "M": ([1.2445905549, -0.1430120281, 1.0371587958], [1.1952548585, -0.1536975682, 0.9960457155]),
        "s": ([0.3405557366, 0.6614740134], [0.2375668726, 0.5910999412]),
        "central": [0.3217044407, 0.6175488727],
        "P": (0.2005126334, 0.2129212486, 0.2105944116),
    },
    2: {
        "x": ([0.3758161123, 0.7331002244], [0.2435729077, 0.7953222536]),
        "M": ([1.2146934027, -0.1489958848, 1.0122445022], [1.2005944561, -0.1520631064, 1.0004953801]),
        "s": ([0.3940226247, 0.6877982316], [0.2919478101, 0.6888623416]),
        "central": [0.3459658375, 0.6931380479],
        "P": (0.1873415546, 0.1913256884, 0.1906262877),
    },
    5: {
        "x": ([0.2705743187, 0.5093859874], [0.2111233125, 0.6434140918]),
        "M": ([1.2029197698, -0.1513575206, 1.0024331415], [1.2025737837, -0.1514328476, 1.0021448197]),
        "s": ([0.3672741201, 0.5693621332], [0.3216864404, 0.6772448390]),
        "central": [0.3204783108, 0.6494003824],
        "P": (0.1846899518, 0.1848127221, 0.1847931622),
    },
    10: {
        "x": ([0.0045354151, -0.4238083975], [0.0982951524, -0.4153383917]),
        "M": ([1.2026238592, -0.1514168928, 1.0021865493], [1.2026231386, -0.1514170497, 1.0021859488]),
        "s": ([0.0273150982, -0.2449314750], [0.0971131749, -0.2017536085]),
        "central": [0.0495500914, -0.2191070887],
        "P": (0.1847126035, 0.1847128986, 0.1847128542),
    },
    30: {
        "x": ([0.2993086996, -0.3921346026], [0.1740367789, -0.3205192089]),
        "M": ([1.2026232416, -0.1514170167, 1.0021860346], [1.2026232416, -0.1514170167, 1.0021860346]),
        "s": ([0.1667161935, -0.1919809636], [0.0895368790, -0.1073722738]),
        "central": [0.1246372657, -0.1428421429],
        "P": (0.1847127903, 0.1847127903, 0.1847127903),
    },
}


def shares(swarm: Swarm) -> Array:
    """What every node has of x and M, (N, nx + nxx)."""
    return np.array([node._share for node in swarm.nodes.values()])


def test_the_reference_table() -> None:
    swarm, readings = Swarm("consensus", example(), GRAPH, {"rounds": 2, "step_size": "fastest"}), data(31)
    central = textbook(swarm.system, readings, range(5))
    for t, ys in enumerate(readings):
        told, mixed = swarm.take(ys), shares(swarm)
        if t in TABLE:
            wanted: dict[str, Any] = TABLE[t]
            for place, i in enumerate((0, 3)):
                np.testing.assert_allclose(mixed[i, :2], wanted["x"][place], atol=1.1e-10)
                np.testing.assert_allclose(mixed[i, 2:], wanted["M"][place], atol=1.1e-10)
                np.testing.assert_allclose(told[i].x, wanted["s"][place], atol=1.1e-10)
                assert told[i].P.trace() == pytest.approx(wanted["P"][place], abs=1.1e-10)
            np.testing.assert_allclose(central[t][0], wanted["central"], atol=1.1e-10)
            assert central[t][1].trace() == pytest.approx(wanted["P"][2], abs=1.1e-10)
    assert not any(outcome.incidents for outcome in told.values())


def test_the_reference_as_a_scenario_is_the_same_system() -> None:
    scenario = load_scenario(EXAMPLE)
    system, observed = scenario.system(), observed_of(scenario.system())
    np.testing.assert_allclose(observed.A, A)
    np.testing.assert_allclose(observed.Q, Q)
    np.testing.assert_allclose(A @ system.initial_covariance @ A.T + WP, np.eye(2), atol=1e-12)
    assert scenario.network == GRAPH
    told = METHODS["consensus"].choose(scenario.method.options).options.mixing(GRAPH, system)
    traces = np.trace(error_covariances(observed, told), axis1=1, axis2=2)
    np.testing.assert_allclose(
        traces, [0.2113210755, 0.2037407776, 0.2049487413, 0.2013063635, 0.2064041732], atol=1e-10
    )


def varying(steps: int, seed: int = 1) -> System:
    """Every node's noise is another one at every step."""
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.3, 3.0, (5, steps))
    return example([[scale * q for scale in row] for row, q in zip(scales, Q, strict=True)])


def test_sums_are_kept_whatever_varies() -> None:
    system = varying(20)
    swarm = Swarm("consensus", system, GRAPH, {"rounds": 3, "step_size": "fastest"})
    for k, ys in enumerate(data(20), start=1):
        swarm.take(ys)
        wanted = np.zeros(5)
        for i in range(5):
            U, y = np.linalg.inv(system.noise.covariances(k, (i,)).R), ys[i]
            assert y is not None
            wanted += [*(U @ y), U[0, 0], U[1, 0], U[1, 1]]
        np.testing.assert_allclose(shares(swarm).sum(axis=0), wanted, atol=1e-12)


def differences(system: System, options: dict[str, Any], readings: Any) -> tuple[float, float]:
    """Largest difference of any node's x and P from those of the filter that has everything."""
    told = Swarm("consensus", system, GRAPH, options).run(readings)
    central = textbook(system, readings, range(5))
    pairs = [(one[i], both) for one, both in zip(told, central, strict=True) for i in range(5)]
    return (
        max(float(np.abs(one.x - x).max()) for one, (x, _) in pairs),
        max(float(np.abs(one.P - P).max()) for one, (_, P) in pairs),
    )


@pytest.mark.parametrize("chebyshev", [False, True])
def test_many_rounds_are_the_centralised_filter_though_noises_vary(chebyshev: bool) -> None:
    """Less than 6e-2 with 5 rounds, 3e-3 with 10, 6e-6 with 20, and 5e-14 with 50, where noises vary otherwise."""
    system, readings = varying(20), data(20)
    found = {}
    for rounds in (20,) if chebyshev else (1, 5, 10, 20, 50):
        options = {"rounds": rounds, "step_size": "fastest", "chebyshev": chebyshev}
        found[rounds] = differences(system, options, readings)[0]
    if chebyshev:
        assert found[20] < 1e-7
        return
    assert found[1] > 0.1
    for rounds, limit in ((5, 0.3), (10, 0.02), (20, 5e-5), (50, 1e-12)):
        assert found[rounds] < limit
    assert (found[20] / found[10]) ** 0.1 == pytest.approx(0.5393446629, rel=0.05)


def test_nodes_that_measure_different_things_share_their_information() -> None:
    """No node sees the whole state, and M is singular at first: as with 5 other sensors, .96, 7e-2, 7e-6, 6e-14."""
    rng = np.random.default_rng(3)
    H = [rng.standard_normal((1, 2)) for _ in range(5)]
    system = white_system(A, WP, H, [0.5 + 0.25 * i for i in range(5)], P0=BEFORE)
    _, readings = sampled(system, 40, 5)
    found = [differences(system, {"rounds": n, "step_size": "fastest"}, readings) for n in (1, 5, 20, 50)]
    assert found[0][0] > 0.1
    for (x, P), limit in zip(found[1:], (0.3, 1e-4, 1e-11), strict=True):
        assert x < limit
        assert limit > P


def test_a_sensor_without_a_reading_has_no_say() -> None:
    readings = data(30)
    for k, ys in enumerate(readings):
        ys[k % 5] = None
    readings[7] = dict.fromkeys(range(5))
    x, P = differences(example(), {"rounds": 50, "step_size": "fastest"}, readings)
    assert x < 1e-9
    assert P < 1e-9


def losing(probability: float, *, both: bool) -> Lost:
    """Losses by edge, step and stage; `both` ways together, or each for itself."""

    def lost(stage: int, step: int, sender: NodeId, receiver: NodeId) -> bool:
        edge = tuple(sorted((sender, receiver), key=str)) if both else (sender, receiver)
        return step <= 40 and Random(repr((edge, stage, step))).random() < probability

    return lost


def test_one_way_losses_bias_for_good_and_losses_both_ways_do_not() -> None:
    """With constant readings the filters end where the centralised one does, or do not."""
    readings = [{i: np.array([1.0 + i, -1.0]) for i in range(5)}] * 160
    system = example()
    wanted = textbook(system, readings, range(5))[-1][0]
    total = sum(np.linalg.inv(q) @ readings[0][i] for i, q in enumerate(Q))
    found = {}
    for both in (False, True):
        swarm = Swarm("consensus", system, GRAPH, {"rounds": 2})
        last = swarm.run(readings, losing(0.1, both=both))[-1]
        sums = shares(swarm).sum(axis=0)[:2]
        found[both] = max(float(np.abs(told.x - wanted).max()) for told in last.values())
        assert bool(np.abs(sums - total).max() < 1e-10) == both
        assert len({tuple(np.round(told.x, 9)) for told in last.values()}) == 1  # they agree, on the wrong thing too
    assert found[True] < 1e-9
    assert found[False] > 1e-3


def test_a_step_without_update_is_a_prediction_and_is_told() -> None:
    """Star of ten, one round, the fastest step: M is indefinite in turn with what is definite."""
    star = Network.star(range(10))
    R = [0.05, *[1.0] * 9]
    system = white_system(0.9, 0.1, [1.0] * 10, R, P0=[[1.0]])
    swarm = Swarm("consensus", system, star, {"rounds": 1, "step_size": "fastest"})
    readings = [{i: np.array([1.0]) for i in range(10)}] * 60
    least, without = [], []
    for ys in readings:
        before = {i: (node._s, node._P) for i, node in swarm.nodes.items()}
        told = swarm.take(ys)
        M = shares(swarm)[:, 1]
        least.append(float(M.min()))
        for i, outcome in told.items():
            assert outcome.incidents == (() if M[i] >= 0 else ("without_update",))
            if outcome.incidents:
                x, P = before[i]
                np.testing.assert_allclose(outcome.x, 0.9 * x)
                np.testing.assert_allclose(outcome.P, 0.81 * P + 0.1)
        without.append(sum(bool(outcome.incidents) for outcome in told.values()))
    np.testing.assert_allclose(least[:7], [-11.1, 1.63, -6.5, 2.0, -3.4, 2.3, -1.3], atol=0.06)
    assert least[-1] == pytest.approx(2.9, abs=0.01)
    assert without[0] > 0
    assert not any(without[20:])


def test_steps_without_update_reach_the_summary(capsys: pytest.CaptureFixture[str]) -> None:
    document = tomllib.loads(EXAMPLE.read_text())
    document["network"] = {"generator": "star"}
    document["sensors"][0]["R"] = [[0.02, 0], [0, 0.02]]
    document["method"]["options"]["rounds"] = 1
    document["steps"] = 12
    scenario = Scenario.model_validate(document)
    summary = summarize("r", scenario, simulate(scenario, run="r"), None, simulated=True)
    assert list(summary["incidents"]) == ["without_update"]
    assert summary["incidents"]["without_update"] > 0
    show_summary(Console(width=200), summary)
    assert f"{summary['incidents']['without_update']} without update" in capsys.readouterr().out
    assert not summarize("r", scenario, simulate(load_scenario(EXAMPLE, steps=12), run="r"), None)["incidents"]


def squared(told: list[dict[NodeId, Any]], states: Array) -> Array:
    """Squared errors, (steps, N)."""
    return np.array([[((x - one[i].x) ** 2).sum() for i in range(5)] for x, one in zip(states, told, strict=True)])


def assert_mean(squares: Array, wanted: Array) -> None:
    """Means of stretches of 80 steps, each far longer than errors remember: 6 standard errors of their mean."""
    stretches = squares[-(len(squares) // 80 * 80) :].reshape(-1, 80, 5).mean(axis=1)
    deviation = stretches.std(axis=0, ddof=1) / np.sqrt(len(stretches))
    assert (np.abs(stretches.mean(axis=0) - wanted) < 6 * deviation).all()
    assert (deviation < 0.05 * wanted).all()


def test_errors_are_those_that_are_predicted() -> None:
    options = {"rounds": 1}
    mixing = METHODS["consensus"].choose(options).options.mixing(GRAPH, example())
    wanted = np.trace(error_covariances(observed_of(example()), mixing), axis1=1, axis2=2)
    states, readings = sampled(example(), 1640, 2)
    told = Swarm("consensus", example(), GRAPH, options).run(readings)
    assert_mean(squared(told, states), wanted)
    believed = np.array([told[-1][i].P.trace() for i in range(5)])
    np.testing.assert_allclose(believed, 0.1847127903, rtol=1e-9)  # the filter with all measurements, and no more
    assert (believed < 0.9 * wanted).all()


def test_errors_in_the_simulator_are_those_that_are_predicted() -> None:
    scenario, truth = load_scenario(EXAMPLE, steps=1640), {}
    found: dict[NodeId, list[Array]] = {i: [] for i in range(5)}

    def observe(message: Message, _: int) -> None:
        if message.stage == "estimate":
            found[message.node].append(cast(Array, message.fields["x"]))

    simulation = Simulation(scenario, observe=observe)
    simulation.run()
    source = open_sources(scenario, scenario.ids)[0]
    for k in range(1, 1641):
        source.read(k, 0)
        truth[k] = source.truth(k)
    states = np.array([truth[k] for k in range(1, 1641)])
    squares = np.array([((states - np.array(found[i])) ** 2).sum(axis=1) for i in range(5)]).T
    assert_mean(squares, np.array([0.2113210755, 0.2037407776, 0.2049487413, 0.2013063635, 0.2064041732]))


def test_a_tuned_step_is_the_best_of_all() -> None:
    for rounds in (1, 2, 3):
        options = ConsensusOptions(rounds, "tuned")
        mixing, observed = options.mixing(GRAPH, example()), observed_of(example())

        def cost(step: float, rounds: int = rounds, of: Any = observed, spectrum: Any = mixing.spectrum) -> float:
            return float(np.trace(error_covariances(of, Mixing(spectrum, rounds, step)), axis1=1, axis2=2).mean())

        best = cost(mixing.gamma)
        everywhere = np.linspace(0.002, 0.998, 150) * mixing.spectrum.largest_step
        assert best <= min(map(cost, everywhere)) * (1 + 1e-9)
        assert best < min(cost(mixing.spectrum.fastest_step), cost(1 / mixing.spectrum.values[-1]))
        single = np.trace(alone(observed), axis1=1, axis2=2).mean()
        assert best < single
    assert mixing.gamma == float(f"{tuned_step(observed, mixing.spectrum, 3):.12g}")


def test_larger_rings_tuned_are_as_good_as_is_known() -> None:
    """Ring of 20: 1.28, 1.52 and 1.58 / λ_N, with the losses 6.65, 4.50, 3.56; noises drawn otherwise here."""
    q = np.random.default_rng(3).uniform(0.5, 4.0, 20)
    system = white_system(A, WP, [np.eye(2)] * 20, [x * np.eye(2) for x in q])
    ring, observed = Network.ring(range(20)), observed_of(system)
    best = np.trace(observed.centralised[1])
    for rounds, scale, loss in ((2, 1.52, 4.50), (3, 1.58, 3.56)):
        mixing = ConsensusOptions(rounds, "tuned").mixing(ring, system)
        assert mixing.gamma * 4 == pytest.approx(scale, rel=0.1)
        found = np.trace(error_covariances(observed, mixing), axis1=1, axis2=2).mean() / best
        assert found == pytest.approx(loss, rel=0.35)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rounds": 0}, "rounds: expected a whole number from 1 to 64"),
        ({"rounds": 2.0}, "rounds: expected a whole number"),
        ({"step_size": 0.44}, r"step_size: expected 0 < step size < 2 / λ_N = 0\.4330847293"),
        ({"step_size": -0.1}, "step_size: expected a number > 0, or one of fastest, careful, tuned"),
        ({"step_size": "quick"}, "step_size: expected a number > 0"),
        ({"step_size": True}, "step_size: expected a number > 0"),
        ({"step_size": 0.3, "chebyshev": True}, "step_size: expected none: Chebyshev"),
        ({"chebyshev": 1}, "chebyshev: expected true or false"),
        ({"round": 2}, "expected an option of consensus: rounds, step_size, chebyshev"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ModelError, match=said):
        Swarm("consensus", example(), GRAPH, options)


def test_networks_and_systems_that_it_cannot_stand() -> None:
    def refused(said: str, system: System, graph: Network, **options: Any) -> None:
        with pytest.raises(InputError, match=said):
            Swarm("consensus", system, graph, options)

    refused("directed graph not supported: weight 1->0", example(), Network.from_edges(range(5), [(1, 0)]))
    refused("one component .*3 components", example(), Network.from_edges(range(5), [(0, 1), (2, 3)], undirected=True))
    silent = white_system(A, WP, [np.eye(2)] * 5, [*Q[:4], np.zeros((2, 2))])
    refused("noise of sensor 4, step 1: .* positive definite", silent, GRAPH)
    later = white_system(A, WP, [np.eye(2)] * 5, [*Q[:4], [Q[4], Q[4], np.diag([1.0, 0.0])]])
    refused("noise of sensor 4, step 3: .* positive definite", later, GRAPH)
    lagging = white_system([[1, 1], [0, 1]], WP, [np.eye(2)] * 5, Q)
    refused("no errors are predicted: .* lag without bound", lagging, GRAPH, step_size="tuned")
    refused("no errors are predicted: .* vary with time", varying(4), GRAPH, step_size="tuned")
    Swarm("consensus", lagging, GRAPH)


def test_a_certain_prior_and_a_noise_in_one_component_are_legal() -> None:
    """P is singular: nothing but information is ever inverted."""
    system = white_system([[1, 0.1], [0, 1]], np.diag([0.0, 0.1]), [np.eye(2)] * 5, Q, mean=[1, 2], P0=np.zeros((2, 2)))
    _, readings = sampled(system, 20, 1)
    told = Swarm("consensus", system, GRAPH, {"rounds": 40, "step_size": "fastest"}).run(readings)
    for one, (x, P) in zip(told, textbook(system, readings, range(5)), strict=True):
        np.testing.assert_allclose(one[3].x, x, atol=1e-9)
        np.testing.assert_allclose(one[3].P, P, atol=1e-9)


def test_what_a_message_carries() -> None:
    node = Swarm("consensus", example(), GRAPH, {"rounds": 3}).nodes[0]
    assert isinstance(node, Consensus)
    assert [stage.name for stage in node.stages] == ["measurement", "mix2", "mix3"]
    fields: Any = node.begin(1, np.array([1.0, 2.0]))
    np.testing.assert_allclose(unpacked(fields["M"]), np.linalg.inv(Q[0]), rtol=1e-14)
    assert (len(fields["x"]), len(fields["M"])) == (2, 3)
