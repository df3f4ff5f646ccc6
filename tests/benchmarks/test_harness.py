"""What results tell of the command that made them."""

from __future__ import annotations

import pytest

from benchmarks.harness import RESULTS, told

TREE = RESULTS.parent.parent


@pytest.mark.quick
@pytest.mark.parametrize(("word", "shown"), [
    (str(TREE / "runs" / "course" / "0"), "runs/course/0"),
    ("/somewhere/else/course/0", "0"),
    ("runs/course/0", "runs/course/0"),
    ("../shared", "../shared"),
    ("--device", "--device"),
    ("cpu, 1 core of the H200's host", "cpu, 1 core of the H200's host"),
])  # fmt: skip
def test_a_command_is_told_without_the_places_of_a_machine(word, shown):
    assert told(word) == shown
