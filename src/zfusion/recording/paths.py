"""Files that are read and files that are written: what is read is a file, and nothing that is read is replaced."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from zfusion.errors import InputError


def open_to_read(path: Path) -> BinaryIO:
    """The file at `path`, open; OSError where it cannot be read, or is no file but a pipe or a device.

    A pipe would have us wait for somebody who writes into it, for ever where there is nobody.
    """
    file = open(path, "rb", opener=_at_once)  # noqa: SIM115 - Path.open takes no opener; closed by the caller
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.EINVAL, "is not a regular file")
    return file


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def refuse_to_replace(output: Path, inputs: Iterable[Path], what: str = "one of the recordings that are read") -> None:
    """InputError if `output` is one of the files `inputs`, by whatever name; `what` they are, in words."""
    for path in inputs:
        if output.exists() and path.exists() and output.samefile(path):
            raise InputError(f"{output}: is {what}")
