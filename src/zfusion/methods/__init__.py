"""Estimation methods: what a node computes from its measurement and its neighbours' messages."""

from __future__ import annotations

import json
from functools import lru_cache

from zfusion.methods.consensus.method import CONSENSUS
from zfusion.methods.delay_aware.filter import DELAY_AWARE
from zfusion.methods.diffusion import DIFFUSION
from zfusion.methods.family import Chosen, Family
from zfusion.methods.hybrid import HYBRID
from zfusion.methods.intersection import INTERSECTION
from zfusion.methods.kalman_consensus import KALMAN_CONSENSUS
from zfusion.methods.l2_linf.filter import L2_LINF
from zfusion.methods.protocol import Fields, Method, Outcome, Setting
from zfusion.methods.stationary.filter import STATIONARY
from zfusion.methods.two_stage import CENTRALIZED, LOCAL, TWO_STAGE
from zfusion.model.scenario import Scenario

METHODS: dict[str, Family] = {
    family.name: family
    for family in (
        *(TWO_STAGE, LOCAL, CENTRALIZED),
        *(CONSENSUS, STATIONARY, L2_LINF),
        *(DIFFUSION, KALMAN_CONSENSUS, HYBRID, INTERSECTION),
        *(DELAY_AWARE,),
    )
}
"""Every method by its name in a scenario."""


def chosen(scenario: Scenario) -> Chosen:
    """The scenario's method with its options. KeyError, ModelError where `check_method` finds that there is none."""
    return _chosen(scenario.method.name, json.dumps(scenario.method.options, sort_keys=True))


@lru_cache(maxsize=64)
def _chosen(name: str, options: str) -> Chosen:
    return METHODS[name].choose(json.loads(options))


__all__ = ["METHODS", "Chosen", "Family", "Fields", "Method", "Outcome", "Setting", "chosen"]
