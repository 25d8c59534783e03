"""Recovering: all that is as it was written is saved, wherever it is by now, and nothing else is ever returned.

What must be saved is told by an oracle that knows nothing of how it is looked for: every block of messages whose bytes
are all there, one after the other, somewhere in the damaged file.
"""

from __future__ import annotations

import json
import tracemalloc
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import NamedTuple

import msgpack
import pytest
from hypothesis import strategies as st
from mcap.reader import make_reader

from drawing import TIMEOUT_S, fuzz
from recordings import START_NS, Sent, contents, open_writer, read_plainly, record, traffic
from simulations import record as record_simulation
from zfusion.drivers.replayed import verify
from zfusion.errors import InputError, RecordingError
from zfusion.model.scenario import load_scenario
from zfusion.recording import Keeping, Recording
from zfusion.recording.layout import CHANNELS, RECORDING, segment_path
from zfusion.recording.recover import Recovery, recover

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"


class Original(NamedTuple):
    data: bytes
    blocks: list[tuple[bytes, Sent]]
    """A block's bytes, and the messages in it."""
    origins: list[bytes]
    """Bytes of what says what the recording is."""
    tables: list[bytes]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    sent = traffic(60)
    path = record(tmp_path_factory.mktemp("original") / "r.mcap", sent, flush_every=25)
    data = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        blocks = []
        for number, index in enumerate(summary.chunk_indexes):
            start = index.chunk_start_offset
            blocks.append((data[start : start + index.chunk_length], sent[25 * number : 25 * number + 25]))
    told = [(index.name, data[index.offset : index.offset + index.length]) for index in summary.metadata_indexes]
    tables = [of for name, of in told if name == CHANNELS]
    origins = [of for name, of in told if name == RECORDING]
    origins += [data[i.offset : i.offset + i.length] for i in summary.attachment_indexes]
    assert (len(blocks), len(tables), len(origins)) == (12, 1, 2)
    return Original(data, blocks, origins, tables)


def flip(data: bytes, random: Random) -> bytes:
    place = random.randrange(len(data))
    return data[:place] + bytes([data[place] ^ random.randint(1, 255)]) + data[place + 1 :]


def zero(data: bytes, random: Random) -> bytes:
    start, length = random.randrange(len(data)), random.choice([1, 50, 4096])
    return data[:start] + bytes(len(data[start : start + length])) + data[start + length :]


def truncate(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data))]


def duplicate(data: bytes, random: Random) -> bytes:
    start, place = random.randrange(len(data)), random.randrange(len(data))
    return data[:place] + data[start : start + random.choice([10, 1000, 6000])] + data[place:]


def remove(data: bytes, random: Random) -> bytes:
    start = random.randrange(len(data))
    return data[:start] + data[start + random.choice([1, 100, 4000]) :]


DAMAGES: list[Callable[[bytes, Random], bytes]] = [flip, zero, truncate, duplicate, remove]


def check(tmp_path: Path, original: Original, damaged: bytes) -> Recovery | None:
    """Recover, and see that what came out is what must, and nothing false; None if nothing can be saved."""
    broken, good = tmp_path / "broken.mcap", tmp_path / "good.mcap"
    broken.write_bytes(damaged)
    good.unlink(missing_ok=True)
    whole = all(part in damaged for part in original.origins) or original.tables[0] in damaged
    try:
        told = recover(broken, good)
    except RecordingError:
        assert not whole
        assert not list(tmp_path.glob("good*"))
        return None
    found = read_plainly(good)
    must = [message for block, messages in original.blocks if block in damaged for message in messages]
    may = [message for _, messages in original.blocks for message in messages]
    assert Counter(found) <= Counter(may), "nothing false, nothing twice"
    channels = original.tables[0] in damaged or original.blocks[0][0] in damaged
    if channels:
        assert Counter(must) <= Counter(found), "everything that is there"
    assert [at for *_, at in found] == sorted(at for *_, at in found)
    with Recording.open(good) as recording:
        assert contents(recording) == found
        assert recording.derived["kind"] == "recovered"
        assert json.loads(recording.derived["account"])["messages"] == told.messages == len(found)
        assert recording.complete is not (told.lossy or told.end_is_missing)
    assert told.lossy or told.end_is_missing or len(found) == len(may)
    return told


