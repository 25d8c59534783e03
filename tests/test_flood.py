"""A peer that floods every key of a live run with lies: what the others estimate is what they would without it.

Some hundred messages a key here; by

    ZFUSION_FLOOD=100000 python -m pytest -m long -s tests/test_flood.py

as many as that, and what is left of the honest traffic's throughput meanwhile is told: of what it is when nobody lies,
and of what it is beside a process that puts as much where nobody listens, for who lies on the same machine takes a
processor from the honest.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import pytest
import zenoh

from swarms import Listener, client, decoded, endpoints, estimates, wait_until, zfusion
from test_hostile import Attack, attacked, header, intermediates, measurements, nonsense, pack
from zfusion.recording import Recording

NODES = (1, 2, 3, 4)
STAGES = ("measurement", "intermediate", "estimate", "event", "arrivals", "revised")
SETTLED = 500
"""Steps after which the covariances of the example stand, and a step costs what it will."""
FLOOD = int(os.environ.get("ZFUSION_FLOOD", "100000"))
PATIENT = {"timing": {"timeout_s": 60.0}}
"""Nobody is given up for being slow: then used sets are the same, however busy the machine is."""


def lies(random: Random) -> list[bytes]:
    """Of which none is a legal message of anybody's; some are what one looks like."""
    deep: object = 1
    for _ in range(200):
        deep = {"x": deep}
    shape = {"x": [0.0], "P": [-1.0], "used": [2], "excluded": []}
    bombs = [pack(header(y=deep)), pack(header(kind="late", data=deep, v=7)), pack(header(**shape, shape=[2, 2], v=9))]
    future = [pack(header(y=[1.0], step=step, born=step + 1)) for step in (1, 50, 2**40)]
    return [*nonsense(random), *measurements(), *intermediates(), *bombs, *future]


@contextmanager
def wrong_answers(attack: Attack) -> Iterator[Counter[str]]:
    """Somebody who answers all that nodes are asked, and says that his answers are complete."""
    asked: Counter[str] = Counter()
    answers = [
        b"",
        b"\xc1",
        pack({}),
        pack({"node": 2, "zfusion": 1}),
        pack([1]),
        pack({"born": -1, "end": 5, "runs": 3}),
    ]

    def answer(query: zenoh.Query) -> None:
        with query:
            asked[str(query.key_expr)] += 1
            query.reply(str(query.key_expr), answers[asked.total() % len(answers)])

    declared = [
        attack.session.declare_queryable(
            f"zfusion/{attack.run}/node/*/{what}", zenoh.handlers.Callback(answer, indirect=False), complete=complete
        )
        for what, complete in (("status", True), ("history", False))
    ]
    try:
        yield asked
    finally:
        for queryable in declared:
            queryable.undeclare()


def pour(attack: Attack, number: int, where: str = "") -> None:
    """So many lies on every key, or on keys that begin with `where`, which nobody listens to."""
    pool = lies(Random(1))
    keys = [f"{where}node/{i}/{stage}" for i in NODES for stage in STAGES] + [f"{where}truth"]
    for n in range(number):
        for k, key in enumerate(keys):
            attack.put(key, pool[(n + k) % len(pool)])


def ask(attack: Attack, number: int) -> None:
    """Questions that nobody needs, and tokens that come and go."""
    for n in range(number):
        for what in ("status", "history"):
            attack.session.get(
                f"zfusion/{attack.run}/node/*/{what}",
                zenoh.handlers.RingChannel(10),
                payload=[None, b"garbage", pack({"from": 77 + n, "started": n, "leaving": True})][n % 3],
                timeout=0.5,
            )
        token = attack.session.liveliness().declare_token(f"zfusion/{attack.run}/node/{n % 6}")
        token.undeclare()


class Watch:
    """How far node 1 is, seen by somebody who has no link to the one who floods."""

    def __init__(self, session: zenoh.Session, run: str) -> None:
        self._heard = Listener(session, f"zfusion/{run}/node/1/estimate")

    def step(self) -> int:
        samples = self._heard.collect()
        del samples[:-1]
        return int(decoded(samples[-1])["step"]) if samples else 0

    def wait_for(self, step: int) -> None:
        wait_until(lambda: self.step() >= step, f"step {step} of node 1, not {self.step()}", 600)

    def rate(self, act: Callable[[], object]) -> float:
        """Steps a second, while something is done."""
        first, began = self.step(), time.monotonic()
        act()
        return (self.step() - first) / (time.monotonic() - began)


def endure(directory: Path, number: int, questions: int) -> None:
    with attacked(directory, "--free-run", **PATIENT) as (command, attack, _, path):
        with client(endpoints(directory / "attacked.toml")["1"]) as session:
            watch = Watch(session, attack.run)
            watch.wait_for(SETTLED)
            before = watch.rate(lambda: watch.wait_for(watch.step() + max(50, number // 100)))
            beside = watch.rate(lambda: pour(attack, number, "elsewhere/"))
            with wrong_answers(attack):
                ask(attack, questions)
                during = watch.rate(lambda: pour(attack, number))
            after = watch.rate(lambda: watch.wait_for(watch.step() + max(50, number // 100)))
        command.interrupt()
        result = command.wait()
    assert result.code == 0, result.err
    summary = result.summary
    assert (summary["failures"], summary["restarts"], summary["missed"], summary["fallbacks"]) == ([], 0, 0, 0)
    # Each lie on a key of the method's stages is refused by the two nodes that hear its supposed sender.
    refused = sum(summary["refused"].values())
    assert refused >= 2 * 2 * len(NODES) * number
    with Recording.open(path) as recording:
        assert recording.complete
    print(f"{number} lies on each of {len(NODES) * len(STAGES) + 1} keys; {refused} refused by the nodes")
    print(f"rounds a second: {during:.0f} meanwhile; {before:.0f} before ({during / before:.2f}), {after:.0f} after")
    print(f"beside as many messages that nobody hears: {beside:.0f} ({during / beside:.2f})")
    steps = min(summary["completed_steps"].values())
    calm = ("--free-run", "--steps", steps, "--record", "calm.mcap", "--json")
    assert zfusion(directory, "simulate", "attacked.toml", *calm).code == 0
    ours, theirs = estimates(path), estimates(directory / "calm.mcap")
    assert len(theirs) == len(NODES) * steps
    assert all(ours[place] == estimate for place, estimate in theirs.items())


@pytest.mark.timeout(400)
def test_a_flood_of_lies_on_every_key_changes_no_bit(tmp_path: Path) -> None:
    endure(tmp_path, 200, 30)


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_a_long_flood_of_lies_on_every_key_changes_no_bit(tmp_path: Path) -> None:
    endure(tmp_path, FLOOD, 1000)
