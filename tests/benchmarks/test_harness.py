"""What results tell of the command that made them."""

from __future__ import annotations

import json

import pytest

from benchmarks.harness import RESULTS, figure, portable, record
from benchmarks.merge import merge

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
    assert portable(word) == shown


@pytest.mark.quick
def test_a_run_with_other_figures_than_an_earlier_one_leaves_none_of_its_behind(tmp_path):
    def values(*names):
        return {name: figure([1.0], "m", "X") for name in names}

    record("x", "a claim", values("rung_1", "rung_2", "other"), tmp_path)
    path = record("x", "a claim", values("rung_1"), tmp_path, replacing="rung_")
    assert set(json.loads(path.read_text())["figures"]) == {"other", "rung_1"}


@pytest.mark.quick
def test_figures_of_another_machine_are_taken_unless_older_and_only_those_asked_for(tmp_path):
    def file(folder, **figures):
        folder.mkdir(exist_ok=True)
        path = folder / "x.json"
        path.write_text(json.dumps({"claim": "c", "figures": {
            name: {"value": value, "date": date} for name, (value, date) in figures.items()}}))
        return path

    def values(path):
        return {name: one["value"] for name, one in json.loads(path.read_text())["figures"].items()}

    here = file(tmp_path / "here", a=(1, "2026-01-02"), b=(1, "2026-01-02"), c=(1, "2026-01-02"))
    there = file(tmp_path / "there", a=(2, "2026-01-02"), b=(2, "2026-01-01"), d=(2, "2026-01-02"))
    assert merge(there, here.parent) == here
    assert values(here) == {"a": 2, "b": 1, "c": 1, "d": 2}
    there = file(tmp_path / "there", a=(3, "2026-01-03"), c=(3, "2026-01-03"))
    merge(there, here.parent, only=["c"])
    assert values(here) == {"a": 2, "b": 1, "c": 3, "d": 2}
    with pytest.raises(ValueError, match="no figure e; it has a, c"):
        merge(there, here.parent, only=["e"])


@pytest.mark.parametrize("figures", [{"a": 3}, {"a": {"unit": "s"}}, {"a": None}, []])
def test_what_is_no_result_file_is_not_merged(figures, tmp_path):
    source = tmp_path / "new" / "speed.json"
    source.parent.mkdir()
    source.write_text(json.dumps({"figures": figures}))
    with pytest.raises(ValueError, match=f"{source}: (figure 'a' has no value|has no figures)"):
        merge(source, tmp_path)
    assert not (tmp_path / "speed.json").exists()
