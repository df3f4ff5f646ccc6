"""The programs in examples/ run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from whill_mjx.tasks.options import named_task

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SMALL = {"many_chairs.py": ["--count", "8", "--steps", "2"]}


def run_example(path, cwd):
    return subprocess.run(
        [sys.executable, str(path), *SMALL.get(path.name, [])], cwd=cwd, capture_output=True, text=True
    )


@pytest.mark.quick
def test_the_examples_page_lists_every_example():
    text = (ROOT / "examples" / "README.md").read_text()
    assert [path.name for path in EXAMPLES if f"`{path.name}`" not in text] == []


@pytest.mark.quick
def test_the_example_of_a_task_is_a_task_and_the_same_as_in_the_tutorial():
    task = named_task(f"{ROOT / 'examples' / 'parking.py'}:Parking")
    assert task.name == "parking"
    tutorial = (ROOT / "docs" / "tutorials" / "5_my_map_my_task.md").read_text()
    methods = (
        (ROOT / "examples" / "parking.py")
        .read_text()
        .partition("    def sample_world")[2]
        .partition("    def rewards")[0]
    )
    assert methods in tutorial


@pytest.mark.quick
def test_the_example_that_reads_a_log_prints_a_line_a_trial(tmp_path):
    done = run_example(ROOT / "examples" / "read_log.py", tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 9 and "circle_1" in done.stdout


@pytest.mark.long
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_runs(path, tmp_path):
    done = run_example(path, tmp_path)
    assert done.returncode == 0 and done.stdout, done.stderr
