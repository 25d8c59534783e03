"""Units, compose files, the image and the manifests: held against the tools that read them, and against the plan."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import yaml

from deployed import hosts_document, planned
from services import ROOT, services_of, write_all
from zfusion.deploy.compose import SHARED
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.plan import Plan
from zfusion.deploy.systemd import SERVED
from zfusion.model.scenario import load_scenario

DEPLOY = ROOT / "deploy"

EXPOSURE = 2.0
"""What `systemd-analyze security` may say at most, of 10: its word for up to 2 is OK."""

SYSTEMD_S_OWN = ("sysinit", "basic", "shutdown", "multi-user", "network-online", "time-sync")
"""Targets that units refer to."""

KUBERNETES = ("1.31", "1.35")

SCHEMA = json.loads((ROOT / "tests" / "schemas" / "compose-spec.json").read_text())


def tool(name: str) -> str:
    """The path of a program; the test is skipped, naming it, where it is not there."""
    found = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if found is None:
        pytest.skip(f"{name} is not there")
    return found


def example_plan(hosts: Path) -> Plan:
    scenario = load_scenario(ROOT / "examples" / "four_sensor.toml")
    loaded = HostsFile.load(hosts, scenario)
    assert loaded.run is not None
    return Plan(scenario, loaded, loaded.run)


@pytest.fixture(scope="module", params=["direct", "router"])
def plan(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Path]:
    """A deployment of three hosts, and its folders."""
    directory = tmp_path_factory.mktemp(request.param)
    made = planned(directory, hosts_document(request.param))
    write_all(made, directory / "out")
    return made, directory / "out"


@pytest.fixture(scope="module")
def unit_root(plan: tuple[Plan, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root directory with the units of a host that has all kinds."""
    root = tmp_path_factory.mktemp("root")
    place = root / "etc" / "systemd" / "system"
    place.mkdir(parents=True)
    for file in plan[1].glob("*/systemd/*"):
        if file.suffix in {".service", ".target"}:
            shutil.copy(file, place)
    for name in SYSTEMD_S_OWN:
        (place / f"{name}.target").write_text(f"[Unit]\nDescription={name}\n")
    program = root / "opt" / "zfusion" / "bin" / "zfusion"
    program.parent.mkdir(parents=True)
    program.touch(0o755)
    return root


def verify(root: Path, *units: str) -> subprocess.CompletedProcess[str]:
    words = [tool("systemd-analyze"), "verify", f"--root={root}", "--man=no", "--recursive-errors=one", *units]
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)


def unit_names(plan: Plan) -> list[str]:
    names = [f"zfusion-{plan.run}.target"]
    for process in plan.processes:
        if process.kind in SERVED:
            instance = f"@{process.node}" if process.kind == "node" else ""
            names.append(f"zfusion-{plan.run}-{process.kind}{instance}.service")
    return names


def test_systemd_reads_the_units_without_a_word(plan: tuple[Plan, Path], unit_root: Path) -> None:
    result = verify(unit_root, *unit_names(plan[0]))
    assert (result.returncode, result.stderr) == (0, "")


def test_systemd_would_have_said_something(plan: tuple[Plan, Path], unit_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    shutil.copytree(unit_root, root)
    unit = root / "etc" / "systemd" / "system" / f"zfusion-{plan[0].run}-recorder.service"
    unit.write_text(unit.read_text().replace("ProtectSystem=strict", "ProtectSystem=sternly"))
    assert "sternly" in verify(root, unit.name).stderr


def test_units_are_hardly_exposed(plan: tuple[Plan, Path], unit_root: Path) -> None:
    for unit in unit_names(plan[0])[1:]:
        words = [tool("systemd-analyze"), "security", "--offline=true", f"--root={unit_root}", "--no-pager", unit]
        told = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60).stdout
        found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", told)
        assert found is not None
        assert float(found[1]) <= EXPOSURE, told


@pytest.mark.parametrize("kind", ["systemd", "compose"])
def test_services_are_the_plan_s(plan: tuple[Plan, Path], kind: str) -> None:
    made, out = plan
    services = {service.name: service for service in services_of(kind, made, out)}
    assert set(services) == {process.name for process in made.processes if process.kind in SERVED}
    for process in made.processes:
        if process.kind in SERVED:
            assert services[process.name].words == list(made.command(process)[1:])
            assert services[process.name].keys == {Path(process.key).name}
            assert services[process.name].writable == (["recordings"] if process.kind == "recorder" else [])


def test_nothing_is_written_for_hosts_that_only_look(tmp_path: Path) -> None:
    made = example_plan(DEPLOY / "hosts.example.toml")
    write_all(made, tmp_path / "out")
    assert not (tmp_path / "out" / "desk" / "systemd").exists()
    assert not (tmp_path / "out" / "desk" / "compose.yaml").exists()
    assert "zfusion-field.target" in (tmp_path / "out" / "alpha" / "systemd" / "README").read_text()


