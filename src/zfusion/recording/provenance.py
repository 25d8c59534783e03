"""What a recording was made on: the versions and the machine that decide the last bits of its numbers.

The same inputs give the same bits for the same versions on the same kind of machine. On another, BLAS kernels and
vector instructions round differently: then a recording can be compared within a tolerance only, and says so.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

PACKAGES = ("zfusion", "numpy", "eclipse-zenoh", "mcap", "msgpack")

ARITHMETIC = ("zfusion", "numpy", "blas", "machine", "cpu", "simd")
"""The facts that have to be equal for results to be equal bit for bit."""


def software() -> dict[str, str]:
    """The versions of Python, of zfusion and of the packages that its results and files depend on."""
    return {"python": platform.python_version()} | {package: _version(package) for package in PACKAGES}


def machine() -> dict[str, str]:
    """Host name, operating system, processor, and what NumPy computes with on it."""
    built = np.show_config(mode="dicts")
    blas = built["Build Dependencies"]["blas"]
    return {
        "host": platform.node(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "cpu": _cpu_model(),
        "blas": f"{blas['name']} {blas['version']}",
        "simd": " ".join(built["SIMD Extensions"]["found"]),
    }


def clocks() -> dict[str, str]:
    """The two clocks of this machine, read together: what its time stamps can be translated with later."""
    return {
        "clock_realtime_ns": str(time.time_ns()),
        "clock_monotonic_ns": str(time.monotonic_ns()),
        "clock_realtime_resolution_ns": str(round(time.clock_getres(time.CLOCK_REALTIME) * 1e9)),
    }


def arithmetic_differences(recorded: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """What of a recording's facts decides bits and is otherwise here: name to (recorded, here). Empty: all equal."""
    here = software() | machine()
    return {name: (told, here[name]) for name in ARITHMETIC if (told := recorded.get(name, "unknown")) != here[name]}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _cpu_model() -> str:
    """The processor's name; Linux tells it nowhere else than here."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    models = [line.partition(":")[2].strip() for line in lines if line.startswith(("model name", "CPU part"))]
    return models[0] if models else platform.processor() or "unknown"
