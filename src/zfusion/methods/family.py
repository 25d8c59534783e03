"""What there is to know of a method before a node runs it: its stages, its options, and what is computed off-line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

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


class Design(Protocol):
    """What a method computed off-line, for all nodes."""

    def save(self, path: Path) -> None:
        """Write it as an .npz archive; InputError where that cannot be done."""


class Designer(Protocol):
    """How a method is designed off-line."""

    def make(self, options: Any, system: System, network: Network, modes: Modes) -> Design:
        """Design it: InputError where that cannot be done, with the numbers."""

    def load(self, path: Path, options: Any, system: System, network: Network, modes: Modes) -> Design:
        """Read what `Design.save` wrote; InputError unless it is a design for just this."""


def _as_it_is(graph: Network) -> Network:
    return graph


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
    designer: Designer | None = None
    check: Callable[[Any, System, Network], None] | None = None
    """Refuses, with an InputError or ModelError, a system or a network that the method cannot stand."""
    note: str = ""
    """What a user of the method must know of every run: told in its summary."""

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
