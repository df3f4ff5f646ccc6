"""Imports point one way: sysid -> whill_mjx; dreamer and bridge stand alone; two doors and their parts look upwards.

All of them may import `bridge.policy`, the one reader of policy files.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("whill_mjx", "sysid", "dreamer", "bridge")
ALLOWED = {"whill_mjx": set(), "sysid": {"whill_mjx"}, "dreamer": set(), "bridge": set()}
DOORS = {
    "whill_mjx/train.py": {"dreamer", "sysid"},  # the training command
    "bridge/simulate.py": {"whill_mjx"},  # the simulator behind the topics
}
PARTS = {f"whill_mjx/{name}.py": {"dreamer"} for name in ("training", "inside", "prediction")}  # of the first

READER = "bridge.policy"
"""The one reader of policy files, which all packages may import."""

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
    allowed = {own} | ALLOWED[own] | (DOORS | PARTS).get(relative.as_posix(), set())
    names = {name for name in imported(path) if name != READER}
    outside = {name.split(".")[0] for name in names} & {*PACKAGES, "benchmarks", "tests"}
    assert outside <= allowed


def test_the_reader_of_policy_files_needs_only_numpy_and_onnxruntime():
    own = sorted((ROOT / "bridge" / "policy").glob("*.py"))
    names = {name for path in own for name in imported(path) if name != READER and not name.startswith(f"{READER}.")}
    assert {name.split(".")[0] for name in names} - sys.stdlib_module_names == {"numpy", "onnxruntime"}


def test_only_the_face_of_the_reader_is_imported_by_others():
    outside = {name for path in modules() if path.parent.name != "policy" for name in imported(path)}
    assert not [name for name in outside if name.startswith(f"{READER}.")]


def test_nothing_imports_the_doors():
    doors = {door.removesuffix(".py").replace("/", ".") for door in DOORS}
    importers = {path.name for path in modules() if doors & set(imported(path))}
    assert not importers
