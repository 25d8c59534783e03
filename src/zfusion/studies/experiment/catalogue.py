"""The metrics, by name: what each is, and in which unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

METRICS_VERSION = 1
"""Grows whenever a metric comes out otherwise for the same run: what was computed by an older one is computed anew."""

ALL = "all"
"""Stands for the network as a whole where a node's id would."""

STATE_SQUARED, STATE = "squared unit of the state", "unit of the state"


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric of the tables."""

    unit: str
    meaning: str
    timing: bool = False
    """Depends on the machine: in a table of its own, so that the others are the same whenever the file is run."""


METRICS: Mapping[str, Metric] = {
    "mse": Metric(STATE_SQUARED, "mean of |x̂ - x|² over the steps"),
    "rmse": Metric(STATE, "root of mse"),
    "predicted_mse": Metric(STATE_SQUARED, "mean of trace P over the same steps: what theory says for what was used"),
    "excess_mse": Metric(STATE_SQUARED, "mse - predicted_mse: its interval holds 0 where measurement and theory agree"),
    "nees": Metric("1", "mean of (x̂ - x)ᵀ P⁻¹ (x̂ - x); near the state's dimension where P can be believed"),
    "nees_final": Metric("1", "the same at the last step alone, in which runs are independent of one another"),
    "nees_band": Metric("1", "99 % chi-square band of the mean of nees over the seeds, where errors are Gaussian"),
    "bound_centralized": Metric(STATE_SQUARED, "predicted mse of a filter with all measurements: no network beats it"),
    "bound_local": Metric(STATE_SQUARED, "predicted mse of every node by itself"),
    "design_mse": Metric(STATE_SQUARED, "predicted mse if every message arrived in time"),
    "disagreement": Metric(STATE_SQUARED, "mean over the steps of the nodes' mean |x̂_i - x̄|²"),
    "age": Metric("steps", "age of the newest measurement of another node in the estimate, where it holds any"),
    "unheard": Metric("1", "fraction of the other nodes in reach of which the estimate holds no measurement at all"),
    "used_fraction": Metric("1", "fraction of the neighbours' messages of the stage that went in in time"),
    "latency_p50": Metric("s", "median one-way latency of the stage's messages"),
    "latency_p90": Metric("s", "its 90 % quantile"),
    "latency_p99": Metric("s", "its 99 % quantile"),
    "response_p50": Metric("s", "median time from a step's measurement to its estimate, of completed steps"),
    "response_p99": Metric("s", "its 99 % quantile"),
    "missed": Metric("messages", "not there at the deadline, whatever the reason"),
    "late": Metric("messages", "came after their stage was over"),
    "lost": Metric("messages", "never came"),
    "revised": Metric("messages", "came late and were taken in after all, by going back"),
    "too_late": Metric("messages", "came when the window of a node that revises was over"),
    "stale": Metric("messages", "came within the window, and could not be used: the sender had used more since"),
    "fallbacks": Metric("messages", "neighbours' estimates left out, their history being unknown; labelled so"),
    "completed": Metric("steps", "steps that ended in an estimate"),
    "skipped": Metric("steps", "steps that a node did not take, because their time was over"),
    "restarts": Metric("lives", "lives beyond the first"),
    "messages": Metric("messages", "messages published"),
    "bytes": Metric("bytes", "their payloads, each counted once however many receive it"),
    "rounds_per_s": Metric("1/s", "steps a second of wall-clock time", timing=True),
    "wall_s": Metric("s", "how long the run took", timing=True),
}
