"""What becomes of a swarm when somebody stops it, kills a part of it, or keeps a part from starting."""

from __future__ import annotations

import os
import signal
import socket
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from exactness import assert_only_last_words_are_missing
from swarms import (
    EXAMPLE,
    Command,
    Listener,
    Recorded,
    census,
    client,
    decoded,
    endpoints,
    launch,
    process_of,
    recorded,
    run_name,
    variant,
    wait_until,
    zfusion,
)
from zfusion.recording import Recording

NODES = ["1", "2", "3", "4"]


class Swarm:
    """A launched swarm, and somebody who listens to it."""

    def __init__(self, directory: Path, *words: object, **tables: Any) -> None:
        self.run = run_name("swarm")
        self.recording = directory / f"{self.run}.mcap"
        self.scenario = variant(directory, **tables)
        self.command = Command(
            directory, "launch", self.scenario, "--json", "--run", self.run, "--record", self.recording, *words
        )
        self._client = client(*endpoints(self.scenario).values())
        session = self._client.__enter__()
        self._listeners = {
            node: Listener(session, f"zfusion/{self.run}/node/{node}/intermediate") for node in map(int, NODES)
        }

    def last(self, node: int) -> dict[str, Any]:
        """The last intermediate estimate that was heard of the node."""
        samples = self._listeners[node].collect()
        return decoded(samples[-1]) if samples else {"step": 0, "born": 0, "used": []}

    def step(self, node: int) -> int:
        """How far the node is."""
        return int(self.last(node)["step"])

    def taken(self, node: int) -> int:
        """How many steps have been heard of the node."""
        return len(self._listeners[node].collect())

    def wait_for(self, node: int, step: int) -> None:
        """Until the node has made the step."""
        wait_until(lambda: self.step(node) >= step, f"step {step} of node {node}\n{self.command.said()}")

    def wait_for_use(self, node: int, used: list[int]) -> None:
        """Until the node uses just these nodes' measurements."""
        wait_until(lambda: self.last(node)["used"] == used, f"node {node} uses {used}\n{self.command.said()}")

    def kill(self, *words: str, with_signal: signal.Signals = signal.SIGKILL) -> None:
        os.kill(process_of(self.run, *words), with_signal)

    def messages(self) -> list[Recorded]:
        return recorded(self.recording)

    def close(self) -> None:
        self._client.__exit__(None, None, None)
        for pid in census(self.run):
            os.kill(pid, signal.SIGKILL)
        self.command.process.wait()


@contextmanager
def swarm(directory: Path, *words: object, **tables: Any) -> Iterator[Swarm]:
    running = Swarm(directory, *words, **tables)
    try:
        yield running
        wait_until(lambda: not census(running.run), "nothing is left running", 20)
    finally:
        running.close()


PACED = {"timing": {"rate_hz": 50.0}}
ENDLESS = 1_000_000
ALONE = {"matrix": [[int(i == j) for j in range(4)] for i in range(4)]}
PAIRS = {"matrix": [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1, 1]]}


def intermediates(messages: list[Recorded], node: int) -> dict[int, list[int]]:
    """Step -> whose measurements the node used."""
    return {m.payload["step"]: m.payload["used"] for m in messages if m.topic.endswith(f"/node/{node}/intermediate")}


@pytest.mark.parametrize("timing", [PACED["timing"], {"free_run": True, "rate_hz": None}], ids=["paced", "free"])
def test_ctrl_c_ends_the_run_cleanly(tmp_path: Path, timing: dict[str, Any]) -> None:
    words = [] if timing.get("rate_hz") else ["--free-run"]
    with swarm(tmp_path, "--steps", ENDLESS, *words) as running:
        wait_until(lambda: min(running.taken(int(node)) for node in NODES) > 20, "all have taken steps")
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 0, result.err
    summary = result.summary
    assert summary["interrupted"]
    assert summary["failures"] == []
    assert (summary["lost"], summary["unreported_lives"]) == (0, 0)
    assert summary["messages"]["sent"] == summary["messages"]["recorded"]
    assert all(steps >= 20 for steps in summary["completed_steps"].values())
    with Recording.open(running.recording) as recording:
        assert recording.complete
    assert zfusion(tmp_path, "replay", running.recording, "--verify", "--json").code == 0


