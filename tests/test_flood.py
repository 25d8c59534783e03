"""A peer that floods every key of a live run with lies: what the others estimate is what they would without it.

One is a stranger in a swarm that lets everybody in; the other a member of a deployed swarm, whose certificate is good
at every node's door: rules refuse all that he says in other names. Some hundred messages a key here; by

    ZFUSION_FLOOD=100000 python -m pytest -m long -s tests/test_flood.py

as many as that, and what is left of the honest traffic's throughput meanwhile is told: of what it is when nobody lies,
and of what it is beside a process that puts as much where nobody listens, for who lies on the same machine takes a
processor from the honest.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import pytest
import zenoh

from deployed import deployed, hosts_document, process, refusals, senders, swarm
from swarms import Listener, client, decoded, endpoints, estimates, recorded, wait_until, zfusion
from test_hostile import Attack, attacked, header, intermediates, measurements, nonsense, pack
from test_security import Doors
from zfusion.deploy.plan import Plan
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


def pour(puts: Sequence[Callable[[str, bytes], object]], number: int, where: str = "") -> None:
    """So many lies on every key, in each of these ways; or on keys that begin with `where`, which nobody listens to."""
    pool = lies(Random(1))
    keys = [f"{where}node/{i}/{stage}" for i in NODES for stage in STAGES] + [f"{where}truth"]
    for n in range(number):
        for k, key in enumerate(keys):
            for put in puts:
                put(key, pool[(n + k) % len(pool)])


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
    """How far a node is, seen by somebody who has no link to the one who floods."""

    def __init__(self, session: zenoh.Session, run: str, node: int) -> None:
        self._node = node
        self._heard = Listener(session, f"zfusion/{run}/node/{node}/estimate")

    def step(self) -> int:
        samples = self._heard.collect()
        del samples[:-1]
        return int(decoded(samples[-1])["step"]) if samples else 0

    def wait_for(self, step: int) -> None:
        wait_until(lambda: self.step() >= step, f"step {step} of node {self._node}, not {self.step()}", 600)

    def rate(self, act: Callable[[], object]) -> float:
        """Steps a second, while something is done."""
        first, began = self.step(), time.monotonic()
        act()
        return (self.step() - first) / (time.monotonic() - began)

    def calm(self, number: int) -> float:
        """Steps a second, while nobody lies."""
        return self.rate(lambda: self.wait_for(self.step() + max(50, number // 100)))


@dataclass(frozen=True)
class Rates:
    """Rounds a second."""

    before: float
    beside: float
    """Beside as many messages that nobody hears."""
    during: float
    after: float

    def tell(self) -> None:
        def share(whole: float) -> str:
            return f"{self.during / whole:.2f}" if whole else "of nothing"  # few lies are told before a step is made

        print(
            f"rounds a second: {self.during:.0f} meanwhile; {self.before:.0f} before ({share(self.before)}),"
            f" {self.after:.0f} after; beside as many messages that nobody hears {self.beside:.0f}"
            f" ({share(self.beside)})"
        )


def same_as_calm(directory: Path, scenario: str, path: Path, steps: int) -> None:
    """Whether the estimates of so many steps are those that the scenario's nodes make when nobody lies."""
    calm = ("--free-run", "--steps", steps, "--record", "calm.mcap", "--json")
    assert zfusion(directory, "simulate", scenario, *calm).code == 0
    ours, theirs = estimates(path), estimates(directory / "calm.mcap")
    assert len(theirs) == len(NODES) * steps
    assert all(ours[place] == estimate for place, estimate in theirs.items())


def endure_stranger(directory: Path, number: int, questions: int) -> None:
    with attacked(directory, "--free-run", **PATIENT) as (command, attack, _, path):
        with client(endpoints(directory / "attacked.toml")["1"]) as session:
            watch = Watch(session, attack.run, 1)
            watch.wait_for(SETTLED)
            before = watch.calm(number)
            beside = watch.rate(lambda: pour([attack.put], number, "elsewhere/"))
            with wrong_answers(attack):
                ask(attack, questions)
                during = watch.rate(lambda: pour([attack.put], number))
            rates = Rates(before, beside, during, watch.calm(number))
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
    rates.tell()
    same_as_calm(directory, "attacked.toml", path, min(summary["completed_steps"].values()))


def flooded(plan: Plan, out: Path, number: int) -> tuple[Rates, dict[str, dict[str, Any]]]:
    """A deployed swarm while node 1's certificate floods it; what its processes reported."""
    with swarm(plan, out) as running, ExitStack() as links:
        doors = Doors(running)
        wait_until(running.steps_taken, "steps are taken")
        watch = Watch(links.enter_context(doors.as_member("observer", 3)), plan.run, 3)
        watch.wait_for(SETTLED)
        before = watch.calm(number)
        with ExitStack() as liar:
            sessions = [liar.enter_context(doors.as_member("node-1", node)) for node in NODES]
            puts = [Attack(session, plan.run).put for session in sessions]
            beside = watch.rate(lambda: pour(puts, number, "elsewhere/"))
            during = watch.rate(lambda: pour(puts, number))
        rates = Rates(before, beside, during, watch.calm(number))
        running.interrupt()
        return rates, running.ended()


def endure_member(directory: Path, number: int) -> None:
    plan = deployed(directory, hosts_document("direct"), steps=10_000_000, free_run=True, **PATIENT)
    rates, reports = flooded(plan, directory / "out", number)
    print(f"{number} lies on each of {len(NODES) * len(STAGES) + 1} keys at each of {len(NODES)} nodes")
    rates.tell()
    nodes = {name: report for name, report in reports.items() if name.startswith("node")}
    refused = {edge: sum(counted.values()) for edge, counted in refusals(reports).items()}
    # What comes in node 1's own name has to be read by those that hear it; everything else is kept from all by rules.
    assert refused == {("node-3", "1"): 2 * number, ("node-4", "1"): 2 * number}
    path = directory / "out" / process(plan, "recorder").host / "recordings" / f"{plan.run}.mcap"
    assert senders(recorded(path)) == {(str(node), str(node)) for node in NODES}
    same_as_calm(directory, "field.toml", path, min(report["completed"] for report in nodes.values()))


@pytest.mark.timeout(400)
def test_a_flood_of_lies_on_every_key_changes_no_bit(tmp_path: Path) -> None:
    endure_stranger(tmp_path, 200, 30)


@pytest.mark.timeout(400)
def test_a_members_flood_on_every_key_goes_no_farther_than_its_own(tmp_path: Path) -> None:
    endure_member(tmp_path, 200)


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_a_long_flood_of_lies_on_every_key_changes_no_bit(tmp_path: Path) -> None:
    endure_stranger(tmp_path, FLOOD, 1000)


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_a_members_long_flood_goes_no_farther_than_its_own_keys(tmp_path: Path) -> None:
    endure_member(tmp_path, FLOOD)
