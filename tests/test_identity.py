"""Who a node is: the second process of an id is refused, and so is one of another version; the others are unharmed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from swarms import Command, Listener, client, decoded, endpoints, run_name, variant, wait_until, zfusion
from zfusion.drivers.claims import PATIENCE_NS, Claims
from zfusion.errors import InputError, MessageError
from zfusion.messages import VERSION, Reason, encode_any
from zfusion.status import Phase, Status
from zfusion.swarm.ports import free_endpoints

NODES = (1, 2, 3, 4)
PACED = {"timing": {"rate_hz": 20.0}}


def nodes(directory: Path, scenario: Path, run: str) -> dict[int, Command]:
    return {i: Command(directory, "node", scenario, "--id", i, "--run", run, "--forever", "--json") for i in NODES}


def test_the_second_node_of_an_id_is_refused_and_the_first_unharmed(tmp_path: Path) -> None:
    scenario, run = variant(tmp_path, **PACED), run_name("double")
    where = endpoints(scenario)
    swarm = nodes(tmp_path, scenario, run)
    try:
        with client(*where.values()) as session:
            heard = Listener(session, f"zfusion/{run}/node/*/intermediate")
            wait_until(lambda: len(heard.steps()) > 5, "the swarm runs")
            here = zfusion(tmp_path, "node", scenario, "--id", 3, "--run", run)
            # As on another machine: it listens elsewhere, and dials the same neighbours.
            others = [word for i in ("1", "2") for word in ("--connect", where[i])]
            elsewhere = zfusion(
                tmp_path, "node", scenario, "--id", 3, "--run", run, "--listen", free_endpoints(1)[0], *others
            )
            last = max(heard.steps())
            wait_until(lambda: max(heard.steps()) > last + 5, "the swarm goes on")
        for command in swarm.values():
            command.interrupt()
        results = {i: command.wait() for i, command in swarm.items()}
    finally:
        for command in swarm.values():
            command.process.kill()
            command.process.wait()
    assert (here.code, elsewhere.code) == (2, 2)
    assert where["3"].removeprefix("tcp/") in here.error
    assert "in use" in here.error
    assert elsewhere.error.startswith("error: node 3 is there already: node 1, node 2 knows another process of that id")
    for result in results.values():
        assert result.code == 0, result.err
        assert all(not edge["refused"] for edge in result.summary["edges"].values())
        assert all(not sum(edge["lost"].values()) for edge in result.summary["edges"].values())
    said = [decoded(sample) for sample in heard.samples if "/3/" in str(sample.key_expr)]
    assert {message["born"] for message in said} == {1}  # nobody else has spoken in its name


def test_another_version_is_refused_with_both_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = tmp_path / "elsewhere" / "zfusion-99.1.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: zfusion\nVersion: 99.1\n")
    scenario, run = variant(tmp_path, **PACED), run_name("versions")
    both = [Command(tmp_path, "node", scenario, "--id", 2, "--run", run)]
    with monkeypatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(facts.parent), os.environ.get("PYTHONPATH", "")]))
        both.append(Command(tmp_path, "node", scenario, "--id", 3, "--run", run))
    results = [command.wait() for command in both]
    for result in results:
        assert result.code == 2
        assert "on zfusion 99.1, format 1" in result.error
        assert f"on zfusion {Status(1, '', Phase.JOINING, 0, 0, None, {}).zfusion}, format 1" in result.error


def test_of_another_version_only_the_identity_is_read() -> None:
    raw = {"node": 3, "fingerprint": "f", "zfusion": "99.1", "wire": VERSION + 1, "mood": "new"}
    assert Status.decode(encode_any(raw)).identity == ("99.1", VERSION + 1, "f")
    with pytest.raises(MessageError) as refusal:
        Status.decode(
            encode_any({**raw, "zfusion": Status(1, "", Phase.DONE, 0, 0, None, {}).zfusion, "wire": VERSION})
        )
    assert refusal.value.reason == Reason.MISSING_FIELD


def test_who_came_first_holds_the_id_until_it_has_gone() -> None:
    claims = Claims(own=1)
    assert claims.asked(2, 100, present=True, begun=True) is None
    assert claims.asked(2, 100, present=True, begun=True) is None
    assert claims.asked(2, 50, present=True, begun=True) == 100  # whatever its clock says
    assert claims.asked(2, 200, present=True, begun=True) == 100
    claims.gone(2)
    assert claims.asked(2, 300, present=False, begun=True) is None  # it shows no token yet: nothing is known of it
    assert claims.asked(2, 200, present=True, begun=True) is None
    assert claims.asked(2, 300, present=True, begun=True) == 200


def test_of_two_that_are_started_together_all_know_the_older() -> None:
    one, other = Claims(own=1), Claims(own=4)
    assert one.asked(2, 100, present=True, begun=False) is None
    assert one.asked(2, 101, present=True, begun=False) == 100
    assert other.asked(2, 101, present=True, begun=False) is None
    assert other.asked(2, 100, present=True, begun=False) is None
    assert other.asked(2, 101, present=True, begun=False) == 100


def test_a_process_waits_for_its_former_self_to_go() -> None:
    claims = Claims(own=2)
    claims.check(0)
    claims.answered(1, 100)
    assert claims.contested
    claims.check(10)
    claims.check(9 + PATIENCE_NS)
    claims.answered(1, None)
    assert not claims.contested
    claims.check(11 + PATIENCE_NS)
    claims.answered(4, 100)
    claims.check(12 + PATIENCE_NS)
    with pytest.raises(InputError, match="node 2 is there already: node 4 knows another process"):
        claims.check(12 + 2 * PATIENCE_NS)
