"""What is known of used sets, against a model that remembers every step on its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zfusion import used_sets
from zfusion.used_sets import History, Ledger, Run, UsedSet

SETS: list[UsedSet] = [(), (1,), (1, 2), (2, 3)]
LAST = 30
fixed = settings(derandomize=True, deadline=None, max_examples=300)


class Naive:
    """A used set for each step that was told of."""

    def __init__(self, born: int) -> None:
        self.born = born
        self.known: dict[int, UsedSet] = {}

    def tell(self, told: list[Run], end: int) -> int | None:
        changed = None
        for number, (start, used) in enumerate(told):
            stop = told[number + 1][0] if number + 1 < len(told) else end + 1
            for step in range(start, stop):
                if self.known.get(step) != used:
                    changed = step if changed is None else min(changed, step)
                    self.known[step] = used
        return changed

    def at(self, step: int) -> UsedSet | None:
        return () if step < self.born else self.known.get(step)


@st.composite
def tellings(draw: st.DrawFn, born: int) -> tuple[list[Run], int]:
    """Ascending runs, of which neighbours may be equal, and the last step that they speak of."""
    end = draw(st.integers(born, LAST))
    starts = sorted(draw(st.sets(st.integers(born, end), min_size=1, max_size=5)))
    return [(start, draw(st.sampled_from(SETS))) for start in starts], end


def assert_same(history: History, naive: Naive) -> None:
    steps = range(LAST + 3)
    assert [history.at(step) for step in steps] == [naive.at(step) for step in steps]
    for start in steps:
        unknown = [step for step in range(start, LAST + 3) if naive.at(step) is None]
        assert history.first_unknown(start, LAST + 2) == unknown[0]
        assert history.first_unknown(start, unknown[0] - 1) is None


@fixed
@given(st.data(), st.integers(1, 6))
def test_whatever_is_told_in_whatever_order(data: st.DataObject, born: int) -> None:
    history, naive = History(born), Naive(born)
    for runs, end in data.draw(st.lists(tellings(born), max_size=12)):
        if data.draw(st.booleans()):
            assert history.fill(runs, end) == naive.tell(runs, end)
        else:  # a message: the set of its step, and runs that end just before it
            earlier = [run for run in runs if run[0] < end]
            used = data.draw(st.sampled_from(SETS))
            assert history.learn(end, used, earlier) == naive.tell([*earlier, (end, used)], end)
        assert history.last == max(naive.known, default=born - 1)
        assert_same(history, naive)


@fixed
@given(st.data(), st.integers(1, 4))
def test_a_sender_that_repeats_its_last_runs_is_followed_through_losses(data: st.DataObject, limit: int) -> None:
    sender, receiver, naive = History(1), History(1), Naive(1)
    for step in range(1, LAST):
        used = data.draw(st.sampled_from(SETS))
        sender.learn(step, used)
        earlier = sender.runs(step - 1, limit)
        if data.draw(st.booleans()):
            assert receiver.learn(step, used, earlier) == naive.tell([*earlier, (step, used)], step)
    assert_same(receiver, naive)
    receiver.fill(sender.runs(LAST), sender.last)
    assert [receiver.at(step) for step in range(LAST)] == [sender.at(step) for step in range(LAST)]


@fixed
@given(st.data(), st.integers(1, LAST), st.integers(1, 6))
def test_runs_are_the_last_known_steps_in_a_row(data: st.DataObject, end: int, limit: int) -> None:
    history, naive = History(1), Naive(1)
    for runs, last in data.draw(st.lists(tellings(1), max_size=4)):
        history.fill(runs, last)
        naive.tell(runs, last)
    end = min(end, history.last)
    runs = history.runs(end)
    assert history.runs(end, limit) == runs[-limit:]
    first = runs[0][0] if runs else end + 1
    assert naive.at(first - 1) is None or first == 1
    for number, (start, used) in enumerate(runs):
        stop = runs[number + 1][0] if number + 1 < len(runs) else end + 1
        assert {naive.at(step) for step in range(start, stop)} == {used}
        assert number == 0 or runs[number - 1][1] != used


def test_a_message_a_step_costs_one_run_as_long_as_nothing_changes() -> None:
    history = History(1)
    for step in range(1, 10_000):
        assert history.learn(step, (1, 2), history.runs(step - 1, 16)) == step
    assert history.runs(9_999) == [(1, (1, 2))]


def test_only_so_many_runs_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(used_sets, "KEPT_RUNS", 4)
    history = History(1)
    for step in range(1, 11):
        history.learn(step, SETS[step % 2])
    assert history.runs(10) == [(step, SETS[step % 2]) for step in (7, 8, 9, 10)]
    assert history.at(6) is None
    assert history.first_unknown(1, 10) == 1
    history.fill([(5, SETS[2]), (6, SETS[1])], 6)
    assert len(history.runs(10)) == 4


def test_a_ledger_tells_from_which_step_on_something_has_changed() -> None:
    ledger = Ledger("own", born=1)
    ledger.learn("own", 1, 1, ("own",))
    ledger.learn("a", 1, 1, ("a",))
    assert ledger.take_changes() == {"own": 1, "a": 1}
    assert ledger.take_changes() == {}
    ledger.learn("a", 1, 4, ("a",))
    ledger.learn("a", 1, 5, ("a",), [(1, ("a",)), (2, ()), (4, ("a",))])
    assert ledger.take_changes() == {"a": 2}
    ledger.learn("a", 1, 5, ("a",), [(4, ("a",))])
    assert ledger.take_changes() == {}


def test_a_new_life_begins_with_nothing_and_a_former_one_is_not_listened_to() -> None:
    ledger = Ledger(1, born=1)
    ledger.learn(2, 1, 7, (2,), [(1, (1, 2))])
    ledger.take_changes()
    ledger.learn(2, 5, 9, (1,), [(8, ())])
    history = ledger.of(2)
    assert history is not None
    assert [history.at(step) for step in range(4, 10)] == [(), None, None, None, (), (1,)]
    assert ledger.take_changes() == {2: 5}
    ledger.learn(2, 1, 8, (2,), [(1, (1, 2))])
    assert not ledger.fill(2, 1, 7, [(1, (2,))])
    assert not ledger.fill(2, 6, 7, [(6, (2,))])
    assert not ledger.fill(3, 1, 7, [(1, (2,))])
    assert ledger.take_changes() == {}
    assert ledger.fill(2, 5, 7, [(5, (2,))])
    assert ledger.take_changes() == {2: 5}
    assert history.first_unknown(1, 9) is None
    assert ledger.of(3) is None


# --- senders that revise


@fixed
@given(st.data(), st.integers(1, 5), st.integers(0, 3))
def test_what_a_sender_may_have_revised_is_never_taken_for_known(data: st.DataObject, window: int, more: int) -> None:
    """Whatever is known of a step, after any message, is what that message was computed with, or nothing is known."""
    sender, ledger, then = Ledger("j", 1, window), Ledger("i", 1, window), dict[int, list[UsedSet | None]]()
    for step in range(1, LAST):
        for past in range(max(1, step - window), step):
            if data.draw(st.integers(0, 4)) == 0:
                sender.revise(past, data.draw(st.sampled_from(SETS)))
        used = data.draw(st.sampled_from(SETS))
        sender.learn("j", 1, step, used)
        own, known = sender.of("j"), ledger.of("j")
        assert own is not None
        then[step] = [own.at(past) for past in range(step + 1)]
        if data.draw(st.integers(0, 3)) == 0 and known is not None:  # an answer, of now or of an earlier moment
            end = data.draw(st.integers(1, step))
            final = end - window
            answer = [run for run in own.runs(step) if run[0] <= final]
            ledger.fill("j", 1, final, answer)
            assert all(known.at(past) in (None, then[known.last][past]) for past in range(1, known.last + 1))
        if data.draw(st.booleans()):
            ledger.learn("j", 1, step, used, own.runs(step - 1, window + more))
            known = ledger.of("j")
            assert known is not None
            assert known.at(step) == used
            assert all(known.at(past) in (None, then[step][past]) for past in range(1, step))
            assert all(known.at(past) is not None for past in range(max(1, step - window), step))
            past = data.draw(st.integers(1, step))
            told = [run for run in runs_of(then[past]) if run[0] < past][-(window + 1) :]
            agrees = ledger.agrees("j", 1, past, cast(UsedSet, then[past][past]), told)
            assert agrees <= all(known.at(s) in (None, then[past][s]) for s in range(1, past + 1))
            assert agrees or any(known.at(s) != then[past][s] for s in range(1, past + 1))


def runs_of(sets: Sequence[UsedSet | None]) -> list[Run]:
    """The sets of steps 1, 2, ... as runs."""
    return [(s, cast(UsedSet, u)) for s, u in enumerate(sets) if s and (s == 1 or u != sets[s - 1])]


def test_a_message_that_tells_less_than_may_have_been_revised_leaves_the_rest_unknown() -> None:
    history = History(1)
    for step in range(1, 9):
        history.learn(step, SETS[1])
    assert history.learn(9, SETS[2], [(8, SETS[1])], window=3) == 6
    assert [history.at(step) for step in range(5, 10)] == [SETS[1], None, None, SETS[1], SETS[2]]
    assert history.learn(7, SETS[3], (), window=3) is None  # older than what was heard last
    assert history.at(7) is None
    assert history.learn(20, SETS[2], (), window=3) == 8  # 6 and 7 were not known before
    assert [history.at(step) for step in (6, 7, 9, 19, 20)] == [None, None, None, None, SETS[2]]
