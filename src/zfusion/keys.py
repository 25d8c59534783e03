"""Key expressions: the only file that knows what zfusion's Zenoh keys look like.

zfusion/<run>/node/<id>/<stage>      what a node publishes: measurement, intermediate, estimate, event, ...
zfusion/<run>/truth                  the true state, where it is known
zfusion/<run>/node/<id>              liveliness token of a node
zfusion/<run>/recorder               liveliness token of the recorder
zfusion/<run>/node/<id>/status       queryable: how the node is doing
zfusion/<run>/node/<id>/history      queryable: the node's used sets

<run>     name of one execution of a scenario: NAME below
<id>      a node id of the scenario, an integer or a name, as text (a scenario maps text back to its ids)
<stage>   name of one exchange within a step (`zfusion.stages`)
"""

from __future__ import annotations

import re
from typing import NamedTuple

from zfusion.errors import InputError, MessageError
from zfusion.messages import Reason
from zfusion.model.types import NodeId
from zfusion.stages import TRUTH

ROOT = "zfusion"

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
"""Names of runs and nodes. They are parts of keys and of file names (hence the length, and no dot in front), and are
typed on command lines (hence no dash in front)."""

_STAGE = re.compile(rf"{ROOT}/([^/]+)/node/([^/]+)/([^/]+)")
_TRUTH = re.compile(rf"{ROOT}/([^/]+)/{TRUTH.name}")
_TOKEN = re.compile(rf"{ROOT}/([^/]+)/(?:node/([^/]+)|recorder)")


class Key(NamedTuple):
    """What a message's key says."""

    run: str
    node: str | None
    """The node's id as text; None for the truth, which no node publishes."""
    stage: str


class Token(NamedTuple):
    """What a liveliness token's key says."""

    run: str
    node: str | None
    """The node's id as text; None for the recorder."""


def check_run(run: str) -> str:
    """`run`, if it can be a run's name; InputError if not."""
    if not NAME.fullmatch(run):
        raise InputError(
            f"run name {run!r}: expected 1 to 100 letters, digits, '_', '-' or '.', not beginning with '-' or '.'"
        )
    return run


def stage_key(run: str, node: NodeId, stage: str) -> str:
    """Where `node` publishes its messages of `stage`."""
    return f"{ROOT}/{run}/node/{node}/{stage}"


def truth_key(run: str) -> str:
    """Where the true state is published."""
    return f"{ROOT}/{run}/{TRUTH.name}"


def status_key(run: str, node: NodeId) -> str:
    """Where `node` answers how it is doing."""
    return stage_key(run, node, "status")


def history_key(run: str, node: NodeId) -> str:
    """Where `node` answers what its used sets were."""
    return stage_key(run, node, "history")


def node_token(run: str, node: NodeId) -> str:
    """The liveliness token that says: `node` is there and has subscribed to its neighbours."""
    return f"{ROOT}/{run}/node/{node}"


def recorder_token(run: str) -> str:
    """The liveliness token that says: the recorder is there and has subscribed."""
    return f"{ROOT}/{run}/recorder"


def recorder_status_key(run: str) -> str:
    """Where the recorder answers what it has so far."""
    return f"{recorder_token(run)}/status"


def whole_run(run: str) -> str:
    """A key expression that every key of the run matches: messages and liveliness tokens alike."""
    return f"{ROOT}/{run}/**"


def expression(run: str, text: str) -> str:
    """The key expression that a person means: ``estimate`` (of all), ``1/estimate``, ``node/1/estimate``, ``truth``.

    What begins with ``zfusion/`` is one already; ``/`` before it says so of any other.
    """
    if text.startswith("/"):
        return text[1:]
    first, *more = text.split("/")
    if first == ROOT and more:
        return text
    if first in {"node", "recorder", TRUTH.name, "**"}:
        return f"{ROOT}/{run}/{text}"
    return f"{ROOT}/{run}/node/{text}" if more else stage_key(run, "*", text)


def parse(key: str) -> Key:
    """What a message's key says; MessageError if it is not one of zfusion's."""
    if match := _STAGE.fullmatch(key):
        run, node, stage = match.groups()
        return Key(run, node, stage)
    if match := _TRUTH.fullmatch(key):
        return Key(match[1], None, TRUTH.name)
    raise MessageError(Reason.UNKNOWN_KEY, f"{key!r} is no key of zfusion's")


def parse_token(key: str) -> Token:
    """What a liveliness token's key says; MessageError if it is not one of zfusion's."""
    if match := _TOKEN.fullmatch(key):
        return Token(match[1], match[2])
    raise MessageError(Reason.UNKNOWN_KEY, f"{key!r} is no liveliness token of zfusion's")
