"""Recordings in several files, on disks that fill up, and after power cuts."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from recordings import SCENARIO_TOML, contents, open_writer, read, read_plainly, record, traffic
from simulations import writer_for
from swarms import wait_until
from test_recording import ENVIRONMENT
from zfusion.drivers.replayed import verify
from zfusion.drivers.simulated import Simulation
from zfusion.errors import RecordingError, RunError
from zfusion.model.scenario import load_scenario
from zfusion.recording import Keeping, Recording
from zfusion.recording import keeping as keeping_module
from zfusion.recording.info import info
from zfusion.recording.layout import CHANNELS, segment_path

SMALL = Keeping(rotate_bytes=20_000)
EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"


def segments(path: Path) -> list[Path]:
    return sorted(path.parent.glob(f"{path.stem}*.mcap"), key=lambda p: (len(p.name), p.name))


def test_a_large_recording_is_in_several_files_that_are_read_as_one(tmp_path: Path) -> None:
    sent = traffic(200)
    path = record(tmp_path / "r.mcap", sent, keeping=SMALL)
    files = segments(path)
    assert [file.name for file in files] == [segment_path(path, n).name for n in range(len(files))]
    assert len(files) > 3
    assert all(file.stat().st_size <= 20_000 + 4_000 for file in files), "the size, and the indexes"
    with Recording.open(path) as recording:
        assert contents(recording) == sent
        assert (recording.complete, recording.note, recording.messages) == (True, "", len(sent))
        assert recording.files == tuple(files)
        assert recording.size_bytes == sum(file.stat().st_size for file in files)
        assert (recording.start_ns, recording.end_ns) == (sent[0][2], sent[-1][2])
        assert [r.data for r in recording.records(start_ns=sent[400][2])] == [
            d for _, d, at in sent if at >= sent[400][2]
        ]
        told = info(recording)
    assert (told.lost, sum(t.gaps.received for t in told.topics), len(told.files)) == (0, len(sent), len(files))


def test_every_segment_is_a_whole_recording_for_every_reader(tmp_path: Path) -> None:
    sent = traffic(200)
    path = record(tmp_path / "r.mcap", sent, keeping=SMALL)
    files = segments(path)
    assert [message for file in files for message in read_plainly(file)] == sent
    for number, file in enumerate(files):
        alone = shutil.copy(file, tmp_path / "alone.mcap")
        with Recording.open(alone) as recording:
            assert recording.scenario_toml == SCENARIO_TOML
            assert recording.metadata["segment"] == str(number)
            assert recording.metadata.get("previous") == (files[number - 1].name if number else None)
            assert contents(recording) == read_plainly(file)
            assert recording.complete is (len(files) == 1)


def test_a_recording_is_changed_by_time_too(tmp_path: Path) -> None:
    sent = traffic(30)
    path = record(tmp_path / "r.mcap", sent, keeping=Keeping(rotate_ns=10_000_000))
    assert [len({at for *_, at in read_plainly(file)}) for file in segments(path)] == [10, 10, 10]
    assert read(path) == sent


def test_only_so_many_files_are_kept(tmp_path: Path) -> None:
    sent = traffic(200)
    path = record(tmp_path / "r.mcap", sent, keeping=Keeping(rotate_bytes=20_000, max_files=2))
    assert len(segments(path)) == 2
    with Recording.open(path) as recording:
        found = contents(recording)
        assert found == sent[-len(found) :]
        assert not recording.complete
        assert "begins with segment" in recording.note


@pytest.mark.parametrize("max_files", [0, 1], ids=["all are kept", "only the last is kept"])
def test_a_recording_that_goes_on_in_another_file_is_still_refused_to_others(tmp_path: Path, max_files: int) -> None:
    path, sent = tmp_path / "r.mcap", traffic(200)
    with open_writer(path, keeping=Keeping(rotate_bytes=20_000, max_files=max_files)) as writer:
        for message in sent:
            writer.write(*message)
        assert path not in writer.files[-1:]
        before = {file: file.read_bytes() for file in segments(path)}
        with pytest.raises(RecordingError, match=r"r\.mcap: cannot be written: another process is writing it"):
            open_writer(path)
        assert {file: file.read_bytes() for file in segments(path)} == before
    found = read(path)
    assert found == sent[-len(found) :]


def test_a_segment_that_is_missing_damaged_or_of_another_recording_is_told(tmp_path: Path) -> None:
    sent = traffic(200)
    path = record(tmp_path / "r.mcap", sent, keeping=SMALL)
    files = segments(path)
    kept = len(read_plainly(files[0]))
    with Recording.open(files[1]) as recording:
        assert "the ones before are not here" in recording.note
        assert contents(recording) == sent[kept:]
    data = files[1].read_bytes()
    files[1].write_bytes(data[:5000] + b"?" + data[5001:])
    with pytest.raises(RecordingError, match=r"r\.1\.mcap: damaged at byte .* zfusion recover saves"):
        Recording.open(path)
    files[1].unlink()
    for there, note in (False, "not here"), (True, "of another recording"):
        if there:
            record(files[1], traffic(2))
        with Recording.open(path) as recording:
            assert f"it goes on in r.1.mcap, which is {note}" in recording.note
            assert (recording.complete, len(contents(recording))) == (False, kept)
    files[1].write_bytes(b"")
    with Recording.open(path) as recording:
        assert "r.1.mcap: is empty" in recording.note


def test_a_new_recording_is_not_continued_by_an_old_ones_segments(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), keeping=SMALL)
    assert len(segments(path)) > 2
    assert read(record(path, traffic(3))) == traffic(3)


def test_replay_of_segments_is_bit_for_bit(tmp_path: Path) -> None:
    scenario = load_scenario(EXAMPLE, steps=60)
    path = tmp_path / "r.mcap"
    with writer_for(path, scenario, Keeping(rotate_bytes=15_000)) as writer:
        Simulation(scenario, run="r", record=writer.write).run()
    assert len(segments(path)) > 2
    with Recording.open(path) as recording:
        verdict = verify(recording)
    assert verdict.verified
    assert (verdict.identical, verdict.missing_count, verdict.note) == (60 * 4 * 2, 0, "")


def test_channels_are_told_again_outside_of_the_blocks(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), flush_every=100)
    with path.open("rb") as file:
        tables = [m.metadata for m in make_reader(file).iter_metadata() if m.name == CHANNELS]
    assert [table["channels"] for table in tables] == ["5"]


# --- no room ----------------------------------------------------------------------------------------------------


def test_a_recording_ends_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [10**9]
    monkeypatch.setattr(Keeping, "free_bytes", lambda *_: free[0])
    sent = traffic(20)
    writer = open_writer(tmp_path / "r.mcap", keeping=Keeping(min_free_bytes=10**6))
    for message in sent[:60]:
        writer.write(*message)
    writer.flush()
    free[0] = 999_999
    writer.flush()
    for message in sent[60:]:
        writer.write(*message)
    writer.flush()
    writer.finish()
    assert writer.stopped == "only 999999 bytes are free on the disk, and min_free_bytes is 1000000"
    assert (writer.messages, writer.unrecorded) == (60, 40)
    assert read_plainly(writer.path) == sent[:60]
    with Recording.open(writer.path) as recording:
        assert not recording.complete
        assert recording.note == f"stopped before the run ended: {writer.stopped}"
        assert recording.statistics is not None
    with pytest.raises(RecordingError, match=r"cannot be written: only 999999 bytes are free"):
        open_writer(tmp_path / "s.mcap", keeping=Keeping(min_free_bytes=10**6))
    assert not (tmp_path / "s.mcap").exists()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB, where we may make one."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(place)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small file system takes root's rights")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.mark.parametrize("rotate_bytes", [0, 50_000])
def test_a_disk_that_is_really_full(small_disk: Path, rotate_bytes: int) -> None:
    sent = traffic(3000)
    writer = open_writer(small_disk / "r.mcap", keeping=Keeping(rotate_bytes=rotate_bytes, fsync_interval_ns=10**7))

    def fill() -> None:
        for number, message in enumerate(sent):
            writer.write(*message)
            if number % 100 == 99:
                writer.flush()

    with pytest.raises(RunError, match=r"r\.mcap: writing failed: No space left on device"):
        fill()
    writer.finish()
    found = read(writer.path)
    assert found == sent[: len(found)]
    assert len(found) >= 1000


# --- what survives ----------------------------------------------------------------------------------------------

KILLED = """
import sys, time
from recordings import open_writer, traffic
from pathlib import Path
from zfusion.recording import Keeping

