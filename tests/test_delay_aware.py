"""The recursion of `delay_aware`: reference numbers, enumeration, Monte Carlo, companions, constant gains."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from oracles.delay_aware import FINAL, X0, X00, LongForm, data, example_1, example_2, reference
from zfusion.methods.delay_aware.companions import Augmented, Packet, Stamped
from zfusion.methods.delay_aware.constant import Stationary, best_gain, moment_radius, settled
from zfusion.methods.delay_aware.parameters import Parameters
from zfusion.methods.delay_aware.recursion import Filter
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

EXAMPLES = {1: example_1, 2: example_2}
UPPER = np.array([0, 1, 3])


@pytest.mark.parametrize("example", [1, 2])
def test_all_reference_numbers(example: int) -> None:
    expected, seen = dict(reference(example)), 0
    running = EXAMPLES[example](0).filter(X0, X00)
    last, variance = FINAL[example]
    for k in range(last):
        given = EXAMPLES[example](k)
        x, P, X = running.x, running.P.copy(), running.X.copy()
        R, A = given.reception(X).R, given.mean
        found = given.step(running, data(k))
        if k in expected:
            seen += 1
            told = {
                "P": P.ravel()[UPPER],
                "X": X.ravel()[UPPER],
                "R": [R[0, 0], R[1, 1], R[1, 2], R[2, 2]],
                "S": found.S[np.triu_indices(3)],
                "L": (A @ found.K).ravel(),
                "x": x,
                "e": found.e,
                "next": running.x,
            }
            assert len(expected[k]) == (5 if k == 300 else 8)
            for name, numbers in expected[k].items():
                np.testing.assert_allclose(told[name], numbers, rtol=0, atol=6e-11, err_msg=f"{name} of {k}")
    assert seen == len(expected) == (7 if example == 1 else 6)
    assert running.P.trace() == pytest.approx(variance, abs=6e-11)


@pytest.mark.parametrize("example", [1, 2])
@pytest.mark.parametrize("optimal", [True, False])
def test_the_recursion_is_the_long_form(example: int, optimal: bool) -> None:
    rng = np.random.default_rng(5)
    running, oracle = example_1(0).filter(X0, X00), LongForm(X0, X00)
    for k in range(25):
        given = EXAMPLES[example](k)
        wanted = None if optimal else 0.2 * rng.standard_normal((2, 3))
        found = given.step(running, np.zeros(3), wanted)
        L, P = oracle.step(given, wanted)
        if optimal:
            np.testing.assert_allclose(given.mean @ found.K, L, atol=1e-14)
        np.testing.assert_allclose(running.P, P, atol=1e-14)


def outcomes_of(given: Parameters) -> list[tuple[float, float, Array, Array]]:
    """(probability, g, f, Δ of each delay) of all that can be drawn at a step, two values for each gain."""
    spread = np.sqrt(given.g2 - given.gbar**2)
    choices: list[list[tuple[float, float]]] = [[(0.5, given.gbar - spread), (0.5, given.gbar + spread)]]
    for mean, second in zip(given.fbar, given.f2, strict=True):
        sd = np.sqrt(second - mean**2)
        choices.append([(0.5, mean - sd), (0.5, mean + sd)])
    found = []
    delays = [[*given.p[:, i], 1 - given.p[:, i].sum()] for i in range(2)]
    for (pg, g), (pf, f), (ph, h) in product(*choices):
        for a, b in product(range(4), repeat=2):
            arrived = np.zeros((4, 3))
            arrived[a, 0] = arrived[b, 1:] = 1.0
            found.append((pg * pf * ph * delays[0][a] * delays[1][b], g, np.array([f, h, h]), arrived[:3]))
    return found


@pytest.mark.parametrize("example", [1, 2])
@pytest.mark.parametrize("optimal", [True, False])
def test_covariances_are_those_of_all_outcomes_enumerated(example: int, optimal: bool) -> None:
    """Second moments of (x_k, x̂_k, x̂_k-1, x̂_k-2, y_k-1, y_k-2) over all draws; the gains in it are just numbers."""
    rng = np.random.default_rng(6)
    running = example_1(0).filter(X0, X00)
    n, m, size = 2, 3, 4 * 2 + 2 * 3
    start = np.concatenate((X0, X0, np.zeros(size - 4)))
    second = np.outer(start, start)
    second[:2, :2] = X00
    parameters: list[Parameters] = []
    for k in range(8):
        given = EXAMPLES[example](k)
        parameters.append(given)
        wanted = None if optimal else 0.2 * rng.standard_normal((2, 3))
        found = given.step(running, np.zeros(3), wanted)
        L = given.mean @ found.K if wanted is None else wanted
        H = [p.reception(np.eye(2)).H for p in parameters[: -4 if k > 2 else None : -1]]
        H += [np.zeros((m, n))] * (3 - len(H))
        p, C = given.reception(np.eye(2)).p, np.vstack(given.C)
        following = np.zeros_like(second)
        for chance, g, f, arrived in outcomes_of(given):
            y = np.zeros((m, size + n + 2 * m))  # of (old vector, w, v, n)
            y[:, :n], y[:, size + n : size + n + m] = f[:, None] * C, np.eye(m)
            e = arrived[0][:, None] * y
            e[:, 4 * n : 4 * n + m] += np.diag(arrived[1])
            e[:, 4 * n + m : size] += np.diag(arrived[2])
            e[:, size + n + m :] += np.eye(m)
            for j in range(3):
                e[:, n + j * n : 2 * n + j * n] -= p[j][:, None] * H[j]
            step = np.zeros((size, size + n + 2 * m))
            step[:n, :n], step[:n, size : size + n] = given.A + g * given.Ah, np.eye(n)
            step[n : 2 * n] = L @ e
            step[n : 2 * n, n : 2 * n] += given.mean
            step[2 * n : 4 * n, n : 3 * n] = np.eye(2 * n)
            step[4 * n : 4 * n + m] = y
            step[4 * n + m : size, 4 * n : 4 * n + m] = np.eye(m)
            whole = np.zeros((size + n + 2 * m,) * 2)
            whole[:size, :size] = second
            whole[size : size + n, size : size + n] = given.W
            whole[size + n : size + n + m, size + n : size + n + m] = given.V
            whole[size + n + m :, size + n + m :] = given.N
            following += chance * step @ whole @ step.T
        second = following
        error = np.hstack((np.eye(n), -np.eye(n)))
        np.testing.assert_allclose(error @ second[: 2 * n, : 2 * n] @ error.T, running.P, atol=1e-13)
        np.testing.assert_allclose(second[:n, :n], running.X, atol=1e-13)


@pytest.mark.parametrize("example", [1, 2])
def test_no_other_gain_has_a_smaller_covariance(example: int) -> None:
    """In the matrix order, at each step; P of any gain is right, see above."""
    rng, steps = np.random.default_rng(7), 6
    for last in range(steps):
        best, other = example_1(0).filter(X0, X00), example_1(0).filter(X0, X00)
        for k in range(last + 1):
            given = EXAMPLES[example](k)
            found = given.step(best, np.zeros(3))
            L = given.mean @ found.K
            given.step(other, np.zeros(3), L + 0.1 * rng.standard_normal(L.shape) if k == last else None)
        assert np.linalg.eigvalsh(other.P - best.P)[0] > -1e-14
        assert other.P.trace() > best.P.trace() + 1e-4


SCENES: dict[str, dict[str, Any]] = {
    "S1": {},
    "S2": {"p": np.array([[0.2, 0.2], [0.3, 0.3], [0.3, 0.3]])},
    "S3": {"p": np.array([[0.6, 0.6], [0.0, 0.0], [0.0, 0.0]])},
    "S4": {"fbar": (1.0, 1.0), "f2": (1.0, 1.0), "g2": 0.09},
    "S5": {"p": np.array([[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]])},
    "S6": {"p": np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])},
    "S7": {"A": np.array([[0.98, 0.2], [-0.1, 0.92]]), "gbar": 0.0, "g2": 0.01},
}
STEPWISE = {"S1": 0.48235, "S2": 0.61503, "S3": 0.49828, "S4": 0.40132, "S5": 0.35387, "S6": 0.70651, "S7": 0.57238}
LEAST = {"S1": 0.47102, "S2": 0.57817, "S3": 0.49828, "S4": 0.38989, "S5": 0.35387, "S6": 0.61689, "S7": 0.55819}


@pytest.mark.parametrize("scene", SCENES)
def test_variances_beside_those_of_least_squares(scene: str) -> None:
    """Means of tr P over k = 30..60, of the filter and of the companion without time stamps, on the spec's scenes."""
    given = example_1(0, **SCENES[scene])
    running, companion = given.filter(X0, X00), Augmented(X0, X00 - np.outer(X0, X0), 2, 3)
    found = []
    for _ in range(61):
        found.append((running.P.trace(), companion.P.trace()))
        A, Q = given.mean, given.noise(running.X)
        companion.receive(np.zeros(3), given.reception(running.X))
        given.step(running, np.zeros(3))
        companion.move(A, Q)
    np.testing.assert_allclose(np.mean(found[30:], axis=0), (STEPWISE[scene], LEAST[scene]), rtol=0, atol=6e-6)
    np.testing.assert_array_less([least for _, least in found], np.array([own for own, _ in found]) + 1e-12)