def test_nothing_is_left_when_the_launcher_is_killed(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, **PACED) as running:
        running.wait_for(2, 10)
        assert len(census(running.run)) == 6
        running.command.process.kill()
        running.command.process.wait()
        wait_until(lambda: not census(running.run), "nothing is left running", 20)
    with Recording.open(running.recording) as recording:
        assert recording.complete  # the recorder had the time
        assert recording.messages > 100


def test_a_node_that_is_stopped_in_its_tracks_does_not_outlive_the_launcher(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, **PACED) as running:
        running.wait_for(2, 10)
        running.kill("--id", "3", with_signal=signal.SIGSTOP)
        running.command.process.kill()
        running.command.process.wait()
        wait_until(lambda: not census(running.run), "nothing is left running", 20)


def test_a_node_that_dies_is_told_and_the_others_go_on(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, **PACED) as running:
        running.wait_for_use(1, [1, 2, 3])  # whom node 1 hears
        running.wait_for(2, running.step(2) + 50)  # for it to have said how it is doing
        running.kill("--id", "2")
        wait_until(lambda: "node 2 died" in running.command.said(), "the death is told")  # at once, not at the end
        taken = {node: running.taken(node) for node in (1, 3, 4)}
        wait_until(lambda: all(running.taken(node) > taken[node] + 50 for node in taken), "the others go on")
        running.wait_for_use(1, [1, 3])
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 1
    summary = result.summary
    [failure] = summary["failures"]
    assert failure.startswith("node 2 died")
    assert "SIGKILL" in failure
    assert all(summary["completed_steps"][str(node)] >= taken[node] + 50 for node in taken)
    assert summary["completed_steps"]["2"] > 0
    messages = running.messages()
    last = max(intermediates(messages, 2))
    used = intermediates(messages, 1)
    assert [1, 2, 3] in [taken for step, taken in used.items() if step <= last]
    assert not any(2 in taken for step, taken in used.items() if step > last + 1)
    gone = [m.payload for m in messages if m.topic.endswith("/event") and m.payload["kind"] == "gone"]
    assert {event["node"] for event in gone if event["data"]["of"] == 2} == {1, 4}
    assert zfusion(tmp_path, "replay", running.recording, "--verify", "--json").code == 0


@pytest.mark.parametrize("pace", ["paced", "free"])
def test_a_node_that_dies_is_started_again_and_taken_back_in(tmp_path: Path, pace: str) -> None:
    words = ["--steps", ENDLESS, "--restart", *(["--free-run"] if pace == "free" else [])]
    everybody = {1: [1, 2, 3], 2: [2, 3, 4], 4: [1, 2, 4]}
    with swarm(tmp_path, *words, **(PACED if pace == "paced" else {})) as running:
        running.wait_for(2, 20)
        for neighbour in (1, 4):
            running.wait_for_use(neighbour, everybody[neighbour])
        running.kill("--id", "2")
        wait_until(lambda: running.last(2)["born"] > 20, "node 2 is back")
        born = running.last(2)["born"]
        for node, used in everybody.items():
            wait_until(
                lambda n=node, u=used: running.last(n)["step"] > born + 20 and running.last(n)["used"] == u,
                f"node {node} uses {used}, not {running.last(node)['used']}",
            )
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 0, result.err
    assert "node 2 died" in result.err
    assert "starting it again" in result.err
    summary = result.summary
    assert (summary["restarts"], summary["unreported_lives"]) == (1, 1)
    assert summary["failures"] == []
    messages = running.messages()
    first_life = [m for m in messages if "/node/2/" in m.topic and m.payload["born"] < born]
    missing = Counter(m.topic.rpartition("/")[2] for m in first_life)
    sent, on_file = Counter(summary["messages"]["sent"]), Counter(summary["messages"]["recorded"])
    assert on_file - sent == missing, "what the life that was killed had sent"
    for neighbour in (1, 4):
        used = intermediates(messages, neighbour)
        assert everybody[neighbour] in [taken for step, taken in used.items() if step < born]
        assert any(2 not in used.get(step, [2]) for step in range(20, born))
    verdict = zfusion(tmp_path, "replay", running.recording, "--verify", "--json")
    assert verdict.code == 0, verdict.out + verdict.err


