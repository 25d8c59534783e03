"""Swarms of which one process is killed or stopped at a random moment, and what must be true of them all the same.

`Plan.draw(seed)` says what happens, `carry_out` does it and checks: nothing hangs, nothing is left behind, what was
recorded can be read and is short of one flush at most, and every estimate on it is right for what it says was used.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from exactness import Exactness, assert_only_last_words_are_missing
from swarms import Command, Result, census, process_of, run_name, variant, wait_until, zfusion
from zfusion.errors import RecordingError
from zfusion.recording import Recording

RATE_HZ = 50.0
FLUSH_S = 0.2

LAST_S = 3.0
"""The last moment at which it happens: of the swarm's start, or of its steps, which take as long."""

BEGUN_BYTES = 40_000
"""A recording of this size has steps on it."""

BUSY_S = 1.0
"""What a busy machine may need between two flushes, beside their interval."""

VICTIMS = ("node", "recorder", "launcher", "network")


@dataclass(frozen=True)
class Plan:
    """What happens to one swarm."""

    seed: int
    victim: str
    """Its name: "node 3", "the recorder", "the launcher", "the network"."""
    how: signal.Signals
    running: bool
    """Whether it happens when steps are taken, or when the swarm is starting."""
    after_s: float
    """From the first steps, or from when its process is there."""
    then: signal.Signals | None
    """What it gets after a SIGSTOP; None: it stays as it is."""
    then_after_s: float
    restart: bool
    netns: bool
    steps: int = 150

    @classmethod
    def draw(cls, seed: int, namespaces: bool) -> Plan:
        random = Random(seed)
        kinds = VICTIMS if namespaces else VICTIMS[:-1]
        kind = random.choice(kinds)
        victim = f"node {random.randint(1, 4)}" if kind == "node" else f"the {kind}"
        how = random.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGSTOP))
        then = random.choice((signal.SIGCONT, signal.SIGKILL, None)) if how is signal.SIGSTOP else None
        if then is None and how is signal.SIGSTOP and kind == "launcher":
            then = signal.SIGCONT  # or it would stand there as long as the test lets it
        return cls(
            seed=seed,
            victim=victim,
            how=how,
            running=random.random() < 0.75,
            after_s=random.uniform(0.0, LAST_S),
            then=then,
            then_after_s=random.uniform(0.1, 4.0),
            restart=random.random() < 0.5,
            netns=kind == "network" or (namespaces and random.random() < 0.2),
        )

    @property
    def words(self) -> tuple[str, ...]:
        """By which the victim is found among the processes of its run."""
        kind, _, number = self.victim.partition(" ")
        return ("--id", number) if kind == "node" else ({"recorder": "record"}.get(number, number),)

    def __str__(self) -> str:
        then = f", {self.then.name} {self.then_after_s:.2f} s later" if self.then else ""
        where = "".join(f", {word}" for word in ("restart", "netns") if getattr(self, word))
        of = "of steps" if self.running else "of starting"
        return f"seed {self.seed}: {self.how.name} to {self.victim} after {self.after_s:.2f} s {of}{then}{where}"


@dataclass
class Fate:
    """What became of a swarm."""

    plan: Plan
    code: int = 0
    elapsed_s: float = 0.0
    struck: bool = False
    """Whether the victim was still there."""
    recording: str = "none"
    """finished, broken off, or none: nothing had begun."""
    lost_s: float | None = None
    """What is missing at the end of a recording whose recorder was killed: from its last message to the death."""
    verified: int = 0
    """Estimates that a replay computes again, bit for bit."""
    checked: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        struck = "" if self.struck else " (it had ended)"
        lost = "" if self.lost_s is None else f", {self.lost_s:.2f} s lost"
        return (
            f"{self.plan}{struck}: exit {self.code} after {self.elapsed_s:.1f} s; recording {self.recording}{lost}; "
            f"{self.verified} identical, {self.checked['estimates']} exact; {self.failures}"
        )


def carry_out(plan: Plan, directory: Path) -> Fate:
    """Launch a swarm, do to it what the plan says, and see that all is as it must be. AssertionError if it is not."""
    fate, run = Fate(plan), run_name(f"kill{plan.seed}")
    path = directory / f"{run}.mcap"
    tables: dict[str, Any] = {"links": {"delay": 0.001}} if plan.netns else {}
    scenario = variant(
        directory, f"s{plan.seed}", recording={"flush_interval_s": FLUSH_S}, timing={"rate_hz": RATE_HZ}, **tables
    )
    words = [*(["--restart"] if plan.restart else []), *(["--netns-with", "tun"] if plan.netns else [])]
    command = Command(
        directory, "launch", scenario, "--json", "--run", run, "--record", path, "--steps", plan.steps, *words
    )
    began = time.monotonic()
    try:
        died_ns = strike(plan, fate, command, run, path)
        result = command.wait()
        fate.code, fate.elapsed_s = result.code, time.monotonic() - began
        wait_until(lambda: not census(run), f"{plan}: nothing is left running: {census(run)}", 20)
    finally:
        for pid in census(run):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    summary = json.loads(result.out) if result.out else {}
    fate.failures = summary.get("failures", [])
    check_the_ending(plan, fate, result, summary)
    check_the_recording(fate, path, died_ns, summary, directory)
    return fate


