"""Why somebody who is dialled does not come."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
import zenoh

from test_credentials import authority, credentials
from zfusion.drivers.credentials import Credentials
from zfusion.drivers.probe import WORD_NS, Prober, Route, Waiting, trouble
from zfusion.drivers.settings import base_settings
from zfusion.swarm.ports import free_endpoints

HERE = "127.0.0.1"


@contextmanager
def listener(endpoint: str, files: Credentials) -> Iterator[None]:
    """A Zenoh session that asks for certificates."""
    tls = {
        "root_ca_certificate": str(files.authority),
        "enable_mtls": True,
        "listen_certificate": str(files.certificate),
        "listen_private_key": str(files.key),
    }
    config = zenoh.Config()
    for path, value in (base_settings() | {"listen/endpoints": [endpoint], "transport/link/tls": tls}).items():
        config.insert_json5(path, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield
    finally:
        session.close()


def test_no_connection() -> None:
    [free] = free_endpoints(1)
    assert trouble(Route(free)) == "the connection is refused: nothing listens there"
    assert trouble(Route("tcp/no-such-host.invalid:7450")) == "its name cannot be looked up"
    assert trouble(Route("unixsock-stream//run/x")) is None
    with socket.create_server((HERE, 0)) as server:
        assert trouble(Route(f"tcp/{HERE}:{server.getsockname()[1]}")) is None


def test_handshakes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    ours, theirs = authority(tmp_path / "ours"), authority(tmp_path / "theirs", "somebody")
    node = credentials(tmp_path / "node", ours, address=HERE)
    own = credentials(tmp_path / "own", ours, "node-2", HERE)
    stranger = credentials(tmp_path / "stranger", theirs, "node-2", HERE)
    stranger.authority.write_bytes(ours.pem)
    expired = credentials(tmp_path / "expired", ours, "node-2", HERE, days=1, age=timedelta(days=2))
    elsewhere = credentials(tmp_path / "elsewhere", ours, "node-3", "10.0.0.3")
    there, misplaced = (at.replace("tcp/", "tls/") for at in free_endpoints(2))
    with listener(there, node), listener(misplaced, elsewhere):
        assert trouble(Route(there, own, frozenset({"node-1"}))) is None
        assert trouble(Route(there, own, frozenset({"node-4"}))) == (
            "it is 'node-1', of whom this process' rules know nothing"
        )
        refused = "it refuses this process' certificate, or TLS: "
        assert (trouble(Route(there, stranger)) or "").startswith(refused)
        assert trouble(Route(there, expired)) == f"{refused}sslv3 alert certificate expired"
        wrong = "its certificate is refused here: it is of another address than this host's"
        assert trouble(Route(misplaced, own)) == wrong
        prober = Prober([Route(there, own), Route(misplaced, own)])
        prober.look()
        assert prober._thread is not None
        prober._thread.join()
    assert [record.message for record in caplog.records if "refused here" in record.message] == [
        f"{misplaced}: {wrong}"
    ]


def test_who_is_waited_for_is_said_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    [free] = free_endpoints(1)
    prober = Prober([Route(free)])
    waiting = Waiting(prober, 1000)
    for now in (999, 1000, 1001, 1000 + WORD_NS):
        waiting.tell(now, lambda: ["node 1", "the recorder"], linked=True)
    assert [record.message for record in caplog.records] == ["waiting for node 1, the recorder"] * 2
    assert prober._thread is None
    waiting.tell(1000 + 2 * WORD_NS, lambda: ["node 1"])
    assert prober._thread is not None
    prober._thread.join()
    assert caplog.records[-1].message == f"{free}: the connection is refused: nothing listens there"