def stationary(scene: str) -> Stationary:
    given = example_1(0, **SCENES[scene])
    n = len(given.A)
    B = np.sqrt(max(given.g2 - given.gbar**2, 0.0)) * given.Ah
    assert moment_radius(given.mean, B[None]) < 1
    X = np.linalg.solve(np.eye(n * n) - np.kron(given.mean, given.mean) - np.kron(B, B), given.W.ravel()).reshape(n, n)
    return Stationary(given.mean, given.noise(X), given.reception(X))


BEST = {
    "S1": (0.47762, 0.48231, [[0.31152, 0.12796, 0.19839], [0.08673, 0.24103, -0.16383]]),
    "S2": (0.59503, 0.61497, [[0.24098, 0.14019, 0.15905], [0.03716, 0.19268, -0.15062]]),
    "S4": (0.39746, 0.40130, None),
    "S6": (0.65606, 0.70649, [[0.18496, 0.11963, 0.06299], [0.01127, 0.13919, -0.14905]]),
}


@pytest.mark.parametrize("scene", BEST)
def test_the_best_constant_gain(scene: str) -> None:
    cost, greedy, gain = BEST[scene]
    model = stationary(scene)
    best = best_gain(model)
    assert (best.variance, settled(model).variance) == (pytest.approx(cost, abs=6e-6), pytest.approx(greedy, abs=6e-6))
    if gain is not None:
        np.testing.assert_allclose(best.L, gain, atol=2e-5)
    given = example_1(0, **SCENES[scene])
    running = given.filter(X0, X00)
    for _ in range(300):
        given.step(running, np.zeros(3), best.L)
    assert running.P.trace() == pytest.approx(best.variance, rel=1e-9)  # two routes to the same number


