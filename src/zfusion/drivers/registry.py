"""The runs of this machine: whoever starts a swarm, or a node of one, leaves a note, so that observers find it.

A note is a small JSON file in a directory that is this user's alone. It goes when its process ends; where that was
killed, whoever reads it next sees that there is no such process any more, and removes it.
"""

from __future__ import annotations

import json
import logging
import os
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from zfusion.drivers.clocks import machine
from zfusion.errors import InputError

log = logging.getLogger(__name__)

ANYWHERE = {"tcp/0.0.0.0:": "tcp/127.0.0.1:", "tcp/[::]:": "tcp/[::1]:"}
"""Beginnings of endpoints that listen on all interfaces, and how they are dialled from the same machine."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What is noted of a run."""

    run: str
    scenario: str
    """The scenario's name."""
    endpoints: Mapping[str, str]
    """Node -> where it is dialled; empty where a Zenoh configuration of the user's says that."""
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    """The same of those that somebody else has started, as far as one knows."""
    recorder: str | None = None
    """Where the recorder is dialled; None where there is none, or none that listens."""
    low_latency: bool = False
    config: str | None = None
    """The user's Zenoh configuration, which is everybody's."""
    own_configs: bool = False
    """Whether each process has one of its own instead, as zfusion deploy makes them: none is an observer's."""
    enter: tuple[str, ...] = ()
    """The words before a command that have it run where the nodes can be reached, if that is not everywhere."""
    pid: int = field(default_factory=os.getpid)
    birth: str | None = field(default_factory=lambda: birth(os.getpid()))
    """What tells the process from others that had, or will have, its id."""


@contextmanager
def registered(entry: Entry) -> Iterator[None]:
    """Have the run noted meanwhile. Where that cannot be done it is said, and nothing else changes."""
    path = None
    try:
        path = _write(entry)
    except OSError as error:
        log.warning("observers will not find run %s by themselves: %s", entry.run, error)
    try:
        yield
    finally:
        if path is not None:
            path.unlink(missing_ok=True)


def entries() -> list[Entry]:
    """The runs of this machine and user, one entry each, by name; notes of processes that are gone are removed."""
    found: dict[str, Entry] = {}
    try:
        paths = sorted(_directory().glob("*.json"))
    except OSError:
        return []
    for path in paths:
        entry = _read(path)
        if entry is None:
            continue
        first = found.get(entry.run, entry)
        found[entry.run] = replace(
            first,
            endpoints={**first.endpoints, **entry.endpoints},
            elsewhere={**first.elsewhere, **entry.elsewhere},
            recorder=first.recorder or entry.recorder,
            own_configs=first.own_configs or entry.own_configs,
        )
    return list(found.values())


def dialled_here(endpoint: str) -> str:
    """How a session on the same machine dials whoever listens there."""
    for anywhere, here in ANYWHERE.items():
        if endpoint.startswith(anywhere):
            return here + endpoint.removeprefix(anywhere)
    return endpoint


def _directory() -> Path:
    """The directory of the notes, made where it is not there; OSError if it is not this user's alone."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(runtime) / "zfusion" if runtime else Path(tempfile.gettempdir()) / f"zfusion-{os.getuid()}"
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(f"{path}: expected a directory that belongs to this user and that no other can write to")
    return path


def _write(entry: Entry) -> Path:
    path = _directory() / f"{entry.run}.{entry.pid}.json"
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(asdict(entry)))
    return partial.replace(path)


def _read(path: Path) -> Entry | None:
    """The entry of a file; None where its process is gone, and for what is none."""
    try:
        raw = json.loads(path.read_text())
        entry = Entry(**{**raw, "endpoints": dict(raw["endpoints"]), "enter": tuple(raw["enter"])})
        gone = birth(entry.pid) != entry.birth
    except FileNotFoundError:  # it has just ended
        return None
    except (OSError, ValueError, TypeError, KeyError) as error:
        log.warning("%s: no note of a run: %s", path, error)
        return None
    if gone:
        path.unlink(missing_ok=True)
    return None if gone else entry


def birth(pid: int) -> str | None:
    """When a process began, since this machine did, and which start of the machine; None where there is none."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "running" if not Path("/proc/self/stat").exists() and _exists(pid) else None
    return None if state == "Z" else f"{machine()}/{rest[18]}"


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def the_one(found: list[Entry], run: str | None, what: str) -> Entry | None:
    """The entry of `run`, or the only one; None where there is none. InputError, with the names, if there are more."""
    found = [entry for entry in found if run in (None, entry.run)]
    if len(found) > 1:
        names = ", ".join(entry.run for entry in found)
        raise InputError(f"--run: expected one of the runs {what}: {names}")
    return found[0] if found else None
