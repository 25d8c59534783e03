"""Consensus on measurements: mixing, transfer functions, predicted errors, against the reference example."""

from __future__ import annotations

import numpy as np
import pytest

from zfusion.methods.consensus.mixing import Mixing, Spectrum, rounds_needed
from zfusion.methods.consensus.prediction import (
    Observed,
    alone,
    error_covariances,
    mean_noise,
    mode_response,
    noise_gains,
    transfer,
)
from zfusion.model.checks import ModelError
from zfusion.model.types import Array

A = np.array([[0.95, 0.10], [-0.10, 0.95]])


def weights(count: int, edges: list[tuple[int, int]]) -> Array:
    a = np.zeros((count, count))
    for i, j in edges:
        a[i, j] = a[j, i] = 1.0
    return a


def ring(count: int, reach: int = 1) -> Array:
    return weights(count, [(i, (i + step) % count) for i in range(count) for step in range(1, reach + 1)])


@pytest.fixture(scope="module")
def spectrum() -> Spectrum:
    return Spectrum.of(weights(5, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)]))


@pytest.fixture(scope="module")
def observed() -> Observed:
    Q = np.array([(0.5 + 0.25 * i) * np.array([[1, 0.1 * i], [0.1 * i, 1.2]]) for i in range(5)])
    return Observed(A, np.eye(2), 0.1 * np.eye(2), Q)


def test_the_reference_example(spectrum: Spectrum, observed: Observed) -> None:
    np.testing.assert_allclose(spectrum.values, [0, 1.3819660113, 2.3819660113, 3.6180339887, 4.6180339887], atol=1e-10)
    assert spectrum.fastest_step == pytest.approx(1 / 3, abs=1e-12)
    assert spectrum.fastest_rate == pytest.approx(0.5393446629, abs=1e-10)
    assert spectrum.largest_step == pytest.approx(0.4330847293, abs=1e-10)
    np.testing.assert_allclose(
        observed.pooled.ravel(), [0.1695279971, 0.0256134317, 0.0256134317, 0.2034335965], atol=1e-10
    )
    K, P = observed.centralised
    np.testing.assert_allclose(K.ravel(), [0.5193513526, -0.0235711598, -0.0224883205, 0.4809821913], atol=1e-10)
    np.testing.assert_allclose(P.ravel(), [0.0874408563, 0.0085072046, 0.0085072046, 0.0972719340], atol=1e-10)


@pytest.mark.parametrize(
    ("rounds", "slowest", "traces"),
    [
        (1, 0.5393446629, [0.3322555962, 0.2631525811, 0.3120138013, 0.3005745484, 0.2866626247]),
        (2, 0.2908926654, [0.2113210755, 0.2037407776, 0.2049487413, 0.2013063635, 0.2064041732]),
        (3, 0.1568914066, [0.1918488077, 0.1901615650, 0.1924074478, 0.1918189452, 0.1903528852]),
        (5, 0.0456385594, [0.1852735494, 0.1851897694, 0.1853458717, 0.1852997844, 0.1851757500]),
        (10, 0.0020828781, [0.1847140913, 0.1847138024, 0.1847139319, 0.1847137534, 0.1847140111]),
    ],
)
def test_predicted_errors(
    spectrum: Spectrum, observed: Observed, rounds: int, slowest: float, traces: list[float]
) -> None:
    mixing = Mixing(spectrum, rounds, spectrum.fastest_step)
    assert mixing.slowest == pytest.approx(slowest, abs=1e-10)
    np.testing.assert_allclose(np.trace(error_covariances(observed, mixing), axis1=1, axis2=2), traces, atol=1e-10)