@pytest.mark.parametrize("damage", DAMAGES)
def test_at_a_hundred_random_places(
    tmp_path: Path, original: Original, damage: Callable[[bytes, Random], bytes]
) -> None:
    random = Random(damage.__name__)
    told = [check(tmp_path, original, damage(original.data, random)) for _ in range(20)]
    assert sum(one is not None for one in told) >= 10


def test_a_file_that_is_whole_is_recovered_whole(tmp_path: Path, original: Original) -> None:
    told = check(tmp_path, original, original.data)
    assert told is not None
    assert (told.lossy, told.end_is_missing, told.dropped_bytes, told.messages) == (False, False, 0, 300)
    with Recording.open(tmp_path / "good.mcap") as recording:
        assert recording.complete
        assert recording.closing["messages"] == "300"


def test_every_block_but_the_first_is_saved_without_the_first(tmp_path: Path, original: Original) -> None:
    """The first block declares the channels, and the index at the end is gone: the table in between tells them."""
    start = original.data.index(original.blocks[0][0])
    damaged = bytearray(original.data[: original.data.index(original.blocks[-1][0]) + len(original.blocks[-1][0])])
    damaged[start + 60] ^= 1
    told = check(tmp_path, original, bytes(damaged))
    assert told is not None
    assert (told.messages, told.dropped_places, told.orphaned) == (275, 1, {})
    assert told.dropped[0][:2] == (start, len(original.blocks[0][0]))
    assert (told.lossy, told.end_is_missing) == (True, True)


def test_messages_of_channels_that_are_declared_nowhere_are_counted(tmp_path: Path, original: Original) -> None:
    damaged = original.data.replace(original.tables[0], b"").replace(original.blocks[0][0], b"")
    told = check(tmp_path, original, damaged[: damaged.index(original.blocks[-1][0])])
    assert told is not None
    assert (told.messages, sum(told.orphaned.values()), told.lossy) == (0, 250, True)


def test_a_recording_whose_beginning_is_lost(tmp_path: Path, original: Original) -> None:
    told = check(tmp_path, original, original.data[original.data.index(original.origins[1]) + 10 :])
    assert told is not None
    assert told.messages == 300


def test_two_recordings_in_one_file_are_not_taken_for_one(tmp_path: Path, original: Original) -> None:
    other = record(tmp_path / "o.mcap", traffic(2))
    both = tmp_path / "both.mcap"
    both.write_bytes(original.data + other.read_bytes())
    with pytest.raises(RecordingError, match=r"both\.mcap: holds pieces of more than one recording"):
        recover(both, tmp_path / "g.mcap")


def test_what_looks_like_a_block_in_a_damaged_blocks_payload_is_none(tmp_path: Path, original: Original) -> None:
    """A node may publish anything, the bytes of a block of messages too."""
    path = tmp_path / "r.mcap"
    key = "zfusion/r/node/1/estimate"
    forged = original.blocks[0][0]
    record(path, [(key, forged, START_NS), (key, b"true", START_NS)], keeping=Keeping("none"))
    data = bytearray(path.read_bytes())
    data[data.index(b"true")] ^= 1
    path.write_bytes(data)
    told = recover(path, tmp_path / "g.mcap")
    assert (told.messages, told.written, told.lossy) == (0, 2, True)


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda path: None, "cannot be read: No such file"),
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_bytes(bytes(10_000)), "what the recording is of is nowhere on it"),
        (lambda path: path.write_bytes(Random(1).randbytes(100_000)), "what the recording is of is nowhere on it"),
    ],
)
def test_where_nothing_can_be_saved(tmp_path: Path, make: Callable[[Path], object], complaint: str) -> None:
    make(tmp_path / "r.mcap")
    with pytest.raises(RecordingError, match=complaint):
        recover(tmp_path / "r.mcap", tmp_path / "g.mcap")
    assert not list(tmp_path.glob("g*"))


