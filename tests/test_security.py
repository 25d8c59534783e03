"""A live swarm with TLS, and those who were not invited: raw Zenoh sessions that keep to no rule of zfusion's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from deployed import Swarm, answers, deployed, hosts_document, intruder, process, refusals, senders, swarm, tls_files
from swarms import Listener, recorded, wait_until, zfusion
from zfusion import keys
from zfusion.deploy.authority import make_authority, read_authority
from zfusion.deploy.identity import write_private
from zfusion.deploy.plan import Plan

ADDRESS = "127.0.0.1"
FORGED = msgpack.packb({"v": 0})
"""Whoever looks into it counts it."""


def stolen(directory: Path, authority: Path, name: str, days: float, age: timedelta = timedelta()) -> dict[str, Any]:
    """TLS settings with a certificate in a process' name, signed by the given CA."""
    directory.mkdir()
    signer = read_authority(authority / "ca.pem", authority / "ca.key")
    certificate, key = signer.issue(name, ADDRESS, days, datetime.now(UTC) - age)
    (directory / f"{name}.pem").write_bytes(certificate)
    write_private(directory / f"{name}.key", key)
    return tls_files(directory, name)


def strangers(directory: Path, out: Path) -> dict[str, dict[str, Any] | None]:
    """Who is not to get in at all; all of them know our CA's certificate, which is no secret."""
    ours = str(out / "ca" / "ca.pem")
    other = directory / "other"
    other.mkdir()
    certificate, key = make_authority("zfusion", 10)
    (other / "ca.pem").write_bytes(certificate)
    write_private(other / "ca.key", key)
    expired = stolen(directory / "expired", out / "ca", "node-2", 1, timedelta(days=2))
    foreign = stolen(directory / "foreign", other, "node-2", 10)
    return {
        "no certificate": {"root_ca_certificate": ours},
        "another CA's": {**foreign, "root_ca_certificate": ours},
        "expired": {**expired, "root_ca_certificate": ours},
    }


class Doors:
    """Where the nodes of a swarm are reached: themselves, or their router."""

    def __init__(self, running: Swarm) -> None:
        self._running, self._plan = running, running.plan

    def of(self, node: int) -> str:
        routers = [one for one in self._plan.processes if one.kind == "router"]
        return (routers or [process(self._plan, f"node-{node}")])[0].listen[0]

    @contextmanager
    def as_member(self, name: str, node: int) -> Iterator[zenoh.Session]:
        """A session at a node's door with the certificate of a member."""
        one = process(self._plan, name)
        with intruder(self.of(node), tls_files(self._running.out / one.host / "tls", name)) as session:
            yield session


def step_of(session: zenoh.Session, run: str, node: int) -> int:
    """At which step a node says that it is."""
    [told] = answers(session, keys.status_key(run, node))
    step: int = msgpack.unpackb(told)["step"]
    return step


def publish(session: zenoh.Session, key: str) -> None:
    """Put something on a key that is not to come back to the session's own subscribers."""
    session.put(
        key,
        FORGED,
        congestion_control=zenoh.CongestionControl.BLOCK,
        allowed_destination=zenoh.Locality.REMOTE,
    )


def hears_nothing_of(listener: Listener, session: zenoh.Session, run: str, node: int) -> bool:
    """Whether nothing comes while a node takes some steps, as it says over the same link."""
    first = step_of(session, run, node)
    wait_until(lambda: step_of(session, run, node) >= first + 3, "it takes steps")
    return not listener.collect()


def try_the_doors(directory: Path, doors: Doors, running: Swarm) -> None:
    """Strangers."""
    for tls in strangers(directory, running.out).values():
        with pytest.raises(zenoh.ZError), intruder(doors.of(1), tls):
            pass
    with pytest.raises(zenoh.ZError), intruder(doors.of(1).replace("tls/", "tcp/"), None):
        pass


