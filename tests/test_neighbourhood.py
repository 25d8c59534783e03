"""A node's bookkeeping of its neighbours: whatever becomes known when, what is called exact is so, and nothing less."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oracles import random_systems
from zfusion.methods import neighbourhood
from zfusion.methods.covariances import State, advance, prior
from zfusion.methods.fusion import joint_index
from zfusion.methods.layout import Layout
from zfusion.methods.neighbourhood import Neighbourhood, StepModels
from zfusion.model.statistics import prior_moments, step_models
from zfusion.model.system import System
from zfusion.model.types import NodeId
from zfusion.used_sets import History, Ledger, UsedSet

IDS: tuple[NodeId, ...] = (1, 2, 3, 4, 5)
OWN: NodeId = 2
NEIGHBOURS: dict[NodeId, tuple[NodeId, ...]] = {2: (1, 2, 3, 4), 1: (1, 5), 3: (2, 3, 5), 4: (1, 4)}
OTHERS = (1, 3, 4)
RUNS = 3
"""Runs of history in a message: few, so that gaps stay open."""


@cache
def small_system() -> System:
    return random_systems.random_system(np.random.default_rng(1), ids=IDS, nx=2)


def make(system: System) -> Neighbourhood:
    return Neighbourhood(
        OWN,
        NEIGHBOURS,
        {sensor.id: sensor.ny for sensor in system.sensors},
        lambda: step_models(system, IDS),
        prior_moments(system),
    )


def fresh(system: System, histories: Mapping[NodeId, History], steps: int) -> tuple[Layout, State]:
    """The recursion from step 0 on with these used sets, none where they are not known."""
    layout = Layout.build(NEIGHBOURS, {sensor.id: sensor.ny for sensor in system.sensors})
    state = prior(layout, system.initial_covariance)
    models = step_models(system, IDS)
    for k in range(1, steps + 1):
        used = {i: history.at(k) or () for i, history in histories.items()}
        state = advance(layout, state, next(models)[0], layout.used(used))
    return layout, state


def assert_exact(tracked: Neighbourhood, known: frozenset[NodeId], truth: tuple[Layout, State]) -> None:
    """The blocks of all that are called exact are those of the fresh recursion."""
    layout, state = truth
    others = tuple(sorted(known - {OWN}))
    wanted = state.P.flat.take(joint_index(layout, (OWN, *others), 2))
    np.testing.assert_allclose(tracked.joint(others), wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


class Story:
    """Nodes that live, die and use what they use, and a node that hears of it now and then."""

    def __init__(self, seed: int, system: System | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        self.system = system or small_system()
        self.true: dict[NodeId, History] = {i: History(1) for i in NEIGHBOURS}
        self.ledger = Ledger(OWN, 1)
        self.tracked = make(self.system)
        self.used: dict[NodeId, UsedSet] = dict(NEIGHBOURS)

    def step(self, k: int, heard: set[NodeId], reborn: set[NodeId], asked: set[NodeId]) -> None:
        """One step: who is reborn at it, whose message of it arrives, whose whole history is told in answer."""
        for i, members in NEIGHBOURS.items():
            if i in reborn and i != OWN:
                self.true[i] = History(k)
            if self.rng.random() < 0.4:
                self.used[i] = tuple(j for j in members if self.rng.random() < 0.7)
            self.true[i].learn(k, self.used[i])
            if i == OWN or i in heard:
                self.ledger.learn(i, self.true[i].born, k, self.used[i], self.true[i].runs(k - 1, RUNS))
        for i in asked:
            self.ledger.fill(i, self.true[i].born, k, self.true[i].runs(k))
        self.tracked.follow(k, self.ledger)

    def check(self, k: int) -> int:
        """The number of neighbours that are exact, after all has been found right."""
        known = self.tracked.exact(k)
        could = {i for i in OTHERS if (h := self.ledger.of(i)) is not None and h.first_unknown(h.born, k) is None}
        assert known - {OWN} == could
        if could:
            lives = {i: self.true[i] for i in known}
            assert_exact(self.tracked, known, fresh(self.system, lives, k))
        for i in set(OTHERS) - could:
            history = self.ledger.of(i)
            if history is not None and history.last == k:  # heard, and yet not exact: what is missing is known
                missing = self.tracked.missing(i, k, self.ledger)
                assert missing == history.first_unknown(history.born, k)
        return len(could)


some = st.sets(st.sampled_from(OTHERS))
events = st.lists(
    st.tuples(some, st.sets(st.sampled_from((*OTHERS, *[0] * 20))), st.sets(st.sampled_from((*OTHERS, *[0] * 10)))),
    min_size=5,
    max_size=22,
)


@pytest.mark.parametrize("window", [2, 5, 64])
@settings(derandomize=True, deadline=None, max_examples=60)
@given(events, st.integers(0, 1000))
def test_what_is_called_exact_is_and_all_is_that_can_be(
    window: int, story: list[tuple[set[NodeId], set[NodeId], set[NodeId]]], seed: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbourhood, "WINDOW", window)
        told = Story(seed)
        for k, (heard, reborn, asked) in enumerate(story, start=1):
            told.step(k, heard, reborn - {0}, asked - {0})
            told.check(k)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(events, st.integers(0, 1000))
def test_what_is_called_exact_is_so_while_catching_up_too(
    story: list[tuple[set[NodeId], set[NodeId], set[NodeId]]], seed: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbourhood, "WINDOW", 2)
        patch.setattr(neighbourhood, "CATCH_UP", 2 * neighbourhood.UNSETTLED)
        told = Story(seed)
        for k, (heard, reborn, asked) in enumerate(story, start=1):
            told.step(k, heard, reborn - {0}, asked - {0})
            known = told.tracked.exact(k)
            if known:
                assert_exact(told.tracked, known, fresh(told.system, {i: told.true[i] for i in known}, k))
        end = 2 * len(story) + 5
        for k in range(len(story) + 1, end):
            told.step(k, set(OTHERS), set(), set(OTHERS))
        assert told.check(end - 1) == len(OTHERS)


def test_a_new_life_that_began_while_the_former_one_still_spoke() -> None:
    """What had seemed exact is not, until the gap in the new life's history is filled."""
    story = Story(11)
    for k in range(1, 11):
        story.step(k, set(OTHERS), set(), set())
    new = History(9)
    for k, used in ((9, (2,)), (10, (3,)), (11, ()), (12, (2, 3))):
        new.learn(k, used)
    story.ledger.learn(3, 9, 12, (2, 3), [(11, ())])
    story.tracked.follow(10, story.ledger)
    assert story.tracked.exact(10) == {1, 2, 4}
    story.true[3] = new
    assert story.tracked.missing(3, 10, story.ledger) == 9
    story.ledger.fill(3, 9, 10, new.runs(10))
    story.tracked.follow(10, story.ledger)
    assert story.check(10) == 3


