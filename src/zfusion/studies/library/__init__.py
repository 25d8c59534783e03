"""A real wireless sensor network: motes in a library, readings of one day and one night (docs/library.md).

data      readings and link qualities from the published files
field     a simple model of the temperature field, identified from a first part of the readings
prepare   the scenario that runs the swarm on the rest, with some motes held out
score     how well the swarm predicted, beside simple baselines
"""

from __future__ import annotations

from zfusion.studies.library.prepare import Study, load_study, prepare
from zfusion.studies.library.score import Score, score, show_score

__all__ = ["Score", "Study", "load_study", "prepare", "score", "show_score"]
