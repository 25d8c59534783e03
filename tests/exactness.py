"""Whether the estimates on a recording are right: set beside the least-squares ones, by projection and no recursion.

Whatever happened to a swarm, its messages say what was used. Each estimate must be the least-squares one for that, and
its covariance the one that it has: `oracles.brute_force` knows nothing of nodes, messages, losses or deaths.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from oracles import brute_force
from oracles.brute_force import Estimates, StackedSystem, stack
from zfusion.messages import decode_any
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId
from zfusion.recording import Recording
from zfusion.used_sets import UsedSet

Life = tuple[NodeId, int]
"""(node, first step)."""

Payload = Mapping[str, Any]
UsedSets = dict[int, UsedSet]


def said(path: Path) -> tuple[Scenario, dict[tuple[str, Life], dict[int, Payload]]]:
    """The scenario of a recording, and (stage, life) -> step -> the message; the first, where one came again."""
    found: dict[tuple[str, Life], dict[int, Payload]] = defaultdict(dict)
    with Recording.open(path) as recording:
        scenario = Scenario.from_toml(recording.scenario_toml, str(path), path.parent)
        for record in recording.records():
            stage = record.topic.rpartition("/")[2]
            if stage in {"measurement", "intermediate", "estimate"}:
                raw = decode_any(record.data)
                found[stage, (raw["node"], raw["born"])].setdefault(raw["step"], raw)
    return scenario, found


def assert_only_last_words_are_missing(verdict: Mapping[str, Any], path: Path) -> None:
    """That what a replay missed is what nodes said when they were killed, all at once.

    A message goes to each listener by itself. Its sender may be killed when it has come to a neighbour, and not to the
    recorder; and where the neighbours are killed with it, nobody is left who could tell the recorder.
    """
    assert verdict["different"] == 0, verdict
    missing = verdict["missing"]
    assert len(missing) == verdict["missing_count"], verdict
    assert missing or not verdict["unverifiable"], verdict
    lives: dict[str, dict[int, int]] = defaultdict(dict)
    for (_, (node, born)), messages in said(path)[1].items():
        lives[str(node)][born] = max(*messages, lives[str(node)].get(born, 0))
    for what in missing:
        found = re.fullmatch(r"\w+ of node (\w+), step (\d+), which node \w+ used", what)
        assert found, verdict
        node, step = found[1], int(found[2])
        _, last = max(((born, last) for born, last in lives[node].items() if born <= step), default=(1, 0))
        assert last <= step, f"node {node} went on after step {step}: {what}"


def used_sets(intermediates: Mapping[int, Payload], born: int) -> UsedSets:
    """What a life used at each of its steps, as far as that is known without a gap."""
    used: UsedSets = {}
    for step in sorted(intermediates):
        message = intermediates[step]
        runs = [*message["history"], [step, ()]]
        for (first, ids), (after, _) in pairwise(runs):
            used |= {k: tuple(ids) for k in range(first, after) if k not in used}
        used[step] = tuple(message["used"])
    known: UsedSets = {}
    while born + len(known) in used:
        known[born + len(known)] = used[born + len(known)]
    return known


class Exactness:
    """What the estimates of a recording should be."""

    def __init__(self, path: Path) -> None:
        scenario, self._said = said(path)
        lives = {life for stage, life in self._said if stage == "intermediate"}
        last = max((max(by) for (stage, _), by in self._said.items() if stage == "estimate"), default=0)
        self._stacked: StackedSystem = stack(scenario.system(), last)
        readings = {
            (life[0], step): np.array(message["y"], dtype=float)
            for (stage, life), by in self._said.items()
            if stage == "measurement"
            for step, message in by.items()
            if message["y"] is not None and step <= last
        }
        self._readings = readings
        self._Y = self._stacked.vector(readings)
        self._used = {life: used_sets(self._said["intermediate", life], life[1]) for life in lives}
        self._filters: dict[Life, Estimates] = {}
        self._lives_at: dict[tuple[NodeId, int], list[Life]] = defaultdict(list)
        for life in lives:
            for step in self._said["intermediate", life]:
                self._lives_at[life[0], step].append(life)

    @property
    def lives(self) -> set[Life]:
        return set(self._used)

    def assert_sample(self, random: Random, per_life: int = 12) -> Counter[str]:
        """Some estimates of every life, its last ones among them, each set beside the least-squares one.

        How many there were of each stage, and how many neighbours' estimates were fused in them.
        """
        seen: Counter[str] = Counter()
        for life in sorted(self._used):
            by = self._said["estimate", life]
            steps = sorted(step for step in by if step in self._used[life])
            for step in sorted({*random.sample(steps, min(per_life, len(steps))), *steps[-2:]}):
                self._check(life, step, by[step], seen)
        return seen

    def _check(self, life: Life, step: int, message: Payload, seen: Counter[str]) -> None:
        others = [self._lives_at[j, step] for j in message["used"] if j != life[0]]
        if any(len(lives) != 1 or step not in self._used[lives[0]] for lives in others):
            seen["not to be told"] += 1  # a message of a neighbour's did not get onto the recording
            return
        members: Iterable[Life] = [life, *(lives[0] for lives in others)]
        if not all(self._is_read(j, s) for m in members for s, ids in self._used[m].items() if s <= step for j in ids):
            seen["not to be told"] += 1
            return
        here = StackedSystem(
            self._stacked.ids,
            self._stacked.state_mean[step : step + 1],
            self._stacked.state[step : step + 1],
            self._stacked.reading_mean,
            self._stacked.readings,
            self._stacked.where,
        )
        parts: Any = {member: self._filter(member, step) for member in members}
        self._compare(self._said["intermediate", life].get(step), parts[life], here)
        fused = brute_force.fused(here, parts, life, {(life, 0): tuple(m for m in members if m != life)})  # type: ignore[arg-type, dict-item]
        self._compare(message, fused, here)
        seen.update(estimates=1, fused=len(others))

    def _is_read(self, j: NodeId, step: int) -> bool:
        return (j, step) in self._readings

    def _filter(self, life: Life, step: int) -> Estimates:
        if life not in self._filters:
            used: Any = {(life[0], s): ids for s, ids in self._used[life].items()}
            self._filters[life] = brute_force.intermediate(self._stacked, life[0], used)
        whole = self._filters[life]
        return Estimates(whole.weights[step : step + 1], whole.errors[step : step + 1])

    def _compare(self, message: Payload | None, expected: Estimates, here: StackedSystem) -> None:
        if message is None:
            return
        value, covariance = expected.values(here, self._Y)[0], expected.covariance[0]
        scale = np.abs(covariance).max()
        np.testing.assert_allclose(message["x"], value, rtol=1e-7, atol=1e-6 * np.sqrt(scale))
        if "P" in message:
            told = np.array(message["P"]).reshape(message["shape"])
            np.testing.assert_allclose(told, covariance, rtol=0, atol=1e-7 * scale)
