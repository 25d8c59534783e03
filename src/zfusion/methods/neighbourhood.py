"""The covariances that one node needs to fuse its neighbours' intermediate estimates, whatever is known of them.

A node can follow a neighbour's filter only as far as it knows the neighbour's used sets. What arrives late, in
gaps or after a restart is taken in by going back to the newest state that is still right and forward again; a
neighbour of which something is missing is left out of the fusion until it is known, so that what is fused is always
exact. Deterministic: the same ledger at the same steps gives the same states, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import NamedTuple

from zfusion.methods.covariances import State, advance, forget, prior
from zfusion.methods.fusion import joint_index
from zfusion.methods.layout import Ints, Layout, Used
from zfusion.model.statistics import PriorMoments, StepModel
from zfusion.model.types import Array, NodeId
from zfusion.used_sets import Ledger, UsedSet

WINDOW = 64
"""Past steps whose states are kept. A used set that becomes known within it costs as many steps of covariance work as
it is late; beyond it the node goes back to the state it put aside when the gap began."""

WINDOW_BYTES = 1 << 26
"""What those states may take: a hub of 32 nodes keeps fewer of them."""

CATCH_UP = 2048
"""Work that a node does at most within one step to catch up after a longer gap, in steps of settled covariances: tens
of milliseconds, so that it keeps its own deadlines meanwhile."""

UNSETTLED = 16
"""What a step costs whose covariances have to be computed, in steps of settled ones."""

COMBINATIONS = 1024
"""Combinations of used sets, and of fused neighbours, for which it is remembered where things stand."""

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
        while self._next <= step:
            self._kept[self._next] = next(self._iterator)
            self._kept.pop(self._next - WINDOW - 2, None)
            self._next += 1
        return self._kept[step]


class Tracked(NamedTuple):
    """A state of the recursion, the step it stands at, and for which nodes (by position) it is right."""

    step: int
    state: State
    exact: tuple[bool, ...]


class Past(NamedTuple):
    """The state of a step, for what is known now, and for whom it is right."""

    state: State
    exact: Mapping[NodeId, bool]

    def knows(self, node: NodeId) -> bool:
        """Whether the node's covariances are right."""
        return self.exact[node]


