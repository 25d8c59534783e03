"""The covariance recursion against projection on the stacked measurements, and what it must do in the long run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from oracles import brute_force, paper, random_systems, tracking
from oracles.brute_force import Estimates, StackedSystem, Used
from zfusion.methods import covariances, layout
from zfusion.methods.covariances import State, advance, forget, prior
from zfusion.methods.layout import Blocks, Layout
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.noise import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.statistics import StepModel, prior_moments, step_models
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId

STEPS = 12
NAMES: tuple[NodeId, ...] = ("attic", "cellar", "hall", "yard")
KINDS: list[dict[str, Any]] = [
    {"nx": 1},
    {"nx": 2, "ids": NAMES, "varying": True},
    {"nx": 3},
    {"nx": 3, "noise": "white"},
    {"nx": 2, "radius": 1.2, "varying": True},
    {"nx": 2, "multiplicative": False},
    {"radius": 1.3, "multiplicative": False},
    {"mean": 5.0},
]
Neighbours = Mapping[NodeId, tuple[NodeId, ...]]


class Recursion:
    """The recursion for chosen nodes of a system, step by step."""

    def __init__(
        self, system: System, neighbours: Neighbours, pairs: Iterable[tuple[NodeId, NodeId]] | None = None
    ) -> None:
        self.layout = Layout.build(neighbours, {sensor.id: sensor.ny for sensor in system.sensors}, pairs)
        self.state = prior(self.layout, system.initial_covariance)
        self.moments = prior_moments(system)
        self._models = step_models(system, system.ids)
        self.model: StepModel | None = None

    def step(self, used: Neighbours) -> State:
        self.model, self.moments = next(self._models)
        self.state = advance(self.layout, self.state, self.model, self.layout.used(used))
        return self.state

    def covariance(self, i: NodeId, j: NodeId) -> Array:
        """P^(ij)."""
        found: Array = self.state.P.flat.take(self.layout.among([i, j], len(self.moments.mean)))[0, 1]
        return found

    @property
    def own(self) -> Array:
        """P^(ii) of all nodes, (n, nx, nx)."""
        return self.layout.in_order(self.layout.own(self.state.P))


def identical(one: Blocks, other: Blocks) -> bool:
    return all(map(np.array_equal, one.arrays, other.arrays))


def at_step(used: Used, k: int) -> dict[NodeId, tuple[NodeId, ...]]:
    return {i: members for (i, step), members in used.items() if step == k}


def projected(
    rng: np.random.Generator, system: System, neighbours: Neighbours
) -> tuple[Used, StackedSystem, dict[NodeId, Estimates]]:
    """Random used sets, and what projection makes of them."""
    used = random_systems.random_used_sets(rng, neighbours, STEPS)
    stacked = brute_force.stack(system, STEPS)
    return used, stacked, {i: brute_force.intermediate(stacked, i, used) for i in neighbours}


def worst(recursion: Recursion, estimates: Mapping[NodeId, Estimates], k: int) -> float:
    """Largest difference of any P^(ij) from the projection's, in parts of the two nodes' own variances."""
    size = {i: np.abs(e.errors[k] @ e.errors[k].T).max() ** 0.5 for i, e in estimates.items()}
    return max(
        float(np.abs(recursion.covariance(i, j) - e.errors[k] @ f.errors[k].T).max() / (size[i] * size[j]))
        for i, e in estimates.items()
        for j, f in estimates.items()
    )


# --- against projection


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("seed", range(4))
def test_all_pairs_are_those_of_projection_whatever_was_used(kind: dict[str, Any], seed: int) -> None:
    rng = np.random.default_rng([1, seed])
    system = random_systems.random_system(rng, **kind)
    if seed == 3:
        system = random_systems.by_covariances(system)
    neighbours = random_systems.random_graph(rng, system.ids)
    used, _, estimates = projected(rng, system, neighbours)
    recursion = Recursion(system, neighbours)
    for k in range(1, STEPS + 1):
        recursion.step(at_step(used, k))
        assert worst(recursion, estimates, k) < 1e-11


def test_the_published_example() -> None:
    recursion = Recursion(paper.paper_system(), paper.NEIGHBOURS)
    itself: Neighbours = {i: (i,) for i in paper.NEIGHBOURS}
    alone = Recursion(paper.paper_system(), itself, pairs=())
    everything = Recursion(paper.paper_system(), {1: (1, 2, 3, 4)})
    for k in range(1, 101):
        recursion.step(paper.NEIGHBOURS)
        alone.step(itself)
        everything.step({1: (1, 2, 3, 4)})
        if k in paper.ERROR_VARIANCES:
            wanted = paper.ERROR_VARIANCES[k]
            for estimate, found in {"intermediate": recursion, "local": alone, "centralized": everything}.items():
                np.testing.assert_allclose(found.own[:, 0, 0], wanted[estimate], rtol=0, atol=1e-9)


def test_every_pair_is_symmetric_to_the_last_bit() -> None:
    rng = np.random.default_rng(2)
    for kind in KINDS:
        system = random_systems.random_system(rng, **kind)
        neighbours = random_systems.random_graph(rng, system.ids)
        recursion = Recursion(system, neighbours)
        for _ in range(5):
            state = recursion.step(neighbours)
            assert identical(recursion.layout.flip(state.P), state.P)
            assert identical(recursion.layout.flip(state.Pi), state.Pi)


def test_a_layout_of_chosen_pairs_gives_the_same_as_one_of_all() -> None:
    rng = np.random.default_rng(3)
    system = random_systems.random_system(rng, ids=range(7), nx=2)
    neighbours = random_systems.random_graph(rng, system.ids)
    pairs: list[tuple[NodeId, NodeId]] = [(0, 3), (5, 3), (3, 5), (6, 1), (2, 2)]
    every, chosen = Recursion(system, neighbours), Recursion(system, neighbours, pairs)
    used = random_systems.random_used_sets(rng, neighbours, STEPS)
    assert chosen.layout.blocks[0].partners.shape[1] == 3  # node 3 and two others: the rest is padding
    for k in range(1, STEPS + 1):
        every.step(at_step(used, k))
        chosen.step(at_step(used, k))
        for i, j in [*pairs, *((i, i) for i in system.ids)]:
            np.testing.assert_allclose(chosen.covariance(i, j), every.covariance(i, j), rtol=1e-12, atol=1e-14)
            np.testing.assert_array_equal(chosen.covariance(j, i), chosen.covariance(i, j).T)
    with pytest.raises(KeyError):
        chosen.covariance(0, 1)


def test_nodes_of_very_different_sizes_are_padded_in_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hub, its leaves, and a chain: the same numbers as with one size for all."""
    rng = np.random.default_rng(13)
    system = random_systems.random_system(rng, ids=range(9), nx=2)
    neighbours: Neighbours = {0: tuple(range(7)), **{i: (0, i) for i in range(1, 7)}, 7: (6, 7, 8), 8: (8,)}
    used = random_systems.random_used_sets(rng, neighbours, STEPS)
    pairs = [(i, j) for members in neighbours.values() for i in members for j in members]
    one = Recursion(system, neighbours, pairs)
    monkeypatch.setattr(layout, "WASTE", 0)
    several = Recursion(system, neighbours, pairs)
    assert len(one.layout.classes) == 1
    assert len(several.layout.classes) > 2
    for k in range(1, STEPS + 1):
        for recursion in (one, several):
            if k == 6:
                covariance = recursion.moments.covariance
                recursion.state = forget(recursion.layout, recursion.state, [0, 3, 8], covariance)
            recursion.step(at_step(used, k))
        for i, j in pairs:
            np.testing.assert_allclose(several.covariance(i, j), one.covariance(i, j), rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(several.own, one.own, rtol=1e-11)
        assert identical(several.layout.flip(several.state.P), several.state.P)


@pytest.mark.parametrize("changed", StepModel._fields)
def test_what_changes_in_a_model_is_noticed_whatever_stays_the_same(changed: str) -> None:
    """The statistics are picked anew only where they are other objects than in the step before."""
    rng = np.random.default_rng(14)
    system = random_systems.random_system(rng, ids=NAMES, nx=2)
    recursion = Recursion(system, dict.fromkeys(NAMES, NAMES))
    for _ in range(3):
        state = recursion.step(dict.fromkeys(NAMES, NAMES))
    assert recursion.model is not None
    model = recursion.model._replace(**{changed: 1.1 * getattr(recursion.model, changed)})
    found = advance(recursion.layout, state, model, state.used)
    wanted = advance(recursion.layout, state, StepModel(*map(np.copy, model)), state.used)
    assert identical(found.P, wanted.P)
    assert not identical(found.P, advance(recursion.layout, state, recursion.model, state.used).P)


def test_a_node_that_forgets_is_one_that_has_used_nothing_so_far() -> None:
    rng = np.random.default_rng(4)
    for kind in KINDS:
        system = random_systems.random_system(rng, **kind)
        neighbours = random_systems.random_graph(rng, system.ids)
        used = dict(random_systems.random_used_sets(rng, neighbours, STEPS, late=0))
        lost = set(system.ids[::2])
        forgetful, newborn = Recursion(system, neighbours), Recursion(system, neighbours)
        for k in range(1, STEPS + 1):
            if k == 6:
                forgetful.state = forget(forgetful.layout, forgetful.state, lost, forgetful.moments.covariance)
            forgetful.step(at_step(used, k))
            newborn.step({i: () if k < 6 and i in lost else used[i, k] for i in neighbours})
        wanted = newborn.state.P.flat
        np.testing.assert_allclose(forgetful.state.P.flat, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())


def test_what_is_known_of_a_past_state_is_not_changed_by_going_on() -> None:
    rng = np.random.default_rng(5)
    system = random_systems.random_system(rng, ids=NAMES)
    recursion = Recursion(system, dict.fromkeys(NAMES, NAMES))
    states = [recursion.step(dict.fromkeys(NAMES, NAMES[:k])) for k in (4, 2, 0, 3)]
    copies = [arrays_of(state, np.copy) for state in states]
    forget(recursion.layout, recursion.state, ["hall"], recursion.moments.covariance)
    recursion.step({})
    for state, copy in zip(states, copies, strict=True):
        assert all(map(np.array_equal, arrays_of(state), copy))


def arrays_of(state: State, act: Callable[[Array], Array] = np.asarray) -> list[Array]:
    by_pair = (array for blocks in (state.P, state.E, state.Pi) for array in blocks.arrays)
    return [act(array) for array in (*by_pair, *state.X, *state.A)]


# --- innovations that can be predicted


def fixed_system(
    F: Array, Q: Array, sensors: Mapping[NodeId, tuple[Array, dict[int, float]]], P0: float = 1.0
) -> System:
    """A system without random matrices; sensors by H and their noise, lag -> weight of one white noise of all."""
    nx = len(F)

    def taps(rows: int, weights: Mapping[int, float]) -> tuple[Tap, ...]:
        return tuple(Tap("n", lag, Schedule((np.full((rows, 1), weight),))) for lag, weight in weights.items())

    return System(
        nx=nx,
        initial_mean=np.zeros(nx),
        initial_covariance=P0 * np.eye(nx),
        F=Schedule((Fixed(F),)),
        sensors=tuple(Sensor(i, len(H), Schedule((Fixed(H),), first=1)) for i, (H, _) in sensors.items()),
        noise=MovingAverageNoise(
            white={"w": WhiteNoise(Q), "n": WhiteNoise(np.eye(1))},
            process=(Tap("w", 0, Schedule((np.eye(nx),))),),
            sensors={i: taps(len(H), weights) for i, (H, weights) in sensors.items()},
        ),
    )


ONE = np.ones((1, 1))
DRIFT = np.array([[1.0, 1.0], [0.0, 1.0]])
POSITION, VELOCITY = np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])
NOISY, EXACT = {0: 1.0}, {0: 0.0}
PREDICTABLE = {
    "the same sensor three times": fixed_system(
        0.9 * ONE, 0.5 * ONE, {1: (ONE, NOISY), 2: (ONE, NOISY), 3: (ONE, NOISY)}
    ),
    "one noise in different sensors": fixed_system(
        0.9 * ONE, 0.5 * ONE, {1: (ONE, NOISY), 2: (1.5 * ONE, NOISY), 3: (2 * ONE, NOISY)}
    ),
    "sensors without noise": fixed_system(
        0.9 * ONE, 0.5 * ONE, {1: (ONE, EXACT), 2: (ONE, EXACT), 3: (2 * ONE, EXACT)}
    ),
    "a static state and sensors without noise": fixed_system(
        ONE, 0 * ONE, {1: (ONE, EXACT), 2: (ONE, NOISY), 3: (ONE, EXACT)}, P0=1e6
    ),
    "a noise that cancels over time": fixed_system(
        0.9 * ONE, 0.5 * ONE, {1: (ONE, {0: 1.0, -1: 1.0}), 2: (ONE, {0: 1.0, -1: -1.0}), 3: (0 * ONE, EXACT)}
    ),
    "an exact position": fixed_system(
        DRIFT, 0.01 * np.eye(2), {1: (POSITION, EXACT), 2: (POSITION, NOISY), 3: (VELOCITY, NOISY)}
    ),
    "an exact position that nothing pushes": fixed_system(
        DRIFT, np.zeros((2, 2)), {1: (POSITION, EXACT), 2: (POSITION, NOISY), 3: (VELOCITY, NOISY)}
    ),
    "nothing to estimate": fixed_system(
        0.9 * ONE, 0 * ONE, {1: (ONE, EXACT), 2: (ONE, NOISY), 3: (ONE, NOISY)}, P0=0.0
    ),
}


