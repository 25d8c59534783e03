"""The recorder, in one process with those who publish: what came is on the file, and what did not is told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from math import nan
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

from swarms import EXAMPLE, wait_until
from zfusion import keys
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.metrics import RecorderReport
from zfusion.drivers.recorder import Recorder
from zfusion.drivers.transport import open_session
from zfusion.errors import RunError
from zfusion.messages import MAX_MESSAGE_BYTES
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.recording import Recording, RecordingWriter
from zfusion.stages import MEASUREMENT
from zfusion.swarm.launch import free_endpoints

RUN = "r"


class Studio:
    """A recorder in a thread, and somebody who publishes to it."""

    def __init__(self, path: Path, scenario: Scenario, **options: Any) -> None:
        self.path = path
        [endpoint] = free_endpoints(1)
        self.told: list[RecorderReport] = []
        self.writer = RecordingWriter(
            path, scenario_toml=scenario.to_toml(), run=RUN, method="two_stage", seed=1, stages=(MEASUREMENT,)
        )
        self.recorder = Recorder(
            scenario, RUN, Endpoints(listen=(endpoint,)), self.writer, tell=self.told.append, **options
        )
        self.report: RecorderReport | None = None
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.peer = open_session(Endpoints(connect=(endpoint,)))
        watch = self.peer.liveliness().declare_subscriber(
            keys.recorder_token(RUN), zenoh.handlers.FifoChannel(4), history=True
        )
        wait_until(watch.handler.try_recv, "the recorder shows its token")

    def _run(self) -> None:
        try:
            self.report = self.recorder.run()
        except RunError as error:
            self.error = error

    def put(self, key: str, data: bytes) -> None:
        self.peer.put(key, data, congestion_control=zenoh.CongestionControl.BLOCK)

    def measurement(self, node: int, number: int, /, **changes: object) -> None:
        message = {"v": 1, "node": node, "step": number + 1, "t_ns": 5, "seq": number, "born": 1, "y": [0.5]}
        self.put(keys.stage_key(RUN, node, "measurement"), msgpack.packb(message | changes))

    def event(self, node: int, **data: object) -> None:
        message = {"v": 1, "node": node, "step": 1, "t_ns": 5, "seq": 0, "born": 1, "kind": "stopped", "data": data}
        self.put(keys.stage_key(RUN, node, "event"), msgpack.packb(message))

    def ask(self) -> int:
        """How many messages it has, once it has all that were put before."""
        [reply] = list(self.peer.get(keys.recorder_status_key(RUN), zenoh.handlers.FifoChannel(4), timeout=30.0))
        return int(msgpack.unpackb(reply.ok.payload.to_bytes())["messages"])

    def finish(self) -> RecorderReport:
        self.recorder.stop()
        self.join()
        assert self.report is not None
        return self.report

    def join(self) -> None:
        self._thread.join(30)
        assert not self._thread.is_alive()
        self.peer.close()


@pytest.fixture
def scenario() -> Scenario:
    return load_scenario(EXAMPLE)


@pytest.fixture
def studio(tmp_path: Path, scenario: Scenario) -> Iterator[Studio]:
    studio = Studio(tmp_path / "r.mcap", scenario)
    yield studio
    studio.recorder.stop()
    studio.join()


def test_an_answer_comes_when_all_that_was_put_before_is_on_record(studio: Studio) -> None:
    for number in range(500):
        studio.measurement(1, number)
    assert studio.ask() == 500
    report = studio.finish()
    assert report.messages == 500
    assert report.by_key == {"1/measurement": 500}
    with Recording.open(studio.path) as recording:
        assert recording.complete
        assert [record.sequence for record in recording.records()] == list(range(500))


def test_what_came_before_the_stop_is_on_the_file(studio: Studio) -> None:
    for number in range(200):
        studio.measurement(2, number)
    wait_until(lambda: studio.writer.messages, "the first came")
    assert studio.ask() == 200
    assert studio.finish().recorded == {"measurement": 200}


def test_what_is_missing_is_told_by_the_senders_counters(studio: Studio) -> None:
    for number in (0, 1, 2, 5, 6, 9):
        studio.measurement(3, number)
    studio.event(3, sent={"measurement": 12})
    assert studio.ask() == 7
    report = studio.finish()
    assert report.lost == {keys.stage_key(RUN, 3, "measurement"): 2 + 2 + 2}


def test_what_a_forger_numbers_is_not_missing(studio: Studio) -> None:
    studio.measurement(3, 0)
    studio.measurement(3, 10**9, y=[nan])
    studio.measurement(3, 7, born=5, y=[nan])
    studio.measurement(3, 50, node=4)
    studio.put(keys.stage_key(RUN, 3, "measurement"), b"\xc1")
    studio.measurement(3, 1)
    assert studio.ask() == 6  # on the file all the same: they were on the wire
    assert studio.finish().lost == {}
    with Recording.open(studio.path) as recording:
        accounts = recording.statistics
        assert accounts is not None
        account = accounts[keys.stage_key(RUN, 3, "measurement")]
    assert (account.received, account.unreadable, account.lost, account.restarts) == (2, 4, 0, 0)


def test_what_is_not_of_the_scenario_is_counted_and_not_recorded(studio: Studio) -> None:
    studio.measurement(1, 0)
    for key in ("node/99/measurement", "node/1/gossip", "x/y", "node/1", "status"):
        studio.put(f"zfusion/{RUN}/{key}", b"whatever")
    studio.put(keys.stage_key(RUN, 1, "measurement"), bytes(MAX_MESSAGE_BYTES + 1))
    assert studio.ask() == 1
    report = studio.finish()
    assert report.foreign == 6
    with Recording.open(studio.path) as recording:
        assert set(recording.topics) == {keys.stage_key(RUN, 1, "measurement")}
        assert recording.closing["foreign"] == "6"


def test_a_flush_is_on_the_disk_while_the_run_goes_on(tmp_path: Path, scenario: Scenario) -> None:
    quick = scenario.model_copy(update={"recording": scenario.recording.model_copy(update={"flush_interval_s": 0.05})})
    studio = Studio(tmp_path / "q.mcap", quick)
    try:
        studio.measurement(1, 0)
        assert studio.ask() == 1
        flushes = len(studio.told)
        wait_until(lambda: len(studio.told) > flushes, "a flush")
        with Recording.open(studio.path) as recording:
            assert not recording.complete
            assert recording.messages == 1
    finally:
        studio.finish()


def test_by_itself_it_ends_when_everybody_has_come_and_gone(tmp_path: Path, scenario: Scenario) -> None:
    studio = Studio(tmp_path / "u.mcap", scenario, until_all_gone=True)
    liveliness = studio.peer.liveliness()
    tokens = [liveliness.declare_token(keys.node_token(RUN, i)) for i in (*scenario.ids, 99)]
    studio.measurement(1, 0)
    assert studio.ask() == 1
    for token in tokens[:-2]:
        token.undeclare()
    assert studio.ask() == 1  # node 4 is still there
    tokens[-2].undeclare()
    studio.join()
    assert studio.report is not None
    assert studio.report.messages == 1


def test_a_full_disk_ends_the_recording_with_an_error(tmp_path: Path, scenario: Scenario) -> None:
    studio = Studio(tmp_path / "f.mcap", scenario)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    studio.writer._writer.add_message = full  # type: ignore[method-assign]
    studio.measurement(1, 0)
    studio.join()
    assert studio.error is not None
    assert "No space left on device" in str(studio.error)
