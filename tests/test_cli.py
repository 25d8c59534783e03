"""The commands as a user and a program meet them, in processes of their own."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from click import Command
from typer.core import TyperOption
from typer.main import get_command

from oracles.paper import ERROR_VARIANCES
from zfusion import __version__
from zfusion.__main__ import main
from zfusion.cli import app, run
from zfusion.cli.common import unused

ROOT = Path(__file__).parents[1]
FOUR = str(ROOT / "examples" / "four_sensor.toml")


def zfusion(*arguments: str, cwd: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-m", "zfusion", *arguments], cwd=cwd, capture_output=True, text=True, timeout=90, check=False
    )
    assert done.returncode == code, f"{arguments}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    assert "Traceback" not in done.stderr
    return done


def told(*arguments: str, cwd: Path, code: int = 0) -> dict[str, Any]:
    """What a command prints with --json: one JSON object and nothing else."""
    result = json.loads(zfusion(*arguments, "--json", cwd=cwd, code=code).stdout)
    assert isinstance(result, dict)
    return result


Refused = Callable[..., tuple[str, str]]


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """What a command that ends with exit code 2 says, on both its streams; in this process, which is quicker."""

    def call(*arguments: str) -> tuple[str, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["zfusion", *arguments])
        with pytest.raises(SystemExit) as ended:
            run()
        assert ended.value.code == 2
        out, said = capsys.readouterr()
        return out, said

    return call


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("simulated")
    zfusion("simulate", FOUR, "--steps", "120", "--record", "run.mcap", "--run", "run", cwd=directory)
    return directory / "run.mcap"


def test_design_is_the_papers_table(tmp_path: Path) -> None:
    design = told("design", FOUR, "--steps", "100", cwd=tmp_path)
    assert design["nodes"] == [1, 2, 3, 4]
    assert design["steps"] == 100
    covariances = design["error_covariance"]
    for step, row in ERROR_VARIANCES.items():
        for kind in ("local", "intermediate", "distributed"):
            computed = np.array(covariances[kind][step])
            assert computed.shape == (4, 1, 1)
            np.testing.assert_allclose(computed[:, 0, 0], row[kind], atol=1e-9, rtol=0)
        np.testing.assert_allclose(covariances["centralized"][step], [[row["centralized"][0]]], atol=1e-9, rtol=0)
    assert covariances["local"][0] == [[[1.0]]] * 4
    assert "centralized" in zfusion("design", FOUR, "--steps", "5", cwd=tmp_path).stdout


def test_simulate_tells_what_launch_tells(tmp_path: Path) -> None:
    summary = told("simulate", FOUR, "--steps", "50", "--run", "s", cwd=tmp_path)
    assert summary["run"] == "s"
    assert summary["method"] == "two_stage"
    assert summary["completed_steps"] == {"1": 50, "2": 50, "3": 50, "4": 50}
    assert summary["messages"]["sent"]["estimate"] == 200
    assert summary["messages"]["recorded"]["estimate"] == 200
    assert summary["lost"] == summary["late"] == 0
    assert set(summary["rmse"]) == {"intermediate", "estimate"}
    assert Path(summary["recording"]) == tmp_path / "recordings" / "s.mcap"


def test_simulating_twice_is_the_same(tmp_path: Path) -> None:
    first = told("simulate", FOUR, "--steps", "30", "--no-record", "--run", "s", cwd=tmp_path)
    assert told("simulate", FOUR, "--steps", "30", "--no-record", "--run", "s", cwd=tmp_path) == first
    other = told("simulate", FOUR, "--steps", "30", "--no-record", "--run", "s", "--seed", "99", cwd=tmp_path)
    assert other["rmse"] != first["rmse"]


def test_loss_is_counted_and_the_recording_still_verifies(tmp_path: Path) -> None:
    arguments = ("simulate", FOUR, "--steps", "100", "--loss", "0.2", "--record", "lossy.mcap")
    summary = told(*arguments, cwd=tmp_path)
    assert summary["lost"] > 50
    assert summary["missed"] >= summary["lost"]
    assert told("replay", "lossy.mcap", "--verify", cwd=tmp_path)["different"] == 0


def test_replay_verifies(simulated: Path) -> None:
    verdict = told("replay", str(simulated), "--verify", cwd=simulated.parent)
    assert (verdict["identical"], verdict["different"], verdict["unverifiable"]) == (2 * 4 * 120, 0, 0)
    assert "960 identical, 0 different" in zfusion("replay", str(simulated), "--verify", cwd=simulated.parent).stdout


def test_replay_names_the_first_difference(simulated: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    changed = tmp_path / "changed.mcap"
    with simulated.open("rb") as source, changed.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, compression=CompressionType.NONE)
        writer.start(profile=reader.get_header().profile)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for found in reader.iter_attachments():
            writer.add_attachment(found.create_time, found.log_time, found.name, found.media_type, found.data)
        numbers: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in numbers:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            data = message.data
            if channel.topic.endswith("/node/3/estimate"):
                payload = msgpack.unpackb(data)
                if payload["step"] == 77:
                    payload["x"][0] = float(np.nextafter(payload["x"][0], 9e9))
                    data = msgpack.packb(payload)
            writer.add_message(numbers[channel.topic], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()
    verdict = told("replay", str(changed), "--verify", cwd=tmp_path, code=1)
    assert verdict["different"] == 1
    first = verdict["first_difference"]
    assert (first["node"], first["step"], first["stage"], first["field"], first["ulps"]) == (3, 77, "estimate", "x", 1)


def test_replay_runs_the_measurements_through_another_method(simulated: Path, tmp_path: Path) -> None:
    arguments = ("replay", str(simulated), "--method", "centralized", "-o", "new/central.mcap")
    compared = told(*arguments, cwd=tmp_path)
    assert set(compared["nodes"]) == {"1", "2", "3", "4"}
    assert all(node["compared"] == 120 for node in compared["nodes"].values())
    rerun = told("info", "new/central.mcap", cwd=tmp_path)
    assert rerun["method"] == "centralized"
    assert told("replay", "new/central.mcap", "--verify", cwd=tmp_path)["different"] == 0


def test_info_and_export(simulated: Path, tmp_path: Path) -> None:
    facts = told("info", str(simulated), cwd=tmp_path)
    assert facts["run"] == "run"
    assert facts["complete"] is True
    assert facts["lost"] == 0
    for format in ("csv", "jsonl", "npz"):
        done = told("export", str(simulated), "-f", format, "-o", f"run.{format}", cwd=tmp_path)
        assert done["messages"] == facts["messages"]
        assert (tmp_path / f"run.{format}").stat().st_size > 1000
    assert "node/1/estimate" in zfusion("info", str(simulated), cwd=tmp_path).stdout


SCENARIO = """
name = "tiny"
[system]
F = 1.0
Q = 0.01
initial_covariance = 1.0
[[sensors]]
id = 1
H = 1.0
R = 1.0
[network]
matrix = [[1]]
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("F = 1.0", "F = 1.0\nG = 2"), "system.G"),
        (("Q = 0.01", "Q = -0.01"), "system.Q"),
        (("matrix = [[1]]", "matrix = [[0]]"), "network.matrix"),
        (("matrix = [[1]]", "matrix = [[1, 0]]"), "network.matrix"),
        (("R = 1.0", "R = [[1, 2], [3, 4]]"), "sensors[0].R"),
        (("H = 1.0", "H = [[1.0, 0.0]]"), "sensors[0].H"),
        (('name = "tiny"', 'method = "magic"'), "method"),
        (('name = "tiny"', "timing = { deadlines = { lunch = 0.5 } }"), "timing.deadlines.lunch"),
        (("F = 1.0", "F = "), "tiny.toml"),
    ],
)
def test_a_scenario_that_is_wrong_is_refused_in_a_line(
    tmp_path: Path, refused: Refused, change: tuple[str, str], said: str
) -> None:
    (tmp_path / "tiny.toml").write_text(SCENARIO.replace(*change))
    for command in ("launch", "simulate", "design"):
        out, err = refused(command, "tiny.toml")
        assert said in err
        assert len(err.strip().splitlines()) <= 2
        assert out == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("info", "nothing.mcap"), "nothing.mcap"),
        (("replay", "nothing.mcap", "--verify"), "nothing.mcap"),
        (("replay", "text.mcap", "--verify"), "text.mcap"),
        (("launch", "nothing.toml"), "nothing.toml"),
        (("node", FOUR, "--id", "9"), "--id"),
        (("node", FOUR, "--id", "1", "--epoch", "soon"), "--epoch"),
        (("launch", FOUR, "--run", "a/b"), "a/b"),
        (("launch", FOUR, "--steps", "0"), "--steps"),
        (("launch", FOUR, "--method", "magic"), "magic"),
        (("simulate", FOUR, "--record", "/proc/nowhere/x.mcap"), "/proc/nowhere"),
        (("export", "text.mcap"), "text.mcap"),
        (("frobnicate",), "frobnicate"),
    ],
)
def test_bad_usage_is_exit_code_2(tmp_path: Path, refused: Refused, arguments: tuple[str, ...], said: str) -> None:
    (tmp_path / "text.mcap").write_text("this is not a recording\n" * 10)
    assert said in refused(*arguments)[1]


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "tiny.toml", "--record", "tiny.toml"),
        ("launch", "tiny.toml", "--record", "tiny.toml"),
        ("launch", "tiny.toml", "--links", "links.toml", "--record", "links.toml"),
        ("launch", "read.toml", "--record", "y.csv"),
        ("record", "tiny.toml", "-o", "tiny.toml"),
    ],
)
def test_no_recording_replaces_what_is_read(tmp_path: Path, refused: Refused, arguments: tuple[str, ...]) -> None:
    (tmp_path / "tiny.toml").write_text(SCENARIO)
    (tmp_path / "read.toml").write_text(f'{SCENARIO}\n[source]\nkind = "csv"\nfile = "y.csv"\ncolumns = ["y"]\n')
    (tmp_path / "y.csv").write_text("step,y\n1,1.0\n")
    (tmp_path / "links.toml").write_text("[links]\nloss = 0.1\n")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert f"{arguments[-1]}: is one of the files that are read" in refused(*arguments)[1]
    assert {path: path.read_bytes() for path in before} == before


