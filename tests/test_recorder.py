"""The recorder, in one process with those who publish: what came is on the file, and what did not is told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from math import nan
from pathlib import Path
from random import Random
from typing import Any

import msgpack
import pytest
import zenoh

from swarms import EXAMPLE, Command, run_name, variant, wait_until
from test_flood import lies
from zfusion import keys
from zfusion.drivers import inbox as inbox_module
from zfusion.drivers import recorder as recorder_module
from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.metrics import RecorderReport
from zfusion.drivers.recorder import Recorder
from zfusion.drivers.transport import open_session
from zfusion.errors import MessageError, RunError
from zfusion.messages import MAX_MESSAGE_BYTES, read_stamp
from zfusion.model.scenario import Scenario, load_scenario
from zfusion.recording import Recording, RecordingWriter
from zfusion.stages import MEASUREMENT
from zfusion.swarm.ports import free_endpoints

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


def recording_as(scenario: Scenario, **settings: object) -> Scenario:
    return scenario.model_copy(update={"recording": scenario.recording.model_copy(update=settings)})


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


def test_lies_on_every_key_are_recorded_as_what_was_on_the_wire_and_take_no_account_in(studio: Studio) -> None:
    """Also on those that no node listens to: estimates, arrivals, events, the truth."""
    stages = ("measurement", "intermediate", "estimate", "event", "arrivals", "revised")
    every = [keys.stage_key(RUN, node, stage) for node in (1, 2, 3, 4) for stage in stages] + [keys.truth_key(RUN)]
    foreign = {key for key in every if key.endswith("/revised")}  # of a scenario that revises nothing
    pool = [lie for lie in lies(Random(2)) if not is_own_word(lie)]
    for number, lie in enumerate(pool):
        studio.measurement(1, number)
        for key in every:
            studio.put(key, lie)
    assert studio.ask() == len(pool) * (len(every) - len(foreign) + 1)
    report = studio.finish()
    assert (report.lost, report.foreign, report.unrecorded) == ({}, len(pool) * len(foreign), 0)
    with Recording.open(studio.path) as recording:
        assert recording.complete
        assert set(recording.topics) == set(every) - foreign
        records = list(recording.records())
        assert recording.statistics is not None
        account = recording.statistics[keys.stage_key(RUN, 1, "measurement")]
    assert (account.received, account.unreadable) == (len(pool), len(pool))
    honest = [r.data for r in records if r.topic == keys.stage_key(RUN, 1, "measurement")][::2]
    assert [msgpack.unpackb(data)["seq"] for data in honest] == list(range(len(pool)))
    assert sorted(r.data for r in records if r.topic == keys.truth_key(RUN)) == sorted(pool)


def is_own_word(data: bytes) -> bool:
    """Whether somebody of the scenario might have said it: a lie all the same, but not by its looks."""
    try:
        read_stamp(data)
    except MessageError:
        return False
    return True


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
    studio = Studio(tmp_path / "q.mcap", recording_as(scenario, flush_interval_s=0.05))
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
    for i in scenario.ids:
        studio.event(i)
    for token in tokens[:-2]:
        token.undeclare()
    assert studio.ask() == 1 + len(scenario.ids)  # node 4 is still there
    tokens[-2].undeclare()
    studio.join()
    assert studio.report is not None
    assert studio.report.messages == 1 + len(scenario.ids)


@pytest.mark.parametrize("when_full", ["wait", "drop"])
def test_it_says_for_whom_it_waits_and_why(tmp_path: Path, when_full: str) -> None:
    file = variant(tmp_path, recording={"when_full": when_full, "flush_interval_s": 3600.0})
    run = run_name("waiting")
    recorder = Command(tmp_path, "record", file, "--run", run, "-o", tmp_path / "w.mcap")
    wait_until(lambda: "waiting for node 1, node 2, node 3, node 4" in recorder.said(), "it says for whom it waits")
    wait_until(lambda: recorder.said().count("refused: nothing listens there") >= 4, "it says why")
    node = Command(tmp_path, "node", file, "--run", run, "--id", 1)
    wait_until(lambda: "waiting for node 2, node 3, node 4" in recorder.said(), "one has come")
    for command in (node, recorder):
        command.interrupt()
        assert command.wait().code == 0


def test_a_full_disk_ends_the_recording_and_the_recorder_goes_on_counting(studio: Studio) -> None:
    for number in range(10):
        studio.measurement(1, number)
    assert studio.ask() == 10
    studio.writer.flush()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    studio.writer._segment.add = full  # type: ignore[method-assign]
    for number in range(10, 15):
        studio.measurement(1, number)
    studio.measurement(2, 0)
    assert studio.ask() == 10
    report = studio.finish()
    assert (report.messages, report.unrecorded) == (10, 6)
    assert "No space left on device" in report.stopped
    assert report.lost == {keys.stage_key(RUN, 1, "measurement"): 5, keys.stage_key(RUN, 2, "measurement"): 1}
    with Recording.open(studio.path) as recording:
        assert not recording.complete
        assert [record.sequence for record in recording.records()] == list(range(10))


def test_what_a_slow_disk_leaves_no_room_for_is_dropped_and_counted_and_nobody_waits(
    tmp_path: Path, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox_module, "POSTED", 50)
    studio = Studio(tmp_path / "s.mcap", recording_as(scenario, when_full="drop"))
    going, write = threading.Event(), studio.writer.write
    studio.writer.write = lambda *message: (going.wait(60), write(*message))[1]  # type: ignore[method-assign]
    try:
        for number in range(1000):
            studio.measurement(1, number)  # would wait if the recorder held it up: far more than fits on the way
        wait_until(lambda: studio.recorder._inbox.overrun == 1000 - 1 - 50, "all but one and what waits is dropped")
    finally:
        going.set()
    assert studio.ask() == 51
    studio.event(1, sent={"measurement": 1000})
    assert studio.ask() == 52
    report = studio.finish()
    assert report.overrun == 1000 - report.by_key["1/measurement"] == report.lost[keys.stage_key(RUN, 1, "measurement")]
    assert report.overrun == 949
    with Recording.open(studio.path) as recording:
        assert recording.closing["overrun"] == str(report.overrun)


def test_nodes_that_vanished_without_a_word_may_come_back(
    tmp_path: Path, scenario: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder that stood still for long finds all its links broken: that is not the end of the run."""
    monkeypatch.setattr(recorder_module, "GRACE_NS", 10**18)
    studio = Studio(tmp_path / "b.mcap", scenario, until_all_gone=True)
    liveliness = studio.peer.liveliness()
    for _ in range(2):
        tokens = [liveliness.declare_token(keys.node_token(RUN, i)) for i in scenario.ids]
        studio.measurement(1, 0)
        studio.ask()
        for token in tokens:
            token.undeclare()
    assert studio.ask() == 2
    for i in scenario.ids:
        studio.event(i)
    studio.join()
    assert studio.report is not None
    assert studio.report.messages == 2 + len(scenario.ids)
