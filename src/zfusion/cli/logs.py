"""Logs: for people on a terminal, one line each in a file, or JSON for programs; each record says run, node and step.

The form is told by ``--log-format`` or the environment variable ZFUSION_LOG, which the processes that a launcher starts
inherit.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.logging import RichHandler

from zfusion.model.types import NodeId

VARIABLE = "ZFUSION_LOG"

log = logging.getLogger("zfusion")


class LogFormat(StrEnum):
    """How log records are written."""

    TEXT = "text"
    JSON = "json"


class Context(logging.Filter):
    """Adds to every record what this process is about."""

    def __init__(self) -> None:
        super().__init__()
        self.run: str | None = None
        self.node: NodeId | None = None
        self.step: Callable[[], int | None] = lambda: None

    def filter(self, record: logging.LogRecord) -> bool:
        """Add it."""
        told = {"run": self.run, "node": self.node, "step": self.step()}
        record.context = {name: value for name, value in told.items() if value is not None}
        return True


_context = Context()


def about(run: str, node: NodeId | None = None, step: Callable[[], int | None] = lambda: None) -> None:
    """From now on log records say that they are about this run and node, and the step that it is at."""
    _context.run, _context.node, _context.step = run, node, step


def configure(form: LogFormat, console: Console, *, verbose: bool) -> None:
    """Have log records written to the console, in that form; processes that are started inherit it."""
    os.environ[VARIABLE] = form.value
    handler: logging.Handler
    if form is LogFormat.JSON:
        handler = logging.StreamHandler()
        handler.setFormatter(JsonFormatter())
        sys.excepthook = _log_exception
    elif console.is_terminal:
        handler = RichHandler(console=console, show_path=False, markup=False)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(LineFormatter())
    handler.addFilter(_context)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler])


def as_json() -> bool:
    """Whether logs are for programs."""
    return os.environ.get(VARIABLE) == LogFormat.JSON


class LineFormatter(logging.Formatter):
    """A line: time, level, run, node, step, what happened."""

    def format(self, record: logging.LogRecord) -> str:
        """The line; below it where a failure came from."""
        where = "".join(f" {name}={value}" for name, value in _context_of(record).items())
        line = f"{_time(record)} {record.levelname}{where}: {record.getMessage()}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


class JsonFormatter(logging.Formatter):
    """A JSON object: time, level, logger, message, and run, node, step where there are such; exception."""

    def format(self, record: logging.LogRecord) -> str:
        """The object, on one line."""
        told: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_context_of(record),
        }
        if record.exc_info:
            told["exception"] = self.formatException(record.exc_info)
        return json.dumps(told)


def _context_of(record: logging.LogRecord) -> dict[str, Any]:
    context: dict[str, Any] = getattr(record, "context", {})
    return context


def _time(record: logging.LogRecord) -> str:
    return datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _log_exception(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    log.critical("%s: %s", kind.__name__, error, exc_info=(kind, error, trace))
