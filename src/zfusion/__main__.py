"""``python -m zfusion`` and the ``zfusion`` command."""

from __future__ import annotations

import os
import signal
import sys

INTERRUPTED = 130
"""What a shell says of a process that Ctrl-C has ended."""


def main() -> None:
    """Run the command line. Sets what must be set before numpy is imported."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # small matrices: threads cost more than they bring, and change the last bits
    listens = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not so in the background
    if listens:  # nothing has begun that would have to be ended well, and modules are no place for an exception
        signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
    from zfusion.cli import run  # noqa: PLC0415

    if listens:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    except KeyboardInterrupt:  # while the commands are put together; later typer does the same
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
