"""What a choice of messages that do not arrive costs.

A choice is a row of truth values over the messages of the run: (step, arc) of the first stage, then of the second.
A message lost at stage 1 shrinks a used set, one lost at stage 2 removes an estimate from one fusion; the objective,
the mean over nodes and steps of trace Σ or of |x̂ - x|², follows by the recursion (`methods.ensemble`).

Choices that differ from a common base at few steps are followed only while they differ: each begins, as a copy of the
base's filters, at its first other message, and ends when its covariances (and estimates) are the base's again. So what
it costs to look at one does not grow with the length of the run, as long as the filters forget.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from zfusion.errors import InputError
from zfusion.methods import chosen
from zfusion.methods.ensemble import Arcs, Ensemble, Known, copies_at_once
from zfusion.methods.layout import Bools, Ints
from zfusion.methods.neighbourhood import StepModels
from zfusion.model.scenario import Scenario
from zfusion.model.statistics import PriorMoments, prior_moments, step_models
from zfusion.model.types import Array, NodeId
from zfusion.studies.fates import fate_of, method_network

Objective = Literal["predicted", "measured"]

SAME = 1e-8
"""Copies whose covariances differ by less than this from the base's, relative, and likewise estimates, are the base."""

MOST_COPIES = 256
"""Choices that are followed at the same time."""

MEMORY = 32
"""Steps after which most choices are the base again: a guess at how many copies are needed at a time, no more."""


@dataclass(frozen=True)
class Data:
    """What was measured, where not every sensor has a reading at every step, or errors are to be measured."""

    measurements: Mapping[NodeId, Mapping[int, Array]]
    """By sensor and step; what is not there is not used."""
    truth: Mapping[int, Array]
    """By step; for the objective "measured", of all steps."""


