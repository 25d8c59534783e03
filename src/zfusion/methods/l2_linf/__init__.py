"""Distributed filters with a bound on the peak of the error, for sensors that miss and a graph that switches.

Source: Zhu, Wen, Peng, Yang, Distributed l2-l∞ filtering for sensor networks with missing measurements and switching
topology, Control and Decision 35 (2020) 1841-1848.
"""

from zfusion.methods.l2_linf.design import Design, make_design
from zfusion.methods.l2_linf.filter import L2Linf
from zfusion.methods.l2_linf.lmi import Form
from zfusion.methods.l2_linf.mapping import problem_of
from zfusion.methods.l2_linf.options import L2LinfOptions
from zfusion.methods.l2_linf.problem import Problem

__all__ = ["Design", "Form", "L2Linf", "L2LinfOptions", "Problem", "make_design", "problem_of"]
