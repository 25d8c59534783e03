"""What any design is measured by: Kalman predictors with various measurements, and what a node could know at best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zfusion.methods.gramians import predictor_covariance, predictor_gain, riccati_step
from zfusion.methods.plant import Mask
from zfusion.methods.stationary.cost import Gains
from zfusion.methods.stationary.problem import Plant, Problem
from zfusion.model.types import Array


def predictor(plant: Plant, sensors: Sequence[int]) -> tuple[Array, Array]:
    """Covariance (nx, nx) and gain (nx, p of the chosen) of the Kalman predictor with some of the sensors."""
    rows = sensor_rows(plant, sensors)
    C, R = plant.stacked_C[rows], plant.R[np.ix_(rows, rows)]
    S = predictor_covariance(plant.A, C, plant.Q, R)
    return S, predictor_gain(plant.A, C, S, R)


def sensor_rows(plant: Plant, sensors: Sequence[int]) -> list[int]:
    """Where the sensors' measurements are in the stack of all."""
    ends = np.cumsum(plant.ny)
    return [row for j in sensors for row in range(ends[j] - plant.ny[j], ends[j])]


def centralized_mse(plant: Plant) -> float:
    """tr S of the predictor with all sensors."""
    return float(predictor(plant, range(plant.n))[0].trace())


def neighbourhood_mse(plant: Plant, mask: Mask) -> Array:
    """tr S of each node's predictor with the sensors of its row of the mask, (n,)."""
    return np.array([predictor(plant, np.flatnonzero(row).tolist())[0].trace() for row in mask])


def own_sensor_mse(plant: Plant) -> Array:
    """tr S of each node's predictor with its own sensor, (n,)."""
    return neighbourhood_mse(plant, np.eye(plant.n, dtype=bool))


def information_limit(problem: Problem, plant: Plant | None = None) -> Array:
    """What no estimator of this structure, of whatever order, can beat: mean squared errors, (n,).

    Node i can know y_m(k-t), t >= 1, only along i <-H- · <-F- · (t-1 times) <-G- m. So: a predictor with all sensors
    that ever reach it, up to the time when all do, then a Riccati step for each later time with those that do by then.
    """
    plant = problem.nominal if plant is None else plant
    reach = [_reach(problem, 0)]
    while True:
        further = _reach(problem, len(reach))
        if (further == reach[-1]).all():
            break
        reach.append(further)
    return np.array([_limit(plant, [row[i] for row in reach]) for i in range(plant.n)])


def local_predictors(problem: Problem) -> Gains:
    """Each node the Kalman predictor of the measurements that it may use: where designs begin."""
    plant, n, nx = problem.nominal, problem.nominal.n, problem.nominal.nx
    F, G = np.zeros((problem.size, problem.size)), np.zeros((problem.size, len(plant.stacked_C)))
    for i in range(n):
        sensors = np.flatnonzero(problem.G[i]).tolist()
        L = predictor(plant, sensors)[1]
        rows, at = sensor_rows(plant, sensors), slice(i * nx, (i + 1) * nx)
        F[at, at] = plant.A - L @ plant.stacked_C[rows]
        G[at, rows] = L
    return Gains(F, G, np.eye(problem.size))


def _reach(problem: Problem, hops: int) -> Mask:
    """(n, n): whose measurements, hops + 1 steps old, a node can know."""
    known = problem.H.astype(int)
    for _ in range(hops):
        known = np.minimum(known @ problem.F, 1)
    reached: Mask = known @ problem.G > 0
    return reached


def _limit(plant: Plant, reach: Sequence[Mask]) -> float:
    S = predictor(plant, np.flatnonzero(reach[-1]).tolist())[0]
    for known in reversed(reach[:-1]):
        rows = sensor_rows(plant, np.flatnonzero(known).tolist())
        S = riccati_step(plant.A, plant.stacked_C[rows], plant.Q, plant.R[np.ix_(rows, rows)], S)
    return float(S.trace())