def kill_all_at_once(running: Swarm) -> None:
    pids = [process_of(running.run, "--id", node) for node in NODES]
    for how in (signal.SIGSTOP, signal.SIGKILL):  # none is to go on, and be joined, while the others are killed
        for pid in pids:
            os.kill(pid, how)


def test_nodes_that_all_die_at_once_go_on_together(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, "--restart", **PACED) as running:
        running.wait_for(2, 20)
        kill_all_at_once(running)
        for node, used in {1: [1, 2, 3], 2: [2, 3, 4], 3: [1, 3, 4], 4: [1, 2, 4]}.items():
            wait_until(
                lambda n=node, u=used: running.last(n)["born"] > 20 and running.last(n)["used"] == u,
                f"node {node} uses {used} again, not {running.last(node)}\n{running.command.said()}",
            )
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 0, result.err
    assert result.summary["restarts"] == 4
    assert result.summary["failures"] == []
    verdict = zfusion(tmp_path, "replay", running.recording, "--verify", "--json")
    assert verdict.out, verdict.err
    assert_only_last_words_are_missing(verdict.summary, running.recording)


def test_a_node_that_is_alone_goes_on_with_the_step_that_is_due(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, "--restart", network=ALONE, **PACED) as running:
        running.wait_for(2, 20)
        os.kill(process_of(running.run, "--id", "2"), signal.SIGKILL)
        wait_until(lambda: running.last(2)["born"] > 20, f"node 2 has gone on\n{running.command.said()}")
        running.command.interrupt()
        assert running.command.wait().code == 0
    messages = [m.payload for m in recorded(running.recording) if m.topic.endswith("/node/2/estimate")]
    steps = [m["step"] for m in messages]
    assert steps == sorted(set(steps))
    assert len({m["born"] for m in messages}) == 2


def lives(path: Path) -> dict[int, dict[int, list[int]]]:
    """Node -> the first step of each life -> the steps of its estimates."""
    found: dict[int, dict[int, list[int]]] = {}
    for m in recorded(path):
        if m.topic.endswith("/estimate"):
            found.setdefault(m.payload["node"], {}).setdefault(m.payload["born"], []).append(m.payload["step"])
    return found


def killed_by_plan(
    directory: Path, nodes: Iterable[int], *words: object, **tables: Any
) -> dict[int, dict[int, list[int]]]:
    """The lives of a run in which these nodes die at step 30, to begin again at step 90; nobody is lost by that."""
    return killed_for(dict.fromkeys(nodes, 60), directory, *words, **tables)


def killed_for(
    away: Mapping[int, int], directory: Path, *words: object, **tables: Any
) -> dict[int, dict[int, list[int]]]:
    """Likewise; nodes are away for so many steps each."""
    faults = [{"kind": "kill", "node": node, "step": 30, "restart_after": steps} for node, steps in away.items()]
    result = launch(directory, variant(directory, faults=faults, **tables), *words, "--record", "r.mcap")
    assert result.code == 0, result.err
    summary = result.summary
    assert (summary["failures"], summary["restarts"], summary["unreported_lives"]) == ([], len(faults), 0)
    verdict = zfusion(directory, "replay", "r.mcap", "--verify", "--json")
    assert verdict.code == 0, verdict.out + verdict.err
    found = lives(directory / "r.mcap")
    for born in found.values():
        for first, taken in born.items():
            assert taken[0] >= first
            assert taken == sorted(set(taken))
    return found


