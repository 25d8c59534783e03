"""zfusion doctor: every failure is made for real, and found with its remedy."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from deployed import deployed as written
from deployed import hosts_document, planned, process, swarm
from swarms import EXAMPLE, ZFUSION, Command, recorded, run_name, variant, wait_until, zfusion
from test_clock_watch import SECOND, Box, ended, three
from zfusion import keys
from zfusion.deploy.authority import read_authority
from zfusion.deploy.folders import write
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.identity import write_private
from zfusion.deploy.plan import Plan
from zfusion.doctor.certificates import check_certificates
from zfusion.doctor.clocks import Discipline, check_clock, check_source, discipline
from zfusion.doctor.disk import AROUND, Room, bytes_per_step, check_disk, judge
from zfusion.doctor.examine import Asked, examine
from zfusion.doctor.finding import Finding, Severity
from zfusion.doctor.ground import Ground, Place, is_own
from zfusion.doctor.limits import (
    available_memory,
    check_files,
    check_governor,
    check_memory,
    check_processors,
    step_seconds,
)
from zfusion.doctor.names import check_names, reach
from zfusion.doctor.namespaces import check_namespaces
from zfusion.doctor.ports import check_ports, why_not
from zfusion.doctor.running import check_running
from zfusion.doctor.scenario import check_scenario
from zfusion.doctor.versions import check_versions
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.simulated import simulate
from zfusion.drivers.transport import on_zenoh_thread, open_session
from zfusion.model.scenario import load_scenario
from zfusion.swarm.ports import free_endpoints

MS = 1_000_000
NOBODY = 65_534


def only(findings: Iterable[Finding]) -> Finding:
    [finding] = findings
    return finding


def severities(findings: Iterable[Finding]) -> list[str]:
    return [str(finding.severity) for finding in findings]


@contextmanager
def an_ordinary_user() -> Iterator[None]:
    """Without root's rights, if we have them."""
    was = os.geteuid()
    os.seteuid(NOBODY if was == 0 else was)
    try:
        yield
    finally:
        os.seteuid(was)


@pytest.fixture
def taken() -> Iterator[str]:
    """An endpoint at which this process listens."""
    [endpoint] = free_endpoints(1)
    with socket.create_server(("127.0.0.1", int(endpoint.rpartition(":")[2]))):
        yield endpoint


def test_an_endpoint_that_is_taken_is_found_with_who_has_it(taken: str) -> None:
    [free] = free_endpoints(1)
    wrong, right = check_ports({taken: "node 1", free: "node 2"}, named=[taken, free])
    assert (wrong.severity, right.severity) == (Severity.ERROR, Severity.OK)
    assert wrong.what.startswith(f"{taken}, of node 1: Address already in use: by ")
    assert f"pid {os.getpid()}" in wrong.what
    assert "another port" in wrong.remedy
    assert right.what == f"free: {free}"
    unnamed = only(check_ports({taken: "node 1"}, named=[]))
    assert unnamed.severity is Severity.WARNING  # launch takes others
    assert "launch takes other ports" in unnamed.why


def test_an_address_of_another_machine_cannot_be_listened_at() -> None:
    assert not is_own("192.0.2.1")
    assert is_own("127.0.0.1")
    wrong = only(check_ports({"tcp/192.0.2.1:7450": "node 1"}, named=()))
    assert wrong.severity is Severity.ERROR
    assert "correct the address" in wrong.remedy
    assert only(check_ports({"unixsock-stream/x": "node 1"}, named=())).severity is Severity.WARNING


def test_a_port_that_takes_a_right_is_refused_to_an_ordinary_user() -> None:
    if int(Path("/proc/sys/net/ipv4/ip_unprivileged_port_start").read_text()) <= 1023:
        pytest.skip("here everybody may use ports below 1024")
    with an_ordinary_user():
        assert why_not(Place("tcp", "127.0.0.1", 1023)) == errno.EACCES
        wrong = only(check_ports({"tcp/127.0.0.1:1023": "node 1"}, named=()))
    assert wrong.severity is Severity.ERROR
    assert "CAP_NET_BIND_SERVICE" in wrong.remedy


def test_places() -> None:
    assert Place.of("tls/[::1]:7450#so_sndbuf=1") == Place("tls", "::1", 7450)
    assert Place.of("quic/name.example:1") == Place("quic", "name.example", 1)
    assert Place.of("unixsock-stream/tmp/socket") is None


