"""The hosts' folders: everything that was planned, written so that it can be copied to the hosts.

Writing them again brings them up to date and keeps what is good: CA, certificates, recordings. What was written before
and is no process' of the host any more, its key above all, is removed. What is not ours is never touched.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import join
from typing import Any

from zfusion.deploy.access import Speech
from zfusion.deploy.bundle import Bundle
from zfusion.deploy.identity import Identities, private_directory
from zfusion.deploy.plan import RECORDINGS, Plan
from zfusion.deploy.zenoh_file import zenoh_file
from zfusion.drivers.designs import design_of, with_design
from zfusion.errors import InputError
from zfusion.methods.design_files import DesignFileError
from zfusion.model.scenario import Scenario

MARK = "zfusion-deploy.json"
"""The file by which a directory of ours is known."""

FORMAT = 2

Writer = Callable[[Plan, Path], Iterable[Path]]
"""Writes more into the folders of a plan, in a directory; the files that it has written."""

DESIGN = "design.npz"
"""The design that all nodes share, of methods that are designed off-line."""


@dataclass
class Written:
    """What `write` has done."""

    directory: Path
    run: str
    folders: list[str] = field(default_factory=list)
    certificates_made: list[str] = field(default_factory=list)
    certificates_kept: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    """Files of processes that are not on these hosts any more."""
    stale: list[str] = field(default_factory=list)
    """Folders of hosts that are not in the hosts file any more; they are left as they are."""

    def told(self) -> dict[str, Any]:
        """As one JSON object."""
        return {**vars(self), "directory": str(self.directory)}


@dataclass(frozen=True)
class _Mark:
    """What a directory of ours says of itself."""

    run: str
    folders: frozenset[str] = frozenset()
    """Hosts' folders that were ever written into it."""
    files: frozenset[str] = frozenset()
    """Files in them, relative to the directory."""

    @classmethod
    def read(cls, directory: Path, run: str) -> _Mark:
        """That of a directory; of a run's new one where there is nothing in it. InputError where it is another's."""
        if not directory.exists():
            return cls(run)
        if not directory.is_dir():
            raise InputError(f"{directory}: expected a directory")
        if not any(directory.iterdir()):
            return cls(run)
        try:
            told = json.loads((directory / MARK).read_text())
            mark = cls(str(told["run"]), frozenset(map(str, told["folders"])), frozenset(map(str, told["files"])))
            known = told["format"] == FORMAT
        except (OSError, ValueError, KeyError, TypeError):
            known = False
        if not known:
            raise InputError(f"{directory}: expected an empty directory, or one that zfusion deploy has written")
        if mark.run != run:
            raise InputError(f"{directory}: this is the deployment of another run, {mark.run}: expected one of its own")
        return mark

    def write(self, directory: Path) -> None:
        """Mark a directory as ours."""
        told = {"format": FORMAT, "run": self.run, "folders": sorted(self.folders), "files": sorted(self.files)}
        (directory / MARK).write_text(json.dumps(told, indent=2) + "\n")


def write(plan: Plan, directory: Path, *, renew: bool = False, more: Iterable[Writer] = ()) -> Written:
    """Write the folders of a plan's hosts into `directory`; `more` are called at the end, to write more into them.

    InputError where there is something else in it, it cannot be written, a data file is missing, or a certificate is no
    good.
    """
    try:
        return _write(plan, directory, renew, more)
    except OSError as error:
        raise InputError(f"{error.filename or directory}: cannot be written: {error.strerror}") from None