class Neighbourhood:
    """Tracks P^(lj) for l, j in N_i with the help of the ledger."""

    def __init__(
        self,
        node: NodeId,
        neighbourhoods: Mapping[NodeId, Collection[NodeId]],
        sizes: Mapping[NodeId, int],
        statistics: Statistics,
        initial: PriorMoments,
        *,
        revisable: int = 0,
    ) -> None:
        """`neighbourhoods` are those of all l in N_i, `sizes` those of all sensors in them.

        `revisable`: how many steps before its last message a node may have changed what it used without our knowing.
        """
        self._layout = Layout.build(neighbourhoods, sizes)
        self._nodes = self._layout.nodes
        self._row = {node: row for row, node in enumerate(self._nodes)}
        self._node = node
        self._initial = initial
        self._models = StepModels(statistics)
        start = Tracked(0, prior(self._layout, initial.covariance), (True,) * len(self._nodes))
        self._head = start
        self._recent: dict[int, Tracked] = {0: start}
        """The last states up to the head, in ascending order of their steps."""
        self._aside: dict[int, Tracked] = {}
        """For each row that is not exact at the head: the last state at which it was for good, if there is one."""
        self._revisable = revisable
        self._window = max(2 + revisable, min(WINDOW, WINDOW_BYTES // (3 * start.state.Pi.nbytes + 1)))
        self._named: tuple[tuple[bool, ...], frozenset[NodeId]] = (start.exact, frozenset(self._nodes))
        self._masks: dict[tuple[UsedSet | None, ...], Used] = {}
        self._joints: dict[tuple[NodeId, ...], Ints] = {}

    def follow(self, step: int, ledger: Ledger) -> None:
        """Bring the states up to `step` with all that the ledger knows, or nearer to it after a long gap."""
        for node, changed in ledger.take_changes().items():
            row = self._row.get(node)
            if row is not None and changed <= self._head.step:
                self._go_back(row, changed, ledger)
        budget = CATCH_UP
        while self._head.step < step and budget > 0 and self._is_worth_it(step, ledger):
            following = self._following(self._head, ledger)
            budget -= 1 if following.state is self._head.state else UNSETTLED
            self._keep(following)

    def exact(self, step: int) -> frozenset[NodeId]:
        """The nodes whose covariances at `step` are known; empty while still catching up."""
        head = self._head
        if head.step != step:
            return frozenset()
        if head.exact is not self._named[0]:
            names = frozenset(node for node, known in zip(self._nodes, head.exact, strict=True) if known)
            self._named = head.exact, names
        return self._named[1]

    def missing(self, node: NodeId, step: int, ledger: Ledger) -> int | None:
        """The first step up to `step` whose used set of `node` is needed and not known; None where all is known."""
        row, history = self._row[node], ledger.of(node)
        base = self._head if self._head.exact[row] else self._aside.get(row)
        if history is None or base is None:
            return None
        return history.first_unknown(base.step + 1, step)

    def at(self, step: int) -> Past | None:
        """The state of a past step, from all that is known now; None if it is not kept, or not reached yet."""
        kept = self._recent.get(step)
        return None if kept is None else Past(kept.state, dict(zip(self._nodes, kept.exact, strict=True)))

    def joint(self, others: tuple[NodeId, ...], state: State | None = None) -> Array:
        """The covariances that `fusion_weights` needs to fuse the sorted `others`: of `state`, or the newest."""
        index = self._joints.get(others)
        if index is None:
            if len(self._joints) == COMBINATIONS:
                self._joints.clear()
            index = self._joints[others] = joint_index(self._layout, (self._node, *others), len(self._initial.mean))
        return (state or self._head.state).P.flat.take(index)

    def moments(self, step: int) -> PriorMoments:
        """Mean and covariance of the state at `step`, before any measurement."""
        return self._models.at(step)[1] if step else self._initial

    @property
    def state(self) -> State:
        """The newest state: the same object while nothing has changed."""
        return self._head.state

    def _is_worth_it(self, step: int, ledger: Ledger) -> bool:
        """Whether any neighbour can be followed up to `step`: if none can, there is nothing to fuse."""
        reached = self._head.step
        for node, known in zip(self._nodes, self._head.exact, strict=True):
            history = ledger.of(node)
            if history is None or node == self._node or not (known or history.born > reached):
                continue
            if history.first_unknown(reached + 1, step) is None:
                return True
        return False

    def _following(self, head: Tracked, ledger: Ledger) -> Tracked:
        """The next step after `head`, with the used sets that are known and none where they are not."""
        step = head.step + 1
        histories = [ledger.of(node) for node in self._nodes]
        used = tuple([None if h is None else h.at(step) for h in histories])
        begins = [row for row, h in enumerate(histories) if h is not None and h.born == step]
        state, exact = head.state, head.exact
        if begins:
            state = forget(
                self._layout, state, [self._nodes[row] for row in begins], self.moments(head.step).covariance
            )
        if begins or None in used:
            exact = tuple([(known or row in begins) and used[row] is not None for row, known in enumerate(exact)])
        return Tracked(step, advance(self._layout, state, self._models.at(step)[0], self._mask(used)), exact)

    def _mask(self, used: tuple[UsedSet | None, ...]) -> Used:
        mask = self._masks.get(used)
        if mask is None:
            if len(self._masks) == COMBINATIONS:
                self._masks.clear()
            mask = self._layout.used({node: of or () for node, of in zip(self._nodes, used, strict=True)})
            self._masks[used] = mask
        return mask

    def _keep(self, following: Tracked) -> None:
        if following.exact != self._head.exact:
            for row, (before, after) in enumerate(zip(self._head.exact, following.exact, strict=True)):
                if before and not after:
                    self._aside[row] = self._newest_for_good()
                elif after:
                    self._aside.pop(row, None)
        self._head = self._recent[following.step] = following
        self._recent.pop(following.step - self._window, None)

    def _newest_for_good(self) -> Tracked:
        """The newest state that nothing which the nodes used up to the head, and may still revise, has a part in."""
        if not self._revisable:
            return self._head
        floor = self._head.step - self._revisable
        states = list(self._recent.values())
        return next((kept for kept in reversed(states) if kept.step <= floor), states[0])

    def _go_back(self, row: int, changed: int, ledger: Ledger) -> None:
        """Go back before `changed`, to the newest state from which this row can be followed up to the head."""
        history = ledger.of(self._nodes[row])
        assert history is not None  # something has changed in it
        kept = [t for t in self._recent.values() if t.exact[row] or history.born > t.step]
        if row in self._aside:
            kept.insert(0, self._aside[row])
        base = next((t for t in reversed(kept) if t.step < changed), None)
        if base is None or history.first_unknown(base.step + 1, self._head.step) is not None:
            self._distrust(row, changed, base)
            return
        self._recent = {step: kept for step, kept in self._recent.items() if step < base.step}
        self._recent[base.step] = self._head = base
        # What was put aside after that step has this row's old used sets in it; it is put aside anew on the way.
        self._aside = {r: kept for r, kept in self._aside.items() if kept.step <= base.step}

    def _distrust(self, row: int, changed: int, base: Tracked | None) -> None:
        """The states from `changed` on are not right for this row, whatever they seemed; that of `base` still is."""
        if base is None:
            self._aside.pop(row, None)
        else:
            self._aside[row] = base
        for step, kept in self._recent.items():
            if step >= changed and kept.exact[row]:
                exact = tuple([known and r != row for r, known in enumerate(kept.exact)])
                self._recent[step] = kept._replace(exact=exact)
        self._head = self._recent[self._head.step]