def test_nodes_that_are_all_killed_by_plan_come_back_together(tmp_path: Path) -> None:
    for born in killed_by_plan(tmp_path, (1, 2, 3, 4), "--steps", 500, **PACED).values():
        first, second = born
        assert first == 1
        assert second > 90


@pytest.mark.parametrize(
    ("network", "nodes"),
    [({}, (1, 2, 3, 4)), ({"network": ALONE}, (2,)), ({"network": PAIRS}, (1, 2))],
    ids=["all", "one alone", "a pair"],
)
def test_without_times_they_are_told_with_which_step(
    tmp_path: Path, network: dict[str, Any], nodes: tuple[int, ...]
) -> None:
    found = killed_by_plan(tmp_path, nodes, "--free-run", "--steps", 300, **network)
    for node, born in found.items():
        assert born[1] == list(range(1, 30 if node in nodes else 301))
    assert first_steps_after(found, nodes)[0] == 90


def first_steps_after(found: dict[int, dict[int, list[int]]], nodes: Iterable[int]) -> list[int]:
    """With which steps the second lives of these nodes begin, sorted; each goes on to step 300.

    On a busy machine one may come to the others when they have begun.
    """
    begun = []
    for node in nodes:
        _, second = found[node]
        assert found[node][second] == list(range(second, 301))
        begun.append(second)
    return sorted(begun)


def test_without_times_those_of_a_part_that_fell_together_begin_together(tmp_path: Path) -> None:
    """The others run far ahead; whether both are raised at once or one after the other, they begin with one step."""
    found = killed_for({1: 60, 2: 70}, tmp_path, "--free-run", "--steps", 300, network=PAIRS)
    _, together = first_steps_after(found, (1, 2))
    used = intermediates(recorded(tmp_path / "r.mcap"), 1)
    assert [1, 2] in [used[step] for step in range(together, 301)]


def test_without_times_a_node_that_is_alone_is_not_started_again(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, "--restart", "--free-run", network=ALONE) as running:
        running.wait_for(2, 20)
        os.kill(process_of(running.run, "--id", "2"), signal.SIGKILL)
        wait_until(lambda: "node 2 died" in running.command.said(), "the death is told")
        running.command.interrupt()
        result = running.command.wait()
    assert result.code == 1
    [failure] = result.summary["failures"]
    assert failure.startswith("node 2 died")
    assert result.summary["restarts"] == 0
    assert all(list(born) == [1] for born in lives(running.recording).values())


def test_a_run_without_times_has_failed_when_all_its_nodes_die_at_once(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, "--restart", "--free-run") as running:
        running.wait_for(2, 20)
        kill_all_at_once(running)
        result = running.command.wait()
    assert result.code == 1, result.err
    words = "found nobody to join: all had died at about the same time"
    assert sorted(result.summary["failures"]) == [f"node {node} {words}" for node in NODES]


def test_the_death_of_the_recorder_ends_the_run_and_costs_one_flush_at_most(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, recording={"flush_interval_s": 0.2}, **PACED) as running:
        running.wait_for(3, 75)
        taken = running.taken(3)
        running.kill("record")
        result = running.command.wait()
    assert result.code == 1
    summary = result.summary
    assert summary["interrupted"]
    assert summary["failures"] == ["the recorder died: killed by SIGKILL"]
    assert summary["completed_steps"]["3"] >= taken - 1  # of the last step there may be no estimate
    with Recording.open(running.recording) as recording:
        assert not recording.complete
        # 0.2 s are 10 steps; the rest is what a busy machine may need between two flushes
        assert recording.topics[f"zfusion/{running.run}/node/3/estimate"] >= taken - 10 - 25