def misbehave_as_node_1(doors: Doors, run: str) -> None:
    """Node 4 hears nodes 1 and 2; node 1 does not hear node 4."""
    with doors.as_member("node-1", 4) as session:
        assert step_of(session, run, 4) > 0  # its own business
        assert answers(session, keys.history_key(run, 4)) == []
        listeners = [
            Listener(session, key)
            for key in (keys.stage_key(run, 4, "measurement"), keys.stage_key(run, 4, "*"), keys.whole_run(run))
        ]
        for key in (
            keys.stage_key(run, 2, "measurement"),
            keys.stage_key(run, 4, "estimate"),
            keys.stage_key(run, 1, "measurement"),  # the only one that may: and that is counted
        ):
            publish(session, key)
        token = session.liveliness().declare_token(keys.node_token(run, 3))
        assert all(hears_nothing_of(listener, session, run, 4) for listener in listeners)
        token.undeclare()


def misbehave_as_readers(doors: Doors, run: str) -> None:
    """The observer reads what it is given and nothing else; neither it nor who has the recorder's key can speak."""
    with doors.as_member("observer", 3) as session:
        given, kept = (Listener(session, keys.stage_key(run, 3, stage)) for stage in ("estimate", "measurement"))
        wait_until(given.collect, "the observer sees estimates")
        assert answers(session, keys.history_key(run, 3)) == []
        publish(session, keys.stage_key(run, 1, "measurement"))
        publish(session, keys.truth_key(run))
        assert hears_nothing_of(kept, session, run, 3)
    with doors.as_member("recorder", 3) as session:
        publish(session, keys.stage_key(run, 1, "measurement"))
        assert answers(session, keys.status_key(run, 3)) == []
        everything = Listener(session, keys.whole_run(run))
        wait_until(everything.collect, "the recorder reads")


def observer_sees_who_is_there(plan: Plan, running: Swarm) -> None:
    """With the rules of its own configuration in force, too."""
    one = process(plan, "observer")
    words = ("scenario.toml", "--run", plan.run, "--zenoh-config", one.zenoh_file)
    look = zfusion(running.out / one.host, "status", *words, "--json")
    assert look.code == 0, look.err


def recording_is_honest(directory: Path, plan: Plan, running: Swarm, forged: list[str]) -> None:
    """Nothing on it is anybody's but its key's owner's, and every estimate follows from it."""
    messages = recorded(running.recording)
    assert {m.topic.split("/")[1] for m in messages} == {plan.run}
    assert [m.topic for m in messages if m.data == FORGED] == forged
    assert senders(m for m in messages if m.data != FORGED) == {(node, node) for node in ("1", "2", "3", "4")}
    verdict = zfusion(directory, "replay", running.recording, "--verify", "--json")
    assert verdict.code == 0, verdict.err


def keeps_its_secrets(running: Swarm, told: list[bytes]) -> None:
    """What anybody can look at has nothing of any key in it, and not where they are."""
    pems = [path.read_bytes() for path in running.out.rglob("*.key")]
    assert len(pems) >= 7
    secrets = [line for pem in pems for line in pem.splitlines()[1:-1]]
    assert not [secret for secret in (*secrets, b".key", b"zenoh_config") for place in told if secret in place]


@pytest.mark.parametrize("topology", ["direct", "router"])
def test_nobody_uninvited(tmp_path: Path, topology: str) -> None:
    plan = deployed(tmp_path, hosts_document(topology), steps=100_000, timing={"rate_hz": 20.0})
    with swarm(plan, tmp_path / "out") as running:
        doors = Doors(running)
        lines = [Path(f"/proc/{command.process.pid}/cmdline").read_bytes() for command in running.commands.values()]
        wait_until(running.steps_taken, "steps are taken")
        try_the_doors(tmp_path, doors, running)
        misbehave_as_node_1(doors, plan.run)
        misbehave_as_readers(doors, plan.run)
        observer_sees_who_is_there(plan, running)
        running.interrupt()
        reports = running.ended()
    refused = refusals(reports)
    # What node 1 says on its own keys a router passes on to all that hear it, and to the recorder.
    routed = topology == "router"
    assert set(refused) == {(name, "1") for name in (("node-3", "node-4") if routed else ("node-4",))}
    assert all(sum(counted.values()) == 1 for counted in refused.values())
    own = keys.stage_key(plan.run, 1, "measurement")
    recording_is_honest(tmp_path, plan, running, [own] if routed else [])
    said = [command.said().encode() for command in running.commands.values()]
    keeps_its_secrets(running, [*lines, *said, running.recording.read_bytes()])
