"""Readings that a program of the user's publishes, over real Zenoh sessions."""

from __future__ import annotations

import json
from collections.abc import Iterator

import msgpack
import numpy as np
import pytest
import zenoh

from swarms import wait_until
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.key_source import KeySource
from zfusion.drivers.transport import open_session
from zfusion.errors import MessageError
from zfusion.messages import decode_reading
from zfusion.swarm.ports import free_endpoints

KEY = "lab/thermometer/1"


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    [endpoint] = free_endpoints(1)
    with (
        open_session(Endpoints(listen=(endpoint,))) as node,
        open_session(Endpoints(connect=(endpoint,))) as program,
    ):
        yield node, program


def test_the_newest_reading_is_taken_once(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    node, program = sessions
    source = KeySource(node, 1, KEY, 2, wait_s=0.0)
    publisher = program.declare_publisher(KEY)
    wait_until(lambda: publisher.matching_status.matching, "a link to the node")
    assert source.read(1, 0) is None
    for payload, encoding in (
        ("[1, 2.5]", "application/json"),
        (msgpack.packb([3.0, 4]), "application/msgpack"),
        ("garbage", "text/plain"),
        ("[1, 2, 3]", "application/json"),
        ("[NaN, 2]", "application/json"),
        (b"\xc1", "application/msgpack"),
        ("[5, 6]", "application/json"),
    ):
        publisher.put(payload, encoding=zenoh.Encoding(encoding))
    wait_until(lambda: source._newest is not None and source._newest[0] == 5.0, "the last reading")
    np.testing.assert_array_equal(source.read(2, 0), [5.0, 6.0])
    assert source.read(3, 0) is None
    assert source.counters == {"not_json": 1, "wrong_shape": 1, "not_finite": 1, "not_msgpack": 1}
    assert source.truth(1) is None
    source.close()


def test_a_free_running_node_waits_for_the_next_reading(sessions: tuple[zenoh.Session, zenoh.Session]) -> None:
    node, program = sessions
    source = KeySource(node, 1, KEY, 1, wait_s=60.0)
    publisher = program.declare_publisher(KEY)
    wait_until(lambda: publisher.matching_status.matching, "a link to the node")
    publisher.put("7")
    np.testing.assert_array_equal(source.read(1, 0), [7.0])
    source.close()


@pytest.mark.parametrize("bad", [b"", b"x", b"{}", b'"7"', b"[true]", b"[[1]]", b"1e999", b"9" * 400, b"[" * 5000])
def test_what_is_no_reading_is_refused_with_one_kind_of_error(bad: bytes) -> None:
    with pytest.raises(MessageError):
        decode_reading(bad, packed=False, ny=1)
    with pytest.raises(MessageError):
        decode_reading(msgpack.packb(json.loads("[[1]]")), packed=True, ny=1)
