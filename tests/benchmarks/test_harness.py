"""What results tell of the command that made them."""

from __future__ import annotations

import json

import pytest

from benchmarks.harness import RESULTS, figure, record, told

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


@pytest.mark.quick
def test_a_run_with_other_figures_than_an_earlier_one_leaves_none_of_its_behind(tmp_path):
    def values(*names):
        return {name: figure([1.0], "m", "X") for name in names}

    record("x", "a claim", values("rung_1", "rung_2", "other"), tmp_path)
    path = record("x", "a claim", values("rung_1"), tmp_path, replacing="rung_")
    assert set(json.loads(path.read_text())["figures"]) == {"other", "rung_1"}
