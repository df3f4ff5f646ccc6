"""The page of figures says what the result files say."""

from __future__ import annotations

import json

import pytest

from benchmarks.harness import figure, record
from benchmarks.tables import page

pytestmark = pytest.mark.quick


def test_a_recorded_figure_appears_on_the_page_with_its_median_and_device(tmp_path):
    record("physics", "it runs", {"dt_s": figure([0.5, 0.25, 4.0], "s", "test device")}, tmp_path)
    text = page(tmp_path)
    assert "| dt_s | 0.5 | s | 0.5, 0.25, 4 | test device |" in text


def test_recording_keeps_figures_of_other_names_and_replaces_those_of_the_same(tmp_path):
    record("camera", "it runs", {"a": figure([1.0], "s", "x"), "b": figure([2.0], "s", "x")}, tmp_path)
    path = record("camera", "it runs", {"b": figure([3.0], "s", "x")}, tmp_path)
    figures = json.loads(path.read_text())["figures"]
    assert (figures["a"]["value"], figures["b"]["value"]) == (1.0, 3.0)


def test_recorded_commands_name_no_absolute_path(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["x", "--shared", str(tmp_path / "shared")])
    content = json.loads(record("camera", "it runs", {"a": figure([1.0], "s", "x")}, tmp_path).read_text())
    assert not any(word.startswith("/") for word in content["command"].split())