def strike(plan: Plan, fate: Fate, command: Command, run: str, path: Path) -> int:
    """Signal the victim when it is time to; when that was, on the wall clock."""

    def find() -> int | None:
        if plan.victim == "the launcher":
            return command.process.pid if command.process.poll() is None else None
        with suppress(AssertionError):
            return process_of(run, *plan.words)
        return None

    def ended() -> bool:
        return command.process.poll() is not None

    def begun() -> bool:
        return path.exists() and path.stat().st_size > BEGUN_BYTES

    wait_until(lambda: ended() or (begun() if plan.running else find()), f"{plan.victim} is there")
    idle_until(time.monotonic() + plan.after_s, ended)
    pid = find()
    if pid is None:
        return 0
    with suppress(ProcessLookupError):
        os.kill(pid, plan.how)
        fate.struck = True
    died_ns = time.time_ns()
    if plan.then is not None:
        idle_until(time.monotonic() + plan.then_after_s, lambda: False)
        with suppress(ProcessLookupError):
            os.kill(pid, plan.then)
    return died_ns


def idle_until(moment: float, ended: Callable[[], bool]) -> None:
    wait_until(lambda: time.monotonic() >= moment or ended(), "the moment comes")


def check_the_ending(plan: Plan, fate: Fate, result: Result, summary: dict[str, Any]) -> None:
    """That it ended as it should, and says so."""
    assert "Traceback" not in result.err, f"{plan}\n{result.err}"
    died = [failure for failure in fate.failures if " died" in failure and not failure.startswith(plan.victim)]
    assert not died, f"{plan}\n{fate.failures}"
    if not fate.struck:
        assert (result.code, fate.failures) == (0, []), f"{plan}\n{result.err}"
        return
    kills = signal.SIGKILL in (plan.how, plan.then)
    if plan.victim == "the launcher":
        assert result.code == (-signal.SIGKILL if kills else 0), f"{plan}\n{result.err}"
        return
    assert result.code in (0, 1, 2), f"{plan}\n{result.err}"
    if result.code == 1:
        assert any(failure.startswith(plan.victim) for failure in fate.failures), f"{plan}\n{fate.failures}"
    if plan.victim.startswith("node") and kills and plan.restart and summary.get("restarts"):
        assert summary["restarts"] == 1


def check_the_recording(fate: Fate, path: Path, died_ns: int, summary: dict[str, Any], directory: Path) -> None:
    plan = fate.plan
    known = read(path)
    if known is None:
        # Killed before it had written what a recording begins with: there was nothing to lose.
        assert not any(summary.get("completed_steps", {}).values()), f"{plan}\n{summary}"
        return
    fate.recording, counts, last_ns = known
    recorder_killed = plan.victim == "the recorder" and fate.struck and signal.SIGKILL in (plan.how, plan.then)
    stopped = plan.victim == "the recorder" and plan.how is signal.SIGSTOP
    assert fate.recording == "finished" or plan.victim == "the recorder", str(fate)
    if recorder_killed and plan.how is signal.SIGKILL and last_ns and fate.recording == "broken off":
        fate.lost_s = (died_ns - last_ns) / 1e9
    if summary and not recorder_killed and not stopped:
        check_the_counters(plan, counts, summary)
    if counts:
        verdict = zfusion(directory, "replay", path, "--verify", "--json")
        assert verdict.out, f"{plan}\n{verdict.err}"
        assert verdict.summary["different"] == 0, f"{plan}\n{verdict.summary}"
        if plan.victim in {"the launcher", "the network"}:  # all nodes die with it
            assert_only_last_words_are_missing(verdict.summary, path)
        else:
            assert verdict.summary["unverifiable"] == 0 or recorder_killed or stopped, f"{plan}\n{verdict.summary}"
        fate.verified = verdict.summary["identical"]
        fate.checked = Exactness(path).assert_sample(Random(plan.seed))


def read(path: Path) -> tuple[str, dict[str, int], int] | None:
    """How the recording ended, its estimates by topic, and when its last message came; None where there is nothing."""
    try:
        with Recording.open(path) as recording:
            counts = {topic: count for topic, count in recording.topics.items() if topic.endswith("/estimate")}
            last_ns = max((record.log_time_ns for record in recording.records()), default=0)
            return "finished" if recording.complete else "broken off", counts, last_ns
    except (RecordingError, OSError):
        return None


def check_the_counters(plan: Plan, counts: dict[str, int], summary: dict[str, Any]) -> None:
    """That what the swarm says of itself is what is on the recording."""
    lost = {topic: number for topic, number in summary["lost_on_recording"].items() if number}
    for node, completed in summary["completed_steps"].items():
        [on_file] = [count for topic, count in counts.items() if topic.split("/")[3] == node] or [0]
        missing = sum(number for topic, number in lost.items() if topic.endswith(f"{node}/estimate"))
        # Of a life that was cut short the launcher knows what it told last, and its last estimate may not have left it.
        cut_short = plan.victim in (f"node {node}", "the network")
        assert on_file + missing >= completed - 1 if cut_short else on_file + missing == completed, f"{plan}\n{summary}"
