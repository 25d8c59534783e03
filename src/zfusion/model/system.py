"""The observed system: a state that moves at random, and sensors that see it at random.

x_{k+1} = F_k x_k + w_k,       k >= 0,   x_k in R^nx
y^i_k   = H^i_k x_k + v^i_k,   k >= 1,   y^i_k in R^{ny_i}
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from zfusion.model.checks import ModelError, covariance_matrix, finite_array
from zfusion.model.matrices import RandomMatrix, Schedule
from zfusion.model.noise_model import NoiseModel
from zfusion.model.types import Array, NodeId, sorted_ids


@dataclass(frozen=True, eq=False)
class Sensor:
    """What sensor `id` measures: H^i_k, (ny, nx), from step 1 on."""

    id: NodeId
    ny: int
    H: Schedule[RandomMatrix]


@dataclass(frozen=True, eq=False)
class System:
    """State, sensors (sorted by id) and noises; ModelError unless they fit one another.

    F_k, (nx, nx), counts from step 0, H^i_k from step 1, noises from step 0.
    """

    nx: int
    initial_mean: Array
    initial_covariance: Array
    F: Schedule[RandomMatrix]
    sensors: tuple[Sensor, ...]
    noise: NoiseModel

    def __post_init__(self) -> None:
        nx = self.nx
        object.__setattr__(self, "initial_mean", finite_array("initial_mean", self.initial_mean, (nx,)))
        covariance = covariance_matrix("initial_covariance", self.initial_covariance, nx)
        object.__setattr__(self, "initial_covariance", covariance)
        _check_matrices("F", self.F, 0, (nx, nx))
        if self.noise.nx != nx:
            raise ModelError("noise", self.noise.nx, f"expected process noise of size nx = {nx}")
        object.__setattr__(self, "sensors", tuple(self.sensors))
        self._check_sensors()

    @cached_property
    def by_id(self) -> dict[NodeId, Sensor]:
        """The sensors, sorted by id."""
        return {sensor.id: sensor for sensor in self.sensors}

    @property
    def ids(self) -> tuple[NodeId, ...]:
        """All sensors' ids, sorted."""
        return tuple(self.by_id)

    def sizes(self, i: NodeId) -> dict[str, int]:
        """Lengths of what node i tells: nx, ny, and nxx of a triangle of an (nx, nx) matrix. KeyError as `chosen`."""
        return {"nx": self.nx, "nxx": self.nx * (self.nx + 1) // 2, "ny": self.by_id[i].ny}

    def chosen(self, ids: Iterable[NodeId]) -> tuple[Sensor, ...]:
        """The sensors of these ids, in this order; KeyError for an unknown one."""
        return tuple(self.by_id[i] for i in ids)

    def _check_sensors(self) -> None:
        ids = [sensor.id for sensor in self.sensors]
        if len({type(i) for i in ids}) != 1 or type(ids[0]) not in (int, str):
            raise ModelError("sensors", ids, "expected at least one sensor, and ids that are all integers or all names")
        if len(set(ids)) < len(ids) or ids != sorted_ids(ids):
            raise ModelError("sensors", ids, "expected ids that differ, in sorted order")
        for n, sensor in enumerate(self.sensors):
            _check_matrices(f"sensors[{n}].H", sensor.H, 1, (sensor.ny, self.nx))
            size = self.noise.sizes.get(sensor.id)
            if size != sensor.ny:
                raise ModelError(f"sensors[{n}]", size, f"expected measurement noise of size ny = {sensor.ny}")
        strangers = set(self.noise.sizes) - set(ids)
        if strangers:
            raise ModelError("noise", list(strangers), f"expected noises of the sensors only: {ids}")


def _check_matrices(field: str, schedule: Schedule[RandomMatrix], first: int, shape: tuple[int, int]) -> None:
    if schedule.first != first:
        raise ModelError(field, schedule.first, f"expected a schedule that begins at step {first}")
    for n, matrix in enumerate(schedule.items):
        if matrix.shape != shape:
            raise ModelError(field if len(schedule.items) == 1 else f"{field}[{n}]", matrix.shape, f"expected {shape}")
