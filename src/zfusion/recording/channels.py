"""What a file says of its channels, and the table that says it again.

MCAP declares a channel once, in the block of messages that was being filled when it first appeared, and again at the
end of a file that was finished. One damaged block would leave all other messages of its channels without a topic.
So the writer repeats the declarations, outside the blocks, with a checksum of their own.
"""

from __future__ import annotations

import json
import zlib
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from mcap.records import Channel, Schema

from zfusion import keys
from zfusion.errors import MessageError
from zfusion.messages import VERSION, json_schema
from zfusion.recording import layout
from zfusion.stages import BUILT_IN, Stage


class Description(NamedTuple):
    """What a file says of a channel beside its topic."""

    encoding: str
    about: tuple[tuple[str, str], ...]
    schema_name: str
    schema_encoding: str
    schema: bytes


Describe = Callable[[str], Description]
"""The description of a topic's channel."""


def by_stages(stages: Iterable[Stage]) -> Describe:
    """Descriptions of zfusion's own topics: the schema of their stage; of one that allows any map, for all others.

    `stages` are those of the method beside the built-in ones.
    """
    known = {stage.name: stage for stage in (*BUILT_IN, *stages)}
    schemas = {name: json.dumps(json_schema(stage)).encode() for name, stage in known.items()}

    def describe(topic: str) -> Description:
        try:
            name = keys.parse(topic).stage
        except MessageError:
            name = ""
        about = (("encoding", "application/msgpack"), ("version", str(VERSION)), ("stage", name))
        schema = schemas.get(name, b'{"type": "object"}')
        title = _schema_name(name if name in known else "any")
        return Description(layout.MESSAGE_ENCODING, about, title, layout.SCHEMA_ENCODING, schema)

    return describe


def described(channel: Channel, schemas: Mapping[int, Schema]) -> Description:
    """What a file says of a channel; without its schema where that is not there."""
    schema = schemas.get(channel.schema_id, Schema(id=0, name="", encoding="", data=b""))
    about = tuple(channel.metadata.items())
    return Description(channel.message_encoding, about, schema.name, schema.encoding, schema.data)


class Table(NamedTuple):
    """What is told again."""

    channels: list[Channel]
    schemas: list[Schema]
    facts: dict[str, str]
    """Those of the file's beginning; empty where they are not repeated."""
    scenario_toml: str
    """Empty where it is not repeated."""


def to_metadata(table: Table) -> dict[str, str]:
    """A table as metadata: compressed, for it is on the file again and again."""
    rows = [[c.id, c.topic, c.message_encoding, c.schema_id, c.metadata] for c in table.channels]
    kinds = [[s.id, s.name, s.encoding, s.data.decode("latin-1")] for s in table.schemas]
    text = json.dumps([rows, kinds, table.facts, table.scenario_toml])
    return {"channels": str(len(rows)), "table": b64encode(zlib.compress(text.encode())).decode()}


def from_metadata(metadata: Mapping[str, str]) -> Table:
    """The table in metadata that are intact."""
    rows, kinds, facts, scenario_toml = json.loads(zlib.decompress(b64decode(metadata["table"])))
    channels = [
        Channel(id=i, topic=topic, message_encoding=encoding, schema_id=schema, metadata=about)
        for i, topic, encoding, schema, about in rows
    ]
    schemas = [Schema(id=i, name=name, encoding=e, data=data.encode("latin-1")) for i, name, e, data in kinds]
    return Table(channels, schemas, facts, scenario_toml)


def _schema_name(stage: str) -> str:
    """``zfusion.Intermediate`` for the stage `intermediate`."""
    return "zfusion." + "".join(word.capitalize() for word in stage.split("_"))
