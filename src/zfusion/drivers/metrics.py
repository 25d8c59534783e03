"""What a node measures of itself while it runs, in bounded memory."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zfusion import keys
from zfusion.errors import MessageError
from zfusion.model.types import Array, NodeId
from zfusion.node import Node
from zfusion.recording.reader import Recording

BINS_PER_OCTAVE = 32
"""Resolution of a latency: 2.2 %, finer than two runs agree."""

LOWEST_US = 1.0
BINS = 32 * BINS_PER_OCTAVE
"""Up to 2^32 µs, over an hour."""


class Latencies:
    """A histogram of durations with logarithmic bins; histograms of several nodes add up."""

    __slots__ = ("_counts",)

    def __init__(self, counts: Mapping[int, int] | None = None) -> None:
        """From the non-empty bins that `sparse` gave."""
        self._counts: dict[int, int] = dict(counts or {})

    def add(self, duration_ns: int) -> None:
        """Count one duration."""
        ratio = duration_ns / (1000 * LOWEST_US)
        number = min(int(BINS_PER_OCTAVE * math.log2(ratio)), BINS - 1) if ratio > 1 else 0
        self._counts[number] = self._counts.get(number, 0) + 1

    def add_all(self, durations_ns: Sequence[int]) -> None:
        """Count many, each as `add` would, faster."""
        ratios = np.maximum(np.asarray(durations_ns, dtype=np.float64) / (1000 * LOWEST_US), 1.0)
        numbers = np.minimum(BINS_PER_OCTAVE * np.log2(ratios), BINS - 1).astype(np.int64)
        self.merge(Counter(numbers.tolist()))

    def sparse(self) -> dict[int, int]:
        """The non-empty bins, ascending."""
        return dict(sorted(self._counts.items()))

    def told(self) -> dict[str, int]:
        """The same with text as keys, as JSON has it."""
        return {str(number): count for number, count in self.sparse().items()}

    def merge(self, counts: Mapping[int, int]) -> None:
        """Add what `sparse` of another gave."""
        for number, count in counts.items():
            self._counts[number] = self._counts.get(number, 0) + count

    def quantile_us(self, q: float) -> float | None:
        """The duration below which a fraction q lies, in µs; None where nothing was counted."""
        least, below = q * sum(self._counts.values()), 0
        for number, count in self.sparse().items():
            below += count
            if below >= least:
                return round(LOWEST_US * math.exp2((number + 0.5) / BINS_PER_OCTAVE), 1)
        return None


class Pace:
    """How fast a node was from some time on."""

    def __init__(self, begun_ns: int) -> None:
        self.begun_ns = self.ended_ns = begun_ns
        """`ended_ns`: when the last step was completed."""
        self._cpu_ns = time.process_time_ns()
        self.completed = 0
        self.latencies = Latencies()

    @property
    def elapsed_s(self) -> float:
        """Until the end of the last step."""
        return (self.ended_ns - self.begun_ns) / 1e9

    def add(self, ended_ns: int, latency_ns: int) -> None:
        """A step was completed, so long after its measurement."""
        self.ended_ns = ended_ns
        self.completed += 1
        self.latencies.add(latency_ns)

    def told(self) -> dict[str, Any]:
        """As plain data: completed, elapsed_s, latency as `Latencies.told`; cpu_s, of this process, until now."""
        cpu_s = (time.process_time_ns() - self._cpu_ns) / 1e9
        told = {"completed": self.completed, "elapsed_s": self.elapsed_s, "cpu_s": cpu_s}
        return {**told, "latency": self.latencies.told()}


ERROR_BLOCK = 256
"""Errors that are summed up at a time: vectorised, a tenth of the cost of one by one."""


class Errors:
    """Squared errors of one stage's estimates against the truth, and what was predicted of them."""

    def __init__(self) -> None:
        self._pending: list[tuple[Array, Array | None]] = []
        self._count = 0
        self._squared = self._predicted = self._nees = 0.0

    def add(self, error: Array, P: Array | None) -> None:
        """Count one error x̂ - x, (nx,), and the covariance that was predicted of it, where it was."""
        self._pending.append((error, P))
        if len(self._pending) == ERROR_BLOCK:
            self._sum_up()

    def summary(self) -> dict[str, float]:
        """count, mse = mean |x̂ - x|², rmse; where predicted: predicted_mse = mean trace P, nees = mean eᵀ P^-1 e."""
        self._sum_up()
        if not self._count:
            return {"count": 0}
        mse = self._squared / self._count
        told = {"count": self._count, "mse": mse, "rmse": math.sqrt(mse)}
        if self._predicted:
            told |= {"predicted_mse": self._predicted / self._count}
            if math.isfinite(self._nees):  # an error that is predicted to be zero in some direction has no NEES
                told |= {"nees": self._nees / self._count}
        return told

    def _sum_up(self) -> None:
        if not self._pending:
            return
        errors = np.array([error for error, _ in self._pending])
        covariances = [P for _, P in self._pending if P is not None]
        self._pending = []
        self._count += len(errors)
        self._squared += float(np.sum(errors * errors))
        if len(covariances) == len(errors):
            P = np.array(covariances)
            self._predicted += float(np.einsum("kaa->", P))
            try:
                self._nees += float(np.sum(errors * np.linalg.solve(P, errors[:, :, None])[:, :, 0]))
            except np.linalg.LinAlgError:
                self._nees = math.nan


