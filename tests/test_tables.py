"""The page of figures says what the result files say."""

from __future__ import annotations

import json

import pytest

from benchmarks import tables
from benchmarks.harness import figure, record
from benchmarks.merge import merge
from benchmarks.tables import MARKS, page, put_between_marks

pytestmark = pytest.mark.quick


def test_a_recorded_figure_appears_on_the_page_with_its_median_and_device(tmp_path):
    record("physics", "it runs", {"dt_s": figure([0.5, 0.25, 4.0], "s", "test device")}, tmp_path)
    text = page(tmp_path)
    assert "| dt_s | 0.5 | s | 0.5, 0.25, 4 | test device |" in text


def test_a_note_written_by_hand_stands_below_its_table(tmp_path, monkeypatch):
    record("camera", "it runs", {"a": figure([1.0], "s", "x")}, tmp_path)
    monkeypatch.setattr(tables, "NOTES", tmp_path)
    assert "predicted" not in page(tmp_path)
    (tmp_path / "camera.md").write_text("| predicted | measured |\n")
    text = page(tmp_path)
    assert text.index("| a | 1 |") < text.index("| predicted | measured |")


def test_recording_keeps_figures_of_other_names_and_replaces_those_of_the_same(tmp_path):
    record("camera", "it runs", {"a": figure([1.0], "s", "x"), "b": figure([2.0], "s", "x")}, tmp_path)
    path = record("camera", "it runs", {"b": figure([3.0], "s", "x")}, tmp_path)
    figures = json.loads(path.read_text())["figures"]
    assert (figures["a"]["value"], figures["b"]["value"]) == (1.0, 3.0)


def test_recorded_commands_name_no_absolute_path(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["x", "--shared", str(tmp_path / "shared")])
    content = json.loads(record("camera", "it runs", {"a": figure([1.0], "s", "x")}, tmp_path).read_text())
    assert not any(word.startswith("/") for word in content["command"].split())


def test_headlines_replace_what_stands_between_the_marks_and_nothing_else():
    text = f"before\n{MARKS[0]}\nold\n{MARKS[1]}\nafter\n"
    assert put_between_marks(text, "new") == f"before\n{MARKS[0]}\nnew\n{MARKS[1]}\nafter\n"
    with pytest.raises(ValueError, match="put both lines"):
        put_between_marks("no marks", "new")


def test_a_merged_file_keeps_figures_that_the_other_machine_did_not_measure(tmp_path):
    (tmp_path / "here").mkdir()
    here = record("camera", "it runs", {"a": figure([1.0], "s", "x")}, tmp_path / "here")
    there = record("camera", "it runs", {"b": figure([2.0], "s", "y")}, tmp_path)
    merge(there, tmp_path / "here")
    assert set(json.loads(here.read_text())["figures"]) == {"a", "b"}
