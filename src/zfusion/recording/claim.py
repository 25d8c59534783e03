"""Opening a file to write it, so that nobody else does at the same time: of two recorders, both would destroy it."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

TAKEN = "another process is writing it"


def open_claimed(path: Path) -> BinaryIO:
    """The file at `path`, made or emptied, and this process's alone to write until it is closed.

    OSError where it cannot be opened, or another process is writing it: then it is left as it is.
    """
    while True:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):  # a device is nobody's
                return os.fdopen(descriptor, "wb")
            _claim(descriptor, fcntl.LOCK_EX)
            if _is_at(path, descriptor):
                os.truncate(descriptor, 0)
                return os.fdopen(descriptor, "wb")
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # whoever had it has renamed or removed it meanwhile


def is_claimed(path: Path) -> bool:
    """Whether a process is writing the file at `path`."""
    with suppress(OSError), path.open("rb") as file:
        try:
            _claim(file.fileno(), fcntl.LOCK_SH)
        except OSError:
            return True
    return False


def _claim(descriptor: int, how: int) -> None:
    try:
        fcntl.flock(descriptor, how | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EBUSY, TAKEN) from None
    except OSError:
        return  # a file system without locks: it is written as it always was


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