def test_the_file_itself_is_never_replaced(tmp_path: Path, original: Original) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(original.data)
    (tmp_path / "link.mcap").symlink_to(path)
    with pytest.raises(InputError, match=r"link\.mcap: is one of the recordings that are read"):
        recover(path, tmp_path / "link.mcap")
    assert path.read_bytes() == original.data


def test_other_segments_are_never_replaced(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), keeping=Keeping(rotate_bytes=20_000))
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    for source, output in ((path, segment_path(path, 1)), (segment_path(path, 1), path)):
        with pytest.raises(InputError, match="is one of the recordings that are read"):
            recover(source, output)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_recovered_segment_takes_the_place_of_the_broken_one(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), keeping=Keeping(rotate_bytes=20_000))
    broken, size = segment_path(path, 1), len(read_plainly(segment_path(path, 1)))
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 1
    broken.write_bytes(data)
    told = recover(broken, tmp_path / "good.mcap")
    assert told.written == size
    (tmp_path / "good.mcap").rename(broken)
    with Recording.open(path) as recording:
        assert recording.messages == 1000 - size + told.messages
        assert recording.complete is not told.lossy


def test_replay_verifies_what_was_recovered(tmp_path: Path) -> None:
    path = record_simulation(tmp_path / "r.mcap", load_scenario(EXAMPLE, steps=40))
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"zfusion.stats") - 13])
    told = recover(path, tmp_path / "g.mcap")
    assert (told.lossy, told.end_is_missing) == (False, True)
    with Recording.open(tmp_path / "g.mcap") as recording:
        verdict = verify(recording)
    assert verdict.verified
    assert verdict.identical == 40 * 4 * 2
    assert "its end, with the accounts of what was sent, is missing" in verdict.note


def peak_memory(work: Callable[[], object]) -> int:
    """Bytes that are in use at most, of those that Python knows of."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    random, peaks = Random(1), []
    for number in (300, 900):
        path = tmp_path / f"{number}.mcap"
        with open_writer(path) as writer:
            for n in range(number):
                payload = msgpack.packb({"v": 1, "node": 1, "step": n + 1, "t_ns": 1, "seq": n, "born": 1, "y": [1.0]})
                writer.write("zfusion/r/node/1/measurement", payload + random.randbytes(10_000), START_NS + n)
        with path.open("r+b") as file:
            file.seek(path.stat().st_size // 2)
            file.write(bytes(100_000))
        peaks.append(peak_memory(lambda path=path: recover(path, tmp_path / "g.mcap")))  # type: ignore[misc]
        assert number - 250 < len(read_plainly(tmp_path / "g.mcap")) < number
    assert peaks[1] < peaks[0] + 2_000_000


def test_a_long_tail_of_nothing_is_not_taken_into_memory(tmp_path: Path, original: Original) -> None:
    path, tail = tmp_path / "r.mcap", 200_000_000
    path.write_bytes(original.data)
    with path.open("r+b") as file:
        file.truncate(len(original.data) + tail)
    told: list[Recovery] = []
    assert peak_memory(lambda: told.append(recover(path, tmp_path / "g.mcap"))) < tail // 4
    assert told[0].messages == 300
    assert told[0].dropped_bytes >= tail


# --- fuzzing ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.timeout(TIMEOUT_S)
def test_fuzz_any_damages(tmp_path: Path, original: Original) -> None:
    def damaged_in_many_ways(damages: list[tuple[Callable[[bytes, Random], bytes], int]]) -> None:
        data = original.data
        for damage, seed in damages:
            if data:
                data = damage(data, Random(seed))
        check(tmp_path, original, data)

    one = st.tuples(st.sampled_from(DAMAGES), st.integers(0, 2**32))
    fuzz(damaged_in_many_ways, st.lists(one, min_size=1, max_size=8))
