"""What this machine gives its processes: descriptors, memory, processors."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

from zfusion.doctor.finding import Finding, Topic
from zfusion.drivers.simulated import simulate
from zfusion.errors import ZfusionError
from zfusion.links import ideal
from zfusion.methods import chosen
from zfusion.model.scenario import Scenario

TOPIC = Topic("limits")

OWN_FILES = 64
"""Descriptors that a process has beside those of its links."""

FILES_PER_LINK = 4

NODE_BYTES = 80 << 20
"""Memory of a node with numpy, Zenoh and a small model."""

TRIED_STEPS = 10
"""Steps that are computed to see how long one takes; the first are the slowest, while covariances settle."""

MOST_TRIED = 200
"""Nodes of a scenario of which that is tried: a few seconds."""

TALK_S = 500e-6
"""What a node's messages cost it a step, measured with three neighbours (README)."""

FULL = 0.7
"""The part of the processors from which on steps begin to be late."""

GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")


def check_files(links: int, limit: int | None = None) -> Iterator[Finding]:
    """`links` of the process here that has most; `limit` of its open files, by default this process'."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0] if limit is None else limit
    needed = OWN_FILES + FILES_PER_LINK * links
    unlimited = limit == resource.RLIM_INFINITY
    said = f"{'unlimited' if unlimited else limit} open files a process; {needed} for {links} links"
    if needed > limit and not unlimited:
        remedy = f"ulimit -n {needed}, or LimitNOFILE={needed} in the unit"
        yield TOPIC.error(said, "links are refused when there are no descriptors left", remedy)
    else:
        yield TOPIC.ok(said)


def available_memory(meminfo: Path = Path("/proc/meminfo")) -> int | None:
    """Bytes; None where that cannot be seen."""
    if not meminfo.exists():
        return None
    lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in lines else None


def check_memory(nodes: int, available: int | None) -> Iterator[Finding]:
    """`available` bytes for so many nodes."""
    if available is None:
        return
    said = f"{available >> 20} MB of memory for {nodes} nodes of about {NODE_BYTES >> 20} MB"
    if nodes * NODE_BYTES > available:
        yield TOPIC.error(said, "the kernel will kill processes", "more memory, or nodes on more machines")
    else:
        yield TOPIC.ok(said)


def step_seconds(scenario: Scenario) -> float | None:
    """What a node computes in a step, in seconds; None where that cannot be tried quickly: measurements come from
    outside, or the method is to be designed first.
    """
    undesigned = chosen(scenario).family.designer is not None and scenario.method.design is None
    foreign = any(scenario.source_of(i).kind in {"zenoh", "python"} for i in scenario.ids)
    if undesigned or foreign or len(scenario.ids) > MOST_TRIED:
        return None
    tried = scenario.model_copy(update={"steps": TRIED_STEPS, "faults": ()})
    began = time.process_time()
    try:
        simulate(tried, run="doctor", link=ideal)
    except ZfusionError:
        return None
    return (time.process_time() - began) / (TRIED_STEPS * len(scenario.ids))


def check_processors(nodes: int, rate_hz: float | None, step_s: float | None, processors: int) -> Iterator[Finding]:
    """Whether so many nodes are done in time with their steps; `rate_hz` is None in free running."""
    if step_s is None:
        yield TOPIC.ok(f"{processors} processors for {nodes} nodes; how long a step takes was not tried")
        return
    said = f"{processors} processors for {nodes} nodes; a step takes about {(step_s + TALK_S) * 1e3:.2g} ms of one"
    if rate_hz is None:
        yield TOPIC.ok(f"{said}: some {processors / (nodes * (step_s + TALK_S)):.0f} rounds a second")
        return
    load = nodes * (step_s + TALK_S) * rate_hz / processors
    said = f"{said}, at {rate_hz:g} steps a second {load:.0%} of all"
    remedy = "a lower rate, longer deadlines, fewer neighbours, or nodes on more machines"
    if load > 1:
        yield TOPIC.error(said, "steps are skipped: there is no time for them", remedy)
    elif load > FULL:
        yield TOPIC.warning(said, "messages will be late now and then", remedy)
    else:
        yield TOPIC.ok(said)


def check_governor(governor: Path = GOVERNOR) -> Iterator[Finding]:
    """How fast processors are when there is little to do, where the kernel says so."""
    if os.access(governor, os.R_OK) and (name := governor.read_text().strip()) == "powersave":
        why = "processors that wake up slowly add to every latency"
        yield TOPIC.warning(f"CPU governor {name}", why, "cpupower frequency-set -g performance, where it matters")