class Problem:
    """The messages of one scenario, under its own links, and the objective.

    Raises InputError where the recursion does not cover the scenario, or the truth is not known at some step.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        objective: Objective = "predicted",
        nodes: Collection[NodeId] | None = None,
        data: Data | None = None,
    ) -> None:
        """`nodes`: those whose errors count, by default all; `data`: for "measured"."""
        if scenario.timing.late == "revise":
            raise InputError('timing.late: expected "drop" or "wait": with "revise", late messages are not lost')
        if objective == "measured" and data is None:
            raise InputError("objective measured: there are no measurements with a known truth")
        self.scenario, self.objective = scenario, objective
        self.network, self.system = method_network(scenario), scenario.system()
        self.arcs = Arcs(self.network.neighbourhoods)
        self.fate = fate_of(scenario)
        self.stages = [stage.name for stage in chosen(scenario).stages]
        steps, width = self.fate.used.shape
        parts = [self.fate.used, self.fate.told][: len(self.stages)]
        self.arriving: Bools = np.concatenate([(part & ~self.arcs.own).reshape(-1) for part in parts])
        """Which messages arrive and can be taken away, (messages,)."""
        self.sent = len(self.stages) * steps * int((~self.arcs.own).sum())
        """Messages that there are, of whose number the budget is a part."""
        self.shape = (len(self.stages), steps, width)
        self._counted = np.array([nodes is None or i in nodes for i in self.network.ids])
        self._weights = self.fate.made * self._counted / max(1, int((self.fate.made & self._counted).sum()))
        self._data = data
        self._models = StepModels(lambda: step_models(self.system, self.network.ids))
        self._copies = max(2, min(MOST_COPIES, copies_at_once(self.system, self.network.neighbourhoods)))

    def step_of(self, messages: Ints) -> Ints:
        """The steps, from 0, of messages given by number."""
        _, steps, width = self.shape
        found: Ints = messages // width % steps
        return found

    def value(self, lost: Bools) -> float:
        """The objective if these messages, (messages,), are lost."""
        return self._pass(lost, []).base

    def gains(self, lost: Bools, toggles: Sequence[Ints]) -> Array:
        """By how much the objective grows, from that of `lost`, if the messages of each toggle change sides as well.

        Toggles are message numbers, each once, none empty.
        """
        order = sorted(range(len(toggles)), key=lambda n: int(self.step_of(toggles[n]).min()))
        gains = np.zeros(len(toggles))
        waiting = order
        while waiting:
            done = self._pass(lost, [(n, toggles[n]) for n in waiting])
            for n, gain in done.gains.items():
                gains[n] = gain
            waiting = [n for n in waiting if n not in done.gains]
        return gains

    def _pass(self, lost: Bools, toggles: Sequence[tuple[int, Ints]]) -> _Pass:
        one = _Pass(self, lost, toggles)
        one.run()
        return one

    @cached_property
    def _readings(self) -> Bools | None:
        """For each step and arc whether the sender has a reading, (steps, arcs); None: they all have."""
        if self._data is None:
            return None
        steps = range(1, self.shape[1] + 1)
        of = {i: [k in self._data.measurements.get(i, {}) for k in steps] for i in self.network.ids}
        return np.array([of[sender] for _, sender in self.arcs.pairs]).T

    @cached_property
    def _measured(self) -> _Measured | None:
        """The data as arrays; None for the objective "predicted"."""
        return None if self.objective == "predicted" or self._data is None else _Measured.of(self, self._data)


@dataclass(frozen=True)
class _Measured:
    """Measurements and truth as arrays."""

    Y: Array
    """(steps, ny), zero where there is no reading."""
    truth: Array
    """(steps, nx)."""

    @classmethod
    def of(cls, problem: Problem, data: Data) -> _Measured:
        steps = problem.shape[1]
        missing = [k for k in range(1, steps + 1) if k not in data.truth]
        if missing:
            raise InputError(f"objective measured: the true state is not known at step {missing[0]}")
        sizes = [problem.system.by_id[i].ny for i in problem.network.ids]
        Y, start = np.zeros((steps, sum(sizes))), 0
        for i, ny in zip(problem.network.ids, sizes, strict=True):
            for k, y in data.measurements.get(i, {}).items():
                if k <= steps:
                    Y[k - 1, start : start + ny] = y
            start += ny
        return cls(Y, np.array([data.truth[k] for k in range(1, steps + 1)]))


class _Pass:
    """One pass over the steps: copy 0 is the base, the others are choices while they differ from it."""

    def __init__(self, problem: Problem, lost: Bools, toggles: Sequence[tuple[int, Ints]]) -> None:
        self.base = 0.0
        """The objective of the base."""
        self.gains: dict[int, float] = {}
        """Of the choices that have been followed to their end, by number."""
        self._problem = problem
        self._lost, self._toggles = lost.reshape(problem.shape), toggles
        _, self._steps, self._width = problem.shape
        together = 1 + min(len(toggles), 16 + len(toggles) * MEMORY // self._steps)
        copies = min(problem._copies, together)
        self._ensemble = Ensemble(problem.system, problem.network.neighbourhoods, copies, fusing=problem.network.ids)
        self._known: Known | None = None
        if problem._measured is not None:
            self._known = self._ensemble.start(prior_moments(problem.system).mean)
        self._free = list(range(copies - 1, 0, -1))
        self._under_way: dict[int, _Choice] = {}
        """By copy."""
        self._next = 0

    def run(self) -> None:
        """Go through all steps."""
        problem, ensemble = self._problem, self._ensemble
        moments = prior_moments(problem.system)
        for step in range(self._steps):
            self._begin_choices(step)
            begins = problem.fate.begins[step]
            if begins.any():
                ensemble.forget(np.tile(begins, (ensemble.copies, 1)), moments)
                self._forget_data(begins, moments)
            model, moments = problem._models.at(step + 1)
            used, told = self._used_and_told(step)
            ensemble.advance(model, used)
            squared = self._squared(step, told, moments)
            weighted = squared @ problem._weights[step]
            self.base += float(weighted[0])
            for copy, choice in self._under_way.items():
                choice.gain += float(weighted[copy] - weighted[0])
            self._end_choices(step, squared)
        self.gains.update({choice.number: choice.gain for choice in self._under_way.values()})

    def _begin_choices(self, step: int) -> None:
        """Those whose first message is one of this step, as long as there are copies; the others wait."""
        begun = []
        while self._next < len(self._toggles):
            number, messages = self._toggles[self._next]
            steps = self._problem.step_of(messages)
            if steps.min() > step:
                break
            self._next += 1
            if steps.min() == step and self._free:
                copy = self._free.pop()
                places = messages // (self._steps * self._width) * self._width + messages % self._width
                columns = {k: places[steps == k] for k in set(steps.tolist())}
                self._under_way[copy] = _Choice(number, columns, int(steps.max()))
                begun.append(copy)
        if begun:
            self._ensemble.copy(0, begun)
            if self._known is not None:
                self._known = self._known.copied(0, begun)

    def _used_and_told(self, step: int) -> tuple[Bools, Bools]:
        problem, copies = self._problem, self._ensemble.copies
        lost = np.repeat(self._lost[None, :, step], copies, axis=0)
        flat = lost.reshape(copies, -1)
        for copy, choice in self._under_way.items():
            if (columns := choice.columns.get(step)) is not None:
                flat[copy, columns] ^= True
        used = problem.fate.used[step] & ~lost[:, 0]
        readings = problem._readings
        if readings is not None:
            used &= readings[step]
        told = problem.fate.told[step] & ~lost[:, -1] if len(problem.stages) > 1 else problem.arcs.own[None]
        return used, np.broadcast_to(told, used.shape)

    def _squared(self, step: int, told: Bools, moments: PriorMoments) -> Array:
        """What the objective is the mean of, (copies, m)."""
        measured = self._problem._measured
        if measured is None or self._known is None:
            return np.asarray(np.einsum("cmaa->cm", self._ensemble.fused(told, moments)))
        self._known = self._ensemble.filtered(self._known, measured.Y[step])
        error = self._ensemble.fused_estimates(told, moments, self._known) - measured.truth[step]
        return np.asarray((error**2).sum(axis=-1))

    def _forget_data(self, begins: Bools, moments: PriorMoments) -> None:
        if self._known is not None:
            x = np.where(begins[None, :, None], moments.mean, self._known.x)
            self._known = Known(x, self._known.innovations)

    def _end_choices(self, step: int, squared: Array) -> None:
        """Those that are the base again, and have no other message to come."""
        over = [copy for copy, choice in self._under_way.items() if choice.last < step]
        if not over or step % 2:  # to look is as much work as a part of a step
            return
        P = self._ensemble.intermediate
        size = np.einsum("maa->m", P[0])[:, None, None]
        same = (np.abs(P[over] - P[0]) <= SAME * size).all(axis=(1, 2, 3))
        same &= (np.abs(squared[over] - squared[0]) <= SAME * np.abs(squared[0])).all(axis=1)
        if self._known is not None:
            apart = ((self._known.x[over] - self._known.x[0]) ** 2).sum(axis=-1)
            same &= (apart <= SAME**2 * np.einsum("maa->m", P[0])).all(axis=1)
        for copy, is_same in zip(over, same, strict=True):
            if is_same:
                choice = self._under_way.pop(copy)
                self.gains[choice.number] = choice.gain
                self._free.append(copy)


@dataclass(slots=True)
class _Choice:
    """One that is under way."""

    number: int
    columns: Mapping[int, Ints]
    """By step, the messages that change sides, as places among (stages, arcs)."""
    last: int
    gain: float = 0.0