def test_what_is_refused_is_exit_code_2_of_the_process_too(tmp_path: Path) -> None:
    assert "nothing.toml" in zfusion("launch", "nothing.toml", cwd=tmp_path, code=2).stderr
    assert "frobnicate" in zfusion("frobnicate", cwd=tmp_path, code=2).stderr


@pytest.mark.parametrize("words", [("--version",), ("design", FOUR, "--steps", "5"), ("design", FOUR, "--json")])
@pytest.mark.parametrize(("target", "reason"), [(">/dev/full", "No space left on device"), (">&-", "it is closed")])
def test_standard_output_that_cannot_be_written_is_told_in_a_line(
    tmp_path: Path, words: tuple[str, ...], target: str, reason: str
) -> None:
    command = shlex.join([sys.executable, "-m", "zfusion", *words])
    done = subprocess.run(
        f"{command} {target}", check=False, shell=True, cwd=tmp_path, stderr=subprocess.PIPE, text=True, timeout=90
    )
    assert done.returncode == 1
    assert done.stderr == f"error: standard output cannot be written: {reason}\n"


def test_a_reader_that_has_enough_is_no_trouble(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    command = subprocess.Popen(
        [sys.executable, "-m", "zfusion", "--help"], cwd=tmp_path, stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(reading)
    os.close(writing)
    assert command.communicate(timeout=90)[1] == ""


@pytest.mark.parametrize("module", ["zfusion.cli", "numpy", "typer", "zfusion.cli.soak", "zfusion.drivers.observer"])
def test_an_interrupt_at_the_beginning_is_no_failure(tmp_path: Path, module: str) -> None:
    """A hook of Python's own has the signal come just when a module is imported: on no clock."""
    program = f"""
import os, signal, sys
from zfusion.__main__ import main
def interrupted(event, args):
    if event == "import" and args[0] == {module!r}:
        os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(interrupted)
sys.argv = ["zfusion", "status"]
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, check=False, capture_output=True, text=True, timeout=90
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_an_interrupt_while_the_commands_are_put_together_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("zfusion.cli.run", interrupted)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130


def test_version_is_told(tmp_path: Path) -> None:
    assert zfusion("--version", cwd=tmp_path).stdout == f"zfusion {__version__}\n"


def test_no_help_text_is_taken_for_markup() -> None:
    """What stands in brackets is a style to the help's renderer, and is gone from what it prints."""

    def texts(command: Command) -> Iterator[str]:
        yield command.help or ""
        yield from (parameter.help or "" for parameter in command.params if isinstance(parameter, TyperOption))
        for name in getattr(command, "commands", {}):
            yield from texts(command.commands[name])  # type: ignore[attr-defined]

    found = list(texts(get_command(app)))
    assert len(found) > 200
    assert [text for text in found if "[" in text] == []


def test_a_truncated_recording_is_verified_as_far_as_it_goes(simulated: Path, tmp_path: Path) -> None:
    whole = simulated.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    verdict = told("replay", "cut.mcap", "--verify", cwd=tmp_path)
    assert verdict["different"] == 0
    assert verdict["identical"] > 0
    assert verdict["note"]


def test_a_damaged_recording_is_refused(simulated: Path, tmp_path: Path) -> None:
    damaged = bytearray(simulated.read_bytes())
    damaged[len(damaged) // 2] ^= 0x55
    (tmp_path / "damaged.mcap").write_bytes(damaged)
    assert "damaged" in zfusion("replay", "damaged.mcap", "--verify", cwd=tmp_path, code=2).stderr


def test_a_published_replay_reaches_a_consumer_whole_and_in_order(simulated: Path) -> None:
    import zenoh

    from zfusion.drivers.endpoints import Endpoints
    from zfusion.drivers.transport import open_session
    from zfusion.recording import Recording
    from zfusion.swarm.ports import free_endpoints

    [endpoint] = free_endpoints(1)
    with Recording.open(simulated) as recording:
        wanted = [(r.topic, r.data) for r in recording.records() if r.topic.endswith("/estimate")]
    with open_session(Endpoints(connect=(endpoint,))) as session:
        subscriber = session.declare_subscriber("zfusion/run/node/*/estimate", zenoh.handlers.FifoChannel(10_000))
        arguments = ("--publish", "--speed", "0", "--stage", "estimate", "--listen", endpoint, "--await-consumer")
        assert told("replay", str(simulated), *arguments, cwd=simulated.parent)["played"] == len(wanted)
        heard = [subscriber.recv() for _ in wanted]
        assert [(str(s.key_expr), s.payload.to_bytes()) for s in heard] == wanted
        subscriber.undeclare()


def test_a_recording_that_is_kept_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "field.mcap"
    assert unused(path) == path
    (tmp_path / "field.1.mcap").touch()  # a part of it, whose first one is gone
    assert unused(path) == tmp_path / "field-2.mcap"
    (tmp_path / "field-2.mcap").touch()
    assert unused(path) == tmp_path / "field-3.mcap"
    (tmp_path / "fields.mcap").touch()
    assert unused(tmp_path / "field-4.mcap") == tmp_path / "field-4.mcap"
