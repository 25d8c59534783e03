"""Units, compose files and the image: held against the tools that read them, and against the plan."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from deployed import hosts_document, planned
from services import ROOT, plan_of, services_of, tool, write_all
from zfusion.deploy.compose import SHARED
from zfusion.deploy.plan import Plan
from zfusion.deploy.systemd import SERVED

DEPLOY = ROOT / "deploy"

EXPOSURE = 2.0
"""What `systemd-analyze security` may say at most, of 10: its word for up to 2 is OK."""

SYSTEMD_S_OWN = ("sysinit", "basic", "shutdown", "multi-user", "network-online", "time-sync")
"""Targets that units refer to."""

SCHEMA = json.loads((ROOT / "tests" / "schemas" / "compose-spec.json").read_text())


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
    made = plan_of(DEPLOY / "hosts.example.toml")
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
    plan = plan_of(DEPLOY / "compose.hosts.toml")
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


def test_commands_in_the_readme_are_there() -> None:
    text = (DEPLOY / "README.md").read_text()
    for line in text.splitlines():
        if line.startswith("    ") and (words := shlex.split(line, comments=True)):
            for word in words:
                if word.startswith(("deploy/", "examples/")) and "field" not in word:
                    assert (ROOT / word).exists(), line
