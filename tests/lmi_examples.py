"""The reference examples of the methods `stationary` and `l2_linf`, and what their tests share."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from zfusion.drivers.designs import design_of
from zfusion.methods import l2_linf, stationary
from zfusion.methods.l2_linf.lmi import Designed, slack_design
from zfusion.methods.protocol import Fields, Method, Outcome
from zfusion.model.matrices import Fixed, RandomMatrix, Schedule
from zfusion.model.noise import CovarianceNoise
from zfusion.model.scenario import Scenario
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array
from zfusion.used_sets import Ledger

EXAMPLES = Path(__file__).parents[1] / "examples"

IDS = (1, 2, 3, 4)


def example(name: str, **changes: Any) -> Scenario:
    """The scenario of that name among the examples, with some of its tables replaced."""
    return Scenario.model_validate(tomllib.loads((EXAMPLES / f"{name}.toml").read_text()) | changes)


GRAPHS: Mapping[str, Array] = {
    "PATH": np.eye(4) + np.eye(4, k=1) + np.eye(4, k=-1),
    "RING": np.array([[1.0, 0, 0, 1], [1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]]),
    "FULL": np.ones((4, 4)),
    "NONE": np.eye(4),
}

PAIRS = np.array([[1.0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]])


def plant(turn: float = 0.0, gain: float = 0.0) -> stationary.Plant:
    """Section 5 of the specification of `stationary`; A_22 = 0.9 + turn and C_1 = [1 + gain, 0, 0]."""
    A = np.array([[0.9, 0.25, 0], [-0.25, 0.9 + turn, 0.1], [0, 0, 0.8]])
    C = [[[1 + gain, 0, 0]], [[0, 1, 0]], [[0, 0, 1]], [[1, 0, 1]]]
    V = tuple(np.array([[v]]) for v in (0.5, 1, 0.5, 2))
    C_arrays = tuple(np.array(c, dtype=float) for c in C)
    return stationary.Plant(A, np.eye(3), C_arrays, (np.eye(1),) * 4, np.diag([0.1, 0.1, 0.2]), V)


def polytope(points: int = 2) -> list[stationary.Plant]:
    """The uncertain plant at `points` x `points` values of its two parameters; with two: the vertices."""
    turns, gains = np.linspace(-0.08, 0.08, points), np.linspace(-0.2, 0.2, points)
    return [plant(turn, gain) for turn in turns for gain in gains]


@cache
def designed(graph: str, choice: stationary.Choice | None = None) -> stationary.Design:
    """A design of the nominal example, on any of the graphs, as the scenario's options describe it; made once."""
    asked = stationary.Choice() if choice is None else choice
    options: dict[str, Any] = {"gramian": asked.gramian.value}
    options |= {name: getattr(asked, name) for name in ("plain", "worst_node", "observer")}
    method = {"name": "stationary", "options": options}
    scenario = example("stationary", network={"matrix": GRAPHS[graph].tolist()}, method=method)
    design = design_of(scenario)
    assert isinstance(design, stationary.Design)
    return design


def switching(
    arrival: Iterable[float],
    modes: Sequence[Array] = (GRAPHS["RING"], PAIRS),
    transition: Any = ((0.7, 0.3), (0.4, 0.6)),
) -> l2_linf.Problem:
    """Section 5 of the specification of `l2_linf`."""
    B = np.zeros((2, 5))
    B[1, 0] = 0.3
    D = 0.0 * np.eye(4, 5)
    D[range(4), range(1, 5)] = (0.3, 0.6, 0.8, 0.6)
    C = tuple(np.array([c], dtype=float) for c in ([1, 0], [0, 1], [1, 0.5], [0.5, -1]))
    A, M = np.array([[0.9, 0.4], [-0.2, 0.8]]), np.array([[1.0, 0]])
    return l2_linf.Problem(
        A, B, C, tuple(D[:, None]), M, np.array(list(arrival)), np.array(modes), np.array(transition)
    )


