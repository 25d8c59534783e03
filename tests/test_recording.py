"""Recordings: what was on the wire is on the file, whatever happens to the recorder; what is damaged is refused."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

import jsonschema
import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from recordings import SCENARIO_TOML, START_NS, contents, open_writer, read, record, traffic
from zfusion import gaps as gaps_module
from zfusion import keys
from zfusion.errors import InputError, RecordingError, RunError
from zfusion.messages import decode_any, encode
from zfusion.recording import GapCounter, Gaps, Keeping, Record, Recording, arithmetic_differences, layout
from zfusion.recording import export as export_module
from zfusion.recording.export import FORMATS, export
from zfusion.recording.info import info
from zfusion.recording.layout import CHECKSUM, RECORDING, SCENARIO, sealed, segment_path
from zfusion.recording.provenance import machine, software
from zfusion.recording.recover import recover
from zfusion.stages import TRUTH_SENDER, Field, Kind, Message, Stage

ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
}

# --- what is on the file ----------------------------------------------------------------------------------------


def test_the_plain_mcap_reader_finds_everything(tmp_path: Path) -> None:
    sent = traffic(20)
    path = record(tmp_path / "r.mcap", sent, flush_every=30)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [(c.topic, m.data, m.log_time) for _, c, m in reader.iter_messages()]
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (channel.message_encoding, schema.encoding) == ("msgpack", "jsonschema")
            assert schema.name == "zfusion." + channel.topic.rpartition("/")[2].capitalize()
            jsonschema.validate(msgpack.unpackb(message.data), json.loads(schema.data))
            assert message.publish_time == msgpack.unpackb(message.data)["t_ns"] == message.log_time - 7_000
            assert message.sequence == msgpack.unpackb(message.data)["seq"]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
        (attachment,) = reader.iter_attachments()
    assert found == sent
    assert (attachment.name, attachment.media_type) == ("scenario.toml", "application/toml")
    assert attachment.data.decode() == SCENARIO_TOML
    facts = metadata["zfusion.recording"]
    assert (facts["format"], facts["run"], facts["method"], facts["seed"]) == ("1", "r", "two_stage", "7")
    assert facts.items() >= (software() | machine()).items()
    assert {"clock_realtime_ns", "clock_monotonic_ns"} <= facts.keys()
    assert set(metadata["zfusion.stats"]) == {CHECKSUM} | {topic for topic, _, _ in sent}
    assert metadata["zfusion.close"]["messages"] == str(len(sent))


def test_our_reader_finds_everything_too(tmp_path: Path) -> None:
    sent = traffic(20)
    with Recording.open(record(tmp_path / "r.mcap", sent, flush_every=30)) as recording:
        assert contents(recording) == sent
        assert (recording.complete, recording.note, recording.scenario_toml) == (True, "", SCENARIO_TOML)
        assert recording.topics == Counter(topic for topic, _, _ in sent)
        assert recording.messages == len(sent)
        assert (recording.start_ns, recording.end_ns) == (sent[0][2], sent[-1][2])
        assert next(recording.records()) == Record(sent[0][0], sent[0][1], sent[0][2], sent[0][2] - 7_000, 0)


def test_a_selection_of_topics_and_times(tmp_path: Path) -> None:
    sent = traffic(20)
    start, end = sent[31][2], sent[62][2]
    topics = {keys.truth_key("r"), keys.stage_key("r", 2, "estimate")}
    with Recording.open(record(tmp_path / "r.mcap", sent, flush_every=30)) as recording:
        found = [(r.topic, r.data, r.log_time_ns) for r in recording.records(topics, start, end)]
        assert found == [message for message in sent if message[0] in topics and start <= message[2] < end]
        assert not list(recording.records(["zfusion/r/node/9/estimate"]))
        assert not list(recording.records(start_ns=recording.end_ns + 1))


def test_several_iterations_at_once(tmp_path: Path) -> None:
    sent = traffic(8)
    with Recording.open(record(tmp_path / "r.mcap", sent, flush_every=10)) as recording:
        pairs = list(zip(recording.records(), recording.records(), strict=True))
    assert [(a.data, b.data) for a, b in pairs] == [(data, data) for _, data, _ in sent]


def test_a_recording_without_messages(tmp_path: Path) -> None:
    with Recording.open(record(tmp_path / "r.mcap", [])) as recording:
        assert recording.complete
        assert not contents(recording)
        assert (recording.start_ns, recording.end_ns, recording.topics) == (0, 0, {})


def test_everything_that_comes_is_recorded_verbatim(tmp_path: Path) -> None:
    """Garbage too, and what other programs say on other keys: a replay must see what the nodes saw."""
    key = keys.stage_key("r", 1, "measurement")
    sent = [(key, b"\xc1garbage", 50), (key, b"", 60), ("weather/wind", msgpack.packb({"speed": 3.0}), 70)]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        found = list(recording.records())
        assert [(r.topic, r.data, r.log_time_ns) for r in found] == sent
        assert all((r.publish_time_ns, r.sequence) == (r.log_time_ns, 0) for r in found)
        assert recording.statistics == {key: Gaps(unreadable=2), "weather/wind": Gaps(unreadable=1)}


def test_a_method_brings_stages_of_its_own(tmp_path: Path) -> None:
    stage = Stage("consensus_round", (Field("omega", Kind.MATRIX, ("nx", "nx")),))
    message = Message(1, 1, stage.name, 0, 1, 5, {"omega": np.eye(2)})
    sent = [(keys.stage_key("r", 1, stage.name), encode(message), 9)]
    path = record(tmp_path / "r.mcap", sent, stages=[stage])
    with path.open("rb") as file:
        ((schema, _, _),) = make_reader(file).iter_messages()
        assert schema is not None
        assert schema.name == "zfusion.ConsensusRound"
        assert "omega" in json.loads(schema.data)["properties"]
    assert read(path) == sent


def test_arrival_times_never_go_back_and_order_is_kept(tmp_path: Path) -> None:
    sent = [(keys.truth_key("r"), bytes([n]), at) for n, at in enumerate([100, 90, 110, 105, 120])]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        assert [(r.data[0], r.log_time_ns) for r in recording.records()] == [
            (0, 100), (1, 100), (2, 110), (3, 110), (4, 120),
        ]  # fmt: skip


def test_counters_and_times_at_their_limits(tmp_path: Path) -> None:
    """MCAP counts to 2^32; a publish time of zero would mean that there is none."""
    key = keys.truth_key("r")
    values = [(2**32 + 3, 0), (2**53 - 1, 2**63 - 1)]
    sent = [(key, encode(Message(TRUTH_SENDER, 1, "truth", seq, 1, t_ns, {})), 40) for seq, t_ns in values]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        assert [(r.sequence, r.publish_time_ns) for r in recording.records()] == [(3, 40), (2**32 - 1, 2**63 - 1)]


def test_what_the_caller_knows_is_on_the_file_but_never_in_place_of_what_the_writer_knows(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "r.mcap", facts={"scenario_sha256": "ab", "run": "not this"})
    writer.finish(facts={"queue_peak": "17"})
    with Recording.open(writer.path) as recording:
        assert (recording.metadata["scenario_sha256"], recording.metadata["run"]) == ("ab", "r")
        assert recording.closing["queue_peak"] == "17"


def test_finishing_twice_is_finishing_once(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(2))
    before = path.read_bytes()
    writer = open_writer(path)
    writer.finish()
    once = path.read_bytes()
    writer.finish()
    assert path.read_bytes() == once != before


def test_a_file_holds_so_many_topics_and_counts_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "MAX_TOPICS", 2)
    sent = [(f"zfusion/r/node/{n}/estimate", b"\x80", 1) for n in (1, 2, 3, 2)]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        assert [r.topic[-10] for r in recording.records()] == ["1", "2", "2"]
        assert recording.closing["refused"] == "1"


def test_a_file_that_cannot_be_made_and_one_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"nowhere/r\.mcap: cannot be written: No such file"):
        open_writer(tmp_path / "nowhere" / "r.mcap")
    with pytest.raises(RunError, match="/dev/full: writing failed: No space left"):
        open_writer(Path("/dev/full"))


def test_a_file_that_is_being_written_is_refused_to_others_and_left_as_it_is(tmp_path: Path) -> None:
    path, sent = tmp_path / "r.mcap", traffic(20)
    with open_writer(path) as writer:
        for message in sent:
            writer.write(*message)
        with pytest.raises(RecordingError, match=r"r\.mcap: cannot be written: another process is writing it"):
            open_writer(path)
        with Recording.open(path) as recording:  # reading is for everybody
            assert not recording.complete
    assert read(path) == sent
    assert read(record(path, sent[:3])) == sent[:3], "and for the next one when it is done"


def test_a_disk_that_fills_up_costs_what_came_after(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: in a process of its own, as it cannot be lifted again."""
    path = tmp_path / "r.mcap"
    limited = subprocess.run(
        [sys.executable, "-c", FULL, str(path)], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert limited.stdout == f"{path}: writing failed: File too large\n{path}: the recording is closed\n"
    with Recording.open(path) as recording:
        assert not recording.complete
        assert contents(recording) == traffic(40)[:100]


FULL = """
import resource, signal, sys
from recordings import open_writer, traffic
from zfusion.errors import RunError
from pathlib import Path

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
path = Path(sys.argv[1])
sent = traffic(40)
try:
    with open_writer(path) as writer:
        for message in sent[:100]:
            writer.write(*message)
        writer.flush()
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000,) * 2)
        for message in sent[100:]:
            writer.write(*message)
        writer.flush()
except RunError as error:
    print(error)
try:
    writer.write(*sent[0])
except RunError as error:
    print(error)
"""


# --- broken off -------------------------------------------------------------------------------------------------

KILLED = """
import sys
from recordings import open_writer, traffic
from pathlib import Path

writer = open_writer(Path(sys.argv[1]))
sent = traffic(400)
for message in sent[:1000]:
    writer.write(*message)
writer.flush()
for message in sent[1000:]:
    writer.write(*message)
print("written", flush=True)
sys.stdin.read()
"""


def test_what_was_flushed_survives_sigkill(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=ENVIRONMENT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    with Recording.open(path) as recording:
        assert not recording.complete
        assert "1000 messages" in recording.note
        assert contents(recording) == traffic(400)[:1000]
        assert recording.scenario_toml == SCENARIO_TOML
        assert recording.statistics is None


def test_a_recorder_killed_at_once_leaves_a_readable_file(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "r.mcap")
    with Recording.open(writer.path) as recording:
        assert not recording.complete
        assert (recording.metadata["run"], recording.messages) == ("r", 0)
    writer.finish()


def open_or_refuse(path: Path) -> Recording | None:
    """The recording; None if it is refused in words that begin with the file's name."""
    try:
        return Recording.open(path)
    except RecordingError as error:
        if not str(error).startswith(str(path)):
            raise
        return None


def test_every_beginning_of_a_recording_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    sent = traffic(4)
    path = record(tmp_path / "r.mcap", sent, flush_every=6)
    seen, refused = set(), 0
    for size in range(path.stat().st_size - 1, -1, -1):
        os.truncate(path, size)
        if (recording := open_or_refuse(path)) is None:
            refused += 1
            continue
        assert not refused, "a shorter file was read, a longer one was not"
        with recording:
            found = contents(recording)
            assert not recording.complete
            assert f"{len(found)} messages" in recording.note
        assert found == sent[: len(found)]
        seen.add(len(found))
    assert seen == {0, 6, 12, 18, len(sent)}
    assert refused < 2500, "only what comes before the end of the scenario may be too little"


def test_a_tail_of_zeros_as_a_power_cut_leaves_it(tmp_path: Path) -> None:
    sent = traffic(4)
    writer = open_writer(tmp_path / "r.mcap")
    for message in sent:
        writer.write(*message)
    writer.flush()
    flushed = writer.path.read_bytes()
    writer.finish()
    writer.path.write_bytes(flushed + bytes(5000))
    with Recording.open(writer.path) as recording:
        assert not recording.complete
        assert contents(recording) == sent
    writer.path.write_bytes(flushed + bytes(5000) + b"\x01")
    with pytest.raises(RecordingError, match=f"damaged at byte {len(flushed)}"):
        Recording.open(writer.path)


# --- damaged, or something else ---------------------------------------------------------------------------------


def flips(data: bytes) -> Iterator[bytes]:
    random = Random(3)
    for position in range(len(data)):
        yield data[:position] + bytes([data[position] ^ random.randint(1, 255)]) + data[position + 1 :]


def test_a_flipped_byte_anywhere_is_never_returned_as_data(tmp_path: Path) -> None:
    sent = traffic(4)
    path = record(tmp_path / "r.mcap", sent, flush_every=6)
    with Recording.open(path) as recording:
        facts = recording.metadata
    data, refused = path.read_bytes(), 0
    for altered in flips(data):
        path.write_bytes(altered)
        if (recording := open_or_refuse(path)) is None:
            refused += 1
            continue
        with recording:
            assert contents(recording) == sent
            assert (recording.scenario_toml, recording.metadata) == (SCENARIO_TOML, facts)
    assert refused >= len(data) - 8, "only the last magic may be wrong: the file looks broken off then"


def test_a_flipped_byte_in_a_recording_that_was_broken_off(tmp_path: Path) -> None:
    """No checksum covers the whole: what is returned is right all the same, or the file just seems shorter."""
    sent = traffic(4)
    writer = open_writer(tmp_path / "r.mcap")
    for number, message in enumerate(sent):
        writer.write(*message)
        if number % 6 == 5:
            writer.flush()
    data = writer.path.read_bytes()
    writer.finish()
    with Recording.open(writer.path) as recording:
        facts = recording.metadata
    for altered in flips(data):
        writer.path.write_bytes(altered)
        if (recording := open_or_refuse(writer.path)) is None:
            continue
        with recording:
            found = contents(recording)
            assert found == sent[: len(found)]
            assert (recording.scenario_toml, recording.metadata) == (SCENARIO_TOML, facts)


def test_a_wiped_block_is_found_when_the_file_is_opened(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200))
    data = bytearray(path.read_bytes())
    data[15000:15100] = bytes(100)
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=r"damaged at byte \d+: the checksum of the data section does not agree"):
        Recording.open(path)


