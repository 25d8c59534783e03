"""Estimation methods: what a node computes from its measurement and its neighbours' messages."""

from __future__ import annotations

from zfusion.methods.protocol import Fields, Method, Outcome, Setting
from zfusion.methods.two_stage import Centralized, Local, TwoStage

METHODS: dict[str, type[Method]] = {method.name: method for method in (TwoStage, Local, Centralized)}
"""Every method by its name in a scenario."""

__all__ = ["METHODS", "Fields", "Method", "Outcome", "Setting"]
