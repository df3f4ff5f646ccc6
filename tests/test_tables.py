"""The page of figures says what the result files say."""

from __future__ import annotations

import json

import pytest

from benchmarks import tables
from benchmarks.claims import Claim
from benchmarks.claims.fits import _ladder
from benchmarks.harness import RESULTS, figure, record
from benchmarks.merge import merge
from benchmarks.tables import MARKS, headlines, page, put_between_marks, shown
from whill_mjx import __version__

pytestmark = pytest.mark.quick


HEAD, ROW = ("what", "median", "range"), ("a run", "{dt_s}", "{dt_s|range}")
TEST = Claim("Tests", "It runs", "camera", "Seconds.", HEAD, (ROW,))


def test_a_recorded_figure_appears_with_its_median_range_and_device(tmp_path, monkeypatch):
    record("camera", "it runs", {"dt_s": figure([0.5, 0.25, 4.0], "s", "test device")}, tmp_path)
    monkeypatch.setattr(tables, "CLAIMS", (TEST,))
    text = page(tmp_path)
    assert "### It runs\nSeconds." in text
    assert "| a run | 0.5 | 0.25 to 4 |" in text
    assert "test device" in text


def test_a_claim_without_figures_is_left_out(tmp_path, monkeypatch):
    record("camera", "it runs", {"other": figure([1.0], "s", "x")}, tmp_path)
    monkeypatch.setattr(tables, "CLAIMS", (TEST,))
    assert "It runs" not in page(tmp_path)


def test_a_note_written_by_hand_stands_below_the_tables_of_its_file(tmp_path, monkeypatch):
    record("camera", "it runs", {"dt_s": figure([1.0], "s", "x")}, tmp_path)
    monkeypatch.setattr(tables, "NOTES", tmp_path)
    monkeypatch.setattr(tables, "CLAIMS", (TEST,))
    assert "predicted" not in page(tmp_path)
    (tmp_path / "camera.md").write_text("| predicted | measured |\n")
    text = page(tmp_path)
    assert text.index("| a run | 1 |") < text.index("| predicted | measured |")


@pytest.mark.parametrize(
    ("form", "text"),
    [("", "0.986"), ("%", "98.6 %"), ("1e3", "986"), ("range %", "95.5 % to 99.5 %"), ("n", "3"), (".steps", "22,000")],
)
def test_a_cell_shows_a_figure_in_each_form(form, text):
    entry = {"value": 0.9857, "repeats": [0.955, 0.9857, 0.995], "steps": 22000}
    assert shown(entry, form) == text


def test_every_claim_and_headline_names_figures_that_were_recorded():
    figures = tables.Figures(RESULTS)
    for claim in tables.CLAIMS:
        content = figures.content(claim.stem)
        for row in claim.rows(content) if callable(claim.rows) else claim.rows:
            assert len(row) == len(claim.head), (claim.title, row)
            assert figures.fill(row[1], claim.stem) is not None or any(
                figures.fill(cell, claim.stem) for cell in row[1:]), (claim.title, row)
    for stem, what, value in tables.HEADLINES:
        assert figures.fill(value, stem), what


def test_the_ladder_has_a_row_for_each_rung_whatever_was_named():
    rungs = ("ideal", "base", "with_1_pose_delay", "with_2_supply_sag_quadratic_drag")
    rows = _ladder({"figures": {f"ladder_all_position_{rung}": {} for rung in rungs}})
    assert [row[0] for row in rows[:-1]] == [
        "ideal replay", "fitted base", "with `pose_delay`", "with `supply_sag`, `quadratic_drag`"]


def test_readme_has_at_most_ten_figures_and_both_pages_agree_with_the_result_files():
    assert len(tables.HEADLINES) <= 10
    for path, text in tables.pages().items():
        assert path.read_text() == text, f"{path}: run python -m benchmarks.tables."


def test_a_figure_of_another_release_is_marked_as_older(tmp_path, monkeypatch):
    lines = ("camera", "a run", "{dt_s} s"), ("camera", "a race", "{dt_s} s (others: {peer_s} s)")
    monkeypatch.setattr(tables, "HEADLINES", lines)
    figures = {name: figure([1.0], "s", "x") for name in ("dt_s", "peer_s")}
    path = record("camera", "it runs", figures, tmp_path)
    assert "| a run | 1 s | x |" in headlines(tmp_path) and "*" not in headlines(tmp_path)
    content = json.loads(path.read_text())
    content["figures"]["peer_s"]["release"] = "0.0.1"
    path.write_text(json.dumps(content))
    assert "| a run | 1 s | x |\n| a race | 1 s (others: 1* s) | x |\n\nFigures with *" in headlines(tmp_path)
    path.write_text(path.read_text().replace(f'"release": "{__version__}"', '"release": "0.0.1"'))
    assert "| a run | 1 s* | x |\n| a race | 1 s (others: 1 s)* | x |\n\nFigures with *" in headlines(tmp_path)


@pytest.mark.parametrize("arguments", [["--help"], ["--check"]])
def test_help_and_check_rewrite_nothing(arguments, monkeypatch):
    monkeypatch.setattr(tables, "write", lambda *_: pytest.fail("a page was written"))
    if arguments == ["--help"]:
        with pytest.raises(SystemExit, match="0"):
            tables.main(arguments)
    else:
        tables.main(arguments)


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
