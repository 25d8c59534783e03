"""``python -m zfusion`` and the ``zfusion`` command."""

from __future__ import annotations

import os


def main() -> None:
    """Run the command line. Sets what must be set before numpy is imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices: threads cost more than they bring, and change the last bits
    from zfusion.cli import run  # noqa: PLC0415

    run()


if __name__ == "__main__":
    main()
