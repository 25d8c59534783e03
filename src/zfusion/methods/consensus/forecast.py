"""What is known of the consensus filter's errors before it runs: the loss of every node, beside being alone."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from zfusion.errors import RunError
from zfusion.methods.consensus.mixing import Mixing
from zfusion.methods.consensus.prediction import Observed, alone, error_covariances
from zfusion.methods.constant_system import known, separate_noises
from zfusion.methods.convex import DesignError
from zfusion.methods.family import Forecast
from zfusion.model.system import System
from zfusion.model.types import Array, NodeId

METHOD = "consensus"


def observed_of(system: System) -> Observed:
    """The system as the prediction wants it: one quantity that all sensors measure, with noises of their own.

    DesignError where it is not so, or where a matrix varies or is random.
    """
    A = known(METHOD, "F", system.F)
    Q, R = separate_noises(METHOD, system)
    H = {sensor.id: known(METHOD, f"H of sensor {sensor.id!r}", sensor.H) for sensor in system.sensors}
    first = system.sensors[0].id
    for i, other in H.items():
        if not np.array_equal(other, H[first]):
            raise DesignError(
                f"the errors of {METHOD} are only known where all sensors measure the same: "
                f"H of sensor {i!r} is not that of sensor {first!r}"
            )
    return Observed(A, H[first], Q, np.array([R[i] for i in system.ids]))


def forecast_of(system: System, mixing: Mixing) -> Forecast:
    """The stationary errors of each node, beside those alone and with a centre; DesignError where they are unknown."""
    observed = observed_of(system)
    try:
        best = float(np.trace(observed.centralised[1]))
        single, mixed = _traces(alone(observed)), _traces(error_covariances(observed, mixing))
    except RunError as error:
        raise DesignError(f"the errors of {METHOD} are not known: {error}") from None
    network: dict[str, float | str | None] = {
        "rounds": float(mixing.rounds),
        "step_size": mixing.gamma,
        "largest_step_size": mixing.spectrum.largest_step,
        "fastest_step_size": mixing.spectrum.fastest_step,
        "disagreement_left": mixing.slowest,
        "centralized_mse": best,
    }
    nodes = {"mse": mixed.tolist(), "alone": single.tolist(), "loss": (mixed / best - 1).tolist()}
    worse = [i for i, with_others, without in zip(system.ids, mixed, single, strict=True) if with_others >= without]
    return Forecast(network, nodes, _remarks(worse, len(system.ids)))


def _remarks(worse: Iterable[NodeId], count: int) -> tuple[str, ...]:
    of = [str(i) for i in worse]
    loss = "loss is the part by which an error exceeds that of a centre with all measurements"
    if not of:
        return (loss,)
    who = "any node" if len(of) == count else f"node{'s' * (len(of) > 1)} {', '.join(of)}"
    return loss, f"the network does not help {who}: alone the error is no larger; take more rounds"


def _traces(P: Array) -> Array:
    return np.asarray(np.einsum("iaa->i", P))
