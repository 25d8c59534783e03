"""What is installed: Python, the packages that zfusion needs, and its extras."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from zfusion.doctor.finding import Finding, Topic

TOPIC = Topic("versions")

OLDEST_PYTHON = (3, 11)

REQUIREMENT = re.compile(
    r"(?P<name>[A-Za-z0-9._-]+)(\[[^\]]*\])?(?P<bounds>[^;]*)(;.*extra == ['\"](?P<extra>\w+)['\"])?"
)
BOUND = re.compile(r"(>=|<)\s*([\d.]+)")

EXTRAS = {
    "design": "zfusion design of stationary and l2_linf",
    "experiments": "zfusion experiment, report and figures",
    "deploy": "certificates of zfusion deploy",
}
"""What they are for."""

Installed = Callable[[str], str]
"""A package's version; PackageNotFoundError."""


def check_versions(
    requirements: Iterable[str] | None = None,
    installed: Installed = version,
    python: tuple[int, ...] = sys.version_info[:3],
) -> Iterator[Finding]:
    """What zfusion itself needs, and then its extras; by default of what is installed here."""
    told = ".".join(map(str, python))
    if python < OLDEST_PYTHON:
        yield TOPIC.error(f"Python {told}", "zfusion needs 3.11 or newer", "install a newer Python")
    else:
        yield TOPIC.ok(f"zfusion {version('zfusion')}, Python {told}")
    found = [match for line in requirements or requires("zfusion") or () if (match := REQUIREMENT.match(line))]
    yield from _needed([match for match in found if match["extra"] is None], installed)
    for extra, purpose in EXTRAS.items():
        of_extra = [match for match in found if match["extra"] == extra]
        missing = [match["name"] for match in of_extra if _fault(match, installed)]
        if missing:
            why = f"only {purpose} need{'' if ' and ' in purpose else 's'} it"
            yield TOPIC.warning(
                f"extra {extra}: {', '.join(missing)} missing or too old", why, f"pip install 'zfusion[{extra}]'"
            )
        elif of_extra:
            yield TOPIC.ok(f"extra {extra}")


def _needed(found: list[re.Match[str]], installed: Installed) -> Iterator[Finding]:
    good = []
    for match in found:
        fault = _fault(match, installed)
        if fault is None:
            good.append(f"{match['name']} {installed(match['name'])}")
        else:
            remedy = f"pip install '{match['name']}{match['bounds'].strip()}'"
            yield TOPIC.error(f"{match['name']}: {fault}", "no process of zfusion starts, or works, without it", remedy)
    if good:
        yield TOPIC.ok(", ".join(good))


def _fault(match: re.Match[str], installed: Installed) -> str | None:
    """What is wrong with a package; None where nothing is."""
    try:
        found = installed(match["name"])
    except PackageNotFoundError:
        return "not installed"
    for sign, bound in BOUND.findall(match["bounds"]):
        if (_numbers(found) >= _numbers(bound)) != (sign == ">="):
            return f"version {found}, where {sign}{bound} is needed"
    return None


def _numbers(text: str) -> tuple[int, ...]:
    """The numbers that a version begins with."""
    begin = re.match(r"\d+(\.\d+)*", text)
    return tuple(map(int, begin[0].split("."))) if begin else ()