SURE = (1.0, 1.0, 1.0, 1.0)
MISSING = (0.8, 0.7, 0.9, 0.6)


def switching_scenario(arrival: tuple[float, ...], **options: Any) -> Scenario:
    """The switching example, with other probabilities that the sensors measure anything, and options of the method."""
    method = {"name": "l2_linf", "options": {"output": [[1.0, 0.0]], **options}}
    return example("l2_linf", method=method, sensors=switching_sensors(arrival))


def switching_sensors(arrival: tuple[float, ...]) -> list[dict[str, Any]]:
    """The sensors of the switching example with other probabilities that they measure anything; 1: nothing random."""
    sensors = tomllib.loads((EXAMPLES / "l2_linf.toml").read_text())["sensors"]
    for sensor, chance in zip(sensors, arrival, strict=True):
        sensor["H"]["variables"]["theta"]["p"] = chance
        if chance == 1:
            sensor["H"] = sensor["H"]["terms"][0]["matrix"]
    return list(sensors)


@cache
def filters(arrival: tuple[float, ...], form: str) -> l2_linf.Design:
    """A design of the switching example, as the scenario's options describe it; made once."""
    design = design_of(switching_scenario(arrival, form=form))
    assert isinstance(design, l2_linf.Design)
    return design


@cache
def slack_filters(arrival: tuple[float, ...], tau: float) -> Designed:
    """A design with a full Lyapunov function, made once."""
    return slack_design(switching(arrival), tau)


def system(
    F: Array,
    Q: Array,
    H: Sequence[Array | RandomMatrix],
    R: Sequence[Array],
    *,
    mean: Sequence[float] | None = None,
    P0: Array | None = None,
    correlated: Mapping[Any, Schedule[Array]] | None = None,
    **noise: Any,
) -> System:
    """A constant system with sensors 1, 2, ...; `correlated` and `noise`: what more `CovarianceNoise` takes."""
    matrices = [h if isinstance(h, RandomMatrix) else Fixed(np.atleast_2d(h)) for h in H]
    nx, ids = len(F), range(1, len(matrices) + 1)
    variances = {(i, i): Schedule.constant(np.atleast_2d(r)) for i, r in zip(ids, R, strict=True)}
    return System(
        nx=nx,
        initial_mean=np.zeros(nx) if mean is None else np.array(mean, dtype=float),
        initial_covariance=np.eye(nx) if P0 is None else P0,
        F=Schedule.constant(Fixed(F)),
        sensors=tuple(Sensor(i, h.shape[0], Schedule.constant(h, 1)) for i, h in zip(ids, matrices, strict=True)),
        noise=CovarianceNoise(Schedule.constant(Q), variances | dict(correlated or {}), **noise),
    )


def stationary_system(**more: Any) -> System:
    """The example of `stationary` as a system."""
    p = plant()
    return system(p.A, p.Q, p.C, p.V, **more)


Arrives = Callable[[int, int, int], bool]
"""Whether the message of `sender` to `receiver` at `step` arrives."""


def run(
    methods: Mapping[int, Method],
    readings: Sequence[Mapping[int, Array | None]],
    arrives: Arrives = lambda i, j, k: True,
) -> list[dict[int, Outcome]]:
    """All nodes step by step from step 1 on, each hearing the neighbours of its method's messages that arrive."""
    outcomes = []
    for step, ys in enumerate(readings, 1):
        said: dict[int, Fields] = {i: method.begin(step, ys[i]) for i, method in methods.items()}
        told = {}
        for i, method in methods.items():
            arrived = {j: said[j] for j in methods if j == i or arrives(j, i, step)}
            outcome = method.advance(0, step, arrived, Ledger(i, 1))
            assert isinstance(outcome, Outcome)
            told[i] = outcome
        outcomes.append(told)
    return outcomes
