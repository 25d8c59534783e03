"""Recordings made of recordings: of segments, of what several recorders heard, of some steps and nodes."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from random import Random

import msgpack
import pytest

from recordings import START_NS, contents, open_writer, read, read_plainly, record, traffic
from simulations import record as record_simulation
from simulations import records
from swarms import zfusion
from test_recover import peak_memory
from zfusion.drivers.replayed import verify
from zfusion.errors import InputError
from zfusion.messages import decode_any
from zfusion.model.scenario import load_scenario
from zfusion.recording import Gaps, Keeping, Recording
from zfusion.recording import merge as merge_module
from zfusion.recording.cut import cut
from zfusion.recording.layout import segment_path
from zfusion.recording.merge import merge

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"


# --- merge ------------------------------------------------------------------------------------------------------


def test_segments_become_one_file(tmp_path: Path) -> None:
    sent = traffic(200)
    path = record(tmp_path / "r.mcap", sent, keeping=Keeping(rotate_bytes=20_000))
    files = sorted(tmp_path.glob("r*.mcap"))
    with Recording.open(path) as recording:
        statistics = recording.statistics
    for number, sources in enumerate(([path], files, [files[2], path])):
        output = tmp_path / f"m{number}.mcap"
        told = merge(sources, output)
        assert (told.messages, told.duplicates, told.conflicts) == (1000, 0, 0)
        assert read_plainly(output) == sent
        with Recording.open(output) as recording:
            assert (recording.complete, recording.derived["kind"]) == (True, "merged")
            assert recording.statistics == statistics


def test_what_two_recorders_heard_is_put_together_and_nothing_is_there_twice(tmp_path: Path) -> None:
    """Each lacks something, one came late, and their clocks differ."""
    sent, random = traffic(100), Random(4)
    here = [message for message in sent if random.random() > 0.2]
    there = [(topic, data, at + 5_000_000) for topic, data, at in sent if random.random() > 0.2]
    a, b = record(tmp_path / "a.mcap", here), record(tmp_path / "b.mcap", there)
    told = merge([a, b], tmp_path / "m.mcap")
    found = read_plainly(tmp_path / "m.mcap")
    everything = {(topic, data) for topic, data, _ in here + there}
    assert Counter((topic, data) for topic, data, _ in found) == Counter(everything)
    assert told.duplicates == len(here) + len(there) - len(everything)
    assert (told.conflicts, told.still_twice) == (0, 0)
    assert [at for *_, at in found] == sorted(at for *_, at in found)
    assert set(found) <= {*here, *there}


def test_what_was_twice_on_the_wire_stays_twice(tmp_path: Path) -> None:
    key, payload = traffic(1)[1][:2]
    a = record(tmp_path / "a.mcap", [(key, payload, START_NS), (key, payload, START_NS + 5), (key, b"?", START_NS)])
    b = record(tmp_path / "b.mcap", [(key, payload, START_NS + 9)])
    told = merge([a, b], tmp_path / "m.mcap")
    assert (told.messages, told.duplicates, told.still_twice) == (3, 1, 1)


def test_messages_of_the_same_counters_that_differ_are_kept_and_counted(tmp_path: Path) -> None:
    one, two = ({"v": 1, "node": 1, "step": 1, "t_ns": 1, "seq": 0, "born": 1, "y": [y]} for y in (1.0, 2.0))
    key = "zfusion/r/node/1/measurement"
    paths = [record(tmp_path / f"{n}.mcap", [(key, msgpack.packb(m), START_NS)]) for n, m in enumerate((one, two))]
    told = merge(paths, tmp_path / "m.mcap")
    assert (told.messages, told.duplicates, told.conflicts, told.conflicting) == (2, 0, 1, (key,))
    result = zfusion(tmp_path, "merge", *paths, "-o", "again.mcap", "--json")
    assert (result.code, result.summary["conflicts"]) == (1, 1)


def test_duplicates_too_far_apart_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(merge_module, "WINDOW", 50)
    sent = traffic(40)
    a = record(tmp_path / "a.mcap", sent)
    b = record(tmp_path / "b.mcap", [(topic, data, at + 10**9) for topic, data, at in sent])
    told = merge([a, b], tmp_path / "m.mcap")
    assert (told.messages, told.duplicates, told.still_twice) == (400, 0, 200)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"run": "other"}, r"b\.mcap: run: expected 'r', as in .*a\.mcap \(is 'other'\)"),
        ({"seed": 8}, r"b\.mcap: seed: expected '7'"),
        ({"method": "local"}, r"b\.mcap: method: expected 'two_stage'"),
        ({"scenario_toml": "x"}, r"b\.mcap: scenario.toml: expected the same as"),
    ],
)
def test_other_runs_are_refused(tmp_path: Path, change: dict[str, object], complaint: str) -> None:
    a, b = record(tmp_path / "a.mcap", traffic(2)), record(tmp_path / "b.mcap", traffic(2), **change)
    with pytest.raises(InputError, match=complaint):
        merge([a, b], tmp_path / "m.mcap")
    assert not list(tmp_path.glob("m*"))


def test_an_input_is_never_replaced(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(200), keeping=Keeping(rotate_bytes=20_000))
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    for output in (path, segment_path(path, 1)):
        with pytest.raises(InputError, match="is one of the recordings that are read"):
            merge([path], output)
        with pytest.raises(InputError, match="is one of the recordings that are read"):
            cut(path, output)
    with pytest.raises(InputError, match="is one of the recordings that are read"):
        cut(segment_path(path, 2), path)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_what_is_missing_of_a_part_is_told_by_the_whole(tmp_path: Path) -> None:
    writer = open_writer(tmp_path / "a.mcap")
    for message in traffic(10):
        writer.write(*message)
    writer.flush()
    shutil.copy(writer.path, tmp_path / "broken.mcap")
    writer.finish()
    merge([tmp_path / "broken.mcap"], tmp_path / "m.mcap")
    with Recording.open(tmp_path / "m.mcap") as recording:
        assert not recording.complete
        assert recording.note.startswith("broken.mcap: broken off: it holds 50 messages")


def test_parts_that_are_all_of_a_recording_are_complete(tmp_path: Path) -> None:
    sent = traffic(30)
    path = record(tmp_path / "r.mcap", sent)
    a, b, c, one, other = (tmp_path / f"{name}.mcap" for name in ("a", "b", "c", "one", "other"))
    for output, steps in ((a, range(1, 20)), (b, range(10, 31)), (c, range(22, 31))):
        cut(path, output, steps=steps)
    cut(path, one, nodes=["1"])
    cut(path, other, nodes=["2"])
    for sources, complete in (
        ([a, b], True),
        ([one, other], True),
        ([path, b], True),
        ([a, c], False),
        ([a, one], False),
        ([b], False),
    ):
        merge(sources, tmp_path / "m.mcap")
        with Recording.open(tmp_path / "m.mcap") as recording:
            assert (recording.complete, not recording.note) == (complete, complete), sources
            assert complete is (sorted(contents(recording)) == sorted(sent))


def test_parts_of_what_is_a_part_are_not_complete(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(30))
    cut(path, tmp_path / "half.mcap", steps=range(1, 16))
    for name, steps in (("a", range(1, 9)), ("b", range(5, 16))):
        cut(tmp_path / "half.mcap", tmp_path / f"{name}.mcap", steps=steps)
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "m.mcap")
    with Recording.open(tmp_path / "m.mcap") as recording:
        assert not recording.complete


# --- cut --------------------------------------------------------------------------------------------------------


def test_steps_and_nodes_are_cut_out(tmp_path: Path) -> None:
    sent = traffic(50)
    path = record(tmp_path / "r.mcap", sent, keeping=Keeping(rotate_bytes=10_000))
    told = cut(path, tmp_path / "c.mcap", steps=range(11, 21), nodes=["2"])
    expected = [
        message for message in sent if 11 <= decode_any(message[1])["step"] <= 20 and "/node/1/" not in message[0]
    ]
    assert read_plainly(tmp_path / "c.mcap") == expected
    assert (told.messages, told.left_out, told.what) == (len(expected), 250 - len(expected), "steps 11 to 20 of node 2")
    with Recording.open(tmp_path / "c.mcap") as recording:
        assert not recording.complete
        assert "cut from r.mcap: steps 11 to 20 of node 2; estimates cannot be recomputed from it" in recording.note
        assert recording.statistics is not None
        assert recording.statistics[expected[1][0]] == Gaps(received=10)


def test_what_says_no_step_is_left_out_and_counted(tmp_path: Path) -> None:
    sent = [*traffic(3), ("zfusion/r/node/1/estimate", b"garbage", START_NS + 10**9)]
    path = record(tmp_path / "r.mcap", sent)
    assert cut(path, tmp_path / "c.mcap", steps=range(1, 3)).without_step == 1
    cut(path, tmp_path / "c.mcap", nodes=["1"])
    assert read(tmp_path / "c.mcap")[-1] == sent[-1]


def test_a_node_that_is_named_again_is_one_node(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(3))
    assert cut(path, tmp_path / "c.mcap", nodes=["1", "1", "1"]).what == "all steps of node 1"


def test_cuts_of_nothing_are_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(3))
    with pytest.raises(InputError, match=r"r\.mcap: steps 7 to 9 of all nodes: there is nothing of these on it"):
        cut(path, tmp_path / "c.mcap", steps=range(7, 10))
    with pytest.raises(InputError, match=r"r\.mcap: node 9: expected some of 1, 2"):
        cut(path, tmp_path / "c.mcap", nodes=["1", "9"])
    with pytest.raises(InputError, match=r"r\.mcap: node '': expected some of 1, 2"):
        cut(path, tmp_path / "c.mcap", nodes=["1", "", "2"])
    assert not list(tmp_path.glob("c*"))


def test_what_can_be_proven_of_a_cut(tmp_path: Path) -> None:
    path = record_simulation(tmp_path / "r.mcap", load_scenario(EXAMPLE, steps=20))
    verdicts = []
    for steps in (range(1, 11), range(5, 11)):
        cut(path, tmp_path / "c.mcap", steps=steps)
        with Recording.open(tmp_path / "c.mcap") as recording:
            verdicts.append(verify(recording))
    beginning, middle = verdicts
    assert beginning.verified
    assert (beginning.identical, beginning.unverifiable, beginning.missing_count) == (10 * 4 * 2, 0, 0)
    assert "its estimates can be recomputed" in beginning.note
    assert (middle.verified, middle.different) == (False, 0)
    assert "they rest on the steps before 5" in middle.note


def test_a_cut_of_a_cut_and_of_what_was_merged(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(30))
    merge([path], tmp_path / "m.mcap")
    cut(tmp_path / "m.mcap", tmp_path / "c.mcap", steps=range(1, 21))
    cut(tmp_path / "c.mcap", tmp_path / "d.mcap", steps=range(11, 31))
    assert {decode_any(record.data)["step"] for record in records(tmp_path / "d.mcap")} == set(range(11, 21))
    with Recording.open(tmp_path / "d.mcap") as recording:
        assert "cut from m.mcap: steps 1 to 20" in recording.note
        assert "cut from c.mcap: steps 11 to 30" in recording.note


def test_memory_does_not_grow_with_the_files(tmp_path: Path) -> None:
    def both(path: Path) -> None:
        merge([path, other], tmp_path / "m.mcap")
        cut(path, tmp_path / "c.mcap", nodes=["1"])

    random, peaks = Random(1), []
    for number in (400, 1200):
        sent = []
        for n in range(number):
            payload = {"v": 1, "node": 1, "step": n + 1, "t_ns": 1, "seq": n, "born": 1, "y": random.randbytes(10_000)}
            sent.append(("zfusion/r/node/1/measurement", msgpack.packb(payload), START_NS + n))
        path, other = record(tmp_path / "a.mcap", sent), record(tmp_path / "b.mcap", sent[::2])
        del sent
        peaks.append(peak_memory(lambda path=path: both(path)))  # type: ignore[misc]
    assert peaks[1] < peaks[0] + 2_000_000


STOPPED_IN_THE_MIDDLE = """
import os, sys
from zfusion.cli import run
from zfusion.recording.derived import DerivedWriter

