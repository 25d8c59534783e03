"""Fuzzers of what reads what peers send: for some time here, for longer as `drawing` says, or guided by coverage with
Atheris, as `fuzzing` says. That of recordings is in `test_recover`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import strategies as st

from drawing import TIMEOUT_S, fuzz
from fuzzing import TARGETS, node, wire
from zfusion.messages import Reason


@pytest.mark.slow
@pytest.mark.timeout(TIMEOUT_S)
@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
def test_fuzz(target: Callable[[bytes], object]) -> None:
    """Whatever comes is read or refused; a node keeps its books among neighbours that say anything."""
    fuzz(target, st.binary(max_size=600) | st.binary(min_size=50, max_size=3000))


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
