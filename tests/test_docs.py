"""README, the pages of docs/ and the CHANGELOG: short sentences, plain words, links that lead somewhere."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.prose import sentences

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parent.parent
FIGURES = ROOT / "benchmarks" / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS, FIGURES,
         ROOT / "benchmarks" / "plant" / "README.md"]  # fmt: skip
MOST_WORDS = 35
"""Of a sentence."""


def anchors(text: str) -> set[str]:
    """Names by which the headings of a page can be linked."""
    headings = re.findall(r"^#+ +(.*)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_sentences_are_counted_without_code_and_tables():
    text = "# A title\n\nOne two; three `four five` six. Seven\neight\n\n| a | table |\n\n    code here\n\n- an item\n"
    assert sentences(text) == ["A title", "One two;", "three code six.", "Seven eight", "an item"]


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_no_sentence_is_longer_than_35_words(page):
    long = [sentence for sentence in sentences(page.read_text()) if len(sentence.split()) > MOST_WORDS]
    assert not long, f"{page.name}: {len(long)} sentences of more than {MOST_WORDS} words. Split them: {long[0]!r}"


@pytest.mark.parametrize("page", DOCS, ids=str)
def test_a_page_begins_with_a_sentence_and_not_with_code(page):
    """Or with a table, which a glossary is."""
    _, *blocks = [block for block in page.read_text().split("\n\n") if not block.startswith("<!--")]
    assert not blocks[0].startswith(("```", "![")), f"{page.name}: say first what the page is for."


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_between_pages_lead_somewhere(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        linked = page.parent / name if name else page
        assert linked.exists(), f"{page.name}: {target} does not exist."
        if anchor:
            assert anchor in anchors(linked.read_text()), f"{page.name}: {target} has no such heading."


@pytest.mark.parametrize("page", ["reliability.md", "reliability_files.md"])
def test_every_promise_names_tests_that_exist(page):
    files = {path.name: path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}
    tests = set(re.findall(r"^def test_(\w+)", "\n".join(files.values()), re.MULTILINE))
    text = (ROOT / "docs" / page).read_text()
    named = set(re.findall(r"`(?:test_)?([a-z]+(?:_[a-z0-9]+){4,})`", text))
    assert len(named) > 10 and not named - tests
    assert not set(re.findall(r"`(?:[\w/]+/)?(test_\w+\.py)`", text)) - set(files)


def test_pages_identify_and_report_instead_of_telling():
    count = sum(len(re.findall(r"\b(?:tell|tells|told|telling)\b", page.read_text(), re.IGNORECASE)) for page in PAGES)
    assert count <= 10


def test_readme_fits_150_lines_the_changes_80_and_the_page_of_figures_60_kB():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
    assert len((ROOT / "CHANGELOG.md").read_text().splitlines()) <= 80
    assert FIGURES.stat().st_size <= 60_000


def test_readme_moves_and_cites_the_reference_paper():
    text = (ROOT / "README.md").read_text()
    assert "docs/images/drive.webp" in text and (ROOT / "docs" / "images" / "drive.webp").stat().st_size < 2_000_000
    assert "Sim-to-Real Aware End-to-End Learning Environment for Micromobility" in text
    assert "sysid/data/chair" in text


OURS = r"(?:whill_mjx|sysid|dreamer|bridge|benchmarks)"


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_commands_that_a_page_shows_can_be_started(page):
    for module in set(re.findall(rf"python -m ({OURS}(?:\.\w+)*)", page.read_text())):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), f"{page.name}: python -m {module}"


@pytest.mark.long
def test_commands_that_pages_show_are_taken_by_their_parsers():
    script = ROOT / "tests" / "parse_commands.py"
    pages = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "examples" / "README.md"]
    done = subprocess.run([sys.executable, str(script), *map(str, pages)], cwd=ROOT, capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
    *refused, count = done.stdout.splitlines()
    assert done.returncode == 0 and not refused and int(count.split()[0]) > 100, done.stdout + done.stderr


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_names_that_a_page_imports_exist(page):
    for module, names in re.findall(rf"^ *from ({OURS}[\w.]*) import ([\w, ]+)", page.read_text(), re.MULTILINE):
        found = importlib.import_module(module)
        for name in names.split(","):
            assert hasattr(found, name.strip()) or importlib.util.find_spec(f"{module}.{name.strip()}"), (
                f"{page.name}: from {module} import {name.strip()}")


@pytest.mark.parametrize("package", ["whill_mjx", "sysid", "dreamer"])
def test_every_public_name_is_on_the_page_of_public_names(package):
    text = (ROOT / "docs" / "api.md").read_text().partition(f"## `{package}`")[2].partition("\n## ")[0]
    missing = [name for name in importlib.import_module(package).__all__ if f"`{name}`" not in text]
    assert not missing, f"docs/api.md lacks {', '.join(missing)} of {package}."


def links(page: Path) -> set[Path]:
    """Files of the repository to which a page links."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    targets = (target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in target)
    return {(page.parent / target).resolve() for target in targets if target}