def test_who_is_dialled_is_known_and_reached_or_not(taken: str) -> None:
    [free] = free_endpoints(1)
    there, silent, unknown = check_names([taken, free, "tcp/nobody.invalid:7450"])
    assert (there.severity, silent.severity, unknown.severity) == (Severity.OK, Severity.OK, Severity.ERROR)
    assert there.what == f"somebody listens at {taken}"
    assert silent.what.endswith(free)
    assert unknown.what.startswith("tcp/nobody.invalid:7450: the name is not known here")
    assert "/etc/hosts" in unknown.remedy
    assert isinstance(reach(Place("tcp", "a..b", 1), 1.0), str)
    assert reach(Place("udp", "127.0.0.1", 1), 1.0) is None


def test_a_machine_that_does_not_answer_is_found() -> None:
    [endpoint] = free_endpoints(1)
    place = ("127.0.0.1", int(endpoint.rpartition(":")[2]))
    with socket.socket() as server, socket.socket() as first, socket.socket() as second:
        server.bind(place)
        server.listen(0)
        for full in (first, second):
            full.setblocking(False)
            full.connect_ex(place)
        wait_until(lambda: reach(Place("tcp", *place), 0.05) == errno.ETIMEDOUT, "a full backlog")
        wrong = only(check_names([endpoint], timeout_s=0.05))
    assert wrong.severity is Severity.ERROR
    assert "no answer within 0.05 s" in wrong.what
    assert "firewall" in wrong.remedy


@pytest.fixture(scope="module")
def deployed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Plan, Path]:
    """A swarm of two hosts, written."""
    directory = tmp_path_factory.mktemp("deployed")
    hosts = {
        "alpha": {"address": "127.0.0.1", "nodes": [1, 2], "port": 9450},
        "beta": {"address": "beta.example", "nodes": [3, 4], "recorder": True},
    }
    (directory / "hosts.toml").write_text(tomli_w.dumps({"run": "field", "hosts": hosts}))
    scenario = load_scenario(EXAMPLE)
    plan = Plan(scenario, HostsFile.load(directory / "hosts.toml", scenario), "field")
    write(plan, directory / "out")
    return plan, directory / "out"


@pytest.fixture
def folder(deployed: tuple[Plan, Path], tmp_path: Path) -> Path:
    """Alpha's, to be spoilt."""
    shutil.copytree(deployed[1] / "alpha", tmp_path / "alpha")
    return tmp_path / "alpha"


def certificates(deployed: tuple[Plan, Path], folder: Path, **more: Any) -> list[Finding]:
    return list(check_certificates(folder, deployed[0].on("alpha"), "127.0.0.1", **more))


def test_certificates_that_are_good(deployed: tuple[Plan, Path], folder: Path) -> None:
    good = only(certificates(deployed, folder))
    assert good.severity is Severity.OK
    assert good.what.startswith("node-1, node-2: believed by the others until ")


def test_a_certificate_that_expires_soon(deployed: tuple[Plan, Path], folder: Path) -> None:
    soon = datetime.now(UTC) + timedelta(days=810)
    one, two, good = certificates(deployed, folder, now=soon)
    assert severities([one, two, good]) == ["warning", "warning", "ok"]
    assert one.what.endswith("expires in 14 days")
    assert "--renew" in one.remedy


def test_an_expired_certificate(deployed: tuple[Plan, Path], folder: Path) -> None:
    authority = read_authority(deployed[1] / "ca" / "ca.pem", deployed[1] / "ca" / "ca.key")
    start = datetime.now(UTC) - timedelta(days=3)
    certificate, key = authority.issue("node-1", "127.0.0.1", 1, start)
    (folder / "tls" / "node-1.pem").write_bytes(certificate)
    write_private(folder / "tls" / "node-1.key", key)
    wrong, good = certificates(deployed, folder)
    assert wrong.severity is Severity.ERROR
    assert "expired" in wrong.what
    assert "--renew" in wrong.remedy
    assert good.what.startswith("node-2: ")


