"""Imports point one way: sysid -> whill_mjx; dreamer and bridge stand alone; two doors and one room look upwards."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("whill_mjx", "sysid", "dreamer", "bridge")
ALLOWED = {"whill_mjx": set(), "sysid": {"whill_mjx"}, "dreamer": set(), "bridge": set()}
DOORS = {
    "whill_mjx/train.py": {"dreamer", "sysid"},  # the training command
    "bridge/simulate.py": {"whill_mjx"},  # the simulator behind the topics
}
ROOMS = {"whill_mjx/learning": {"dreamer"}}  # belongs to the first

pytestmark = pytest.mark.quick


def modules():
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imported(path):
    """Dotted names that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path):
    relative = path.relative_to(ROOT)
    own = relative.parts[0]
    looking_up = DOORS.get(relative.as_posix(), set()) | ROOMS.get(relative.parent.as_posix(), set())
    allowed = {own} | ALLOWED[own] | looking_up
    outside = {name.split(".")[0] for name in imported(path)} & {*PACKAGES, "benchmarks", "tests"}
    assert outside <= allowed


def test_nothing_imports_the_doors():
    doors = {door.removesuffix(".py").replace("/", ".") for door in DOORS}
    importers = {path.name for path in modules() if doors & set(imported(path))}
    assert not importers