# Kalman filters that take what is received for what was measured; both that ignore the random gains and not
NAIVE = {
    "S1": (0.57786, 0.47994),
    "S2": (0.68877, 0.60441),
    "S3": (0.72981, 0.59031),
    "S4": (0.40511, 0.40511),
    "S5": (0.44009, 0.35387),
    "S6": (0.70235, 0.70867),
    "S7": (0.89594, 0.58896),
}
CLAIMED = {"S4": (0.27010, 0.27010), "S7": (0.27979, 0.39191)}
"""By themselves, of their predictions for k = 60; in all other scenes as in S1."""


def naive_errors(given: Parameters, believed: Parameters) -> tuple[list[float], list[float]]:
    """E|x - x̂|² step by step of the ordinary Kalman predictor for what is `believed`, and what it thinks of it.

    Exact: second moments of (x_k, y_k, .., y_{k-L}, x̂_k), which move linearly but for zero-mean factors.
    """
    true, own = given.filter(X0, X00), believed.filter(X0, X00)
    H, p, same = (getattr(given.reception(true.X), name) for name in ("H", "p", "same"))
    (m, n), lags = H.shape, len(p)
    y, xh = slice(n, n + lags * m), slice(n + lags * m, 2 * n + lags * m)
    now = slice(n, n + m)
    M = np.zeros((2 * n + lags * m,) * 2)
    M[:n, :n], M[:n, xh], M[xh, :n], M[xh, xh] = X00, np.outer(X0, X0), np.outer(X0, X0), np.outer(X0, X0)
    Pbar = np.hstack([np.diag(row) for row in p])
    errors, claims = [], []
    X = X00
    for _ in range(61):
        measure = np.eye(len(M))
        measure[now, :n], measure[now, now] = H, 0
        M = measure @ M @ measure.T
        M[now, now] += given.reception(X).R
        errors.append(float(np.trace(M[:n, :n] - M[:n, xh] - M[xh, :n] + M[xh, xh])))
        claims.append(float(own.P.trace()))
        Y = M[y, y]
        marginal = sum(np.diag(p[j]) @ Y[j * m : (j + 1) * m, j * m : (j + 1) * m] for j in range(lags))
        noise = given.N + same * (marginal - Pbar @ Y @ Pbar.T)
        K = believed.mean @ believed.step(own, np.zeros(m)).K
        move = np.zeros_like(M)
        move[:n, :n] = given.mean
        move[n + m : y.stop, n : y.stop - m] = np.eye((lags - 1) * m)
        move[xh, y] = K @ Pbar
        move[xh, xh] = believed.mean - K @ believed.reception(X).H
        M = move @ M @ move.T
        M[:n, :n] += given.noise(X)
        M[xh, xh] += K @ noise @ K.T
        X = M[:n, :n]
    return errors, claims


