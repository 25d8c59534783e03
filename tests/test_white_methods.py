"""Diffusion, Kalman consensus, hybrid consensus, covariance intersection: textbook, limits, and how true their P is."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from white_networks import Swarm, random_system, sampled, textbook, white_system
from zfusion.errors import InputError, RunError
from zfusion.methods import METHODS
from zfusion.methods.hybrid import metropolis
from zfusion.methods.intersection import intersection
from zfusion.methods.protocol import Setting
from zfusion.methods.white import White, absorb, inverse, kalman_update
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.types import Array, NodeId

SYSTEM = random_system(1)
IDS = SYSTEM.ids
RING, COMPLETE, ISOLATED = Network.ring(IDS), Network.complete(IDS), Network.isolated(IDS)
READINGS = sampled(SYSTEM, 25, 3)[1]
NAMES = ("diffusion", "kalman_consensus", "hybrid_consensus", "covariance_intersection")


def gappy() -> list[dict[NodeId, Array | None]]:
    return [{i: None if (k + int(i)) % 3 == 0 else y for i, y in ys.items()} for k, ys in enumerate(READINGS)]


def assert_same(told: Any, wanted: Any, tolerance: float = 1e-10) -> None:
    for one, (x, P) in zip(told, wanted, strict=True):
        for outcome in one.values():
            np.testing.assert_allclose(outcome.x, x, rtol=0, atol=tolerance)
            np.testing.assert_allclose(outcome.P, P, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", ["diffusion", "kalman_consensus", "hybrid_consensus"])
def test_on_a_complete_graph_all_are_the_filter_with_all_measurements(name: str) -> None:
    readings = gappy() if name != "hybrid_consensus" else READINGS
    assert_same(Swarm(name, SYSTEM, COMPLETE).run(readings), textbook(SYSTEM, readings, IDS))
    if name == "hybrid_consensus":
        assert_same(Swarm(name, SYSTEM, COMPLETE).run(gappy()), textbook(SYSTEM, gappy(), IDS))


@pytest.mark.parametrize("name", NAMES)
def test_without_links_all_are_the_filter_with_the_own_measurements(name: str) -> None:
    """Each node is a network of its own: so hybrid consensus does not count what others might have measured."""
    swarm = Swarm(name, SYSTEM, ISOLATED)
    for i in IDS:
        swarm.nodes[i] = swarm.method(Setting(i, SYSTEM, Network.isolated([i])))
    told = swarm.run(gappy())
    for i in IDS:
        assert_same([{i: one[i]} for one in told], textbook(SYSTEM, gappy(), [i]))


@pytest.mark.parametrize("graph", [RING, Network.line(IDS)])
def test_hybrid_consensus_with_many_exchanges_is_the_filter_with_all_measurements(graph: Network) -> None:
    wanted = textbook(SYSTEM, gappy(), IDS)
    distance = {}
    for rounds in (1, 4, 16, 64):
        told = Swarm("hybrid_consensus", SYSTEM, graph, {"rounds": rounds}).run(gappy())
        distance[rounds] = max(
            float(np.abs(o.x - x).max()) for one, (x, _) in zip(told, wanted, strict=True) for o in one.values()
        )
    assert distance[1] > distance[4] > distance[16] > distance[64]
    assert distance[64] < 1e-3
    if graph is RING:
        assert distance[64] < 1e-11


def test_metropolis_weights() -> None:
    graph = Network.star(range(5))
    W = np.array([[metropolis(graph, i).get(j, 0.0) for j in range(5)] for i in range(5)])
    assert (W >= 0).all()
    np.testing.assert_allclose(W.sum(axis=0), 1)
    np.testing.assert_allclose(W.sum(axis=1), 1)
    assert W[0, 1] == 1 / 5


def test_diffusion_is_algorithm_1() -> None:
    """Its two lines, written down for all nodes at once."""
    told = Swarm("diffusion", SYSTEM, RING).run(gappy())
    F, Q = SYSTEM.F.at(0).mean, SYSTEM.noise.covariances(0, IDS).Q
    xs, Ps = dict.fromkeys(IDS, SYSTEM.initial_mean), dict.fromkeys(IDS, SYSTEM.initial_covariance)
    for k, ys in enumerate(gappy(), start=1):
        psi = {}
        for i in IDS:
            x, P = F @ xs[i], F @ Ps[i] @ F.T + Q
            for j in RING.neighbours(i):
                y, H, R = ys[j], SYSTEM.by_id[j].H.at(k).mean, SYSTEM.noise.covariances(k, (j,)).R
                if y is not None:
                    Re = np.linalg.inv(R + H @ P @ H.T)
                    x, P = x + P @ H.T @ Re @ (y - H @ x), P - P @ H.T @ Re @ H @ P
            psi[i], Ps[i] = x, P
        xs = {i: sum(psi[j] for j in RING.neighbours(i)) / 3 for i in IDS}
        for i in IDS:
            np.testing.assert_allclose(told[k - 1][i].x, xs[i], atol=1e-11)
            np.testing.assert_allclose(told[k - 1][i].P, Ps[i], atol=1e-11)


def test_kalman_consensus_is_algorithm_1() -> None:
    epsilon = 0.3
    told = Swarm("kalman_consensus", SYSTEM, RING, {"epsilon": epsilon}).run(gappy())
    F, Q = SYSTEM.F.at(0).mean, SYSTEM.noise.covariances(0, IDS).Q
    bars = dict.fromkeys(IDS, F @ SYSTEM.initial_mean)
    Ps = dict.fromkeys(IDS, F @ SYSTEM.initial_covariance @ F.T + Q)
    for k, ys in enumerate(gappy(), start=1):
        following = {}
        for i in IDS:
            u, U = np.zeros(3), np.zeros((3, 3))
            for j in RING.neighbours(i):
                y, H, R = ys[j], SYSTEM.by_id[j].H.at(k).mean, SYSTEM.noise.covariances(k, (j,)).R
                if y is not None:
                    u, U = u + H.T @ np.linalg.inv(R) @ y, U + H.T @ np.linalg.inv(R) @ H
            M = np.linalg.inv(np.linalg.inv(Ps[i]) + U)
            gamma = epsilon / (1 + np.sqrt(np.trace(Ps[i].T @ Ps[i])))
            lean = sum(bars[j] - bars[i] for j in RING.neighbours(i) if j != i)
            x = bars[i] + M @ (u - U @ bars[i]) + gamma * Ps[i] @ lean
            np.testing.assert_allclose(told[k - 1][i].x, x, atol=1e-11)
            np.testing.assert_allclose(told[k - 1][i].P, M, atol=1e-11)
            following[i], Ps[i] = F @ x, F @ M @ F.T + Q
        bars = following


def test_without_leaning_kalman_consensus_is_the_filter_with_the_neighbours_measurements() -> None:
    told = Swarm("kalman_consensus", SYSTEM, RING, {"epsilon": 0.0}).run(gappy())
    for i in IDS:
        assert_same([{i: one[i]} for one in told], textbook(SYSTEM, gappy(), RING.neighbours(i)))


def test_hybrid_consensus_is_algorithm_hcmci() -> None:
    rounds, N = 2, len(IDS)
    told = Swarm("hybrid_consensus", SYSTEM, Network.line(IDS), {"rounds": rounds}).run(gappy())
    F, Q = SYSTEM.F.at(0).mean, SYSTEM.noise.covariances(0, IDS).Q
    W = np.zeros((N, N))
    for a, i in enumerate(IDS):
        for j, weight in metropolis(Network.line(IDS), i).items():
            W[a, IDS.index(j)] = weight
    mixed = np.linalg.matrix_power(W, rounds)
    xs, Ps = [SYSTEM.initial_mean] * N, [SYSTEM.initial_covariance] * N
    for k, ys in enumerate(gappy(), start=1):
        Omega = np.array([np.linalg.inv(F @ P @ F.T + Q) for P in Ps])
        q = np.array([prior @ F @ x for prior, x in zip(Omega, xs, strict=True)])
        dq, dOmega = np.zeros((N, 3)), np.zeros((N, 3, 3))
        for a, i in enumerate(IDS):
            y, H, R = ys[i], SYSTEM.by_id[i].H.at(k).mean, SYSTEM.noise.covariances(k, (i,)).R
            if y is not None:
                dq[a], dOmega[a] = H.T @ np.linalg.inv(R) @ y, H.T @ np.linalg.inv(R) @ H
        Ps = [np.linalg.inv(P) for P in np.tensordot(mixed, Omega + N * dOmega, 1)]
        xs = [P @ told_ for P, told_ in zip(Ps, mixed @ (q + N * dq), strict=True)]
        for a, i in enumerate(IDS):
            np.testing.assert_allclose(told[k - 1][i].x, xs[a], atol=1e-10)
            np.testing.assert_allclose(told[k - 1][i].P, Ps[a], atol=1e-10)


def covariances(seed: int, count: int, nx: int) -> Array:
    roots = np.random.default_rng(seed).standard_normal((count, nx, nx))
    return roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(nx)


@pytest.mark.parametrize(("seed", "nx"), [(1, 1), (2, 2), (3, 2), (4, 3), (5, 4)])
def test_intersection_weights_are_the_best(seed: int, nx: int) -> None:
    """No weights of a fine grid, nor any mixture nearby, give a smaller trace."""
    for count, points in ((2, 400), (3, 60)):
        given = covariances(seed, count, nx)
        weights, P = intersection(given)
        assert weights.sum() == pytest.approx(1)
        assert (weights >= 0).all()
        information = np.linalg.inv(given)
        np.testing.assert_allclose(P, np.linalg.inv(np.tensordot(weights, information, 1)), rtol=1e-9)
        grid = [w for w in product(range(points + 1), repeat=count) if sum(w) == points]
        found = np.linalg.inv(np.tensordot(np.array(grid) / points, information, 1))
        least = float(np.trace(found, axis1=1, axis2=2).min())
        assert P.trace() <= least * (1 + 2e-6)
        assert P.trace() >= least * (1 - 0.01)


def test_intersection_is_safe_whatever_the_estimates_have_in_common() -> None:
    """P - E[e eᵀ] is never indefinite, for errors with any joint covariance that has the given blocks."""
    rng = np.random.default_rng(8)
    for seed in range(40):
        given = covariances(seed, 3, 2)
        weights, P = intersection(given)
        gains = [P @ (w * np.linalg.inv(g)) for w, g in zip(weights, given, strict=True)]
        root = [np.linalg.cholesky(g) for g in given]
        for _ in range(20):
            rank = int(rng.integers(1, 5))
            common = [np.linalg.qr(rng.standard_normal((max(rank, 2), 2)))[0].T for _ in range(3)]  # orthonormal rows
            joint = [[root[a] @ common[a] @ common[b].T @ root[b].T for b in range(3)] for a in range(3)]
            error = sum(gains[a] @ joint[a][b] @ gains[b].T for a in range(3) for b in range(3))
            assert np.linalg.eigvalsh(P - error)[0] > -1e-12


STRETCHES, LONG = 16, 40
"""A mean over a stretch is all but independent of the next: errors are forgotten within a few steps."""


def mean_errors(name: str, options: dict[str, Any]) -> tuple[Array, Array, Array]:
    """On a line, for all nodes: mean squared errors, their standard errors, and trace P once it has settled."""
    states, readings = sampled(SYSTEM, (STRETCHES + 1) * LONG, 11)
    told = Swarm(name, SYSTEM, Network.line(IDS), options).run(readings)
    squares = np.array([[((x - one[i].x) ** 2).sum() for i in IDS] for x, one in zip(states, told, strict=True)])
    stretches = squares[LONG:].reshape(STRETCHES, LONG, len(IDS)).mean(axis=1)
    predicted = np.array([told[-1][i].P.trace() for i in IDS])
    return stretches.mean(axis=0), stretches.std(axis=0, ddof=1) / np.sqrt(STRETCHES), predicted


def test_diffusion_reports_more_than_its_errors() -> None:
    """P is that before the mean: with two neighbours of one's own the errors are smaller by a quarter."""
    found, deviation, told = mean_errors("diffusion", {})
    assert told[1] - found[1] > 4 * deviation[1]
    assert told[1] > 1.1 * found[1]