def test_neighbours_lost_and_recovered_in_any_order() -> None:
    """Gaps longer than the window, one inside the other, filled from the inside and from the outside."""
    for order in ((1, 3, 4), (4, 3, 1), (3, 1, 4)):
        story = Story(7)
        silent = {1: range(5, 90), 3: range(20, 85), 4: range(12, 95)}
        answered = {100 + 3 * n: i for n, i in enumerate(order)}
        exact = {}
        for k in range(1, 115):
            heard = {i for i in OTHERS if k not in silent[i]}
            story.step(k, heard, set(), {answered[k]} if k in answered else set())
            exact[k] = story.tracked.exact(k) - {OWN}
        assert story.check(114) == 3
        assert exact[4] == {1, 3, 4}
        assert exact[99] == set()
        assert exact[109] == {1, 3, 4}
        assert exact[104] == set(order[:2])


def test_a_long_gap_is_caught_up_with_in_bounded_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbourhood, "CATCH_UP", 10 * neighbourhood.UNSETTLED)
    story = Story(8)
    work: list[int] = []

    def counted(*arguments: object) -> State:
        work.append(1)
        return advance(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(neighbourhood, "advance", counted)
    for k in range(1, 101):
        story.step(k, {3} if k < 5 else set(), set(), set())
    assert len(work) <= 5  # nobody to fuse with: nothing to be computed
    exact = {}
    for k in range(101, 120):
        work.clear()
        story.step(k, {3}, set(), {3} if k == 101 else set())
        exact[k] = story.tracked.exact(k)
        assert len(work) <= 10
    assert not exact[109]
    assert exact[119] == {OWN, 3}
    assert story.check(119) == 1


def test_whoever_contradicts_itself_beyond_the_window_is_not_trusted_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbourhood, "WINDOW", 5)
    story = Story(9)
    for k in range(1, 20):
        story.step(k, set(OTHERS), set(), set())
    assert story.tracked.exact(19) == set(NEIGHBOURS)
    lie = (5,) if story.true[3].at(4) != (5,) else ()
    story.ledger.fill(3, 1, 4, [(4, lie)])
    story.step(20, set(OTHERS), set(), set())
    assert story.tracked.exact(20) == {1, 2, 4}
    assert_exact(story.tracked, frozenset({1, 2, 4}), fresh(story.system, story.true, 20))
    story.step(21, set(OTHERS), {3}, set())
    assert story.check(21) == 3  # a new life is believed


def test_whoever_contradicts_what_it_said_before_its_gap_is_not_followed_from_there() -> None:
    story = Story(12)
    for k in range(1, 100):
        story.step(k, set(OTHERS) if k < 20 else {1, 4}, set(), set())
    lie = (5,) if story.true[3].at(10) != (5,) else ()
    story.ledger.fill(3, 1, 10, [(10, lie)])
    story.step(100, set(OTHERS), set(), {3})
    assert story.tracked.exact(100) == {1, 2, 4}
    assert story.tracked.missing(3, 100, story.ledger) is None  # nothing that it could say would help
    story.step(101, set(OTHERS), {3}, set())
    assert story.check(101) == 3


def test_the_state_is_the_same_object_once_all_has_settled() -> None:
    system = random_systems.random_system(np.random.default_rng(10), ids=IDS, nx=2, multiplicative=False)
    tracked, ledger = make(system), Ledger(OWN, 1)
    states = []
    for k in range(1, 500):
        for i, members in NEIGHBOURS.items():
            ledger.learn(i, 1, k, members, [(1, members)] if k > 1 else [])
        tracked.follow(k, ledger)
        states.append(tracked.state)
    assert all(state is states[-1] for state in states[400:])
    ledger.learn(1, 1, 500, (), [(1, (1, 5))])
    tracked.follow(500, ledger)
    assert tracked.state is not states[-1]


def test_past_statistics_are_computed_again_when_they_are_asked_for() -> None:
    system = small_system()
    models = StepModels(lambda: step_models(system, IDS))
    wanted = [item for item, _ in zip(step_models(system, IDS), range(300), strict=False)]
    for step in (1, 300, 299, 237, 2, 150, 1, 300):
        model, moments = models.at(step)
        for found, right in zip((*model, *moments), (*wanted[step - 1][0], *wanted[step - 1][1]), strict=True):
            np.testing.assert_array_equal(found, right)