@pytest.mark.parametrize("scene", SCENES)
def test_naive_kalman_filters_of_the_reference(scene: str) -> None:
    """Their own covariances are wrong by up to a factor 3.2; at S6 one that ignores the network is hardly worse."""
    given = example_1(0, **SCENES[scene])
    at_once = {"p": np.array([[1.0, 1.0]])}
    sure = {"fbar": (1.0, 1.0), "f2": (1.0, 1.0), "g2": given.gbar**2}
    found = [naive_errors(given, example_1(0, **(SCENES[scene] | at_once | ignored))) for ignored in (sure, {})]
    means = [np.mean(errors[30:]) for errors, _ in found]
    claims = [claims[-1] for _, claims in found]
    np.testing.assert_allclose(means, NAIVE[scene], rtol=0, atol=6e-6)
    np.testing.assert_allclose(claims, CLAIMED.get(scene, (0.27010, 0.35386)), rtol=0, atol=6e-6)


@pytest.mark.long
def test_gains_that_are_best_together_are_those_of_least_squares() -> None:
    """All six gains for tr P_6 of example 1, by BFGS: 2.5 % below the stepwise ones, and where least squares is."""
    minimize = pytest.importorskip("scipy.optimize").minimize
    given = example_1(0)

    def stepwise() -> tuple[list[Array], float]:
        running, gains = given.filter(X0, X00), []
        for _ in range(6):
            gains.append(given.mean @ given.step(running, np.zeros(3)).K)
        return gains, float(running.P.trace())

    def cost(entries: Array) -> float:
        running = given.filter(X0, X00)
        for gain in entries.reshape(6, 2, 3):
            given.step(running, np.zeros(3), gain)
        return float(running.P.trace())

    gains, greedy = stepwise()
    companion, X = Augmented(X0, X00 - np.outer(X0, X0), 2, 3), given.filter(X0, X00)
    for _ in range(6):
        A, Q = given.mean, given.noise(X.X)
        companion.receive(np.zeros(3), given.reception(X.X))
        given.step(X, np.zeros(3))
        companion.move(A, Q)
    assert greedy == pytest.approx(0.4939667551, abs=1e-10)
    assert companion.P.trace() == pytest.approx(0.4815703615, abs=1e-10)
    assert cost(np.array(gains).ravel()) == pytest.approx(greedy, rel=1e-12)
    found = minimize(cost, np.array(gains).ravel(), method="BFGS", options={"maxiter": 400, "gtol": 1e-9})
    assert found.fun == pytest.approx(0.4815703615, abs=2e-8)
    assert found.fun >= 0.4815703615 - 1e-10


