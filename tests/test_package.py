"""What an installation offers: console scripts, a version, and a source archive with what a developer needs."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

import whill_mjx

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SCRIPTS = PROJECT["project"]["scripts"]


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_each_console_script_starts_a_function_of_a_module_that_python_m_runs_too(name):
    module, function = SCRIPTS[name].split(":")
    tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text())
    defined = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert function in defined
    needed = len(defined[function].args.args) - len(defined[function].args.defaults)
    assert needed == 0, f"{SCRIPTS[name]} is called without arguments."
    started = [node for node in tree.body if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)]
    assert any(f"{function}()" in ast.unparse(node) for node in started)  # another may listen before the slow imports


def test_every_command_that_readme_shows_has_a_console_script():
    text = (ROOT / "README.md").read_text()
    started = {target.split(":")[0] for target in SCRIPTS.values()}
    shown = set(re.findall(r"python -m ((?:sysid|whill_mjx|bridge)\.\w+)", text))
    assert shown and shown <= started


def test_the_version_is_that_of_the_changelog():
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "whill_mjx.__version__"}
    newest = next(line for line in (ROOT / "CHANGELOG.md").read_text().splitlines() if line.startswith("## "))
    assert newest.split()[1] == whill_mjx.__version__


@pytest.mark.parametrize("needed", ["constraints.txt", "CHANGELOG.md", "Makefile", "docs", "tests", "benchmarks"])
def test_the_source_archive_holds_what_a_developer_needs(needed):
    lines = (ROOT / "MANIFEST.in").read_text().splitlines()
    taken = {word for line in lines if line.startswith(("include", "graft")) for word in line.split()[1:]}
    assert needed in taken and (ROOT / needed).exists()
