"""The published example with four sensors, and its error variances.

x_{k+1} = (0.95 + 0.2 ε_k) x_k + w_k, w_k = 0.6 (η_k + η_{k+1}); y^i_k = H^i_k x_k + v^i_k, v^i_k = c_i (η_{k-1} + η_k).
Caballero-Águila, Hermoso-Carazo, Linares-Pérez, Wang, Information Fusion 45 (2019) 324-332, Section 5.
"""

from __future__ import annotations

import numpy as np

from zfusion.model.distributions import Bernoulli, Discrete, Normal, Uniform
from zfusion.model.matrices import RandomMatrix, Schedule, Terms
from zfusion.model.noise import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.system import Sensor, System
from zfusion.model.types import Array, NodeId

NEIGHBOURS: dict[NodeId, tuple[NodeId, ...]] = {1: (1, 2, 3), 2: (2, 3, 4), 3: (1, 3, 4), 4: (1, 2, 4)}

ERROR_VARIANCES = {
    1: {
        "local": (0.5559586680, 0.3596410023, 0.4746465191, 0.7530221383),
        "intermediate": (0.3182685986, 0.3546512288, 0.4666230009, 0.3445489310),
        "distributed": (0.3180833878, 0.3284702710, 0.3176885793, 0.3178415076),
        "centralized": (0.3156280931,),
    },
    2: {
        "local": (0.3567758480, 0.2133288476, 0.3109932687, 0.7059984112),
        "intermediate": (0.1808756391, 0.1954975056, 0.2836349865, 0.1983022604),
        "distributed": (0.1807748247, 0.1900161035, 0.1804852950, 0.1806741556),
        "centralized": (0.1791033422,),
    },
    5: {
        "local": (0.2096077493, 0.2393626681, 0.3174262149, 0.9925314521),
        "intermediate": (0.1467224204, 0.1761251248, 0.1823940731, 0.1542325741),
        "distributed": (0.1465067722, 0.1474814632, 0.1465367485, 0.1464320624),
        "centralized": (0.1458376741,),
    },
    20: {
        "local": (0.5000778455, 0.6378153507, 0.8534180550, 2.4676591692),
        "intermediate": (0.3956283088, 0.4762932480, 0.4610527814, 0.4130560216),
        "distributed": (0.3948243456, 0.3948495250, 0.3952179582, 0.3947266237),
        "centralized": (0.3934303782,),
    },
    100: {
        "local": (0.7194049928, 0.9179770442, 1.2389953013, 3.4838300391),
        "intermediate": (0.5647185754, 0.6880984391, 0.6609617039, 0.5905026447),
        "distributed": (0.5635566342, 0.5638225355, 0.5641009954, 0.5634229018),
        "centralized": (0.5614501655,),
    },
}
"""Step -> estimate -> error variance of nodes 1..4, to ten digits."""


def paper_system() -> System:
    """The system of the example, written term by term as in the paper."""
    H: dict[NodeId, RandomMatrix] = {
        1: Terms(((_scalar(0.82), ("lambda",)),), {"lambda": Uniform(0.3, 0.7)}),
        2: Terms(((_scalar(0.75), ("lambda",)),), {"lambda": Discrete((0.0, 0.5, 1.0), (0.1, 0.5, 0.4))}),
        3: Terms(((_scalar(0.74), ("lambda",)),), {"lambda": Bernoulli(0.7)}),
        4: Terms(
            ((_scalar(0.75), ("lambda",)), (_scalar(0.95), ("lambda", "zeta"))),
            {"lambda": Bernoulli(0.7), "zeta": Normal(0.0, 1.0)},
        ),
    }
    c = {1: 1.0, 2: 0.5, 3: 0.75, 4: 0.85}
    return System(
        nx=1,
        initial_mean=np.zeros(1),
        initial_covariance=np.eye(1),
        F=Schedule((Terms(((_scalar(0.95), ()), (_scalar(0.2), ("eps",))), {"eps": Normal(0.0, 1.0)}),)),
        sensors=tuple(Sensor(i, 1, Schedule((H[i],), first=1)) for i in H),
        noise=MovingAverageNoise(
            white={"eta": WhiteNoise(_scalar(0.5))},
            process=(_tap(0, 0.6), _tap(1, 0.6)),
            sensors={i: (_tap(-1, c[i]), _tap(0, c[i])) for i in c},
        ),
    )


def _scalar(value: float) -> Array:
    return np.array([[value]])


def _tap(lag: int, value: float) -> Tap:
    return Tap("eta", lag, Schedule((_scalar(value),)))