def test_radius_of_the_example() -> None:
    given = example_1(0)
    B = np.sqrt(given.g2 - given.gbar**2) * given.Ah
    assert moment_radius(given.mean, B[None]) == pytest.approx(0.8425491705, abs=6e-11)
    assert np.abs(np.linalg.eigvals(given.mean)).max() == pytest.approx(0.9164605829, abs=6e-11)


def drawn(rng: np.random.Generator, given: Parameters, runs: int, steps: int) -> tuple[list[Array], list[Any]]:
    """States, and measurements with their delays by row, of many runs: Beta gains of sensors, a Gaussian one of x."""
    x = X0 + rng.standard_normal((runs, 2)) @ np.linalg.cholesky(X00 - np.outer(X0, X0)).T
    states, readings = [], []
    for _ in range(steps):
        f = []
        for mean, second in zip(given.fbar, given.f2, strict=True):
            size = (mean - second) / (second - mean**2)
            f.append(rng.beta(mean * size, (1 - mean) * size, runs))
        gains = np.stack((f[0], f[1], f[1]), axis=1)
        y = gains * (x @ np.vstack(given.C).T) + rng.standard_normal((runs, 3)) @ np.linalg.cholesky(given.V).T
        tau = [rng.choice(4, runs, p=[*given.p[:, i], 1 - given.p[:, i].sum()]) for i in range(2)]
        states.append(x)
        readings.append((y, np.stack((tau[0], tau[1], tau[1]), axis=1)))
        g = given.gbar + np.sqrt(given.g2 - given.gbar**2) * rng.standard_normal((runs, 1))
        x = x @ given.A.T + g * (x @ given.Ah.T) + rng.standard_normal((runs, 2)) @ np.linalg.cholesky(given.W).T
    return states, readings


def test_sampled_errors_are_those_that_are_predicted() -> None:
    """Every entry of the error covariance and of its mean, filtered and predicted, at each of 24 steps: 5 sigma."""
    rng, given, runs = np.random.default_rng(11), example_1(0), 20_000
    states, readings = drawn(rng, given, runs, 24)
    running = given.filter(X0, X00)
    x = np.tile(X0, (runs, 1))
    expected: list[Array] = []
    for k, (state, (_, tau)) in enumerate(zip(states, readings, strict=True)):
        check_moments(state - x, running.P)
        reception = given.reception(running.X)
        expected.append(x @ reception.H.T)
        e = rng.standard_normal((runs, 3)) @ np.linalg.cholesky(given.N).T
        for j in range(min(k, 2) + 1):
            e += (tau == j) * readings[k - j][0] - reception.p[j] * expected[k - j]
        found = given.step(running, np.zeros(3))
        check_moments(e, found.S)
        check_moments(state - x - e @ found.K.T, found.P)
        x = x @ given.mean.T + e @ (given.mean @ found.K).T


def check_moments(errors: Array, covariance: Array) -> None:
    runs = len(errors)
    mean = errors.mean(axis=0)
    assert (np.abs(mean) < 5 * errors.std(axis=0) / np.sqrt(runs)).all()
    products = errors[:, :, None] * errors[:, None, :]
    assert (np.abs(products.mean(axis=0) - covariance) < 5 * products.std(axis=0) / np.sqrt(runs)).all()


