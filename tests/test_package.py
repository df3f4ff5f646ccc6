"""What an installation offers: console scripts, a version, and a source archive with what a developer needs."""

from __future__ import annotations

import ast
import configparser
import os
import re
import runpy
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

import whill_mjx
from whill_mjx.io.command_line import UNREAD, starts

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


@pytest.mark.parametrize("name", sorted(name for name in SCRIPTS if not name.startswith("bridge-")))
def test_each_console_script_listens_for_signals_before_its_slow_imports(name, monkeypatch):
    module = SCRIPTS[name].split(":")[0]
    path = ROOT / f"{module.replace('.', '/')}.py"
    statements = [ast.unparse(node) for node in ast.parse(path.read_text()).body]
    (place,) = (k for k, text in enumerate(statements) if text.startswith("if starts(__name__):\n    listen()"))
    slow = re.compile(r"(import|from) (?!__future__|whill_mjx\.io\.(command_line|heartbeat)\b)([a-z_]+)")
    before = {match[3] for text in statements[:place] if (match := slow.match(text))}
    assert before <= set(sys.stdlib_module_names)
    for argv, expected in (([f"/usr/bin/{name}"], True), (["pytest"], False), ([], False)):
        monkeypatch.setattr(sys, "argv", argv)
        assert starts(module) == expected
    assert starts("__main__")


@pytest.mark.parametrize("package", ["whill_mjx", "sysid", "dreamer", "bridge"])
def test_a_list_of_commands_that_nobody_reads_to_its_end_is_no_error(package):
    read, written = os.pipe()
    os.close(read)
    child = subprocess.run([sys.executable, "-m", package], cwd=ROOT, stdout=written, stderr=subprocess.PIPE, text=True)
    os.close(written)
    assert (child.returncode, child.stderr) == (UNREAD, "")


def test_a_signal_ends_a_console_script_that_still_imports(tmp_path):
    script = tmp_path / "sysid-fit"
    script.write_text("import sys\nfrom sysid.fit import cli\nsys.exit(cli())\n")  # as an installer writes it
    (tmp_path / "slow").mkdir()
    (tmp_path / "slow" / "jax.py").write_text("print('imports', flush=True)\nimport time\ntime.sleep(600)\n")
    path = os.pathsep.join([str(tmp_path / "slow"), os.environ["PYTHONPATH"]])
    child = subprocess.Popen([sys.executable, str(script), "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                             env={**os.environ, "PYTHONPATH": path}, text=True)  # fmt: skip
    assert child.stdout.readline() == "imports\n"  # it stays there until the signal, however late that comes
    child.send_signal(signal.SIGTERM)
    assert child.communicate()[1] == "stopped before the work began. (SIGTERM)\n" and child.returncode == 130


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


def test_every_place_that_names_the_version_names_the_same():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    setup = configparser.ConfigParser()
    setup.read(ROOT / "bridge" / "setup.cfg")
    package = re.search(r"<version>(.*?)</version>", (ROOT / "bridge" / "package.xml").read_text())
    readme = re.search(r"version\s*= \{(.*?)\}", (ROOT / "README.md").read_text())
    assert {str(citation["version"]), setup["metadata"]["version"], package[1], readme[1]} == {whill_mjx.__version__}
    assert re.fullmatch(r"\d+\.\d+\.\d+", whill_mjx.__version__)


def test_readme_and_citation_file_cite_the_same():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    readme = (ROOT / "README.md").read_text().partition("## Cite")[2]
    [paper] = citation["references"]
    wanted = [citation["title"], citation["authors"][0]["name"], paper["title"], paper["institution"]["name"],
              *(f"{one['given-names']} {one['family-names']}" for one in paper["authors"])]  # fmt: skip
    assert not [text for text in wanted if text not in readme]
    assert citation["cff-version"] == "1.2.0" and citation["license"] == PROJECT["project"]["license"]


def test_each_package_ships_its_type_information():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for package in ("whill_mjx", "sysid", "dreamer", "bridge"):
        assert (ROOT / package / "py.typed").read_text() == "" and "py.typed" in data[package]


def test_templates_of_issues_ask_for_what_is_needed():
    forms = [path for path in sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")) if path.stem != "config"]
    assert len(forms) == 3
    for path in forms:
        form = yaml.safe_load(path.read_text())
        assert form["name"] and form["description"]
        assert any(part.get("validations", {}).get("required") for part in form["body"])


def test_hooks_run_what_make_lint_runs():
    [local] = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    entries = [hook["entry"] for hook in local["hooks"]]
    lint = re.findall(r"\$\(BIN\)/python (-m (?:ruff|mypy) [^\n]*)", (ROOT / "Makefile").read_text())
    assert len(lint) == 2
    for line in lint:
        assert any(line.removesuffix(" .") in entry for entry in entries)


def test_the_image_is_built_of_files_that_exist():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    copied = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    assert {"pyproject.toml", "constraints.txt", "whill_mjx", "sysid", "dreamer", "bridge"} <= set(copied)
    assert all((ROOT / name).exists() for name in copied)


def test_pins_of_several_pythons_become_one_list():
    merged = runpy.run_path(str(ROOT / ".ci" / "constraints.py"))["merged"]
    text = merged({"3.12": {"a": "2", "b": "1", "c": "3"}, "3.11": {"a": "1", "b": "1"}, "3.13": {"a": "2", "b": "1",
                                                                                                "c": "3"}})  # fmt: skip
    assert text.splitlines()[1:] == ["a==1; python_version < '3.12'", "a==2; python_version >= '3.12'", "b==1", "c==3"]


def test_readme_of_a_release_leads_to_pictures_and_pages_from_anywhere():
    ready = runpy.run_path(str(ROOT / ".ci" / "index_readme.py"))
    url, readme = "https://a.b/c", (ROOT / "README.md").read_text()
    text = ready["absolute"](readme, url, "v1.2.3")
    assert f"]({url}/raw/v1.2.3/docs/images/drive.webp)" in text and f"]({url}/blob/v1.2.3/docs/fit.md)" in text
    assert not re.findall(r"\]\((?!https?://)[^)\s]+\)", text)
    project = tomllib.loads(ready["with_urls"]((ROOT / "pyproject.toml").read_text(), url))["project"]
    assert project["urls"]["Issues"] == f"{url}/issues"
    assert {**project, "urls": None} == {**PROJECT["project"], "urls": None}
