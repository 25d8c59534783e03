"""A scenario with the data files that it names, made to be read in another place."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Collection
from pathlib import Path, PurePosixPath

from zfusion.errors import Problem, ScenarioError
from zfusion.model.scenario import Scenario
from zfusion.model.types import NodeId

DATA = "data"
"""The directory of the data files, beside the scenario."""

EACH = "{id}"
"""Stands for a sensor's id in the paths of sources."""


class Bundle:
    """The scenario as it is written to the hosts' folders, and what it needs there."""

    def __init__(self, scenario: Scenario) -> None:
        """What is the host's own business, where recordings go and who listens where, is left out."""
        document = tomllib.loads(scenario.to_toml())
        for table, names in {"recording": ("path", "directory"), "transport": ("endpoints", "base_port")}.items():
            kept = {name: value for name, value in document.get(table, {}).items() if name not in names}
            document.pop(table, None)
            document |= {table: kept} if kept else {}
        directory = scenario.absolute(".")
        self._original = Scenario.model_validate(document).with_paths(lambda path: str(directory / path))
        self._places: dict[str, str] = {}
        self._taken: set[str] = set()
        self.scenario = self._original.with_paths(self._place)

    def _place(self, path: str) -> str:
        """Where a file lies in a host's folder: of the same name, by which scenarios know their files."""
        if path not in self._places:
            given = PurePosixPath(path)
            several = (EACH,) if EACH in str(given.parent) else ()
            target = str(PurePosixPath(DATA, *several, given.name))
            number = 2
            while not self._taken.isdisjoint(self._of_each(target)):
                target = str(PurePosixPath(DATA, str(number), *several, given.name))
                number += 1
            self._places[path] = target
            self._taken |= self._of_each(target)
        return self._places[path]

    def _of_each(self, place: str) -> set[str]:
        """The files that a place stands for."""
        return {place.replace(EACH, str(i)) for i in self._original.ids}

    def write(self, directory: Path, nodes: Collection[NodeId]) -> list[str]:
        """Write the scenario and copy what these nodes need; the names of the files, relative to `directory`.

        ScenarioError where one of them is not there.
        """
        written = ["scenario.toml"]
        (directory / written[0]).write_text(self.scenario.to_toml())
        for source, target in sorted(self._needed(nodes)):
            path = directory / target
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                shutil.copyfile(source, path)
            except OSError as error:
                raise ScenarioError(
                    "scenario", [Problem("file", source, f"expected a file that can be copied: {error.strerror}")]
                ) from None
            written.append(target)
        return written

    def _needed(self, nodes: Collection[NodeId]) -> set[tuple[str, str]]:
        """(file, place) of what everybody reads, and of these nodes' own sources."""
        original = self._original
        needed = {(path, self._places[path]) for path in (*original.links.paths(), *original.method.paths())}
        sources = {i: sensor.source or original.source for sensor in original.sensors for i in sensor.members}
        for i in nodes:
            own = sources[i].paths()
            needed |= {(path.replace(EACH, str(i)), self._places[path].replace(EACH, str(i))) for path in own}
        return needed