def test_keys_that_others_may_read_and_files_that_nobody_can(deployed: tuple[Plan, Path], folder: Path) -> None:
    (folder / "tls" / "node-1.key").chmod(0o640)
    (folder / "tls" / "node-2.key").chmod(0o644)
    group, world, good = certificates(deployed, folder)
    assert (group.severity, world.severity) == (Severity.WARNING, Severity.ERROR)
    assert group.remedy.startswith("chmod 600")
    assert world.remedy == "chmod 600 it"
    assert good.what.startswith("node-1: ")
    with an_ordinary_user():
        if os.access(folder / "tls" / "node-1.key", os.R_OK, effective_ids=True):
            (folder / "tls" / "node-1.key").chmod(0)
        unreadable = certificates(deployed, folder)[0]
    assert unreadable.severity is Severity.ERROR
    assert "cannot be read" in unreadable.what
    assert unreadable.remedy
    (folder / "tls" / "ca.pem").unlink()
    assert severities(certificates(deployed, folder)) == ["error", "error"]


def test_another_process_certificate_and_another_address(deployed: tuple[Plan, Path], folder: Path) -> None:
    for suffix in ("pem", "key"):
        shutil.copy(folder / "tls" / f"node-2.{suffix}", folder / "tls" / f"node-1.{suffix}")
    wrong = certificates(deployed, folder)[0]
    assert wrong.severity is Severity.ERROR
    assert "it is the certificate of 'node-2'" in wrong.what
    assert "made for it" in wrong.remedy
    elsewhere = list(check_certificates(folder, deployed[0].on("alpha"), "10.9.9.9"))
    assert severities(elsewhere) == ["error", "error"]
    assert "another address" in elsewhere[0].what
    assert "--renew" in elsewhere[0].remedy


def test_room_for_the_recording(tmp_path: Path) -> None:
    def of(free: int, speed: float, rate_hz: float | None = 10.0, steps: int = 1000) -> list[str]:
        return severities(judge(tmp_path, Room(free, speed), 1000, rate_hz, steps))

    assert of(10**12, 1e8) == ["ok", "ok"]
    assert of(10**12, 1e8, None) == ["ok", "ok"]
    assert of(2 * 10**6, 1e8) == ["warning", "ok"]  # 200 s of it
    assert of(10**5, 1e8) == ["error", "ok"]
    assert of(10**12, 1e4) == ["ok", "error"]
    findings = list(check_disk(tmp_path / "made" / "later", 1000, 10.0, 100))
    assert findings[0].severity is not Severity.ERROR
    assert not list(tmp_path.iterdir())  # nothing is left


def test_what_a_step_takes_on_a_recording_is_about_what_it_does(tmp_path: Path) -> None:
    scenario = load_scenario(EXAMPLE, steps=40)
    simulate(scenario, run="size", output=tmp_path / "size.mcap")
    took = sum(len(m.data) + AROUND for m in recorded(tmp_path / "size.mcap"))
    assert 0.8 < took / (40 * bytes_per_step(scenario)) < 1.25


def test_a_full_disk_and_one_that_cannot_be_written(tmp_path: Path) -> None:
    nowhere = only(check_disk(Path("/proc/nowhere"), 1000, 10.0, 100))
    assert nowhere.severity is Severity.ERROR
    assert "recording.directory" in nowhere.remedy
    if os.geteuid() != 0 or not shutil.which("unshare"):
        pytest.skip("a file system of its own needs root")
    full = tmp_path / "full"
    full.mkdir()
    scenario = variant(tmp_path, recording={"directory": str(full)})
    mount = f'mount -t tmpfs -o size=64k none {full} && exec "$@"'
    try:
        result = Command(
            tmp_path, "doctor", scenario, "--json", program=["unshare", "-m", "sh", "-c", mount, "sh", *ZFUSION]
        ).wait()
    finally:
        full.rmdir()
    wrong = [f for f in json.loads(result.out)["findings"] if f["topic"] == "disk"]
    assert result.code == 1
    assert [(f["severity"], f["what"]) for f in wrong] == [("error", f"{full}: {os.strerror(errno.ENOSPC)}")]
    assert "make room" in wrong[0]["remedy"]


