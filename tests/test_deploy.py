"""Hosts files, plans and the folders that are made of them."""

from __future__ import annotations

import json
import socket
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
import zenoh

from deployed import deployed, hosts_document, planned, process
from swarms import EXAMPLE, zfusion
from zfusion import keys
from zfusion.deploy.access import Speech, access_control
from zfusion.deploy.authority import read_authority
from zfusion.deploy.compose import write_compose
from zfusion.deploy.folders import write
from zfusion.deploy.hosts import HostsFile
from zfusion.deploy.identity import write_private
from zfusion.deploy.plan import Plan, Process
from zfusion.deploy.systemd import write_units
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import may_ask, open_session
from zfusion.errors import InputError, ScenarioError
from zfusion.model.scenario import load_scenario

DEPLOY = Path(__file__).parents[1] / "deploy"


def problems(tmp_path: Path, text: str) -> list[str]:
    """What is wrong with a hosts file, without its name."""
    path = tmp_path / "hosts.toml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        HostsFile.load(path, load_scenario(EXAMPLE))
    return [str(problem) for problem in caught.value.problems]


def test_fields_are_checked(tmp_path: Path) -> None:
    found = problems(
        tmp_path,
        """
        topolgy = "direct"
        run = "-x"
        [hosts.a]
        address = "999.1.1.1"
        nodes = [1, "2"]
        port = 70000
        [security]
        days = 0
        """,
    )
    assert [line.split(":")[0] for line in found] == [
        "run",
        "hosts.a.address",
        "hosts.a.nodes[1]",
        "hosts.a.port",
        "security.days",
        "topolgy",
    ]
    assert "did you mean 'topology'?" in found[-1]


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "224.0.0.1", "ff02::1", "fe80::1%eth0", "1.2.3", "-x.org"])
def test_an_address_is_one_machines(tmp_path: Path, address: str) -> None:
    [found] = problems(tmp_path, f'[hosts.a]\naddress = "{address}"\nnodes = [1, 2, 3, 4]')
    assert found.startswith("hosts.a.address: expected ")


def test_names_are_the_same_in_capitals(tmp_path: Path) -> None:
    placed = (("a", "Sensor.example", [1, 2]), ("b", "sensor.example", [3, 4]))
    hosts = [f'[hosts.{name}]\naddress = "{address}"\nnodes = {nodes}' for name, address, nodes in placed]
    [found] = problems(tmp_path, "\n".join(hosts))
    assert found.startswith("hosts.b.port: expected ports that a at the same address does not use")


def test_no_stop_is_planned_where_nobody_sets_going_again(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"scenario: faults\[0\]: expected no stop"):
        planned(tmp_path, hosts_document(), faults=[{"kind": "stop", "node": 2, "step": 20, "steps": 5}])


def test_placement_roles_and_ports_are_checked(tmp_path: Path) -> None:
    found = problems(
        tmp_path,
        """
        [hosts.a]
        address = "10.0.0.1"
        nodes = [1, 2, 2, 9]
        recorder = true
        [hosts.b]
        address = "10.0.0.1"
        nodes = [3]
        port = 7451
        recorder = true
        router = true
        [hosts.ca]
        address = "gateway.example.org"
        [security]
        enabled = false
        certificates = "mine"
        observer_reads = ["estimates"]
        """,
    )
    assert [line.partition(" (is ")[0] for line in found] == [
        "hosts.a.nodes[2]: expected each node once, this one is on a already",
        "hosts.a.nodes[3]: expected a node of the scenario: 1, 2, 3, 4",
        "hosts: expected node 4 on one of them",
        "hosts.b.recorder: expected one recorder at most, a has one",
        'hosts.b.router: expected no router where topology = "direct"',
        "hosts.ca: expected a name of at most 51 letters, digits, '_' and '-', and not 'ca'",
        "hosts.ca: expected something to run: nodes, recorder, observer or router",
        "hosts.b.port: expected ports that a at the same address does not use",
        "security.observer_reads[0]: expected one of measurement, intermediate, estimate, event, arrivals, revised, "
        "truth, status, history",
        "security.certificates: expected none where enabled = false",
    ]
    assert problems(tmp_path, 'topology = "router"\n[hosts.a]\naddress = "a"\nnodes = [1, 2, 3, 4]') == [
        "topology: expected a host with router = true (is 'router')"
    ]
    assert problems(tmp_path, "hosts = 3")[0].startswith("hosts: expected a table")


