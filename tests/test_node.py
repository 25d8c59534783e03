"""The node: wired to others by a network that does its worst, and on its own, input by input.

Whatever the network does, each estimate must be the least-squares one for what the nodes' own messages say was used;
and a node is a function of its inputs.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from random import Random
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from oracles import brute_force, paper, random_systems
from oracles.brute_force import StackedSystem
from zfusion import node as node_module
from zfusion import used_sets
from zfusion.methods import METHODS, Setting
from zfusion.methods.two_stage import Centralized, Local, TwoStage
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.node import ASK_AGAIN, LOOKAHEAD, REMEMBERED, Ask, Effect, Node, Patience
from zfusion.stages import Message
from zfusion.used_sets import Run

IDS: tuple[NodeId, ...] = (1, 2, 3, 4)
NEIGHBOURS: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2, 3), 2: (2, 3, 4), 3: (1, 3), 4: (1, 2, 4)}
NETWORK = Network(NEIGHBOURS, {})
STEPS = 10
WAIT = 1000
Life = tuple[NodeId, int]
"""(node, first step)."""


@cache
def system_and_stack(steps: int = STEPS) -> tuple[System, StackedSystem]:
    system = random_systems.random_system(np.random.default_rng(1), ids=IDS, nx=2, mean=3.0)
    return system, brute_force.stack(system, steps)


@cache
def path() -> SamplePath:
    return SamplePath(system_and_stack()[0], 1)


def make(
    i: NodeId,
    *,
    method: type[Centralized] = TwoStage,
    paced: bool = False,
    born: int = 1,
    expected: Collection[NodeId] | None = None,
    network: Network = NETWORK,
    system: System | None = None,
) -> Node:
    graph = method.network(network)
    estimator = method(Setting(i, system or system_and_stack()[0], graph, born))
    waits = tuple(WAIT * (n + 1 if paced else 1) for n in range(len(method.stages)))
    return Node(i, graph.neighbours(i), estimator, Patience(waits, paced), born=born, expected=expected)


def told(effects: Sequence[Effect]) -> list[Message]:
    return [effect for effect in effects if isinstance(effect, Message)]


def stages(effects: Sequence[Effect]) -> list[str]:
    return [message.stage for message in told(effects)]


def bits(effects: Sequence[Effect]) -> list[Any]:
    """The effects as something that is equal only where every bit is."""

    def plain(value: Any) -> Any:
        return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value

    return [
        effect if isinstance(effect, Ask) else (*effect[:6], {name: plain(v) for name, v in effect.fields.items()})
        for effect in effects
    ]


# --- a network that does its worst


@dataclass
class Weather:
    """How bad it is: probabilities that something happens to a message, or at a moment."""

    loss: float = 0.0
    duplicate: float = 0.0
    patience: float = 0.0
    """That time passes although messages could still arrive."""
    crash: float = 0.0
    skip: float = 0.0
    deaf: Collection[tuple[NodeId, NodeId]] = ()
    """Links (from, to) that let nothing through."""
    no_reading: float = 0.0
    unanswered: float = 0.0


class Swarm:
    """Nodes wired together by a network that drops, delays, reorders and duplicates, as `random` decides."""

    def __init__(self, random: Random, weather: Weather, paced: bool, steps: int = STEPS) -> None:
        self.random, self.weather, self.paced, self.steps = random, weather, paced, steps
        self.now = 0
        self.nodes = {i: make(i, paced=paced) for i in IDS}
        self.flying: list[tuple[NodeId, Message]] = []
        self.asks: list[tuple[NodeId, Ask]] = []
        self.said: dict[Life, dict[str, dict[int, Message]]] = defaultdict(lambda: defaultdict(dict))
        self.readings: dict[tuple[NodeId, int], Array] = {}
        self.inputs: dict[Life, list[tuple[Callable[[Node], Any], list[Effect]]]] = defaultdict(list)
        self.delivered: Counter[tuple[Life, NodeId]] = Counter()
        self.lives: list[Node] = list(self.nodes.values())
        self.expected: dict[Life, Collection[NodeId] | None] = dict.fromkeys(((i, 1) for i in IDS), None)
        self.histories: dict[Life, dict[int, list[Message]]] = defaultdict(lambda: defaultdict(list))

    def run(self) -> None:
        for _ in range(100_000):
            if all(node.step >= self.steps and node.stage is None for node in self.nodes.values()):
                break
            self._act()
        else:
            raise AssertionError("the swarm does not get on")
        while self.flying:  # what comes when all is over does no harm either
            self._deliver()

    def _act(self) -> None:
        if self.random.random() < self.weather.crash:
            self._crash(self.random.choice(IDS))
        ready = [i for i, node in self.nodes.items() if node.stage is None and node.step < self.steps]
        if self.asks and self.random.random() < 0.5:
            self._answer(*self.asks.pop(0))
        elif ready and (not self.flying or self.random.random() < 0.5):
            self._begin(self.random.choice(ready))
        elif self.flying and self.random.random() >= self.weather.patience:
            self._deliver()
        else:
            self.now += self.random.randrange(1, WAIT)
            for i in IDS:
                self._feed(i, lambda node, now=self.now: node.tick(now))

    def _feed(self, i: NodeId, act: Callable[[Node], list[Effect] | None]) -> None:
        node = self.nodes[i]
        effects = act(node) or []
        self.inputs[node.id, node.born].append((act, effects))
        for effect in effects:
            if isinstance(effect, Ask):
                self.asks.append((i, effect))
                continue
            if effect.stage == "event":
                self.histories[i, node.born][effect.step].append(effect)
            else:
                assert effect.step not in self.said[i, node.born][effect.stage]
                self.said[i, node.born][effect.stage][effect.step] = effect
            if effect.stage in {"measurement", "intermediate"}:
                self.flying += [(j, effect) for j in NETWORK.listeners(i) if (i, j) not in self.weather.deaf]

    def _begin(self, i: NodeId) -> None:
        k = self.nodes[i].step + 1
        if self.random.random() < self.weather.skip:
            k = min(self.steps, k + self.random.randrange(1, 4))
        y = None if self.random.random() < self.weather.no_reading else path().measurement(i, k)
        if y is not None:
            self.readings[i, k] = y
        start = self.now - self.random.randrange(WAIT) if self.paced else None
        self._feed(i, lambda node, now=self.now: node.begin(k, y, now, start))

    def _deliver(self) -> None:
        position = self.random.randrange(len(self.flying))
        to, message = self.flying[position]
        if self.random.random() >= self.weather.duplicate:
            del self.flying[position]
        if self.random.random() < self.weather.loss:
            return
        node = self.nodes[to]
        self.delivered[(to, node.born), message.node] += 1
        self._feed(to, lambda node, now=self.now: node.receive(message, now))

    def _answer(self, asker: NodeId, ask: Ask) -> None:
        if self.random.random() < self.weather.unanswered:
            return
        asked = self.nodes[ask.node]
        own = asked.ledger.of(ask.node)
        assert own is not None
        born, end, runs = asked.born, own.last, own.runs(own.last)
        self._feed(asker, lambda node: node.learn_history(ask.node, born, end, runs))

    def _crash(self, i: NodeId) -> None:
        """A new life, from the first step that nobody has begun; the listeners hear of it at once, or messages first."""
        born = max(node.step for node in self.nodes.values()) + 1
        if born > self.steps or self.nodes[i].step < self.nodes[i].born:
            return
        for j in NETWORK.listeners(i):
            self._feed(j, lambda node, now=self.now: node.gone(i, now))
        self.expected[i, born] = self.random.choice([None, ()])
        self.nodes[i] = make(i, paced=self.paced, born=born, expected=self.expected[i, born])
        self.lives.append(self.nodes[i])
        for j in NEIGHBOURS[i]:
            if j != i:
                self._feed(i, lambda node, j=j: node.back(j))
        for j in NETWORK.listeners(i):
            self._feed(j, lambda node: node.back(i))

    # what must be true of it

    def assert_estimates_are_least_squares(self) -> int:
        """Each published estimate, from what the messages say was used; how many neighbours' were fused in all."""
        _, stacked = system_and_stack(self.steps)
        Y = stacked.vector(self.readings)
        used: dict[Any, Any] = {}
        heard: dict[Any, Any] = {}
        born_at = {(i, k): (i, born) for (i, born), by in self.said.items() for k in by["intermediate"]}
        for life, by in self.said.items():
            used |= {(life, k): message.fields["used"] for k, message in by["intermediate"].items()}
            for k, message in by["estimate"].items():
                others = cast("tuple[NodeId, ...]", message.fields["used"])
                heard[life, k] = tuple(born_at[j, k] for j in others)
        intermediate: dict[Any, Any] = {life: brute_force.intermediate(stacked, life, used) for life in self.said}  # type: ignore[arg-type]
        best = {life: brute_force.fused(stacked, intermediate, life, heard) for life in self.said}  # type: ignore[arg-type]
        for life, by in self.said.items():
            for stage, estimates in (("intermediate", intermediate[life]), ("estimate", best[life])):
                values, covariances = estimates.values(stacked, Y), estimates.covariance
                for k, message in by[stage].items():
                    scale = np.abs(covariances[k]).max()
                    np.testing.assert_allclose(message.fields["x"], values[k], rtol=1e-10, atol=1e-8 * np.sqrt(scale))
                    if stage == "estimate":
                        np.testing.assert_allclose(message.fields["P"], covariances[k], rtol=0, atol=1e-8 * scale)
        return sum(len(others) - 1 for others in heard.values())

    def assert_every_message_is_accounted_for(self) -> None:
        for node in self.lives:
            life = (node.id, node.born)
            for j, edge in node.counters.items():
                kept = sum(message.node == j for early in node._early.values() for message in early.values())
                known = edge.received.total() + edge.late.total() + edge.refused.total() + kept
                assert known == self.delivered[life, j]
                in_estimates = (
                    j in (*cast("Any", m.fields["used"]), *cast("Any", m.fields["excluded"]))
                    for m in self.said[life]["estimate"].values()
                )
                if node.stage is None:
                    assert edge.received["intermediate"] == sum(in_estimates)
            assert not node.strays
            assert node.completed == len(self.said[life]["estimate"])

    def assert_a_node_is_a_function_of_its_inputs(self) -> None:
        for node in self.lives:
            again = make(node.id, paced=self.paced, born=node.born, expected=self.expected[node.id, node.born])
            for act, effects in self.inputs[node.id, node.born]:
                assert bits(act(again) or []) == bits(effects)

    def assert_a_replay_of_what_was_used_gives_the_same_bits(self) -> None:
        """As from a recording: a node that is fed what its own messages say it used, and its history events.

        It waits for a neighbour that does not exist: so a stage ends when its time is up, and not before.
        """
        nobody: NodeId = 0
        for node in self.lives:
            by = self.said[node.id, node.born]
            method = TwoStage(Setting(node.id, system_and_stack()[0], NETWORK, node.born))
            neighbourhood = (nobody, *NEIGHBOURS[node.id])
            again = Node(node.id, neighbourhood, method, Patience((1, 1), False), born=node.born, expected=[nobody])
            for k in sorted(by["estimate"]):
                for event in self.histories[node.id, node.born].get(k, ()):
                    data = cast("dict[str, Any]", event.fields["data"])
                    again.learn_history(data["of"], data["born"], data["end"], data["runs"])
                again.begin(k, cast("Array | None", by["measurement"][k].fields["y"]), now=0)
                self._replay_stage(again, by["intermediate"][k], "measurement", ("used",), now=1)
                self._replay_stage(again, by["estimate"][k], "intermediate", ("used", "excluded"), now=2)

    def _replay_stage(self, node: Node, wanted: Message, stage: str, names: Sequence[str], now: int) -> None:
        inputs = {j for name in names for j in cast("tuple[NodeId, ...]", wanted.fields[name])}
        for j in sorted(inputs - {node.id}):
            lives = ((i, born) for (i, born), by in self.said.items() if i == j and wanted.step in by[stage])
            (life,) = lives
            if node._lives.get(j, life[1]) != life[1]:
                node.gone(j, now - 1)
            assert not node.receive(self.said[life][stage][wanted.step], now - 1)
        (said,) = (message for message in told(node.tick(now)) if message.stage == wanted.stage)
        assert bits([said])[0][6] == bits([wanted])[0][6]


