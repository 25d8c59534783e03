"""From a system to what the recursions take: the sensors are the classes, each with its own random matrix."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from zfusion.methods.constant_system import SETTLED_STEP, constant
from zfusion.methods.convex import DesignError
from zfusion.methods.delay_aware.constant import Stationary, moment_radius
from zfusion.methods.delay_aware.joint import Reception
from zfusion.methods.neighbourhood import StepModels
from zfusion.model.matrices import multiplicative_noise
from zfusion.model.statistics import PriorMoments, step_models
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

METHOD = "delay_aware"


class Motion(NamedTuple):
    """x_k = A x_{k-1} + w, Cov w = Q, what a random A adds in Q."""

    A: Array
    Q: Array


class Model:
    """The statistics of some sensors, step by step."""

    def __init__(self, system: System, ids: Iterable[NodeId], noise: float = 0.0) -> None:
        """`noise`: the variance of each component's noise of reception. KeyError for an unknown sensor."""
        self._system, self._ids = system, tuple(ids)
        self._models = StepModels(lambda: step_models(system, self._ids))
        self.rows, self.m = system.noise.rows(self._ids)
        self.N = noise * np.eye(self.m)
        owner = np.repeat(np.arange(len(self._ids)), [system.by_id[i].ny for i in self._ids])
        self.same = (owner[:, None] == owner).astype(np.float64)

    def prior(self, step: int) -> PriorMoments:
        """Mean and covariance of x at a step >= 1, before any measurement."""
        return self._models.at(step)[1]

    def motion(self, step: int) -> Motion:
        """To this step, from the one before."""
        model = self._models.at(step)[0]
        return Motion(model.F, model.Q)

    def reception(self, step: int, p: Array) -> Reception:
        """At this step, with probabilities p of each row, (L+1, m)."""
        model = self._models.at(step)[0]
        return Reception(model.H, model.R, self.N, p, self.same)

    def stationary(self, p: Array) -> Stationary:
        """In the long run. DesignError where something varies with time, or E[x xᵀ] grows without bound."""
        system = self._system
        F = constant(METHOD, "F", system.F)
        H = [constant(METHOD, f"H of sensor {i!r}", system.by_id[i].H) for i in self._ids]
        if system.noise.constant_from != 0:
            raise DesignError(f"a constant gain of {METHOD} needs noises of constant covariance; these vary with time")
        radius = moment_radius(F.mean, F.factors)
        if not radius < 1:
            raise DesignError(f"a constant gain of {METHOD} needs E[x x^T] to stay bounded (radius {radius:.6g})")
        noise, n = system.noise.covariances(SETTLED_STEP, self._ids), system.nx
        moving = np.kron(F.mean, F.mean) + sum((np.kron(B, B) for B in F.factors), np.zeros((n * n, n * n)))
        X = np.linalg.solve(np.eye(n * n) - moving, noise.Q.ravel()).reshape(n, n)
        R = noise.R.copy()
        for i, matrix in zip(self._ids, H, strict=True):
            R[self.rows[i], self.rows[i]] += matrix.second_moment(X)
        given = Reception(np.vstack([matrix.mean for matrix in H]), R, self.N, p, self.same)
        return Stationary(F.mean, noise.Q + multiplicative_noise(F.factors, X), given)


def check_noises(system: System) -> None:
    """DesignError unless all noises are white, and w uncorrelated with the measurement noises."""
    for k in range(system.noise.repeats_after + SETTLED_STEP):
        found = system.noise.covariances(k, system.ids)
        if found.Q1.any() or found.R1.any():
            what = "white noises; these are correlated with themselves a step before"
        elif found.S0.any() or found.S1.any() or found.S2.any():
            what = "process noise uncorrelated with the measurement noises"
        else:
            continue
        raise DesignError(f"the method {METHOD} needs {what}")
