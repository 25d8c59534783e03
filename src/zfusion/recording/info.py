"""What a recording is, in one structured answer: the facts behind `zfusion info`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from zfusion import keys
from zfusion.errors import MessageError
from zfusion.gaps import Gaps
from zfusion.recording.accounts import Accounts
from zfusion.recording.layout import CHECKSUM
from zfusion.recording.provenance import PACKAGES
from zfusion.recording.reader import Recording


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a recording."""

    topic: str
    node: str | None
    """The sender, as text; None for the truth and for topics that are none of zfusion's."""
    stage: str | None
    """None for topics that are none of zfusion's."""
    messages: int
    gaps: Gaps


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """A recording: what run it is of, what is on it, what is missing, what made it."""

    path: str
    size_bytes: int
    complete: bool
    note: str
    """What is missing of a recording that was broken off; empty for a complete one."""
    run: str
    method: str
    seed: int | None
    start_ns: int
    """Arrival of the first message."""
    end_ns: int
    """Arrival of the last message."""
    messages: int
    lost: int
    """Messages that senders sent and the recording does not have, as far as its counters tell."""
    topics: tuple[TopicInfo, ...]
    versions: Mapping[str, str]
    facts: Mapping[str, str]
    """All else that is known of how it began: the machine, its clocks, what the recorder was told."""
    closing: Mapping[str, str]
    """The facts of how it ended."""
    files: tuple[str, ...]
    """Where it is: one file, or its segments."""
    derived: Mapping[str, str]
    """How it was recovered, merged or cut from others; empty if it was not."""

    @property
    def duration_ns(self) -> int:
        """From the first message's arrival to the last one's."""
        return self.end_ns - self.start_ns

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self) | {"duration_ns": self.duration_ns}


def info(recording: Recording) -> RecordingInfo:
    """What `recording` is.

    The accounts are the writer's own, that know what the senders said they had sent; of a recording that was broken
    off they are made anew from its messages, and know nothing of what came after the last.
    """
    accounts = recording.statistics
    if accounts is None:
        accounts = _count_gaps(recording)
    names = dict.fromkeys((*recording.topics, *accounts))
    topics = tuple(_topic_info(name, recording.topics.get(name, 0), accounts.get(name, Gaps())) for name in names)
    facts = recording.metadata
    versions = {name: facts[name] for name in ("python", *PACKAGES) if name in facts}
    shown = {*versions, "run", "method", "seed", CHECKSUM}
    return RecordingInfo(
        path=str(recording.path),
        size_bytes=recording.size_bytes,
        complete=recording.complete,
        note=recording.note,
        run=facts["run"],
        method=facts["method"],
        seed=int(facts["seed"]) if facts["seed"] else None,
        start_ns=recording.start_ns,
        end_ns=recording.end_ns,
        messages=recording.messages,
        lost=sum(topic.gaps.lost for topic in topics),
        topics=topics,
        versions=versions,
        facts={name: value for name, value in facts.items() if name not in shown},
        closing=dict(recording.closing),
        files=tuple(map(str, recording.files)),
        derived=dict(recording.derived),
    )


def _topic_info(topic: str, messages: int, gaps: Gaps) -> TopicInfo:
    try:
        key = keys.parse(topic)
    except MessageError:
        return TopicInfo(topic, None, None, messages, gaps)
    return TopicInfo(topic, key.node, key.stage, messages, gaps)


def _count_gaps(recording: Recording) -> dict[str, Gaps]:
    accounts = Accounts()
    for record in recording.records():
        accounts.observe(record.topic, record.data)
    return accounts.gaps()