weathers = st.builds(
    Weather,
    loss=st.sampled_from([0.0, 0.1, 0.4]),
    duplicate=st.sampled_from([0.0, 0.2]),
    patience=st.sampled_from([0.05, 0.3]),
    crash=st.sampled_from([0.0, 0.0, 0.005, 0.02]),
    skip=st.sampled_from([0.0, 0.1]),
    deaf=st.sampled_from([(), [(2, 1)], [(1, 3), (4, 2), (2, 4)]]),
    no_reading=st.sampled_from([0.0, 0.2]),
    unanswered=st.sampled_from([0.0, 0.5]),
)


@settings(
    derandomize=True,
    deadline=None,
    max_examples=80,
    suppress_health_check=[HealthCheck.data_too_large, HealthCheck.too_slow],
)
@given(st.integers(0, 10**6), weathers, st.booleans(), st.sampled_from([1, 2, 16]))
def test_whatever_the_network_does_the_estimates_are_right(seed: int, weather: Weather, paced: bool, runs: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(node_module, "HISTORY_RUNS", runs)  # few, so that gaps stay open and are asked about
        patch.setattr(node_module, "ASK_AGAIN", 2)
        patch.setattr(node_module, "NAMED", 3)
        swarm = Swarm(Random(seed), weather, paced)
        swarm.run()
        swarm.assert_estimates_are_least_squares()
        swarm.assert_every_message_is_accounted_for()
        swarm.assert_a_node_is_a_function_of_its_inputs()
        swarm.assert_a_replay_of_what_was_used_gives_the_same_bits()
