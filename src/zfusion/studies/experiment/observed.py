"""What is kept of a run: its published messages, from whichever world, as arrays.

The same stream of messages comes out of a simulation and out of a recording of a live swarm; all metrics are computed
from it and from the nodes' own reports.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from zfusion.messages import encode
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario
from zfusion.model.types import Array, NodeId
from zfusion.stages import ARRIVALS, ESTIMATE, EVENT, REVISED, TRUTH, Message
from zfusion.used_sets import UsedSet


@dataclass(slots=True)
class Told:
    """One node's estimates of one stage, in the order in which it told them."""

    steps: list[int] = field(default_factory=list)
    born: list[int] = field(default_factory=list)
    """First step of the life that told it."""
    x: list[Array] = field(default_factory=list)
    P: list[Array | None] = field(default_factory=list)
    used: list[UsedSet] = field(default_factory=list)


class Observer:
    """Takes in the messages of a run, each as it was published."""

    def __init__(self, scenario: Scenario) -> None:
        method = chosen(scenario)
        self.scenario = scenario
        self.graph = method.network(scenario.network)
        """The method's."""
        self.stages = tuple(stage.name for stage in method.stages)
        """Those that are exchanged, in order."""
        self.estimates: dict[tuple[str, NodeId], Told] = {}
        """By stage and node."""
        self.messages: Counter[tuple[NodeId, str]] = Counter()
        """By node and stage."""
        self.bytes: Counter[tuple[NodeId, str]] = Counter()
        self.latencies_ns: dict[tuple[NodeId, NodeId, str], list[int]] = {}
        """By sender, receiver and stage: how long the messages took that arrived."""
        self.revised: dict[NodeId, list[tuple[int, int, UsedSet]]] = {}
        """By node: (step at which it was, step that was changed, whose late measurements its filter took in)."""

    def __call__(self, message: Message, _now_ns: int) -> None:
        """One published message."""
        self.take(message, len(encode(message)))

    def take(self, message: Message, size: int) -> None:
        """One published message whose payload has so many bytes."""
        node, stage, fields = message.node, message.stage, message.fields
        if stage == TRUTH.name:
            return
        self.messages[node, stage] += 1
        self.bytes[node, stage] += size
        if stage == EVENT.name and fields["kind"] == "revised":
            self._note_revision(message)
        elif stage == ARRIVALS.name:
            self._note_arrivals(message)
        elif "x" in fields:
            told = self.estimates.get((stage, node))
            if told is None:
                told = self.estimates[stage, node] = Told()
            told.steps.append(message.step)
            told.born.append(message.born)
            told.x.append(cast(Array, fields["x"]))
            told.P.append(cast("Array | None", fields.get("P")))
            told.used.append(cast(UsedSet, fields.get("used", ())))

    def _note_revision(self, message: Message) -> None:
        data = cast(Mapping[str, Any], message.fields["data"])
        if data["stage"] == self.stages[0]:
            for step, ids in data["taken"]:
                self.revised.setdefault(message.node, []).append((message.step, int(step), tuple(ids)))

    def _note_arrivals(self, message: Message) -> None:
        data = cast(Mapping[str, Any], message.fields["data"])
        for edge in data["edges"]:
            place = (self.scenario.node_id(str(edge["from"])), message.node, edge["stage"])
            self.latencies_ns.setdefault(place, []).extend(edge["latency_ns"])

    def finish(self) -> None:
        """All has been taken in: of every step, what was said of it last counts as its revised estimate."""
        for i in self.scenario.ids:
            final, corrected = self.estimates.get((ESTIMATE.name, i)), self.estimates.get((REVISED.name, i))
            if final is not None and any(REVISED.name == stage for stage, _ in self.estimates):
                self.estimates[REVISED.name, i] = _last_words(final, corrected or Told())

    @property
    def told_stages(self) -> tuple[str, ...]:
        """The stages that tell estimates, the final one last."""
        found = dict.fromkeys(stage for stage, _ in self.estimates)
        return tuple(sorted(found, key=lambda stage: (stage == ESTIMATE.name, stage)))


def _last_words(final: Told, corrected: Told) -> Told:
    """Of every step the last correction, or the estimate where there is none."""
    rows = {(k, born): (final, n) for n, (k, born) in enumerate(zip(final.steps, final.born, strict=True))}
    rows |= {(k, born): (corrected, n) for n, (k, born) in enumerate(zip(corrected.steps, corrected.born, strict=True))}
    found = Told()
    for (step, born), (told, n) in sorted(rows.items(), key=lambda row: row[0]):
        found.steps.append(step)
        found.born.append(born)
        found.x.append(told.x[n])
        found.P.append(told.P[n])
        found.used.append(told.used[n])
    return found


@dataclass(frozen=True)
class UsedSets:
    """Which measurements went into which estimates, as arrays over steps 0..K and nodes in sorted order."""

    newest: NDArray[np.int64]
    """(K+1, m, m): at each step, for node l, the step of the newest measurement of j that went into its filter."""
    used: NDArray[np.bool_]
    """(K+1, m, m): whether l used j's measurement of this step, in time."""
    fused: NDArray[np.bool_]
    """(K+1, m, m): whether i fused l's estimate; true of i = l where it told an estimate."""


def used_sets(observer: Observer) -> UsedSets:
    """The used sets of a run."""
    scenario, graph = observer.scenario, observer.graph
    ids = scenario.ids
    place = {i: n for n, i in enumerate(ids)}
    steps, m = scenario.steps, len(ids)
    newest = np.zeros((steps + 1, m, m), dtype=np.int64)
    used, fused = np.zeros((steps + 1, m, m), dtype=bool), np.zeros((steps + 1, m, m), dtype=bool)
    filtering = observer.stages[1] if len(observer.stages) > 1 else ESTIMATE.name
    for i in graph.ids:
        row = place[i]
        filters = observer.estimates.get((filtering, i), Told())
        for step, of in zip(filters.steps, filters.used, strict=True):
            used[step, row, [place[j] for j in of]] = True
        np.multiply(used[:, row], np.arange(steps + 1)[:, None], out=newest[:, row])
        for at, changed, of in observer.revised.get(i, ()):
            columns = [place[j] for j in of]
            newest[at, row, columns] = np.maximum(newest[at, row, columns], changed)
        births = sorted({0, *filters.born})
        for begin, end in zip(births, [*births[1:], steps + 1], strict=True):  # a new life has used nothing
            newest[begin:end, row] = np.maximum.accumulate(newest[begin:end, row], axis=0)
        final = observer.estimates.get((ESTIMATE.name, i), Told())
        for step, of in zip(final.steps, final.used, strict=True):
            fused[step, row, row] = True
            if filtering != ESTIMATE.name:
                fused[step, row, [place[j] for j in of]] = True
    return UsedSets(newest, used, fused)
