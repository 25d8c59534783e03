"""A part of a recording: some steps, some nodes."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from zfusion import keys
from zfusion.errors import InputError, MessageError
from zfusion.messages import read_stamp
from zfusion.recording import layout
from zfusion.recording.derived import OF_ITS_PLACE, DerivedWriter
from zfusion.recording.merge import EVERY
from zfusion.recording.reader import Recording


@dataclass(frozen=True, slots=True)
class Cut:
    """What was taken."""

    output: str
    sources: tuple[str, ...]
    messages: int
    left_out: int
    """Messages of other steps and nodes."""
    without_step: int
    """Messages that say no step, left out where steps were chosen."""
    what: str
    """Steps and nodes, in words."""
    provable: str
    """What `replay --verify` can recompute of it, in words."""

    def as_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return asdict(self)


def cut(
    source: Path,
    output: Path,
    *,
    steps: range | None = None,
    nodes: Collection[str] | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> Cut:
    """Copy the messages of some steps and nodes, and the truth of these steps, to a recording of their own.

    `advance` is told how many more messages are done. InputError if there are no such messages, or `output` is the
    recording itself; otherwise as `Recording.open` and `DerivedWriter`.
    """
    with Recording.open(source) as recording:
        senders = {topic: _sender(topic) for topic in recording.topics}
        known = {node for node in senders.values() if node}
        nodes = None if nodes is None else set(nodes)
        if nodes is not None and (unknown := nodes - known):
            raise InputError(f"{source}: node {min(unknown) or repr('')}: expected some of {', '.join(sorted(known))}")
        wanted = {topic for topic, node in senders.items() if nodes is None or node in nodes or node == TRUTH}
        facts = {name: value for name, value in recording.metadata.items() if name not in OF_ITS_PLACE}
        without_step = 0
        of = recording.descriptions.__getitem__
        kept = recording.not_to_replace
        with DerivedWriter(output, kept, facts, recording.scenario_toml, of, recording.design) as writer:
            for done, record in enumerate(recording.records(wanted), 1):
                step = None if steps is None else _step(record.data)
                without_step += steps is not None and step is None
                if steps is None or step in steps:
                    writer.add(record)
                if done % EVERY == 0:
                    advance(EVERY)
            if not writer.messages:
                raise InputError(f"{source}: {_words(steps, nodes)}: there is nothing of these on it")
            told = Cut(
                output=str(output),
                sources=tuple(map(str, recording.files)),
                messages=writer.messages,
                left_out=recording.messages - writer.messages - without_step,
                without_step=without_step,
                what=_words(steps, nodes),
                provable=_provable(steps, nodes),
            )
            note = "; ".join(filter(None, (f"cut from {source.name}: {told.what}; {told.provable}", recording.note)))
            within = {
                topic: replace(gaps, lost_before=0, lost_after=0) for topic, gaps in writer.accounts.gaps().items()
            }
            whole = _whole(recording)
            writer.finish("cut", recording.files, note, told.as_dict(), statistics=within, of=whole)
    return told


def _whole(recording: Recording) -> dict[str, str]:
    """What says of which recording this is a part and how much that is, so that parts can be known to be all of it."""
    if not recording.complete or layout.IDENTITY not in recording.metadata:
        return {}
    return {layout.CUT_FROM: recording.metadata[layout.IDENTITY], layout.OF_MESSAGES: str(recording.messages)}


TRUTH = ""
"""Sends the truth."""


def _sender(topic: str) -> str | None:
    """The node, as text; None for topics that are none of zfusion's."""
    try:
        return keys.parse(topic).node or TRUTH
    except MessageError:
        return None


def _step(data: bytes) -> int | None:
    try:
        return read_stamp(data).step
    except MessageError:
        return None


def _words(steps: range | None, nodes: Collection[str] | None) -> str:
    of_steps = "all steps" if steps is None else f"steps {steps.start} to {steps.stop - 1}"
    if nodes is None:
        return f"{of_steps} of all nodes"
    listed = ", ".join(sorted(nodes, key=lambda node: (len(node), node)))
    return f"{of_steps} of {'node' if len(nodes) == 1 else 'nodes'} {listed}"


def _provable(steps: range | None, nodes: Collection[str] | None) -> str:
    if steps is not None and steps.start > 1:
        return f"estimates cannot be recomputed from it, for they rest on the steps before {steps.start}"
    if nodes is not None:
        return "only estimates of nodes all of whose neighbours are on it can be recomputed"
    return "its estimates can be recomputed"
