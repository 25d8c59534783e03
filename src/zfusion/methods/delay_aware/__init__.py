"""The optimal unbiased filter under random gains, delays and losses, and two Kalman filters for the same model."""

from zfusion.methods.delay_aware.companions import Augmented, Packet, Stamped
from zfusion.methods.delay_aware.constant import Best, Stationary, best_gain, limit_gain, moment_radius, settled
from zfusion.methods.delay_aware.joint import Reception
from zfusion.methods.delay_aware.parameters import Parameters
from zfusion.methods.delay_aware.recursion import Filter, Innovation

__all__ = [
    "Augmented",
    "Best",
    "Filter",
    "Innovation",
    "Packet",
    "Parameters",
    "Reception",
    "Stamped",
    "Stationary",
    "best_gain",
    "limit_gain",
    "moment_radius",
    "settled",
]