def test_transfer_functions(spectrum: Spectrum, observed: Observed) -> None:
    mixing = Mixing(spectrum, 2, spectrum.fastest_step)
    np.testing.assert_allclose(mixing.factors[1:], [0.2908926654, 0.0424406679, 0.0424406679, 0.2908926654], atol=1e-10)
    places = ((0, 0), (0, 2), (0, 3), (4, 9), (7, 0))
    wanted = {
        0.0: [0.3390559942, 0.2250669505, 0.0097037894, -0.0270498507, 0.0512268635],
        0.3: [
            0.3620179033 + 0.0870130063j,
            0.2286969666 + 0.0112841068j,
            0.0098602980 + 0.0004865157j,
            -0.0274861271 - 0.0013561894j,
            0.0520530813 + 0.0025683442j,
        ],
        np.pi: [0.6998862266, 0.2581043011, 0.0111281988, -0.0310204710, 0.0587464030],
    }
    for frequency, values in wanted.items():
        H = transfer(observed, mixing, frequency)
        np.testing.assert_allclose([H[place] for place in places], values, atol=1e-10)
    gains = noise_gains(mixing)
    np.testing.assert_allclose(
        gains[0], [0.1215290520, 0.0495871560, 0.0165596330, 0.0495871560, 0.0165596330], atol=1e-10
    )
    np.testing.assert_allclose(
        mean_noise(observed, mixing)[3].ravel(), [0.1968497426, 0.0227898342, 0.0227898342, 0.2362196911], atol=1e-10
    )


def test_errors_in_the_frequency_domain(spectrum: Spectrum, observed: Observed) -> None:
    """The same covariances by another route: the integral of the errors' spectrum."""
    mixing = Mixing(spectrum, 2, 0.9 / spectrum.values[-1])
    K, _ = observed.centralised
    N = len(observed.Q)
    vectors = spectrum.vectors[:, 1:]
    inverse = N * observed.pooled
    points, total = 512, np.zeros((N, 2, 2))
    for omega in 2 * np.pi * (np.arange(points) + 0.5) / points:
        z = np.exp(1j * omega)
        shared = (vectors * mode_response(mixing, omega)) @ vectors.T
        corrected = np.eye(2) - K @ observed.C
        forward = np.linalg.inv(np.eye(2) - corrected @ A / z)
        signal = observed.C @ np.linalg.inv(z * np.eye(2) - A)
        for i in range(N):
            leak = sum(shared[i, j] * observed.information[j] for j in range(N))
            Gw = forward @ (corrected / z - K @ inverse @ leak @ signal)
            total[i] += np.real(Gw @ observed.Wp @ Gw.conj().T) / points
            for j in range(N):
                Gv = -forward @ K @ inverse @ observed.information[j] * (1 / N + shared[i, j])
                total[i] += np.real(Gv @ observed.Q[j] @ Gv.conj().T) / points
    np.testing.assert_allclose(error_covariances(observed, mixing), total, rtol=1e-9)


@pytest.mark.parametrize(
    ("graph", "slow", "single", "fastest", "careful", "chebyshev"),
    [
        (ring(20), 1.0, 6.12, [34.08, 6.43, 10.42, 5.86], [7.33, 5.41, 4.46, 3.42], [34.08, 13.57, 7.02, 2.71]),
        (ring(20, 2), 1.0, 6.14, [18.46, 3.99, 4.41, 2.27], [], [18.46, 4.97, 2.39, 1.116]),
        (weights(10, [(0, i) for i in range(1, 10)]), 1.0, 3.90, [6.38, 3.71, 2.89, 1.82], [], []),
        (ring(20), 0.01, 1.92, [4.22, 2.21, 2.02, 1.55], [2.56, 2.02, 1.77, 1.51], []),
    ],
)
def test_few_exchanges_in_larger_networks_have_the_size_that_is_known(
    graph: Array, slow: float, single: float, fastest: list[float], careful: list[float], chebyshev: list[float]
) -> None:
    """Noises q_i I with q_i uniform in (0.5, 4): drawn otherwise than in the reference, so only the size is known."""
    found = Spectrum.of(graph)
    q = np.random.default_rng(3).uniform(0.5, 4.0, len(graph))
    observed = Observed(A, np.eye(2), slow * 0.1 * np.eye(2), q[:, None, None] * np.eye(2))
    best = np.trace(observed.centralised[1])

    def losses(step: float, cheb: bool = False) -> list[float]:
        means = []
        for n in (1, 2, 3, 5):
            covariances = error_covariances(observed, Mixing(found, n, step, cheb))
            means.append(float(np.trace(covariances, axis1=1, axis2=2).mean() / best))
        return means

    assert np.trace(alone(observed), axis1=1, axis2=2).mean() / best == pytest.approx(single, rel=0.15)
    np.testing.assert_allclose(losses(found.fastest_step), fastest, rtol=0.35)
    if careful:
        np.testing.assert_allclose(losses(1 / found.values[-1]), careful, rtol=0.35)
    if chebyshev:
        np.testing.assert_allclose(losses(found.fastest_step, True), chebyshev, rtol=0.35)


