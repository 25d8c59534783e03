"""What is made from recordings: a file with some of their messages, byte for byte, that says what it is."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from zfusion.errors import InputError, RecordingError, RunError
from zfusion.gaps import Gaps
from zfusion.recording import layout
from zfusion.recording.accounts import Accounts, to_state
from zfusion.recording.channels import Describe
from zfusion.recording.file import Record
from zfusion.recording.paths import PART, refuse_to_replace
from zfusion.recording.segment import SegmentWriter

OF_ITS_PLACE = (layout.IDENTITY, layout.SEGMENT, layout.PREVIOUS)
"""Facts of a file that tell its place among segments."""


class DerivedWriter:
    """A file that is being made from others. A context manager: without `finish` there is no file in the end.

    `facts`, `scenario_toml` and `design` are the originals'; `inputs` are files that must not be replaced. InputError
    if `output` is one of them; RecordingError if it cannot be made; RunError when writing fails.
    """

    def __init__(
        self,
        output: Path,
        inputs: Iterable[Path],
        facts: Mapping[str, str],
        scenario_toml: str,
        describe: Describe,
        design: bytes | None = None,
    ) -> None:
        refuse_to_replace(output, inputs)
        self.path = output
        self.accounts = Accounts()
        self._segment = SegmentWriter(
            output.with_name(output.name + PART), facts, scenario_toml, describe, design=design
        )
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            self._segment.open()
        except OSError as error:
            raise RecordingError(f"{output}: cannot be written: {error.strerror}") from error

    @property
    def messages(self) -> int:
        """Messages on it so far."""
        return self._segment.messages

    def add(self, record: Record) -> None:
        """Put a message there, as it is. InputError for one topic more than a file can name."""
        if not self._segment.takes(record.topic):
            raise InputError(f"{self.path}: more topics than a file can name, with {record.topic!r}")
        self.accounts.observe(record.topic, record.data)
        self._segment.add(record.topic, record.data, record.log_time_ns, record.publish_time_ns, record.sequence)

    def finish(
        self,
        kind: str,
        sources: Iterable[Path],
        note: str,
        account: Mapping[str, Any],
        *,
        statistics: Mapping[str, Gaps],
        closing: Mapping[str, str] | None = None,
        of: Mapping[str, str] | None = None,
    ) -> None:
        """Close the file, that is now there: what it is (recovered, merged, cut), what is not on it, what it is of."""
        names = json.dumps([path.name for path in sources])
        derived = {"kind": kind, "sources": names, "note": note, "account": json.dumps(account)} | dict(of or {})
        end = dict(closing or {"messages": str(self.messages)}) | {layout.IN_SEGMENT: str(self.messages)}
        with self._segment.claimed():
            self._segment.finish({layout.DERIVED: derived, layout.STATISTICS: to_state(statistics), layout.CLOSE: end})
            os.replace(self._segment.path, self.path)

    def __enter__(self) -> Self:
        try:
            self._segment.begin()
        except OSError as error:
            raise self._failed(error) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            raise self._failed(error) from error
        if error is not None:
            self._abandon()

    def _failed(self, error: OSError) -> RunError:
        self._abandon()
        return RunError(f"{self.path}: writing failed: {error.strerror}")

    def _abandon(self) -> None:
        self._segment.abandon()
        with suppress(OSError):
            self._segment.path.unlink()
