"""Are errors as large as they are said to be? Many runs, with and without losses, beside the predicted covariances.

The bounds are derived: a mean over independent runs may differ from what is predicted by 6 of its own standard
deviations, which are estimated from the runs. In a right implementation that happens once in 5e8 comparisons.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from oracles import paper, random_systems, tracking
from oracles.brute_force import Used, always
from zfusion.methods.covariances import Gains, advance, prior
from zfusion.methods.fusion import fusion_weights, joint_index
from zfusion.methods.layout import Layout
from zfusion.model.sampling import SamplePath
from zfusion.model.statistics import step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

STEPS, RUNS, SIGMAS = 25, 2500, 6.0
LOSS = 0.2
TARGET_NEIGHBOURS: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2), 2: (1, 2, 3), 3: (3, 4), 4: (1, 4)}
CASES = {
    "example": (paper.paper_system(), paper.NEIGHBOURS),
    "target": (tracking.target({1: 1.0, 2: 1.5, 3: 2.0, 4: 0.5}, axes=2, origin=1e3), TARGET_NEIGHBOURS),
}


@cache
def runs(case: str) -> tuple[Array, dict[NodeId, Array]]:
    """Truth, (RUNS, STEPS + 1, nx), and measurements of each sensor, (RUNS, STEPS + 1, ny)."""
    system = CASES[case][0]
    paths = [SamplePath(system, seed) for seed in range(RUNS)]
    truth = np.array([[path.truth(k) for k in range(STEPS + 1)] for path in paths])
    readings = {
        i: np.array([[path.measurement(i, max(k, 1)) for k in range(STEPS + 1)] for path in paths]) for i in system.ids
    }
    return truth, readings


def filtered(x: Array, mu: Array, Z: Array, gains: Gains) -> tuple[Array, Array]:
    """One step of all filters in all runs: x̂ and μ, (nodes, RUNS, ...)."""
    predicted = x @ gains.F.T + mu @ gains.WA.swapaxes(1, 2)
    mu = Z - predicted @ gains.H.swapaxes(1, 2) - mu @ gains.T.swapaxes(1, 2)
    return predicted + mu @ gains.K.swapaxes(1, 2), mu


def estimate(
    system: System, neighbours: dict[NodeId, tuple[NodeId, ...]], readings: dict[NodeId, Array], used: Used, heard: Used
) -> dict[str, tuple[Array, Array]]:
    """Stage -> (estimates, (nodes, RUNS, STEPS + 1, nx), and predicted covariances, (nodes, STEPS + 1, nx, nx))."""
    layout = Layout.build(neighbours, {sensor.id: sensor.ny for sensor in system.sensors})
    state, models = prior(layout, system.initial_covariance), step_models(system, system.ids)
    nodes, nx, (only,) = layout.nodes, system.nx, layout.classes
    n, size = only.slots.shape
    everything = np.concatenate([readings[i] for i in system.ids], axis=-1)
    x, mu = np.tile(system.initial_mean, (n, RUNS, 1)), np.zeros((n, RUNS, size))
    found = {
        stage: (np.zeros((n, RUNS, STEPS + 1, nx)), np.zeros((n, STEPS + 1, nx, nx)))
        for stage in ("intermediate", "estimate")
    }
    for k in range(1, STEPS + 1):
        model, moments = next(models)
        mask = layout.used({i: used[i, k] for i in nodes})
        state = advance(layout, state, model, mask)
        assert state.gains is not None
        Z = everything[:, k][:, only.slots].transpose(1, 0, 2) * mask[0][:, None, :]
        x, mu = filtered(x, mu, Z, state.gains[0])
        found["intermediate"][0][:, :, k], found["intermediate"][1][:, k] = x, layout.own(state.P)[0]
        for row, i in enumerate(nodes):
            members = [i, *(j for j in heard[i, k] if j != i)]
            rows = [nodes.index(j) for j in members]
            joint = state.P.flat.take(joint_index(layout, members, nx))
            weights, covariance = fusion_weights(joint, moments.covariance)
            z = np.concatenate(
                [np.broadcast_to(moments.mean, x[row].shape) - x[row], *(x[r] - x[row] for r in rows[1:])], 1
            )
            found["estimate"][0][row, :, k], found["estimate"][1][row, k] = x[row] + z @ weights.T, covariance
    return found


def assert_mean(samples: Array, wanted: Array | float) -> None:
    """The mean over the runs, the first axis, is the one that is wanted, within what chance can do."""
    deviation = samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    assert (np.abs(samples.mean(axis=0) - wanted) <= SIGMAS * deviation + 1e-12).all()


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("loss", [0.0, LOSS])
def test_errors_are_as_large_as_predicted(case: str, loss: float) -> None:
    system, neighbours = CASES[case]
    truth, readings = runs(case)
    rng = np.random.default_rng(11)
    used: Used = always(neighbours, STEPS)
    heard: Used = used
    if loss:
        used = random_systems.random_used_sets(rng, neighbours, STEPS, loss=loss, blackout=0, late=0)
        heard = random_systems.random_used_sets(rng, neighbours, STEPS, loss=loss, blackout=0, late=0)
    found = estimate(system, neighbours, readings, used, heard)
    for estimates, covariances in found.values():
        for x, P in zip(estimates, covariances, strict=True):
            errors = (truth - x)[:, 1:]
            assert_mean(errors, 0.0)
            assert_mean(errors[..., :, None] * errors[..., None, :], P[1:])
            nees = np.einsum("rka,kab,rkb->rk", errors, np.linalg.inv(P[1:]), errors)
            assert_mean(nees, system.nx)
            assert_mean(nees.mean(axis=1), system.nx)  # a much sharper bound: all steps together
    gained = np.trace(found["intermediate"][1] - found["estimate"][1], axis1=-2, axis2=-1)
    assert gained.min() > -1e-12
    assert gained.max() > 1e-3


def test_the_bounds_are_sharp_enough_to_notice_a_few_percent() -> None:
    """Covariances that are 5 % too small do not pass."""
    system, neighbours = CASES["target"]
    truth, readings = runs("target")
    used = always(neighbours, STEPS)
    x, P = (part[0] for part in estimate(system, neighbours, readings, used, used)["estimate"])
    errors = (truth - x)[:, 1:]
    nees = np.einsum("rka,kab,rkb->rk", errors, np.linalg.inv(P[1:]), errors)
    with pytest.raises(AssertionError):
        assert_mean(nees.mean(axis=1) / 0.95, system.nx)
