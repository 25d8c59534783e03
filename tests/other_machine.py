"""Runs zfusion as if on another machine: with a clock that a test can set, and a boot of its own.

    python other_machine.py OFFSET BOOT zfusion's words ...

OFFSET is a file of eight bytes, how far the machine's clock is ahead, in nanoseconds: whoever writes it sets the clock.
BOOT is a file with what the kernel calls its boot. What is read is changed, and nothing else: the machine's clock stays
as it is, and so does the count of the time that passes.
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
from pathlib import Path


def main() -> None:
    with open(sys.argv[1], "r+b") as file:
        offset = mmap.mmap(file.fileno(), 8)
    right = time.time_ns
    time.time_ns = lambda: right() + struct.unpack("q", offset[:8])[0]
    time.time = lambda: time.time_ns() / 1e9

    from zfusion.drivers import clocks

    clocks.BOOT_ID = Path(sys.argv[2])
    sys.argv = ["zfusion", *sys.argv[3:]]

    from zfusion.__main__ import main as run

    run()


if __name__ == "__main__":
    main()