def test_what_is_installed() -> None:
    installed = {"numpy": "2.4.6", "msgpack": "0.9", "cvxpy": "1.5.1rc1"}

    def version(name: str) -> str:
        if name not in installed:
            raise PackageNotFoundError(name)
        return installed[name]

    lines = [
        "numpy>=2.0",
        "msgpack<2,>=1.1",
        "mcap<2,>=1.6",
        "cvxpy>=1.5; extra == 'design'",
        "jinja2; extra == 'experiments'",
    ]
    old, *rest = check_versions(lines, version, (3, 10, 1))
    assert (old.severity, old.what) == (Severity.ERROR, "Python 3.10.1")
    assert [(f.severity, f.what) for f in rest] == [
        (Severity.ERROR, "msgpack: version 0.9, where >=1.1 is needed"),
        (Severity.ERROR, "mcap: not installed"),
        (Severity.OK, "numpy 2.4.6"),
        (Severity.OK, "extra design"),
        (Severity.WARNING, "extra experiments: jinja2 missing or too old"),
    ]
    assert rest[1].remedy == "pip install 'mcap<2,>=1.6'"
    assert rest[-1].remedy == "pip install 'zfusion[experiments]'"
    assert "error" not in severities(check_versions())


def test_clocks(tmp_path: Path) -> None:
    def of(told: Discipline | None, limit_ns: int | None = 10 * MS) -> Finding:
        return only(check_clock(told, limit_ns, several_machines=True))

    assert of(Discipline(True, 0.001)).severity is Severity.OK
    assert of(Discipline(True, 0.2)).severity is Severity.WARNING
    assert of(Discipline(True, 0.2), None).severity is Severity.OK
    unsynchronised = of(Discipline(False, 16.0))
    assert unsynchronised.severity is Severity.WARNING
    assert "chrony" in unsynchronised.remedy
    assert of(None).severity is Severity.WARNING
    assert only(check_clock(None, 1, several_machines=False)).severity is Severity.OK
    told = discipline()
    assert told is None or told.most_wrong_s >= 0
    (tmp_path / "source").write_text("hpet\n")
    assert "clocksource=tsc" in only(check_source(tmp_path / "source")).remedy
    assert not list(check_source(tmp_path / "none"))


def test_limits(tmp_path: Path) -> None:
    few = only(check_files(30, limit=100))
    assert (few.severity, few.remedy) == (Severity.ERROR, "ulimit -n 184, or LimitNOFILE=184 in the unit")
    assert only(check_files(3)).severity is Severity.OK
    assert only(check_memory(10, 100 << 20)).severity is Severity.ERROR
    assert only(check_memory(1, available_memory() or 1 << 30)).severity is Severity.OK
    assert not list(check_memory(1, available_memory(tmp_path / "none")))
    loads = [only(check_processors(n, 100.0, 0.0005, 2)).severity for n in (1, 18, 30)]
    assert loads == [Severity.OK, Severity.WARNING, Severity.ERROR]
    assert only(check_processors(4, None, 0.001, 2)).what.endswith("some 333 rounds a second")
    assert "not tried" in only(check_processors(4, 10.0, None, 2)).what
    assert 0 < (step_seconds(load_scenario(EXAMPLE)) or 0) < 1
    assert step_seconds(load_scenario(EXAMPLE.with_name("host.toml"))) is None
    (tmp_path / "governor").write_text("powersave\n")
    assert "performance" in only(check_governor(tmp_path / "governor")).remedy


def test_scenarios_that_are_wrong_and_methods_without_their_design(tmp_path: Path) -> None:
    assert check_scenario(EXAMPLE)[0] is not None
    path = variant(tmp_path, timing={"rate_hz": -1.0}, steps=0)
    scenario, findings = check_scenario(path)
    assert scenario is None
    assert severities(findings) == ["error", "error"]
    assert any("timing.rate_hz is -1.0" in f.what and "> 0" in f.remedy for f in findings)
    assert "error" in severities(check_scenario(tmp_path / "none.toml")[1])
    read, [_, undesigned] = check_scenario(EXAMPLE.with_name("stationary.toml"))
    assert read is not None
    assert undesigned.severity is Severity.WARNING
    assert "zfusion design" in undesigned.remedy


def test_namespaces_are_tried_and_what_they_cannot_do_is_told(tmp_path: Path) -> None:
    tried = only(check_namespaces(load_scenario(EXAMPLE)))
    assert tried.topic == "netns"
    assert tried.what.startswith("launch --netns would use") or "root" in tried.remedy
    cannot = only(check_namespaces(load_scenario(variant(tmp_path, links={"duplicate": 0.1}))))
    assert cannot.severity is Severity.WARNING
    assert "links.duplicate" in cannot.what