def test_without_security_there_are_no_keys_to_hide(tmp_path: Path) -> None:
    made = planned(tmp_path, hosts_document(security={"enabled": False}))
    write_all(made, tmp_path / "out")
    for kind in ("systemd", "compose"):
        assert all(not service.keys for service in services_of(kind, made, tmp_path / "out"))
    assert "secrets" not in yaml.safe_load((tmp_path / "out" / "a" / "compose.yaml").read_text())
    assert "/tls" not in (tmp_path / "out" / "a" / "systemd" / f"zfusion-{made.run}-node@.service").read_text()


def problems(document: Any) -> list[str]:
    return [error.message for error in jsonschema.Draft7Validator(SCHEMA).iter_errors(document)]


def test_compose_files_are_compose_files(plan: tuple[Plan, Path]) -> None:
    files = [DEPLOY / "compose.yaml", *plan[1].glob("*/compose.yaml")]
    assert len(files) == 4
    for file in files:
        assert problems(yaml.safe_load(file.read_text())) == []
    assert problems({"services": {"a": {"imagine": "b"}}})


def test_containers_have_no_rights(plan: tuple[Plan, Path]) -> None:
    for file in [DEPLOY / "compose.yaml", *plan[1].glob("*/compose.yaml")]:
        for service in yaml.safe_load(file.read_text())["services"].values():
            for name in ("read_only", "cap_drop", "security_opt", "pids_limit"):
                assert service[name] == SHARED[name]
            assert not {"privileged", "cap_add", "pid", "ipc", "devices"} & set(service)


def test_the_compose_example_is_its_plan() -> None:
    plan = example_plan(DEPLOY / "compose.hosts.toml")
    document = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    services = document["services"]
    for process in plan.processes:
        service = services[process.host]  # by whose name the others dial it
        assert ["zfusion", *service["command"]] == list(plan.command(process))
        first, *more = service["volumes"]
        assert (first["source"], first["target"], first["read_only"]) == ("deployment", "/field", True)
        assert first["volume"]["subpath"] == process.host
        assert [mount["target"] for mount in more] == (["/field/recordings"] if process.kind == "recorder" else [])
        assert all(mount["source"] in document["volumes"] for mount in service["volumes"])
        assert service["depends_on"] == {"deploy": {"condition": "service_completed_successfully"}}
    assert set(services) == {"deploy", *plan.hosts.hosts}
    words = services["deploy"]["command"]
    assert words[words.index("--hosts") + 1] == services["deploy"]["configs"][0]["target"]
    assert (DEPLOY / document["configs"]["hosts"]["file"]).samefile(DEPLOY / "compose.hosts.toml")
    assert services["deploy"]["volumes"] == [f"deployment:{words[words.index('--output') + 1]}"]