def test_the_larger_id_dials_and_readers_dial_all(tmp_path: Path) -> None:
    scenario = load_scenario(EXAMPLE)
    plan = Plan(scenario, HostsFile.load(DEPLOY / "hosts.example.toml", scenario), "field")
    at = ["tls/10.0.0.1:7450", "tls/10.0.0.1:7451", "tls/10.0.0.2:7450", "tls/10.0.0.3:7450"]
    for n, i in enumerate(scenario.ids):
        node = process(plan, f"node-{i}")
        assert (node.mode, node.listen, node.connect) == ("peer", (at[n],), tuple(at[:n]))
    for name in ("recorder", "observer"):
        assert (process(plan, name).listen, process(plan, name).connect) == ((), tuple(at))
    assert plan.command(process(plan, "node-3")) == (
        *("zfusion", "node", "scenario.toml", "--run", "field", "--zenoh-config", "zenoh/node-3.json5"),
        *("--id", "3", "--await-recorder"),
    )
    assert {one.host for one in plan.on("gamma")} == {"gamma"}


def test_clients_prefer_the_router_of_their_host(tmp_path: Path) -> None:
    document = hosts_document("router")
    document["hosts"]["b"] |= {"router": True, "bind": "0.0.0.0"}
    plan = planned(tmp_path, document)
    a, b = (f"tls/127.0.0.1:{document['hosts'][name]['port']}" for name in ("a", "b"))
    assert process(plan, "node-1").connect == (a, b)
    assert process(plan, "node-3").connect == (b, a)
    assert process(plan, "node-4").connect == (a, b)
    assert process(plan, "router-b").listen == (b.replace("127.0.0.1", "0.0.0.0"),)
    assert (process(plan, "router-a").connect, process(plan, "router-b").connect) == ((), (a,))
    assert process(plan, "node-1").mode == "client"


def allowed(rules: dict[str, Any], name: str, flow: str, message: str) -> set[str]:
    """The keys that the rules of one process let through in a message of another."""
    [policy] = [policy for policy in rules["policies"] if policy["subjects"] == [name]] or [{"rules": []}]
    return {
        key
        for rule in rules["rules"]
        if rule["id"] in policy["rules"] and flow in rule["flows"] and message in rule["messages"]
        for key in rule["key_exprs"]
    }


def test_rules_are_the_adjacency_matrix(tmp_path: Path) -> None:
    plan = planned(tmp_path, hosts_document())
    speech, run, graph = Speech(plan), plan.run, plan.scenario.network
    for i in graph.ids:
        rules = access_control(plan, process(plan, f"node-{i}"), speech)
        assert rules["default_permission"] == "deny"
        for j in set(graph.ids) - {i}:
            heard = (
                {keys.stage_key(run, j, s) for s in ("measurement", "intermediate")}
                if j in graph.neighbours(i)
                else set()
            )
            assert allowed(rules, f"node-{j}", "ingress", "put") == heard
            assert allowed(rules, f"node-{j}", "egress", "declare_subscriber") == heard
            asked = allowed(rules, f"node-{j}", "egress", "query")
            assert asked == {keys.status_key(run, j)} | ({keys.history_key(run, j)} if heard else set())
            assert allowed(rules, f"node-{j}", "ingress", "liveliness_token") == {keys.node_token(run, j)}
        for silent in ("recorder", "observer"):
            assert allowed(rules, silent, "ingress", "put") == set()
        assert allowed(rules, "recorder", "ingress", "declare_subscriber") == {keys.whole_run(run)}
        assert keys.stage_key(run, i, "measurement") not in allowed(rules, "observer", "egress", "put")
        assert not {
            key for rule in rules["rules"] for key in rule["key_exprs"] if not key.startswith(f"zfusion/{run}/")
        }


