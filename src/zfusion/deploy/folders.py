"""The hosts' folders: everything that was planned, written so that it can be copied to the hosts.

Writing them again brings them up to date and keeps what is good: CA, certificates, recordings. What is not ours is
never touched.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
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

FORMAT = 1

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
    stale: list[str] = field(default_factory=list)
    """Folders of hosts that are not in the hosts file any more; they are left as they are."""

    def told(self) -> dict[str, Any]:
        """As one JSON object."""
        return {**vars(self), "directory": str(self.directory)}


def write(
    plan: Plan, directory: Path, *, renew: bool = False, more: Iterable[Callable[[Plan, Path], None]] = ()
) -> Written:
    """Write the folders of a plan's hosts into `directory`; `more` are called at the end, to write more into them.

    InputError where there is something else in it, a data file is missing, or a certificate is no good.
    """
    earlier = _earlier(directory, plan)
    private_directory(directory)
    plan = replace(plan, scenario=_designed(plan.scenario, directory / DESIGN))
    written = Written(directory, plan.run, list(plan.hosts.hosts))
    written.stale = sorted(name for name in earlier - set(written.folders) if (directory / name).is_dir())
    mark = {"format": FORMAT, "run": plan.run, "folders": sorted(earlier | set(written.folders))}
    (directory / MARK).write_text(json.dumps(mark, indent=2) + "\n")  # first: a run cut short is ours, too
    identities = Identities(plan, directory, renew=renew) if plan.secured else None
    bundle, speech = Bundle(plan.scenario), Speech(plan)
    for name, host in plan.hosts.hosts.items():
        folder = private_directory(directory / name)
        bundle.write(folder, host.nodes)
        (folder / "zenoh").mkdir(exist_ok=True)
        if host.recorder:
            (folder / RECORDINGS).mkdir(exist_ok=True)
        for process in plan.on(name):
            (folder / process.zenoh_file).write_text(zenoh_file(plan, process, speech))
            if identities is not None:
                identities.write(process)
        (folder / "README").write_text(_readme(plan, name))
    if identities is not None:
        written.certificates_made, written.certificates_kept = identities.made, identities.kept
    for each in more:
        each(plan, directory)
    return written


def _earlier(directory: Path, plan: Plan) -> set[str]:
    """The folders that were written into the directory before; InputError where it holds something else."""
    if not directory.exists():
        return set()
    if not directory.is_dir():
        raise InputError(f"{directory}: expected a directory")
    found = {path.name for path in directory.iterdir()}
    if not found:
        return set()
    try:
        mark = json.loads((directory / MARK).read_text())
        known = mark["format"] == FORMAT and isinstance(mark["folders"], list)
    except (OSError, ValueError, KeyError, TypeError):
        known = False
    if not known:
        raise InputError(f"{directory}: expected an empty directory, or one that zfusion deploy has written")
    if mark["run"] != plan.run:
        raise InputError(f"{directory}: this is the deployment of another run, {mark['run']}: expected one of its own")
    folders = set(map(str, mark["folders"]))
    foreign = sorted(found & set(plan.hosts.hosts) - folders)
    if foreign:
        raise InputError(f"{directory / foreign[0]}: expected nothing here: zfusion deploy has not written it")
    return folders


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
