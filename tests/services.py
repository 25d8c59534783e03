"""What systemd and compose would start, read from what `zfusion deploy` has written for them."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from zfusion.deploy.compose import PLACE as IN_CONTAINER
from zfusion.deploy.compose import write_compose
from zfusion.deploy.folders import write, write_readmes
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.plan import Plan
from zfusion.deploy.systemd import PLACE, PROGRAM, write_units
from zfusion.model.scenario import load_scenario

ROOT = Path(__file__).parents[1]

EXAMPLE = ROOT / "examples" / "four_sensor.toml"


def tool(name: str) -> str:
    """The path of a program; the test is skipped, naming it, where it is not there."""
    found = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if found is None:
        pytest.skip(f"{name} is not there")
    return found


def plan_of(hosts: Path, file: Path = EXAMPLE) -> Plan:
    """The plan of a hosts file that names its run."""
    scenario = load_scenario(file)
    loaded = HostsFile.load(hosts, scenario)
    assert loaded.run is not None
    return Plan(scenario, loaded, loaded.run)


@dataclass(frozen=True)
class Service:
    """One process as its supervisor starts it; paths are relative to its host's folder."""

    name: str
    host: str
    words: list[str]
    """After ``zfusion``."""
    environment: dict[str, str]
    seen: dict[str, str]
    """Where it finds what; empty: all of the folder, but of ``tls`` only its own."""
    keys: set[str]
    writable: list[str]


def write_all(plan: Plan, directory: Path) -> None:
    """The folders of a plan as the command writes them."""
    write(plan, directory, more=(write_readmes, write_units, write_compose))


def services_of(kind: str, plan: Plan, out: Path) -> Iterator[Service]:
    """All services of a deployment."""
    for host in plan.hosts.hosts:
        yield from (_units if kind == "systemd" else _containers)(out / host, plan.run)


def _units(folder: Path, run: str) -> Iterator[Service]:
    for target in folder.glob("systemd/*.target"):
        for unit in _values(target, "Wants", "")[0].split():
            template, _, instance = unit.removesuffix(".service").partition("@")
            file = folder / "systemd" / f"{template}{'@' if instance else ''}.service"
            program, *words = shlex.split(_values(file, "ExecStart", instance)[0])
            assert program == PROGRAM
            place = f"{PLACE}/{run}"
            assert _values(file, "WorkingDirectory", instance) == [place]
            kind = template.removeprefix(f"zfusion-{run}-")
            name = {"node": f"node-{instance}", "router": f"router-{folder.name}"}.get(kind, kind)
            environment = dict(pair.split("=", 1) for pair in _values(file, "Environment", instance))
            shown = [Path(path) for path in _values(file, "BindReadOnlyPaths", instance)]
            writable = [path.removeprefix(f"{place}/") for path in _values(file, "ReadWritePaths", instance)]
            if shown:
                assert _values(file, "TemporaryFileSystem", instance) == [f"{place}/tls:ro"]
            keys = {path.name for path in shown if path.suffix == ".key"}
            seen = {f"tls/{path.name}": f"tls/{path.name}" for path in shown}
            yield Service(name, folder.name, words, environment, seen, keys, writable)


def _values(file: Path, name: str, instance: str) -> list[str]:
    lines = file.read_text().replace("%i", instance).splitlines()
    return [line.split("=", 1)[1] for line in lines if line.startswith(f"{name}=")]


def _containers(folder: Path, _run: str) -> Iterator[Service]:
    file = folder / "compose.yaml"
    if not file.exists():
        return
    document = yaml.safe_load(file.read_text())
    for name, service in document["services"].items():
        assert service["working_dir"] == IN_CONTAINER
        mounted = [(m["source"], m["target"], m["read_only"]) for m in service["volumes"]]
        secrets = [(document["secrets"][s["source"]]["file"], s["target"], True) for s in service.get("secrets", [])]
        places = [(s.removeprefix("./"), t.removeprefix(f"{IN_CONTAINER}/"), r) for s, t, r in mounted + secrets]
        seen = {target: source for source, target, _ in places}
        yield Service(
            name,
            folder.name,
            service["command"],
            {"ZFUSION_HEALTH_FILE": "health"},
            seen,
            {Path(target).name for target in seen if target.endswith(".key")},
            [target for _, target, read_only in places if not read_only],
        )
