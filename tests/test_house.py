"""The rules that the source keeps, checked: who may import whom and what, and what nobody may do."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "zfusion"

LAYERS = (
    ("errors",),
    ("model",),
    ("stages",),
    ("gaps", "used_sets"),
    ("methods",),
    ("node",),
    ("keys", "messages", "status"),
    ("recording",),
    ("links",),
    ("drivers",),
    ("swarm",),
    ("deploy",),
    ("doctor",),
    ("studies",),
    ("report",),
    ("cli",),
    ("__main__",),
)
"""From the bottom up: a module imports from its own layer and those below only."""

ONLY = {
    "zenoh": ("drivers/",),
    "mcap": ("recording/",),
    "msgpack": ("messages.py",),
    "matplotlib": ("report/figures/",),
    "jinja2": ("report/page.py",),
    "pyarrow": ("report/results.py", "studies/experiment/table.py"),
    "typer": ("cli.py", "cli/"),
    "yaml": ("deploy/yaml_file.py",),
    "prometheus_client": ("report/exporters.py",),
    "opentelemetry": ("report/exporters.py",),
    "psutil": ("swarm/watch.py",),
    "cryptography": ("deploy/authority.py",),
    "pydantic": ("deploy/hosts.py", "model/schema/", "model/scenario.py", "studies/experiment/spec.py"),
    "distributed": ("studies/experiment/engines.py",),
    "cvxpy": ("methods/convex.py",),
    "scipy": ("methods/convex.py",),
}
"""Packages, and the only places that import them."""

ZENOH_MODULES = {"inquiry", "key_source", "transport", "inbox", "presence", "recorder", "player", "observer"}

NO_CLOCK = ("model/", "methods/", "node.py", "used_sets.py", "messages.py", "stages.py", "keys.py", "gaps.py", "links/")


@cache
def modules() -> list[tuple[str, ast.Module]]:
    return [(path.relative_to(SOURCE).as_posix(), ast.parse(path.read_text())) for path in sorted(SOURCE.rglob("*.py"))]


@cache
def imported(tree: ast.Module) -> list[str]:
    return list(names_of(tree))


def names_of(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def layer(name: str) -> int:
    for rank, names in enumerate(LAYERS):
        if name in names:
            return rank
    pytest.fail(f"zfusion.{name} is in no layer: say in LAYERS where it belongs")


def test_imports_point_down() -> None:
    wrong = []
    for name, tree in modules():
        own = name.split("/")[0].removesuffix(".py")
        if own == "__init__":
            continue
        for module in imported(tree):
            parts = module.split(".")
            if parts[0] == "zfusion" and len(parts) > 1 and parts[1] != "__version__" and layer(parts[1]) > layer(own):
                wrong.append(f"{name} imports {module}")
    assert not wrong


@pytest.mark.parametrize("package", ONLY)
def test_packages_are_imported_where_they_belong(package: str) -> None:
    wrong = [
        name
        for name, tree in modules()
        if not name.startswith(ONLY[package]) and any(m.split(".")[0] == package for m in imported(tree))
    ]
    assert not wrong


def test_zenoh_is_the_live_drivers_business() -> None:
    wrong = [
        name
        for name, tree in modules()
        if any(m.split(".")[0] == "zenoh" for m in imported(tree)) and Path(name).stem not in ZENOH_MODULES
    ]
    assert not wrong


def test_nothing_prints() -> None:
    wrong = [
        f"{name}:{node.lineno}"
        for name, tree in modules()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]
    assert not wrong


def test_no_clock_and_no_chance_below_the_drivers() -> None:
    forbidden = {"time", "datetime", "random", "secrets", "socket", "threading", "asyncio"}
    allowed = {"model/schema/run.py": {"datetime"}}  # the epoch that a scenario may give is a date
    wrong = [
        f"{name} imports {module}"
        for name, tree in modules()
        if name.startswith(NO_CLOCK)
        for module in imported(tree)
        if module.split(".")[0] in forbidden - allowed.get(name, set())
    ]
    assert not wrong


def test_functions_fit_on_a_screen() -> None:
    too_long = [
        f"{name}:{node.lineno} {node.name}: {length} lines"
        for name, tree in modules()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and (length := (node.end_lineno or 0) - node.lineno + 1) > 70
    ]
    assert not too_long


def test_ci_runs_the_test_command_of_the_readme() -> None:
    root = SOURCE.parents[1]
    commands = [line for line in (root / ".ci" / "run").read_text().splitlines() if "pytest" in line]
    assert len(commands) == 1
    assert commands[0] in (root / "README.md").read_text()
