"""The manifests with what `zfusion deploy` adds to them: held against Kubernetes' schemas, and against the plan."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import kubernetes_validate
import pytest
import tomli_w
import yaml

from namespaces import hosts, why_none
from services import EXAMPLE, ROOT, plan_of, tool
from swarms import ZFUSION, Command, wait_until, zfusion
from zfusion.deploy.folders import write
from zfusion.deploy.kubernetes import write_component
from zfusion.deploy.plan import Plan
from zfusion.errors import InputError, ScenarioError

KUBERNETES = ("1.31", "1.35")

TROUBLE = why_none()

Manifest = dict[str, Any]


class Cluster(NamedTuple):
    """A deployment, and what kustomize makes of it."""

    plan: Plan
    folders: Path
    manifests: list[Manifest]


def deployed(place: Path, scenario: Path, hosts: dict[str, Any] | None = None) -> Cluster:
    """What `kubectl apply -k deploy/kubernetes` would send, of a scenario that is deployed for it."""
    shutil.copytree(ROOT / "deploy" / "kubernetes", place, ignore=shutil.ignore_patterns("field"))
    if hosts is not None:
        (place / "hosts.toml").write_text(tomli_w.dumps(hosts))
    plan = plan_of(place / "hosts.toml", scenario)
    write(plan, place / "field", more=(write_component,))
    words = [tool("kubectl"), "kustomize", str(place)]
    built = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    return Cluster(plan, place / "field", list(yaml.safe_load_all(built.stdout)))


def readings(directory: Path) -> Path:
    """A scenario of three sensors from node 0 on, that read files of their own and one that is everybody's."""
    document = tomllib.loads(EXAMPLE.read_text())
    document["sensors"] = [dict(sensor, id=i) for i, sensor in enumerate(document["sensors"][:3])]
    document["network"] = {"matrix": [[1] * 3] * 3}
    document["source"] = {"kind": "csv", "file": "y-{id}.csv", "columns": ["y"]}
    document["sensors"][2]["source"] = {"kind": "csv", "file": "other/y-1.csv", "columns": ["y"]}
    document["links"] = {"delay": {"trace": "a trace.csv"}}
    (directory / "other").mkdir()
    for name in ("y-0.csv", "y-1.csv", "other/y-1.csv"):
        (directory / name).write_text(f"y\n{len(name)}.5\n")
    (directory / "a trace.csv").write_text("0.001\n0.002\n")
    (directory / "three.toml").write_text(tomli_w.dumps(document))
    return directory / "three.toml"