def _write(plan: Plan, directory: Path, renew: bool, more: Iterable[Writer]) -> Written:
    earlier, hosts = _earlier(directory, plan), frozenset(plan.hosts.hosts)
    private_directory(directory)
    plan = replace(plan, scenario=_designed(plan.scenario, directory / DESIGN))
    written = Written(directory, plan.run, list(plan.hosts.hosts))
    written.stale = sorted(name for name in earlier.folders - hosts if (directory / name).is_dir())
    mark = replace(earlier, folders=earlier.folders | hosts)
    mark.write(directory)  # first: a run cut short is ours, too
    identities = Identities(plan, directory, renew=renew) if plan.secured else None
    files = list(_write_folders(plan, directory, identities))
    if identities is not None:
        written.certificates_made, written.certificates_kept = identities.made, identities.kept
    theirs = {file for file in earlier.files if file.partition("/")[0] in hosts}
    removed = [file for file in sorted(theirs - _named(directory, files)) if _remove(directory, file)]
    for each in more:  # which look at what is there
        files += each(plan, directory)
    now = _named(directory, files)
    written.removed = [file for file in removed if file not in now]
    replace(mark, files=earlier.files - theirs | now).write(directory)
    return written


def _named(directory: Path, files: Iterable[Path]) -> set[str]:
    return {file.relative_to(directory).as_posix() for file in files}


def _write_folders(plan: Plan, directory: Path, identities: Identities | None) -> Iterator[Path]:
    """Write what every host needs; the files."""
    bundle, speech = Bundle(plan.scenario), Speech(plan)
    for name, host in plan.hosts.hosts.items():
        folder = private_directory(directory / name)
        yield from (folder / file for file in bundle.write(folder, host.nodes))
        (folder / "zenoh").mkdir(exist_ok=True)
        if host.recorder:
            (folder / RECORDINGS).mkdir(exist_ok=True)
        for process in plan.on(name):
            (folder / process.zenoh_file).write_text(zenoh_file(plan, process, speech))
            yield folder / process.zenoh_file
            if identities is not None:
                yield from identities.write(process)


def write_readmes(plan: Plan, directory: Path) -> Iterator[Path]:
    """Write what to do into the folder of every host; the files."""
    for host in plan.hosts.hosts:
        (directory / host / "README").write_text(_readme(plan, host))
        yield directory / host / "README"


def _remove(directory: Path, file: str) -> bool:
    """Remove a file of ours, and the directories that are empty without it; whether it was there."""
    path = directory / file
    was_there = path.exists()
    path.unlink(missing_ok=True)
    with suppress(OSError):  # something else is in them
        for parent in list(path.relative_to(directory).parents)[:-2]:  # the host's folder stays
            (directory / parent).rmdir()
    return was_there


def _earlier(directory: Path, plan: Plan) -> _Mark:
    """What was written into the directory before; InputError where it holds something else."""
    mark = _Mark.read(directory, plan.run)
    there = {path.name for path in directory.iterdir()} if directory.exists() else set()
    foreign = sorted(there & set(plan.hosts.hosts) - mark.folders)
    if foreign:
        raise InputError(f"{directory / foreign[0]}: expected nothing here: zfusion deploy has not written it")
    return mark


def _designed(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with its design in a file: that of an earlier time, where it still is the design of this."""
    if path.exists() and scenario.method.design is None:
        document = scenario.method.model_copy(update={"design": str(path.absolute())})
        again = scenario.model_copy(update={"method": document})
        try:
            design_of(again)
        except DesignFileError:
            path.unlink()
        else:
            return again
    return with_design(scenario, path)


def _readme(plan: Plan, host: str) -> str:
    """What to do in a host's folder."""
    lines = [
        f"Host {host} of the run {plan.run}. Written by zfusion deploy: changes are lost when it is run again.",
        "",
        "Copy this folder to the host, with its permissions (the keys in tls/ are secret), and start from inside it:",
        "",
    ]
    lines += [f"    {join(command)}" for process in plan.on(host) if (command := plan.command(process))]
    sensors = [process for process in plan.on(host) if process.kind == "sensor"]
    if sensors:
        lines += ["", "Your own programs publish the readings; their Zenoh configurations are:", ""]
        lines += [f"    {process.zenoh_file}" for process in sensors]
    if plan.secured:
        lines += [
            "",
            "Certificates are renewed where they were made (zfusion deploy --renew); the CA's key stays there.",
        ]
    return "\n".join(lines) + "\n"