def test_damage_that_comes_after_opening(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200))
    with Recording.open(path) as recording:
        with path.open("r+b") as file:
            file.seek(15000)
            file.write(bytes(100))
        with pytest.raises(RecordingError, match=r"r\.mcap: damaged at byte"):
            list(recording.records())
        os.truncate(path, 3000)
        with pytest.raises(RecordingError, match="shorter"):
            list(recording.records())


def foreign(path: Path, metadata: dict[str, str] | None = None, scenario: bytes = b"x", **options: Any) -> Path:
    """An MCAP file as other programs make them, with zfusion's metadata if given."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        if metadata is not None:
            writer.add_metadata(RECORDING, metadata)
            if scenario:
                writer.add_attachment(0, 0, SCENARIO, "", scenario)
        channel = writer.register_channel("zfusion/r/truth", "msgpack", 0)
        for number in range(5):
            writer.add_message(channel, number + 1, b"abc", number + 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


OURS = {"format": "1", "run": "r", "method": "m", "seed": ""}


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda path: None, "cannot be read: No such file"),
        (lambda path: path.mkdir(), "cannot be read: Is a directory"),
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_bytes(b"PK\x03\x04" * 9), "is not an MCAP file"),
        (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "ends at byte 8, before it says what it is"),
        (foreign, "not a recording of zfusion's"),
        (lambda path: foreign(path, sealed(OURS | {"format": "2"})), "is a recording of format 2; this zfusion reads"),
        (lambda path: foreign(path, OURS | {CHECKSUM: "0"}), "checksum of a zfusion.recording"),
        (lambda path: foreign(path, OURS), "checksum of a zfusion.recording"),
        (lambda path: foreign(path, sealed(OURS), scenario=b""), "has no scenario.toml"),
        (lambda path: foreign(path, sealed(OURS), scenario=b"\xff"), "'utf-8' codec can't decode"),
        (lambda path: foreign(path, sealed(OURS), use_chunking=False), "a record of type 5 among the data"),
        (lambda path: foreign(path, sealed(OURS), enable_crcs=False), "the checksum of the chunk does not agree"),
    ],
)
def test_what_is_no_recording_of_ours_is_refused(
    tmp_path: Path, make: Callable[[Path], object], complaint: str
) -> None:
    path = tmp_path / "r.mcap"
    make(path)
    with pytest.raises(RecordingError) as error:
        Recording.open(path)
    assert complaint in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("compression", CompressionType)
def test_a_recording_that_another_tool_rewrote_is_read(tmp_path: Path, compression: CompressionType) -> None:
    """Without a checksum of the data section, as most tools write: every chunk is proven instead."""
    path = foreign(tmp_path / "r.mcap", sealed(OURS), compression=compression)
    with Recording.open(path) as recording:
        assert recording.complete
        assert contents(recording) == [("zfusion/r/truth", b"abc", number + 1) for number in range(5)]
        assert (recording.topics, recording.start_ns, recording.end_ns) == ({"zfusion/r/truth": 5}, 1, 5)


# --- gaps -------------------------------------------------------------------------------------------------------


@given(
    st.dictionaries(st.integers(1, 4), st.lists(st.integers(0, 12), max_size=25), max_size=3),
    st.randoms(use_true_random=False),
)
def test_gaps_are_what_sets_say_they_are(lives: dict[int, list[int]], random: Random) -> None:
    """Beside an oracle that remembers everything: any loss, any order, any repetition, lives in any order."""
    lives = {born: seqs for born, seqs in lives.items() if seqs}
    arrivals = [(born, seq) for born, seqs in lives.items() for seq in seqs]
    random.shuffle(arrivals)
    counter, reordered = GapCounter(), 0
    for number, (born, seq) in enumerate(arrivals):
        counter.observe(born, seq)
        before = [s for b, s in arrivals[:number] if b == born]
        reordered += bool(before) and seq < max(before) and seq not in before
    sent = {born: max(seqs) + 1 + random.randint(0, 3) for born, seqs in lives.items()}
    found = counter.gaps(sent)
    assert found.received == sum(len(set(seqs)) for seqs in lives.values())
    assert found.duplicates == len(arrivals) - found.received
    assert found.reordered == reordered
    assert found.lost_before == sum(min(seqs) for seqs in lives.values())
    assert found.lost_between == sum(max(s) - min(s) + 1 - len(set(s)) for s in lives.values())
    assert found.lost_after == sum(sent[born] - max(seqs) - 1 for born, seqs in lives.items())
    assert found.lost == sum(sent.values()) - found.received
    assert found.restarts == max(0, len(lives) - 1)
    assert counter.gaps().lost_after == 0


def test_a_life_of_which_nothing_came_is_lost_altogether() -> None:
    counter = GapCounter()
    for seq in range(5):
        counter.observe(1, seq)
    assert counter.gaps({1: 5, 9: 40}) == Gaps(received=5, lost_after=40, restarts=1)


def test_a_forger_of_counters_cannot_make_the_account_grow_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gaps_module, "MAX_HOLES", 3)
    monkeypatch.setattr(gaps_module, "MAX_LIVES", 2)
    counter = GapCounter()
    for seq in range(0, 20, 2):
        counter.observe(1, seq)
    counter.observe(1, 1)  # its hole is no longer remembered
    counter.observe(1, 17)
    assert counter.gaps() == Gaps(received=11, duplicates=1, reordered=1, lost_between=8)
    for born in (2, 3, 4, 1):
        counter.observe(born, 20 if born == 1 else 0)
    assert (counter.gaps().received, counter.gaps().restarts, counter.gaps().unreadable) == (13, 1, 2)


def lossy(path: Path, **finish: Any) -> bytes:
    """A recording of node 1's measurements without its first and its fourth, and again after a restart.

    Returns what was on the disk before it was finished.
    """
    key = keys.stage_key("r", 1, "measurement")
    writer = open_writer(path)
    for born, seq in [(1, 1), (1, 2), (1, 4), (8, 0)]:
        message = Message(1, born + seq, "measurement", seq, born, 10, {"y": None})
        writer.write(key, encode(message), 20)
    writer.flush()
    broken_off = path.read_bytes()
    writer.finish(**finish)
    return broken_off


def test_the_account_is_on_the_file(tmp_path: Path) -> None:
    key, silent = keys.stage_key("r", 1, "measurement"), keys.stage_key("r", 2, "measurement")
    path = tmp_path / "r.mcap"
    lossy(path, sent={key: {1: 7, 8: 1}, silent: {1: 3}})
    account = Gaps(received=4, lost_before=1, lost_between=1, lost_after=2, restarts=1)
    with Recording.open(path) as recording:
        assert recording.statistics == {key: account, silent: Gaps(lost_after=3)}
        summary = info(recording)
    assert summary.lost == 7
    assert [(t.node, t.stage, t.messages) for t in summary.topics] == [("1", "measurement", 4), ("2", "measurement", 0)]


def test_the_account_of_a_recording_that_was_broken_off_is_made_anew(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(lossy(path))
    with Recording.open(path) as recording:
        summary = info(recording)
    assert not summary.complete
    assert summary.topics[0].gaps == Gaps(received=4, lost_before=1, lost_between=1, restarts=1)


# --- information and export -------------------------------------------------------------------------------------


def test_info_is_one_json_object(tmp_path: Path) -> None:
    sent = traffic(20)
    path = record(tmp_path / "r.mcap", sent, facts={"world": "simulated"})
    with Recording.open(path) as recording:
        told = json.loads(json.dumps(info(recording).as_dict()))
    assert (told["run"], told["method"], told["seed"], told["complete"]) == ("r", "two_stage", 7, True)
    assert (told["messages"], told["lost"], told["duration_ns"]) == (len(sent), 0, 19_000_000)
    assert told["path"] == str(path)
    assert told["facts"]["world"] == "simulated"
    assert told["versions"]["numpy"] == np.__version__
    assert {topic["topic"]: topic["messages"] for topic in told["topics"]} == Counter(topic for topic, _, _ in sent)


def test_csv_is_tidy_and_exact(tmp_path: Path) -> None:
    sent = [*traffic(4), (keys.truth_key("r"), b"garbage", START_NS + 10**9)]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        done = export(recording, tmp_path / "r.csv", "csv")
    assert (done.messages, done.unreadable) == (len(sent) - 1, 1)
    with (tmp_path / "r.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    original = decode_any(sent[2][1])
    (estimate, *_) = [r for r in rows if (r["node"], r["stage"], r["step"]) == ("1", "estimate", "1")]
    assert int(estimate["log_time_ns"]) == int(estimate["t_ns"]) + 7_000 == sent[2][2]
    first = [r for r in rows if (r["node"], r["stage"], r["step"]) == ("1", "estimate", "1")]
    assert [float(r["value"]) for r in first if r["field"] == "x"] == original["x"]
    P = {(int(r["row"]), int(r["column"])): float(r["value"]) for r in first if r["field"] == "P"}
    assert [P[0, 0], P[0, 1], P[1, 0], P[1, 1]] == original["P"]
    assert [(r["field"], r["value"]) for r in first[-2:]] == [("used", "[1]"), ("excluded", "[]")]
    nil = [r for r in rows if (r["stage"], r["step"]) == ("measurement", "3")]
    assert [(r["field"], r["row"], r["value"]) for r in nil] == [("y", "", "")] * 2
    assert {r["node"] for r in rows if r["stage"] == "truth"} == {""}


def test_json_lines_are_the_messages(tmp_path: Path) -> None:
    odd = msgpack.packb({"value": [float("nan"), 1.0], "name": "é"})
    sent = [*traffic(4), ("weather/wind", odd, START_NS + 10**9)]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        export(recording, tmp_path / "r.jsonl", "jsonl")
    lines = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [(line["topic"], line["log_time_ns"]) for line in lines] == [(topic, at) for topic, _, at in sent]
    assert [line["message"] for line in lines[:-1]] == [decode_any(data) for _, data, _ in sent[:-1]]
    assert lines[-1]["message"] == {"value": [None, 1.0], "name": "é"}


def test_npz_has_one_array_per_topic_and_field(tmp_path: Path) -> None:
    sent = traffic(6)
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        done = export(recording, tmp_path / "r.npz", "npz")
    estimates = [decode_any(data) for topic, data, _ in sent if topic.endswith("1/estimate")]
    with np.load(tmp_path / "r.npz") as arrays:
        assert arrays["1/estimate/x"].tolist() == [message["x"] for message in estimates]
        assert arrays["1/estimate/P"].reshape(6, 4).tolist() == [message["P"] for message in estimates]
        assert arrays["1/estimate/P"].shape == (6, 2, 2)
        assert arrays["1/estimate/step"].tolist() == [1, 2, 3, 4, 5, 6]
        assert np.isnan(arrays["2/measurement/y"][:, 0]).tolist() == [False, False, True] * 2
        assert arrays["truth/x"].shape == (6, 2)
        assert arrays["truth/log_time_ns"].dtype == np.int64
    assert set(done.left_out) == {f"{node}/estimate/{name}" for node in (1, 2) for name in ("used", "excluded")}


def test_npz_leaves_out_what_is_not_one_shape_throughout(tmp_path: Path) -> None:
    payloads = [{"a": [1.0], "b": [1.0], "c": 1}, {"a": [1.0, 2.0], "c": 2**63}, {"a": [1.0], "b": [2.0], "c": 3}]
    sent = [("weather", msgpack.packb(payload), 5) for payload in payloads]
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        done = export(recording, tmp_path / "r.npz", "npz")
    assert set(done.left_out) == {"weather/a", "weather/b", "weather/c"}


def test_a_selection_is_exported(tmp_path: Path) -> None:
    sent = traffic(6)
    with Recording.open(record(tmp_path / "r.mcap", sent)) as recording:
        done = export(recording, tmp_path / "r.csv", "csv", topics=[keys.truth_key("r")], start_ns=sent[12][2])
    assert done.messages == 4


def test_exports_that_cannot_be(tmp_path: Path) -> None:
    with Recording.open(record(tmp_path / "r.mcap", traffic(1))) as recording:
        with pytest.raises(InputError, match="export format 'xlsx': expected one of csv, jsonl, npz"):
            export(recording, tmp_path / "r.xlsx", "xlsx")
        for name in FORMATS:
            with pytest.raises(InputError, match="cannot be written"):
                export(recording, tmp_path / "nowhere" / "r", name)


def test_no_export_replaces_what_it_reads(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), keeping=Keeping(rotate_bytes=20_000))
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert len(before) > 2
    for source, target in ((path, path), (path, segment_path(path, 1)), (segment_path(path, 2), path)):
        for name in FORMATS:
            with Recording.open(source) as recording, pytest.raises(InputError, match="is one of the recordings"):
                export(recording, target, name)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(
    ("felled_by", "expected"),
    [(KeyboardInterrupt(), KeyboardInterrupt), (OSError(errno.ENOSPC, "No space left on device"), RunError)],
)
def test_an_export_that_ends_in_the_middle_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, felled_by: BaseException, expected: type[BaseException]
) -> None:
    numbers = count()

    def fail_at_ten(data: bytes) -> dict[str, Any]:
        if next(numbers) == 10:
            raise felled_by
        return decode_any(data)

    monkeypatch.setattr(export_module, "decode_any", fail_at_ten)
    (tmp_path / "out").write_text("of before")
    with Recording.open(record(tmp_path / "r.mcap", traffic(20))) as recording, pytest.raises(expected):
        export(recording, tmp_path / "out", name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "r.mcap"]
    assert (tmp_path / "out").read_text() == "of before"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")
def test_an_export_onto_a_full_device_fails(tmp_path: Path) -> None:
    with Recording.open(record(tmp_path / "r.mcap", traffic(20))) as recording:
        for name in FORMATS:
            with pytest.raises(RunError, match="/dev/full: writing failed: No space left"):
                export(recording, "/dev/full", name)
    assert Path("/dev/full").is_char_device()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for read_it in (Recording.open, lambda path: recover(path, tmp_path / "g.mcap")):
        with pytest.raises(RecordingError, match=r"pipe: cannot be read: is not a regular file"):
            read_it(tmp_path / "pipe")
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_the_documentation_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parent.parent / "docs" / "recordings.md").read_text(encoding="utf-8")
    (tmp_path / "recordings").mkdir()
    record(tmp_path / "recordings" / "run.mcap", traffic(4))
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) >= 2
    for block in blocks:
        exec(block, {})


def test_a_recording_knows_whether_its_bits_can_be_had_here(tmp_path: Path) -> None:
    with Recording.open(record(tmp_path / "r.mcap", [])) as recording:
        assert arithmetic_differences(recording.metadata) == {}
        elsewhere = {**recording.metadata, "cpu": "Z80", "host": "another"}
        assert arithmetic_differences(elsewhere) == {"cpu": ("Z80", machine()["cpu"])}
