"""Deployed swarms on hosts of their own, started by what is written for systemd and for containers, word for word.

Each host is a network namespace; each process is an ordinary user (where such a one cannot run the interpreter, a root
without any capability), in a directory in which it finds what its unit or its container shows it, and nothing else.
Needs root and the kernel for it; where they are missing, the tests say so and are skipped.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from deployed import SPREAD, planned
from namespaces import Hosts, hosts, why_none
from services import Service, services_of, write_all
from supervisors import Systemd
from swarms import ZFUSION, Command, run_name, wait_until, zfusion
from zfusion.deploy.plan import Plan
from zfusion.drivers.notify import Health

NOBODY = 61_234
"""Nobody's id."""


def as_user(user: int) -> tuple[str, ...]:
    """The words before a command that have it run as an ordinary user, or as a root that may do no more than one."""
    return (
        "setpriv",
        f"--reuid={user}",
        f"--regid={user}",
        "--clear-groups",
        "--no-new-privs",
        "--inh-caps=-all",
        "--bounding-set=-all",
        "env",
    )


STEPS = 10


def runs_zfusion(user: int) -> bool:
    """Whether such a user can: the interpreter may be in root's own directory."""
    words = [*as_user(user), sys.executable, "-c", "import zfusion.drivers.notify"]
    return subprocess.run(words, check=False, capture_output=True, cwd="/", timeout=60).returncode == 0


TROUBLE = why_none()

pytestmark = pytest.mark.skipif(TROUBLE is not None, reason=f"no network namespaces here: {TROUBLE}")


@pytest.fixture(scope="module")
def user() -> int:
    """Whom services run as."""
    return NOBODY if runs_zfusion(NOBODY) else 0


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory that ordinary users reach, too."""
    with tempfile.TemporaryDirectory(prefix="zfusion-") as made:
        Path(made).chmod(0o755)
        yield Path(made)


def show(service: Service, folder: Path, directory: Path, user: int) -> None:
    """Lay out what a service sees of its host's folder, readable by its group, as the READMEs have it."""
    directory.mkdir()
    whole = {name.name: name.name for name in folder.iterdir() if name.name not in {"tls", "systemd"}}
    seen = service.seen if "scenario.toml" in service.seen or service.name.startswith("router") else {}
    for target, source in (seen or whole | service.seen).items():
        (directory / target).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (folder / source).is_dir() else shutil.copy
        copy(folder / source, directory / target)
    subprocess.run(["chown", "-R", f"0:{user}", str(directory)], check=True)
    subprocess.run(["chmod", "-R", "u=rwX,g=rX,o=", str(directory)], check=True)
    for name in service.writable:
        shutil.chown(directory / name, user, user)


class Running:
    """The services of a deployment, each with a systemd of its own to talk to."""

    def __init__(self, kind: str, plan: Plan, place: Path, made: Hosts, stack: ExitStack, user: int) -> None:
        self.place = place
        self.commands: dict[str, Command] = {}
        self.systemds: dict[str, Systemd] = {}
        for service in services_of(kind, plan, place / "out"):
            directory = place / service.name
            show(service, place / "out" / service.host, directory, user)
            systemd = self.systemds[service.name] = stack.enter_context(Systemd(str(place / f"{service.name}.notify")))
            Path(systemd.address).chmod(0o777)
            environment = service.environment | {"NOTIFY_SOCKET": systemd.address, "HOME": "/nonexistent"}
            if "ZFUSION_HEALTH_FILE" in environment:
                (place / f"{service.name}.run").mkdir()
                shutil.chown(place / f"{service.name}.run", user)
                environment["ZFUSION_HEALTH_FILE"] = str(place / f"{service.name}.run" / "health")
            settings = [f"{name}={value}" for name, value in environment.items()]
            entrance = (*made.entrance(service.host), *as_user(user), *settings)
            command = self.commands[service.name] = Command(directory, *service.words, program=(*entrance, *ZFUSION))
            stack.callback(command.process.wait)
            stack.callback(command.process.kill)

    def health(self, name: str) -> Health:
        return Health.read(self.place / f"{name}.run" / "health")

    def heard(self) -> None:
        """Nobody is kept waiting."""
        for systemd in self.systemds.values():
            systemd.heard()

    def all_ready(self) -> bool:
        self.heard()
        for name, command in self.commands.items():
            assert command.process.poll() in {None, 0}, (name, command.said())
        return all(systemd.said("READY=1") for systemd in self.systemds.values())

    def ended(self) -> bool:
        self.heard()
        return all(c.process.poll() is not None for name, c in self.commands.items() if not name.startswith("router"))


def a_stranger_is_kept_out(directory: Path) -> None:
    """Another ordinary user cannot read a key."""
    for key in directory.glob("*/tls/*.key"):
        words = ["setpriv", f"--reuid={NOBODY + 1}", f"--regid={NOBODY + 1}", "--clear-groups", "cat", str(key)]
        assert subprocess.run(words, capture_output=True, check=False).returncode != 0


@pytest.mark.parametrize(("kind", "topology"), [("systemd", "direct"), ("compose", "router")])
def test_as_they_are_started(place: Path, user: int, kind: str, topology: str) -> None:
    spread = dict(SPREAD) | ({"gate": {"router": True}} if topology == "router" else {})
    with hosts(spread) as made, ExitStack() as stack:
        document = {
            "run": run_name(kind),
            "topology": topology,
            "hosts": {name: {"address": made.addresses[name], **what} for name, what in spread.items()},
        }
        plan = planned(place, document, steps=STEPS, timing={"rate_hz": 10.0})
        write_all(plan, place / "out")
        running = Running(kind, plan, place, made, stack, user)
        wait_until(running.all_ready, "all are ready")
        if kind == "compose":
            assert all(running.health(f"node-{i}").pid for i in plan.scenario.ids)
            told = zfusion(place, "health", place / "recorder.run" / "health", "--json")
            assert "status" in told.summary
        a_stranger_is_kept_out(place)
        wait_until(running.ended, "the run's end")
        for name, command in running.commands.items():
            if name.startswith("router"):
                command.process.terminate()
                wait_until(lambda: running.heard() or command.process.poll() is not None, "the router's end")  # noqa: B023
            assert command.process.returncode == 0, (name, command.said())
            assert running.systemds[name].said("STOPPING=1")
        (recording,) = (place / "recorder" / "recordings").iterdir()
        assert recording.stat().st_uid == user
        verdict = zfusion(place, "replay", recording, "--verify", "--json")
        assert verdict.code == 0, verdict.err
