"""The covariances that one node needs to fuse its neighbours' intermediate estimates, whatever is known of them.

A node can follow a neighbour's filter only as far as it knows the neighbour's used sets. What arrives late, in
gaps or after a restart is taken in by going back to the newest state that is still right and forward again; a
neighbour of which something is missing is left out of the fusion until it is known, so that what is fused is always
exact. Deterministic: the same ledger at the same steps gives the same states, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np

from zfusion.methods.covariances import Bools, Layout, State, advance, forget, prior
from zfusion.model.statistics import PriorMoments, StepModel
from zfusion.model.types import Array, NodeId
from zfusion.used_sets import Ledger, UsedSet

WINDOW = 64
"""Past steps whose states are kept. A used set that becomes known within it costs as many steps of covariance work as it is
late; beyond it the node goes back to the state it put aside when the gap began."""

CATCH_UP = 256
"""Steps of covariance work that a node does at most within one step to catch up after a longer gap: tens of
milliseconds, so that it keeps its own deadlines meanwhile."""

MASKS = 1024
"""Combinations of used sets whose masks are remembered."""

Statistics = Callable[[], Iterator[tuple[StepModel, PriorMoments]]]
"""Starts an iterator over the statistics of steps 1, 2, ..."""


class StepModels:
    """Statistics by step, from an iterator that runs forwards: recent steps are kept, older ones recomputed."""

    def __init__(self, start: Statistics) -> None:
        self._start = start
        self._iterator = start()
        self._kept: dict[int, tuple[StepModel, PriorMoments]] = {}
        self._next = 1

    def at(self, step: int) -> tuple[StepModel, PriorMoments]:
        """(StepModel, PriorMoments) of a step, from 1 on."""
        found = self._kept.get(step)
        if found is not None:
            return found
        if step < self._next:
            self._iterator, self._kept, self._next = self._start(), {}, 1
        for number, item in zip(
            range(self._next, step + 1), islice(self._iterator, step + 1 - self._next), strict=True
        ):
            self._kept[number] = item
            self._kept.pop(number - WINDOW - 2, None)
        self._next = step + 1
        return self._kept[step]


@dataclass(frozen=True, slots=True)
class Tracked:
    """A state of the recursion, the step it stands at, and for which nodes (by position) it is right."""

    step: int
    state: State
    exact: tuple[bool, ...]


class Neighbourhood:
    """Tracks P^(lj) for l, j in N_i with the help of the ledger."""

    def __init__(
        self,
        node: NodeId,
        neighbourhoods: Mapping[NodeId, tuple[NodeId, ...]],
        sizes: Mapping[NodeId, int],
        statistics: Statistics,
        initial: PriorMoments,
    ) -> None:
        """`neighbourhoods` are those of all l in N_i, `sizes` those of all sensors in them."""
        self._layout = Layout.build(neighbourhoods, sizes)
        self._nodes = self._layout.nodes
        self._own = self._nodes.index(node)
        self._initial = initial
        self._models = StepModels(statistics)
        start = Tracked(0, prior(self._layout, initial.covariance), (True,) * len(self._nodes))
        self._head = start
        self._recent: dict[int, Tracked] = {0: start}
        self._aside: dict[int, Tracked] = {}
        self._masks: dict[tuple[UsedSet | None, ...], Bools] = {}

    def follow(self, step: int, ledger: Ledger) -> None:
        """Bring the states up to `step` with all that the ledger knows."""
        for node, changed in ledger.take_changes().items():
            self._go_back(self._nodes.index(node), changed, ledger)
        budget = CATCH_UP
        while self._head.step < step and budget:
            following = self._following(self._head, ledger)
            budget -= following.state is not self._head.state
            self._keep(following)

    def exact(self, step: int) -> frozenset[NodeId]:
        """The nodes whose covariances at `step` are known; empty while still catching up."""
        if self._head.step < step:
            return frozenset()
        return frozenset(node for node, known in zip(self._nodes, self._head.exact, strict=True) if known)

    def missing(self, node: NodeId, step: int, ledger: Ledger) -> int | None:
        """The first step up to `step` whose used set of `node` is needed and not known; None where all is known."""
        history = ledger.of(node)
        aside = self._aside.get(self._nodes.index(node))
        start = aside.step + 1 if aside is not None else step
        return start if history is None else history.first_unknown(start, step)

    def blocks(self, others: Collection[NodeId]) -> tuple[Array, Array, Array]:
        """P^(ii) (nx, nx), P^(ij) (d, nx, nx) and P^(jl) (d, d, nx, nx) for the sorted `others`, at the newest step."""
        chosen = [self._own, *(self._nodes.index(node) for node in others)]
        P = self._head.state.P[np.array(chosen)[:, None], :, self._layout.places(chosen)]
        return P[0, 0], P[0, 1:], P[1:, 1:]

    def moments(self, step: int) -> PriorMoments:
        """Mean and covariance of the state at `step`, before any measurement."""
        return self._models.at(step)[1]

    @property
    def state(self) -> State:
        """The newest state: the same object while nothing has changed."""
        return self._head.state

    def _following(self, head: Tracked, ledger: Ledger) -> Tracked:
        """The next step after `head`, with the used sets that are known and none where they are not."""
        step = head.step + 1
        histories = [ledger.of(node) for node in self._nodes]
        begins = [step > 1 and h is not None and h.born == step for h in histories]
        state = head.state
        if any(begins):
            covariance = (self.moments(head.step) if head.step else self._initial).covariance
            state = forget(self._layout, state, np.flatnonzero(begins).tolist(), covariance)
        used = tuple(None if h is None else h.at(step) for h in histories)
        exact = tuple(
            (known or begin) and of is not None for known, begin, of in zip(head.exact, begins, used, strict=True)
        )
        return Tracked(step, advance(self._layout, state, self._models.at(step)[0], self._mask(used)), exact)

    def _mask(self, used: tuple[UsedSet | None, ...]) -> Bools:
        mask = self._masks.get(used)
        if mask is None:
            if len(self._masks) == MASKS:
                self._masks.clear()
            mask = self._layout.used({node: of or () for node, of in zip(self._nodes, used, strict=True)})
            self._masks[used] = mask
        return mask

    def _keep(self, following: Tracked) -> None:
        for row, (before, after) in enumerate(zip(self._head.exact, following.exact, strict=True)):
            if before and not after:
                self._aside[row] = self._head
            elif after:
                self._aside.pop(row, None)
        self._head = self._recent[following.step] = following
        self._recent.pop(following.step - WINDOW, None)

    def _go_back(self, row: int, changed: int, ledger: Ledger) -> None:
        """Begin again before `changed`, from the newest state that this row can be followed from, if there is one."""
        history = ledger.of(self._nodes[row])
        if history is None or changed > self._head.step:
            return
        base = next(
            (
                kept
                for kept in reversed(self._recent.values())
                if kept.step < changed and (kept.exact[row] or history.born > kept.step)
            ),
            self._aside.get(row),
        )
        if base is None or history.first_unknown(base.step + 1, changed) is not None:
            return
        for later in [step for step in self._recent if step > base.step]:
            del self._recent[later]
        if base.step not in self._recent:
            self._recent = {base.step: base}
        self._head = base
