"""A target for the long run: constant velocity, pushed by noise, seen by sensors with noises in common."""

from __future__ import annotations

import numpy as np

from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.noise import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId

T = 0.1
"""Seconds a step."""

Q = 0.2 * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])
"""Of a velocity pushed by white acceleration."""


def target(
    sensors: dict[NodeId, float], *, origin: float = 0.0, axes: int = 1, correlated: bool = True, P0: float = 10.0
) -> System:
    """State (position, velocity) along each axis; sensor i sees the position, more precisely the larger its number.

    `origin` is where the position begins. The measurement noises are private and, where `correlated`, have a
    common part too, of which the process noise has some as well.
    """
    axis = np.eye(axes)
    F, H = np.kron(axis, [[1.0, T], [0.0, 1.0]]), np.kron(axis, [[1.0, 0.0]])
    common = 0.3 if correlated else 0.0
    white = {"push": WhiteNoise(np.kron(axis, Q)), "gust": WhiteNoise(np.eye(1))}
    white |= {f"sensor {i}": WhiteNoise(axis) for i in sensors}

    def constant(matrix: Array) -> Schedule[Array]:
        return Schedule((matrix,))

    gust = np.kron(np.ones((axes, 1)), np.array([[0.0], [0.05 * common]]))
    return System(
        nx=2 * axes,
        initial_mean=np.kron(np.ones(axes), [origin, 1.0]),
        initial_covariance=P0 * np.eye(2 * axes),
        F=Schedule((Fixed(F),)),
        sensors=tuple(Sensor(i, axes, Schedule((Fixed(H),), first=1)) for i in sensors),
        noise=MovingAverageNoise(
            white=white,
            process=(Tap("push", 0, constant(np.eye(2 * axes))), Tap("gust", 1, constant(gust))),
            sensors={
                i: (
                    Tap(f"sensor {i}", 0, constant(axis / weight)),
                    Tap("gust", 0, constant(np.full((axes, 1), common))),
                    Tap("gust", -1, constant(np.full((axes, 1), common / 2))),
                )
                for i, weight in sensors.items()
            },
        ),
    )


def random_walk(sensors: dict[NodeId, float], *, F: float, Q: float, P0: float) -> System:
    """A scalar state that is forgotten by the factor F, with private noises; larger numbers see it more precisely."""
    one = np.eye(1)
    white = {"push": WhiteNoise(Q * one)} | {f"sensor {i}": WhiteNoise(one / w**2) for i, w in sensors.items()}
    return System(
        nx=1,
        initial_mean=np.zeros(1),
        initial_covariance=P0 * one,
        F=Schedule((Fixed(F * one),)),
        sensors=tuple(Sensor(i, 1, Schedule((Fixed(one),), first=1)) for i in sensors),
        noise=MovingAverageNoise(
            white=white,
            process=(Tap("push", 0, Schedule((one,))),),
            sensors={i: (Tap(f"sensor {i}", 0, Schedule((one,))),) for i in sensors},
        ),
    )
