"""A network of stationary estimators, designed off-line for the mean squared error: `filter` is what a node runs.

Source: de Souza, Coutinho, Kinnaert, Mean square state estimation for sensor networks, Automatica 72 (2016) 108-114.
"""

from zfusion.methods.stationary.design import Design, make_design
from zfusion.methods.stationary.filter import Stationary
from zfusion.methods.stationary.lmi import Choice, Gramian
from zfusion.methods.stationary.mapping import problem_of
from zfusion.methods.stationary.options import StationaryOptions
from zfusion.methods.stationary.problem import Plant, Problem

__all__ = [
    "Choice",
    "Design",
    "Gramian",
    "Plant",
    "Problem",
    "Stationary",
    "StationaryOptions",
    "make_design",
    "problem_of",
]
