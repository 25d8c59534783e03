"""Messages as they come off the wire, in words: for `echo`.

What comes is anybody's: it is shown whatever it is, and nothing in it can do anything to a terminal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from zfusion import keys
from zfusion.drivers.observer import Letter
from zfusion.errors import MessageError
from zfusion.messages import MAX_MESSAGE_BYTES, Reason, decode_any, read_stamp
from zfusion.stages import HEADER

SHOWN_BYTES = 32
"""Of a payload that cannot be read."""

SHOWN_ELEMENTS = 24
"""Of a vector or matrix; of more, the first and the last are shown."""


def printable(text: str) -> str:
    """The text, with all that a terminal would act on written out."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def decoded(letter: Letter) -> dict[str, Any]:
    """The message in a letter, unchecked but for what every message has; MessageError if it is none."""
    if letter.size > MAX_MESSAGE_BYTES:
        raise MessageError(Reason.TOO_LARGE, f"{letter.size} bytes, expected at most {MAX_MESSAGE_BYTES}")
    node = keys.parse(letter.key).node
    payload = decode_any(letter.data)
    read_stamp(letter.data)
    if node is not None and str(payload.get("node")) != node:
        raise MessageError(Reason.WRONG_NODE, f"{payload.get('node')!r:.80} on the key of {node}")
    return payload


def as_data(letter: Letter) -> dict[str, Any]:
    """A letter as what JSON can say: key, received_ns, bytes, and message, or error where it is none."""
    told: dict[str, Any] = {"key": letter.key, "received_ns": letter.received_ns, "bytes": letter.size}
    try:
        return {**told, "message": finite(decoded(letter))}
    except MessageError as error:
        if error.reason == Reason.UNKNOWN_KEY:
            return {**told, "text": _foreign(letter.data)}
        return {**told, "error": error.reason, "detail": str(error)}


def as_text(letter: Letter) -> str:
    """A letter for people: a line of what every message has, and one for each of its fields, matrices excepted."""
    key = printable(letter.key.removeprefix(f"{keys.ROOT}/"))
    try:
        payload = decoded(letter)
    except MessageError as error:
        if error.reason == Reason.UNKNOWN_KEY:
            return f"{printable(letter.key)}  {letter.size} bytes\n  {_foreign(letter.data)}"
        start = letter.data[:SHOWN_BYTES].hex(" ")
        return f"{key}  broken, {letter.size} bytes: {printable(str(error))}\n  {start}"
    at = datetime.fromtimestamp(letter.received_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]
    age_ms = (letter.received_ns - payload["t_ns"]) / 1e6
    life = f"  born {payload['born']}" if payload["born"] > 1 else ""
    head = f"{key}  step {payload['step']}  seq {payload['seq']}{life}  {at}  sent {age_ms:.3g} ms before"
    return "\n".join([head, *_fields(payload)])


def as_raw(letter: Letter) -> str:
    """The bytes as they came."""
    return f"{printable(letter.key)} {letter.size} {letter.data.hex()}"


def finite(value: Any) -> Any:
    """The same with text in the place of what JSON has no numbers for."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return value


def _fields(payload: Mapping[str, Any]) -> Iterator[str]:
    matrix, shape = _matrix(payload)
    names = [name for name in payload if name not in HEADER and (matrix is None or name != "shape")]
    width = max((len(name) for name in names), default=0)
    for name in names:
        value = np.reshape(payload[name], shape) if name == matrix else payload[name]
        first, *more = _value(value).splitlines() or [""]
        yield f"  {printable(name):{width}}  {first}"
        for line in more:
            yield f"  {'':{width}}  {line}"


def _foreign(data: bytes) -> str:
    """What is on a key of somebody else's: text, or bytes."""
    try:
        return printable(data.decode())
    except UnicodeDecodeError:
        return data[:SHOWN_BYTES].hex(" ")


def _matrix(payload: Mapping[str, Any]) -> tuple[str | None, tuple[int, ...]]:
    """The one list that the shape belongs to, if there is such a one."""
    shape = payload.get("shape")
    if not isinstance(shape, list) or len(shape) != 2 or not all(type(n) is int and 0 <= n <= 4096 for n in shape):
        return None, ()
    fitting = [name for name, v in payload.items() if _is_vector(v) and name != "shape" and len(v) == math.prod(shape)]
    return (fitting[-1], tuple(shape)) if fitting else (None, ())


def _is_vector(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(type(number) is float for number in value)


def _value(value: object) -> str:
    if isinstance(value, np.ndarray) or _is_vector(value):
        numbers = np.asarray(value)
        return np.array2string(numbers, precision=5, suppress_small=True, threshold=SHOWN_ELEMENTS, max_line_width=100)
    if value is None:
        return "none"
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, list) and all(type(item) in (int, str) for item in value):
        return printable(" ".join(map(str, value))) or "-"
    return json.dumps(finite(value))