def test_rules_agree_between_the_ends_of_every_link(tmp_path: Path) -> None:
    """What one lets out, the other lets in: through routers, too."""
    for topology in ("direct", "router"):
        plan = planned(tmp_path, hosts_document(topology))
        speech = Speech(plan)
        rules = {one.name: access_control(plan, one, speech) for one in plan.processes}
        links = [("node-1", "node-2"), ("node-4", "recorder")] if topology == "direct" else [("node-1", "router-a")]
        for (a, b), message in ((link, m) for link in links for m in ("put", "query", "reply", "liveliness_token")):
            assert allowed(rules[a], b, "egress", message) == allowed(rules[b], a, "ingress", message)
            assert allowed(rules[b], a, "egress", message) == allowed(rules[a], b, "ingress", message)


def test_who_may_ask_is_read_from_a_configuration(tmp_path: Path) -> None:
    file = Path(process(deployed(tmp_path, hosts_document(run="r")), "observer").zenoh_file)
    assert may_ask(keys.status_key("r", 3), tmp_path / "out" / "c" / file)
    assert not may_ask(keys.history_key("r", 3), tmp_path / "out" / "c" / file)
    own = {"enabled": True, "default_permission": "allow"}
    rule = {"id": "x", "messages": ["query"], "permission": "deny", "key_exprs": ["zfusion/*/node/3/**"]}
    (tmp_path / "own.json5").write_text(json.dumps({"access_control": own | {"rules": [rule]}}))
    assert [may_ask(keys.status_key("r", i), tmp_path / "own.json5") for i in (1, 3)] == [True, False]
    assert may_ask(keys.history_key("r", 3), None)


def test_a_users_program_may_only_publish_its_sensors_readings(tmp_path: Path) -> None:
    plan = planned(tmp_path, hosts_document(), source={"kind": "zenoh", "key": "plant/{id}/level"})
    rules = access_control(plan, process(plan, "node-3"), Speech(plan))
    assert allowed(rules, "sensor-3", "ingress", "put") == {"plant/3/level"}
    assert allowed(rules, "sensor-4", "ingress", "put") == set()
    assert process(plan, "sensor-3").connect == process(plan, "node-3").listen
    assert plan.command(process(plan, "sensor-3")) == ()


def modes(directory: Path) -> dict[str, int]:
    return {str(path.relative_to(directory)): path.stat().st_mode & 0o777 for path in directory.rglob("*")}