def test_many_exchanges_are_the_centralised_filter(spectrum: Spectrum, observed: Observed) -> None:
    P = observed.centralised[1]
    covariances = error_covariances(observed, Mixing(spectrum, 60, spectrum.fastest_step))
    np.testing.assert_allclose(covariances, np.broadcast_to(P, covariances.shape), rtol=1e-9)


def test_mixing_is_the_polynomial_of_the_laplacian(spectrum: Spectrum) -> None:
    L = np.diag(spectrum.weights.sum(axis=1)) - spectrum.weights
    v = np.random.default_rng(1).standard_normal((5, 3))
    for chebyshev in (False, True):
        mixing = Mixing(spectrum, 7, 0.3, chebyshev)
        earlier, now = v, v
        for number, omega in enumerate(mixing.relaxations):
            mixed = now - mixing.gamma * L @ now
            earlier, now = now, mixed if number == 0 else omega * mixed + (1 - omega) * earlier
        np.testing.assert_allclose(mixing.matrix @ v, now, atol=1e-13)
        np.testing.assert_allclose(now.mean(axis=0), v.mean(axis=0), atol=1e-13)
    assert Mixing(spectrum, 7, 0.3, True).slowest == pytest.approx(3.689e-4, rel=1e-3)
    assert Mixing(spectrum, 7, spectrum.fastest_step).slowest == pytest.approx(1.328e-2, rel=1e-3)


def test_the_rule_for_the_rounds_keeps_what_it_promises(spectrum: Spectrum) -> None:
    for band, tolerance in ((0.3, 0.05), (np.pi, 0.01), (1.0, 1e-4)):
        n = rounds_needed(spectrum.fastest_rate, band, tolerance)
        mixing = Mixing(spectrum, n, spectrum.fastest_step)
        worst = max(np.abs(mode_response(mixing, w)).max() for w in np.linspace(1e-3, band, 200))
        assert worst <= tolerance * (1 + 1e-9)


def test_a_process_whose_lag_would_grow_is_refused(spectrum: Spectrum, observed: Observed) -> None:
    velocity = np.array([[1.0, 1.0], [0.0, 1.0]])
    drifting = Observed(velocity, np.eye(2), 0.1 * np.eye(2), observed.Q)
    mixing = Mixing(spectrum, 2, 0.3)
    with pytest.raises(ModelError, match="lag without bound"):
        error_covariances(drifting, mixing)
    alike = Observed(velocity, np.eye(2), 0.1 * np.eye(2), np.repeat(observed.Q[:1], 5, axis=0))
    assert (np.trace(error_covariances(alike, mixing), axis1=1, axis2=2) > np.trace(alike.centralised[1])).all()
    walk = Observed(np.eye(2), np.eye(2), 0.1 * np.eye(2), observed.Q)
    assert np.isfinite(error_covariances(walk, mixing)).all()


@pytest.mark.parametrize(
    ("graph", "said"),
    [
        (np.ones((1, 1)), "two nodes or more"),
        (np.ones((2, 3)), "two nodes or more"),
        (np.array([[0, 1], [0.5, 0]]), r"directed graph not supported: weight 1->0 is 1, 0->1 is 0\.5"),
        (np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]), r"\(balanced\)"),
        (np.array([[0, 1, 0], [0, 0, 1], [0, 1, 0]]), r"\(unbalanced: not even the average is preserved\)"),
        (np.array([[0, np.nan], [np.nan, 0]]), "finite weights"),
        (np.array([[0.0, -1], [-1, 0]]), "finite weights"),
        (weights(4, [(0, 1), (2, 3)]), "2 components"),
    ],
)
def test_networks_that_cannot_be(graph: Array, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        Spectrum.of(graph)


def test_steps_and_rounds_that_cannot_be(spectrum: Spectrum) -> None:
    for step in (0.0, -0.1, spectrum.largest_step, np.nan):
        with pytest.raises(ModelError, match=r"2 / λ_N = 0\.4330847293"):
            Mixing(spectrum, 2, step)
    for rounds in (0, -1, 1.5, True):
        with pytest.raises(ModelError, match="rounds"):
            Mixing(spectrum, rounds, 0.3)  # type: ignore[arg-type]