writer = open_writer(Path(sys.argv[1]), keeping=Keeping(rotate_bytes=20_000))
next_flush = time.monotonic() + 0.1
for number, message in enumerate(traffic(1000) * 100):
    writer.write(*message)
    if time.monotonic() >= next_flush:
        writer.flush()
        print(number, flush=True)
        next_flush = time.monotonic() + 0.1
"""


def test_a_kill_costs_what_came_since_the_last_flush(tmp_path: Path) -> None:
    path, flushed, seen = tmp_path / "r.mcap", 0, 0
    script = KILLED.replace("traffic(100_000)", "traffic(1_000) * 100")
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, env=ENVIRONMENT
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            seen += 1
            if seen == 3:
                flushed = int(line)
                process.send_signal(signal.SIGKILL)
                break
    sent = traffic(1_000) * 100
    with Recording.open(path) as recording:
        found = [(r.topic, r.data) for r in recording.records()]
        assert not recording.complete
    assert found == [(topic, data) for topic, data, _ in sent[: len(found)]]
    assert len(found) > flushed


def test_what_was_synced_is_a_recording_with_all_that_was_flushed_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut leaves what was on the disk: here, what the files held when they were put there."""
    durable: dict[Path, bytes] = {}
    lock = threading.Lock()

    def fdatasync(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        if path.is_file():
            with lock:
                durable[path] = path.read_bytes()

    monkeypatch.setattr(keeping_module, "fdatasync", fdatasync)
    path = tmp_path / "r.mcap"
    sent = traffic(200)
    writer = open_writer(path, keeping=Keeping(rotate_bytes=30_000, fsync_interval_ns=1_000_000))
    syncer = writer._syncer
    assert syncer is not None
    for number, message in enumerate(sent):
        writer.write(*message)
        if number % 250 == 249:
            writer.flush()
            synced = syncer.count
            wait_until(lambda before=synced: syncer.count >= before + 3, "all open files are synced")  # type: ignore[misc]
            with lock:
                after = tmp_path / f"after{number}"
                after.mkdir()
                for file, data in durable.items():
                    (after / file.name).write_bytes(data)
            assert read(after / "r.mcap") == sent[: number + 1]
    writer.finish()
    assert {file.name: data for file, data in durable.items()} == {f.name: f.read_bytes() for f in segments(path)}


def test_a_disk_that_cannot_be_synced_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(keeping_module, "fdatasync", broken)
    writer = open_writer(tmp_path / "r.mcap", keeping=Keeping(fsync_interval_ns=1_000_000))
    assert writer._syncer is not None
    wait_until(lambda: writer._syncer.failure, "the disk says no")  # type: ignore[union-attr]
    with pytest.raises(RunError, match=r"r\.mcap: writing failed: Input/output error"):
        writer.flush()
    writer.finish()
