"""Recordings of runs: MCAP files that hold every message as it was on the wire, and all that made them.

The only importers of mcap. `RecordingWriter` writes them, `Recording` reads them, finished or broken off,
in one file or several; `zfusion.recording.info` says what is on one, `zfusion.recording.export` takes the numbers out.
"""

from zfusion.gaps import GapCounter, Gaps
from zfusion.recording.keeping import Keeping
from zfusion.recording.provenance import arithmetic_differences
from zfusion.recording.reader import Record, Recording
from zfusion.recording.writer import RecordingWriter

__all__ = ["GapCounter", "Gaps", "Keeping", "Record", "Recording", "RecordingWriter", "arithmetic_differences"]
