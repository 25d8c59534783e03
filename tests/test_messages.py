"""The wire format: exact for what is legal, one kind of error for everything else."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import jsonschema
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zfusion import messages
from zfusion.errors import MessageError
from zfusion.messages import Decoder, Reason, decode_any, encode, json_schema, read_stamp
from zfusion.stages import (
    ARRIVALS,
    BUILT_IN,
    ESTIMATE,
    EVENT,
    INTERMEDIATE,
    MEASUREMENT,
    REVISED,
    TRUTH,
    TRUTH_SENDER,
    Field,
    Kind,
    Message,
    Stage,
)

IDS = (1, 2, 5)
SIZES = {"nx": 2, "ny": 3}

FIELDS: dict[Stage, dict[str, Any]] = {
    MEASUREMENT: {"y": [1.5, -0.25, 3.0]},
    INTERMEDIATE: {"x": [0.5, 2.0], "used": [1, 2], "history": [[3, [1, 2, 5]], [6, []]]},
    ESTIMATE: {"x": [0.5, 2.0], "P": [4.0, 1.0, 1.0, 3.0], "shape": [2, 2], "used": [1, 5], "excluded": [2]},
    REVISED: {"x": [0.5, 2.0], "P": [4.0, 1.0, 1.0, 3.0], "shape": [2, 2], "used": [1, 5], "excluded": [2], "at": 12},
    EVENT: {"kind": "late", "data": {"from": 5, "by_ns": 1200, "why": ["x", None, True, 1.5]}},
    ARRIVALS: {"data": {"edges": [{"from": 1, "stage": "measurement", "steps": [[1, 2]], "latency_ns": [5, 7]}]}},
    TRUTH: {"x": [0.5, 2.0]},
}


def payload(stage: Stage, **changes: Any) -> dict[str, Any]:
    """A legal payload of node 2 (or of the truth) at step 9, with changes."""
    node = TRUTH_SENDER if stage is TRUTH else 2
    return {"v": 1, "node": node, "step": 9, "t_ns": 10**18, "seq": 7, "born": 3} | FIELDS[stage] | changes


def decoder(stage: Stage) -> Decoder:
    return Decoder(stage, TRUTH_SENDER if stage is TRUTH else 2, sizes=SIZES, ids=IDS)


def reason(stage: Stage, data: bytes) -> str:
    with pytest.raises(MessageError) as error:
        decoder(stage).decode(data)
    return error.value.reason


# --- what is legal ----------------------------------------------------------------------------------------------


def test_the_payloads_are_those_of_the_contract() -> None:
    sent = Message(
        4, 12, "estimate", 11, 1, 1_790_000_000_000_000_000,
        {"x": np.array([1.0, 2.0]), "P": np.array([[1.0, 2.0], [3.0, 4.0]]), "used": (1, 4), "excluded": ()},
    )  # fmt: skip
    assert msgpack.unpackb(encode(sent)) == {
        "v": 1,
        "node": 4,
        "step": 12,
        "t_ns": 1_790_000_000_000_000_000,
        "seq": 11,
        "born": 1,
        "x": [1.0, 2.0],
        "P": [1.0, 2.0, 3.0, 4.0],
        "shape": [2, 2],
        "used": [1, 4],
        "excluded": [],
    }


def test_a_matrix_goes_row_by_row_however_it_lies_in_memory() -> None:
    matrix = np.arange(6.0).reshape(3, 2).T
    sent = Message(1, 1, "estimate", 0, 1, 1, {"P": matrix})
    assert msgpack.unpackb(encode(sent))["P"] == matrix.tolist()[0] + matrix.tolist()[1]


@pytest.mark.parametrize("stage", BUILT_IN, ids=lambda stage: stage.name)
def test_what_is_decoded_encodes_to_the_same_map(stage: Stage) -> None:
    message = decoder(stage).decode(msgpack.packb(payload(stage)))
    assert (message.step, message.stage, message.seq, message.born, message.t_ns) == (9, stage.name, 7, 3, 10**18)
    assert decode_any(encode(message)) == payload(stage)
    assert read_stamp(encode(message)) == (3, 7, 10**18, message.step)


def test_decoded_values_have_the_types_of_their_kinds() -> None:
    fields = decoder(INTERMEDIATE).decode(msgpack.packb(payload(INTERMEDIATE))).fields
    assert fields["used"] == (1, 2)
    assert fields["history"] == ((3, (1, 2, 5)), (6, ()))
    P = decoder(ESTIMATE).decode(msgpack.packb(payload(ESTIMATE))).fields["P"]
    assert isinstance(P, np.ndarray)
    assert (P.dtype, P.shape) == (np.float64, (2, 2))
    with pytest.raises(ValueError, match="read-only"):
        P[0, 0] = 1.0


def test_a_sensor_without_a_reading_says_nil() -> None:
    data = encode(Message(2, 9, "measurement", 7, 3, 1, {"y": None}))
    assert decoder(MEASUREMENT).decode(data).fields["y"] is None
    assert reason(TRUTH, msgpack.packb(payload(TRUTH, x=None))) == Reason.WRONG_TYPE


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=0, max_size=20))
def test_floats_arrive_bit_for_bit(values: list[float]) -> None:
    sent = np.array(values, dtype=np.float64)
    got = Decoder(MEASUREMENT, 1, sizes={"ny": len(values)}).decode(
        encode(Message(1, 1, "measurement", 0, 1, 0, {"y": sent}))
    )
    assert np.asarray(got.fields["y"]).tobytes() == sent.tobytes()


@pytest.mark.parametrize("value", [-0.0, 5e-324, -2.2e-308, 1.7976931348623157e308, math.nextafter(1.0, 2.0)])
def test_awkward_floats_arrive_bit_for_bit(value: float) -> None:
    """Several of the largest too: their sum is infinite, they are not."""
    sent = np.full(3, value)
    got = decoder(MEASUREMENT).decode(encode(Message(2, 9, "measurement", 7, 3, 1, {"y": sent})))
    assert np.asarray(got.fields["y"]).tobytes() == sent.tobytes()


def test_names_that_a_reader_does_not_know_are_skipped() -> None:
    data = msgpack.packb(payload(TRUTH, run="r", unit="m", more={"a": [1, b"2"]}))
    assert set(decoder(TRUTH).decode(data).fields) == {"x"}


def test_named_nodes() -> None:
    reads = Decoder(INTERMEDIATE, "b", sizes=SIZES, ids=("a", "b"))
    data = msgpack.packb(payload(INTERMEDIATE, node="b", used=["a", "b"], history=[[4, ["a"]]]))
    assert reads.decode(data).fields["history"] == ((4, ("a",)),)


@pytest.mark.parametrize("ids", [tuple(range(2**64 - 300, 2**64)), tuple(f"sensor-{n:03d}" for n in range(300))])
def test_the_largest_legal_message_is_not_too_large(ids: tuple[int, ...] | tuple[str, ...]) -> None:
    """The limits are derived from the table; this is the extreme of every field at once."""
    everything = Stage(
        "everything",
        (
            Field("vector_of_nx", Kind.VECTOR, ("nx",)),
            Field("matrix_of_nx", Kind.MATRIX, ("nx", "nx")),
            Field("ids", Kind.IDS),
            Field("history", Kind.HISTORY),
            Field("text", Kind.TEXT),
        ),
    )
    high, runs = messages.MAX_STEP, messages.MAX_HISTORY_RUNS
    fields: dict[str, object] = {
        "vector_of_nx": np.full(30, 0.1),
        "matrix_of_nx": np.full((30, 30), 0.1),
        "ids": ids,
        "history": tuple((high - runs + n, ids) for n in range(runs)),
        "text": "\U0001f6f0" * messages.MAX_TEXT,
    }
    sent = Message(ids[-1], high, "everything", high, 1, messages.MAX_TIME_NS, fields)
    got = Decoder(everything, ids[-1], sizes={"nx": 30}, ids=ids).decode(encode(sent))
    assert got.fields["history"] == fields["history"]
    assert got.fields["text"] == fields["text"]


# --- what is not ------------------------------------------------------------------------------------------------

ILLEGAL = [
    (MEASUREMENT, {"v": 2}, Reason.VERSION),
    (MEASUREMENT, {"v": "1"}, Reason.VERSION),
    (MEASUREMENT, {"v": True}, Reason.VERSION),
    (MEASUREMENT, {"v": 1.0}, Reason.VERSION),
    (MEASUREMENT, {"node": 1}, Reason.WRONG_NODE),
    (MEASUREMENT, {"node": "2"}, Reason.WRONG_NODE),
    (MEASUREMENT, {"node": 2.0}, Reason.WRONG_NODE),
    (MEASUREMENT, {"node": None}, Reason.WRONG_NODE),
    (MEASUREMENT, {"step": True}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"step": 9.0}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"seq": "7"}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"t_ns": None}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"step": 0, "born": 0}, Reason.OUT_OF_RANGE),
    (MEASUREMENT, {"born": 10}, Reason.OUT_OF_RANGE),
    (MEASUREMENT, {"step": 2**53}, Reason.OUT_OF_RANGE),
    (MEASUREMENT, {"seq": -1}, Reason.OUT_OF_RANGE),
    (MEASUREMENT, {"t_ns": 2**63}, Reason.OUT_OF_RANGE),
    (MEASUREMENT, {"y": [1.0, 2.0]}, Reason.WRONG_SHAPE),
    (MEASUREMENT, {"y": [1.0] * 50}, Reason.WRONG_SHAPE),
    (MEASUREMENT, {"y": []}, Reason.WRONG_SHAPE),
    (MEASUREMENT, {"y": 1.0}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": [1.0, 2.0, 3]}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": [1.0, 2.0, False]}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": [1.0, 2.0, "3.0"]}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": [1.0, [2.0], 3.0]}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": b"\0" * 24}, Reason.WRONG_TYPE),
    (MEASUREMENT, {"y": [1.0, math.nan, 3.0]}, Reason.NOT_FINITE),
    (MEASUREMENT, {"y": [1.0, math.inf, -math.inf]}, Reason.NOT_FINITE),
    (INTERMEDIATE, {"used": [1, 3]}, Reason.UNKNOWN_ID),
    (INTERMEDIATE, {"used": [2, 1]}, Reason.NOT_SORTED),
    (INTERMEDIATE, {"used": [1, 1]}, Reason.NOT_SORTED),
    (INTERMEDIATE, {"used": [True, 2]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"used": [1.0, 2]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"used": [[1], 2]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"used": {"1": 2}}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"history": [[9, [1]]]}, Reason.BAD_HISTORY),
    (INTERMEDIATE, {"history": [[2, [1]]]}, Reason.BAD_HISTORY),
    (INTERMEDIATE, {"history": [[5, [1]], [5, [2]]]}, Reason.BAD_HISTORY),
    (INTERMEDIATE, {"history": [[5, [1]], [4, [2]]]}, Reason.BAD_HISTORY),
    (INTERMEDIATE, {"history": [[5, [3]]]}, Reason.UNKNOWN_ID),
    (INTERMEDIATE, {"history": [[5, [1], 6]]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"history": [5]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"history": [[True, [1]]]}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"history": {}}, Reason.WRONG_TYPE),
    (INTERMEDIATE, {"history": [[4, [1]]] * 257}, Reason.NOT_MSGPACK),
    (ESTIMATE, {"shape": [4, 1]}, Reason.WRONG_SHAPE),
    (ESTIMATE, {"shape": [2]}, Reason.WRONG_SHAPE),
    (ESTIMATE, {"shape": [2.0, 2]}, Reason.WRONG_TYPE),
    (ESTIMATE, {"shape": None}, Reason.WRONG_TYPE),
    (ESTIMATE, {"P": [[4.0, 1.0], [1.0, 3.0]]}, Reason.WRONG_SHAPE),
    (EVENT, {"kind": 3}, Reason.WRONG_TYPE),
    (EVENT, {"kind": "x" * 201}, Reason.TOO_LARGE),
    (EVENT, {"data": []}, Reason.WRONG_TYPE),
    (EVENT, {"data": {"a": b"b"}}, Reason.WRONG_TYPE),
    (EVENT, {"data": {b"a": 1}}, Reason.WRONG_TYPE),
    (EVENT, {"data": {"a": msgpack.ExtType(5, b"")}}, Reason.WRONG_TYPE),
    (EVENT, {"data": {"a": [[[[[[[[[]]]]]]]]]}}, Reason.TOO_DEEP),
    (TRUTH, {"node": 2}, Reason.WRONG_NODE),
]


@pytest.mark.parametrize(("stage", "changes", "expected"), ILLEGAL)
def test_what_is_not_legal_is_refused_with_its_reason(stage: Stage, changes: Any, expected: Reason) -> None:
    assert reason(stage, msgpack.packb(payload(stage, **changes))) == expected


def test_a_history_longer_than_any_sender_tells() -> None:
    many = Decoder(INTERMEDIATE, 2, sizes={"nx": 300}, ids=IDS)  # a list of 300 is legal for this sender, as x
    long = payload(INTERMEDIATE, x=[0.0] * 300, step=400, history=[[n, [1]] for n in range(3, 260)])
    with pytest.raises(MessageError) as error:
        many.decode(msgpack.packb(long))
    assert error.value.reason == Reason.TOO_LARGE


@pytest.mark.parametrize("stage", BUILT_IN, ids=lambda stage: stage.name)
def test_every_field_is_needed(stage: Stage) -> None:
    for name in payload(stage):
        rest = {key: value for key, value in payload(stage).items() if key != name}
        assert reason(stage, msgpack.packb(rest)) == Reason.MISSING_FIELD


@pytest.mark.parametrize("stage", BUILT_IN, ids=lambda stage: stage.name)
def test_no_part_of_a_message_is_a_message_nor_one_with_more_behind_it(stage: Stage) -> None:
    data = msgpack.packb(payload(stage))
    for length in range(len(data)):
        assert reason(stage, data[:length]) == Reason.NOT_MSGPACK
    assert reason(stage, data + b"\xc0") == Reason.NOT_MSGPACK


@pytest.mark.parametrize("data", [b"\x93\x01\x02\x03", b"\xc0", b"\x01", b"\xa3abc", b"\xc1", b"noise", b'{"v": 1}'])
def test_what_is_no_map(data: bytes) -> None:
    assert reason(TRUTH, data) == Reason.NOT_A_MAP
    for read in (read_stamp, decode_any):
        with pytest.raises(MessageError) as error:
            read(data)
        assert error.value.reason == Reason.NOT_A_MAP


@pytest.mark.parametrize(
    "bomb",
    [
        b"\x91" * 1000,
        b"\x91" * 2000 + b"\x01",
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xdd\x00\x00\x04\x00" * 200,
        b"\x81\x01\x02",
        b"\xa1\xff",
        b"\xd7\xff" + b"\xff" * 8,
        b"\xc1",
    ],
)
@pytest.mark.parametrize("read", [decoder(TRUTH).decode, decoder(EVENT).decode, read_stamp, decode_any])
def test_bombs_and_broken_msgpack_are_refused(bomb: bytes, read: Callable[[bytes], object]) -> None:
    with pytest.raises(MessageError):
        read(bomb)


def test_size_is_looked_at_before_anything_else() -> None:
    """Too large for its sender, though it would be legal otherwise; too large for anybody."""
    assert reason(TRUTH, msgpack.packb(payload(TRUTH, padding="x" * 1500))) == Reason.TOO_LARGE
    for read in (read_stamp, decode_any):
        with pytest.raises(MessageError) as error:
            read(bytes(messages.MAX_MESSAGE_BYTES + 1))
        assert error.value.reason == Reason.TOO_LARGE


def test_every_reason_of_a_decoder_is_one_that_can_happen() -> None:
    elsewhere = {Reason.NOT_JSON, Reason.UNKNOWN_KEY, Reason.NOT_A_MAP, Reason.MISSING_FIELD}
    assert {expected for _, _, expected in ILLEGAL} | elsewhere == set(Reason)


READS = [*(decoder(stage).decode for stage in BUILT_IN), read_stamp, decode_any]


def assert_reads_or_refuses(data: bytes) -> None:
    for read in READS:
        with suppress(MessageError):
            read(data)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_a_message_error(data: bytes) -> None:
    assert_reads_or_refuses(data)


leaf = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5)
plain = st.recursive(
    leaf | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


@given(st.data())
@settings(max_examples=300)
def test_any_value_in_any_place_is_a_message_or_a_message_error(data: st.DataObject) -> None:
    stage = data.draw(st.sampled_from(BUILT_IN))
    name = data.draw(st.sampled_from(sorted(payload(stage))))
    assert_reads_or_refuses(msgpack.packb(payload(stage, **{name: data.draw(plain)})))


@given(st.data())
@settings(max_examples=300)
def test_any_altered_message_is_a_message_or_a_message_error(data: st.DataObject) -> None:
    altered = bytearray(msgpack.packb(payload(data.draw(st.sampled_from(BUILT_IN)))))
    for _ in range(data.draw(st.integers(1, 4))):
        altered[data.draw(st.integers(0, len(altered) - 1))] = data.draw(st.integers(0, 255))
    assert_reads_or_refuses(bytes(altered))


def test_the_error_does_not_repeat_what_the_sender_shouts() -> None:
    with pytest.raises(MessageError) as error:
        decoder(EVENT).decode(msgpack.packb(payload(EVENT, kind=["x" * 500])))
    assert len(str(error.value)) < 200


# --- tools, schemas, tables, documentation ----------------------------------------------------------------------


def test_tools_read_what_no_decoder_knows() -> None:
    data = msgpack.packb({"v": 7, "something": [1, math.inf, {"else": None}]})
    assert decode_any(data) == {"v": 7, "something": [1, math.inf, {"else": None}]}
    with pytest.raises(MessageError) as error:
        read_stamp(data)
    assert error.value.reason == Reason.MISSING_FIELD


@pytest.mark.parametrize("stage", BUILT_IN, ids=lambda stage: stage.name)
def test_the_schema_of_a_stage_says_what_its_payloads_are(stage: Stage) -> None:
    schema = json_schema(stage)
    json.dumps(schema)
    jsonschema.Draft202012Validator.check_schema(schema)
    check = jsonschema.Draft202012Validator(schema)
    check.validate(payload(stage))
    for name in payload(stage):
        assert not check.is_valid({key: value for key, value in payload(stage).items() if key != name})
        assert not check.is_valid(payload(stage, **{name: {"not": "this"}})) or name == "data"


def test_a_measurement_may_be_nil_in_its_schema_too() -> None:
    jsonschema.validate(payload(MEASUREMENT, y=None), json_schema(MEASUREMENT))


@pytest.mark.parametrize(
    "build",
    [
        lambda: Field("step", Kind.TEXT),
        lambda: Field("shape", Kind.IDS),
        lambda: Field("a/b", Kind.TEXT),
        lambda: Field("x", Kind.VECTOR),
        lambda: Field("x", Kind.MATRIX, ("nx",)),
        lambda: Field("x", Kind.IDS, ("nx",)),
        lambda: Stage("two words", ()),
        lambda: Stage("twice", (Field("a", Kind.TEXT), Field("a", Kind.IDS))),
        lambda: Stage("two", (Field("a", Kind.MATRIX, (1, 1)), Field("b", Kind.MATRIX, (1, 1)))),
    ],
)
def test_tables_that_cannot_be_are_refused(build: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"expected|twice|more than one|shape"):
        build()


def test_a_decoder_needs_the_sizes_of_its_table() -> None:
    with pytest.raises(KeyError, match="nx"):
        Decoder(TRUTH, TRUTH_SENDER)


def test_the_documentation_names_every_field_and_every_reason() -> None:
    page = (Path(__file__).parent.parent / "docs" / "messages.md").read_text(encoding="utf-8")
    for stage in BUILT_IN:
        assert f"`{stage.name}`" in page
        for field in stage.fields:
            assert f"`{field.name}`" in page
    for name in Reason:
        assert f"`{name}`" in page
