"""Sampled paths: the statistics are those that filters are fed with, and every process gets the same bits."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from oracles.paper import paper_system
from oracles.random_systems import by_covariances, random_system
from zfusion.errors import InputError, RunError
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.sampling import SamplePath
from zfusion.model.statistics import step_models
from zfusion.model.streams import BLOCK, Recent, Seeds
from zfusion.model.system import Sensor, System

SYSTEMS: dict[str, Callable[[], System]] = {
    "paper": paper_system,
    "varying": lambda: random_system(np.random.default_rng(5), ids=[1, 2, 3], varying=True),
    "named": lambda: random_system(np.random.default_rng(6), ids=["a", "b"], nx=3),
    "covariances": lambda: by_covariances(random_system(np.random.default_rng(7), ids=[1, 2, 3], nx=2)),
}
PATHS = 1000


@pytest.mark.parametrize("name", SYSTEMS)
def test_paths_have_the_statistics_that_filters_are_fed_with(name: str) -> None:
    """Estimates of mean, Cov[x_k], Q, Q1, W, V, B and R from many seeds, within 4.5 of their standard deviations."""
    system = SYSTEMS[name]()
    steps = range(1, 5)
    draws: dict[str, dict[int, list[np.ndarray]]] = {
        kind: {k: [] for k in range(-1, max(steps) + 1)} for kind in "xywv"
    }
    for seed in range(PATHS):
        path, noise = SamplePath(system, seed), system.noise.sampler(Seeds(seed))
        w, v = noise.process(0), np.hstack([noise.sensor(i, 0) for i in system.ids])
        for k in range(max(steps) + 1):
            draws["x"][k].append(path.truth(k))
            draws["w"][k - 1].append(w[k])
            if k:
                draws["y"][k].append(np.hstack([path.measurement(i, k) for i in system.ids]))
                draws["v"][k].append(v[k])
    x, y, ws, vs = ({k: np.array(a) for k, a in draws[kind].items()} for kind in "xywv")

    def agree(estimates: np.ndarray, exact: np.ndarray) -> None:
        bound = 4.5 * estimates.std(axis=0) / np.sqrt(PATHS) + 1e-9
        assert (np.abs(estimates.mean(axis=0) - exact) <= bound).all()

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[:, :, None] * b[:, None, :]

    for k, (model, moments) in zip(steps, step_models(system, system.ids), strict=False):
        moved, seen = x[k] - x[k - 1] @ model.F.T, y[k] - x[k] @ model.H.T
        agree(x[k], moments.mean)
        agree(product(x[k] - moments.mean, x[k] - moments.mean), moments.covariance)
        agree(product(moved, moved), model.Q)
        agree(product(ws[k - 1], x[k - 1]), model.Q1)
        agree(product(x[k], vs[k]), model.B)
        agree(product(seen, seen), model.R)
        if k > 1:
            agree(product(ws[k - 1], y[k - 1]), model.W)
            agree(product(vs[k], y[k - 1]), model.V)


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_order_of_asking_does_not_matter(name: str) -> None:
    """Forwards for all sensors, beside late and backward steps for one sensor alone: the same bits."""
    system = SYSTEMS[name]()
    path, other = SamplePath(system, 12), SamplePath(system, 12)
    last = system.ids[-1]
    wanted = {}
    for k in range(1, 5 * BLOCK):
        for i in system.ids:
            path.measurement(i, k)
        wanted[k] = path.truth(k).tobytes() + path.measurement(last, k).tobytes()
    for k in (3 * BLOCK + 7, 3 * BLOCK, 3 * BLOCK - 1, 4 * BLOCK + 1, BLOCK, 5, 1, 5 * BLOCK - 1):
        assert other.measurement(last, k).tobytes() == wanted[k][-other.measurement(last, k).nbytes :]
        assert other.truth(k).tobytes() + other.measurement(last, k).tobytes() == wanted[k]


def test_another_process_gets_the_same_bits() -> None:
    """A process of its own that begins at step 600, as after a restart, and knows one sensor only."""
    script = (
        "from oracles.paper import paper_system\n"
        "from zfusion.model.sampling import SamplePath\n"
        "path = SamplePath(paper_system(), 99)\n"
        "print(*(path.measurement(3, k).tobytes().hex() for k in range(600, 620)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    path = SamplePath(paper_system(), 99)
    for k in range(1, 600):
        path.truth(k)
        path.measurement(1, k)
    assert done.stdout.split() == [path.measurement(3, k).tobytes().hex() for k in range(600, 620)]


def test_seeds_differ_and_sensors_are_independent_of_one_another() -> None:
    """Leaving a sensor out changes neither the truth nor the others' measurements; another seed changes all."""
    system = paper_system()
    noise = system.noise
    fewer = replace(
        system, sensors=system.sensors[1:], noise=replace(noise, sensors={i: noise.sensors[i] for i in (2, 3, 4)})
    )
    path, part, other = SamplePath(system, 1), SamplePath(fewer, 1), SamplePath(system, 2)
    for k in range(1, 300):
        assert path.truth(k) == part.truth(k)
        assert path.measurement(4, k) == part.measurement(4, k)
        assert path.truth(k) != other.truth(k)


