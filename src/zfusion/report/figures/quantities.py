"""What numbers are called on an axis: names, units, and the multiples of units that are easy to read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from zfusion.studies.experiment.catalogue import METRICS

MANY_DECADES = 50.0
"""Ratio of the largest to the smallest number from which on an axis is logarithmic."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A name and a unit; numbers are multiplied by `scale` before they are drawn."""

    name: str
    unit: str = ""
    scale: float = 1.0

    @property
    def label(self) -> str:
        """As it stands on an axis: ``delay [ms]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


_NAMES = {
    "rmse": "root mean squared error",
    "mse": "mean squared error",
    "predicted_mse": "predicted mean squared error",
    "nees": "NEES",
    "disagreement": "disagreement, mean square",
    "age": "age of information",
    "used_fraction": "fraction used in time",
    "latency_p50": "one-way latency, median",
    "latency_p90": "one-way latency, 90 % quantile",
    "latency_p99": "one-way latency, 99 % quantile",
    "rounds_per_s": "rounds",
    "messages": "messages published",
    "bytes": "bytes published",
}
"""Metrics in words, where their names are not enough."""

_UNITS = (
    ("_fraction", "1"),
    ("_per_step", "1/step"),
    ("_per_s", "1/s"),
    ("_steps", "steps"),
    ("_us", "µs"),
    ("_ms", "ms"),
    ("_ns", "ns"),
    ("_hz", "Hz"),
    ("_bps", "bit/s"),
    ("_s", "s"),
)
"""Endings of names, and the units that they tell."""

_PATHS = {
    "links.delay": Quantity("link delay", "s"),
    "links.delay.shift": Quantity("constant part of the link delay", "s"),
    "links.delay.median": Quantity("median of the link delay", "s"),
    "links.delay.mean": Quantity("mean of the link delay", "s"),
    "links.delay.sd": Quantity("standard deviation of the link delay", "s"),
    "links.delay.scale": Quantity("scale of the link delay", "s"),
    "links.delay.low": Quantity("least link delay", "s"),
    "links.delay.high": Quantity("largest link delay", "s"),
    "links.delay.minimum": Quantity("least link delay", "s"),
    "timing.deadlines": Quantity("deadline of the first stage", "periods"),
    "links.loss": Quantity("loss probability of a message", "1"),
    "links.duplicate": Quantity("probability of a duplicate", "1"),
    "timing.window": Quantity("window of revisions", "steps"),
    "steps": Quantity("steps of a run", "steps"),
}


def metric(name: str, values: Iterable[float] = ()) -> Quantity:
    """What a metric of an experiment is called, in a unit that suits its values; an unknown one keeps its name."""
    known = METRICS.get(name)
    if known is None:
        return _by_ending(name)
    words = _NAMES.get(name, name.replace("_", " "))
    return _scaled(words, values) if known.unit == "s" else Quantity(words, known.unit)


def axis(path: str, values: Iterable[float]) -> Quantity:
    """What an axis of an experiment is called, from the path of what it sets, in a unit that suits its values."""
    if path.startswith("timing.deadlines."):
        return Quantity(f"deadline of stage {path.removeprefix('timing.deadlines.')}", "periods")
    path = path.removeprefix("label.")
    found = _PATHS.get(path) or _by_ending(path.rpartition(".")[2] if path.startswith("timing.") else path)
    return _scaled(found.name, values) if found.unit == "s" else found


def _scaled(name: str, values: Iterable[float]) -> Quantity:
    return in_seconds(name, max((abs(v) for v in values if math.isfinite(v)), default=0.0))


def in_seconds(name: str, largest: float) -> Quantity:
    """A time, whose numbers are seconds, in the multiple that makes `largest` easy to read."""
    for unit, scale in (("s", 1.0), ("ms", 1e3)):
        if largest * scale >= 0.5 or not largest:
            return Quantity(name, unit, scale)
    return Quantity(name, "µs", 1e6)


def shown(value: float) -> str:
    """A number in three or so digits, as short as can be."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
        text = f"{value:.{min(digits, 5)}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2e}"


def spans_decades(values: Sequence[float]) -> bool:
    """Whether numbers are better shown on a logarithmic axis: all positive, and orders of magnitude apart."""
    finite = [v for v in values if math.isfinite(v)]
    return bool(finite) and min(finite) > 0 and max(finite) / min(finite) >= MANY_DECADES


def _by_ending(name: str) -> Quantity:
    for ending, unit in _UNITS:
        if name.endswith(ending):
            return Quantity(name.removesuffix(ending).replace("_", " "), unit)
    return Quantity(name.replace("_", " "))