@dataclass(slots=True)
class NodeReport:
    """How one life of a node went; plain data, so that it can be told."""

    node: NodeId
    born: int
    step: int
    """The last step that it began."""
    completed: int
    skipped: int
    elapsed_s: float
    """From the start of its first step to the end of its last; a paced step lasts its period, if not longer."""
    sent: dict[str, int]
    edges: dict[str, dict[str, dict[str, int]]]
    """Neighbour -> received, late, missed, refused -> by stage or reason."""
    fallbacks: int
    errors: dict[str, dict[str, float]]
    latency: dict[str, int]
    """Measurement to estimate, as `Latencies.told`."""
    overheard: dict[str, int] = field(default_factory=dict)
    """What was not a legal message, and other trouble, by reason."""
    estimate: dict[str, list[float]] = field(default_factory=dict)
    """The last one: `x`, and `sd`, the standard deviations that its P gives."""
    settled: dict[str, Any] = field(default_factory=dict)
    """`Pace.told` of the part of its life that counts as settled, where there is one."""
    measured: dict[str, Any] = field(default_factory=dict)
    """`Meter.told`: latencies, waits and budgets."""
    clocks: dict[str, dict[str, float]] = field(default_factory=dict)
    """Neighbour -> `ClockOffset.told`: how far its clock was ahead of this node's, where that was found out."""
    clock_jumps: int = 0
    """How often its machine's clock was seen to jump."""
    clock_offset_exceeded: int = 0
    """Readings of neighbours' clocks that were beyond what is allowed."""
    queues: dict[str, int] = field(default_factory=dict)
    """Messages that waited at the most: too far `ahead` of the node, `held` by emulated links."""
    emulated: dict[str, dict[str, int]] = field(default_factory=dict)
    """Neighbour -> what link emulation did with its messages here -> how often."""
    incidents: dict[str, int] = field(default_factory=dict)
    """What was out of the ordinary with the method -> how often."""
    cut: bool = False
    """Whether it ended without telling what it had counted: all counters are 0 then, whatever there was."""

    @classmethod
    def of_nothing(cls, node: NodeId) -> NodeReport:
        """Of a life that ended before its first step."""
        return cls._uncounted(node, 0, 0, 0)

    @classmethod
    def cut_short(cls, node: NodeId, status: Mapping[str, Any]) -> NodeReport:
        """Of a life that ended without a report: what is known from the last `Status` that it told."""
        return cls._uncounted(node, status["born"], status["step"], status["completed"], cut=True)

    @classmethod
    def _uncounted(cls, node: NodeId, born: int, step: int, completed: int, *, cut: bool = False) -> NodeReport:
        return cls(node, born, step, completed, 0, 0.0, sent={}, edges={}, fallbacks=0, errors={}, latency={}, cut=cut)


def told_estimate(node: Node) -> dict[str, list[float]]:
    """A node's last estimate as plain data: x, and the standard deviations of its errors; empty before the first."""
    outcome = node.estimate
    if outcome is None:
        return {}
    return {"x": outcome.x.tolist(), "sd": np.sqrt(np.diag(outcome.P)).tolist()}


def edge_report(node: Node) -> dict[str, dict[str, dict[str, int]]]:
    """The counters of a node's in-edges as plain data: received, late, missed, lost by stage; refused by reason.

    `lost` is what the sender's own counter says is missing between messages that came; `heard` is how far it went, in
    the sender's last life. What a sender had sent before this node was born is not lost.
    """
    report = {}
    for j, counters in node.counters.items():
        accounts = {stage: counter.gaps() for stage, counter in counters.gaps.items()}
        report[str(j)] = {
            "received": dict(counters.received),
            "late": dict(counters.late),
            "revised": dict(counters.revised),
            "too_late": dict(counters.too_late),
            "stale": dict(counters.stale),
            "missed": dict(counters.missed),
            "lost": {s: a.lost_between + (a.lost_before if node.born == 1 else 0) for s, a in accounts.items()},
            "heard": {stage: counter.heard for stage, counter in counters.gaps.items()},
            "refused": dict(counters.refused),
        }
    return report


@dataclass(slots=True)
class RecorderReport:
    """What is on the file."""

    path: str
    messages: int = 0
    recorded: dict[str, int] = field(default_factory=dict)
    """By stage."""
    by_key: dict[str, int] = field(default_factory=dict)
    """By node and stage: ``1/measurement``."""
    lost: dict[str, int] = field(default_factory=dict)
    """By topic, where anything is missing that its sender sent."""
    foreign: int = 0
    """What came and is not on the file: on keys that are none of the scenario's, or larger than any message is."""
    files: list[str] = field(default_factory=list)
    """Where the recording is: one file, or its segments."""
    unrecorded: int = 0
    """What came and could not be written, because the recording had stopped; also among the lost."""
    overrun: int = 0
    """What came and was dropped unread, being too much at once; also among the lost where its sender numbered it."""
    stopped: str = ""
    """Why the recording ended before the run did, if it did."""
    unheeded: int = 0
    """Questions, and news of nodes, that were dropped because too many waited."""

    @classmethod
    def of(cls, recording: Recording) -> RecorderReport:
        """Of a recording that is there."""
        report = cls(str(recording.path), recording.messages, files=list(map(str, recording.files)))
        for topic, count in recording.topics.items():
            with suppress(MessageError):
                _, node, stage = keys.parse(topic)
                report.recorded[stage] = report.recorded.get(stage, 0) + count
                report.by_key[f"{node}/{stage}"] = count
        accounts = recording.statistics or {}
        report.lost = {topic: gaps.lost for topic, gaps in accounts.items() if gaps.lost}
        return report
