"""The loop over ROS 2: its stages, how it goes on, how it ends badly, and the whole of it at small size."""

import csv
import importlib.util
import json

import pytest

from benchmarks import loop, loop_figures, ros_domains
from benchmarks.loop import Loop, Options, main
from benchmarks.loop_figures import removed, summary
from benchmarks.loop_page import write_page
from whill_mjx.io.command_line import OptionError

TINY = {"manoeuvres": ("turn",), "seconds": 3.0, "days": 1, "replicates": 1}


def verdict(effect, members, before, after, floor):
    """A report of the closed loop, as far as the loop over ROS 2 reads it."""
    def errors(trajectory):
        return {"ground_truth": {"trajectory": trajectory, "noise_floor": {"trajectory": floor}}}

    return {"verdict": "named", "effects": [{"name": effect, "class": members}],
            "before": {"held_out": errors(before), "training": {}},
            "after": {"held_out": errors(after), "training": {}}}


def finished(folder, report):
    for name, content in (("answers.json", {"effects": {"gain_fade": 0.5}}), ("loop/report.json", report),
                          ("stages/loop.json", {"what": "named", "seconds": 3.0}), ("loop/report.html", "")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content))
    return folder


@pytest.mark.quick
def test_the_error_beyond_what_replicates_differ_by_is_what_a_loop_can_remove():
    assert removed(verdict("slope", ["slope"], 0.11, 0.03, 0.01)) == pytest.approx(0.8)
    assert removed(verdict("slope", ["slope"], 0.01, 0.01, 0.02)) is None


@pytest.mark.quick
def test_an_effect_is_named_by_its_class_or_by_what_covers_it(tmp_path):
    right = summary(finished(tmp_path / "a", verdict("slope", ["slope", "supply_sag"], 0.2, 0.1, 0.0)))
    wrong = summary(finished(tmp_path / "b", verdict("slope", ["slope"], 0.2, 0.1, 0.0)))
    assert right["loop"]["named"] and not wrong["loop"]["named"]


@pytest.mark.quick
def test_figures_of_several_runs_count_the_named_draws_and_keep_the_verdicts(tmp_path, monkeypatch):
    kept = {}
    monkeypatch.setattr(loop_figures, "record", lambda stem, claim, figures: kept.update(figures))
    right = finished(tmp_path / "a", verdict("supply_sag", ["supply_sag"], 0.11, 0.03, 0.01))
    wrong = finished(tmp_path / "b", verdict("slope", ["slope"], 0.11, 0.09, 0.01))
    main(Options(collect=(right, wrong)))
    assert kept["loop_named"]["value"] == 1 and kept["loop_named"]["named"] == [1.0, 0.0]
    assert kept["loop_heldout_removed"]["repeats"] == pytest.approx([0.8, 0.2])
    assert "loop_named_of_10" not in kept
    with pytest.raises(OptionError, match="has no verdict"):
        main(Options(collect=(tmp_path,)))


@pytest.mark.quick
def test_the_page_shows_the_verdict_the_truth_and_both_errors(tmp_path):
    out = finished(tmp_path, verdict("supply_sag", ["supply_sag"], 0.2, 0.05, 0.01))
    page = write_page(out, out / "loop", summary(out)).read_text()
    for word in ("gain_fade, size 0.5", "supply_sag", "0.2", "0.05", "75 %", "the first verdict"):
        assert word in page


