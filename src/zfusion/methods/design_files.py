"""Designs as files: what a method computed off-line, for the nodes that run it.

An .npz archive of plain arrays, which numpy alone can read: `method`, `version` and `fingerprint` say what it is a
design of, and is one of nothing else.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, Self
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from zfusion.errors import InputError
from zfusion.model.types import NodeId

FORMAT = "zfusion design"
VERSION = 1
"""Of the files; a file of another version is refused, not guessed at."""

DIGITS = 9
"""Significant digits that count in a fingerprint: matrix products differ in the last bits between machines."""

HEAD = ("format", "version", "method", "fingerprint")

Arrays = Mapping[str, NDArray[np.generic]]


class Content(NamedTuple):
    """What is in a design file, wherever that was."""

    source: str
    """What errors call it."""
    data: bytes


class DesignFileError(InputError):
    """A design file that cannot be used: missing, damaged, of another version, method or system."""


class Stored(ABC):
    """A design that can be kept in a file."""

    @abstractmethod
    def packed(self) -> bytes:
        """What its file holds."""

    @classmethod
    @abstractmethod
    def unpack(cls, content: Content, made_for: str | None = None) -> Self:
        """As `load`, of what is in a file."""

    def save(self, path: Path) -> None:
        """Write it as an .npz archive; InputError where that cannot be done."""
        write(path, self.packed())

    @classmethod
    def load(cls, path: Path, made_for: str | None = None) -> Self:
        """Read one; DesignFileError unless it is of this method, and for the fingerprint `made_for` where given."""
        return cls.unpack(read(path), made_for)


def fingerprint(parts: Iterable[tuple[str, object]]) -> str:
    """SHA-256 in hex of named numbers, texts and arrays, in this order."""
    digest = hashlib.sha256()
    for name, value in parts:
        array = np.asarray(value)
        words = (
            [f"{number + 0.0:.{DIGITS - 1}e}" for number in array.ravel().tolist()]
            if array.dtype.kind in "fiub"
            else [repr(value)]
        )
        digest.update(f"{name} {array.shape} {' '.join(words)}\n".encode())
    return digest.hexdigest()


def packed(method: str, made_for: str, arrays: Arrays) -> bytes:
    """What a file is to hold: the design of a method for what has the fingerprint `made_for`."""
    head = {"format": FORMAT, "version": VERSION, "method": method, "fingerprint": made_for}
    if clash := set(head) & set(arrays):
        raise ValueError(f"these names are taken: {sorted(clash)}")
    file = BytesIO()
    named = {name: np.asarray(value) for name, value in (head | dict(arrays)).items()}
    np.savez_compressed(file, allow_pickle=False, **named)
    return file.getvalue()


def write(path: Path, data: bytes) -> None:
    """Write what was `packed`; InputError where that cannot be done."""
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None


def read(path: Path) -> Content:
    """What is in a file, whatever that is; DesignFileError where it cannot be read."""
    try:
        return Content(str(path), path.read_bytes())
    except FileNotFoundError:
        raise DesignFileError(f"{path}: there is no such file") from None
    except OSError as error:
        raise DesignFileError(f"{path}: not a design file of zfusion ({error})") from None


def unpack(content: Content, method: str, made_for: str | None = None) -> dict[str, NDArray[np.generic]]:
    """The arrays of a design; DesignFileError unless it is one of this method, and for `made_for` where given."""
    path, arrays = content.source, _arrays(content)
    said = {name: arrays.pop(name, np.array(None)).tolist() for name in HEAD}
    if said["format"] != FORMAT:
        raise DesignFileError(f"{path}: not a design file of zfusion")
    if said["version"] != VERSION:
        raise DesignFileError(
            f"{path}: a design file of version {said['version']}; this zfusion reads version {VERSION}"
        )
    if said["method"] != method:
        raise DesignFileError(f"{path}: a design of the method {said['method']!r}, expected one of {method!r}")
    if made_for is not None and said["fingerprint"] != made_for:
        raise DesignFileError(f"{path}: designed for another system, network or choice of options; design it anew")
    return arrays


def stored_ids(ids: Iterable[NodeId]) -> NDArray[np.generic]:
    """Node ids as an array, numbers or texts."""
    return np.array(list(ids))


def _arrays(content: Content) -> dict[str, NDArray[np.generic]]:
    try:
        archive = np.load(BytesIO(content.data), allow_pickle=False)
        if isinstance(archive, np.ndarray):
            raise DesignFileError(f"{content.source}: not a design file of zfusion (a single array)")
        return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, BadZipFile, EOFError) as error:
        raise DesignFileError(f"{content.source}: not a design file of zfusion ({error})") from None