def test_nodes_that_run_are_asked_for_their_scenario_and_clock(tmp_path: Path) -> None:
    file, run = three(tmp_path, nodes=2), run_name("asked")
    scenario = load_scenario(file)
    box = Box(tmp_path, "away", 3 * SECOND)
    node = Command(tmp_path, "node", file, "--run", run, "--id", 1, program=box.zfusion)
    reachable = [scenario.endpoint(1)]
    place = Place.of(reachable[0])
    assert place is not None
    with ended([node]):
        wait_until(lambda: reach(place, 1.0) is None, "the node")
        wrong = only(check_running(Ground(scenario, run), reachable, 10 * MS))
        other = load_scenario(file, method="local")
        stranger, _ = check_running(Ground(other, run), reachable, None)
        node.interrupt()
        node.wait()
    assert wrong.severity is Severity.ERROR
    told = re.fullmatch(r"node 1: joining, step 0; its clock is ([\d.]+) s ahead, to within ([\d.]+) ms", wrong.what)
    assert told is not None, wrong.what
    offset_s, uncertainty_ms = map(float, told.groups())
    assert abs(offset_s - 3) * 1000 <= uncertainty_ms + 1  # both are rounded
    assert "timing.max_clock_offset_s" in wrong.remedy
    assert stranger.severity is Severity.ERROR
    assert "node 1 runs scenario" in stranger.what
    assert "the same scenario" in stranger.remedy
    assert not list(check_running(Ground(scenario, run), [], None))  # nobody listens: nobody is asked


def stand_still(node: Command) -> None:
    """As by Ctrl-Z: its port stays open, and nobody answers there."""
    node.process.send_signal(signal.SIGSTOP)
    stat = Path(f"/proc/{node.process.pid}/stat")
    wait_until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T", "it stands still")


def test_a_node_that_stands_still_beside_others_is_an_error(tmp_path: Path) -> None:
    file, run = three(tmp_path, nodes=2), run_name("still")
    scenario = load_scenario(file)
    endpoints = [scenario.endpoint(i) for i in scenario.ids]
    nodes = [Command(tmp_path, "node", file, "--run", run, "--id", i, "--forever") for i in scenario.ids]
    with ended(nodes):
        wait_until(lambda: all("begins with step 1" in node.said() for node in nodes), "they run")
        other = only(check_running(Ground(scenario, "other"), endpoints, None))
        stand_still(nodes[1])
        wrong, right = check_running(Ground(scenario, run), endpoints, None)
    assert (wrong.severity, right.severity) == (Severity.ERROR, Severity.OK)
    assert wrong.what == f"node 2 of run {run}: not seen, though somebody listens at {endpoints[1]}"
    assert "stands still" in wrong.why
    assert right.what.startswith("node 1: running, ")
    assert other.severity is Severity.OK  # that the ports are taken is told elsewhere
    assert other.what.startswith("no node of run other shows itself: ")


def test_nodes_that_do_not_answer_or_not_legibly_are_errors() -> None:
    scenario, [endpoint] = load_scenario(EXAMPLE), free_endpoints(1)
    ground = Ground(scenario, "r")
    with open_session(Endpoints(listen=(endpoint,))) as session:
        tokens = [session.liveliness().declare_token(keys.node_token("r", i)) for i in (1, 3)]
        key = keys.status_key("r", 3)

        def babble(query: Any) -> None:
            with query:
                query.reply(key, b"babble")

        queryable = session.declare_queryable(key, on_zenoh_thread(babble))
        unread, silent = check_running(ground, [endpoint], None)
        for declared in (*tokens, queryable):
            declared.undeclare()
        nobody = only(check_running(ground, [endpoint], None))
    assert (unread.severity, silent.severity) == (Severity.ERROR, Severity.ERROR)
    assert unread.what == "node 3: answered what this version does not know"
    assert silent.what == "node 1: there, and does not answer"
    assert nobody.severity is Severity.OK
    assert nobody.what.startswith("no node of run r shows itself")


