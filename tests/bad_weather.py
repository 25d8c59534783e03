"""Nodes wired together by a network that does its worst, and what must be true of them all the same.

Every estimate that they publish, corrected ones included, must be the least-squares one for what their own messages
say was used: by projection on all measurements, with no recursion at all (`oracles.brute_force`).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from random import Random
from typing import Any, cast

import numpy as np

from oracles import brute_force, random_systems
from oracles.brute_force import Estimates, StackedSystem
from zfusion.methods import Setting
from zfusion.methods.two_stage import Centralized, TwoStage
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.node import Ask, Effect, Node, Patience
from zfusion.stages import Message
from zfusion.used_sets import UsedSet

IDS: tuple[NodeId, ...] = (1, 2, 3, 4)
NEIGHBOURS: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2, 3), 2: (2, 3, 4), 3: (1, 3), 4: (1, 2, 4)}
NETWORK = Network(NEIGHBOURS, {})
TWINS = Network({1: (1, 2, 3), 2: (1, 2, 3), 3: (1, 3, 4), 4: (1, 2, 4)}, {})
"""Nodes 1 and 2 hear the same."""
STEPS = 10
WAIT = 1000
Life = tuple[NodeId, int]
"""(node, first step)."""
UsedSets = Mapping[int, UsedSet]
"""By step."""


@cache
def system_and_stack(steps: int = STEPS, seed: int = 1) -> tuple[System, StackedSystem]:
    system = random_systems.random_system(np.random.default_rng(seed), ids=IDS, nx=2, mean=3.0)
    return system, brute_force.stack(system, steps)


@cache
def path(seed: int = 1) -> SamplePath:
    return SamplePath(system_and_stack(seed=seed)[0], 1)


def make(
    i: NodeId,
    *,
    method: type[Centralized] = TwoStage,
    paced: bool = False,
    born: int = 1,
    expected: Collection[NodeId] | None = None,
    network: Network = NETWORK,
    system: System | None = None,
    window: int = 0,
) -> Node:
    graph = method.network(network)
    estimator = method(Setting(i, system or system_and_stack()[0], graph, born, window))
    waits = tuple(WAIT * (n + 1 if paced else 1) for n in range(len(method.stages)))
    patience = Patience(waits, paced)
    return Node(i, graph.neighbours(i), estimator, patience, born=born, expected=expected, window=window)


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


@dataclass
class Weather:
    """How bad it is: probabilities that something happens to a message, or at a moment."""

    loss: float = 0.0
    loss_of: tuple[str, float] = ("", 0.0)
    """A stage of which more is lost, and how much."""
    duplicate: float = 0.0
    patience: float = 0.0
    """That time passes although messages could still arrive."""
    crash: float = 0.0
    skip: float = 0.0
    deaf: Collection[tuple[NodeId, NodeId]] = ()
    """Links (from, to) that let nothing through."""
    no_reading: float = 0.0
    unanswered: float = 0.0
    slow_answers: float = 0.0
    """That an answer that was given waits on its way, each time something happens."""


class Swarm:
    """Nodes wired together by a network that drops, delays, reorders and duplicates, as `random` decides."""

    def __init__(
        self,
        random: Random,
        weather: Weather,
        paced: bool,
        steps: int = STEPS,
        *,
        window: int = 0,
        network: Network = NETWORK,
        method: type[Centralized] = TwoStage,
        seed: int = 1,
    ) -> None:
        self.random, self.weather, self.paced, self.steps = random, weather, paced, steps
        self.window, self.network, self.method, self.seed = window, method.network(network), method, seed
        self.now = 0
        self.nodes = {i: self.make(i) for i in IDS}
        self.flying: list[tuple[NodeId, Message]] = []
        self.asks: list[tuple[NodeId, Ask]] = []
        self.answers: list[tuple[NodeId, Callable[[Node], None]]] = []
        self.said: dict[Life, dict[str, dict[int, Message]]] = defaultdict(lambda: defaultdict(dict))
        self.corrections: dict[Life, list[Message]] = defaultdict(list)
        self.readings: dict[tuple[NodeId, int], Array] = {}
        self.inputs: dict[Life, list[tuple[Callable[[Node], Any], list[Effect]]]] = defaultdict(list)
        self.delivered: Counter[tuple[Life, NodeId]] = Counter()
        self.lives: list[Node] = list(self.nodes.values())
        self.expected: dict[Life, Collection[NodeId] | None] = dict.fromkeys(((i, 1) for i in IDS), None)
        self.events: dict[Life, dict[int, list[Message]]] = defaultdict(lambda: defaultdict(list))

    def make(self, i: NodeId, born: int = 1, expected: Collection[NodeId] | None = None) -> Node:
        system = system_and_stack(seed=self.seed)[0]
        return make(
            i,
            method=self.method,
            paced=self.paced,
            born=born,
            expected=expected,
            network=self.network,
            system=system,
            window=self.window,
        )

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
        if self.answers and self.random.random() >= self.weather.slow_answers:
            asker, answer = self.answers.pop(0)
            self._feed(asker, answer)
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
        life = (node.id, node.born)
        self.inputs[life].append((act, effects))
        for effect in effects:
            if isinstance(effect, Ask):
                self.asks.append((i, effect))
                continue
            if effect.stage == "event":
                self.events[life][effect.step].append(effect)
            elif effect.stage == "revised":
                self.corrections[life].append(effect)
            else:
                assert effect.step not in self.said[life][effect.stage]
                self.said[life][effect.stage][effect.step] = effect
            if effect.stage in {stage.name for stage in self.method.stages}:
                self.flying += [(j, effect) for j in self.network.listeners(i) if (i, j) not in self.weather.deaf]

    def _begin(self, i: NodeId) -> None:
        k = self.nodes[i].step + 1
        if self.random.random() < self.weather.skip:
            k = min(self.steps, k + self.random.randrange(1, 4))
        y = None if self.random.random() < self.weather.no_reading else path(self.seed).measurement(i, k)
        if y is not None:
            self.readings[i, k] = y
        start = self.now - self.random.randrange(WAIT) if self.paced else None
        self._feed(i, lambda node, now=self.now: node.begin(k, y, now, start))

    def _deliver(self) -> None:
        position = self.random.randrange(len(self.flying))
        to, message = self.flying[position]
        if self.random.random() >= self.weather.duplicate:
            del self.flying[position]
        stage, probability = self.weather.loss_of
        if self.random.random() < (probability if message.stage == stage else self.weather.loss):
            return
        node = self.nodes[to]
        self.delivered[(to, node.born), message.node] += 1
        self._feed(to, lambda node, now=self.now: node.receive(message, now))

    def _answer(self, asker: NodeId, ask: Ask) -> None:
        if self.random.random() < self.weather.unanswered:
            return
        answer = self.nodes[ask.node].tell_history()
        self.answers.append((asker, lambda node: node.learn_history(ask.node, *answer)))

    def _crash(self, i: NodeId) -> None:
        """A new life, from the first step that nobody has begun."""
        born = max(node.step for node in self.nodes.values()) + 1
        if born > self.steps or self.nodes[i].step < self.nodes[i].born:
            return
        self._new_life(i, born)

    def _new_life(self, i: NodeId, born: int) -> None:
        for j in self.network.listeners(i):
            self._feed(j, lambda node, now=self.now: node.gone(i, now))
        self.answers = [(asker, answer) for asker, answer in self.answers if asker != i]
        self.expected[i, born] = self.random.choice([None, ()])
        self.nodes[i] = self.make(i, born, self.expected[i, born])
        self.lives.append(self.nodes[i])
        for j in self.network.neighbours(i):
            if j != i:
                self._feed(i, lambda node, j=j: node.back(j))
        for j in self.network.listeners(i):
            self._feed(j, lambda node: node.back(i))

    # what must be true of it

    def used_sets(self, life: Life) -> dict[int, UsedSets]:
        """What a life used at each step up to k, as it stood when it closed the first stage of step k.

        From what it said when it did: `used`, and its events "revised"; what its messages tell of it must agree.
        """
        first, filtered = self.method.stages[0].name, [s.name for s in self.method.stages[1:]] or ["estimate"]
        by, used, then = self.said[life], dict[int, UsedSet](), dict[int, UsedSets]()
        for k in range(life[1], self.steps + 1):
            for event in self.events[life].get(k, ()):
                data = cast("dict[str, Any]", event.fields["data"])
                if event.fields["kind"] == "revised" and data["stage"] == first:
                    for step, ids in data["taken"]:
                        assert max(life[1], k - self.window) <= step < k
                        assert not set(ids) & set(used[step])
                        used[step] = tuple(sorted({*used[step], *ids}))  # type: ignore[type-var]
            message = by[filtered[0]].get(k)
            used[k] = () if message is None else cast(UsedSet, message.fields["used"])
            then[k] = dict(used)
            if message is not None and "history" in message.fields:
                self._assert_tells(message, then[k])
        return then

    def _assert_tells(self, message: Message, used: UsedSets) -> None:
        runs = cast("list[tuple[int, UsedSet]]", message.fields["history"])
        ends = [first for first, _ in (*runs[1:], (message.step, ()))]
        for (first, ids), end in zip(runs, ends, strict=False):
            assert all(used[step] == ids for step in range(first, end))
        if self.window:  # nothing that it may have changed since its last message is left out
            assert min((first for first, _ in runs), default=message.step) <= max(
                message.born, message.step - self.window
            )

    def _filters(self, life: Life, stacked: StackedSystem) -> tuple[Estimates, dict[int, Estimates]]:
        """The intermediate estimates of a life by projection: of each step as it was published, and, for the end of
        each step k, of all steps before it as they would be published then."""
        then = self.used_sets(life)
        now: dict[int, Estimates] = {}
        for k in sorted(then, reverse=True):
            later = now.get(k + 1)
            if later is None or any(then[k + 1][step] != ids for step, ids in then[k].items()):
                later = brute_force.intermediate(stacked, life[0], {(life[0], s): ids for s, ids in then[k].items()})
            now[k] = later
        weights, errors = now[max(now)].weights.copy(), now[max(now)].errors.copy()
        for k, estimates in now.items():
            weights[k], errors[k] = estimates.weights[k], estimates.errors[k]
        return Estimates(weights, errors), now

    def assert_estimates_are_least_squares(self) -> Counter[str]:
        """Each published estimate, from what the messages say was used; how many were seen, and fused in them."""
        _, stacked = system_and_stack(self.steps, self.seed)
        Y, seen = stacked.vector(self.readings), Counter[str]()
        two = len(self.method.stages) > 1
        filters = {life: self._filters(life, stacked) for life in self.said}
        published: Any = {life: estimates for life, (estimates, _) in filters.items()}
        born_at = {(life[0], k): life for life, by in self.said.items() for k in by["intermediate"]}

        def lives(message: Message) -> tuple[Life, ...]:
            return tuple(born_at[j, message.step] for j in cast(UsedSet, message.fields["used"]) if two)

        heard: Any = {(life, k): lives(m) for life, by in self.said.items() for k, m in by["estimate"].items()}
        for life, by in self.said.items():
            fused = brute_force.fused(stacked, published, life, heard) if two else published[life]  # type: ignore[arg-type]
            for stage, estimates in (("intermediate", published[life]), ("estimate", fused)):
                values, covariances = estimates.values(stacked, Y), estimates.covariance
                for k, message in by[stage].items():
                    assert_is(message, values[k], covariances[k])
                    seen[stage] += 1
            seen["fused"] += sum(len(heard[life, k]) - 1 for k in by["estimate"] if two)
            told = {k: float(np.trace(cast(Array, m.fields["P"]))) for k, m in by["estimate"].items()}
            for message in self.corrections[life]:
                s, at = message.step, cast(int, message.fields["at"])
                assert max(life[1], at - self.window) <= s < at
                here = replace(stacked, state_mean=stacked.state_mean[s : s + 1], state=stacked.state[s : s + 1])
                parts: Any = {other: one_step(published[other], s) for other in lives(message)}
                parts[life] = one_step(filters[life][1][at], s)
                best = brute_force.fused(here, parts, life, {(life, 0): lives(message)}) if two else parts[life]  # type: ignore[arg-type, dict-item]
                assert_is(message, best.values(here, Y)[0], best.covariance[0])
                now = float(np.trace(cast(Array, message.fields["P"])))
                assert now < told[s]  # or it would be no correction
                told[s] = now
                seen["revised"] += 1
        return seen

    def assert_every_message_is_accounted_for(self) -> None:
        for node in self.lives:
            life = (node.id, node.born)
            for j, edge in node.counters.items():
                kept = sum(message.node == j for early in node._early.values() for message in early.values())
                known = edge.received.total() + edge.late.total() + edge.refused.total() + kept
                assert known == self.delivered[life, j]
                for stage, late in edge.late.items():
                    assert edge.revised[stage] + edge.too_late[stage] + edge.stale[stage] <= late
                in_estimates = (
                    j in (*cast("Any", m.fields["used"]), *cast("Any", m.fields["excluded"]))
                    for m in self.said[life]["estimate"].values()
                )
                if node.stage is None:
                    assert edge.received[self.method.stages[-1].name] >= sum(in_estimates)
            assert not node.strays
            assert node.completed == len(self.said[life]["estimate"])
            assert node.sent["revised"] == len(self.corrections[life])

    def assert_a_node_is_a_function_of_its_inputs(self) -> None:
        for node in self.lives:
            again = self.make(node.id, node.born, self.expected[node.id, node.born])
            for act, effects in self.inputs[node.id, node.born]:
                assert bits(act(again) or []) == bits(effects)

    def assert_a_replay_of_what_was_used_gives_the_same_bits(self) -> None:
        """As from a recording: a node that is fed what its own messages say it used, and its events.

        It waits for a neighbour that does not exist: so a stage ends when its time is up, and not before.
        """
        nobody: NodeId = 0
        system, names = system_and_stack(seed=self.seed)[0], [stage.name for stage in self.method.stages]
        for node in self.lives:
            life = (node.id, node.born)
            by = self.said[life]
            method = self.method(Setting(node.id, system, self.network, node.born, self.window))
            neighbourhood = (nobody, *self.network.neighbours(node.id))
            patience = Patience((1,) * len(names), False)
            again = Node(
                node.id, neighbourhood, method, patience, born=node.born, expected=[nobody], window=self.window
            )
            corrected: list[Effect] = []
            for k in sorted(by["estimate"]):
                taken: dict[str, list[tuple[int, UsedSet]]] = defaultdict(list)
                for event in self.events[life].get(k, ()):
                    data = cast("dict[str, Any]", event.fields["data"])
                    if event.fields["kind"] == "history":
                        again.learn_history(data["of"], data["born"], data["end"], data["runs"])
                    elif event.fields["kind"] == "revised":
                        taken[data["stage"]] += data["taken"]
                again.begin(k, cast("Array | None", by["measurement"][k].fields["y"]), now=0)
                for n, (stage, following) in enumerate(zip(names, [*names[1:], "estimate"], strict=True)):
                    effects = self._replay_stage(again, by[following][k], stage, taken[stage], now=n + 1)
                    corrected += [message for message in effects if message.stage == "revised"]
            assert [e[6] for e in bits(corrected)] == [e[6] for e in bits(self.corrections[life])]

    def _replay_stage(
        self, node: Node, wanted: Message, stage: str, taken: list[tuple[int, UsedSet]], now: int
    ) -> list[Message]:
        inputs = {j for name in ("used", "excluded") for j in cast(UsedSet, wanted.fields.get(name, ()))}
        for j, k in [(j, step) for step, ids in taken for j in ids] + [(j, wanted.step) for j in sorted(inputs)]:
            if j == node.id:
                continue
            (life,) = ((i, born) for (i, born), by in self.said.items() if i == j and k in by[stage])
            if node._lives.get(j, life[1]) != life[1]:
                node.gone(j, now - 1)
            assert not node.receive(self.said[life][stage][k], now - 1)
        effects = told(node.tick(now))
        (said,) = (message for message in effects if message.stage == wanted.stage)
        assert bits([said])[0][6] == bits([wanted])[0][6]
        return effects


def one_step(estimates: Estimates, step: int) -> Estimates:
    return Estimates(estimates.weights[step : step + 1], estimates.errors[step : step + 1])


def assert_is(message: Message, value: Array, covariance: Array) -> None:
    """The estimate in the message, and the covariance if it tells one, are these."""
    scale = np.abs(covariance).max()
    # Nearly equal estimates are told apart by rounding: what P has of it, 1e-15, is 3e-8 of a standard deviation in x.
    rounding = 1e-8 if message.stage == "intermediate" else 1e-7
    np.testing.assert_allclose(message.fields["x"], value, rtol=1e-10, atol=rounding * np.sqrt(scale))
    if "P" in message.fields:
        np.testing.assert_allclose(message.fields["P"], covariance, rtol=0, atol=1e-8 * scale)


@dataclass
class Climate:
    """What becomes of messages in a `Lockstep`."""

    late: float = 0.2
    """Part of the messages that come late, by one step or more: by each further one with probability `later`."""
    later: float = 0.5
    burst: Mapping[str, float] = field(default_factory=dict)
    """By stage: the probability that at a step a link turns bad, and lets nothing through for about `length` steps."""
    length: float = 4.0
    duplicate: float = 0.0
    crash: float = 0.0
    sleep: float = 0.0
    no_reading: float = 0.0
    answered: float = 0.5
    """That a question is answered at a step, and likewise that the answer then arrives: both may take their time."""
    calm_from: int = 10**9
    """From this step on everything arrives in time, and nothing happens."""


class Lockstep(Swarm):
    """All nodes take each step together, and what comes late does so by whole steps: long gaps, and many answers."""

    def __init__(self, random: Random, climate: Climate, steps: int, *, at_most: int = 10**9, **more: Any) -> None:
        """`at_most`: the steps that a message is late, if it is."""
        super().__init__(random, Weather(no_reading=climate.no_reading), paced=False, steps=steps, **more)
        self.climate, self.at_most = climate, at_most
        self.step = 0
        self.underway: dict[tuple[int, int], list[tuple[NodeId, Message]]] = defaultdict(list)
        """By the step and the phase of it in which they arrive."""
        self.bad: set[tuple[NodeId, NodeId, str]] = set()

    def run(self) -> None:
        for k in range(1, self.steps + 1):
            self.step = k
            calm = self.step >= self.climate.calm_from
            self.bad = set() if calm else self._weather()
            asleep = {i for i in IDS if not calm and self.chance(self.climate.sleep)}
            for i in IDS:
                if not calm and self.chance(self.climate.crash):
                    self._crash(i)
            for i in self.random.sample(IDS, len(IDS)):
                if i not in asleep and self.nodes[i].born <= self.step:
                    self._begin_at(i)
            for phase in range(3):
                self._arrive(phase)
                self._ask_and_answer(calm)
                self.now += WAIT
                for i in IDS:
                    self._feed(i, lambda node, now=self.now: node.tick(now))

    def chance(self, probability: float) -> bool:
        return self.random.random() < probability

    def _weather(self) -> set[tuple[NodeId, NodeId, str]]:
        links = {(i, j, stage) for i in IDS for j in self.network.listeners(i) for stage in self.climate.burst}
        turned = {link for link in sorted(links - self.bad) if self.chance(self.climate.burst[link[2]])}
        return turned | {link for link in sorted(self.bad) if not self.chance(1 / self.climate.length)}

    def _begin_at(self, i: NodeId) -> None:
        y = None if self.chance(self.climate.no_reading) else path(self.seed).measurement(i, self.step)
        if y is not None:
            self.readings[i, self.step] = y
        self._feed(i, lambda node, k=self.step, now=self.now: node.begin(k, y, now))

    def _arrive(self, phase: int) -> None:
        """What is late first, then what is in time; and what that sets off."""
        for to, message in self.underway.pop((self.step, phase), ()):
            self._hand_over(to, message)
        while self.flying:
            to, message = self.flying.pop(self.random.randrange(len(self.flying)))
            if (message.node, to, message.stage) in self.bad:
                continue
            calm = self.step >= self.climate.calm_from
            for _ in range(1 + (not calm and self.chance(self.climate.duplicate))):
                if calm or not self.chance(self.climate.late):
                    self._hand_over(to, message)
                    continue
                delay = 1
                while delay < self.at_most and self.chance(self.climate.later):
                    delay += 1
                self.underway[self.step + delay, self.random.randrange(3)].append((to, message))

    def _hand_over(self, to: NodeId, message: Message) -> None:
        node = self.nodes[to]
        self.delivered[(to, node.born), message.node] += 1
        self._feed(to, lambda node, now=self.now: node.receive(message, now))

    def _ask_and_answer(self, calm: bool) -> None:
        for waiting, act in ((self.asks, self._answer), (self.answers, self._feed)):
            for item in list(waiting):  # type: ignore[call-overload]
                if calm or self.chance(self.climate.answered):
                    waiting.remove(item)
                    act(*item)

    def _crash(self, i: NodeId) -> None:
        if self.nodes[i].step >= self.nodes[i].born:
            self._new_life(i, self.step)