def test_kalman_consensus_that_leans_little_reports_its_errors() -> None:
    found, deviation, told = mean_errors("kalman_consensus", {})
    assert (np.abs(found - told) < 6 * deviation).all()


def test_hybrid_consensus_with_one_exchange_reports_less_than_its_errors() -> None:
    """A node at the end of the line counts its own measurement four times two thirds."""
    found, deviation, told = mean_errors("hybrid_consensus", {"rounds": 1})
    assert found[3] - told[3] > 6 * deviation[3]
    assert told[3] < 0.8 * found[3]


def test_covariance_intersection_never_reports_less_than_its_errors() -> None:
    found, deviation, told = mean_errors("covariance_intersection", {})
    assert (found < told + 6 * deviation).all()
    single = [textbook(SYSTEM, READINGS, [i])[-1][1].trace() for i in IDS]
    assert (told <= np.array(single) * (1 + 1e-6)).all()


@pytest.mark.parametrize("nx", [1, 3])
def test_absorbing_information_is_the_kalman_update(nx: int) -> None:
    rng = np.random.default_rng(nx)
    for _ in range(20):
        root, H, R = rng.standard_normal((nx, nx)), rng.standard_normal((2, nx)), np.diag(rng.uniform(0.1, 2, 2))
        units = np.diag(10.0 ** rng.integers(-8, 8, nx))
        P, H = units @ (root @ root.T) @ units, H @ np.linalg.inv(units)
        x, y = units @ rng.standard_normal(nx), rng.standard_normal(2)
        weight, told = H.T @ np.linalg.inv(R) @ H, H.T @ np.linalg.inv(R) @ y
        found = absorb(x, P, told, weight)
        assert found is not None
        wanted, scale = kalman_update(x, P, y, H, R), np.sqrt(P.diagonal())
        np.testing.assert_allclose(found[0] / scale, wanted[0] / scale, atol=1e-9)
        np.testing.assert_allclose(found[1] / np.outer(scale, scale), wanted[1] / np.outer(scale, scale), atol=1e-9)


