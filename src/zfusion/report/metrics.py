"""What an observer has seen of a swarm as metrics: one table of them, for Prometheus and for OpenTelemetry.

Names follow Prometheus' conventions: what only grows ends in ``_total`` (and begins anew with each life of a node),
times are in seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

from zfusion.drivers.metrics import BINS_PER_OCTAVE, LOWEST_US
from zfusion.drivers.observer import Observer, SeenRecorder
from zfusion.status import Counts, Phase, Status

Labels = tuple[str, ...]
"""The values of a family's labels."""

FATES = {
    "received": "in time, and used",
    "late": "first seen when the stage was over",
    "missed": "not there at the deadline although expected",
    "lost": "missing, by the sender's own counter",
    "revised": "late, and taken in after all",
}
"""What becomes of neighbours' messages, by stage."""


@dataclass(frozen=True, slots=True)
class Histogram:
    """Durations in buckets of an octave each."""

    buckets: tuple[tuple[float, int], ...]
    """(upper bound in s, how many are not above it), ascending; the last bound is infinite."""
    total_s: float
    """The sum of all, known to within the 1.1 % of half a bin."""


@dataclass(frozen=True, slots=True)
class Family:
    """One metric."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    help: str
    labels: Labels
    samples: Mapping[Any, float | Histogram]
    """By `Labels`."""


def families(observer: Observer) -> Iterator[Family]:
    """All metrics of what was seen last. Of who does not answer there is nothing but that he does not."""
    run = observer.run or ""
    up = {(run, name): float(node.answered) for name, node in observer.nodes.items()}
    yield Family("zfusion_node_up", "gauge", "Whether the node answers.", ("run", "node"), up)
    told = {name: node.status for name, node in observer.nodes.items() if node.status is not None and node.answered}
    yield from _of_nodes(run, told)
    counted = {name: status.counts for name, status in told.items() if status.counts is not None}
    yield from _of_lives(run, counted)
    yield from _of_edges(run, counted)
    yield _waits(run, counted)
    if observer.recorder is not None:
        yield from _of_recorder(run, observer.recorder)


def _of_nodes(run: str, told: Mapping[str, Status]) -> Iterator[Family]:
    node = ("run", "node")
    each = {(run, name): status for name, status in told.items()}
    yield _gauge("node_step", "Step that the node is at.", node, {at: s.step for at, s in each.items()})
    running = {at: float(s.phase is Phase.RUNNING) for at, s in each.items()}
    yield _gauge("node_running", "Whether the node takes steps.", node, running)
    steps = {at: s.completed for at, s in each.items()}
    yield _counter("node_steps", "Steps completed in the present life.", node, steps)
    fallbacks = {at: s.fallbacks for at, s in each.items()}
    yield _counter("node_fallbacks", "Estimates of neighbours that were left out.", node, fallbacks)
    jumps = {at: s.clock_jumps for at, s in each.items()}
    yield _counter("node_clock_jumps", "Jumps of the node's clock.", node, jumps)
    for name, which in (("estimate", "x"), ("estimate_sd", "sd")):
        values = {
            (*at, str(number)): value
            for at, s in each.items()
            for number, value in enumerate(s.estimate.get(which, ()))
        }
        what = "The last estimate." if which == "x" else "Standard deviation of its error, as predicted."
        yield _gauge(f"node_{name}", what, (*node, "component"), values)


def _of_lives(run: str, counted: Mapping[str, Counts]) -> Iterator[Family]:
    node = ("run", "node")
    each = {(run, name): counts for name, counts in counted.items()}
    yield _counter("node_steps_skipped", "Steps whose time was over.", node, {at: c.skipped for at, c in each.items()})
    cpu = {at: c.cpu_s for at, c in each.items()}
    yield _counter("node_cpu_seconds", "CPU time of the node's process.", node, cpu)
    for kind, what in (("sent", "Messages put, by stage."), ("overheard", "What was no legal message, by reason.")):
        label = "stage" if kind == "sent" else "reason"
        values = {(*at, name): n for at, c in each.items() for name, n in getattr(c, kind).items()}
        yield _counter(f"messages_{kind}", what, (*node, label), values)
    incidents = {(*at, name): n for at, c in each.items() for name, n in c.incidents.items()}
    yield _counter("node_incidents", "What was out of the ordinary with the method.", (*node, "kind"), incidents)
    queues = {(*at, name): n for at, c in each.items() for name, n in c.queues.items()}
    yield _gauge("node_queue_most", "Messages that waited at the most.", (*node, "queue"), queues)
    for name, which, what in (
        ("offset", "offset_us", "How far a neighbour's clock is ahead."),
        ("uncertainty", "uncertainty_us", "By how much that may be wrong."),
    ):
        values = {(*at, j): clock[which] / 1e6 for at, c in each.items() for j, clock in c.clocks.items()}
        yield _gauge(f"clock_{name}_seconds", what, (*node, "from"), values)


def _of_edges(run: str, counted: Mapping[str, Counts]) -> Iterator[Family]:
    edges = {(run, name, j): edge for name, counts in counted.items() for j, edge in counts.edges.items()}
    for fate, what in FATES.items():
        values = {(*at, stage): n for at, edge in edges.items() for stage, n in edge.get(fate, {}).items()}
        yield _counter(f"messages_{fate}", f"Messages {what}.", ("run", "node", "from", "stage"), values)
    refused = {(*at, reason): n for at, edge in edges.items() for reason, n in edge.get("refused", {}).items()}
    yield _counter("messages_refused", "Messages refused, by reason.", ("run", "node", "from", "reason"), refused)


def _waits(run: str, counted: Mapping[str, Counts]) -> Family:
    waits = {
        (run, name, stage): histogram({int(number): n for number, n in bins.items()})
        for name, counts in counted.items()
        for stage, bins in counts.waits.items()
    }
    name, what = "zfusion_stage_wait_seconds", "How long a stage was open."
    return Family(name, "histogram", what, ("run", "node", "stage"), waits)


def _of_recorder(run: str, recorder: SeenRecorder) -> Iterator[Family]:
    at = (run,)
    yield _gauge("recorder_up", "Whether the recorder answers.", ("run",), {at: float(recorder.answered)})
    status = recorder.status
    if status is None or not recorder.answered:
        return
    yield _counter("recorder_messages", "Messages on the file.", ("run",), {at: status.messages})
    yield _counter("recorder_lost", "Missing between messages that came.", ("run",), {at: status.lost})
    yield _counter("recorder_foreign", "What came and is none of the run's.", ("run",), {at: status.foreign})
    yield _gauge("recorder_queue", "Messages that waited when it was asked.", ("run",), {at: status.waiting})


def histogram(bins: Mapping[int, int]) -> Histogram:
    """The bins of `Latencies`, an octave of them to a bucket."""
    octaves: dict[int, int] = {}
    for number, count in bins.items():
        octaves[number // BINS_PER_OCTAVE] = octaves.get(number // BINS_PER_OCTAVE, 0) + count
    span = range(min(octaves, default=0), max(octaves, default=0) + 1)
    below = accumulate(octaves.get(octave, 0) for octave in span)
    buckets = [(LOWEST_US * 2.0 ** (octave + 1) / 1e6, n) for octave, n in zip(span, below, strict=True)]
    middle = sum(n * 2.0 ** ((number + 0.5) / BINS_PER_OCTAVE) for number, n in bins.items())
    return Histogram((*buckets, (math.inf, sum(bins.values()))), middle * LOWEST_US / 1e6)


def _gauge(name: str, what: str, labels: Labels, values: Mapping[Any, float]) -> Family:
    return Family(f"zfusion_{name}", "gauge", what, labels, values)


def _counter(name: str, what: str, labels: Labels, values: Mapping[Any, float]) -> Family:
    return Family(f"zfusion_{name}_total", "counter", what, labels, values)
