"""Whether this machine's clock is kept right, well enough for the deadlines, and whether it is fast to read."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from zfusion.doctor.finding import Finding, Topic

TOPIC = Topic("clocks")

UNSYNCHRONISED = 0x0040
"""STA_UNSYNC, of adjtimex(2)."""

SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")

SLOW = frozenset({"hpet", "acpi_pm", "jiffies", "pit"})
"""Clock sources that take a microsecond and more to read; nodes read the clock some twenty times a step."""

REMEDY = "run an NTP daemon (chrony, systemd-timesyncd) and look with chronyc tracking or timedatectl"


class _Timex(ctypes.Structure):
    """The beginning of struct timex, and room for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


class Discipline(NamedTuple):
    """What the kernel says of its clock."""

    synchronised: bool
    most_wrong_s: float
    """By how much it may be wrong."""


def discipline() -> Discipline | None:
    """As adjtimex(2) tells everybody; None where there is no such thing."""
    try:
        adjtimex = ctypes.CDLL(None, use_errno=True).adjtimex
    except (AttributeError, OSError):
        return None
    told = _Timex()  # modes 0: nothing is changed
    if adjtimex(ctypes.byref(told)) < 0:
        return None
    return Discipline(not told.status & UNSYNCHRONISED, told.maxerror / 1e6)


def check_clock(told: Discipline | None, limit_ns: int | None, *, several_machines: bool) -> Iterator[Finding]:
    """`limit_ns`: how far clocks may be apart (`drivers.clock_watch`); None in free running."""
    limit = "" if limit_ns is None else f"; {limit_ns / 1e6:g} ms between neighbours are allowed"
    if not several_machines:
        yield TOPIC.ok("all nodes are on this machine and have one clock")
    elif told is None:
        why = f"steps begin on every machine's own clock{limit}"
        yield TOPIC.warning("whether the clock is synchronised cannot be seen here", why, REMEDY)
    elif not told.synchronised:
        why = f"steps begin on every machine's own clock{limit}; nodes that find more refuse to start"
        yield TOPIC.warning("the kernel's clock is not synchronised", why, REMEDY)
    elif limit_ns is not None and told.most_wrong_s > limit_ns / 1e9:
        why = f"that is more than deadlines stand{limit}, though it is the worst case: nodes find out how it is"
        yield TOPIC.warning(
            f"the clock is synchronised, and may be wrong by {told.most_wrong_s * 1e3:.3g} ms",
            why,
            "a nearer or better NTP server, longer deadlines, or timing.max_clock_offset_s",
        )
    else:
        yield TOPIC.ok(f"the clock is synchronised, to within {told.most_wrong_s * 1e3:.3g} ms{limit}")


def check_source(source: Path = SOURCE) -> Iterator[Finding]:
    """How the clock is read, where the kernel says so."""
    if not os.access(source, os.R_OK):
        return
    name = source.read_text().strip()
    if name in SLOW:
        why = "each reading takes a microsecond or more, and nodes read it some twenty times a step"
        yield TOPIC.warning(
            f"clock source {name}", why, "the kernel's option clocksource=tsc, where the processor allows"
        )
    else:
        yield TOPIC.ok(f"clock source {name}")
