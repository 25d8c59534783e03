"""What the tests of real processes on real Zenoh share: starting swarms, looking at them, and counting what is left."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import msgpack
import tomli_w
import zenoh
from mcap.reader import make_reader

from zfusion.drivers.endpoints import Endpoints
from zfusion.drivers.transport import open_session
from zfusion.swarm.ports import free_endpoints

EXAMPLE = Path(__file__).parents[1] / "examples" / "four_sensor.toml"

PATIENCE_S = 90.0
"""How long anything may take before a test gives up: the machine may be busy with other things."""

POLL_S = 0.01

ZFUSION = (sys.executable, "-m", "zfusion")

MORTAL = ("setpriv", "--pdeathsig", "KILL", "--") if shutil.which("setpriv") else ()
"""Words before a command that have it end with who started it: a test process that is killed leaves no swarm behind."""

_numbers = count(1)


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = PATIENCE_S) -> None:
    """Wait for a condition; AssertionError, naming it, if it does not come true in time."""
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"not within {timeout_s:g} s: {what}"
        time.sleep(POLL_S)


def variant(directory: Path, name: str = "scenario", base: Path = EXAMPLE, **changes: Any) -> Path:
    """A scenario like `base` with some tables changed, and an endpoint for every node, so that a test can dial it."""
    document = tomllib.loads(base.read_text()) | {"name": name}
    ids = [str(sensor["id"]) for sensor in document["sensors"]]
    endpoints = dict(zip(ids, free_endpoints(len(ids)), strict=True))
    document["transport"] = {"endpoints": endpoints, **document.get("transport", {})}
    for table, value in changes.items():
        document[table] = {**document.get(table, {}), **value} if isinstance(value, Mapping) else value
    path = directory / f"{name}.toml"
    path.write_text(tomli_w.dumps(document))
    return path


@dataclass(frozen=True)
class Result:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def summary(self) -> dict[str, Any]:
        """What ``--json`` printed."""
        assert self.out, self.err
        found: dict[str, Any] = json.loads(self.out)
        return found

    @property
    def error(self) -> str:
        """The one line that a refused command says."""
        assert "Traceback" not in self.err, self.err
        lines = [line for line in self.err.splitlines() if line.startswith("error:")]
        assert len(lines) == 1, self.err
        return lines[0]


class Command:
    """A zfusion command that runs, in a directory of its own making."""

    def __init__(
        self, directory: Path, *words: object, program: Sequence[object] = ZFUSION, limit_bytes: int | None = None
    ) -> None:
        """`limit_bytes` is how large a file it may write, as on a full disk."""
        number = next(_numbers)
        self._out, self._err = (directory / f"command{number}.{name}" for name in ("out", "err"))
        environment = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
        limit = [] if limit_bytes is None else ["prlimit", f"--fsize={limit_bytes}"]
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                [*MORTAL, *limit, *map(str, program), *map(str, words)],
                cwd=directory,
                stdout=out,
                stderr=err,
                stdin=subprocess.DEVNULL,
                env={**environment, "COLUMNS": "500"},
            )

    def said(self) -> str:
        """What it has said on standard error so far."""
        return self._err.read_text()

    @property
    def heard(self) -> bool:
        """Whether it has said anything on standard output."""
        return self._out.stat().st_size > 0

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)

    def wait(self) -> Result:
        """Wait for its end."""
        try:
            code = self.process.wait(PATIENCE_S)
        finally:
            if self.process.poll() is None:
                self.process.kill()
                self.process.wait()
        return Result(code, self._out.read_text(), self._err.read_text())


def run_name(word: str) -> str:
    """A name that no other process on this machine has in its command line."""
    return f"test-{word}-{os.getpid()}-{next(_numbers)}"


def zfusion(directory: Path, *words: object) -> Result:
    """Run a command to its end."""
    return Command(directory, *words).wait()


def launch(directory: Path, scenario: Path, *words: object, run: str | None = None) -> Result:
    """Run `zfusion launch --json` to its end, and see that it leaves nothing running."""
    run = run or run_name("launch")
    result = zfusion(directory, "launch", scenario, "--json", "--run", run, *words)
    assert not census(run)
    return result


def census(run: str) -> dict[int, list[str]]:
    """The processes of a run, by their command lines; zombies are none."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with suppress(OSError):
                words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
                if run in words:
                    found[int(entry.name)] = words
    return found


def process_of(run: str, *words: str) -> int:
    """The one process of the run that has these words, in a row, in its command line."""
    pids = [
        pid
        for pid, line in census(run).items()
        if any(tuple(line[n : n + len(words)]) == words for n in range(len(line)))
    ]
    assert len(pids) == 1, (words, census(run))
    return pids[0]


@contextmanager
def client(*endpoints: str) -> Iterator[zenoh.Session]:
    """A Zenoh session of somebody else's that dials these endpoints."""
    session = open_session(Endpoints(connect=endpoints))
    try:
        yield session
    finally:
        session.close()


def endpoints(scenario: Path) -> dict[str, str]:
    """Where the nodes of a `variant` listen."""
    found: dict[str, str] = tomllib.loads(scenario.read_text())["transport"]["endpoints"]
    return found


class Listener:
    """Collects what is published on a key expression."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.RingChannel(100_000))
        self.samples: list[zenoh.Sample] = []

    def collect(self) -> list[zenoh.Sample]:
        """All that has come so far."""
        while (sample := self._subscriber.handler.try_recv()) is not None:
            self.samples.append(sample)
        return self.samples

    def steps(self) -> set[int]:
        """The steps of the messages that have come so far."""
        return {decoded(sample)["step"] for sample in self.collect()}


def decoded(sample: zenoh.Sample) -> dict[str, Any]:
    """A message's payload."""
    payload: dict[str, Any] = msgpack.unpackb(sample.payload.to_bytes())
    return payload


@dataclass(frozen=True)
class Recorded:
    """One message of a recording, read with nothing but mcap and msgpack."""

    topic: str
    payload: dict[str, Any]
    sequence: int
    publish_time: int
    log_time: int
    data: bytes


def recorded(path: Path) -> list[Recorded]:
    """All messages of a finished recording, in its order."""
    with path.open("rb") as file:
        return [
            Recorded(
                channel.topic,
                msgpack.unpackb(message.data),
                message.sequence,
                message.publish_time,
                message.log_time,
                message.data,
            )
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]


def estimates(path: Path) -> dict[tuple[Any, int], Any]:
    """(node, step) -> all of an estimate that is not a time stamp or a counter, bit for bit."""
    return {
        (m.payload["node"], m.payload["step"]): [m.payload[name] for name in ("x", "P", "used", "excluded")]
        for m in recorded(path)
        if m.topic.endswith("/estimate")
    }