def test_the_path_obeys_the_equations() -> None:
    """With known matrices that vary, x_{k+1} - F_k x_k and y_k - H_k x_k are the noises themselves, across blocks."""
    system = random_system(np.random.default_rng(3), ids=[1, 2], multiplicative=False, varying=True)
    path, noise = SamplePath(system, 4), system.noise.sampler(Seeds(4))
    for k in (1, 2, 3, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK):
        block, row = divmod(k, BLOCK)
        moved = path.truth(k) - system.F.at(k - 1).mean @ path.truth(k - 1)
        seen = path.measurement(2, k) - system.by_id[2].H.at(k).mean @ path.truth(k)
        assert np.allclose(moved, noise.process(block)[row], atol=1e-12)
        assert np.allclose(seen, noise.sensor(2, block)[row], atol=1e-12)


def test_random_matrices_are_drawn_anew_each_step() -> None:
    """y / x of the third sensor of the example, without noise: 0.74 or 0, in runs as short as chance makes them."""
    system = paper_system()
    silent = replace(
        system.noise, white={name: replace(w, covariance=[[0.0]]) for name, w in system.noise.white.items()}
    )
    path = SamplePath(replace(system, noise=silent), 3)
    gains = np.array([path.measurement(3, k)[0] / path.truth(k)[0] for k in range(1, 400)])
    assert set(np.round(gains, 9).tolist()) == {0.0, 0.74}
    switches = (np.diff(gains) != 0).sum()
    assert abs(switches - 398 * 2 * 0.7 * 0.3) < 6 * np.sqrt(398 * 0.42)  # variance below the count's mean


def test_an_unstable_state_is_given_up_at_the_step_at_which_it_is_lost() -> None:
    noise = by_covariances(random_system(np.random.default_rng(1), nx=1, ids=[1], noise="white")).noise
    system = System(
        1,
        [1.0],
        [[0.0]],
        Schedule.constant(Fixed([[10.0]])),
        (Sensor(1, noise.sizes[1], Schedule.constant(Fixed(np.ones((noise.sizes[1], 1))), 1)),),
        noise,
    )
    path = SamplePath(system, 0)
    assert np.isfinite(path.truth(300)).all()
    lost = next(k for k in range(300, 320) if not _finite(path, k))
    assert abs(path.truth(lost - 1)[0]) > 1e306
    with pytest.raises(RunError, match=f"at step {lost}"):
        path.measurement(1, lost)
    with pytest.raises(RunError, match=f"at step {lost}"):
        path.truth(5000)


def _finite(path: SamplePath, k: int) -> bool:
    try:
        path.truth(k)
    except RunError:
        return False
    return True


def test_steps_and_sensors_that_do_not_exist_are_refused() -> None:
    path = SamplePath(paper_system(), 0)
    with pytest.raises(ValueError, match="no step -1"):
        path.truth(-1)
    with pytest.raises(ValueError, match="no step 0: the first is 1"):
        path.measurement(1, 0)
    with pytest.raises(KeyError):
        path.measurement(9, 1)
    for seed in (-1, 1.5, True):
        with pytest.raises(InputError, match="seed: expected an integer >= 0"):
            SamplePath(paper_system(), seed)


def test_samples_cannot_be_changed() -> None:
    path = SamplePath(paper_system(), 0)
    for value in (path.truth(3), path.measurement(1, 3)):
        with pytest.raises(ValueError, match="read-only"):
            value[0] = 0


def test_memory_is_bounded() -> None:
    made: list[int] = []
    recent = Recent(lambda block: made.append(block) or block, keep=2)
    assert [recent(b) for b in (0, 1, 0, 2, 0, 1, 2)] == [0, 1, 0, 2, 0, 1, 2]
    assert made == [0, 1, 2, 1, 2]


def test_streams_of_different_purposes_and_blocks_differ() -> None:
    seeds = Seeds(0)
    firsts = {
        seeds.generator(*purpose, block=block).random()
        for purpose in (("a",), ("b",), ("a", "b"), ("ab",), ("a/b",), ("('a',",))
        for block in (0, 1, -1)
    }
    assert len(firsts) == 18
    stream = seeds.streams("a", block=0)
    assert stream("b") is stream("b")
    assert stream("c").random() == seeds.generator("a", "c", block=0).random()