def test_every_page_of_docs_is_at_most_two_links_away_from_readme():
    first = links(ROOT / "README.md")
    reached = first.union(*(links(page) for page in first if page.suffix == ".md"))
    missing = [str(page.relative_to(ROOT)) for page in DOCS if page not in reached]
    assert not missing, f"No page that README.md links to leads to {', '.join(missing)}."


def test_every_page_of_docs_is_in_the_sites_navigation_and_no_other():
    text = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    named = set(re.findall(r"[\w/]+\.md", text))
    pages = {str(page.relative_to(ROOT / "docs")) for page in DOCS}
    made = {"figures.md", "plant.md", "changes.md",
            "api/whill_mjx.md", "api/sysid.md", "api/dreamer.md", "api/bridge.md"}  # fmt: skip
    assert pages <= named, f"Add to nav in mkdocs.yml: {', '.join(sorted(pages - named))}."
    assert named <= pages | made, f"mkdocs.yml names what is not there: {', '.join(sorted(named - pages - made))}."


def test_nine_of_ten_pages_of_docs_have_a_picture_or_a_diagram():
    shown = re.compile(r"!\[|^```mermaid", re.MULTILINE)
    without = [str(page.relative_to(ROOT)) for page in DOCS if not shown.search(page.read_text())]
    assert len(without) <= 0.1 * len(DOCS), f"{len(without)} of {len(DOCS)} pages have none: {', '.join(without)}."


@pytest.mark.parametrize("picture", sorted((ROOT / "docs" / "images").glob("[!.]*")), ids=lambda path: path.name)
def test_a_picture_is_small_and_used(picture):
    limit = 2_000_000 if picture.suffix == ".webp" else 450_000
    assert picture.stat().st_size <= limit, f"{picture.name} has {picture.stat().st_size} bytes; at most {limit}."
    assert any(f"images/{picture.name}" in page.read_text() for page in PAGES), f"no page shows {picture.name}."


def test_pages_that_are_made_are_up_to_date():
    from benchmarks import command_page, task_pages

    assert command_page.PAGE.read_text() == command_page.page(), "write it again: python -m benchmarks.command_page"
    for name in task_pages.names():
        page = ROOT / "docs" / "reference" / "tasks" / f"{name}.md"
        assert page.exists() and page.read_text() == task_pages.page(name), (
            f"{page.name}: write it again: python -m benchmarks.task_pages page. "
            f"A new task also needs its picture (... picture --tasks {name}) and a line in mkdocs.yml and index.md.")


def test_each_command_says_what_it_does_by_a_verb():
    from benchmarks import command_page

    said = re.findall(r"^\| \[`python -m .*\| (\w+) ", command_page.page(), re.MULTILINE)
    assert len(said) > 20 and not [word for word in said if word in ("A", "An", "The") or word.endswith("s")]


def test_links_of_the_repository_become_links_of_the_site():
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "site_hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    assert hooks.site_link("../benchmarks/README.md#fits", "docs/fit.md", "fit.md") == "figures.md#fits"
    assert hooks.site_link("../../CHANGELOG.md", "docs/howto/gpus.md", "howto/gpus.md") == "../changes.md"
    assert hooks.site_link("../docs/fit.md", "benchmarks/README.md", "figures.md") == "fit.md"
    assert hooks.site_link("../whill_mjx/env.py", "docs/fit.md", "fit.md") is None  # code is not on the site
    assert hooks.site_link("https://a.b/c", "docs/fit.md", "fit.md") == "https://a.b/c"


@pytest.mark.long
@pytest.mark.skipif(not importlib.util.find_spec("mkdocs"), reason="needs MkDocs: pip install -e '.[docs]'")
def test_the_site_is_built_without_a_warning(tmp_path):
    """Every link, anchor and picture is checked by MkDocs too, and every public name has its docstring."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "site" / "api" / "whill_mjx.html").read_text()
    assert "make_batch" in text and "Args" not in (tmp_path / "site" / "index.html").read_text()


def test_the_first_hour_is_timed_with_the_commands_of_readme():
    from benchmarks.first_hour import PARTS

    readme = re.sub(r" *#.*", "", (ROOT / "README.md").read_text())
    assert all(line in readme.splitlines() for lines in PARTS.values() for line in lines)
