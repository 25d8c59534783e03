"""The fate of all messages of a run: who used whose measurements and estimates at each step, without any data.

It is found by running the swarm in virtual time with the very nodes, links, deadlines and faults of a simulation, and
with a method that computes nothing but used sets. So it is what happens in a simulation with the same seed, by
construction, at a twentieth of the cost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from zfusion.drivers.simulated import Simulation
from zfusion.errors import InputError
from zfusion.methods import chosen
from zfusion.methods.ensemble import Arcs
from zfusion.methods.layout import Bools
from zfusion.methods.protocol import Fields, Outcome, Setting
from zfusion.methods.two_stage import Centralized, Local, TwoStage
from zfusion.model.network import Network
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.stages import INTERMEDIATE, MEASUREMENT, Stage
from zfusion.used_sets import Ledger, UsedSet

COVERED = (TwoStage.name, Centralized.name, Local.name)
"""Methods whose error covariances follow from used sets alone, by the recursion of `methods.covariances`."""


@dataclass(frozen=True)
class Fate:
    """Rows are the steps 1, 2, ...; columns the arcs of the method's network, as `Arcs` orders them, or its nodes."""

    used: Bools
    """Whose measurement of the step the receiver used, (steps, arcs)."""
    told: Bools
    """Whose intermediate estimate it fused, (steps, arcs); itself always."""
    made: Bools
    """Whether there is an estimate of the node, (steps, m)."""
    begins: Bools
    """Whether the node begins a new life with this step, knowing nothing, (steps, m); the first lives do not count."""
    taken: tuple[tuple[int, int, int], ...]
    """What was late and is used from a later step on: (that step, step of the measurement, arc)."""


def covered(scenario: Scenario) -> None:
    """InputError unless what is predicted here is what the scenario's method computes."""
    if scenario.method.name not in COVERED:
        known = ", ".join(COVERED)
        raise InputError(f"method {scenario.method.name}: errors can be predicted from used sets for {known} only")


def method_network(scenario: Scenario) -> Network:
    """The graph whose neighbourhoods the scenario's method uses."""
    return chosen(scenario).network(scenario.network)


def fate_of(scenario: Scenario) -> Fate:
    """What becomes of all messages of the scenario, where every sensor always has a reading.

    InputError for a method that is not `covered`, and for links that cannot be had (`links_of`).
    """
    covered(scenario)
    network = method_network(scenario)
    told = _Told(scenario, network)
    sizes = {sensor.id: sensor.ny for sensor in scenario.system().sensors}
    sources = {i: _Blank(sizes[i]) for i in network.ids}
    Simulation(scenario, sources=sources, method=told.bookkeeper).run()
    return Fate(told.used, told.told, told.made, told.begins, tuple(told.taken))


class _Told:
    """What the bookkeepers of a network write down."""

    def __init__(self, scenario: Scenario, network: Network) -> None:
        steps = scenario.steps
        self.arcs = Arcs(network.neighbourhoods)
        self.rank = {i: at for at, i in enumerate(network.ids)}
        self.used = np.zeros((steps, len(self.arcs)), dtype=np.bool_)
        self.told = np.tile(self.arcs.own, (steps, 1))
        self.made = np.zeros((steps, len(network.ids)), dtype=np.bool_)
        self.begins = np.zeros_like(self.made)
        self.taken: list[tuple[int, int, int]] = []
        self._made = _Fusing if len(chosen(scenario).stages) > 1 else _Bookkeeper

    def bookkeeper(self, setting: Setting) -> _Bookkeeper:
        """For one life of a node."""
        if setting.born > 1:
            self.begins[setting.born - 1, self.rank[setting.node]] = True
        return self._made(setting, self)


