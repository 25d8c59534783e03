"""Runs of the methods that are compared: what each estimated, and what that cost in messages, bytes and time."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple, cast

import numpy as np

from zfusion import keys
from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError, ZfusionError
from zfusion.methods import chosen
from zfusion.methods.protocol import Fields, Method, Outcome, Revising, Setting, Wary
from zfusion.model.network import Network
from zfusion.model.sampling import SamplePath
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.stages import ESTIMATE, Message, Stage
from zfusion.studies.compare import common_steps, series_of
from zfusion.studies.contestants import Field
from zfusion.used_sets import Ledger, UsedSet


class Cost(NamedTuple):
    """What one method's run cost."""

    messages: int
    bytes: int
    ns: Sequence[int]
    """Of every node and step."""


class SeedRun(NamedTuple):
    """All methods on the measurements and the network of one seed, or of a recording."""

    errors: Sequence[Array]
    """Squared, by configuration, (steps, m): the contestants, then their ideal twins where there are any."""
    nees: Sequence[Array]
    costs: Sequence[Cost]
    """By contestant."""


def run_all(field: Field, seed: int | None) -> SeedRun:
    """Simulate all contestants with one seed; of a recording, whose measurements are given, with none."""
    scenarios = [one.scenario for one in field.contestants]
    ideals = [one.ideal for one in field.contestants if one.ideal is not None]
    if seed is not None:
        scenarios = [scenario.with_overrides(seed=seed) for scenario in scenarios]
        ideals = [scenario.with_overrides(seed=seed) for scenario in ideals]
    truth = _truth(scenarios[0], field.truths)
    runs = [_observed(scenario) for scenario in scenarios]
    estimates = [told for told, _ in runs] + [_observed(scenario)[0] for scenario in ideals]
    ids = scenarios[0].ids
    errors = common_steps([series_of(iter(told), ids, truth, "mse") for told in estimates])
    nees = [_nees(told, ids, truth) for told in estimates[: len(scenarios)]]
    return SeedRun(errors, nees, [cost for _, cost in runs])


def _truth(scenario: Scenario, recorded: Mapping[int, Array] | None) -> Array:
    """(steps + 1, nx), NaN where it is not known."""
    if recorded is None:
        path = SamplePath(scenario.system(), scenario.seed)
        return np.array([path.truth(k) for k in range(scenario.steps + 1)])
    truth = np.full((scenario.steps + 1, scenario.system().nx), np.nan)
    for step, x in recorded.items():
        if step <= scenario.steps:
            truth[step] = x
    return truth


def _nees(estimates: Sequence[Message], ids: Sequence[NodeId], truth: Array) -> Array:
    try:
        return series_of(iter(estimates), ids, truth, "nees")
    except InputError:  # an error that is predicted to be zero in some direction
        return np.full((len(truth) - 1, len(ids)), np.nan)


def _observed(scenario: Scenario) -> tuple[list[Message], Cost]:
    """Simulate it: its estimates, and what it cost."""
    make, told, timed, payloads = chosen(scenario), list[Message](), list[_Timed](), Counter[tuple[str, str]]()
    sizes: Counter[tuple[str, str]] = Counter()

    def method(setting: Setting) -> Method:
        made = make(setting)
        timed.append(_TimedAndWary(made) if isinstance(made, Wary) else _Timed(made))
        return timed[-1]

    def observe(message: Message, _now_ns: int) -> None:
        if message.stage == ESTIMATE.name:
            told.append(message)

    def record(key: str, payload: bytes, _now_ns: int) -> None:
        with suppress(ZfusionError):
            said = keys.parse(key)
            payloads[str(said.node), said.stage] += 1
            sizes[str(said.node), said.stage] += len(payload)

    simulation = Simulation(scenario, method=method, observe=observe, record=record)
    try:
        simulation.run()
    finally:
        simulation.close()
    listeners = _listeners(make.network(scenario.network))
    exchanged = {stage.name for stage in make.stages}
    sent = [
        (listeners[node] * count, listeners[node] * sizes[node, stage])
        for (node, stage), count in payloads.items()
        if stage in exchanged
    ]
    ns = [spent for one in timed for spent in one.spent_ns.values()]
    return told, Cost(sum(count for count, _ in sent), sum(size for _, size in sent), ns)


def _listeners(graph: Network) -> Counter[str]:
    """How many others hear each node."""
    return Counter(str(j) for i in graph.ids for j in graph.neighbours(i) if j != i)


class _Timed:
    """A method, and the CPU time that it took by step."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self.spent_ns: Counter[int] = Counter()
        self._step = 0

    @property
    def stages(self) -> tuple[Stage, ...]:
        return self._method.stages

    def begin(self, step: int, y: Array | None) -> Fields:
        self._step, began = step, time.process_time_ns()
        fields = self._method.begin(step, y)
        self.spent_ns[step] += time.process_time_ns() - began
        return fields

    def skip(self, step: int) -> None:
        self._method.skip(step)

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:
        began = time.process_time_ns()
        result = self._method.advance(stage, step, arrived, ledger)
        self.spent_ns[step] += time.process_time_ns() - began
        return result

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        began = time.process_time_ns()
        taken = cast(Revising, self._method).revise(late)
        self.spent_ns[self._step] += time.process_time_ns() - began
        return taken

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:
        began = time.process_time_ns()
        outcome = cast(Revising, self._method).correct(step, heard)
        self.spent_ns[self._step] += time.process_time_ns() - began
        return outcome


class _TimedAndWary(_Timed):
    """Of a method that refuses messages."""

    def refuses(self, stage: int, fields: Fields) -> str | None:
        return cast(Wary, self._method).refuses(stage, fields)
