"""Links: what is drawn depends on seed, edge, stage and step alone, and is distributed as the scenario says."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from math import erf, log, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulations import MS, four_sensor, payloads, record, walk
from zfusion.drivers.simulated import simulate
from zfusion.errors import InputError
from zfusion.links import Edge, LinkNetwork, ideal, links_of
from zfusion.links.chain import Chain
from zfusion.links.delays import LONGEST_S
from zfusion.messages import encode
from zfusion.model.streams import BLOCK
from zfusion.stages import Message

EDGE: Edge = (20, 10)
OTHER: Edge = (10, 20)
STAGES = ("measurement", "intermediate")


def network(seed: int = 4, **links: Any) -> LinkNetwork:
    """Links of the five nodes 10, 20, ... in a ring."""
    return LinkNetwork(walk(links=links, seed=seed))


def message(step: int = 1, stage: str = "measurement", node: int = 20) -> Message:
    return Message(node, step, stage, step, 1, 0, {"y": np.ones(1)})


def fates(link: LinkNetwork, steps: int, edge: Edge = EDGE, stage: str = "measurement") -> list[int | None]:
    return [link.injected_ns(edge, message(k, stage)) for k in range(1, steps + 1)]


def seconds(link: LinkNetwork, steps: int, edge: Edge = EDGE, stage: str = "measurement") -> np.ndarray:
    return np.array(fates(link, steps, edge, stage), dtype=float) / 1e9


# --- what a draw depends on ---

MODELS: dict[str, dict[str, Any]] = {
    "uniform": {"delay": {"distribution": "uniform", "low": 0.001, "high": 0.02}, "loss": 0.2},
    "bursts": {"delay": 0.01, "loss": {"gilbert_elliott": {"to_bad": 0.05, "to_good": 0.3, "loss_bad": 0.9}}},
    "mixture": {
        "delay": {
            "mixture": [
                {"weight": 3, "delay": {"distribution": "gamma", "shape": 2, "scale": 0.01}},
                {"weight": 1, "delay": {"distribution": "pareto", "minimum": 0.05, "shape": 1.5}},
                {"weight": 1, "delay": 0.2},
            ]
        },
        "duplicate": 0.3,
    },
    "switching": {
        "delay": {"distribution": "exponential", "mean": 0.01},
        "topology": {
            "modes": [{"generator": "ring"}, {"edges": [[10, 20], [20, 30]]}],
            "markov": {"transition": [[0.9, 0.1], [0.3, 0.7]], "initial": [1, 0]},
        },
    },
}

MODES = {"modes": [{"generator": "ring"}, {"edges": [[10, 20]]}]}

asked = st.lists(
    st.tuples(st.sampled_from([EDGE, OTHER, (30, 20), (50, 10)]), st.sampled_from(STAGES), st.integers(1, 5 * BLOCK)),
    min_size=1,
    max_size=60,
)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(sorted(MODELS)), asked, st.randoms(use_true_random=False))
def test_draws_do_not_depend_on_what_else_is_asked_nor_in_which_order(model: str, places: Any, random: Any) -> None:
    def answers(some: list[Any]) -> dict[Any, tuple[int, ...]]:
        link = network(reorder=True, **MODELS[model])
        return {place: tuple(link(place[0], message(place[2], place[1]), 7)) for place in some}

    every = answers(places)
    random.shuffle(places)
    shuffled = answers(places)
    assert shuffled == every
    part = places[: len(places) // 2 + 1]
    assert answers(part) == {place: every[place] for place in part}


def test_draws_are_the_same_in_every_process() -> None:
    """Whatever the hash seed: each node of a live swarm draws what comes to it by itself."""
    program = (
        "import sys; sys.path[:0] = ['tests']\n"
        "from test_links import *\n"
        "print([fates(network(**MODELS[m]), 300, e, s) for m in MODELS for e in (EDGE, OTHER) for s in STAGES])"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={"PYTHONHASHSEED": seed, "PATH": "", "PYTHONPATH": "src"},
            cwd=Path(__file__).parents[1],
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    here = [fates(network(**MODELS[m]), 300, e, s) for m in MODELS for e in (EDGE, OTHER) for s in STAGES]
    assert told == {f"{here}\n".encode()}


def test_edges_stages_and_seeds_have_draws_of_their_own() -> None:
    uniform = MODELS["uniform"]["delay"]
    samples = [
        seconds(network(delay=uniform), 4000),
        seconds(network(delay=uniform), 4000, OTHER),
        seconds(network(delay=uniform), 4000, EDGE, "intermediate"),
        seconds(network(seed=5, delay=uniform), 4000),
    ]
    correlations = np.corrcoef(samples) - np.eye(4)
    assert np.abs(correlations).max() < 6 / sqrt(4000)


@pytest.mark.parametrize(
    "links",
    [
        {"loss": 0.5},
        {"loss": {"gilbert_elliott": {"to_bad": 0.5, "to_good": 0.5}}},
        {"delay": {"distribution": "exponential", "mean": 0.01}},
        {"delay": {"mixture": [{"weight": 1, "delay": 0.1}, {"weight": 1, "delay": 0.2}]}},
        {"duplicate": 0.5},
        {"topology": {**MODES, "markov": {"transition": [[0.5, 0.5], [0.5, 0.5]], "initial": [0.5, 0.5]}}},
    ],
)
def test_nothing_comes_round_again(links: dict[str, Any]) -> None:
    """Each block of steps has draws of its own."""
    link = network(reorder=True, **links)
    came = [tuple(link((30, 20), message(k, node=30), 0)) for k in range(4 * BLOCK)]
    blocks = {tuple(came[n * BLOCK + 1 : (n + 1) * BLOCK]) for n in range(4)}
    assert len(blocks) == 4


def test_links_leave_the_measurements_as_they_were(tmp_path: Path) -> None:
    scenarios = [four_sensor(40), four_sensor(40, loss=0.3), four_sensor(40, loss=0.0)]
    paths = [record(tmp_path / f"{n}.mcap", scenario) for n, scenario in enumerate(scenarios)]
    for stage, name in (("measurement", "y"), ("truth", "x")):
        first, *others = ({(p["node"], p["step"]): p[name] for p in payloads(path, stage)} for path in paths)
        assert first == others[0] == others[1]
    lossless, lossy = payloads(paths[0], "estimate"), payloads(paths[1], "estimate")
    assert [p["used"] for p in lossless] != [p["used"] for p in lossy]


def test_what_is_lost_less_often_is_lost_within_what_is_lost_more_often() -> None:
    """So that runs which differ only in the rate can be compared pair by pair."""
    rare, often = (fates(network(loss=p), 1000) for p in (0.1, 0.3))
    assert all(b is None for a, b in zip(rare, often, strict=True) if a is None)
    short, long = (seconds(network(delay={"distribution": "exponential", "mean": m}), 500) for m in (0.01, 0.02))
    assert np.allclose(2 * short, long, atol=2e-9)


# --- how delays are distributed ---

N = 20_000
BAND = sqrt(log(2 / 1e-9) / (2 * N))
"""Dvoretzky, Kiefer, Wolfowitz: the empirical distribution function is further off with probability 1e-9."""


def normal(z: np.ndarray) -> np.ndarray:
    return np.array([0.5 * (1 + erf(value / sqrt(2))) for value in z])


LAWS: list[tuple[dict[str, Any], Callable[[np.ndarray], np.ndarray]]] = [
    ({"distribution": "uniform", "low": 0.01, "high": 0.03}, lambda s: np.clip((s - 0.01) / 0.02, 0, 1)),
    ({"distribution": "normal", "mean": 0.01, "sd": 0.01}, lambda s: np.where(s >= 0, normal((s - 0.01) / 0.01), 0)),
    ({"distribution": "lognormal", "median": 0.02, "sigma": 0.5}, lambda s: normal(np.log(s / 0.02) / 0.5)),
    ({"distribution": "gamma", "shape": 2, "scale": 0.01}, lambda s: 1 - np.exp(-100 * s) * (1 + 100 * s)),
    ({"distribution": "exponential", "mean": 0.01}, lambda s: 1 - np.exp(-100 * s)),
    ({"distribution": "pareto", "minimum": 0.01, "shape": 2.5}, lambda s: 1 - (0.01 / s) ** 2.5),
    (
        {"distribution": "exponential", "mean": 0.01, "shift": 0.1},
        lambda s: np.where(s > 0.1, 1 - np.exp(-100 * (s - 0.1)), 0),
    ),
    (
        {
            "mixture": [
                {"weight": 3, "delay": {"distribution": "uniform", "low": 0.0, "high": 0.01}},
                {"weight": 1, "delay": {"distribution": "exponential", "mean": 0.1}},
            ],
            "shift": 0.5,
        },
        lambda s: 0.75 * np.clip((s - 0.5) / 0.01, 0, 1) + 0.25 * (1 - np.exp(-10 * (s - 0.5))),
    ),
]


@pytest.mark.parametrize(
    ("law", "cdf"), LAWS, ids=lambda law: str(law.get("distribution", "mixture")) if isinstance(law, dict) else ""
)
def test_delays_have_the_distribution_that_the_scenario_says(law: dict[str, Any], cdf: Any) -> None:
    drawn = np.sort(seconds(network(delay=law), N))
    expected = cdf(drawn)
    positive = drawn > 0  # the normal one has an atom at 0, of which only the upper end counts
    above = np.arange(1, N + 1) / N - expected
    below = expected - np.arange(N) / N
    assert above[positive].max() < BAND
    assert below[positive].max() < BAND
    assert drawn.min() >= 0
    if law.get("distribution") == "normal":
        assert abs((drawn == 0).mean() - 0.5 * (1 + erf(-1 / sqrt(2)))) < BAND


def test_a_constant_delay_is_that_for_every_message() -> None:
    assert set(fates(network(delay=0.005), 300)) == {5 * MS}
    assert set(fates(network(delay=1), 3)) == {1000 * MS}


def test_no_delay_is_without_end() -> None:
    drawn = fates(network(delay={"distribution": "pareto", "minimum": 1.0, "shape": 0.01}), 300)
    assert max(delay for delay in drawn if delay is not None) == LONGEST_S * 1e9


# --- losses ---


def test_independent_losses_have_their_probability() -> None:
    n, p = 20_000, 0.2
    lost = np.array([fate is None for fate in fates(network(loss=p), n)])
    assert abs(lost.sum() - n * p) < 6 * sqrt(n * p * (1 - p))
    both = (lost[1:] & lost[:-1]).mean()
    assert abs(both - p * p) < 6 * sqrt(p * p / n)
    assert fates(network(loss=0.0), 3) == [0, 0, 0]
    assert fates(network(loss=1.0), 3) == [None] * 3


def test_bursts_are_as_long_and_as_frequent_as_the_chain_says() -> None:
    n, to_bad, to_good = 40_000, 0.02, 0.2
    loss = {"gilbert_elliott": {"to_bad": to_bad, "to_good": to_good}}
    lost = np.array([fate is None for fate in fates(network(loss=loss), n)])
    bad = to_bad / (to_bad + to_good)
    memory = 1 - to_bad - to_good  # of a two-state chain: the variance of a mean grows by (1 + m) / (1 - m)
    assert abs(lost.mean() - bad) < 6 * sqrt(bad * (1 - bad) * (1 + memory) / (1 - memory) / n)
    changes = np.flatnonzero(np.diff(lost.astype(int)))
    lengths = np.array([end - begin for begin, end in pairwise(changes) if lost[begin + 1]])
    assert abs(lengths.mean() - 1 / to_good) < 6 * sqrt((1 - to_good) / to_good**2 / len(lengths))


def test_the_stages_of_an_edge_share_its_state_and_are_lost_each_by_itself() -> None:
    def lost(loss: dict[str, float], stage: str, edge: Edge = EDGE) -> np.ndarray:
        link = network(loss={"gilbert_elliott": loss})
        return np.array([fate is None for fate in fates(link, 4000, edge, stage)])

    total = {"to_bad": 0.1, "to_good": 0.2}
    assert (lost(total, "measurement") == lost(total, "intermediate")).all()
    assert (lost(total, "measurement") != lost(total, "measurement", OTHER)).any()
    half = {**total, "loss_bad": 0.5}
    first, second = lost(half, "measurement"), lost(half, "intermediate")
    bad = lost(total, "measurement")
    assert not (first & ~bad).any()
    assert abs((first & second)[bad].mean() - 0.25) < 6 * sqrt(0.25 * 0.75 / bad.sum())


def test_a_link_that_is_never_good_or_never_bad() -> None:
    never, always = ({"gilbert_elliott": {"to_bad": b, "to_good": 1 - b}} for b in (0.0, 1.0))
    assert fates(network(loss=never), 50) == [0] * 50
    assert fates(network(loss=always), 50) == [None] * 50


def test_a_chain_starts_as_it_is_told_and_goes_on_by_its_transitions() -> None:
    """Oracle: one step after the other, from one list of random numbers."""
    numbers = np.random.default_rng(1).random(10 * BLOCK)
    rows = [[0.2, 0.5, 0.3], [0.0, 1.0, 0.0], [0.6, 0.0, 0.4]]
    initial = [0.0, 0.0, 1.0]
    state, expected = None, []
    for u in numbers[1:]:
        cumulative = np.cumsum(initial if state is None else rows[state])
        state = int(np.searchsorted(cumulative, u, side="right"))
        expected.append(state)
    chain = Chain(initial, rows, lambda block: numbers[block * BLOCK : (block + 1) * BLOCK].tolist())
    steps = np.random.default_rng(2).permutation(np.arange(1, 10 * BLOCK)).tolist()
    assert all(chain(step) == expected[step - 1] for step in steps)


# --- order, duplicates, bandwidth ---


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 30 * MS), min_size=2, max_size=80), st.sampled_from(["uniform", "mixture"]))
def test_nothing_overtakes_unless_it_may(gaps: list[int], model: str) -> None:
    spec = {**MODELS[model], "loss": 0.1}
    fifo, free = network(**spec), network(reorder=True, **spec)
    sent, latest = 0, 0
    for n, gap in enumerate(gaps):
        sent += gap
        one = message(1 + n // 2, STAGES[n % 2])
        kept, drawn = fifo(EDGE, one, sent), free(EDGE, one, sent)
        assert len(kept) == len(drawn)
        for arrival, alone in zip(kept, drawn, strict=True):
            latest = max(latest, alone)
            assert arrival == latest
            assert alone >= sent


def test_order_is_kept_on_each_edge_for_itself() -> None:
    link = network(edges=[{"from": 20, "delay": 0.5}])
    assert link(EDGE, message(1), 0) == [500 * MS]
    assert link((50, 10), message(1, node=50), 0) == [0]
    assert link(EDGE, message(1, "intermediate"), 1) == [500 * MS + 1]


def test_messages_that_may_overtake_do() -> None:
    link = network(reorder=True, delay={"distribution": "uniform", "low": 0.0, "high": 0.1})
    arrivals = [link(EDGE, message(k), k * MS)[0] for k in range(1, 200)]
    assert any(later < earlier for earlier, later in pairwise(arrivals))


def test_duplicates_come_as_often_as_they_should_and_are_counted() -> None:
    n, p = 10_000, 0.1
    link = network(duplicate=p, loss=0.2, reorder=True, delay={"distribution": "exponential", "mean": 0.01})
    arrivals = [link(EDGE, message(k), 0) for k in range(1, n + 1)]
    twice, lost = sum(len(a) == 2 for a in arrivals), sum(len(a) == 0 for a in arrivals)
    assert abs(twice - 0.8 * n * p) < 6 * sqrt(n * 0.08 * 0.92)
    assert all(a[0] != a[1] for a in arrivals if len(a) == 2)
    assert dict(link.counters[EDGE]) == {"duplicated": twice, "lost": lost}


def test_a_line_sends_one_after_the_other() -> None:
    """By hand: at 8000 bit/s a byte takes 1 ms."""
    link = network(bandwidth={"rate_bps": 8000.0, "queue": 2}, delay=0.001)
    size = len(encode(message()))
    ms = [link(EDGE, message(k), 0) for k in range(1, 5)]
    assert ms == [[(size + 1) * MS], [(2 * size + 1) * MS], [(3 * size + 1) * MS], ()]  # one on the line, two wait
    assert dict(link.counters[EDGE]) == {"queue_full": 1}
    assert link(EDGE, message(5), size * MS - 1) == ()
    assert link(EDGE, message(5), size * MS) == [(4 * size + 1) * MS]  # the second is on the line: room for one
    assert link(EDGE, message(6), 9 * size * MS) == [(10 * size + 1) * MS]  # an idle line begins at once
    assert link(OTHER, message(1, node=10), 0) == [(size + 1) * MS]  # another edge is another line


def test_a_line_without_room_takes_only_what_it_can_send_at_once() -> None:
    link = network(bandwidth={"rate_bps": 8000.0, "queue": 0})
    size = len(encode(message()))
    assert link(EDGE, message(1), 0) == [size * MS]
    assert link(EDGE, message(2), size * MS - 1) == ()
    assert link(EDGE, message(3), size * MS) == [2 * size * MS]


def test_what_is_lost_on_the_way_has_taken_its_time_on_the_line() -> None:
    link = network(bandwidth={"rate_bps": 8000.0}, edges=[{"stages": "intermediate", "loss": 1.0}])
    size = len(encode(message(1, "intermediate")))
    assert link(EDGE, message(1, "intermediate"), 0) == ()
    assert link(EDGE, message(1), 0) == [(size + len(encode(message()))) * MS]


# --- exceptions, named messages, cuts ---


def test_later_exceptions_win_and_replace_only_what_they_give() -> None:
    link = network(
        delay=0.001,
        loss=0.0,
        edges=[
            {"from": 20, "delay": 0.002},
            {"from": [20, 30], "to": 10, "delay": 0.003, "stages": "intermediate"},
            {"to": 10, "stages": ["measurement"], "loss": 1.0},
        ],
    )
    assert link.injected_ns((20, 30), message()) == 2 * MS
    assert link.injected_ns((20, 10), message(1, "intermediate")) == 3 * MS
    assert link.injected_ns((20, 10), message()) is None
    assert link.injected_ns((50, 10), message(1, "intermediate", 50)) == 1 * MS
    assert link.injected_ns((40, 50), message(1, node=40)) == 1 * MS


def test_messages_that_are_named_do_what_is_said_of_them() -> None:
    link = network(
        loss=1.0,
        messages=[
            {"from": 20, "to": 10, "stage": "measurement", "steps": [3, 300], "delay": 0.2},
            {"from": 20, "to": 10, "stage": "intermediate", "steps": [3], "lost": True},
        ],
    )
    assert [link.injected_ns(EDGE, message(k)) for k in (2, 3, 4, 300)] == [None, 200 * MS, None, 200 * MS]
    assert link.injected_ns(EDGE, message(3, "intermediate")) is None


def test_without_links_all_arrives_at_once() -> None:
    assert links_of(walk()) is ideal
    assert links_of(walk(faults=[{"kind": "kill", "node": 10, "step": 3}])) is ideal
    assert links_of(walk(links={})) is ideal
    assert links_of(walk(links={"delay": 0.1})) is not ideal
    assert links_of(walk(faults=[{"kind": "cut", "from": 10, "to": 20, "step": 3}])) is not ideal


def test_a_cut_link_carries_nothing_and_says_so() -> None:
    link = LinkNetwork(walk(faults=[{"kind": "cut", "to": 10, "step": 300, "steps": 2}], links={"delay": 0.001}))
    carried = {k: bool(link(EDGE, message(k), k * MS)) for k in (298, 299, 300, 301, 302)}
    assert carried == {298: True, 299: True, 300: False, 301: False, 302: True}
    assert dict(link.counters[EDGE]) == {"cut": 2}
    assert link(OTHER, message(300, node=10), 0)


def test_what_the_links_did_is_in_the_reports() -> None:
    scenario = walk(steps=40, links={"loss": 0.25, "duplicate": 0.1})
    reports = simulate(scenario, run="r")
    for i in scenario.ids:
        for sender, edge in reports[i][0].edges.items():
            done = reports[i][0].emulated[sender]
            assert done["lost"] == sum(edge["missed"].values())
            assert done["duplicated"] == edge["refused"]["duplicate"]


# --- traces ---


def traced(path: Path, text: str, **trace: Any) -> dict[str, Any]:
    path.write_text(text)
    return {"delay": {"trace": str(path), **trace}}


def test_a_trace_as_recorded(tmp_path: Path) -> None:
    links = traced(tmp_path / "t.txt", "# ping\n0.001\n\n0.002\n0.004\n", order="as_recorded")
    assert fates(network(**links), 7) == [k * MS for k in (1, 2, 4, 1, 2, 4, 1)]
    far = network(**links)
    assert far.injected_ns(EDGE, message(3 * 1000 + 2)) == 2 * MS
    assert far.injected_ns(EDGE, message(2, "intermediate")) == 2 * MS


def test_a_trace_at_random(tmp_path: Path) -> None:
    text = "when, rtt\n1, 0.001\n2, 0.002\n3, 0.004\n4, 0.004\n"
    drawn = fates(network(**traced(tmp_path / "t.csv", text, column="rtt", shift=0.01)), 4000)
    assert set(drawn) == {11 * MS, 12 * MS, 14 * MS}
    assert abs(drawn.count(14 * MS) - 2000) < 6 * sqrt(1000)
    assert abs(drawn.count(11 * MS) - 1000) < 6 * sqrt(750)


@pytest.mark.parametrize(
    ("text", "more", "expected"),
    [
        ("0.1\nfast\n", {}, "t.txt, line 2: expected a delay, a number of seconds >= 0 (is 'fast')"),
        ("0.1\n-0.1\n", {}, "line 2: expected a delay"),
        ("0.1\nnan\n", {}, "line 2: expected a delay"),
        ("inf\n", {}, "line 1: expected a delay"),
        ("# nothing\n", {}, "expected delays, one a line at least"),
        ("a,b\n1,2\n", {"column": "c"}, "has no column 'c'; it has a, b"),
        ("", {"column": "c"}, "has no column 'c'; it has nothing"),
        ("a,b\n1,2\n1\n", {"column": "b"}, "line 3: expected a delay, a number of seconds >= 0 (is '')"),
    ],
)
def test_a_trace_that_is_none(tmp_path: Path, text: str, more: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError) as caught:
        network(**traced(tmp_path / "t.txt", text, **more))
    assert expected in str(caught.value)


def test_a_trace_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere.txt: cannot be read: No such file"):
        network(edges=[{"delay": {"mixture": [{"weight": 1, "delay": {"trace": str(tmp_path / "nowhere.txt")}}]}}])
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not text in UTF-8"):
        network(delay={"trace": str(tmp_path / "binary")})


# --- packets ---


def steps_of(now_ns: int) -> int:
    return now_ns // (20 * MS)


def test_packets_are_drawn_by_their_number() -> None:
    spec: dict[str, Any] = {"loss": 0.3, "reorder": True, "delay": {"distribution": "exponential", "mean": 0.01}}
    one, two = (network(**spec).packet_model(EDGE, steps_of) for _ in range(2))
    first = [one.next(0, 1500) for _ in range(2000)]
    second = [two.next(n * MS, 40) for n in range(2000)]
    delays = [None if a is None else a - n * MS for n, a in enumerate(second)]
    assert first == delays
    assert abs(first.count(None) - 600) < 6 * sqrt(2000 * 0.3 * 0.7)
    assert one.counters["lost"] == first.count(None)
    other = network(**spec).packet_model(OTHER, steps_of)
    assert [other.next(0, 1500) for _ in range(2000)] != first


def test_packets_wait_for_the_line_and_keep_their_order() -> None:
    slow = network(bandwidth={"rate_bps": 8000.0, "queue": 1}).packet_model(EDGE, steps_of)
    assert [slow.next(0, 10) for _ in range(3)] == [10 * MS, 20 * MS, None]
    assert slow.counters == {"queue_full": 1}
    ragged = network(delay={"distribution": "uniform", "low": 0.0, "high": 0.1}).packet_model(EDGE, steps_of)
    arrivals = [ragged.next(n * MS, 10) for n in range(100)]
    assert arrivals == sorted(arrivals)


def test_packets_of_a_cut_link_go_by_the_time() -> None:
    scenario = walk(links={"delay": 0.001}, faults=[{"kind": "cut", "from": 20, "to": 10, "step": 3, "steps": 2}])
    model = LinkNetwork(scenario).packet_model(EDGE, steps_of)
    carried = [model.next(now * 10 * MS, 100) is not None for now in range(12)]
    assert carried == [True] * 6 + [False] * 4 + [True] * 2  # steps 3 and 4: from 60 ms to 100 ms
    assert model.counters == {"cut": 4}


def test_bursts_of_packets() -> None:
    """Losses of packets come in bursts of packets, whatever the stages are."""
    loss = {"gilbert_elliott": {"to_bad": 0.05, "to_good": 0.5}}
    model = network(loss=loss).packet_model(EDGE, steps_of)
    lost = np.array([model.next(0, 100) is None for _ in range(8000)])
    again = lost[1:][lost[:-1]].mean()
    assert abs(again - 0.5) < 6 * sqrt(0.25 / lost.sum())
    bad, memory = 0.05 / 0.55, 0.45
    assert abs(lost.mean() - bad) < 6 * sqrt(bad * (1 - bad) * (1 + memory) / (1 - memory) / 8000)
