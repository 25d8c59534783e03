"""A system is accepted only whole: sizes, order, first steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from oracles.paper import paper_system
from zfusion.errors import InputError
from zfusion.model.matrices import Fixed, Schedule
from zfusion.model.noise import CovarianceNoise
from zfusion.model.system import Sensor, System


def noise(nx: int = 2, **sizes: int) -> CovarianceNoise:
    return CovarianceNoise(
        Q=Schedule.constant(np.eye(nx)), R={(i, i): Schedule.constant(np.eye(n)) for i, n in sizes.items()}
    )


def sensor(i: Any, ny: int, nx: int = 2, first: int = 1) -> Sensor:
    return Sensor(i, ny, Schedule.constant(Fixed(np.ones((ny, nx))), first))


def system(**changes: Any) -> System:
    given: dict[str, Any] = {
        "nx": 2,
        "initial_mean": [1, 2],
        "initial_covariance": np.eye(2),
        "F": Schedule.constant(Fixed(np.eye(2))),
        "sensors": (sensor("a", 1), sensor("b", 3)),
        "noise": noise(a=1, b=3),
    }
    return System(**(given | changes))


def test_sensors_are_found_by_id() -> None:
    made = system()
    assert made.ids == ("a", "b")
    assert [s.ny for s in made.chosen(("b", "a"))] == [3, 1]
    assert made.initial_mean.dtype == np.float64
    with pytest.raises(KeyError):
        made.chosen(("c",))


def test_a_singular_initial_covariance_is_legal() -> None:
    assert system(initial_covariance=np.ones((2, 2))).initial_covariance[0, 1] == 1
    assert not system(initial_covariance=np.zeros((2, 2))).initial_covariance.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nx": 3}, r"initial_mean: expected an array of shape \(3,\)"),
        ({"initial_mean": [1, np.inf]}, "initial_mean: expected finite"),
        ({"initial_covariance": [[1, 2], [2, 1]]}, "initial_covariance: expected a positive semi-definite"),
        ({"F": Schedule.constant(Fixed(np.eye(3)))}, r"F: expected \(2, 2\)"),
        ({"F": Schedule((Fixed(np.eye(2)), Fixed(np.eye(3))))}, r"F\[1\]: expected \(2, 2\)"),
        ({"F": Schedule.constant(Fixed(np.eye(2)), 1)}, "F: expected a schedule that begins at step 0"),
        ({"noise": noise(3, a=1, b=3)}, "noise: expected process noise of size nx = 2"),
        ({"noise": noise(a=1)}, r"sensors\[1\]: expected measurement noise of size ny = 3 \(is None\)"),
        ({"noise": noise(a=1, b=2)}, r"sensors\[1\]: expected measurement noise of size ny = 3 \(is 2\)"),
        ({"noise": noise(a=1, b=3, c=1)}, r"noise: expected noises of the sensors only.*\(is \['c'\]\)"),
        ({"sensors": ()}, "sensors: expected at least one"),
        ({"sensors": (sensor("b", 3), sensor("a", 1))}, "sensors: expected ids that differ, in sorted order"),
        ({"sensors": (sensor("a", 1), sensor("a", 1))}, "sensors: expected ids that differ"),
        ({"sensors": (sensor("a", 1), sensor(2, 3))}, "sensors: .* all integers or all names"),
        ({"sensors": (sensor("a", 1), sensor("b", 3, first=0))}, r"sensors\[1\].H: .* begins at step 1"),
        ({"sensors": (sensor("a", 1), sensor("b", 3, nx=3))}, r"sensors\[1\].H: expected \(3, 2\)"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(changes, message) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        system(**changes)


def test_a_system_is_checked_again_when_it_is_varied() -> None:
    with pytest.raises(InputError, match="initial_mean"):
        replace(paper_system(), initial_mean=[1.0, 2.0])
