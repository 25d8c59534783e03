"""Fuzzing by Hypothesis for as long as is wanted: ``ZFUSION_FUZZ_S=3600 python -m pytest -n0 -k fuzz``."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

from hypothesis import HealthCheck, given, settings
from hypothesis.strategies import SearchStrategy

T = TypeVar("T")

SECONDS = float(os.environ.get("ZFUSION_FUZZ_S", "25"))
"""How long each fuzzer runs: more than a minute of them in continuous integration."""

TIMEOUT_S = SECONDS + 200
"""When a test that does so has hung."""

AT_ONCE = 100
"""Examples between two looks at the clock."""


def fuzz(target: Callable[[T], object], drawn: SearchStrategy[T]) -> None:
    """Give a target what is drawn, never the same again, until the time is over; what it raises is a failure."""

    @settings(
        max_examples=AT_ONCE,
        deadline=None,
        database=None,
        derandomize=False,
        print_blob=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn)
    def some(value: T) -> None:
        target(value)

    end = time.monotonic() + SECONDS
    some()
    while time.monotonic() < end:
        some()
