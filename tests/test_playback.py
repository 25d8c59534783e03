"""Playing recordings: what is put, when, and how it is held up, on a clock that moves only when it is waited for."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from simulations import MS, record, records, walk, writer_for
from zfusion.drivers.playback import Extent, MonotonicClock, Player, choose_topics
from zfusion.errors import InputError
from zfusion.messages import decode_any
from zfusion.recording import Recording

Put = tuple[int, str, bytes]
"""(time, key, payload)."""


class FakeClock:
    """Time passes by being waited for; at some times something happens."""

    def __init__(self, happens: dict[int, Callable[[], None]] | None = None) -> None:
        self.now = 7_000_000_000
        self.happens = dict(happens or {})

    def now_ns(self) -> int:
        return self.now

    def wait(self, changed: threading.Condition, timeout_ns: int | None) -> None:
        end = float("inf") if timeout_ns is None else self.now + timeout_ns
        due = [at for at in sorted(self.happens) if at <= end]
        if due:
            self.now = max(self.now, due[0])
            self.happens.pop(due[0])()
        else:
            assert timeout_ns is not None, "waits for ever"
            self.now += timeout_ns


class Stage:
    """A recording of five steps 20 ms apart, and what is played of it."""

    def __init__(self, path: Path) -> None:
        self.recording = Recording.open(record(path, walk(5)))
        self.records = list(self.recording.records())
        self.clock = FakeClock()
        self.puts: list[Put] = []

    def put(self, key: str, payload: bytes) -> None:
        self.puts.append((self.clock.now, key, payload))

    def offsets(self) -> list[int]:
        return [at - self.puts[0][0] for at, *_ in self.puts]


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path / "r.mcap")
    with stage.recording:
        yield stage


@pytest.mark.parametrize("speed", [1.0, 4.0, 0.5])
def test_everything_is_put_with_the_spacing_that_it_had(stage: Stage, speed: float) -> None:
    player = Player(stage.recording, stage.put, speed=speed, clock=stage.clock)
    assert player.run() == player.played == len(stage.records)
    assert [(key, payload) for _, key, payload in stage.puts] == [(r.topic, r.data) for r in stage.records]
    start = stage.records[0].log_time_ns
    assert stage.offsets() == [round((r.log_time_ns - start) / speed) for r in stage.records]
    assert player.position_ns == stage.records[-1].log_time_ns
    assert max(stage.offsets()) == round(100 * MS / speed)


def test_as_fast_as_it_is_taken(stage: Stage) -> None:
    assert Player(stage.recording, stage.put, speed=0, clock=stage.clock).run() == len(stage.records)
    assert set(stage.offsets()) == {0}


def test_a_put_that_takes_long_delays_nothing_but_itself(stage: Stage) -> None:
    def slow(key: str, payload: bytes) -> None:
        stage.put(key, payload)
        if len(stage.puts) == 1:
            stage.clock.now += 50 * MS

    Player(stage.recording, slow, clock=stage.clock).run()
    start = stage.records[0].log_time_ns
    expected = [max(r.log_time_ns - start, 50 * MS) for r in stage.records[1:]]
    assert stage.offsets()[1:] == expected


def test_parts_of_a_recording(stage: Stage) -> None:
    start = stage.recording.start_ns
    for extent, wanted in (
        (Extent(start_s=0.04), lambda r: r.log_time_ns - start >= 40 * MS),
        (Extent(end_s=0.04), lambda r: r.log_time_ns - start < 40 * MS),
        (Extent(0.02, 0.06), lambda r: 20 * MS <= r.log_time_ns - start < 60 * MS),
        (Extent(first_step=4), lambda r: decode_any(r.data)["step"] >= 4),
        (Extent(last_step=2), lambda r: decode_any(r.data)["step"] <= 2),
        (Extent(first_step=3, last_step=3), lambda r: decode_any(r.data)["step"] == 3),
    ):
        stage.puts.clear()
        Player(stage.recording, stage.put, extent=extent, clock=stage.clock).run()
        assert [payload for *_, payload in stage.puts] == [r.data for r in stage.records if wanted(r)]
        assert stage.offsets()[0] == 0


@pytest.mark.parametrize(
    "limits", [{"start_s": -1.0}, {"start_s": 2.0, "end_s": 1.0}, {"first_step": 3, "last_step": 2}]
)
def test_parts_that_cannot_be(limits: dict[str, float]) -> None:
    with pytest.raises(InputError, match="expected a start"):
        Extent(**limits)  # type: ignore[arg-type]


def test_nothing_to_play(stage: Stage) -> None:
    with pytest.raises(InputError, match="nothing to play"):
        Player(stage.recording, stage.put, extent=Extent(start_s=99.0), clock=stage.clock).run()
    for speed in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="speed"):
            Player(stage.recording, stage.put, speed=speed)


def test_a_choice_of_topics(stage: Stage) -> None:
    recording = stage.recording
    assert set(choose_topics(recording)) == set(recording.topics)
    assert set(choose_topics(recording, nodes=["10"], stages=["measurement", "estimate"])) == {
        "zfusion/r/node/10/measurement",
        "zfusion/r/node/10/estimate",
    }
    assert choose_topics(recording, stages=["truth"]) == ["zfusion/r/truth"]
    assert set(choose_topics(recording, patterns=["*/20/*", "*/truth"])) == {
        topic for topic in recording.topics if "/20/" in topic or "truth" in topic
    }
    with pytest.raises(InputError, match="none of its topics"):
        choose_topics(recording, nodes=["11"])
    chosen = choose_topics(recording, stages=["estimate"])
    Player(recording, stage.put, topics=chosen, clock=stage.clock).run()
    assert [payload for *_, payload in stage.puts] == [r.data for r in stage.records if r.topic in chosen]


def test_over_and_over(stage: Stage) -> None:
    def put(key: str, payload: bytes) -> None:
        stage.put(key, payload)
        if len(stage.puts) == 3 * len(stage.records) - 1:
            player.stop()

    player = Player(stage.recording, put, loop=True, clock=stage.clock)
    assert player.run() == 3 * len(stage.records) - 1
    n, data = len(stage.records), [payload for *_, payload in stage.puts]
    assert data[:n] == data[n : 2 * n]
    assert data[2 * n :] == data[: n - 1]
    assert stage.offsets()[n : 2 * n] == [offset + 100 * MS for offset in stage.offsets()[:n]]


def test_a_pause_moves_all_that_comes_after(stage: Stage) -> None:
    begun = stage.clock.now
    player = Player(stage.recording, stage.put, clock=stage.clock)
    stage.clock.happens = {begun + 30 * MS: player.pause, begun + 730 * MS: player.resume}
    player.run()
    start = stage.records[0].log_time_ns
    offsets = [r.log_time_ns - start for r in stage.records]
    assert stage.offsets() == [offset if offset <= 30 * MS else offset + 700 * MS for offset in offsets]


@pytest.mark.parametrize("paused", [False, True])
def test_stop_ends_a_wait_too(stage: Stage, paused: bool) -> None:
    begun = stage.clock.now
    player = Player(stage.recording, stage.put, clock=stage.clock)
    stage.clock.happens = {begun + 25 * MS: player.pause} if paused else {}
    stage.clock.happens[begun + 50 * MS] = player.stop
    last = 25 if paused else 50
    assert player.run() == sum(r.log_time_ns - stage.recording.start_ns <= last * MS for r in stage.records)


def test_the_real_clock_waits_until_it_is_told_or_time_is_up() -> None:
    clock, changed = MonotonicClock(), threading.Condition()
    before = clock.now_ns()
    with changed:
        clock.wait(changed, 2 * MS)
    assert clock.now_ns() - before >= 2 * MS

    def tell() -> None:
        with changed:
            changed.notify_all()

    with changed:
        threading.Thread(target=tell).start()
        clock.wait(changed, None)


def test_an_empty_recording(tmp_path: Path) -> None:
    with writer_for(tmp_path / "r.mcap", walk(1)):
        pass
    assert not records(tmp_path / "r.mcap")
    with Recording.open(tmp_path / "r.mcap") as recording, pytest.raises(InputError, match="nothing to play"):
        Player(recording, lambda *_: None, speed=0).run()