def refused(directory: Path, *words: object, run: str | None = None) -> str:
    """The line with which a command refuses to run."""
    run = run or run_name("refused")
    result = zfusion(directory, *words, "--run", run)
    assert result.code == 2, result.err
    assert not census(run)
    return result.error


def test_a_second_recorder_of_a_file_is_refused_and_the_first_has_everything(tmp_path: Path) -> None:
    with swarm(tmp_path, "--steps", ENDLESS, **PACED) as running:
        running.wait_for(2, 10)
        errors = [
            refused(tmp_path, "launch", EXAMPLE, "--record", running.recording),
            refused(tmp_path, "record", EXAMPLE, "-o", running.recording),
            refused(tmp_path, "simulate", EXAMPLE, "--record", running.recording),
        ]
        running.wait_for(2, running.step(2) + 10)
        running.command.interrupt()
        result = running.command.wait()
    assert all(
        error.endswith(f"{running.recording}: cannot be written: another process is writing it") for error in errors
    )
    assert result.code == 0, result.err
    assert result.summary["messages"]["sent"] == result.summary["messages"]["recorded"]
    with Recording.open(running.recording) as recording:
        assert recording.complete


def test_a_port_that_is_in_use_fails_the_launch(tmp_path: Path) -> None:
    scenario = variant(tmp_path)
    host, port = endpoints(scenario)["3"].removeprefix("tcp/").split(":")
    with socket.socket() as taken:
        taken.bind((host, int(port)))
        taken.listen()
        error = refused(tmp_path, "launch", scenario, "--no-record")
    assert error.startswith("error: node 3: ")
    assert f"{host}:{port}" in error
    assert "in use" in error


def test_a_source_that_is_missing_fails_the_launch(tmp_path: Path) -> None:
    scenario = variant(tmp_path, source={"kind": "csv", "file": "missing-{id}.csv", "columns": ["y"]})
    error = refused(tmp_path, "launch", scenario, "--record", "x.mcap")
    assert error.startswith("error: node ")
    assert "missing-" in error


def test_what_cannot_be_launched_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "nowhere.toml" in refused(tmp_path, "launch", "nowhere.toml")
    assert "two_stage" in refused(tmp_path, "launch", EXAMPLE, "--method", "guesswork")
    assert "1, 2, 3, 4" in refused(tmp_path, "node", EXAMPLE, "--id", "9")
    for record in ("file/x.mcap", "/proc/nowhere/x.mcap"):
        assert record in refused(tmp_path, "launch", EXAMPLE, "--record", record)
    (tmp_path / "x.mcap").mkdir()
    assert "x.mcap" in refused(tmp_path, "launch", EXAMPLE, "--record", "x.mcap")
    quiet = variant(tmp_path, recording={"directory": "file"})
    assert "file" in refused(tmp_path, "launch", quiet, "--no-record")


def test_a_source_that_fails_later_is_told_with_its_words(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(
        "def read(step, t_ns, node):\n"
        "    if node == 3 and step > 5:\n"
        "        raise OSError('unplugged')\n"
        "    return 1.0\n"
    )
    scenario = variant(tmp_path, source={"kind": "python", "function": "bad.py:read"})
    result = launch(tmp_path, scenario, "--free-run", "--steps", 40, "--no-record")
    assert result.code == 1
    [failure] = result.summary["failures"]
    assert failure.startswith("node 3 died")
    assert "unplugged" in failure
    assert result.summary["completed_steps"]["1"] == 40


def test_a_second_launch_does_not_disturb_the_first(tmp_path: Path) -> None:
    commands = [
        Command(tmp_path, "launch", EXAMPLE, "--json", "--free-run", "--steps", 30, "--record", f"{n}.mcap")
        for n in range(2)
    ]
    for result in [command.wait() for command in commands]:
        assert result.code == 0, result.err
        assert result.summary["completed_steps"] == dict.fromkeys(NODES, 30)
        assert result.summary["refused"] == {}
