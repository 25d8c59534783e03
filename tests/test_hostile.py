"""A peer that means harm: what it says is counted and dropped, the run goes on, and no estimate changes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import inf, nan
from pathlib import Path
from random import Random
from typing import Any

import msgpack
import pytest
import zenoh

from swarms import (
    Command,
    Listener,
    census,
    client,
    decoded,
    endpoints,
    estimates,
    recorded,
    run_name,
    variant,
    wait_until,
    zfusion,
)
from zfusion.drivers.inbox import CHANNEL
from zfusion.recording import Recording

VICTIM = 2
"""In whose name the messages are; nodes 1 and 4 listen to it."""

LISTENERS = 2
HUGE = 5 << 20
MONSTROUS = 40 << 20
"""Larger than what a session puts together."""

REPLAYED = 20
"""Old messages of each stage that are said again."""

REASONS = (
    *("not_msgpack", "not_a_map", "too_large", "wrong_type", "not_finite", "wrong_shape", "wrong_node", "version"),
    *("missing_field", "out_of_range", "unknown_id", "not_sorted", "bad_history"),
)
"""For which something is refused here."""


def pack(value: object) -> bytes:
    data: bytes = msgpack.packb(value)
    return data


def header(**changes: object) -> dict[str, object]:
    return {"v": 1, "node": VICTIM, "step": 7, "t_ns": 1, "seq": 6, "born": 1} | changes


def nonsense(random: Random) -> list[bytes]:
    """What is no msgpack map at all."""
    lies = [b"", b"\xc1", b"{}", pack(None), pack([1, 2]), pack(7), pack("x") + b"tail"]
    lies += [random.randbytes(random.randrange(1, 200)) for _ in range(50)]
    lies += [pack(header(y=[1.0]))[:-4], b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\x81" * 5000]
    return lies


def measurements() -> list[bytes]:
    """What is no measurement of the victim's."""
    lies: list[dict[str, object]] = [header(y=y) for y in ([nan], [inf], [], [1.0, 2.0], [1], ["1"], 1.0, {}, [None])]
    lies += [
        header(y=[1.0], **{name: value}) for name in ("step", "seq", "born", "t_ns") for value in (-1, 1.5, None, "1")
    ]
    lies += [header(y=[1.0], node=node) for node in (3, 99, "2", None, [2])]
    lies += [header(y=[1.0], v=v) for v in (0, 2, "1", None)]
    lies += [header(y=[1.0], step=2**60), header(y=[nan], step=50, seq=10**9), header(y=[nan], born=5, seq=77)]
    lies += [{}, {"v": 1}, header()]
    return [pack(lie) for lie in lies]


def intermediates() -> list[bytes]:
    """What is no intermediate estimate of the victim's, whose neighbours are 2, 3, 4."""
    right: dict[str, object] = {"x": [1.0], "used": [2, 3, 4], "history": [[1, [2, 3, 4]]]}
    wrong: list[dict[str, object]] = [
        {"x": [nan]}, {"x": [1.0, 2.0]}, {"used": [1, 2]}, {"used": [4, 3]}, {"used": [2, 2]}, {"used": "all"},
        {"history": [[9, [2]]]}, {"history": [[3, [2]], [2, [3]]]}, {"history": [[1, [77]]]}, {"history": [[0, [2]]]},
        {"history": [[1, [2]]] * 300}, {"history": 5},
    ]  # fmt: skip
    return [pack(header(**{**right, **lie})) for lie in wrong]


