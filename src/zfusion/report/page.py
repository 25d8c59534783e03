"""A report as one HTML file that needs nothing else: no script, no style sheet, no picture beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from zfusion.errors import InputError, RunError
from zfusion.recording.paths import written_whole
from zfusion.report.figures.style import Picture

TEMPLATE = "report.html.j2"

SHOWN_ROWS = 200
"""Rows of a table on a page; the files beside it have all."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of text; columns of `numbers` are set flush right."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    caption: str = ""

    @property
    def shown(self) -> Sequence[Sequence[str]]:
        """The rows that are on the page."""
        return self.rows[:SHOWN_ROWS]

    @property
    def left_out(self) -> int:
        """How many are not."""
        return max(0, len(self.rows) - SHOWN_ROWS)


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report: paragraphs, then tables, then pictures, then files word for word."""

    anchor: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    texts: Sequence[tuple[str, str]] = ()
    """(name, text) of files."""
    warnings: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class Page:
    """A whole report."""

    title: str
    summary: str
    """What it is of, in a sentence."""
    sections: Sequence[Section] = field(default_factory=tuple)

    @property
    def pictures(self) -> list[Picture]:
        """All pictures, in order."""
        return [picture for section in self.sections for picture in section.pictures]

    def render(self) -> str:
        """The page as HTML."""
        environment = Environment(
            loader=PackageLoader("zfusion.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
            lstrip_blocks=True,
        )  # fmt: skip
        environment.filters["inline"] = lambda picture: Markup(picture.inline())
        return environment.get_template(TEMPLATE).render(page=self, version=version("zfusion"))

    def write(self, path: Path) -> Path:
        """Write the page to a file, whole or not at all; its path.

        InputError if nothing can be written there, RunError if not all of it can.
        """
        text = self.render()
        _make(path.parent)
        with written_whole(path) as half:
            half.write_text(text, encoding="utf-8")
        return path


def save_pictures(page: Page, directory: Path) -> list[Path]:
    """Write all pictures of a page as SVG and PNG; their paths.

    InputError if there can be no such directory, RunError if not all of them can be written.
    """
    _make(directory)
    try:
        return [path for picture in page.pictures for path in picture.save(directory)]
    except OSError as error:
        raise RunError(f"{directory}: writing failed: {error.strerror}") from None


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from None
