"""What the loop's report says: title, sentences, and one drive before and after."""

from __future__ import annotations

import numpy as np
import pytest

from sysid.logs.manoeuvre_library import OWN
from sysid.pages.before_after import drive_pictures, drive_table, shown_drive
from sysid.pages.loop_words import MANOEUVRE_WORDS, lead, sentence, size, title, wrapped
from sysid.pages.series import Channel, TrialSeries

pytestmark = pytest.mark.quick


def parameter(value, low, high, unit="s", **more):
    return {"value": value, "interval": [low, high], "unit": unit, "open": [False, False], "was": None, "neutral": 0.0,
            **more}


def effect(name, parameters, alike=()):
    return {"name": name, "parameters": parameters, "class": [name, *alike],
            "equation": "A command acts `delay` after it is sent: u(t) = u_sent(t - delay)."}


DELAY = effect("command_delay", {"command_delay.delay": parameter(
    0.1523, 0.1131, 0.1902, description="time from sending a command to its effect")})


def report(*effects, verdict="named", **more):
    def part(trajectory, floor=0.014):
        return {"held_out": {"ground_truth": {"trajectory": trajectory, "noise_floor": {"trajectory": floor}}},
                "training": {}}
    return {"verdict": verdict, "effects": list(effects), "before": part(0.27), "refitted": part(0.15),
            "after": part(0.02), "known": True, "next_manoeuvre": None, "unnamed": None, "lives_in": [], **more}


def test_the_title_says_what_was_found_with_its_size_and_interval():
    assert title(report(DELAY)) == "Missing: command delay 0.152 s (0.113 to 0.190)"
    assert title(report(verdict="none")).startswith("Nothing is missing")
    assert title(report(verdict="unexplained")).startswith("Something is missing")


def test_drives_that_stand_alone_are_not_said_to_be_described_to_within_their_noise():
    errors = {"training": {"ground_truth": {"trajectory": 2.7}}, "held_out": {"ground_truth": {}, "odometry": {}}}
    alone = report(verdict="none", known=False) | dict.fromkeys(("before", "refitted", "after"), errors)
    assert title(alone) == "No known effect stands out in these drives"
    what, change, _ = lead(alone)
    assert "no drive was repeated" in what
    assert change.startswith("On the drives that were fitted") and "270.0 cm" in change


def test_another_floor_is_in_the_title_and_what_drives_elsewhere_is_not_said_to_be_as_on_other_days():
    floor = {"name": "another floor", "members": []}
    assert title(report(verdict="none", floor=floor)) == "Changed: another floor"
    assert "as on another floor" in lead(report(verdict="none", floor=floor))[0]
    assert title(report(DELAY, floor=floor)).endswith("(0.113 to 0.190); Changed: another floor")
    base = [{"name": "body.com_x", "reference": 0.0, "spread": 0.01, "before": 0.3, "away": 30.2},
            {"name": "torque_drive.kp", "reference": 1.0, "spread": 1.0, "before": 1.2, "away": 0.2}]
    assert "com x by 30 day-to-day spreads." in lead(report(verdict="none", base=base))[0]


def test_an_effect_that_was_there_before_has_changed():
    had = effect("command_delay", {"command_delay.delay": parameter(0.152, 0.113, 0.190, was=0.02)})
    assert title(report(had)) == "Missing: command delay 0.152 s (0.113 to 0.190)"  # no more than it is unsure by
    had = effect("command_delay", {"command_delay.delay": parameter(0.152, 0.113, 0.190, was=0.06)})
    assert title(report(had)) == "Changed: command delay 0.152 s (0.113 to 0.190), before 0.060"


def test_parts_of_an_effect_that_may_be_none_are_left_to_the_table():
    slope = effect("slope", {"slope.along_x": parameter(0.001, -0.002, 0.004, "rad"),
                             "slope.along_y": parameter(0.0356, 0.0317, 0.039, "rad")})
    assert title(report(slope)) == "Missing: slope, along y 2.04 degrees (1.82 to 2.23)"


def test_an_open_end_is_said():
    assert size(parameter(0.3, 0.22, 0.5, "m/s^2", open=[False, True])) == "above 0.22 m/s^2"
    assert size(parameter(0.3, 0.22, 0.5, "m/s^2", open=[True, False])) == "below 0.50 m/s^2"
    assert "do not show" in size(parameter(0.3, 0.22, 0.5, "m/s^2", open=[True, True]))


def test_three_sentences_say_what_it_is_what_it_changes_and_what_is_open():
    what, change, rest = lead(report(DELAY))
    assert what == "Command delay (time from sending a command to its effect) explains these drives."
    assert "27.0 cm for the vehicle as it was, 15.0 cm refitted within its day-to-day spread, 2.0 cm with" in change
    assert "two repeats of one drive differ by 1.4 cm" in change and "No other effect" in rest
    alike = effect("command_delay", DELAY["parameters"], ("sensor_delay", "clock_offset"))
    assert "could as well be sensor delay, clock offset" in lead(report(alike))[2]


def circle(error, name, held_out):
    t = np.linspace(0, 10, 500)
    path = np.column_stack([np.sin(t), 1 - np.cos(t), t])
    values = {"measured": path, "before": path + [error, 0, 0.1], "after": path + [error / 10, 0, 0.0]}
    return TrialSeries(name, held_out, (0.0, 0.0, 0.0), {"ground_truth": Channel(t, values)})


def test_the_drive_that_is_shown_is_held_out_and_the_one_of_median_error():
    drives = [circle(9.0, "training", False), *(circle(e, f"held_{e}", True) for e in (0.3, 0.1, 0.2))]
    shown = shown_drive(drives)
    assert shown["trial"] == "held_0.2" and len(shown["t"]) <= 240
    assert shown["errors"]["before"]["position"] == pytest.approx(0.2)
    assert shown["errors"]["after"]["yaw"] == pytest.approx(0.0)
    names = {"before": "the vehicle as it was", "after": "with the effect"}
    page = drive_pictures(shown, names) + drive_table(shown, names)
    assert page.count("<svg") == 3 and "20.00" in page and "held out" in page
    assert shown_drive([]) is None


def test_long_lines_are_folded_and_words_stay_whole():
    folded = wrapped("  lives in " + "somewhere " * 30, 60)
    assert max(map(len, folded.splitlines())) <= 60 and folded.splitlines()[1].startswith("    somewhere")


def test_every_manoeuvre_of_the_library_has_words_and_both_effects_are_named():
    assert MANOEUVRE_WORDS.keys() == OWN.keys()
    proposal = {"name": "prbs", "parameters": {"v": 0.6, "omega": 0.5}, "start": {"heading": 0.0}, "replicates": 1,
                "splits": ["side_force", "wind"], "expected_separation": 15.2, "file": "next_command.csv",
                "not_split": []}
    said = sentence(proposal)
    assert said.startswith(MANOEUVRE_WORDS["prbs"]) and "separates side force from wind by 15 standard" in said
