"""Fuzzers: some seconds of them here; for minutes, by Hypothesis,

    ZFUSION_FUZZ=200000 python -m pytest -m long tests/test_fuzzing.py

or guided by coverage with Atheris, see `fuzzing`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzzing import TARGETS, node, wire
from zfusion.messages import Reason

MANY = int(os.environ.get("ZFUSION_FUZZ", "20000"))

data = st.binary(max_size=600)


@settings(max_examples=400, deadline=None)
@given(data)
def test_whatever_comes_is_read_or_refused(said: bytes) -> None:
    wire(said)


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=50, max_size=600))
def test_a_node_keeps_its_books_among_neighbours_that_say_anything(said: bytes) -> None:
    node(said)


def test_the_fuzzers_get_somewhere() -> None:
    random, seen, steps, late = Random(1), Counter[str](), 0, 0
    for _ in range(400):
        seen += wire(random.randbytes(40))
    for _ in range(15):
        subject = node(random.randbytes(2000))
        steps += subject.completed
        late += sum(edge.late.total() for edge in subject.counters.values())
    common = {"read", Reason.NOT_MSGPACK, Reason.NOT_A_MAP, Reason.MISSING_FIELD, Reason.WRONG_TYPE, Reason.WRONG_NODE}
    assert not [name for name in common if not seen[name]]
    assert steps > 30
    assert late > 30


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_for_minutes(target: Callable[[bytes], object]) -> None:
    settings(max_examples=MANY, deadline=None, suppress_health_check=list(HealthCheck))(
        given(st.binary(max_size=3000))(lambda said: target(said) and None)
    )()
