"""What reports need beyond what zfusion itself needs."""

from __future__ import annotations

from importlib.util import find_spec

from zfusion.errors import InputError

PACKAGES = ("matplotlib", "jinja2", "pyarrow")
"""Of the extra `experiments`."""


def check_extras() -> None:
    """InputError, with what to install, unless all that reports need is there."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise InputError(f"reports need {' and '.join(missing)}: pip install 'zfusion[experiments]'")
