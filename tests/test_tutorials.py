"""The tutorials run as they are written: two in `make test`, all six in a row in `make test-long`."""

from __future__ import annotations

import importlib.util
import json
import os
import time
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks import tutorials
from benchmarks.tutorials import blocks, notebook_text, pages, run_page, workplace
from whill_mjx.effects import EFFECTS, unregister

QUICK = ("1_look_and_drive.md", "5_my_map_my_task.md")
"""Those that take the fewest seconds."""


def page_of(tmp_path, text):
    page = tmp_path / "page.md"
    page.write_text(text)
    return page


@pytest.mark.quick
def test_there_are_six_tutorials_and_each_has_code_and_a_picture():
    assert [page.name[0] for page in pages()] == list("123456")
    for page in pages():
        assert blocks(page) and "![" in page.read_text(), page.name


@pytest.mark.quick
def test_a_block_is_changed_in_tests_alone_and_only_by_a_text_that_it_has(tmp_path):
    text = "<!-- in tests: a 100 => a 4 -->\n<!-- in make test: left out -->\n```sh\nx --a 100\n```\n```text\nno\n```\n"
    [block] = blocks(page_of(tmp_path, text))
    assert (block.code, block.in_tests, block.quick, block.line) == ("x --a 100\n", "x --a 4\n", False, 4)
    with pytest.raises(ValueError, match="page.md, line 4: the block has no 'b'"):
        blocks(page_of(tmp_path, text.replace("tests: a", "tests: b").replace("b 100", "b")))


def wait_until_gone(pid):
    """Return when a process has ended; a zombie, which nobody has waited for, has."""
    with suppress(OSError):  # its file goes at any moment
        while Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z":
            time.sleep(0.01)


@pytest.mark.quick
def test_python_blocks_share_names_and_a_failing_one_is_named_by_page_and_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(page_of(tmp_path, "```python\na = 1\n```\n\n```python\nassert a == 1\n```\n"))
    with pytest.raises(RuntimeError, match="page.md, line 6: NameError"):
        run_page(page_of(tmp_path, "```python\na = 1\n```\n\n```python\nb\n```\n"))
    with pytest.raises(RuntimeError, match="page.md, line 2"):
        run_page(page_of(tmp_path, "```sh\nsleep 60 & echo $! > left\nfalse\ntrue\n```\n"))
    wait_until_gone(int((tmp_path / "left").read_text()))


@pytest.mark.quick
def test_a_notebooks_links_lead_from_its_place_to_the_files_of_the_repository():
    for page in pages():
        text = notebook_text(page)
        assert "<!--" not in text and "%cd ../.." in text
        for target in tutorials.re.findall(r"\]\((\.\./[^)#\s]+)", text):
            assert (tutorials.ROOT / "build" / "notebooks" / target).resolve().exists(), (page.name, target)


@pytest.mark.quick
@pytest.mark.skipif(not importlib.util.find_spec("jupytext"), reason="needs jupytext: pip install -e '.[docs]'")
def test_notebooks_have_the_code_of_the_pages(tmp_path):
    for page, path in zip(pages(), tutorials.write_notebooks(tmp_path), strict=True):
        cells = [cell["source"] for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        texts = ["".join(cell) for cell in cells]
        for block in blocks(page):
            [text] = [text for text in texts if block.code.strip() in text]
            assert text.startswith("%%") == (block.language == "sh")


@pytest.mark.quick
@pytest.mark.skipif(not importlib.util.find_spec("nbclient"), reason="needs nbclient: pip install -e '.[docs]'")
def test_a_cell_of_a_notebook_fails_with_any_of_its_lines(tmp_path):
    page = page_of(tmp_path, "# Page\n\n```sh\nfalse\ntrue\n```\n")
    with workplace(tmp_path), pytest.raises(RuntimeError, match="page.md as a notebook"):
        tutorials.run_notebook(page)


@pytest.mark.quick
def test_what_a_page_took_is_recorded_though_a_later_one_fails(tmp_path, monkeypatch):
    for name, line in (("1_first.md", "true"), ("2_second.md", "false")):
        (tmp_path / name).write_text(f"# Page\n\n```sh\n{line}\n```\n")
    recorded = {}
    monkeypatch.setattr(tutorials, "TUTORIALS", tmp_path)
    monkeypatch.setattr(tutorials, "write_figures", recorded.update)
    monkeypatch.setattr("sys.argv", ["tutorials", "run", "--record", "--out", str(tmp_path / "out")])
    with pytest.raises(RuntimeError, match=r"2_second.md, line 4"):
        tutorials.main()
    assert set(recorded) == {"tutorial_1_s", "tutorial_1_cpu_s"}


@pytest.mark.parametrize("name", QUICK)
def test_the_quick_tutorials_run(name, tmp_path):
    with workplace(tmp_path):
        run_page(tutorials.TUTORIALS / name, tests=True, quick=True)


def has_ros():
    return importlib.util.find_spec("rclpy") or os.environ.get("ROS_DISTRO")


@pytest.mark.long
@pytest.mark.parametrize("run", [run_page, tutorials.run_notebook])
def test_all_tutorials_run_in_a_row_as_pages_and_as_notebooks(run, tmp_path):
    if run is tutorials.run_notebook and not importlib.util.find_spec("nbclient"):
        pytest.skip("needs nbclient: pip install -e '.[docs]'")
    with workplace(tmp_path):
        for page in pages():
            if page.name.startswith("6") and not has_ros():
                pytest.skip("the sixth needs rclpy: pip install -e '.[ros]'")
            run(page, tests=True)
    assert list((tmp_path / "runs").glob("first/index.html"))


CODE_PAGES = [page for page in (tutorials.ROOT / "README.md", *sorted((tutorials.ROOT / "docs").rglob("*.md")))
              if page not in pages() and any(block.tested for block in blocks(page))]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("page", CODE_PAGES, ids=lambda page: page.name)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)  # as a program in this folder has it
    with workplace(tmp_path):
        map_block = blocks(tutorials.TUTORIALS / "5_my_map_my_task.md")[0]
        exec(map_block.code, {})  # the small map that pages use
        known = set(EFFECTS)
        try:
            run_page(page, tests=True)
        finally:  # what a page registers is not for other tests
            for name in set(EFFECTS) - known:
                unregister(name)