def test_a_door_of_another_machine_behind_which_nobody_shows_himself_is_no_all_clear(tmp_path: Path) -> None:
    plan = planned(tmp_path, hosts_document(security={"enabled": False}))
    ground, door = Ground(plan.scenario, plan.run, plan, "a"), process(plan, "node-3").listen[0]
    assert ground.doors[process(plan, "node-1").listen[0]] == 1
    with open_session(Endpoints(listen=(door,))):
        hidden = only(check_running(ground, [door], None))
    assert hidden.severity is Severity.WARNING
    assert hidden.what == f"node 3 of run {plan.run}: not seen, though somebody listens at {door}"
    assert "--run" in hidden.remedy


def test_who_may_not_be_asked_is_said_to_be_there(tmp_path: Path) -> None:
    plan = written(tmp_path, hosts_document(security={"observer_reads": ["estimate"]}), steps=100_000)
    desk = process(plan, "observer")
    words = (tmp_path / "field.toml", "--hosts", tmp_path / "hosts.toml", "--host", desk.host, "--folder", "..")
    with swarm(plan, tmp_path / "out") as running:
        wait_until(running.steps_taken, "steps are taken")
        stand_still(running.commands["node-2"])
        found = zfusion(tmp_path / "out" / desk.host, "doctor", *words, "--zenoh-config", desk.zenoh_file, "--json")
    unasked, hidden = (Finding(**f) for f in found.summary["findings"] if f["topic"] == "running")
    assert (unasked.severity, hidden.severity) == (Severity.WARNING, Severity.ERROR)
    assert unasked.what.startswith("node 1, node 3, node 4: there, and may not be asked by ")
    assert "security.observer_reads" in unasked.remedy
    assert hidden.what.startswith(f"node 2 of run {plan.run}: not seen")


def test_the_command_ends_with_one_where_there_is_an_error_and_fits_on_a_screen(tmp_path: Path, taken: str) -> None:
    fine = variant(tmp_path, "fine")
    result = zfusion(tmp_path, "doctor", fine, "--json")
    assert result.code == 0, result.out
    topics = {f["topic"] for f in result.summary["findings"]}
    warnings = sum(f["severity"] == "warning" for f in result.summary["findings"])  # of this machine, if any
    assert topics == {"versions", "scenario", "ports", "clocks", "disk", "limits", "netns"}
    endpoints = dict(zip("1234", [*free_endpoints(3), taken], strict=True))
    wrong = variant(tmp_path, "wrong", transport={"endpoints": endpoints})
    command = Command(tmp_path, "doctor", wrong, program=["env", "COLUMNS=80", *ZFUSION])
    shown = command.wait()
    assert shown.code == 1
    assert f"{taken}, of node 4" in shown.out
    assert shown.out.splitlines()[-1] == f"errors: 1, warnings: {warnings}"
    assert all(len(line.rstrip()) <= 80 for line in shown.out.splitlines())
    hosts = list(examine(Asked(fine, hosts=tmp_path / "none.toml")))
    assert any("none.toml" in f.what for f in hosts if f.severity is Severity.ERROR)


def test_pods_are_not_looked_for_outside_of_their_cluster() -> None:
    hosts = EXAMPLE.parents[1] / "deploy" / "kubernetes" / "hosts.toml"
    findings = [f for f in examine(Asked(EXAMPLE, hosts=hosts)) if f.topic in {"hosts", "names", "ports", "running"}]
    none, *_ = findings
    assert [f.severity for f in findings] == [Severity.WARNING]
    assert "none of the pods" in none.what
    inside = list(examine(Asked(EXAMPLE, hosts=hosts, host="zfusion-node-4")))
    assert any("zfusion-nodes" in f.what for f in inside if f.topic == "names")


def test_a_deployed_host_is_recognised_by_its_address(deployed: tuple[Plan, Path]) -> None:
    _, out = deployed
    result = zfusion(out.parent, "doctor", EXAMPLE, "--hosts", out.parent / "hosts.toml", "--folder", out, "--json")
    findings = result.summary["findings"]
    said = {f["topic"]: f for f in findings}
    assert result.code == 0, findings
    assert said["hosts"]["what"] == "this machine is alpha, and runs node-1, node-2"
    assert said["certificates"]["severity"] == "ok"
    assert "disk" not in said  # the recorder is beta's
