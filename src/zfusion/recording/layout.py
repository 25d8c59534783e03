"""What a zfusion recording is made of, beyond what MCAP says: the names and versions that writer and reader share.

Metadata  zfusion.recording   first record of the file: format, run, method, seed, versions, machine, clocks
Attachment scenario.toml      the scenario
Attachment design.npz         the design of its method, where that is designed off-line
Chunks                        one channel per Zenoh key; message data are the wire bytes
Metadata  zfusion.stats       at the close: the account of every topic
Metadata  zfusion.close       at the close: how the recording ended
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping

FORMAT = "1"
"""Version of this layout; a reader refuses every other."""

PROFILE = "zfusion"
MESSAGE_ENCODING = "msgpack"
SCHEMA_ENCODING = "jsonschema"

RECORDING = "zfusion.recording"
STATISTICS = "zfusion.stats"
CLOSE = "zfusion.close"

SCENARIO = "scenario.toml"
SCENARIO_TYPE = "application/toml"

DESIGN = "design.npz"
DESIGN_TYPE = "application/zip"

CHECKSUM = "checksum"


def sealed(facts: Mapping[str, str]) -> dict[str, str]:
    """`facts` and their checksum: MCAP guards its metadata only in files that were finished."""
    return {**facts, CHECKSUM: _checksum(facts)}


def is_intact(facts: Mapping[str, str]) -> bool:
    """Whether the checksum among the facts is theirs."""
    rest = {name: value for name, value in facts.items() if name != CHECKSUM}
    return facts.get(CHECKSUM) == _checksum(rest)


def _checksum(facts: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(facts.items())).encode()):08x}"