def test_time_stamps_are_worth_what_they_say() -> None:
    """Sampled errors of the companion with time stamps are its own covariances (6 sigma), and less than without."""
    rng, given, runs, steps = np.random.default_rng(12), example_1(0), 40, 60
    states, readings = drawn(rng, given, runs, steps)
    noises = rng.standard_normal((runs, steps, 3, 3)) @ np.linalg.cholesky(given.N).T
    receptions, moves = [], []
    running = given.filter(X0, X00)
    for _ in range(steps):
        receptions.append(given.reception(running.X))
        moves.append((given.mean, given.noise(running.X)))
        given.step(running, np.zeros(3))
    difference, told = [], []
    for run in range(runs):
        stamped, found = Stamped(X0, X00 - np.outer(X0, X0), 2, 3), []
        for k in range(steps):
            found.append((((states[k][run] - stamped.x) ** 2).sum(), stamped.P.trace()))
            packets = [
                Packet(j, own, readings[k - j][0][run, own] + noises[run, k, j, own])
                for own in (slice(0, 1), slice(1, 3))
                for j in range(min(k, 2) + 1)
                if readings[k][1][run, own.start] == j
            ]
            stamped.receive(packets, receptions[k])
            stamped.move(*moves[k])
        squares, traces = np.mean(found[20:], axis=0)
        difference.append(squares - traces)
        told.append(traces)
    assert abs(np.mean(difference)) < 6 * np.std(difference, ddof=1) / np.sqrt(runs)
    assert np.mean(told) == pytest.approx(0.43077, rel=0.02)


def test_packets_that_have_one_delay_each_are_on_the_safe_side() -> None:
    """Of the packets that come at a step the newest counts: the delays of steps depend, the filter takes them not to.

    0.49986 predicted with the right probabilities; sampled elsewhere 0.47007, here within 5 sigma of that.
    """
    d = np.array([[0.6, 0.5], [0.25, 0.3], [0.1, 0.15]])
    p = d * np.vstack((np.ones(2), np.cumprod(1 - d, axis=0)[:-1]))
    rng, given, runs, steps = np.random.default_rng(14), example_1(0, p=p), 6000, 61
    states, readings = drawn(rng, given, runs, steps)
    delays = [rng.choice(4, (steps, runs), p=[*d[:, i], 1 - d[:, i].sum()]) for i in (0, 1, 1)]
    delays[2] = delays[1]
    own = np.stack(delays, axis=2)
    running, x = given.filter(X0, X00), np.tile(X0, (runs, 1))
    errors, predicted, expected = [], [], list[Array]()
    for k in range(steps):
        errors.append(((states[k] - x) ** 2).sum(axis=1))
        predicted.append(running.P.trace())
        reception = given.reception(running.X)
        expected.append(x @ reception.H.T)
        e = rng.standard_normal((runs, 3)) @ np.linalg.cholesky(given.N).T
        free = np.ones((runs, 3))
        for j in range(min(k, 2) + 1):
            comes = free * (own[k - j] == j)
            free = free - comes
            e += comes * readings[k - j][0] - reception.p[j] * expected[k - j]
        found = given.step(running, np.zeros(3))
        x = x @ given.mean.T + e @ (given.mean @ found.K).T
    assert np.mean(predicted[30:]) == pytest.approx(0.49986, abs=6e-6)
    squares = np.mean(errors[30:], axis=0)
    sigma = squares.std() / np.sqrt(runs)
    assert abs(squares.mean() - 0.47007) < 5 * sigma
    assert squares.mean() + 5 * sigma < 0.49986


def test_without_delays_it_is_the_kalman_predictor() -> None:
    given = example_1(0, g2=0.09, fbar=(1.0, 1.0), f2=(1.0, 1.0), p=np.ones((1, 2)), N=np.zeros((3, 3)))
    running, x, P = given.filter(X0, X00), X0, X00 - np.outer(X0, X0)
    C = np.vstack(given.C)
    for k in range(40):
        found = given.step(running, data(k))
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + given.V)
        np.testing.assert_allclose(found.K, K, atol=1e-13)
        x, P = given.mean @ (x + K @ (data(k) - C @ x)), given.mean @ (P - K @ C @ P) @ given.mean.T + given.W
        np.testing.assert_allclose(running.x, x, atol=1e-12)
        np.testing.assert_allclose(running.P, P, atol=1e-13)