@dataclass
class Attack:
    """What the hostile peer has done so far."""

    session: zenoh.Session
    run: str
    refused: int = 0
    """Messages on keys that two nodes listen to."""
    tokens: list[zenoh.LivelinessToken] = field(default_factory=list)

    def put(self, key: str, data: bytes) -> None:
        self.session.put(f"zfusion/{self.run}/{key}", data, congestion_control=zenoh.CongestionControl.BLOCK)

    def lie(self, stage: str, lies: list[bytes]) -> None:
        for data in lies:
            self.put(f"node/{VICTIM}/{stage}", data)
            self.refused += 1

    def everything(self, overheard: Listener) -> None:
        random = Random(1)
        for stage, lies in (("measurement", measurements()), ("intermediate", intermediates())):
            self.lie(stage, nonsense(random))
            self.lie(stage, lies)
            self.lie(stage, [bytes(HUGE)] * 3)
            self.put(f"node/{VICTIM}/{stage}", bytes(MONSTROUS))
            old = [s.payload.to_bytes() for s in overheard.collect() if str(s.key_expr).endswith(f"/{VICTIM}/{stage}")]
            self.lie(stage, old[:REPLAYED])
            self.lie(stage, [b"flood"] * 3000)
        for key in ("node/99/measurement", f"node/{VICTIM}/gossip", "x/y/z", f"node/{VICTIM}/event", "recorder/bell"):
            self.put(key, b"whatever")
        self.session.delete(f"zfusion/{self.run}/node/{VICTIM}/measurement")
        self.refused += 1
        for name in ("99", "2.5", "recorder"):
            self.tokens.append(self.session.liveliness().declare_token(f"zfusion/{self.run}/node/{name}"))
        for key in ("node/*/status", "node/*/history", "recorder/status"):
            for payload in (None, b"garbage", pack({"from": [1], "leaving": True}), bytes(HUGE // 5)):
                for reply in self.session.get(
                    f"zfusion/{self.run}/{key}", zenoh.handlers.FifoChannel(100), payload=payload, timeout=30.0
                ):
                    assert reply is not None


@contextmanager
def attacked(directory: Path, *words: object, **tables: Any) -> Iterator[tuple[Command, Attack, Listener, Path]]:
    """A swarm, and a hostile peer with a link to every node."""
    scenario, run = variant(directory, "attacked", **tables), run_name("attacked")
    path = directory / "attacked.mcap"
    command = Command(
        directory, "launch", scenario, "--json", "--run", run, "--record", path, "--steps", 1_000_000, *words
    )
    try:
        with client(*endpoints(scenario).values()) as session:
            overheard = Listener(session, f"zfusion/{run}/node/*/*")
            yield command, Attack(session, run), overheard, path
    finally:
        if command.process.poll() is None:  # the test failed: its swarm must not disturb the others
            command.process.kill()
            command.process.wait()
    assert not census(run)


def wait_for_step(overheard: Listener, node: int, step: int, command: Command) -> None:
    def last() -> int:
        own = [s for s in overheard.collect() if str(s.key_expr).endswith(f"/node/{node}/estimate")]
        return int(decoded(own[-1])["step"]) if own else 0

    wait_until(lambda: last() >= step, f"step {step} of node {node}, not {last()}\n{command.said()}")


def endure(directory: Path, *words: object, **tables: Any) -> tuple[dict[str, Any], Attack, Path]:
    """Run a swarm, attack it, let it go on for a while, stop it."""
    with attacked(directory, *words, **tables) as (command, attack, overheard, path):
        wait_for_step(overheard, 1, 30, command)
        attack.everything(overheard)
        seen = max(decoded(s)["step"] for s in overheard.collect() if str(s.key_expr).endswith("/estimate"))
        for node in (1, 2, 3, 4):
            wait_for_step(overheard, node, seen + 50, command)
        command.interrupt()
        result = command.wait()
    assert result.code == 0, result.err
    return result.summary, attack, path


def check_the_books(summary: dict[str, Any], attack: Attack, path: Path) -> None:
    assert summary["failures"] == []
    assert summary["restarts"] == 0
    assert summary["lost"] == 0
    assert summary["lost_on_recording"] == {}
    counted = sum(summary["refused"].values()) + summary["late"]
    assert counted >= LISTENERS * attack.refused
    for reason in REASONS:
        assert summary["refused"].get(reason, 0) > 0, reason
    assert summary["refused"].get("duplicate", 0) + summary["late"] >= LISTENERS * 2 * REPLAYED  # of long ago: late
    assert sum(summary["refused"].values()) < LISTENERS * attack.refused + 200
    with Recording.open(path) as recording:
        assert recording.complete


@pytest.mark.timeout(400)
def test_a_free_running_swarm_makes_the_same_estimates(tmp_path: Path) -> None:
    summary, attack, path = endure(tmp_path, "--free-run")
    check_the_books(summary, attack, path)
    assert summary["missed"] == 0
    assert summary["fallbacks"] == 0
    ours = estimates(path)
    steps = min(summary["completed_steps"].values())
    calm = ("--free-run", "--steps", steps, "--record", "calm.mcap", "--json")
    assert zfusion(tmp_path, "simulate", "attacked.toml", *calm).code == 0
    for place, estimate in estimates(tmp_path / "calm.mcap").items():
        assert ours[place] == estimate
    assert zfusion(tmp_path, "replay", path, "--verify", "--json").summary["different"] == 0


@pytest.mark.timeout(400)
def test_a_flood_while_all_rest_fills_no_memory_and_costs_nobody_a_link(tmp_path: Path) -> None:
    """Five seconds from step to step: more than twice the lease of links that nothing is read from."""
    small, large = 3 * CHANNEL, 300
    with attacked(tmp_path, timing={"rate_hz": 0.2}) as (command, attack, overheard, path):
        wait_for_step(overheard, 1, 2, command)
        for n in range(small):
            attack.put(f"node/{VICTIM}/measurement", b"flood" if n % (small // large) else bytes(HUGE))
        wait_for_step(overheard, 1, 4, command)
        most = max(_most_memory(pid) for pid in census(attack.run))
        command.interrupt()
        result = command.wait()
    assert result.code == 0, result.err
    assert sum(result.summary["refused"].values()) == LISTENERS * small
    assert (result.summary["missed"], result.summary["lost"], result.summary["failures"]) == (0, 0, [])
    events = [message.payload["kind"] for message in recorded(path) if message.topic.endswith("/event")]
    assert "gone" not in events[: events.index("stopped")]
    assert most < large * HUGE / 3


def _most_memory(pid: int) -> int:
    """Bytes that a process had at the most so far."""
    status = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM"))


@pytest.mark.timeout(400)
def test_a_paced_swarm_goes_on(tmp_path: Path) -> None:
    summary, attack, path = endure(tmp_path, timing={"rate_hz": 20.0})
    check_the_books(summary, attack, path)
    used = [m.payload["used"] for m in recorded(path) if m.topic.endswith("/node/1/intermediate")]
    assert [1, 2, 3] in used[-50:]
    assert zfusion(tmp_path, "replay", path, "--verify", "--json").summary["different"] == 0
