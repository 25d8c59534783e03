"""Files that are read and written: what is read is a file and is not replaced, what is written is there as a whole."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from zfusion.errors import InputError, RunError

PART = ".part"
"""Ends the name of a file that is not finished yet."""


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


@contextmanager
def written_whole(output: Path) -> Iterator[Path]:
    """Where to write what is the file `output` in the end; that is not touched before all of it is there.

    InputError if nothing can be written there; RunError if writing fails, on a full disk. Then, and after any other
    error, nothing is left of it. What is no file but a pipe or a device is written as it goes.
    """
    if output.is_dir():
        raise InputError(f"{output}: cannot be written: {os.strerror(errno.EISDIR)}")
    file = output.resolve()
    as_it_goes = output.exists() and not output.is_file()
    half = output if as_it_goes else file.with_name(file.name + PART)
    try:
        half.touch()
    except OSError as error:
        raise InputError(f"{output}: cannot be written: {error.strerror}") from None
    try:
        yield half
        if not as_it_goes:
            half.replace(file)
    except BaseException as error:
        if not as_it_goes:
            half.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise RunError(f"{output}: writing failed: {error.strerror}") from error
        raise