number = int(sys.argv.pop(1))
DerivedWriter.add = lambda *_: os.kill(os.getpid(), number)
run()
"""


@pytest.mark.parametrize(
    ("command", "number"), [("recover", signal.SIGTERM), ("merge", signal.SIGHUP), ("cut", signal.SIGINT)]
)
def test_who_is_stopped_in_the_middle_leaves_nothing(tmp_path: Path, command: str, number: signal.Signals) -> None:
    record(tmp_path / "r.mcap", traffic(20))
    arguments = [sys.executable, "-c", STOPPED_IN_THE_MIDDLE, str(int(number)), command, "r.mcap", "-o", "o.mcap"]
    done = subprocess.run(arguments, cwd=tmp_path, timeout=90, check=False)
    assert done.returncode == 130
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]


def test_the_commands(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", traffic(20))
    data = path.read_bytes()
    (tmp_path / "broken.mcap").write_bytes(data[: len(data) // 2])
    recovered = zfusion(tmp_path, "recover", "broken.mcap", "-o", "good.mcap", "--json")
    assert (recovered.code, recovered.summary["lossy"], recovered.summary["end_is_missing"]) == (1, True, True)
    assert zfusion(tmp_path, "info", "good.mcap").code == 0
    done = zfusion(tmp_path, "cut", "r.mcap", "--steps", "2:4", "--nodes", "1", "-o", "c.mcap")
    assert "steps 2 to 4 of node 1: 9 messages" in done.out
    refused = zfusion(tmp_path, "merge", "r.mcap", "c.mcap", "-o", "r.mcap")
    assert (refused.code, refused.error) == (2, "error: r.mcap: is one of the recordings that are read")
    merged = zfusion(tmp_path, "merge", "r.mcap", "c.mcap", "-o", "m.mcap", "--json")
    assert (merged.code, merged.summary["messages"]) == (0, 100)
    assert read(tmp_path / "m.mcap") == traffic(20)