class _Bookkeeper:
    """The used sets of a method of one stage, and nothing of its mathematics."""

    name: ClassVar[str] = "used sets"
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT,)
    revises: ClassVar[bool] = True

    def __init__(self, setting: Setting, told: _Told) -> None:
        self._node, self._told = setting.node, told
        self._neighbourhood = setting.network.neighbours(setting.node)
        self._x, self._P = np.zeros(setting.system.nx), np.eye(setting.system.nx)
        self._window, self._step = setting.window, setting.born - 1
        self._used: dict[int, set[NodeId]] = {}
        """By step, as far as it may be revised."""

    @staticmethod
    def network(graph: Network) -> Network:
        """The graph, as it is."""
        return graph

    def begin(self, step: int, y: Array | None) -> Fields:
        """The measurement, as it is."""
        self._step = step
        return {"y": y}

    def skip(self, step: int) -> None:
        """Nothing is used."""

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        """Take in what had not been used."""
        place, taken = self._told.arcs.place, {}
        for step in sorted(late):
            used = self._used.setdefault(step, set())
            new = tuple([j for j in self._neighbourhood if j in late[step] and j not in used])
            if new:
                taken[step] = new
                used.update(new)
                self._told.taken.extend((self._step, step, place[self._node, j]) for j in new)
        return taken

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:  # noqa: ARG002
        """Nothing better than what was told."""
        return Outcome(self._x, self._P, ())

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:  # noqa: ARG002
        """Use what has arrived."""
        used = self._use(step, arrived)
        return self._outcome(step, used)

    def _use(self, step: int, arrived: Mapping[NodeId, Fields]) -> UsedSet:
        used = tuple([j for j in self._neighbourhood if j in arrived])
        self._write(self._told.used, step, used)
        if self._window:
            self._used[step] = set(used)
            self._used.pop(step - self._window - 1, None)
        return used

    def _outcome(self, step: int, used: UsedSet, excluded: Mapping[NodeId, int] = MappingProxyType({})) -> Outcome:
        self._told.made[step - 1, self._told.rank[self._node]] = True
        return Outcome(self._x, self._P, used, tuple(excluded), excluded)

    def _write(self, table: Bools, step: int, senders: UsedSet) -> None:
        place = self._told.arcs.place
        table[step - 1, [place[self._node, j] for j in senders]] = True


class _Fusing(_Bookkeeper):
    """The same with a second stage."""

    name: ClassVar[str] = "used sets of two stages"
    stages: ClassVar[tuple[Stage, ...]] = (MEASUREMENT, INTERMEDIATE)

    def __init__(self, setting: Setting, told: _Told) -> None:
        super().__init__(setting, told)
        self._known: dict[NodeId, tuple[int, int]] = {}
        """For each neighbour, in which life of it all its used sets are known, and up to which step."""

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:
        """Use what has arrived; a neighbour whose used sets are not known without a gap is left out, and asked."""
        if stage == 0:
            return {"x": self._x, "used": self._use(step, arrived)}
        there = [j for j in self._neighbourhood if j in arrived]
        unknown = {j: first for j in there if (first := self._first_unknown(ledger, j, step)) is not None}
        used = tuple([j for j in there if j not in unknown])
        self._write(self._told.told, step, used)
        return self._outcome(step, used, unknown)

    def _first_unknown(self, ledger: Ledger, node: NodeId, step: int) -> int | None:
        history = ledger.of(node)
        if history is None:
            return step
        born, known = self._known.get(node, (history.born, history.born - 1))
        first = history.first_unknown(known + 1 if born == history.born else history.born, step)
        self._known[node] = history.born, step if first is None else first - 1
        return first


class _Blank:
    """A sensor that always has a reading, of zeros."""

    def __init__(self, ny: int) -> None:
        self.counters: Counter[str] = Counter()
        self._y = np.zeros(ny)

    def read(self, step: int, t_ns: int) -> Array | None:  # noqa: ARG002
        """See `Source`."""
        return self._y

    def truth(self, step: int) -> Array | None:  # noqa: ARG002
        """See `Source`."""
        return None

    def close(self) -> None:
        """See `Source`."""
