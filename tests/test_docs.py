"""README, the pages of docs/ and the CHANGELOG: short sentences, plain words, links that lead somewhere."""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path

import pytest

from benchmarks.prose import sentences

pytestmark = pytest.mark.quick
ROOT = Path(__file__).parent.parent
FIGURES = ROOT / "benchmarks" / "README.md"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md")), FIGURES,
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


def test_every_page_of_docs_is_linked_from_readme():
    text = (ROOT / "README.md").read_text()
    missing = [page.name for page in sorted((ROOT / "docs").glob("*.md")) if f"docs/{page.name}" not in text]
    assert not missing, f"README.md links no {', '.join(missing)}."
