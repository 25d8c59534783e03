"""What a method is to the node that drives it.

A method declares its stages, the exchanges within a step, as data. At a step the node calls `begin` with its own
measurement, publishes what it gets, waits for the neighbours' messages of that stage, calls `advance` with what
arrived, publishes the next stage, and so on, until `advance` of the last stage returns the outcome.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId
from zfusion.stages import Stage
from zfusion.used_sets import Ledger, UsedSet

Fields = Mapping[str, object]
"""The stage's part of a message, by name: what `Stage.fields` declares."""


@dataclass(frozen=True)
class Setting:
    """All that a method may know when it starts at a node."""

    node: NodeId
    system: System
    network: Network
    """Whose neighbourhoods the method uses: the scenario's, after `Method.network`."""
    born: int = 1
    """First step of this life; a node that was restarted begins later, from the prior, having used nothing before."""
    window: int = 0
    """Steps that `Revising.revise` and `Revising.correct` may go back."""
    options: Any = None
    """What the scenario says of the method, as `Family.options` holds it."""
    design: Any = None
    """What was computed off-line for all nodes, where the method has that: `Designing`."""
    mode: Callable[[int], int] = lambda _: 0
    """The mode of the topology at a step, the same at all nodes; 0 where it does not switch."""
    punctuality: Callable[[int], Mapping[NodeId, Sequence[float]]] | None = None
    """L -> of each neighbour the probabilities that what is received of it at a step is 0, ..., L steps old, as far as
    the world knows its links; None where it does not."""


class Outcome(NamedTuple):
    """A step's estimate."""

    x: Array
    """x̂_{k/k}, (nx,)."""
    P: Array
    """Predicted covariance of its error, (nx, nx)."""
    used: UsedSet
    """Whose messages of the last stage went into it."""
    excluded: UsedSet = ()
    """Whose messages were there and had to be left out, mostly as their history is not known (a *fallback*)."""
    ask: Mapping[NodeId, int] = MappingProxyType({})
    """Whose history is wanted, and from which step on."""
    incidents: tuple[str, ...] = ()
    """What was out of the ordinary with the method itself, one word each time; counted, and told at the end."""


class Method(Protocol):
    """One estimator at one node. Deterministic: the same calls give the same results, bit for bit."""

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The exchanges of a step."""

    def begin(self, step: int, y: Array | None) -> Fields:
        """Fields of the first stage, from the own measurement (ny,), None where the sensor had none."""

    def skip(self, step: int) -> None:
        """A step that the node slept through: nothing was used in it, and no estimate of it is told."""

    def advance(self, stage: int, step: int, arrived: Mapping[NodeId, Fields], ledger: Ledger) -> Fields | Outcome:
        """Take in what arrived of a stage, the own message included; the next stage's fields, or the outcome."""


@runtime_checkable
class Wary(Protocol):
    """A method that does not take in every message that is well-formed: not what no honest neighbour can say."""

    def refuses(self, stage: int, fields: Fields) -> str | None:
        """Why a neighbour's message is not taken in, in one word, under which it is counted; None where it is.

        A function of its arguments only: so what was refused is so again in a replay, or is not there.
        """


@runtime_checkable
class Selective(Protocol):
    """A method that knows at which steps a neighbour is not to be heard, so that nobody waits for it then."""

    def unheard(self, step: int) -> Collection[NodeId]:
        """The neighbours of whom nothing can come at a step."""


class Revising(Method, Protocol):
    """A method that can go back: afterwards all is as if what was late had been in time."""

    def revise(self, late: Mapping[int, Mapping[NodeId, Fields]]) -> dict[int, UsedSet]:
        """Take in messages of the first stage of past steps, up to `Setting.window` before the one that is going on.

        Called before `advance` of the first stage. Returns by step, ascending, whose were taken in: not those whose
        had been used before, and not those that hold nothing.
        """

    def correct(self, step: int, heard: Mapping[NodeId, Fields]) -> Outcome:
        """The estimate of a past step with all that is known now; called after `advance` of the last stage.

        `heard` are the neighbours' messages of the last stage, of that step, where that is not the first: those that
        were computed with just the used sets that the ledger has now.
        """