def test_a_proposed_manoeuvre_is_driven_on_the_reference_days_too_and_the_second_verdict_gets_them(
        tmp_path, monkeypatch):
    """What a vehicle shows in a new manoeuvre is its model's form error too: without references that is an effect."""
    out, closed = tmp_path / "run", []
    main(Options(out, direct=True, until="days", **TINY))
    (out / "stages" / "fit.json").write_text(json.dumps({"what": "", "seconds": 0.0}))
    main(Options(out, direct=True, until="drives", **TINY))
    proposal = {"name": "prbs", "replicates": 2, "splits": ["slope", "wind"], "start": {"x": 0, "y": 0, "heading": 0}}
    report = {**verdict("slope", ["slope", "wind"], 0.2, 0.1, 0.0), "next_manoeuvre": proposal}
    (out / "loop").mkdir()
    (out / "loop" / "report.json").write_text(json.dumps(report))
    (out / "loop" / "next_command.csv").write_text("t,v,omega\n0,0.3,0.2\n0.5,-0.3,0\n1,0,0\n")
    monkeypatch.setattr(loop.Loop, "command", lambda self, stage, *words: closed.append((stage, *words)))
    (out / "loop_again").mkdir()
    (out / "loop_again" / "report.json").write_text(json.dumps(report))
    main(Options(out, direct=True, until="loop_again", **TINY))
    driven = {name: sorted(trial.name for trial in (out / name / "trials").iterdir())
              for name in ("drives", "drives_again", "day_1", "day_1_again")}
    assert driven == {"drives": ["turn_1"], "drives_again": ["proposed_1", "proposed_2", "turn_1"],
                      "day_1": ["turn_1"], "day_1_again": ["proposed_1", "turn_1"]}
    (again,) = [words for stage, *words in closed if stage == "loop_again"]
    assert again[1:4] == [out / "drives_again", "--reference", out / "day_1_again"]


def test_a_stage_that_fails_is_named_with_what_to_do(tmp_path):
    with pytest.raises(OSError, match=r"stage days: .*none.day_1 is missing.*give the same command again"):
        main(Options(tmp_path / "run", days_of=tmp_path / "none", **TINY))


@pytest.mark.quick
def test_two_loops_of_one_computer_do_not_hear_each_other(tmp_path, monkeypatch):
    monkeypatch.setattr(ros_domains.random, "randrange", lambda _: 6)
    one, other, asked = (Loop(Options(tmp_path / name, domain=domain))
                         for name, domain in (("one", None), ("other", None), ("asked", 42)))
    with one.hold_station("days") as first, other.hold_station("days") as second, asked.hold_station("days") as third:
        assert first.domain != second.domain and third.domain == 42
        with one.hold_station("drive") as next_stage:
            assert next_stage.domain not in (first.domain, second.domain)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed")
def test_a_day_is_driven_over_ros_recorded_exactly_and_not_driven_twice(tmp_path, capsys):
    options = Options(tmp_path / "run", until="days", **TINY)
    main(options)
    trial = tmp_path / "run" / "day_1" / "trials" / "turn_1"
    with open(trial / "odometry.csv", newline="") as file:
        times = [float(row["t"]) for row in csv.DictReader(file)]
    assert all(0.049 < b - a < 0.051 for a, b in zip(times, times[1:], strict=False)) and len(times) > 80
    with open(trial / "command.csv", newline="") as file:
        turns = [float(row["omega"]) for row in csv.DictReader(file)]
        file.seek(0)
        sent = [float(row["t"]) for row in csv.DictReader(file)]
    assert max(turns) > 0.6 and turns[0] == turns[-1] == 0
    assert sent[0] == 0 and all(0.0499 < b - a < 0.0501 for a, b in zip(sent, sent[1:], strict=False))
    before = trial.stat().st_mtime_ns
    main(options)
    assert trial.stat().st_mtime_ns == before and capsys.readouterr().out.count("days ...") == 1
    assert (tmp_path / "run" / "report.html").exists()
    main(Options(tmp_path / "direct", until="days", direct=True, **TINY))
    direct = (tmp_path / "direct/day_1/trials/turn_1/command.csv").read_text()
    assert (trial / "command.csv").read_text().startswith(direct)


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed")
def test_the_whole_loop_at_small_size_from_drives_to_a_policy_that_drives(tmp_path):
    out = tmp_path / "run"
    main(Options(out, draw=2, quick=True, preset="smoke", episodes=1))
    found = summary(out)
    assert (found.get("loop_again") or found["loop"])["verdict"] in ("named", "none", "unexplained")
    assert len(json.loads((out / "drive.json").read_text())["episodes"]) == 1
    assert "The policy on the plant" in (out / "report.html").read_text()
