"""Imports point one way, without circles; packages meet at their doors, and all may import `bridge.policy`."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from benchmarks.import_graph import circles, floors, import_graph

ROOT = Path(__file__).parent.parent
PACKAGES = ("whill_mjx", "sysid", "dreamer", "bridge")
ALLOWED = {"whill_mjx": set(), "sysid": {"whill_mjx"}, "dreamer": set(), "bridge": set()}
DOORS = {
    "whill_mjx/train.py": {"dreamer"},  # the training command
    "bridge/simulate.py": {"whill_mjx"},  # the simulator, or a robot file, behind the topics
}
ROOMS = {"whill_mjx/learning": {"dreamer"}}  # belongs to the first
FILES = {  # belong to the first, and to the second
    "whill_mjx/learning/vehicle_of_run.py": {"sysid"},
    "bridge/simulation/chair_simulator.py": {"whill_mjx"},
    "bridge/simulation/moved_simulator.py": {"whill_mjx"},
    "bridge/simulation/simulator_choice.py": {"whill_mjx", "sysid"},
}

READER = "bridge.policy"
"""The one reader of policy files, which all packages may import."""

pytestmark = pytest.mark.quick


def modules():
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


@cache
def imports(path):
    """The import statements of a module, anywhere in it."""
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported(path):
    """Dotted names that a module imports, anywhere in it."""
    for node in imports(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif node.module and not node.level:
            yield node.module


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path):
    relative = path.relative_to(ROOT)
    own = relative.parts[0]
    file = relative.as_posix()
    looking_up = {**DOORS, **FILES}.get(file, set()) | ROOMS.get(relative.parent.as_posix(), set())
    allowed = {own} | ALLOWED[own] | looking_up
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


def test_only_the_command_that_serves_them_imports_the_simulators():
    own = {name.removesuffix(".py").replace("/", ".") for name in FILES if name.startswith("bridge")}
    importers = {path.relative_to(ROOT).as_posix() for path in modules() if own & set(modules_used(path))}
    assert importers - set(FILES) == {"bridge/simulate.py"}


def test_commands_are_thin():
    written = {path: path.read_text() for package in PACKAGES for path in (ROOT / package).glob("*.py")}
    written.pop(ROOT / "dreamer/train.py")  # a function; as a command it says so
    commands = {path.name: text.count("\n") for path, text in written.items() if "if __name__ == " in text}
    assert len(commands) > 20 and not {name: lines for name, lines in commands.items() if lines >= 150}


def test_no_file_imports_itself_by_way_of_others():
    assert circles(import_graph(ROOT, (*PACKAGES, "benchmarks"))) == []


def test_sysid_has_nine_floors_at_most():
    """The longest chain of imports from a command down to what imports nothing of the package."""
    assert floors(import_graph(ROOT, ("sysid",)), "sysid") <= 9


def test_circles_and_floors_are_counted_in_functions_and_for_type_checking_too(tmp_path):
    package = tmp_path / "house"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "roof.py").write_text("from house import wall\n")
    (package / "wall.py").write_text("def build():\n    from house.floor import lay\n    return lay\n")
    (package / "floor.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from . import wall\n")
    graph = import_graph(tmp_path, ("house",))
    assert circles(graph) == [["house.floor", "house.wall"]] and floors(graph, "house") == 2


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_of_one_another_what_the_page_of_public_names_lists(package):
    page = (ROOT / "docs/api.md").read_text().partition("## Between the packages")[2]
    listed: set[str] = set()
    rooms: set[str] = set()
    for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE):
        names = re.findall(r"`([\w.]+)`", row)
        whole = [name for name in names if not name.startswith(".")]
        stem = whole[0].split(".")[0] if len(whole[0].split(".")) < 3 else whole[0].rpartition(".")[0]
        listed |= {*whole, *(stem + name for name in names if name.startswith("."))}
        rooms |= set(whole) if "and the files in it" in row else set()
    used = {name for path in modules() if path.relative_to(ROOT).parts[0] == package for name in modules_used(path)}
    others = {name for name in used if name.split(".")[0] in PACKAGES and name.split(".")[0] != package}
    assert {name for name in others if name.rpartition(".")[0] not in rooms} <= listed


def modules_used(path):
    """As `imported`, with the module itself where a package's module is imported by name."""
    for node in imports(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif node.module:
            for alias in node.names:
                inside = f"{node.module}.{alias.name}"
                yield inside if (ROOT / inside.replace(".", "/")).with_suffix(".py").exists() else node.module


@pytest.mark.parametrize("package", ["whill_mjx", "sysid", "dreamer"])
def test_public_names_can_be_imported_and_others_are_refused_by_name(package):
    door = importlib.import_module(package)
    assert 10 <= len(door.__all__) <= 21
    assert all(getattr(door, name) is not None and name in dir(door) for name in door.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = door.no_such_name


@pytest.mark.parametrize("package", PACKAGES)
def test_python_m_package_lists_its_commands(package):
    said = subprocess.run([sys.executable, "-m", package], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    listed = re.findall(rf"python -m ({package}\.\w+) +(\S.*)", said)
    files = [(path.with_suffix(".py"), path / "__main__.py") for name, _ in listed
             for path in [ROOT / name.replace(".", "/")]]
    assert all(module.exists() or package_.exists() for module, package_ in files)
    assert listed or package == "dreamer"
