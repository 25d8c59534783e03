"""The pieces of a scenario that say what becomes of messages on their way.

Times are seconds. What a piece means for one message or at one step is the business of `zfusion.links`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from math import isclose
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self

from pydantic import BeforeValidator, Discriminator, Field, PlainSerializer, Tag, model_validator

from zfusion.errors import Problem
from zfusion.model.network import Edge, Network
from zfusion.model.schema.base import Count, Flag, Id, Name, Natural, Number, Positive, Spec
from zfusion.model.schema.network import AnyGraph
from zfusion.model.schema.problems import Faults, below
from zfusion.model.types import NodeId

PROBABILITY_SUM = 1e-9
"""How far from 1 probabilities may add up, for decimals typed by hand."""

DEFAULT_QUEUE = 64
"""Messages that may wait for a link of limited bandwidth, unless it says otherwise."""

NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Seconds = NotNegative
Probability = Annotated[float, Field(strict=True, ge=0, le=1)]


def _listed(value: object) -> object:
    return value if isinstance(value, list | tuple) else (value,)


def _unlisted(values: tuple[Any, ...] | None) -> Any:
    return values[0] if values is not None and len(values) == 1 else values and list(values)


Ids = Annotated[Annotated[tuple[Id, ...], Field(min_length=1)], BeforeValidator(_listed), PlainSerializer(_unlisted)]
"""An id, or a list of ids."""

Stages = Annotated[
    Annotated[tuple[Name, ...], Field(min_length=1)], BeforeValidator(_listed), PlainSerializer(_unlisted)
]
"""The name of a stage, or a list of names."""


class Nested(Spec):
    """A piece whose own pieces may name files."""

    def with_paths(self, changed: Callable[[str], str]) -> Self:
        """See `Spec`: every path in it, however deep."""
        return self.model_copy(
            update={name: _with_paths(getattr(self, name), changed) for name in self.model_fields_set}
        )


def _with_paths(value: Any, changed: Callable[[str], str]) -> Any:
    if isinstance(value, Spec):
        return value.with_paths(changed)
    return tuple(_with_paths(item, changed) for item in value) if isinstance(value, tuple) else value


class DelaySpec(Spec):
    """A law of delays, in seconds; `shift` is added to what is drawn."""

    TAG = "distribution"

    shift: Seconds = 0.0


class UniformDelay(DelaySpec):
    """Between `low` and `high`."""

    distribution: Literal["uniform"] = "uniform"
    low: Seconds
    high: Seconds

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.low > self.high:
            raise Faults([Problem("high", self.high, f"expected a number >= low, {self.low:g}")])
        return self


class NormalDelay(DelaySpec):
    """Gaussian, cut off at 0: max(0, mean + sd * z)."""

    distribution: Literal["normal"] = "normal"
    mean: Number
    sd: Seconds


class LognormalDelay(DelaySpec):
    """median * exp(sigma * z), z standard normal."""

    distribution: Literal["lognormal"] = "lognormal"
    median: Positive
    sigma: NotNegative


class GammaDelay(DelaySpec):
    """Gamma, of mean shape * scale and variance shape * scale^2."""

    distribution: Literal["gamma"] = "gamma"
    shape: Positive
    scale: Positive


class ExponentialDelay(DelaySpec):
    """Exponential."""

    distribution: Literal["exponential"] = "exponential"
    mean: Positive


class ParetoDelay(DelaySpec):
    """P(delay > s) = (minimum / s)^shape for s >= minimum: heavy-tailed; of infinite mean if shape <= 1."""

    distribution: Literal["pareto"] = "pareto"
    minimum: Positive
    shape: Positive


class TraceDelay(Spec):
    """Delays that were measured: a file of one value a line, or of columns (CSV) of which one is named.

    Drawn at random, or `as_recorded`: step k takes value k, and round again when all have been taken.
    """

    PATHS = ("trace",)

    trace: str
    column: str | None = None
    order: Literal["random", "as_recorded"] = "random"
    shift: Seconds = 0.0


Distributed = Annotated[
    UniformDelay | NormalDelay | LognormalDelay | GammaDelay | ExponentialDelay | ParetoDelay,
    Field(discriminator="distribution"),
]


def _form_of_delay(value: object) -> str | None:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "<number>"
    for form in ("distribution", "mixture", "trace"):
        if (isinstance(value, Mapping) and form in value) or hasattr(value, form):
            return f"<{form}>"
    return None


PureDelay = Annotated[
    Annotated[Seconds, Tag("<number>")]
    | Annotated[Distributed, Tag("<distribution>")]
    | Annotated[TraceDelay, Tag("<trace>")],
    Discriminator(
        _form_of_delay,
        custom_error_type="no_form",
        custom_error_message="expected seconds, or a table with one of distribution and trace",
    ),
]
"""A delay that is no mixture."""


class ComponentSpec(Nested):
    """One of the laws of a mixture, and how often it is the one, in proportion to the other weights."""

    weight: Positive
    delay: PureDelay


class MixtureDelay(Nested):
    """Each time one of several laws, drawn by their weights."""

    mixture: Annotated[tuple[ComponentSpec, ...], Field(min_length=1)]
    shift: Seconds = 0.0


AnyDelay = Annotated[
    Annotated[Seconds, Tag("<number>")]
    | Annotated[Distributed, Tag("<distribution>")]
    | Annotated[TraceDelay, Tag("<trace>")]
    | Annotated[MixtureDelay, Tag("<mixture>")],
    Discriminator(
        _form_of_delay,
        custom_error_type="no_form",
        custom_error_message="expected seconds, or a table with one of distribution, mixture and trace",
    ),
]
"""A delay: a constant number of seconds, or drawn anew for every message."""


class GilbertElliottSpec(Spec):
    """A link is in a good or a bad state, and changes it from step to step with these probabilities.

    In the long run it is bad to_bad / (to_bad + to_good) of the time, 1 / to_good steps at a stretch.
    """

    to_bad: Probability
    to_good: Probability
    loss_good: Probability = 0.0
    loss_bad: Probability = 1.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.to_bad + self.to_good:
            raise ValueError("expected to_bad or to_good > 0, as otherwise the link has no state to be in")
        return self


class BurstLoss(Spec):
    """Losses in bursts."""

    gilbert_elliott: GilbertElliottSpec


def _form_of_loss(value: object) -> str:
    return "<bursts>" if isinstance(value, Mapping | BurstLoss) else "<probability>"


AnyLoss = Annotated[
    Annotated[Probability, Tag("<probability>")] | Annotated[BurstLoss, Tag("<bursts>")], Discriminator(_form_of_loss)
]
"""The probability with which each message is lost, independently of all others, or a model of bursts."""


class BandwidthSpec(Spec):
    """A message of n bytes takes 8 n / rate_bps seconds; one that finds `queue` others waiting is dropped."""

    rate_bps: Positive
    queue: Natural = DEFAULT_QUEUE


class LinkRules(Nested):
    """What becomes of the messages on a link."""

    RULES: ClassVar[tuple[str, ...]] = ("delay", "loss", "duplicate", "reorder", "bandwidth")

    delay: AnyDelay = 0.0
    loss: AnyLoss = 0.0
    duplicate: Probability = 0.0
    """The probability that a message that is not lost comes twice, the second time with a delay of its own."""
    reorder: Flag = False
    """Whether a message may overtake one that was sent before it on the same link."""
    bandwidth: BandwidthSpec | None = None


class EdgeLinks(LinkRules):
    """An exception: what is given here holds for these edges and stages in the place of what held before."""

    senders: Ids | None = Field(default=None, alias="from")
    """None: any."""
    receivers: Ids | None = Field(default=None, alias="to")
    stages: Stages | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.rules:
            raise ValueError(f"expected one or more of {', '.join(self.RULES)}")
        return self

    @property
    def rules(self) -> dict[str, Any]:
        """What is given."""
        return {name: getattr(self, name) for name in self.RULES if name in self.model_fields_set}

    def concerns(self, edge: Edge) -> bool:
        """Whether it is about this edge."""
        return between(edge, self)


class MessageLinks(Spec):
    """Single messages, by name: how long they take, or that they are lost, whatever is drawn for them."""

    sender: Id = Field(alias="from")
    receiver: Id = Field(alias="to")
    stage: Name
    steps: Annotated[tuple[Count, ...], Field(min_length=1)]
    delay: Seconds | None = None
    lost: Flag = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.delay is not None) == self.lost:
            raise ValueError("expected either delay or lost = true")
        return self


class Ends(Protocol):
    """What is about links between some nodes; None: any."""

    @property
    def senders(self) -> Collection[NodeId] | None:
        """Where the links begin."""

    @property
    def receivers(self) -> Collection[NodeId] | None:
        """Where they end."""


def between(edge: Edge, ends: Ends) -> bool:
    """Whether the edge is one of those."""
    senders, receivers = ends.senders, ends.receivers
    return (senders is None or edge[0] in senders) and (receivers is None or edge[1] in receivers)


class SwitchSpec(Spec):
    """From this step on, this mode."""

    step: Count
    mode: Natural


class MarkovSpec(Spec):
    """At step 1 mode i with probability initial[i]; then, from step to step, from i to j with transition[i][j]."""

    transition: tuple[tuple[Probability, ...], ...]
    initial: tuple[Probability, ...]


class TopologySpec(Spec):
    """Graphs of which one at a time says which links carry anything."""

    modes: Annotated[tuple[AnyGraph, ...], Field(min_length=1)]
    schedule: Annotated[tuple[SwitchSpec, ...], Field(min_length=1)] | None = None
    markov: MarkovSpec | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.schedule is None) == (self.markov is None):
            raise ValueError("expected either schedule or markov")
        problems = [*_schedule_problems(self.schedule or (), len(self.modes)), *_chain_problems(self)]
        if problems:
            raise Faults(problems)
        return self


def _schedule_problems(schedule: tuple[SwitchSpec, ...], modes: int) -> Iterator[Problem]:
    before = 0
    for n, switch in enumerate(schedule):
        if switch.mode >= modes:
            yield Problem(f"schedule[{n}].mode", switch.mode, f"expected the number of a mode, 0 to {modes - 1}")
        if n == 0 and switch.step != 1:
            yield Problem("schedule[0].step", switch.step, "expected 1: there is a mode from the first step on")
        elif switch.step <= before:
            yield Problem(f"schedule[{n}].step", switch.step, f"expected a step after {before}")
        before = switch.step


def _chain_problems(topology: TopologySpec) -> Iterator[Problem]:
    if topology.markov is None:
        return
    modes, chain = len(topology.modes), topology.markov
    if len(chain.transition) != modes:
        yield Problem(
            "markov.transition", [list(row) for row in chain.transition], f"expected {modes} rows, one a mode"
        )
    rows = {f"markov.transition[{n}]": row for n, row in enumerate(chain.transition)} | {
        "markov.initial": chain.initial
    }
    for place, row in rows.items():
        if len(row) != modes:
            yield Problem(place, list(row), f"expected {modes} probabilities, one a mode")
        elif not isclose(sum(row), 1.0, abs_tol=PROBABILITY_SUM):
            yield Problem(place, list(row), "expected probabilities that add up to 1")


class RecordedLinks(Spec):
    """Latencies and losses as they were measured in a run that was recorded."""

    PATHS = ("recording",)

    recording: str


class LinksSpec(LinkRules):
    """What becomes of messages on their way: for all edges, and the exceptions, of which later ones win."""

    edges: tuple[EdgeLinks, ...] = ()
    messages: tuple[MessageLinks, ...] = ()
    topology: TopologySpec | None = None
    recorded: RecordedLinks | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [name for name in (*self.RULES, "edges") if name in self.model_fields_set]
        if self.recorded is not None and given:
            raise ValueError(f"expected either recorded or {', '.join(given)}, not both")
        return self

    @property
    def facts(self) -> dict[str, Any]:
        """All that the nodes of a run must agree in, however it is written."""
        exceptions = [edge.model_dump(exclude_unset=True) for edge in self.edges]
        return self.model_dump(exclude={"edges"}, exclude_none=True) | {"edges": exceptions}


def link_problems(links: LinksSpec, ids: Collection[NodeId], network: Network | None) -> Iterator[Problem]:
    """Edges and modes that the network does not have; `network` is None where it is not known."""
    for n, exception in enumerate(links.edges):
        yield from end_problems(f"links.edges[{n}]", exception, ids, network)
    for n, message in enumerate(links.messages):
        ends = {"from": message.sender, "to": message.receiver}
        unknown = [(name, i) for name, i in ends.items() if i not in ids]
        yield from (Problem(f"links.messages[{n}].{name}", i, "expected the id of a sensor") for name, i in unknown)
        if not unknown and message.sender == message.receiver:
            yield Problem(f"links.messages[{n}]", ends, "expected two nodes: a node sends itself nothing")
    for n, mode in enumerate(links.topology.modes if links.topology else ()):
        place = f"links.topology.modes[{n}]"
        problems = list(mode.problems(tuple(ids)))
        yield from (below(place, problem) for problem in problems)
        if network is not None and not problems:
            yield from _sub_graph_problems(place, mode.network(tuple(ids)), network)


def _sub_graph_problems(place: str, mode: Network, network: Network) -> Iterator[Problem]:
    for i in mode.ids:
        more = [j for j in mode.neighbours(i) if j not in network.neighbours(i)]
        if more:
            yield Problem(place, [more[0], i], "expected a sub-graph of the network, which does not have the edge")
            return


def end_problems(place: str, ends: Ends, ids: Collection[NodeId], network: Network | None) -> Iterator[Problem]:
    """Ends that are no nodes, or between which there is no edge."""
    known = True
    for name, given in (("from", ends.senders), ("to", ends.receivers)):
        for i in given or ():
            if i not in ids:
                known = False
                yield Problem(f"{place}.{name}", i, "expected the id of a sensor")
    edges = ((j, i) for i in ids for j in network.neighbours(i) if j != i) if known and network is not None else None
    if edges is not None and not any(between(edge, ends) for edge in edges):
        shown = {name: list(some) for name, some in (("from", ends.senders), ("to", ends.receivers)) if some}
        yield Problem(place, shown, "expected ends of an edge of the network")
