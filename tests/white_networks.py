"""Networks of nodes on systems with white noises, driven without anything around them, and the textbook beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zfusion.methods import METHODS
from zfusion.methods.protocol import Fields, Method, Outcome, Setting
from zfusion.model.checks import semidefinite_factor
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.network import Network
from zfusion.model.noise import CovarianceNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId
from zfusion.used_sets import Ledger

Lost = Callable[[int, int, NodeId, NodeId], bool]
"""Whether the message of a stage and step from a sender to a receiver is lost."""


def white_system(
    F: Any, Q: Any, H: Sequence[Any], R: Sequence[Any], mean: Any = None, P0: Any = None, first: int = 0
) -> System:
    """Sensors `first`, `first` + 1, ...; an R may be a list of matrices, one for each step from 1 on."""
    F, Q = np.atleast_2d(np.array(F, float)), np.atleast_2d(np.array(Q, float))
    matrices = [Fixed(np.atleast_2d(np.array(h, float))) for h in H]
    schedules = [
        Schedule(tuple(np.atleast_2d(np.array(r, float)) for r in [one[0], *one]))
        if isinstance(one, list)
        else Schedule.constant(np.atleast_2d(np.array(one, float)))
        for one in R
    ]
    ids = range(first, first + len(H))
    return System(
        nx=len(F),
        initial_mean=np.zeros(len(F)) if mean is None else np.array(mean, float),
        initial_covariance=np.eye(len(F)) if P0 is None else np.array(P0, float),
        F=Schedule.constant(Fixed(F)),
        sensors=tuple(Sensor(i, h.shape[0], Schedule.constant(h, 1)) for i, h in zip(ids, matrices, strict=True)),
        noise=CovarianceNoise(Schedule.constant(Q), {(i, i): s for i, s in zip(ids, schedules, strict=True)}),
    )


def random_system(seed: int, nx: int = 3, count: int = 4) -> System:
    """A stable process, and sensors of one or two measurements each."""
    rng = np.random.default_rng(seed)
    F = rng.standard_normal((nx, nx))
    F *= 0.95 / np.abs(np.linalg.eigvals(F)).max()
    root, H = rng.standard_normal((nx, nx)), [rng.standard_normal((1 + n % 2, nx)) for n in range(count)]
    R = []
    for h in H:
        r = rng.standard_normal((len(h), len(h)))
        R.append(r @ r.T + 0.2 * np.eye(len(h)))
    return white_system(F, 0.1 * root @ root.T + 0.05 * np.eye(nx), H, R, rng.standard_normal(nx), np.eye(nx))


def sampled(system: System, steps: int, seed: int) -> tuple[Array, list[dict[NodeId, Array | None]]]:
    """The states of steps 1, 2, ..., (steps, nx), and all readings, of a system that is constant but for its R."""
    rng = np.random.default_rng(seed)
    F = system.F.at(0).mean
    x = rng.multivariate_normal(system.initial_mean, system.initial_covariance)
    states, readings = [], []
    kept: Any = None
    for k in range(1, steps + 1):
        noises = system.noise.covariances(k, system.ids)
        if noises is not kept:
            kept = noises
            Q, R = semidefinite_factor(noises.Q), semidefinite_factor(noises.R)
        x = F @ x + Q @ rng.standard_normal(Q.shape[1])
        states.append(x)
        v, end, ys = R @ rng.standard_normal(R.shape[1]), 0, dict[NodeId, Array | None]()
        for sensor in system.sensors:
            start, end = end, end + sensor.ny
            ys[sensor.id] = sensor.H.at(k).mean @ x + v[start:end]
        readings.append(ys)
    return np.array(states), readings


@dataclass
class Swarm:
    """All nodes of a method, in step."""

    name: str
    system: System
    graph: Network
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.method = METHODS[self.name].choose(dict(self.options))
        if self.method.family.check is not None:
            self.method.family.check(self.method.options, self.system, self.graph)
        self.network = self.method.network(self.graph)
        self.nodes: dict[NodeId, Any] = {i: self.make(i) for i in self.network.ids}
        self.step = 0

    def make(self, node: NodeId, born: int = 1) -> Method:
        """A node at the beginning of a life."""
        return self.method(Setting(node, self.system, self.network, born))

    def take(self, ys: Mapping[NodeId, Array | None], lost: Lost = lambda *_: False) -> dict[NodeId, Outcome]:
        """One step of all nodes."""
        self.step += 1
        said: dict[NodeId, Any] = {i: node.begin(self.step, ys.get(i)) for i, node in self.nodes.items()}
        for stage in range(len(self.method.stages)):
            said = {i: self.advance(i, stage, said, lost) for i in self.nodes}
        assert all(isinstance(outcome, Outcome) for outcome in said.values())
        return said

    def advance(self, i: NodeId, stage: int, said: Mapping[NodeId, Fields], lost: Lost) -> Fields | Outcome:
        """One node's stage: with what its neighbours said and was not lost."""
        arrived = {j: said[j] for j in self.network.neighbours(i) if j == i or not lost(stage, self.step, j, i)}
        result: Fields | Outcome = self.nodes[i].advance(stage, self.step, arrived, Ledger(i, 1))
        return result

    def run(
        self, readings: Iterable[Mapping[NodeId, Array | None]], lost: Lost = lambda *_: False
    ) -> list[dict[NodeId, Outcome]]:
        """Step by step."""
        return [self.take(ys, lost) for ys in readings]


def textbook(
    system: System, readings: Iterable[Mapping[NodeId, Array | None]], ids: Iterable[NodeId]
) -> list[tuple[Array, Array]]:
    """x and P of the Kalman filter with these sensors' measurements, in ten lines."""
    x, P, told, ids = system.initial_mean, system.initial_covariance, [], tuple(ids)
    for k, ys in enumerate(readings, start=1):
        F = system.F.at(k - 1).mean
        x, P = F @ x, F @ P @ F.T + system.noise.covariances(k - 1, ids).Q
        for i in ids:
            y, H, R = ys.get(i), system.by_id[i].H.at(k).mean, system.noise.covariances(k, (i,)).R
            if y is not None:
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x, P = x + K @ (y - H @ x), P - K @ H @ P
        told.append((x, P))
    return told