def test_the_image_s_recipe() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    result = subprocess.run(
        [tool("hadolint"), "--format", "json", str(DEPLOY / "Dockerfile")],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (result.returncode, json.loads(result.stdout)) == (0, [])
    assert re.search(r"^ARG BASE=\S+:\d+\.\d+\.\d+-\S+$", text, re.M)
    assert set(re.findall(r"^FROM (\S+)", text, re.M)) == {"${BASE}"}
    assert re.search(r"^USER [1-9]\d*:[1-9]\d*$", text, re.M)
    assert text.rindex("\nUSER ") > text.rindex("\nRUN ")
    assert json.loads(text.partition("ENTRYPOINT ")[2].partition("\n")[0]) == ["zfusion"]
    assert json.loads(text.partition("retries=3 CMD ")[2].partition("\n")[0]) == ["zfusion", "health"]
    assert all(line.startswith('RUN ["') for line in text.splitlines() if line.startswith("RUN"))  # no shell
    wanted = {word for words in re.findall(r"^COPY (?!--)(.+) \S+$", text, re.M) for word in words.split()}
    assert wanted | {"examples"} == {
        line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")
    }


@pytest.fixture(scope="module")
def manifests(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What kustomize makes of deploy/kubernetes and of the folders that are deployed for it."""
    place = tmp_path_factory.mktemp("kubernetes") / "kubernetes"
    shutil.copytree(DEPLOY / "kubernetes", place, ignore=shutil.ignore_patterns("field"))
    write_all(example_plan(place / "hosts.toml"), place / "field")
    words = [tool("kubectl"), "kustomize", str(place)]
    built = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    return list(yaml.safe_load_all(built.stdout))


def of_kind(manifests: list[dict[str, Any]], kind: str) -> dict[str, dict[str, Any]]:
    return {one["metadata"]["name"]: one for one in manifests if one["kind"] == kind}


def pods(manifests: list[dict[str, Any]]) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """Name of the set -> its pods and their one container."""
    found = {}
    for name, one in of_kind(manifests, "StatefulSet").items():
        pod = one["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        found[name] = pod, container
    return found


@pytest.mark.parametrize("version", KUBERNETES)
def test_manifests_are_kubernetes_own(manifests: list[dict[str, Any]], version: str) -> None:
    for manifest in manifests:
        kubernetes_validate.validate(manifest, version, strict=True)


def test_pods_run_what_is_planned(manifests: list[dict[str, Any]]) -> None:
    plan = example_plan(DEPLOY / "kubernetes" / "hosts.toml")
    nodes = of_kind(manifests, "StatefulSet")["zfusion-node"]["spec"]
    ids = range(nodes["ordinals"]["start"], nodes["ordinals"]["start"] + nodes["replicas"])
    assert list(ids) == list(plan.scenario.ids)
    for process in plan.processes:
        own = process.kind == "node"
        _, container = pods(manifests)["zfusion-node" if own else "zfusion-recorder"]
        words = [word.replace("$(NODE)", str(process.node)) for word in container["args"]]
        given = [part for word in words for part in word.split("=", 1)]
        planned = [word.replace("-o", "--output") if word == "-o" else word for word in plan.command(process)[1:]]
        assert sorted(given) == sorted([*planned, *(["--forever"] if own else [])])
        if own:
            service = of_kind(manifests, "Service")[nodes["serviceName"]]["spec"]
            assert plan.hosts.hosts[process.host].address == f"zfusion-node-{process.node}.{nodes['serviceName']}"
            assert process.listen == (f"tls/0.0.0.0:{service['ports'][0]['port']}",)
            assert container["ports"] == [{"name": service["ports"][0]["targetPort"], "containerPort": 7450}]


def test_what_pods_refer_to_is_there(manifests: list[dict[str, Any]]) -> None:
    maps, secrets = of_kind(manifests, "ConfigMap"), of_kind(manifests, "Secret")
    for name, (pod, container) in pods(manifests).items():
        claims = of_kind(manifests, "StatefulSet")[name]["spec"].get("volumeClaimTemplates", [])
        assert {mount["name"] for mount in container["volumeMounts"]} == {
            *(volume["name"] for volume in pod["volumes"]),
            *(claim["metadata"]["name"] for claim in claims),
        }
        for volume in pod["volumes"]:
            if "configMap" in volume:
                assert volume["configMap"]["name"] in maps
            if "secret" in volume:
                assert {"ca.pem", "recorder.pem", "recorder.key"} == set(
                    secrets[volume["secret"]["secretName"]]["data"]
                )
    (tls,) = [volume for volume in pods(manifests)["zfusion-node"][0]["volumes"] if volume["name"] == "tls"]
    for i, source in enumerate(tls["projected"]["sources"], 1):
        own = {"ca.pem", f"node-{i}.pem", f"node-{i}.key"}
        assert set(secrets[source["secret"]["name"]]["data"]) == own
        assert {(item["key"], item["path"]) for item in source["secret"]["items"]} == {(x, f"{i}/{x}") for x in own}
    (mount,) = [m for m in pods(manifests)["zfusion-node"][1]["volumeMounts"] if m["name"] == "tls"]
    assert mount["subPathExpr"] == "$(NODE)"
    assert tls["projected"]["defaultMode"] == 0o440


def test_pods_are_restricted(manifests: list[dict[str, Any]]) -> None:
    (namespace,) = of_kind(manifests, "Namespace").values()
    assert namespace["metadata"]["labels"]["pod-security.kubernetes.io/enforce"] == "restricted"
    for pod, container in pods(manifests).values():
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


def test_only_neighbours_are_let_in(manifests: list[dict[str, Any]]) -> None:
    policies = of_kind(manifests, "NetworkPolicy")
    (ingress,) = policies["zfusion-nodes"]["spec"]["ingress"]
    assert ingress["ports"] == [{"protocol": "TCP", "port": 7450}]
    assert "ingress" not in policies["zfusion-recorder"]["spec"]
    labels = of_kind(manifests, "StatefulSet")["zfusion-node"]["spec"]["template"]["metadata"]["labels"]
    selected = policies["zfusion-nodes"]["spec"]["podSelector"]["matchLabels"].items()
    assert selected <= labels.items()
    assert of_kind(manifests, "PodDisruptionBudget")["zfusion-nodes"]["spec"]["selector"]["matchLabels"].items() <= (
        labels.items()
    )
    names = policies["zfusion-egress"]["spec"]["egress"][1]["to"][0]["podSelector"]
    assert "matchLabels" not in names  # to which kustomize would add the swarm's own


def test_commands_in_the_readme_are_there() -> None:
    text = (DEPLOY / "README.md").read_text()
    for line in text.splitlines():
        if line.startswith("    ") and (words := shlex.split(line, comments=True)):
            for word in words:
                if word.startswith(("deploy/", "examples/")) and "field" not in word:
                    assert (ROOT / word).exists(), line
