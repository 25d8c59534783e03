"""The worst network within a budget: which messages, lost or delayed past their deadlines, hurt most.

problem   which messages there are, and what a choice of them costs: the objective, many choices at once
search    exhaustive on tiny problems; greedy and local search, with restarts, on real ones
witness   a choice as a file of links, with which any simulation or replay finds the same number
"""

from zfusion.studies.worst.problem import Objective, Problem
from zfusion.studies.worst.search import Found, find_worst
from zfusion.studies.worst.witness import Report, worst_network, write_witness

__all__ = ["Found", "Objective", "Problem", "Report", "find_worst", "worst_network", "write_witness"]
