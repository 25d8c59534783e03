"""Key expressions: what the contract says, and back again."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from zfusion import keys
from zfusion.errors import InputError, MessageError

names = st.from_regex(keys.NAME, fullmatch=True)
ids = st.integers() | names


def test_the_keys_are_those_of_the_contract() -> None:
    assert keys.stage_key("r1", 3, "intermediate") == "zfusion/r1/node/3/intermediate"
    assert keys.truth_key("r1") == "zfusion/r1/truth"
    assert keys.node_token("r1", "mast") == "zfusion/r1/node/mast"
    assert keys.recorder_token("r1") == "zfusion/r1/recorder"
    assert keys.recorder_status_key("r1") == "zfusion/r1/recorder/status"
    assert keys.status_key("r1", 3) == "zfusion/r1/node/3/status"
    assert keys.history_key("r1", 3) == "zfusion/r1/node/3/history"


@given(names, ids, names)
def test_a_key_says_what_it_was_made_of(run: str, node: int | str, stage: str) -> None:
    assert keys.check_run(run) == run
    assert keys.parse(keys.stage_key(run, node, stage)) == (run, str(node), stage)
    assert keys.parse(keys.truth_key(run)) == (run, None, "truth")
    assert keys.parse_token(keys.node_token(run, node)) == (run, str(node))
    assert keys.parse_token(keys.recorder_token(run)) == (run, None)


@given(names, names, ids)
def test_the_whole_run_is_all_keys_of_that_run_and_of_no_other(run: str, other: str, node: int | str) -> None:
    whole = zenoh.KeyExpr(keys.whole_run(run))
    for build in (keys.truth_key, keys.recorder_token):
        assert whole.includes(build(run))
        assert whole.includes(build(other)) == (run == other)
    assert whole.includes(keys.stage_key(run, node, "estimate"))
    assert whole.includes(keys.node_token(run, node))


@pytest.mark.parametrize("run", ["", "a b", "a/b", "*", "$x", ".", "..", "-r", "é", "x" * 101, "a\n"])
def test_names_that_cannot_be_parts_of_keys_and_files_are_refused(run: str) -> None:
    with pytest.raises(InputError, match="run name"):
        keys.check_run(run)


@pytest.mark.parametrize(
    "key",
    [
        "", "zfusion", "zfusion/r", "zfusion/r/node/1", "zfusion/r/node//estimate", "zfusion/r/node/1/a/b",
        "zfusion//truth", "zfusion/r/truth/x", "other/r/truth", "xzfusion/r/truth", "zfusion/r/truth\n",
    ],
)  # fmt: skip
def test_other_keys_are_refused(key: str) -> None:
    with pytest.raises(MessageError) as error:
        keys.parse(key)
    assert error.value.reason == "unknown_key"


@pytest.mark.parametrize("key", ["", "zfusion/r/node/1/estimate", "zfusion/r/truth", "zfusion/r/recorder/1"])
def test_other_tokens_are_refused(key: str) -> None:
    with pytest.raises(MessageError) as error:
        keys.parse_token(key)
    assert error.value.reason == "unknown_key"