def test_what_never_comes_has_no_gain() -> None:
    dead = example_1(0, p=np.array([[0.0, 0.5], [0.0, 0.3]]), N=np.zeros((3, 3)))
    alone = example_1(0, C=dead.C[1:], fbar=(0.6,), f2=(0.41,), V=dead.V[1:, 1:], N=np.zeros((2, 2)), p=dead.p[:, 1:])
    first, second = dead.filter(X0, X00), alone.filter(X0, X00)
    for k in range(20):
        r = data(k) * (0.0, 1.0, 1.0)
        found = dead.step(first, r)
        np.testing.assert_array_equal(found.K[:, 0], 0.0)
        alone.step(second, r[1:])
        np.testing.assert_allclose(first.P, second.P, atol=1e-13)
    nothing = example_1(0, p=np.zeros((3, 2)), N=np.zeros((3, 3)))
    running = nothing.filter(X0, X00)
    for _ in range(10):
        nothing.step(running, np.zeros(3))
        np.testing.assert_allclose(running.P, running.X - np.outer(running.x, running.x), atol=1e-12)


def test_what_comes_twice_without_noise_counts_once() -> None:
    once = example_1(
        0, C=[np.array([[1.0, 0.5]])], fbar=(1.0,), f2=(1.0,), V=np.eye(1), N=np.zeros((1, 1)), p=np.ones((1, 1))
    )
    twice = example_1(
        0,
        C=[once.C[0].repeat(2, axis=0)],
        fbar=(1.0,),
        f2=(1.0,),
        V=np.ones((2, 2)),
        N=np.zeros((2, 2)),
        p=np.ones((1, 1)),
    )
    first, second = once.filter(X0, X00), twice.filter(X0, X00)
    for k in range(10):
        once.step(first, data(k)[:1])
        twice.step(second, data(k)[[0, 0]])
        np.testing.assert_allclose(first.P, second.P, atol=1e-12)
        np.testing.assert_allclose(first.x, second.x, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"A": np.eye(3)}, "Ah at k = 4: expected an array of shape"),
        ({"W": np.array([[1.0, 2.0], [2.0, 1.0]])}, "W at k = 4: expected a positive semi-definite matrix.*-1"),
        ({"W": np.array([[1.0, 0.2], [0.0, 1.0]])}, "W at k = 4: expected a symmetric"),
        ({"V": [np.eye(1)]}, "V at k = 4: expected 2 blocks"),
        ({"V": [np.eye(2), np.eye(1)]}, r"V\[0\] at k = 4: expected an array of shape \(1, 1\)"),
        ({"p": np.array([[0.6, 0.5], [0.5, 0.2]])}, "p at k = 4: expected the probabilities of a class to add up"),
        ({"p": np.array([[1.2, 0.5]])}, "p at k = 4: expected probabilities, from 0 to 1"),
        ({"g2": 0.05}, "g2 at k = 4: expected gbar.*is it a variance"),
        ({"f2": (0.02, 0.41)}, r"f2\[0\] at k = 4: expected fbar.*is it a variance"),
        ({"fbar": (1.2, 0.6), "f2": (1.5, 0.41)}, r"fbar\[0\] at k = 4: expected a mean of what is between 0 and 1"),
        ({"f2": (0.85, 0.41)}, r"f2\[0\] at k = 4: expected 0.8 or less"),
        ({"fbar": (0.8,)}, "fbar at k = 4: expected an array"),
    ],
)
def test_parameters_that_cannot_be_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        example_1(4, **changes)


def test_receptions_and_priors_that_cannot_be_are_refused() -> None:
    given = example_1(4)
    with pytest.raises(ModelError, match=r"X00 - x0 x0.T at k = 4.*is it a variance"):
        given.filter(X0, X00 - np.outer(X0, X0))
    running = given.filter(X0, X00)
    with pytest.raises(ModelError, match=r"r at k = 4: expected no NaN: drop-outs are in the model"):
        given.step(running, [0.0, np.nan, 0.0])
    with pytest.raises(ModelError, match=r"r at k = 4: expected an array of shape \(3,\)"):
        given.step(running, [0.0])
    with pytest.raises(ValueError, match="nothing was received"):
        Filter(X0, np.eye(2), 1, 3).move(np.eye(2), np.eye(2))
