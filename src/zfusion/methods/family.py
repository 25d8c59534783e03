"""What there is to know of a method before a node runs it: its stages, its options, and what is computed off-line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from zfusion.methods.design_files import Content
from zfusion.methods.protocol import Method, Setting
from zfusion.model.checks import ModelError
from zfusion.model.network import Network
from zfusion.model.system import System
from zfusion.model.types import Array
from zfusion.stages import Stage


@dataclass(frozen=True)
class NoOptions:
    """Of a method that has none."""


class Modes(NamedTuple):
    """The graphs between which the topology switches, and with which probability from one to the other."""

    networks: Sequence[Network]
    """One for each mode; the network itself where it does not switch."""
    transition: Array
    """Π, rows add up to 1, (modes, modes)."""


class Forecast(NamedTuple):
    """What is known of a method's errors before it runs; what nothing is known of is left out, or None.

    Names are words joined by "_". Mean squared errors are stationary.
    """

    network: Mapping[str, float | str | None]
    """Of the network as a whole."""
    nodes: Mapping[str, Sequence[float]]
    """By what it is a number for every node, in the order of their ids."""
    remarks: Sequence[str] = ()
    """What a reader of the numbers must know, in sentences."""
    given: str = "with every message there"
    """What they take for granted of the links."""


class Design(Protocol):
    """What a method computed off-line, for all nodes."""

    @property
    def forecast(self) -> Forecast:
        """What it promises, what it really costs, and what both are to be set beside."""

    def save(self, path: Path) -> None:
        """Write it as an .npz archive; InputError where that cannot be done."""

    def packed(self) -> bytes:
        """What such an archive holds."""


class Designer(Protocol):
    """How a method is designed off-line."""

    def make(self, options: Any, system: System, network: Network, modes: Modes) -> Design:
        """Design it: InputError where that cannot be done, with the numbers."""

    def unpack(self, content: Content, options: Any, system: System, network: Network, modes: Modes) -> Design:
        """What `Design.packed` has packed; InputError unless it is a design for just this."""


def _as_it_is(graph: Network) -> Network:
    return graph


def _none(_: object) -> int:
    return 0


def _no_warnings(options: object, system: System, network: Network) -> Sequence[str]:  # noqa: ARG001
    return ()


@dataclass(frozen=True)
class Family:
    """A method of estimation, whatever its options are."""

    name: str
    make: Callable[[Setting], Method]
    """The estimator of one node."""
    stages: Callable[[Any], tuple[Stage, ...]]
    """The exchanges of a step, given the options; the first carries the measurement `y`."""
    options: Callable[..., Any] = NoOptions
    """A frozen dataclass; its constructor refuses what cannot be with a ModelError."""
    network: Callable[[Network], Network] = _as_it_is
    """The graph whose neighbourhoods the method uses, given the scenario's."""
    revises: bool = False
    """Whether it is `Revising`: it can take in what comes late."""
    lateness: Callable[[Any], int] = _none
    """By how many steps messages may be late that the method wants: it takes a window of as many."""
    designer: Designer | None = None
    forecast: Callable[[Any, System, Network], Forecast] | None = None
    """What is known before it runs, where it is not designed off-line; InputError where nothing is."""
    check: Callable[[Any, System, Network], None] | None = None
    """Refuses, with an InputError or ModelError, a system or a network that the method cannot stand."""
    note: str = ""
    """What a user of the method must know of every run: told in its summary."""
    warnings: Callable[[Any, System, Network], Sequence[str]] = _no_warnings
    """What a user must know of just this system, with these options: likewise."""

    def choose(self, options: Mapping[str, object]) -> Chosen:
        """The method with these options, as a scenario gives them; ModelError for what cannot be."""
        known = [one.name for one in fields(self.options)] if isinstance(self.options, type) else []
        for name, value in options.items():
            if name not in known:
                said = f"expected an option of {self.name}: {', '.join(known)}" if known else "it has no options"
                raise ModelError(name, value, said)
        return Chosen(self, self.options(**options))


@dataclass(frozen=True)
class Chosen:
    """A method and its options: what a scenario has chosen."""

    family: Family
    options: Any
    stages: tuple[Stage, ...] = field(init=False)
    """The exchanges of a step."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "stages", self.family.stages(self.options))

    def __call__(self, setting: Setting) -> Method:
        """The estimator of one node."""
        return self.family.make(replace(setting, options=self.options))

    @property
    def name(self) -> str:
        """As scenarios call it."""
        return self.family.name

    @property
    def revises(self) -> bool:
        """Whether it can take in what comes late."""
        return self.family.revises

    def network(self, graph: Network) -> Network:
        """The graph whose neighbourhoods the method uses, given the scenario's."""
        return self.family.network(graph)