@pytest.mark.parametrize("name", PREDICTABLE)
def test_a_singular_innovation_covariance_is_a_legal_one(name: str) -> None:
    system = PREDICTABLE[name]
    neighbours: Neighbours = {1: (1, 2, 3), 2: (1, 2), 3: (3,)}
    stacked = brute_force.stack(system, STEPS)
    always = brute_force.always(neighbours, STEPS)
    estimates = {i: brute_force.intermediate(stacked, i, always) for i in neighbours}
    recursion = Recursion(system, neighbours)
    for k in range(1, STEPS + 1):
        state = recursion.step(neighbours)
        scale = max(np.abs(recursion.moments.covariance).max(), 1e-300)
        for i in neighbours:
            for j in neighbours:
                wanted = estimates[i].errors[k] @ estimates[j].errors[k].T
                np.testing.assert_allclose(recursion.covariance(i, j), wanted, rtol=0, atol=1e-11 * scale)
        assert all(np.isfinite(A).all() for A in state.A)


def test_what_cannot_be_predicted_is_not_taken_for_it() -> None:
    """Two sensors that are nearly the same: the small difference is information, and it is used."""
    system = fixed_system(0.9 * ONE, 0.5 * ONE, {1: (ONE, NOISY), 2: (1.001 * ONE, NOISY)})
    recursion = Recursion(system, {1: (1, 2)})
    for _ in range(3):
        recursion.step({1: (1, 2)})
    assert recursion.own[0, 0, 0] < 1e-9


