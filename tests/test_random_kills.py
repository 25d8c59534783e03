"""One process of a swarm is killed or stopped at a random moment: a few times here, many times by

ZFUSION_KILLS=50 python -m pytest -m long -s tests/test_random_kills.py
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from pathlib import Path

import pytest

from random_kills import BUSY_S, FLUSH_S, Fate, Plan, carry_out
from test_netns_swarm import TROUBLE

FIRST_SEED = int(os.environ.get("ZFUSION_KILLS_SEED", "1000"))
KILLS = int(os.environ.get("ZFUSION_KILLS", "50"))


def check_loss(fate: Fate) -> None:
    if fate.lost_s is not None:
        assert fate.lost_s < FLUSH_S + BUSY_S, str(fate)


@pytest.mark.parametrize(
    "plan",
    [
        Plan(1, "node 2", signal.SIGKILL, True, 0.3, None, 0.0, True, False, steps=75),
        Plan(2, "the recorder", signal.SIGKILL, True, 0.7, None, 0.0, False, False, steps=75),
        Plan(3, "the launcher", signal.SIGSTOP, True, 0.2, signal.SIGKILL, 0.4, False, False, steps=75),
    ],
    ids=str,
)
def test_whoever_dies_nothing_hangs_and_nothing_is_wrong(plan: Plan, tmp_path: Path) -> None:
    fate = carry_out(plan, tmp_path)
    assert fate.checked["estimates"] > 0
    check_loss(fate)


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_fifty_random_kills(tmp_path: Path) -> None:
    fates: list[Fate] = []
    errors: list[str] = []
    for seed in range(FIRST_SEED, FIRST_SEED + KILLS):
        plan = Plan.draw(seed, TROUBLE is None)
        try:
            fates.append(carry_out(plan, tmp_path))
            check_loss(fates[-1])
            print(fates[-1], flush=True)
        except AssertionError as error:
            errors.append(f"{plan}\n{error}")
            print(f"FAILED {plan}\n{error}", flush=True)
    recordings = Counter(fate.recording for fate in fates)
    print(f"{len(fates)} launches, {sum(fate.struck for fate in fates)} struck; recordings: {dict(recordings)}")
    print("verified bit for bit:", sum(fate.verified for fate in fates))
    print("set beside least squares:", sum((fate.checked for fate in fates), Counter[str]()))
    print("lost with the recorder, s:", sorted(round(fate.lost_s, 2) for fate in fates if fate.lost_s is not None))
    assert not errors