@pytest.fixture(scope="module", params=["four", "three", "open", "designed"])
def cluster(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Cluster:
    """The example; another scenario with data files, with keys and without; one with a design, which is no text."""
    place = tmp_path_factory.mktemp(request.param)
    if request.param == "four":
        return deployed(place / "kubernetes", EXAMPLE)
    hosts = {"run": "other", "kubernetes": True, "security": {"enabled": request.param != "open"}}
    scenario = EXAMPLE.parent / "stationary.toml" if request.param == "designed" else readings(place)
    return deployed(place / "kubernetes", scenario, hosts)


def of_kind(manifests: list[Manifest], kind: str) -> dict[str, Manifest]:
    return {one["metadata"]["name"]: one for one in manifests if one["kind"] == kind}


def pods(manifests: list[Manifest]) -> dict[str, tuple[Manifest, Manifest]]:
    """Name of the set -> its pods and their one container."""
    found = {}
    for name, one in of_kind(manifests, "StatefulSet").items():
        pod = one["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        found[name] = pod, container
    return found


def contents_of(manifests: list[Manifest], volume: Manifest) -> dict[str, bytes]:
    """Path -> what is in a volume that a container reads."""
    if "projected" in volume:
        kinds = {"secret": "Secret", "configMap": "ConfigMap"}
        sources = [
            (kinds[kind], part["name"], part)
            for source in volume["projected"]["sources"]
            for kind, part in source.items()
        ]
    elif "secret" in volume:
        sources = [("Secret", volume["secret"]["secretName"], volume["secret"])]
    else:
        sources = [("ConfigMap", volume["configMap"]["name"], volume["configMap"])]
    found = {}
    for kind, name, source in sources:
        one = of_kind(manifests, kind)[name]
        data = {key: text.encode() for key, text in one.get("data", {}).items()} if kind == "ConfigMap" else {}
        coded = one.get("binaryData", {}) if kind == "ConfigMap" else one["data"]
        data |= {key: base64.b64decode(text) for key, text in coded.items()}
        items = source.get("items") or [{"key": key, "path": key} for key in data]
        assert not found.keys() & {item["path"] for item in items}
        found |= {item["path"]: data[item["key"]] for item in items}
    return found


def seen_by(manifests: list[Manifest], name: str, number: object) -> dict[str, bytes]:
    """Path -> what the container of a pod, of that number in its set, has below its working directory to read."""
    pod, container = pods(manifests)[name]
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    found = {}
    for mount in container["volumeMounts"]:
        if not mount.get("readOnly"):
            continue
        within = mount["mountPath"].removeprefix(container["workingDir"] + "/")
        files = contents_of(manifests, volumes[mount["name"]])
        if "subPath" in mount:
            found[within] = files[mount["subPath"]]
            continue
        part = mount["subPathExpr"].replace("$(NODE)", str(number)) + "/" if "subPathExpr" in mount else ""
        found |= {f"{within}/{path.removeprefix(part)}": data for path, data in files.items() if path.startswith(part)}
    return found


@pytest.mark.parametrize("version", KUBERNETES)
def test_manifests_are_kubernetes_own(cluster: Cluster, version: str) -> None:
    for manifest in cluster.manifests:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_pods_run_what_is_planned(cluster: Cluster) -> None:
    plan, _, manifests = cluster
    nodes = of_kind(manifests, "StatefulSet")["zfusion-node"]["spec"]
    ids = range(nodes["ordinals"]["start"], nodes["ordinals"]["start"] + nodes["replicas"])
    assert list(ids) == list(plan.scenario.ids)
    (service,) = of_kind(manifests, "Service").values()
    for process in plan.processes:
        own = process.kind == "node"
        _, container = pods(manifests)["zfusion-node" if own else "zfusion-recorder"]
        words = [word.replace("$(NODE)", str(process.node)) for word in container["args"]]
        assert words == [*plan.command(process)[1:], *(["--forever"] if own else [])]
        if own:
            assert plan.hosts.hosts[process.host].address == f"zfusion-node-{process.node}.{nodes['serviceName']}"
            assert nodes["serviceName"] == service["metadata"]["name"]
            (port,) = service["spec"]["ports"]
            assert process.listen == (f"{'tls' if plan.secured else 'tcp'}/0.0.0.0:{port['port']}",)
            assert container["ports"] == [{"name": port["targetPort"], "containerPort": port["port"]}]


def test_each_pod_sees_the_files_of_its_folder(cluster: Cluster) -> None:
    plan, folders, manifests = cluster
    hosts = {p.host: ("zfusion-node" if p.kind == "node" else "zfusion-recorder", p.node) for p in plan.processes}
    own = {host: files_in(folders / host) for host in hosts}
    everybodys = {path: data for files in own.values() for path, data in files.items() if path.startswith("data/")}
    for host, (name, number) in hosts.items():
        seen = seen_by(manifests, name, number)
        assert own[host].items() <= seen.items()
        more = {path: data for path, data in seen.items() if path not in own[host]}
        assert more.items() <= everybodys.items()  # and of keys and configurations its own alone


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")
def test_pods_find_each_other_by_their_names(tmp_path: Path) -> None:
    """Each in a network namespace, with the files that it sees, started by its container's words, stopped as pods are.

    The names that the headless service would give them are in an /etc/hosts of their own.
    """
    plan, _, manifests = deployed(tmp_path / "kubernetes", EXAMPLE)
    with hosts(plan.hosts.hosts) as made, ExitStack() as stack:
        table = tmp_path / "hosts"
        table.write_text("".join(f"{made.addresses[name]} {host.address}\n" for name, host in plan.hosts.hosts.items()))
        with_names = ("unshare", "--mount", "sh", "-c", 'mount --bind "$0" /etc/hosts && exec "$@"', str(table))
        commands = {}
        for process in plan.processes:
            name = "zfusion-node" if process.kind == "node" else "zfusion-recorder"
            (tmp_path / process.name / "recordings").mkdir(parents=True)
            for path, data in seen_by(manifests, name, process.node).items():
                (tmp_path / process.name / path).parent.mkdir(exist_ok=True)
                (tmp_path / process.name / path).write_bytes(data)
                (tmp_path / process.name / path).chmod(0o440)
            words = [word.replace("$(NODE)", str(process.node)) for word in pods(manifests)[name][1]["args"]]
            entrance = (*made.entrance(process.host), *with_names)
            command = commands[process] = Command(tmp_path / process.name, *words, program=(*entrance, *ZFUSION))
            stack.callback(command.wait)
            stack.callback(command.process.kill)
        recording = tmp_path / "recorder" / "recordings" / "field.mcap"
        wait_until(lambda: recording.exists() and recording.stat().st_size > 40_000, "steps are on the recording")
        for process, command in commands.items():
            if process.kind == "node":
                command.process.terminate()
        assert {command.wait().code for command in commands.values()} == {0}
    verdict = zfusion(tmp_path, "replay", recording, "--verify", "--json")
    assert verdict.code == 0, verdict.out + verdict.err
    assert {node for node, tally in verdict.summary["nodes"].items() if tally["identical"]} == {"1", "2", "3", "4"}


def test_keys_are_for_the_pods_only(cluster: Cluster) -> None:
    for name, (pod, container) in pods(cluster.manifests).items():
        claims = of_kind(cluster.manifests, "StatefulSet")[name]["spec"].get("volumeClaimTemplates", [])
        assert {mount["name"] for mount in container["volumeMounts"]} == {
            *(volume["name"] for volume in pod["volumes"]),
            *(claim["metadata"]["name"] for claim in claims),
        }
        tls = [volume.get("projected") or volume["secret"] for volume in pod["volumes"] if volume["name"] == "tls"]
        assert [volume["defaultMode"] for volume in tls] == ([0o440] if cluster.plan.secured else [])
    assert bool(of_kind(cluster.manifests, "Secret")) == cluster.plan.secured


@pytest.mark.parametrize(
    ("changes", "ids", "told"),
    [
        ({"topology": "router"}, None, 'topology: expected "direct" where kubernetes = true'),
        ({"hosts": {"a": {"address": "a", "nodes": [1]}}}, None, "hosts: expected none where kubernetes = true"),
        ({}, [1, 2, 3, 5], "kubernetes: expected a scenario whose ids are consecutive numbers"),
        ({}, ["a", "b", "c", "d"], "kubernetes: expected a scenario whose ids are consecutive numbers"),
        ({"kubernetes": False}, None, r"hosts: expected a table \[hosts.NAME\] for each, or kubernetes = true"),
    ],
)
def test_what_cannot_be_pods_is_refused(
    tmp_path: Path, changes: dict[str, Any], ids: list[Any] | None, told: str
) -> None:
    document = tomllib.loads(EXAMPLE.read_text())
    for i, sensor in zip(ids or [], document["sensors"], strict=False):
        sensor["id"] = i
    (tmp_path / "s.toml").write_text(tomli_w.dumps(document))
    (tmp_path / "hosts.toml").write_text(tomli_w.dumps({"run": "r", "kubernetes": True, **changes}))
    with pytest.raises(ScenarioError, match=told):
        plan_of(tmp_path / "hosts.toml", tmp_path / "s.toml")


def test_data_that_kubernetes_cannot_take_is_refused(tmp_path: Path) -> None:
    scenario = readings(tmp_path)
    (tmp_path / "y-1.csv").write_text("y\n" + "0.5\n" * 300_000)
    (tmp_path / "hosts.toml").write_text('run = "r"\nkubernetes = true\n')
    plan = plan_of(tmp_path / "hosts.toml", scenario)
    with pytest.raises(InputError, match=r"zfusion-data: expected files of at most 1048576 bytes together.*y-1\.csv"):
        write(plan, tmp_path / "field", more=(write_component,))


def test_pods_are_restricted(cluster: Cluster) -> None:
    (namespace,) = of_kind(cluster.manifests, "Namespace").values()
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"
    for pod, container in pods(cluster.manifests).values():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["automountServiceAccountToken"] is False
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert {"startupProbe", "readinessProbe", "livenessProbe"} <= set(container)
        assert re.fullmatch(r"zfusion:\d+\.\d+\.\d+", container["image"])


def test_only_neighbours_are_let_in(cluster: Cluster) -> None:
    policies = of_kind(cluster.manifests, "NetworkPolicy")
    (ingress,) = policies["zfusion-nodes"]["spec"]["ingress"]
    assert ingress["ports"] == [{"protocol": "TCP", "port": 7450}]
    assert "ingress" not in policies["zfusion-recorder"]["spec"]
    labels = of_kind(cluster.manifests, "StatefulSet")["zfusion-node"]["spec"]["template"]["metadata"]["labels"]
    selected = policies["zfusion-nodes"]["spec"]["podSelector"]["matchLabels"].items()
    assert selected <= labels.items()
    budget = of_kind(cluster.manifests, "PodDisruptionBudget")["zfusion-nodes"]["spec"]
    assert budget["selector"]["matchLabels"].items() <= labels.items()
    names = policies["zfusion-egress"]["spec"]["egress"][1]["to"][0]["podSelector"]
    assert "matchLabels" not in names  # to which kustomize would add the swarm's own
