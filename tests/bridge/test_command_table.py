"""Command files: what is read, limited and refused before anything moves."""

import math

import numpy as np
import pytest

from bridge.driving.command_table import PERIOD, check_space, make_table, reach_of, read_commands
from bridge.manoeuvre import main, parse_arguments, prepare

pytestmark = pytest.mark.quick
LOW, HIGH, SLEW = (-0.5, -1.0), (1.0, 1.0), (1.0, 2.0)


def table(*rows, slew=SLEW):
    return make_table(np.array(rows, float), LOW, HIGH, slew)


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_begins_and_ends_in_standstill_and_changes_no_faster_than_the_slew_limits():
    made = table((0, 0.5, 0), (2, -0.5, 1.0), (4, 0, 0))
    assert np.all(made.v[:20] == 0) and np.all(made.v[-20:] == 0) and np.all(made.omega[-20:] == 0)
    assert np.abs(np.diff(made.v)).max() <= SLEW[0] * PERIOD + 1e-12
    assert np.abs(np.diff(made.omega)).max() <= SLEW[1] * PERIOD + 1e-12
    assert made.v.max() == pytest.approx(0.5) and made.v.min() == pytest.approx(-0.5)


def test_a_file_that_ends_in_motion_is_brought_to_a_stop():
    made = table((0, 1.0, 0), (3, 1.0, 0))
    assert made.v[-1] == 0 and made.v.max() == 1


def test_without_ramps_the_commands_come_at_their_times():
    made = table((0, 0, 0), (1, 0.4, 0), (2, 0, 0), slew=(math.inf, math.inf))
    assert made.at(1 + 0.95) == (0, 0) and made.at(1 + 1.02) == (0.4, 0) and made.at(1 + 2.02) == (0, 0)


def test_a_command_beyond_the_limits_is_refused_and_not_cut():
    with pytest.raises(ValueError, match=r"v 1.2 m/s is not within -0.5 to 1 m/s.*slower"):
        table((0, 1.2, 0), (1, 0, 0))
    with pytest.raises(ValueError, match="omega -2 rad/s"):
        table((0, 0, -2), (1, 0, 0))


@pytest.mark.parametrize(("text", "words"), [
    ("", "begins with nothing"),
    ("t,x,y\n0,0,0\n", "begins with t,x,y"),
    ("t,v,omega\n0,0,0\n", "a single row"),
    ("t,v,omega\n0,0,0\n1,nan,0\n", "line 3.*not three finite numbers"),
    ("t,v,omega\n0,0,0\n1,0\n", "line 3"),
    ("t,v,omega\n0,0,0\n0,0,0\n", "line 3: t goes from 0 to 0"),
    ("t,v,omega\n0,0,0\n1e5,0,0\n", "lasts at most"),
])
def test_an_unfit_file_is_refused_with_its_line(tmp_path, text, words):
    with pytest.raises(ValueError, match=words):
        read_commands(write(tmp_path / "a.csv", text))


def test_a_byte_order_mark_is_read_and_a_missing_file_named(tmp_path):
    assert len(read_commands(write(tmp_path / "a.csv", "\ufefft,v,omega\n0,0,0\n1,0.2,0\n"))) == 2
    with pytest.raises(ValueError, match="nowhere.csv"):
        read_commands(tmp_path / "nowhere.csv")


def test_reach_holds_the_path_of_a_vehicle_that_is_faster_or_slower():
    made = table((0, 0.5, 0), (4, 0, 0))
    reach = reach_of(made, radius=0.5, uncertainty=0.1)
    assert reach.ahead >= 2.0 * 1.1 + 0.5 and reach.ahead < 3.2
    assert reach.behind >= 0.5 and reach.left == pytest.approx(reach.right)
    left = reach_of(table((0, 0.5, 0.5), (6, 0, 0)), 0.5, 0.1)
    assert left.left > 2 * left.right


def test_the_place_to_start_leaves_the_vehicle_within_the_floor():
    reach = reach_of(table((0, 0.5, 0), (4, 0, 0)), radius=0.5, uncertainty=0.1)
    assert "facing along the floor's LENGTH" in check_space(reach, (5, 2))
    assert "facing along the floor's WIDTH" in check_space(reach, (2, 5))
    with pytest.raises(ValueError, match="needs a floor of .* 1 x 5 m are free"):
        check_space(reach, (1, 5))


def test_the_command_checks_without_ros_and_refuses_in_one_line(tmp_path, capsys):
    path = write(tmp_path / "a.csv", "t,v,omega\n0,0.5,0\n4,0,0\n")
    assert main([str(path), "--space", "6", "4", "--check"]) == 0
    assert "Put the drive axle" in capsys.readouterr().err
    assert main([str(path), "--space", "2", "2", "--check"]) == 2
    assert main([str(path), "--space", "6", "4", "--check", "--v-limits", "-0.2", "0.2"]) == 2
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.parametrize("words", [["--space", "0", "4"], ["--space", "nan", "4"], ["--repeat", "0"],
                                   ["--uncertainty", "1"], ["--slew", "0", "1"]])
def test_unfit_options_are_refused(words, capsys):
    with pytest.raises(SystemExit) as end:
        parse_arguments(["a.csv", "--space", "6", "4", *words])
    assert end.value.code == 2


def test_limits_of_the_base_hold_for_a_manoeuvre(tmp_path):
    path = write(tmp_path / "a.csv", "t,v,omega\n0,-0.6,0\n4,0,0\n")
    with pytest.raises(ValueError, match="v -0.6 m/s"):  # a WHILL reverses at 0.556 m/s at most
        prepare(parse_arguments([str(path), "--space", "9", "9"]))
    prepare(parse_arguments([str(path), "--space", "9", "9", "--base", "generic"]))
