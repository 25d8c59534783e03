"""What Kubernetes is told of a scenario: a component for kustomize, beside the folders of the pods.

How pods are kept, what they may do and who may reach them stands in ``deploy/kubernetes``, for every scenario alike.
The component adds what depends on the scenario: how many nodes there are, the words that start them, and their
configurations, data files and keys. All pods of a set have the same volumes; of these each container is given the
directory with what is its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from zfusion.deploy.bundle import DATA
from zfusion.deploy.hosts import POD, RECORDER_POD
from zfusion.deploy.plan import SCENARIO, Plan, Process
from zfusion.deploy.yaml_file import write_yaml
from zfusion.deploy.zenoh_file import AUTHORITY
from zfusion.errors import InputError

PLACE = "/field"
"""Where a container has the files of its folder."""

NODE = "$(NODE)"
"""A pod's number, in words and paths of its container."""

READABLE = 0o440
"""Permissions of keys: for the pod's own group."""

MAX_MAP = 1 << 20
"""Bytes that Kubernetes takes in one ConfigMap."""

HEADER = "# The pods of the run {run}: {what}. Written by zfusion deploy, for deploy/kubernetes.\n"

Document = dict[str, Any]
Files = Mapping[str, str]
"""Key in a ConfigMap or Secret -> the file, relative to the directory of the folders."""


def write_component(plan: Plan, directory: Path) -> Iterator[Path]:
    """Write the component; the files. InputError where Kubernetes cannot take a file, or the extra is missing."""
    data = _Data(plan, directory)
    documents = {
        "kustomization.yaml": ("configurations, data and keys", _component(plan, directory, data)),
        "nodes.yaml": ("how many nodes, and how they start", _nodes(plan, data)),
        "recorder.yaml": ("how the recorder starts", _recorder(plan, data)),
    }
    for name, (what, document) in documents.items():
        yield write_yaml(directory / name, HEADER.format(run=plan.run, what=what), document)


class _Data:
    """The data files of all folders: one ConfigMap, for what two folders have of one name is the same file."""

    def __init__(self, plan: Plan, directory: Path) -> None:
        self.of = {host: sorted(_below(directory / host, DATA)) for host in plan.hosts.hosts}
        """Host -> files, relative to its folder."""
        names = sorted({file for files in self.of.values() for file in files})
        self.keys = {file: f"{n}-{re.sub(r'[^A-Za-z0-9_.-]', '_', Path(file).name)}" for n, file in enumerate(names)}
        found = {file: f"{host}/{file}" for host, files in self.of.items() for file in files}
        self.files: Files = {self.keys[file]: found[file] for file in names}

    def volume(self, hosts: Iterable[str]) -> list[Document]:
        """With what these hosts have, each file where it is in their folders."""
        own = sorted({file for host in hosts for file in self.of[host]})
        items = [{"key": self.keys[file], "path": str(Path(file).relative_to(DATA))} for file in own]
        return [{"name": "data", "configMap": {"name": "zfusion-data", "items": items}}] if own else []


def _below(folder: Path, part: str) -> Iterator[str]:
    """The files in a part of a folder, relative to the folder."""
    return (path.relative_to(folder).as_posix() for path in (folder / part).rglob("*") if path.is_file())


def _component(plan: Plan, directory: Path, data: _Data) -> Document:
    served = [process for process in plan.processes if process.kind in {"node", "recorder"}]
    maps: dict[str, Files] = {
        "zfusion-scenario": {SCENARIO: f"{RECORDER_POD}/{SCENARIO}"},
        **({"zfusion-data": data.files} if data.files else {}),
        **{process.host: _by_name(process, _zenoh(process)) for process in served},
    }
    for name, files in maps.items():
        size = sum((directory / file).stat().st_size for file in files.values())
        if size > MAX_MAP:
            raise InputError(
                f"{directory}: {name}: expected files of at most {MAX_MAP} bytes together, as a ConfigMap has "
                f"(they have {size}): {', '.join(files.values())}"
            )
    secrets = {process.host: _by_name(process, _tls(process)) for process in served} if plan.secured else {}
    return {
        "apiVersion": "kustomize.config.k8s.io/v1alpha1",
        "kind": "Component",
        "configMapGenerator": [_generator(name, files) for name, files in maps.items()],
        "secretGenerator": [_generator(name, files) for name, files in secrets.items()],
        "patches": [{"path": "nodes.yaml"}, {"path": "recorder.yaml"}],
    }


def _by_name(process: Process, files: Iterable[str]) -> Files:
    """A process' files by their names."""
    return {Path(file).name: f"{process.host}/{file}" for file in files}


def _zenoh(process: Process) -> tuple[str, ...]:
    return (process.zenoh_file,)


def _tls(process: Process) -> tuple[str, ...]:
    return AUTHORITY, process.certificate, process.key


def _generator(name: str, files: Files) -> Document:
    return {"name": name, "files": [f"{key}={file}" for key, file in files.items()]}


def _nodes(plan: Plan, data: _Data) -> Document:
    """The nodes: as many as there are, each with its own configuration and key."""
    nodes = [process for process in plan.processes if process.kind == "node"]
    volumes = [_of_each("zenoh", "configMap", _zenoh, nodes), *data.volume(process.host for process in nodes)]
    if plan.secured:
        volumes.append(_of_each("tls", "secret", _tls, nodes))
    words = (*plan.command(replace(nodes[0], node=NODE)), "--forever")
    document = _stateful_set(POD, "node", words, volumes)
    document["spec"] |= {"replicas": len(nodes), "ordinals": {"start": nodes[0].node}}
    return document


def _of_each(name: str, kind: str, files: Callable[[Process], Iterable[str]], nodes: Iterable[Process]) -> Document:
    """A volume that has for each node a directory, called as its pod's number, with what is its own."""
    sources = [
        {
            kind: {
                "name": node.host,
                "items": [{"key": key, "path": f"{node.node}/{key}"} for key in _by_name(node, files(node))],
            }
        }
        for node in nodes
    ]
    return {"name": name, "projected": {"defaultMode": READABLE, "sources": sources}}


def _recorder(plan: Plan, data: _Data) -> Document:
    (recorder,) = (process for process in plan.processes if process.kind == "recorder")
    volumes = [{"name": "zenoh", "configMap": {"name": recorder.host}}, *data.volume([recorder.host])]
    if plan.secured:
        volumes.append({"name": "tls", "secret": {"secretName": recorder.host, "defaultMode": READABLE}})
    return _stateful_set(RECORDER_POD, "recorder", plan.command(recorder), volumes)


def _stateful_set(name: str, container: str, words: Sequence[str], volumes: Sequence[Document]) -> Document:
    """A patch: the words that start a container, and volumes that it finds under their names: its directory of each."""
    mounts = [
        {
            "name": volume["name"],
            "mountPath": f"{PLACE}/{volume['name']}",
            "readOnly": True,
            **({"subPathExpr": NODE} if "projected" in volume else {}),
        }
        for volume in volumes
    ]
    own = {"name": container, "args": list(words[1:]), "volumeMounts": mounts}  # the image's entry point is zfusion
    return {
        "apiVersion": "apps/v1",
        "kind": "StatefulSet",
        "metadata": {"name": name},
        "spec": {"template": {"spec": {"containers": [own], "volumes": list(volumes)}}},
    }