# --- in the long run


def steps_until_settled(recursion: Recursion, used: Neighbours, limit: int) -> int:
    for k in range(1, limit + 1):
        before = recursion.state
        if recursion.step(used) is before:
            return k
    raise AssertionError(f"not settled after {limit} steps")


@pytest.mark.parametrize(
    "kind", [{"nx": 1}, {"nx": 2}, {"nx": 3, "noise": "white"}, {"nx": 3, "multiplicative": False}]
)
def test_a_time_invariant_network_settles_and_then_costs_nothing(
    kind: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(6)
    system = random_systems.random_system(rng, **kind)
    neighbours = random_systems.random_graph(rng, system.ids)
    recursion = Recursion(system, neighbours)
    steps_until_settled(recursion, neighbours, 1000)

    work: list[int] = []
    compute = covariances._predict
    monkeypatch.setattr(covariances, "_predict", lambda *arguments: work.append(1) or compute(*arguments))
    settled = recursion.state
    for _ in range(50):
        assert recursion.step(neighbours) is settled
    assert not work
    recursion.step({**neighbours, system.ids[0]: ()})
    assert len(work) == 1
    nothing: Neighbours = {}
    steps_until_settled(recursion, nothing, 1000)
    recursion.state = forget(recursion.layout, recursion.state, system.ids, recursion.moments.covariance)
    work.clear()
    recursion.step(nothing)
    assert len(work) == 1
    assert steps_until_settled(recursion, neighbours, 1000) > 2
    np.testing.assert_allclose(recursion.state.P.flat, settled.P.flat, rtol=1e-11, atol=1e-13)


def test_settling_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    system, neighbours = paper.paper_system(), paper.NEIGHBOURS
    settling = Recursion(system, neighbours)
    states = [settling.step(neighbours) for _ in range(1500)]
    assert states[-1] is states[-2]
    monkeypatch.setattr(covariances, "_settled", lambda *_: False)
    working = Recursion(system, neighbours)
    for state in states:
        assert working.step(neighbours) is not state
        np.testing.assert_allclose(state.P.flat, working.state.P.flat, rtol=1e-12)
    assert working.state.gains is not None
    assert states[-1].gains is not None
    np.testing.assert_allclose(states[-1].gains[0].K, working.state.gains[0].K, rtol=1e-12)


def test_a_target_is_tracked_without_drift() -> None:
    """Its own variance grows like k³; that of the errors, worked on at every step, must not move.

    A recursion that lets rounding in the antisymmetric part of a pair grow is at 1e41 after 400 steps.
    """
    neighbours: Neighbours = {1: (1, 2), 2: (2, 3), 3: (1, 3)}
    recursion = Recursion(tracking.target({1: 1.0, 2: 1.5, 3: 2.0}, origin=1e6), neighbours)
    for _ in range(3):
        state = recursion.step(neighbours)
    assert recursion.model is not None
    used, early = state.used, state
    for k in range(4, 10_001):
        state = advance(recursion.layout, state, recursion.model, used)._replace(settled=False)
        if k == 1_000:
            early = state
    (now,), (then,) = state.P.arrays, early.P.arrays
    deviation = np.sqrt(then[:, :, 0].diagonal(0, 1, 2))
    scale = deviation[:, :, None, None] * deviation[recursion.layout.blocks[0].partners][:, None]
    assert np.abs((now - then) / scale).max() < 1e-10
    assert np.linalg.eigvalsh(now[:, :, 0]).min() > 1e-4
    assert identical(recursion.layout.flip(state.P), state.P)
