"""A compose file for a host: its nodes, its recorder and its router in containers, on the host's own network.

The containers' root is read only, they have no capabilities, and of the folder each sees what it needs: its Zenoh
configuration, its certificate and its key.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path
from typing import Any

from zfusion.deploy.bundle import DATA
from zfusion.deploy.plan import RECORDINGS, SCENARIO, Plan, Process
from zfusion.deploy.systemd import MEMORY, SERVED
from zfusion.deploy.yaml_file import write_yaml
from zfusion.deploy.zenoh_file import AUTHORITY

FILE = "compose.yaml"
"""In a host's folder."""

PLACE = "/field"
"""The host's folder in a container."""

HEADER = """\
# Host {host} of the run {run}, in containers. Written by zfusion deploy. In this folder, as the owner of its files:
#     ZFUSION_USER=$(id -u):$(id -g) docker compose up --detach
# The image is made by: docker build -f deploy/Dockerfile -t zfusion:{version} .   (or set ZFUSION_IMAGE)
"""

SHARED: dict[str, Any] = {
    "image": f"${{ZFUSION_IMAGE:-zfusion:{version('zfusion')}}}",
    "user": "${ZFUSION_USER:?the owner of these files, as $$(id -u):$$(id -g)}",
    "network_mode": "host",
    "working_dir": PLACE,
    "read_only": True,
    "cap_drop": ["ALL"],
    "security_opt": ["no-new-privileges:true"],
    "tmpfs": ["/run/zfusion:mode=1777,size=1m", "/tmp:mode=1777,size=16m"],
    "pids_limit": 128,
    "restart": "on-failure",
    "stop_grace_period": "60s",
    "logging": {"driver": "json-file", "options": {"max-size": "10m", "max-file": "3"}},
}
"""What all services have in common."""


def compose(plan: Plan, host: str, *, data: bool = False) -> dict[str, Any]:
    """The compose file of a host, whose folder may have `data`; no services where nothing is to be kept running."""
    served = [process for process in plan.on(host) if process.kind in SERVED]
    files = sorted({file for process in served for file in _secrets(plan, process)})
    document: dict[str, Any] = {
        "name": f"zfusion-{plan.run.lower().replace('.', '-')}",
        "services": {process.name: _service(plan, process, data) for process in served},
    }
    return document | ({"secrets": {Path(file).name: {"file": f"./{file}"} for file in files}} if files else {})


def write_compose(plan: Plan, directory: Path) -> Iterator[Path]:
    """Write the compose files of all hosts into their folders; the files. InputError where the extra is missing."""
    for host in plan.hosts.hosts:
        document = compose(plan, host, data=(directory / host / DATA).is_dir())
        if document["services"]:
            header = HEADER.format(host=host, run=plan.run, version=version("zfusion"))
            yield write_yaml(directory / host / FILE, header, document)


def _service(plan: Plan, process: Process, data: bool) -> dict[str, Any]:
    words = plan.command(process)[1:]  # the image's entry point is zfusion
    secrets = [{"source": Path(file).name, "target": f"{PLACE}/{file}"} for file in _secrets(plan, process)]
    mounts = [_mount(file) for file in _seen(process, data)]
    if process.kind == "recorder":
        mounts.append(_mount(RECORDINGS, read_only=False))
    service = deepcopy(SHARED) | {"command": list(words), "mem_limit": MEMORY[process.kind].lower(), "volumes": mounts}
    return service | ({"secrets": secrets} if secrets else {})


def _mount(path: str, *, read_only: bool = True) -> dict[str, Any]:
    return {
        "type": "bind",
        "source": f"./{path}",
        "target": f"{PLACE}/{path}",
        "read_only": read_only,
        "bind": {"create_host_path": False},
    }


def _seen(process: Process, data: bool) -> list[str]:
    """What a process reads and everybody may know."""
    if process.kind == "router":
        return [process.zenoh_file]
    return [SCENARIO, *([DATA] if data else []), process.zenoh_file]


def _secrets(plan: Plan, process: Process) -> list[str]:
    return [AUTHORITY, process.certificate, process.key] if plan.secured else []
