"""What the tests of the reports share: pages taken apart, and an experiment's directory made by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from html.parser import HTMLParser
from itertools import product
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from simulations import four_sensor


class Page(HTMLParser):
    """A report, taken apart."""

    VOID = frozenset({"meta", "br", "img", "link", "hr"})

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.html = path.read_text(encoding="utf-8")
        self.ids: list[str] = []
        self.links: list[str] = []
        self.tags: list[str] = []
        self.cells: list[list[str]] = []
        self.words = ""
        self._open: list[str] = []
        self.feed(self.html)
        assert not self._open, "tags that are not closed"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.tags.append(tag)
        self.ids += [found["id"]] if found.get("id") else []
        self.links += [value for name in ("href", "src", "xlink:href") if (value := found.get(name))]
        if tag not in self.VOID:
            self._open.append(tag)
        if tag == "tr":
            self.cells.append([])
        if tag in ("td", "th"):
            self.cells[-1].append("")

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] in ("td", "th"):
            self.cells[-1][-1] += data
        if "style" not in self._open:
            self.words += data

    def check(self) -> None:
        """It needs nothing but itself, every link in it leads somewhere, and every figure is read to the reader."""
        assert len(self.ids) == len(set(self.ids))
        outside = [link for link in self.links if not link.startswith("data:image/png;base64,")]
        assert [link for link in outside if not (link[0] == "#" and link[1:] in self.ids)] == []
        assert not {"script", "link", "img", "iframe", "object"} & set(self.tags)
        assert not re.search(r"@import|url\((?!#)", self.html)
        assert self.tags.count("figure") == self.tags.count("figcaption") == self.tags.count("svg")
        captions = re.findall(r"<figcaption><b>Figure (\d+)\.[^<]+</b>([^<]+)</figcaption>", self.html)
        assert [int(number) for number, _ in captions] == list(range(1, self.tags.count("figure") + 1))
        assert all(len(reading.strip()) > 40 for _, reading in captions)

    def rows(self, *headings: str) -> list[list[str]]:
        """The rows of the table whose first headings are these, up to the next table's."""
        start = next(n for n, row in enumerate(self.cells) if tuple(row[: len(headings)]) == headings)
        width = len(self.cells[start])
        rows = []
        for row in self.cells[start + 1 :]:
            if len(row) != width:
                break
            rows.append(row)
        return rows


Labels = Mapping[str, Sequence[Any]]


def rmse_of(labels: Mapping[str, Any]) -> float:
    """An error that tells every point from every other."""
    number = sum(
        (n + 1) * (sum(map(ord, v)) % 7 if isinstance(v, str) else float(v)) for n, v in enumerate(labels.values())
    )
    return 0.5 + number / 10


def experiment(
    directory: Path,
    axes: Labels,
    *,
    seeds: int = 5,
    name: str = "made up",
    metrics: Sequence[str] | None = None,
    **more: Any,
) -> Path:
    """An experiment's directory, with numbers of our own; `more` replaces what its facts say."""
    directory.mkdir(parents=True)
    points = [dict(zip(axes, values, strict=True)) for values in product(*axes.values())]
    summary, series, scenario_toml = [], [], four_sensor().to_toml()
    for number, labels in enumerate(points):
        rmse, spread = rmse_of(labels), None if seeds == 1 else 0.05
        for metric, stage, mean in (
            ("rmse", "estimate", rmse),
            ("predicted_mse", "estimate", (0.9 * rmse) ** 2),
            ("bound_centralized", "estimate", 0.04),
            ("bound_local", "estimate", 25.0),
            ("excess_mse", "estimate", 0.01),
            ("nees", "estimate", 1.1),
            ("used_fraction", "measurement", 0.5),
            ("messages", "", 600.0),
            ("lost", "measurement", 3.0),
            ("lost", "intermediate", 4.0),
        ):
            ends = (None, None) if spread is None else (mean - spread, mean + spread)
            summary.append((number, *labels.values(), "all", "", stage, metric, mean, *ends, seeds))
        summary.append((number, *labels.values(), "all", "", "estimate", "nees_band", 1.0, 0.8, 1.2, seeds))
        for node in "1234":
            summary.append(
                (number, *labels.values(), node, "", "estimate", "rmse", rmse + int(node), None, None, seeds)
            )
        for step in range(1, 11):
            series.append(
                (number, *labels.values(), "all", "estimate", step, step * rmse, None, None, 0.9 * step, seeds)
            )
        scenario = directory / "scenarios" / f"{number}.toml"
        scenario.parent.mkdir(exist_ok=True)
        scenario.write_text(scenario_toml)
    head = ("point", *axes)
    summary = [row for row in summary if metrics is None or row[len(axes) + 4] in metrics]
    _write(
        directory / "summary.parquet", (*head, "node", "sender", "stage", "metric", "mean", "low", "high", "n"), summary
    )
    columns = (*head, "node", "stage", "step", "error_sq", "low", "high", "predicted", "n")
    _write(directory / "series_mean.parquet", columns, series)
    (directory / "experiment.toml").write_text('[experiment]\nscenario = "a <b> & c.toml"\n')
    facts = {
        "name": name,
        "description": "Numbers of our own.",
        "world": "simulated",
        "axes": [{"path": path, "labels": list(labels)} for path, labels in axes.items()],
        "seeds": list(range(1, seeds + 1)),
        "burn_in": 0,
        "confidence": 0.95,
        "points": [
            {"point": n, "labels": labels, "scenario": f"scenarios/{n}.toml", "steps": 30, "runs": [f"run{n}"]}
            for n, labels in enumerate(points)
        ],
        "runs": seeds * len(points),
        "failed": [],
        "made_on": {"zfusion": "0.1.0"},
    } | more
    (directory / "experiment.json").write_text(json.dumps(facts))
    return directory


def _write(path: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    pq.write_table(pa.table(dict(zip(columns, map(list, zip(*rows, strict=True)), strict=True))), path)