def contents(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def test_folders_are_complete_and_can_be_written_again(tmp_path: Path) -> None:
    plan = deployed(tmp_path, hosts_document())
    out = tmp_path / "out"
    found = modes(out)
    for one in plan.processes:
        assert found[f"{one.host}/{one.key}"] == 0o600
        assert f"{one.host}/{one.certificate}" in found
        assert zenoh.Config.from_file(str(out / one.host / one.zenoh_file)).get_json("mode") == json.dumps(one.mode)
    assert {found[name] for name in ("a", "a/tls", "ca", "b/tls")} == {0o700}
    assert found["ca/ca.key"] == 0o600
    assert not [name for name in found if name.endswith("ca.key") and name != "ca/ca.key"]
    assert load_scenario(out / "a" / "scenario.toml").fingerprint == plan.scenario.fingerprint
    before = contents(out)
    assert write(plan, out).certificates_made == []
    assert contents(out) == before
    renewed = write(plan, out, renew=True)
    assert len(renewed.certificates_made) == 6
    after = contents(out)
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {f"{one.host}/{name}" for one in plan.processes for name in (one.key, one.certificate)}


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("irreplaceable")
    document = hosts_document()
    with pytest.raises(InputError, match="expected an empty directory, or one that zfusion deploy has written"):
        deployed(tmp_path, document)
    (out / "thesis.tex").unlink()
    deployed(tmp_path, document)
    (out / "d").mkdir()
    document["hosts"]["d"] = document["hosts"].pop("c") | {"observer": False}
    with pytest.raises(InputError, match="expected nothing here: zfusion deploy has not written it"):
        deployed(tmp_path, document)
    (out / "d").rmdir()
    plan = deployed(tmp_path, document)
    assert write(plan, out).stale == ["c"]
    with pytest.raises(InputError, match="this is the deployment of another run"):
        write(Plan(plan.scenario, plan.hosts, "other"), out)


def test_who_has_moved_leaves_nothing_behind(tmp_path: Path) -> None:
    """Node 2 from a to b; the recorder and node 4 to d. What the user has put beside them stays."""
    document, units = hosts_document(), (write_units, write_compose)
    write(planned(tmp_path, document), out := tmp_path / "out", more=units)
    (out / "b" / "recordings" / "field.mcap").write_bytes(b"precious")
    (out / "a" / "tls" / "mine.pem").write_bytes(b"mine")
    hosts = document["hosts"]
    hosts["a"]["nodes"], hosts["b"] = [1], {**hosts["b"], "nodes": [2, 3], "recorder": False}
    hosts["c"], hosts["d"] = {**hosts["c"], "nodes": []}, {"address": "127.0.0.9", "nodes": [4], "recorder": True}
    plan = planned(tmp_path, document)
    written = write(plan, out, more=units)
    assert {"a/tls/node-2.key", "a/zenoh/node-2.json5", "b/tls/recorder.key", "c/compose.yaml"} <= set(written.removed)
    for one in ("a", "b", "c", "d"):
        mine = {Path(process.key).name for process in plan.on(one)}
        assert {path.name for path in (out / one / "tls").glob("*.key")} == mine
        assert {path.stem for path in (out / one / "zenoh").iterdir()} == {Path(key).stem for key in mine}
    assert not (out / "c" / "systemd").exists()
    assert "recorder" not in "".join(path.name for path in (out / "b" / "systemd").iterdir())
    assert (out / "b" / "recordings" / "field.mcap").exists()
    assert (out / "a" / "tls" / "mine.pem").exists()
    assert write(plan, out, more=units).removed == []
    fresh = tmp_path / "fresh"
    write(plan, fresh, more=units)
    ours = {name for name in contents(out) if name not in {"a/tls/mine.pem", "b/recordings/field.mcap"}}
    assert ours == set(contents(fresh))
    document["security"] = {"enabled": False}
    write(planned(tmp_path, document), out, more=units)
    assert [path.name for path in out.rglob("*.key")] == ["ca.key"]


def test_a_ca_without_its_key_is_not_replaced(tmp_path: Path) -> None:
    plan = deployed(tmp_path, hosts_document())
    key = tmp_path / "out" / "ca" / "ca.key"
    kept = key.rename(tmp_path / "kept.key")
    before = contents(tmp_path / "out")
    with pytest.raises(InputError, match=r"ca\.key: expected the key of ca\.pem, to sign with: put it back"):
        write(plan, tmp_path / "out")
    assert contents(tmp_path / "out") == before
    kept.rename(key)
    assert write(plan, tmp_path / "out").certificates_made == []


def test_what_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/out: cannot be written: Not a directory"):
        write(planned(tmp_path, hosts_document()), tmp_path / "file" / "out")


def test_data_files_go_where_they_are_needed(tmp_path: Path) -> None:
    source = tmp_path / "source"
    for i in (1, 2, 3, 4):
        (source / "readings" / str(i)).mkdir(parents=True)
        (source / "readings" / str(i) / "y.csv").write_text(f"y\n{i}.5\n")
    (source / "y.csv").write_text("y\n0.5\n")
    (source / "trace.csv").write_text("0.001\n0.002\n")
    document = tomllib.loads(EXAMPLE.read_text())
    document["source"] = {"kind": "csv", "file": "readings/{id}/y.csv", "columns": ["y"]}
    document["sensors"][3]["source"] = {"kind": "csv", "file": "y.csv", "columns": ["y"]}
    document["links"] = {"delay": {"trace": "trace.csv"}}
    document["recording"] = {"directory": "elsewhere", "compression": "lz4"}
    (source / "s.toml").write_text(tomli_w.dumps(document))
    plan = planned(tmp_path, hosts_document(), source / "s.toml")
    write(plan, tmp_path / "out")
    for host, data in {
        "a": {"data/1/y.csv", "data/2/y.csv", "data/trace.csv"},
        "b": {"data/3/y.csv", "data/trace.csv"},
        "c": {"data/y.csv", "data/trace.csv"},
    }.items():
        folder = tmp_path / "out" / host
        assert {name for name in contents(folder) if name.startswith("data/")} == data
        loaded = load_scenario(folder / "scenario.toml")
        assert loaded.fingerprint == plan.scenario.fingerprint
        assert (loaded.recording.directory, loaded.recording.compression) == (None, "lz4")
        for i in plan.hosts.hosts[host].nodes:
            assert Path(loaded.source_of(i).file).exists()
    (source / "trace.csv").unlink()
    with pytest.raises(ScenarioError, match="expected a file that can be copied"):
        write(plan, tmp_path / "again")


def test_files_that_would_have_one_name_keep_their_own(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    for number, name in enumerate(("y-1.csv", "other/y-1.csv", "y-3.csv", "y-4.csv")):
        (tmp_path / name).write_text(f"y\n{number}.5\n")
    document = tomllib.loads(EXAMPLE.read_text())
    document["source"] = {"kind": "csv", "file": "y-{id}.csv", "columns": ["y"]}
    document["sensors"][1]["source"] = {"kind": "csv", "file": "other/y-1.csv", "columns": ["y"]}
    (tmp_path / "s.toml").write_text(tomli_w.dumps(document))
    write(planned(tmp_path, hosts_document(), tmp_path / "s.toml"), tmp_path / "out")
    loaded = load_scenario(tmp_path / "out" / "a" / "scenario.toml")
    read = {i: Path(loaded.source_of(i).file).read_text() for i in (1, 2)}
    assert read == {1: "y\n0.5\n", 2: "y\n1.5\n"}


def test_a_design_is_made_once_for_all(tmp_path: Path) -> None:
    document = tomllib.loads((EXAMPLE.parent / "stationary.toml").read_text())
    ids = [sensor["id"] for sensor in document["sensors"]]
    hosts = {"run": "designed", "hosts": {"a": {"address": "127.0.0.1", "nodes": ids}}, "security": {"enabled": False}}
    plan = planned(tmp_path, hosts, EXAMPLE.parent / "stationary.toml")
    write(plan, tmp_path / "out")
    before = contents(tmp_path / "out")
    write(plan, tmp_path / "out")
    assert contents(tmp_path / "out") == before
    loaded = load_scenario(tmp_path / "out" / "a" / "scenario.toml")
    assert loaded.method.design == "data/design.npz"
    with np.load(tmp_path / "out" / "a" / "data" / "design.npz") as design:
        assert design.files


def test_own_certificates_are_checked_and_copied(tmp_path: Path) -> None:
    plan = deployed(tmp_path, hosts_document())
    mine = tmp_path / "mine"
    mine.mkdir()
    for path in (tmp_path / "out").rglob("tls/*"):
        (mine / path.name).write_bytes(path.read_bytes())
        (mine / path.name).chmod(0o600)
    document = {"run": plan.run, **hosts_document(), "security": {"certificates": "mine"}}
    second = planned(tmp_path, document)
    write(second, tmp_path / "second")
    assert not (tmp_path / "second" / "ca").exists()
    assert (tmp_path / "second/a/tls/node-1.key").read_bytes() == (mine / "node-1.key").read_bytes()
    (mine / "node-2.pem").write_bytes((mine / "node-1.pem").read_bytes())
    (mine / "node-2.key").write_bytes((mine / "node-1.key").read_bytes())
    with pytest.raises(InputError, match=r"node-2.pem: it is the certificate of 'node-1'"):
        write(second, tmp_path / "third")
    (mine / "node-2.key").unlink()
    (mine / "node-3.pem").unlink()
    with pytest.raises(InputError, match=r"node-2.key: cannot be read") as caught:
        write(second, tmp_path / "third")
    assert "node-3.pem: cannot be read" in str(caught.value)
    assert not (tmp_path / "third" / "a").exists()
    own = {"ca": {"certificate": "out/ca/ca.pem", "key": "out/ca/ca.key"}}
    third = planned(tmp_path, {**hosts_document(), "security": own})
    write(third, tmp_path / "fourth")
    assert (tmp_path / "fourth/a/tls/ca.pem").read_bytes() == (mine / "ca.pem").read_bytes()
    (tmp_path / "out/ca/ca.key").chmod(0o644)
    with pytest.raises(InputError, match=r"ca\.key: everybody on this machine may read or change this key"):
        write(third, tmp_path / "fifth")
    leaf = {"ca": {"certificate": "mine/node-1.pem", "key": "mine/node-1.key"}}
    with pytest.raises(InputError, match=r"node-1\.pem: it is no CA's certificate"):
        write(planned(tmp_path, {**hosts_document(), "security": leaf}), tmp_path / "sixth")


def test_the_commands(tmp_path: Path) -> None:
    words = ("deploy", EXAMPLE, "--hosts", DEPLOY / "hosts.example.toml", "-o", "out", "--json")
    told = zfusion(tmp_path, *words).summary
    assert told["folders"] == ["alpha", "beta", "gamma", "desk"]
    assert len(told["certificates_made"]) == 6
    readme = (tmp_path / "out" / "gamma" / "README").read_text()
    assert "zfusion node scenario.toml --run field --zenoh-config zenoh/node-4.json5 --id 4 --await-recorder" in readme
    refused = zfusion(
        tmp_path, "node", "out/beta/scenario.toml", "--id", 3, "--zenoh-config", "out/beta/zenoh/node-3.json5"
    )
    assert refused.code == 2
    assert "tls/ca.pem: cannot be read (No such file or directory)" in refused.error
    beta = tmp_path / "out" / "beta"
    impostor = zfusion(beta, "node", "scenario.toml", "--id", 4, "--zenoh-config", "zenoh/node-3.json5")
    assert impostor.code == 2
    assert "it is the certificate of 'node-3', and this process is 'node-4'" in impostor.error


def moved_away(out: Path, one: Process) -> None:
    """Give a process a certificate that is good at another host's address."""
    certificate, key = read_authority(out / "ca/ca.pem", out / "ca/ca.key").issue(one.name, "127.0.0.99", 10)
    (out / one.host / one.certificate).write_bytes(certificate)
    write_private(out / one.host / one.key, key)


@pytest.mark.parametrize(("topology", "name"), [("direct", "node-3"), ("router", "router-a")])
@pytest.mark.parametrize("bind", [None, "0.0.0.0"])
def test_a_certificate_of_another_address_ends_who_is_dialled_at_this(
    tmp_path: Path, topology: str, name: str, bind: str | None
) -> None:
    """The address is the one by which the others come, wherever the process listens."""
    document = hosts_document(topology)
    for host in document["hosts"].values():
        host.update({} if bind is None else {"bind": bind})
    plan = deployed(tmp_path, document)
    one = process(plan, name)
    moved_away(tmp_path / "out", one)
    refused = zfusion(tmp_path / "out" / one.host, *plan.command(one)[1:])
    assert refused.code == 2
    assert refused.error == f"error: tls/{name}.pem: it is of another address than this host's"


def test_whom_nobody_dials_may_be_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = deployed(tmp_path, hosts_document())
    one = process(plan, "observer")
    moved_away(tmp_path / "out", one)
    monkeypatch.chdir(tmp_path / "out" / one.host)
    open_session(Endpoints(), config_file=Path(one.zenoh_file), name=one.name).close()  # type: ignore[no-untyped-call]


def test_a_port_that_is_taken_is_named_with_the_file_that_wants_it(tmp_path: Path) -> None:
    plan = deployed(tmp_path, hosts_document())
    one = process(plan, "node-3")
    with socket.create_server(("127.0.0.1", int(one.listen[0].rpartition(":")[2]))):
        refused = zfusion(tmp_path / "out" / one.host, *plan.command(one)[1:])
    assert refused.code == 2
    assert f"{one.zenoh_file} (listen {one.listen[0]}, connect {', '.join(one.connect)}): " in refused.error


def test_without_the_extra_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zfusion.deploy.authority", None)
    with pytest.raises(InputError, match=r"pip install 'zfusion\[deploy\]'"):
        deployed(tmp_path, hosts_document())