def test_information_that_is_less_than_none_is_refused_and_certainty_is_not() -> None:
    x, P = np.array([1.0, 2.0]), np.diag([0.0, 3.0])
    assert absorb(x, P, np.zeros(2), np.diag([1.0, -0.1])) is None
    found = absorb(x, P, np.array([5.0, 4.0]), np.eye(2))
    assert found is not None
    np.testing.assert_allclose(found[0], [1.0, 2.0 + 0.75 * 2.0])
    np.testing.assert_allclose(found[1], np.diag([0.0, 0.75]))
    precise = absorb(np.zeros(2), 1e6 * np.eye(2), np.array([1e12, 3.0]), np.diag([1e12, 1.0]))
    assert precise is not None
    np.testing.assert_allclose(precise[0], [1.0, 3.0], rtol=1e-5)


def test_what_cannot_be_inverted_says_so() -> None:
    with pytest.raises(RunError, match="singular to working precision"):
        inverse(np.ones((2, 2)))
    with pytest.raises(RunError, match="singular"):
        inverse(np.diag([1.0, 0.0]))


def test_systems_that_they_cannot_stand() -> None:
    certain = white_system(
        [[1, 0.1], [0, 1]], np.diag([0, 0.1]), [np.eye(2)] * 2, [1.0 * np.eye(2)] * 2, P0=np.zeros((2, 2))
    )
    pair = Network.complete((0, 1))
    for name in ("hybrid_consensus", "covariance_intersection"):
        with pytest.raises(InputError, match="system, step 1: the method needs predictions with a positive definite"):
            Swarm(name, certain, pair)
    for name in ("diffusion", "kalman_consensus"):
        Swarm(name, certain, pair).run([{0: np.ones(2), 1: np.ones(2)}] * 3)
    exact = white_system(0.9, 1.0, [1.0] * 2, [1.0, 0.0])
    for name in NAMES:
        with pytest.raises(InputError, match="noise of sensor 1, step 1: the method needs a positive definite"):
            Swarm(name, exact, pair)


def test_what_grows_without_being_measured_ends_with_an_error() -> None:
    growing = white_system([[1.5, 0], [0, 0.9]], np.eye(2), [[[0, 1.0]]] * 2, [1.0] * 2)
    model = White(growing, (0,))

    def run(steps: int) -> None:
        x, P = model.before(1)
        for step in range(1, steps + 1):
            x, P = model.predict(step, x, P)

    with pytest.raises(RunError, match=r"beyond 1e\+150: a part of the state grows and is not measured"):
        run(600)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("kalman_consensus", {"epsilon": -1}),
        ("kalman_consensus", {"epsilon": float("nan")}),
        ("hybrid_consensus", {"rounds": 65}),
        ("diffusion", {"rounds": 2}),
        ("covariance_intersection", {"weights": 1}),
    ],
)
def test_options_that_cannot_be(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match=r"expected a|has no options"):
        METHODS[name].choose(options)
