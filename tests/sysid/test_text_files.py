"""CSV and TUM files of any columns into a dataset, and inputs that are measured wheel speeds."""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import sysid
from bridge.driving.whill import ChairState, WheelOdometry
from sysid.logs.bags.messages import chair_odometry, chair_row, joint_row, joint_twist
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.log import load_log
from sysid.logs.planar import integrate_speeds
from sysid.logs.records import Command, with_timeout
from sysid.logs.tables.columns import Table
from sysid.logs.tables.guess import guess
from sysid.logs.tables.text_table import read_table
from sysid.replay.wheel_model import wheel_model
from sysid.search.fitting import check_settings
from sysid.search.settings import FitConfig
from whill_mjx.io.fields import DATASET
from whill_mjx.vehicle.presets import preset_params
from whill_mjx.vehicle.vehicle_file import save_vehicle

pytestmark = pytest.mark.quick
CHAIR = {trial.name: trial for trial in load_log(Path(sysid.__file__).parent / "data" / "chair").trials}
DRIVE = CHAIR["random_1"]
NAMES = {"t": "t", "cv": "cmd_v", "cw": "cmd_omega", "x": "odom_x", "y": "odom_y", "yaw": "odom_yaw", "v": "odom_v",
         "w": "odom_omega"}  # fmt: skip
T0 = 1.7e9  # s, Unix time


def columns(trial=DRIVE):
    """Columns of a drive on one clock: time, commands, odometry and outside pose."""
    o, g, c = trial.odometry, trial.ground_truth, trial.command
    held = np.searchsorted(c.t, o.t + 1e-9, side="right") - 1
    return {"t": o.t, "cv": c.v[held], "cw": c.omega[held], "x": o.x, "y": o.y, "yaw": o.yaw, "v": o.v, "w": o.omega,
            "gx": np.interp(o.t, g.t, g.x), "gy": np.interp(o.t, g.t, g.y), "gyaw": np.interp(o.t, g.t, g.yaw)}


def write(path, table, separator=",", header=True, comma=False, digits=6):
    """Write columns by name; comma: as the decimal point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [separator.join(f"{one:.{digits}f}" for one in row) for row in zip(*table.values(), strict=True)]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    path.write_text("\n".join([separator.join(table)] * header + rows) + "\n")
    return path


def quaternion(yaw):
    return {"qx": 0 * yaw, "qy": 0 * yaw, "qz": np.sin(yaw / 2), "qw": np.cos(yaw / 2)}


def check(trial, pose=True):
    """The trial is the drive that was written."""
    np.testing.assert_allclose(trial.odometry.v, DRIVE.odometry.v, atol=1e-3)
    np.testing.assert_allclose(trial.odometry.omega, DRIVE.odometry.omega, atol=1e-3)
    held = np.searchsorted(trial.command.t, 10.0, side="right") - 1
    assert trial.command.v[held] == pytest.approx(DRIVE.command.v[100], abs=1e-3)
    if pose:
        np.testing.assert_allclose(trial.odometry.yaw, DRIVE.odometry.yaw, atol=5e-3)


def with_units(c):
    return {"time [ms]": 1e3 * c["t"], "cmd_speed [km/h]": 3.6 * c["cv"], "cmd_turn (deg/s)": np.rad2deg(c["cw"]),
            "x_mm": 1e3 * c["x"], "y_mm": 1e3 * c["y"], "heading [deg]": np.rad2deg(c["yaw"]) % 360,
            "speed_kmh": 3.6 * c["v"], "yaw rate [deg/sec]": np.rad2deg(c["w"])}


def german(c):
    return {"Zeit [s]": c["t"], "Soll v [km/h]": 3.6 * c["cv"], "Soll Gier [°/s]": np.rad2deg(c["cw"]),
            "Odo x [m]": c["x"], "Odo y [m]": c["y"], "Odo Gier [°]": np.rad2deg(c["yaw"]),
            "Ist v [km/h]": 3.6 * c["v"], "Ist Gierrate [°/s]": np.rad2deg(c["w"])}


def by_their_units(c):
    return {"time": c["t"], "cmd v [m/s]": c["cv"], "cmd yaw [deg/s]": np.rad2deg(c["cw"]), "odom x [m]": c["x"],
            "odom y [m]": c["y"], "odom turn [deg]": np.rad2deg(c["yaw"]), "odom v [m/s]": c["v"],
            "odom heading [deg/s]": np.rad2deg(c["w"])}


def without_the_second(c):
    return {"time": c["t"], "cmd v [m/s]": c["cv"], "cmd_yaw_rate_deg": np.rad2deg(c["cw"]), "odom_x": c["x"],
            "odom_y": c["y"], "odom_yaw_rads": c["yaw"], "odom v [m/s]": c["v"], "gyro z [deg]": np.rad2deg(c["w"])}


def turn_beside_a_heading(c):
    return {"time": c["t"], "cmd v [m/s]": c["cv"], "cmd_turn_rad": c["cw"], "odom x [m]": c["x"], "odom y [m]": c["y"],
            "odom heading [degs]": np.rad2deg(c["yaw"]), "odom v [m/s]": c["v"], "odom turn [deg]": np.rad2deg(c["w"]),
            "gt x": c["gx"], "gt y": c["gy"], "gt turn [deg]": np.rad2deg(c["gyaw"])}


@pytest.mark.parametrize("form", [german, by_their_units, without_the_second, turn_beside_a_heading])
def test_the_unit_says_whether_a_turn_is_a_heading_or_a_rate_unless_the_name_does(tmp_path, form):
    convert(ConvertConfig(write(tmp_path / "drive.csv", form(columns())), tmp_path / "data"))
    trial = load_log(tmp_path / "data").trials[0]
    check(trial)
    held = np.searchsorted(trial.command.t, 10.0, side="right") - 1
    assert trial.command.omega[held] == pytest.approx(DRIVE.command.omega[100], abs=1e-3)
    assert (trial.ground_truth is not None) == (form is turn_beside_a_heading)


def test_a_vehicle_that_turns_without_a_commanded_yaw_rate_is_refused_with_the_unused_columns(tmp_path):
    table = without_units(columns())
    renamed = {("steer demand" if name == "cmd_w" else name): values for name, values in table.items()}
    path = write(tmp_path / "drive.csv", renamed)
    with pytest.raises(ValueError, match="no column is the commanded yaw rate.*not used: drive/steer demand. If none "
                                         "was commanded, add a column of zeros for it"):
        convert(ConvertConfig(path, tmp_path / "data"))
    convert(ConvertConfig(path, tmp_path / "data", columns=("command.omega=steer demand:rad/s",)))
    assert np.ptp(load_log(tmp_path / "data").trials[0].command.omega) > 0.5


@pytest.mark.parametrize("measured", ["speeds", "wheels"])
def test_a_vehicle_whose_speeds_alone_show_that_it_turns_needs_a_commanded_yaw_rate(tmp_path, measured):
    c = columns()
    speeds = {"odom_v": c["v"], "odom_w": c["w"]} if measured == "speeds" else {
        "left_rad_s": (c["v"] - 0.248 * c["w"]) / 0.1325, "right_rad_s": (c["v"] + 0.248 * c["w"]) / 0.1325}
    path = write(tmp_path / "drive.csv", {"t": c["t"], "target_speed": c["cv"], "target_steer": np.arctan(c["cw"]),
                                          **speeds})
    with pytest.raises(ValueError, match="no column is the commanded yaw rate, .*not used: drive/target_steer"):
        convert(ConvertConfig(path, tmp_path / "data"))


def test_a_command_of_which_only_the_part_that_changed_was_written_keeps_the_other_part(tmp_path):
    c = columns()
    changed = {key: np.diff(c[key], prepend=np.nan) != 0 for key in ("cv", "cw")}
    path = write(tmp_path / "drive.csv", {"t": c["t"], **{f"cmd_{key[1]}": np.where(at, c[key], np.nan)
                                                          for key, at in changed.items()},
                                          "odom_v": c["v"], "odom_w": c["w"]})
    log, _ = convert(ConvertConfig(path, tmp_path / "data"))
    command = log.trials[0].command
    np.testing.assert_allclose(command.at(c["t"][1:]), [c["cv"][1:], c["cw"][1:]], atol=1e-5)
    assert len(command.t) == (changed["cv"] | changed["cw"]).sum()  # rows without a command are none


def test_of_two_columns_that_may_be_one_quantity_the_better_named_counts_and_equals_are_asked_for(tmp_path):
    c = columns()
    table = {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], "gyro_z": 1.2 * c["w"], "odom_v": c["v"],
             "odom_w": c["w"]}
    log, _ = convert(ConvertConfig(write(tmp_path / "drive.csv", table), tmp_path / "data"))
    check(log.trials[0], pose=False)
    twice = {**table, "odom_v_kmh": 3.6 * c["v"], "joy_v": 0 * c["cv"]}
    convert(ConvertConfig(write(tmp_path / "drive.csv", twice), tmp_path / "twice"))
    path = write(tmp_path / "drive.csv", {"t": c["t"], "joy_v": 1.3 * c["cv"], **table})
    with pytest.raises(ValueError, match="drive/joy_v and drive/cmd_v may both be command.v, and they differ. Say which"
                                         " is: command.v=COLUMN"):
        convert(ConvertConfig(path, tmp_path / "asked"))
    log, _ = convert(ConvertConfig(path, tmp_path / "asked", columns=("command.v=cmd_v",)))
    check(log.trials[0], pose=False)


def test_a_straight_drive_needs_no_commanded_yaw_rate(tmp_path):
    table = without_units(columns(CHAIR["straight_1"]))
    del table["cmd_w"]
    convert(ConvertConfig(write(tmp_path / "drive.csv", table), tmp_path / "data"))
    assert not load_log(tmp_path / "data").trials[0].command.omega.any()


def without_units(c):
    return {"timestamp": 1e9 * (T0 + c["t"]), "cmd_v": c["cv"], "cmd_w": c["cw"], "odom_x": c["x"], "odom_y": c["y"],
            "odom_theta": np.rad2deg(c["yaw"]), "odom_v": 3.6 * c["v"], "odom_w": np.rad2deg(c["w"]), "gt_x": c["gx"],
            "gt_y": c["gy"], "gt_yaw": c["gyaw"]}


def plotted(c):
    pose = quaternion(c["yaw"])
    return {"__time": T0 + c["t"], "/cmd_vel/linear/x": c["cv"], "/cmd_vel/angular/z": c["cw"],
            "/odom/pose/pose/position/x": c["x"], "/odom/pose/pose/position/y": c["y"],
            **{f"/odom/pose/pose/orientation/{name[1]}": values for name, values in pose.items()},
            "/odom/twist/twist/linear/x": c["v"], "/odom/twist/twist/angular/z": c["w"],
            "/odom/twist/twist/linear/y": 0 * c["v"]}


@pytest.mark.parametrize(("change", "says"), [
    (lambda text: text.replace(".", ","), "Are there decimal commas"),
    (lambda text: text.replace("gt_x", "odom_x"), "two columns are named 'odom_x'"),
    (lambda text: text.replace("cmd_v", "status"), "is the only part of a command"),
    (lambda text: re.sub(r"(?m)^[\d.]+", "7", text), "time stands still in drive/timestamp"),
    (lambda text: re.sub(r"(?m)^[\d.]+", "Friday noon", text), "Its timestamp holds 'Friday noon', which is no time"),
])  # fmt: skip
def test_a_table_that_cannot_be_read_is_refused_with_the_reason(tmp_path, change, says):
    path = write(tmp_path / "drive.csv", without_units(columns()))
    path.write_text(change(path.read_text()))
    with pytest.raises(ValueError, match=says):
        convert(ConvertConfig(path, tmp_path / "data"))
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(("change", "says"), [
    (lambda lines: ['"' + line.replace(",", '","').replace(".", ",") + '"' for line in lines], ""),
    (lambda lines: [lines[0], *(line + "," for line in lines[1:])], ""),
    (lambda lines: [lines[0], "ms,km/h,deg/s,mm,mm,deg,km/h,deg/s", *lines[1:]], ""),
    (lambda lines: [lines[0], *lines[:0:-1]], "newest row comes first"),
    (lambda lines: [*lines[:9], "0x" + lines[9], *lines[10:]], "is no number .'0x.*' in line 10"),
    (lambda lines: [*lines, lines[-1]], "1 row of .* at the time of the row before"),
])  # fmt: skip
def test_tables_of_other_programs_are_read_and_what_is_left_out_is_said(tmp_path, change, says):
    table = write(tmp_path / "drive.csv", with_units(columns()))
    table.write_text("\n".join(change(table.read_text().splitlines())))
    log, notes = convert(ConvertConfig(table, tmp_path / "data"))
    assert len(log.trials[0].odometry.t) >= len(DRIVE.odometry.t) - 1
    assert any(re.search(says, note) for note in notes)


def level(c):
    """A quaternion as of a vehicle on a floor, and units before the last word."""
    pose = {f"/odom/pose/pose/orientation/{name}": getattr(np, of)(c["yaw"] / 2) for name, of in (("z", "sin"),
                                                                                                 ("w", "cos"))}
    rest = {name: values for name, values in plotted(c).items() if "orientation" not in name and "cmd" not in name}
    return {**rest, **pose, "speed_kmh_cmd": 3.6 * c["cv"], "yawrate_dps_cmd": np.rad2deg(c["cw"])}


def days(c):
    """Dates of a spreadsheet, which count days, and speeds of wheels that are those of their rims."""
    return {"time": 45000.0 + c["t"] / 86400, "cmd_v": c["cv"], "cmd_w": c["cw"],
            "left_speed": c["v"] - c["w"] * 0.248, "right_speed": c["v"] + c["w"] * 0.248}


def wheels(c):
    """Minutes, commands and speeds of wheels, and ticks that nobody needs."""
    rpm = 60 / (2 * np.pi * 0.1325)
    return {"time_min": c["t"] / 60, "left_rpm_cmd": rpm * (c["cv"] - c["cw"] * 0.248),
            "right_rpm_cmd": rpm * (c["cv"] + c["cw"] * 0.248), "left_rpm": rpm * (c["v"] - c["w"] * 0.248),
            "right_rpm": rpm * (c["v"] + c["w"] * 0.248), "battery": 24.0 - c["t"] / 100}


@pytest.mark.parametrize("names", [days, wheels])
def test_wheel_speeds_of_any_unit_are_an_odometry_beside_commands(tmp_path, names):
    path = write(tmp_path / "drive.csv", names(columns()), digits=12)
    log, notes = convert(ConvertConfig(path, tmp_path / "log"))
    assert len(notes) > 1 and ("drive: not used: drive/battery" in notes) == (names is wheels)
    odometry = log.trials[0].odometry
    np.testing.assert_allclose(odometry.omega, np.interp(odometry.t, DRIVE.odometry.t, DRIVE.odometry.omega), atol=5e-3)
    assert log.trials[0].duration == pytest.approx(DRIVE.duration, abs=0.1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_wheel_that_counts_backwards_is_named_and_turned_by_a_flag(tmp_path, side):
    c = columns()
    turned = {"left": c["v"] - 0.248 * c["w"], "right": c["v"] + 0.248 * c["w"]}
    turned[side] = -turned[side]
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"],
                                          "wheel_left": turned["left"], "wheel_right": turned["right"]})
    with pytest.raises(ValueError, match=f"the {side} wheel counts backwards.*--columns wheels.{side}=.*:-") as error:
        convert(ConvertConfig(path, tmp_path / "log"))
    remedy = str(error.value).rpartition(" ")[2]
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=(remedy,)))
    check(log.trials[0], pose=False)
    assert f"{remedy}m/s" in log.fields["columns"]
    again, _ = convert(ConvertConfig(path, tmp_path / "again", columns=tuple(log.fields["columns"])))
    check(again.trials[0], pose=False)


@pytest.mark.parametrize("rate", ["left_speed", "left_mps"])
@pytest.mark.parametrize("backward", [1.0, -1.0])
def test_speeds_that_a_driver_leaves_at_zero_are_taken_from_the_angles_of_the_wheels(tmp_path, rate, backward):
    c, table = columns(), {}
    for side, sign in (("left", -1), ("right", 1)):
        turned = (c["v"] + sign * 0.248 * c["w"]) / 0.1325
        table[f"{side}_angle_rad"] = (backward if side == "right" else 1.0) * np.concatenate(
            [[0.0], np.cumsum((turned[1:] + turned[:-1]) / 2 * np.diff(c["t"]))])
        table[rate.replace("left", side)] = 0 * c["t"]
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], **table})
    if backward < 0:
        with pytest.raises(ValueError, match="drive/right_angle_rad: the right wheel counts backwards"):
            convert(ConvertConfig(path, tmp_path / "log"))
        return
    log, notes = convert(ConvertConfig(path, tmp_path / "log"))
    assert any("the speeds of the wheels are all 0: taken from their angles" in note for note in notes)
    np.testing.assert_allclose(log.trials[0].odometry.v, c["v"], atol=0.1)
    np.testing.assert_allclose(log.trials[0].odometry.yaw[-1] - log.trials[0].odometry.yaw[0],
                               c["yaw"][-1] - c["yaw"][0], atol=0.1)


def test_one_wheel_without_a_speed_has_that_of_its_angle(tmp_path):
    c = columns()
    rates = {side: (c["v"] + sign * 0.248 * c["w"]) / 0.1325 for side, sign in (("left", -1), ("right", 1))}
    turned = {side: np.append(0.0, np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(c["t"])))
              for side, rate in rates.items()}
    path = write(tmp_path / "drive.csv", {
        "t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], "left_speed_rad_s": np.gradient(turned["left"], c["t"]),
        **{f"{side}_angle_rad": angle for side, angle in turned.items()}})
    log, _ = convert(ConvertConfig(path, tmp_path / "log"))
    np.testing.assert_allclose(log.trials[0].odometry.v, c["v"], atol=0.1)


def test_the_remedy_for_a_backward_encoder_keeps_its_ticks(tmp_path):
    c = columns()
    turns = {side: np.concatenate([[0.0], np.cumsum((c["v"] + sign * 0.248 * c["w"])[1:] * np.diff(c["t"]))]) / 0.1325
             for side, sign in (("left", -1), ("right", 1))}
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"],
                                          "enc_left": turns["left"] * 1024 / (2 * np.pi),
                                          "enc_right": -turns["right"] * 1024 / (2 * np.pi)})
    said = ("wheels.left_angle=enc_left:1024/rev", "wheels.right_angle=enc_right:1024/rev")
    with pytest.raises(ValueError, match="the right wheel counts backwards") as error:
        convert(ConvertConfig(path, tmp_path / "log", columns=said))
    remedy = str(error.value).rpartition(" ")[2]
    assert remedy == "wheels.right_angle=drive/enc_right:-1024/rev"
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=(said[0], remedy)))
    np.testing.assert_allclose(log.trials[0].odometry.yaw[-1], DRIVE.odometry.yaw[-1] - DRIVE.odometry.yaw[0], atol=0.1)
    with pytest.raises(ValueError, match=f"{said[1]} and {remedy}: two decisions on one role"):
        convert(ConvertConfig(path, tmp_path / "other", columns=(*said, remedy)))


def test_two_decisions_on_one_column_are_refused_and_one_said_twice_is_not(tmp_path):
    c = columns()
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], "a": c["v"], "b": c["w"]})
    said = ("odometry.v=a:m/s", "odometry.omega=b:rad/s")
    convert(ConvertConfig(path, tmp_path / "log", columns=(*said, said[0])))
    with pytest.raises(ValueError, match="odometry.v=a:m/s and odometry.omega=a:rad/s: two decisions on one column"):
        convert(ConvertConfig(path, tmp_path / "other", columns=(said[0], "odometry.omega=a:rad/s")))


def test_a_file_of_too_few_rows_is_named_where_it_leaves_no_drive(tmp_path):
    c = columns()
    write(tmp_path / "drive" / "odom.csv", {name: c[name] for name in ("t", "x", "y", "yaw", "v", "w")})
    (tmp_path / "drive" / "cmd_vel.csv").write_text("t,v,omega\n0,0.3,0.2\n")
    with pytest.raises(ValueError, match="neither commands.*Left out before: .*cmd_vel.csv: 1 row; at least 10"):
        convert(ConvertConfig(tmp_path / "drive", tmp_path / "log"))


def test_a_quaternion_by_which_the_vehicle_lies_on_its_side_is_named(tmp_path):
    c = columns()
    first = dict(zip(("qx", "qy", "qz", "qw"), np.roll(list(quaternion(c["gyaw"]).values()), 1, axis=0), strict=True))
    table = {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], "gt_x": c["gx"], "gt_y": c["gy"],
             **{f"gt_{name}": values for name, values in first.items()}}
    _, notes = convert(ConvertConfig(write(tmp_path / "drive.csv", table), tmp_path / "log"))
    assert any("lies on its side in ground_truth" in one and "order w, x, y, z" in one for one in notes)


def trajectory(axes, up):
    """The drive in TUM's form in a frame of which two axes are those of the floor, forward and left, and one is up."""
    c = columns()
    place = {axis: 0 * c["gx"] for axis in "xyz"}
    place |= {axes[0][-1]: c["gx"], axes[1][-1]: (-1 if axes[1][0] == "-" else 1) * c["gy"]}
    parts = {axis: 0 * c["gx"] for axis in "xyz"} | {up[-1]: (-1 if up[0] == "-" else 1) * np.sin(c["gyaw"] / 2)}
    return {"timestamp": c["t"], **{f"t{axis}": place[axis] for axis in "xyz"},
            **{f"q{axis}": parts[axis] for axis in "xyz"}, "qw": np.cos(c["gyaw"] / 2)}


def beside_commands(folder, table, name="traj.txt"):
    c = columns()
    write(folder / "u.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"]})
    write(folder / name, table, separator=" ", header=False)
    return folder


@pytest.mark.parametrize(("name", "stream"), [("traj.txt", "ground_truth"), ("odom.txt", "odometry"),
                                              ("odom_gt.txt", "ground_truth"), ("cmd.txt", "ground_truth")])
def test_a_trajectory_is_of_one_stream_by_whatever_name(tmp_path, name, stream):
    log, _ = convert(ConvertConfig(beside_commands(tmp_path / "d", trajectory("xy", "z"), name), tmp_path / "log"))
    found = getattr(log.trials[0], stream)
    assert sum(one is not None for one in (log.trials[0].odometry, log.trials[0].ground_truth)) == 1
    np.testing.assert_allclose(np.ptp(found.yaw), np.ptp(columns()["gyaw"]), atol=0.01)


@pytest.mark.parametrize(("axes", "up"), [(("z", "-x"), "-y"), (("z", "x"), "y"), (("y", "z"), "x")])
def test_a_trajectory_of_a_camera_says_which_columns_to_take_and_these_work(tmp_path, axes, up):
    drive = beside_commands(tmp_path / "d", trajectory(axes, up))
    with pytest.raises(ValueError, match=f"whose {up[-1]} axis is the vertical one") as error:
        convert(ConvertConfig(drive, tmp_path / "log"))
    assert "on its side" not in str(error.value)
    said = re.search(r"--columns (.*?qw)\.", str(error.value))[1]
    said = said if up[0] == "-" else said.replace(":--", "").replace(":-m", "")
    log, notes = convert(ConvertConfig(drive, tmp_path / "log", columns=tuple(said.split())))
    c, pose = columns(), log.trials[0].ground_truth
    for name in ("x", "y", "yaw"):
        np.testing.assert_allclose(getattr(pose, name), np.interp(pose.t, c["t"] - c["t"][0], c[f"g{name}"]), atol=2e-3)
    assert not any(note.startswith("!") for note in notes)


@pytest.mark.parametrize("height", [lambda c: 0.05 * c["gx"], lambda c: 0.01 * np.sin(9 * c["t"])])
def test_a_trajectory_up_a_slope_or_with_noise_is_of_the_floor(tmp_path, height):
    c = columns()
    straight = trajectory("xy", "z") | {"ty": 1e-3 * np.sin(7 * c["t"]), "qz": 0 * c["t"], "qw": 1 + 0 * c["t"]}
    drive = beside_commands(tmp_path / "d", straight | {"tz": height(c)})
    write(drive / "u.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": 0 * c["cw"]})
    log, _ = convert(ConvertConfig(drive, tmp_path / "log"))
    assert log.trials[0].ground_truth is not None


def test_files_of_one_name_but_for_their_kind_are_kept_apart(tmp_path):
    c = columns()
    drive = beside_commands(tmp_path / "d", trajectory("xy", "z"), "drive1.txt")
    (drive / "u.csv").rename(drive / "drive1.csv")
    log, notes = convert(ConvertConfig(drive, tmp_path / "log"))
    assert log.trials[0].ground_truth is not None and log.trials[0].command.v.max() == pytest.approx(c["cv"].max())
    assert any("ground_truth.x=drive1.txt/tx" in note for note in notes)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("lost", [False, True])
def test_angles_of_wheels_are_unwrapped_only_where_they_wrap(wraps, lost):
    radius, track = 0.033, 0.16
    rate = 8.0 if wraps else 18.0  # rad/s: 3.6 rad from row to row at 5 Hz
    t = np.arange(0.0, 20.0, 0.2)
    t = t[(t < 5.0) | (t > 5.9)] if lost and not wraps else t  # a gap of two turns and a half
    angle = rate * t
    rows = np.column_stack([np.angle(np.exp(1j * angle)) if wraps else angle] * 2 + [0 * t + np.nan] * 2)
    np.testing.assert_allclose(joint_twist(t, rows, radius, track), np.tile([rate * radius, 0.0], (len(t), 1)),
                               atol=1e-9)


@pytest.mark.parametrize("turn", [1440, 1000])
@pytest.mark.parametrize("forward", [1.0, -1.0])
def test_a_counter_that_overflows_is_no_jump_of_the_wheels(tmp_path, turn, forward):
    c, angle = columns(), {}
    for side, way in (("left", -1), ("right", 1)):
        rate = (c["v"] + way * 0.25 * c["w"] + 0.3) / 0.1
        angle[side] = forward * np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(c["t"]))])
    half = {side: each[len(each) // 2] * turn / (2 * np.pi) for side, each in angle.items()}
    ticks = {f"{side}_ticks": np.remainder(np.round(each * turn / (2 * np.pi) - half[side]), 65536)
             for side, each in angle.items()}
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": forward * (c["cv"] + 0.3), "cmd_w": forward * c["cw"],
                                          **ticks})
    said = tuple(f"wheels.{side}_angle={side}_ticks:{turn}/rev" for side in ("left", "right"))
    log, _ = convert(ConvertConfig(path, tmp_path / "data", columns=said, wheel_radius=0.1, track=0.5, vehicle="cart"))
    went = 0.1 * np.gradient((angle["left"] + angle["right"]) / 2, c["t"])
    np.testing.assert_allclose(log.trials[0].odometry.v, went, atol=0.02)


def test_ticks_of_wheels_need_their_number_in_a_turn(tmp_path):
    c = columns()
    angle = np.cumsum((c["v"] - c["w"] * 0.248) / 0.1325) * np.median(np.diff(c["t"]))
    ticks = {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"],
             **{f"{side}_ticks": np.round(angle * 1440 / (2 * np.pi)) for side in ("left", "right")}}
    path = write(tmp_path / "drive.csv", ticks)
    with pytest.raises(ValueError, match="say how many make a turn: wheels.left_angle=drive/left_ticks:N/rev"):
        convert(ConvertConfig(path, tmp_path / "log"))
    said = tuple(f"wheels.{side}_angle={side}_ticks:1440/rev" for side in ("left", "right"))
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=said))
    assert log.trials[0].odometry.v.max() == pytest.approx((c["v"] - c["w"] * 0.248).max(), rel=0.1)


def beside_others(c):
    """What could be taken for the time or for a speed, left of what is."""
    return {"hour": 10.0 + 0 * c["t"], "angular_velocity.x": 0.1 * np.cos(c["t"]), **without_units(c)}


@pytest.mark.parametrize("names", [with_units, without_units, plotted, level, beside_others])
def test_columns_are_found_by_their_names_and_units_by_names_or_numbers(tmp_path, names):
    log, _ = convert(ConvertConfig(write(tmp_path / "drive.csv", names(columns())), tmp_path / "log"))
    (trial,) = log.trials
    assert trial.name == "drive" and (trial.ground_truth is not None) == (names in (without_units, beside_others))
    check(trial)


def test_files_of_one_drive_are_joined_by_time_and_the_decision_is_written_and_can_be_repeated(tmp_path):
    c, folder = columns(), tmp_path / "monday"
    turn, seen = quaternion(c["yaw"]), quaternion(c["gyaw"])
    write(folder / "cmd_vel.csv", {"%time": 1e9 * (T0 + c["t"]), "field.linear.x": c["cv"], "field.angular.z": c["cw"]})
    write(folder / "odom.csv", {"header.stamp.secs": np.floor(T0 + c["t"]), "header.stamp.nsecs": 1e9 * (c["t"] % 1),
                                "pose.pose.position.x": c["x"], "pose.pose.position.y": c["y"],
                                **{f"pose.pose.orientation.{name[1]}": one for name, one in turn.items()},
                                "twist.twist.linear.x": c["v"], "twist.twist.angular.z": c["w"]})
    write(folder / "mocap.tum", {"t": T0 + c["t"], "x": c["gx"], "y": c["gy"], "z": 0 * c["gx"], **seen},
          separator=" ", header=False)
    log, notes = convert(ConvertConfig(folder, tmp_path / "log"))
    check(log.trials[0])
    assert log.trials[0].ground_truth is not None and any("column ground_truth.x=mocap/tx:m" in note for note in notes)
    decided = log.fields["columns"]
    again, _ = convert(ConvertConfig(folder, tmp_path / "again", columns=tuple(decided)))
    assert again.fields["columns"] == decided
    np.testing.assert_array_equal(again.trials[0].odometry.values, log.trials[0].odometry.values)


def test_columns_of_one_stream_in_several_files_are_brought_to_one_clock(tmp_path):
    """A file for each signal, as plotting programs and databases export them, each at times of its own."""
    c, late = columns(), 0.013
    write(tmp_path / "in" / "v.csv", {"time": c["t"], "cmd_v": c["cv"]})
    write(tmp_path / "in" / "w.csv", {"time": c["t"] + late, "cmd_omega": c["cw"]})
    write(tmp_path / "in" / "pose.csv", {"time": c["t"], "odom_x": c["x"], "odom_y": c["y"], "odom_yaw": c["yaw"]})
    shifted = {name: np.interp(c["t"] + late, c["t"], c[key]) for name, key in (("odom_v", "v"), ("odom_omega", "w"))}
    write(tmp_path / "in" / "twist.csv", {"time": c["t"] + late, **shifted})
    _, notes = convert(ConvertConfig(tmp_path / "in", tmp_path / "data"))
    trial = load_log(tmp_path / "data").trials[0]
    begin = c["t"][1]  # the first row of the pose that the twist covers
    assert np.abs(trial.odometry.v - np.interp(trial.odometry.t + begin, c["t"], c["v"])).mean() < 5e-3
    for name, value in (("v", "cv"), ("omega", "cw")):
        held = np.searchsorted(trial.command.t, [4.0, 10.0, 16.0], side="right") - 1
        expected = c[value][np.searchsorted(c["t"], np.array([4.0, 10.0, 16.0]) + begin - late * (name == "omega"),
                                            side="right") - 1]
        np.testing.assert_allclose(getattr(trial.command, name)[held], expected, atol=1e-3)
    assert any("omega of w hold until the next row of their file" in note for note in notes)
    assert any("omega, v of twist are interpolated to the times of pose" in note for note in notes)


def test_columns_of_one_stream_in_files_without_a_common_time_are_refused(tmp_path):
    c = columns()
    write(tmp_path / "in" / "v.csv", {"time": c["t"], "cmd_v": c["cv"]})
    write(tmp_path / "in" / "odom.csv", {"time": c["t"], **{f"odom_{name}": c[name] for name in ("x", "y", "yaw")}})
    write(tmp_path / "in" / "gt.csv", {"time": c["t"], "gt_x": c["gx"], "gt_y": c["gy"]})
    write(tmp_path / "in" / "heading.csv", {"time": c["t"] + 500.0, "gt_yaw [rad]": c["gyaw"]})
    write(tmp_path / "in" / "w.csv", {"time": c["t"], "cmd_omega": c["cw"]})
    with pytest.raises(ValueError, match="columns of ground_truth are in files that share no time .*gt .*heading "):
        convert(ConvertConfig(tmp_path / "in", tmp_path / "data"))


def test_each_file_with_commands_and_odometry_is_a_drive(tmp_path):
    for name in ("circle_1", "circle_2"):
        c = columns(CHAIR[name])
        write(tmp_path / "drives" / f"{name}.csv", {"t": c["t"], "v_cmd": c["cv"], "w_cmd": c["cw"], "x": c["x"],
                                                    "y": c["y"], "theta": c["yaw"], "v": c["v"], "w": c["w"]})
    log, _ = convert(ConvertConfig(tmp_path / "drives", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["circle_1", "circle_2"]


def test_a_drive_that_is_there_twice_is_named(tmp_path):
    c = columns()
    for name in ("drive", "drive_copy"):
        write(tmp_path / "logs" / f"{name}.csv", with_units(c))
    write(tmp_path / "logs" / "other.csv", with_units(columns(CHAIR["circle_1"])))
    log, notes = convert(ConvertConfig(tmp_path / "logs", tmp_path / "data"))
    assert len(log.trials) == 3 and [one for one in notes if "is a copy of" in one] == [
        "drive_copy is a copy of drive: as replicates they would show a noise of 0, and held out it would be seen "
        "before. Leave one out"]


def test_decimal_commas_and_cells_that_are_empty_are_read(tmp_path):
    c = columns()
    path = write(tmp_path / "drive.csv", {"Zeit": c["t"], "v_soll": c["cv"], "w_soll": c["cw"], "v_ist": c["v"],
                                          "w_ist": c["w"]}, separator=";", comma=True)
    lines = path.read_text().splitlines()
    lines[5] = ";".join([lines[5].split(";")[0], "", "", "", ""])
    path.write_text("\n".join(lines))
    log, notes = convert(ConvertConfig(path, tmp_path / "log"))
    assert len(log.trials[0].odometry.t) == len(c["t"]) - 1 and any("dead reckoned" in note for note in notes)


@pytest.mark.parametrize("word", ["None", "null", "N/A", "-"])
def test_words_in_the_first_rows_are_no_second_line_of_names(tmp_path, word):
    c = columns()
    path = write(tmp_path / "drive.csv", {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"], "odom_v": c["v"],
                                          "odom_w": c["w"]})
    lines = path.read_text().splitlines()
    for row in (1, 2):
        lines[row] = ",".join([*lines[row].split(",")[:3], word, word])
    path.write_text("\n".join(lines))
    log, _ = convert(ConvertConfig(path, tmp_path / "log"))
    assert len(log.trials[0].odometry.t) == len(c["t"]) - 2


def test_separators_of_thousands_are_no_decimals(tmp_path):
    c = columns()
    path = write(tmp_path / "drive.csv", clocked(c, 1e6 * c["t"]), separator=";", comma=True)
    head, *rows = path.read_text().splitlines()
    millions = [f"{round(float(row.split(';')[0].replace(',', '.'))):,}".replace(",", ".") for row in rows]
    path.write_text("\n".join([head, *(f"{one};{row.partition(';')[2]}"
                                       for one, row in zip(millions, rows, strict=True))]))
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=("time=time:us",)))
    check(log.trials[0], pose=False)


def test_rows_of_a_rounded_time_are_spread_evenly(tmp_path):
    c = columns()
    log, notes = convert(ConvertConfig(write(tmp_path / "drive.csv", clocked(c, np.floor(c["t"]))), tmp_path / "log"))
    assert any("its time is rounded to 1 s: rows of odometry at one time are spread" in note for note in notes)
    np.testing.assert_allclose(log.trials[0].odometry.t, c["t"] - c["t"][0], atol=0.11)


@pytest.mark.parametrize("order", [("qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz")])
def test_a_trajectory_without_names_may_have_w_first(tmp_path, order):
    c, parts = columns(), quaternion(columns()["gyaw"])
    write(tmp_path / "drive" / "cmd.csv", {name: c[key] for name, key in (("t", "t"), ("v", "cv"), ("w", "cw"))})
    write(tmp_path / "drive" / "mocap.tum", {"t": c["t"], "x": c["gx"], "y": c["gy"], "z": 0 * c["gx"],
                                             **{name: parts[name] for name in order}}, separator=" ", header=False)
    log, _ = convert(ConvertConfig(tmp_path / "drive", tmp_path / "log"))
    np.testing.assert_allclose(np.unwrap(log.trials[0].ground_truth.yaw), np.unwrap(c["gyaw"]), atol=1e-3)


def test_names_in_several_lines_and_counted_frames_are_read(tmp_path):
    c, none = columns(), 0 * columns()["t"]
    write(tmp_path / "drive" / "cmd.csv", {name: c[key] for name, key in (("t", "t"), ("v", "cv"), ("w", "cw"))})
    mocap = write(tmp_path / "drive" / "mocap.csv", {
        "Frame": c["t"] / 0.1, "RX": none, "RY": none, "RZ": np.rad2deg(c["gyaw"]), "TX": 1e3 * c["gx"],
        "TY": 1e3 * c["gy"]})
    head, *rows = mocap.read_text().splitlines()
    mocap.write_text("\n".join(["Segments", "10", ",robot:body,,,,", head, ",deg,deg,deg,mm,mm", *rows]))
    with pytest.raises(ValueError, match="If its Frame counts rows, .* time=mocap/Frame:100hz"):
        convert(ConvertConfig(tmp_path / "drive", tmp_path / "log"))
    log, _ = convert(ConvertConfig(tmp_path / "drive", tmp_path / "log", columns=("time=mocap/Frame:10hz",)))
    truth = log.trials[0].ground_truth
    np.testing.assert_allclose(np.interp(truth.t, c["t"] - c["t"][0], c["gx"]), truth.x, atol=1e-3)
    turned = "Rotation,Rotation,Rotation,Rotation,Position,Position"
    parts = quaternion(c["gyaw"])
    write(mocap, {"t": c["t"], "X": parts["qx"], "Y": parts["qy"], "Z": parts["qz"], "W": parts["qw"], "X ": c["gx"],
                  "Y ": c["gy"]})
    head, *rows = mocap.read_text().splitlines()
    mocap.write_text("\n".join(["," + turned, "Time (Seconds),X,Y,Z,W,X,Y", *rows]))
    log, _ = convert(ConvertConfig(tmp_path / "drive", tmp_path / "again"))
    np.testing.assert_allclose(np.unwrap(log.trials[0].ground_truth.yaw), np.unwrap(c["gyaw"]), atol=1e-3)


def clocked(c, t):
    return {"time": t, "cmd_v": c["cv"], "cmd_w": c["cw"], "odom_v": c["v"], "odom_w": c["w"]}


@pytest.mark.parametrize("back", [0.5, 2.0])
def test_a_clock_that_was_set_back_is_refused_and_rows_out_of_order_are_not(tmp_path, back):
    c = columns()
    t = c["t"].copy()
    t[200:] -= back
    with pytest.raises(ValueError, match=f"goes back by {back - 0.05:.2f} s after row 200 .9.9 s into it.*Cut"):
        convert(ConvertConfig(write(tmp_path / "back.csv", clocked(c, t)), tmp_path / "log"))
    rows = np.arange(len(t))
    rows[[100, 101]] = rows[[101, 100]]
    swapped = clocked({name: values[rows] for name, values in c.items()}, c["t"][rows])
    log, _ = convert(ConvertConfig(write(tmp_path / "swapped.csv", swapped), tmp_path / "log"))
    check(log.trials[0], pose=False)


@pytest.mark.parametrize(("turn", "per_s"), [(2**16, 1e3), (2**32, 1e6), (2**32 / 1e6, 1.0)])
def test_a_clock_that_overflows_is_counted_on(tmp_path, turn, per_s):
    c = columns()
    ticks = c["t"] * per_s
    ticks = np.mod(ticks - ticks[200] + turn, turn)
    log, notes = convert(ConvertConfig(write(tmp_path / "drive.csv", clocked(c, ticks)), tmp_path / "log"))
    check(log.trials[0], pose=False)
    assert log.trials[0].duration == pytest.approx(c["t"][-1] - c["t"][0], abs=0.01)
    assert any(f"time counts to {turn:.7g} and begins anew: it is counted on" in note for note in notes)
    doubled = (tmp_path / "drive.csv").read_text().splitlines()  # two columns of one name that agree are one
    (tmp_path / "twice.csv").write_text("\n".join(f"{line},{line.partition(',')[0]}" for line in doubled))
    assert "time" in read_table(tmp_path / "twice.csv").columns
    ticks[300:] = np.mod(ticks[300:] - 2 * per_s, turn)  # and was set back by 2 s
    with pytest.raises(ValueError, match="goes back"):
        convert(ConvertConfig(write(tmp_path / "back.csv", clocked(c, ticks)), tmp_path / "again"))


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%f+02:00", "%H:%M:%S.%f",
                                  "%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p",
                                  "%Y/%m/%d/%H:%M:%S.%f"])
def test_dates_and_times_of_day_are_times_also_past_midnight(tmp_path, form):
    c = columns()
    path = write(tmp_path / "drive.csv", clocked(c, c["t"]))
    head, *rows = path.read_text().splitlines()
    begin = datetime(2026, 1, 2, 23, 59, 55)
    stamps = [(begin + timedelta(seconds=float(row.split(",")[0]))).strftime(form) for row in rows]
    path.write_text("\n".join(["Recorded by a logger", "Robot: 7", head, *(
        f"{stamp},{row.partition(',')[2]}" for stamp, row in zip(stamps, rows, strict=True))]))
    log, _ = convert(ConvertConfig(path, tmp_path / "log"))
    check(log.trials[0], pose=False)
    assert log.trials[0].duration == pytest.approx(c["t"][-1] - c["t"][0], abs=0.01)


def test_one_bad_file_of_a_folder_does_not_keep_out_the_others(tmp_path):
    for name in ("circle_1", "circle_2"):
        c = columns(CHAIR[name])
        write(tmp_path / "logs" / f"{name}.csv", clocked(c, c["t"]))
    (tmp_path / "logs" / "notes.csv").write_text("who,what\nme,nothing\n")
    c = columns(CHAIR["turn_1"])
    write(tmp_path / "logs" / "turn_1.csv", clocked(c, np.where(c["t"] > 5, c["t"] - 3, c["t"])))
    log, notes = convert(ConvertConfig(tmp_path / "logs", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["circle_1", "circle_2"]
    left = [note for note in notes if note.startswith("left out")]
    assert len(left) == 2 and "notes.csv" in left[0] and "turn_1: its time goes back" in left[1]


def unnamed(c):
    return {"a": c["t"], "b": c["cv"], "c": c["cw"], "d": c["v"], "e": c["w"]}


def of_unknown_origin(c):
    return {"time": c["t"], "vel_ref": c["cv"], "omega_ref": c["cw"], "x": c["gx"] + 3, "y": c["gy"], "yaw": c["gyaw"]}


@pytest.mark.parametrize(("names", "said"), [
    (unnamed, "no column is surely a command, .*Its columns are drive/a, drive/b.*Give --columns"),
    (of_unknown_origin, "not clear what drive/x, drive/y, drive/yaw are.*guessed: .*'odometry.x=drive/x:m'.*--columns"),
    (lambda c: {"t": c["t"], "cmd_v": c["cv"], "cmd_w": c["cw"]}, "neither odometry .* nor an outside pose"),
    (lambda c: {"cmd_v": c["cv"], "cmd_w": c["cw"], "odom_v": c["v"], "odom_w": c["w"]},
     "no column of drive is surely its time"),
])
def test_without_a_sure_guess_one_line_names_columns_guess_and_flags_and_nothing_is_written(tmp_path, names, said):
    path = write(tmp_path / "drive.csv", names(columns()))
    with pytest.raises(ValueError, match=said) as caught:
        convert(ConvertConfig(path, tmp_path / "log"))
    assert "\n" not in str(caught.value) and not (tmp_path / "log").exists()


def test_flags_say_what_no_name_does(tmp_path):
    said = ("time=a:s", "command.v=b:m/s", "command.omega=c", "odometry.v=d", "odometry.omega=drive/e:rad/s")
    path = write(tmp_path / "drive.csv", unnamed(columns()))
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=said))
    check(log.trials[0], pose=False)
    with pytest.raises(ValueError, match="'furlong' is no unit of odometry.x"):
        convert(ConvertConfig(path, tmp_path / "other", columns=("odometry.x=a:furlong",)))
    with pytest.raises(ValueError, match="no such column .found drive/a"):
        convert(ConvertConfig(path, tmp_path / "other", columns=("odometry.x=f",)))


def foreign(c):
    """Units that no name says."""
    return {"ms": 1e3 * c["t"], "target speed": 3.6 * c["cv"], "target turn": np.rad2deg(c["cw"]), "x": 1e3 * c["x"],
            "y": 1e3 * c["y"], "heading": np.rad2deg(c["yaw"]), "speed": 3.6 * c["v"], "turn": np.rad2deg(c["w"])}


def test_one_drive_in_another_unit_does_not_change_the_others(tmp_path):
    for k in range(4):
        table = without_units(columns())
        size = 1e3 if k == 2 else 1.0
        table |= {name: size * table[name] for name in ("odom_x", "odom_y", "gt_x", "gt_y")}
        write(tmp_path / "drives" / f"drive_{k}.csv", table)
    write(tmp_path / "drives" / "pose.csv", {"t": DRIVE.odometry.t, "gt_x": DRIVE.odometry.x, "gt_y": DRIVE.odometry.y})
    log, notes = convert(ConvertConfig(tmp_path / "drives", tmp_path / "log"))
    assert [np.ptp(one.odometry.x) for one in log.trials] == pytest.approx(4 * [np.ptp(DRIVE.odometry.x)], abs=0.01)
    assert any("pose: no drive by itself" in note for note in notes)


def test_drives_in_which_a_unit_does_not_show_have_that_of_the_others(tmp_path):
    names = ("random_1", "straight_1", "turn_1")
    for name in names:
        write(tmp_path / "logs" / f"{name}.csv", foreign(columns(CHAIR[name])))
    log, _ = convert(ConvertConfig(tmp_path / "logs", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == list(names)
    for trial in log.trials:
        for quantity in ("x", "y", "yaw", "v", "omega"):
            there = getattr(CHAIR[trial.name].odometry, quantity)
            np.testing.assert_allclose(getattr(trial.odometry, quantity), there, atol=1e-3)


@pytest.mark.parametrize("role, name, unit, size", [
    ("cv", "cmd_v [knots]", "kn", 1852 / 3600), ("v", "odom_v (feet/s)", "ft/s", 0.3048),
    ("v", "odom_v [m/min]", "m/min", 1 / 60), ("w", "odom_omega [rps]", "rev/s", 2 * np.pi),
    ("w", "odom_omega [rad/min]", "rad/min", 1 / 60), ("yaw", "odom_yaw [gon]", "gon", np.pi / 200),
])  # fmt: skip
def test_a_unit_that_is_written_counts_and_no_other_one(tmp_path, role, name, unit, size):
    values = columns()
    table = {name if key == role else plain: values[key] / (size if key == role else 1.0)
             for key, plain in NAMES.items()}  # fmt: skip
    found = guess([read_table(write(tmp_path / "drive.csv", table))])
    assert next(one.unit for one in found if one.name == name) == unit


@pytest.mark.parametrize("name", ["odom_v [um/s]", "odom_v [parsec/h]", "cmd_v [%]"])
def test_a_unit_that_is_written_and_not_known_is_refused_however_the_numbers_look(tmp_path, name):
    values, role = columns(), "cv" if name.startswith("cmd") else "v"
    table = {name if key == role else NAMES[key]: values[key] for key in NAMES}
    path = write(tmp_path / "drive.csv", table)
    with pytest.raises(ValueError, match=r"drive.csv: the unit .* is not known \(known: m/s, .*UNIT; else convert"):
        convert(ConvertConfig(source=path, out=tmp_path / "log"))
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize("late", [0.5, None])
def test_two_clocks_in_one_file_are_refused_unless_they_are_the_same(tmp_path, late):
    values = columns()
    table = {"cmd_time": values["t"], "cmd_v": values["cv"], "cmd_omega": values["cw"],
             "odom_time": values["t"] + (late or 0.0), "odom_x": values["x"], "odom_y": values["y"],
             "odom_yaw": values["yaw"], "odom_v": values["v"], "odom_omega": values["w"]}  # fmt: skip
    path = write(tmp_path / "drive.csv", table)
    if late is None:
        convert(ConvertConfig(source=path, out=tmp_path / "log"))
        check(load_log(tmp_path / "log").trials[0])
        return
    with pytest.raises(ValueError, match="drive/cmd_time and drive/odom_time are times of different streams.*own"):
        convert(ConvertConfig(source=path, out=tmp_path / "log"))
    convert(ConvertConfig(source=path, out=tmp_path / "log", columns=("time=drive/cmd_time:s",)))
    check(load_log(tmp_path / "log").trials[0])


@pytest.mark.parametrize("minus", ["\u2212", "\u2013", "()"])
def test_negative_numbers_may_have_a_minus_sign_a_dash_or_parentheses(tmp_path, minus):
    values = columns()
    path = write(tmp_path / "drive.csv", {name: values[key] for key, name in NAMES.items()})
    text = path.read_text()
    changed = re.sub(r"-([\d.]+)", r"(\1)", text) if minus == "()" else text.replace("-", minus)
    path.write_text(changed, encoding="utf-8")
    _, notes = convert(ConvertConfig(source=path, out=tmp_path / "log")), load_log(tmp_path / "log").notes
    check(load_log(tmp_path / "log").trials[0])
    assert "no number" not in " ".join(notes) and "are none" not in " ".join(notes)


@pytest.mark.parametrize("broken", ["newest first", "cells missing"])
def test_units_show_in_rows_of_any_order_and_beside_missing_cells(tmp_path, broken):
    values = columns()
    table = {name: values[key] / (0.44704 if key in ("v", "cv") else 1.0) for key, name in NAMES.items()}
    if broken == "newest first":
        table = {name: one[::-1] for name, one in table.items()}
    else:
        table["odom_x"] = np.where(np.isin(np.arange(len(values["t"])), (50, 51, 90)), np.nan, table["odom_x"])
    found = guess([read_table(write(tmp_path / "drive.csv", table))])
    assert {one.unit for one in found if one.role in ("command.v", "odometry.v")} == {"mph"}


@pytest.mark.parametrize("key, size, asked", [("t", 1 / 60, "time"), ("x", 100.0, "odom_x")])
def test_minutes_and_centimetres_that_nothing_states_are_asked_for(tmp_path, key, size, asked):
    """In seconds and metres the recording would last half a second, and the vehicle drive at tens of m/s."""
    values = columns()
    scaled = {"t": ("t",), "x": ("x", "y", "v", "cv")}[key]
    table = {NAMES[name]: values[name] * (size if name in scaled else 1.0) for name in NAMES}
    path = write(tmp_path / "drive.csv", table, digits=8)
    with pytest.raises(ValueError, match=f"it is not clear what .*{asked}"):
        convert(ConvertConfig(source=path, out=tmp_path / "log"))


def test_a_unit_that_is_left_out_of_a_flag_is_found_as_elsewhere(tmp_path):
    drive = write(tmp_path / "drive.csv", foreign(columns()) | {"b [deg/s]": np.rad2deg(columns()["w"])})
    flags = ("time=ms", "command.v=target speed", "odometry.omega=b [deg/s]", "odometry.yaw=heading")
    log, _ = convert(ConvertConfig(drive, tmp_path / "log", columns=flags))
    check(log.trials[0])


def wheel_log(folder):
    """Log and notes of a drive with measured wheel speeds and an outside pose, and the drive's columns."""
    c = columns()
    left, right = ((c["v"] + side * c["w"] * 0.496 / 2) / 0.1325 * 60 / (2 * np.pi) for side in (-1, 1))
    path = write(folder / "drive.csv", {"t": c["t"], "wheel_left_rpm": left, "wheel_right_rpm": right,
                                        "mocap_x": c["gx"], "mocap_y": c["gy"], "mocap_yaw": c["gyaw"]})
    return *convert(ConvertConfig(path, folder / "log")), c


def test_wheel_speeds_and_an_outside_pose_are_an_input_without_commands(tmp_path):
    log, notes, c = wheel_log(tmp_path)
    assert log.fields["input"] == "wheels" and log.trials[0].odometry is None
    assert any("no commands" in note for note in notes) and any("measured wheel speeds" in note for note in log.notes)
    np.testing.assert_allclose(log.trials[0].command.v, c["v"], atol=1e-3)
    assert log.trials[0].command.t[3] == pytest.approx((c["t"][2] + c["t"][3]) / 2)  # half an interval before
    assert set(wheel_model(log.spec).params.values) >= {"radius", "track", "ahead"}


def test_a_vehicle_file_beside_measured_wheel_speeds_is_refused(tmp_path):
    log, *_ = wheel_log(tmp_path)
    file = save_vehicle(tmp_path / "vehicle.toml", log.spec, preset_params(log.spec, "physical"))
    with pytest.raises(ValueError, match=r"vehicle.toml: a vehicle file says nothing about the model"):
        check_settings(log, FitConfig(vehicle=file))


@pytest.mark.parametrize("period", [0.05, 0.5])
def test_states_of_the_chair_become_the_odometry_that_the_bridge_makes_of_them(period):
    t = np.arange(0.0, 12.0, period)
    left, right = 6.0 * np.sin(0.4 * t) + 3.0 * t, 4.0 * np.sin(0.4 * t) + 3.0 * t
    rates = 2.4 * np.cos(0.4 * t) + 3.0, 1.6 * np.cos(0.4 * t) + 3.0
    states = [SimpleNamespace(left_motor_angle=np.angle(np.exp(1j * a)), right_motor_angle=-np.angle(np.exp(1j * b)),
                              left_motor_speed=v * 0.1325 * 3.6, right_motor_speed=-w * 0.1325 * 3.6)
              for a, b, v, w in zip(left, right, *rates, strict=True)]
    mine = chair_odometry(t, np.array([chair_row(one) for one in states]), 0.1325, 0.496)
    bridge = WheelOdometry()
    theirs = [bridge.update(now, ChairState(**vars(one))) for now, one in zip(t, states, strict=True)]
    np.testing.assert_allclose(mine[:, :3], [(one.x, one.y, one.yaw) for one in theirs], atol=1e-9)
    np.testing.assert_allclose(mine[2:-2, 3], (0.1325 * (rates[0] + rates[1]) / 2)[2:-2], atol=0.02)


def test_wheels_among_joints_are_found_by_their_names():
    names = ["arm_left_joint", "front_left_wheel", "rear_left_wheel", "right_wheel", "caster_wheel"]
    state = SimpleNamespace(name=names, position=[9.0, 1.0, 1.2, 2.0, 7.0], velocity=[])
    row = joint_row(state)
    assert row[:2] == pytest.approx((1.1, 2.0)) and np.isnan(row[2:]).all()
    assert np.isinf(joint_row(SimpleNamespace(name=["a", "b"], position=[0.0, 0.0], velocity=[]))).all()
    t = np.arange(0.0, 2.0, 0.1)
    rows = np.column_stack([np.angle(np.exp(3j * t)), np.angle(np.exp(5j * t)), np.full((len(t), 2), np.nan)])
    np.testing.assert_allclose(joint_twist(t, rows, 0.1, 0.5), np.tile([0.4, 0.4], (len(t), 1)), atol=1e-9)


def test_a_base_with_a_time_out_stops_in_pauses_of_the_commands():
    command = Command(np.array([0.0, 0.1, 0.2, 3.0, 3.1]), np.array([0.5, 0.5, 0.5, 0.5, 0.0]), np.zeros(5))
    held = with_timeout(command, 0.5)
    np.testing.assert_allclose(held.t, [0.0, 0.1, 0.2, 0.7, 3.0, 3.1])
    np.testing.assert_allclose(held.v, [0.5, 0.5, 0.5, 0.0, 0.5, 0.0])
    assert "command_timeout" in {field.name for field in DATASET}


def wheel_speeds(c, track=0.5):
    """Commanded and measured speeds [m/s] of the left and the right wheel."""
    return [c[v] + side * c[w] * track / 2 for v, w in (("cv", "cw"), ("v", "w")) for side in (-1, 1)]


LEGENDS = [
    "% logfile of robot 7\n%  1    time 0.000 sec\n%  2    mission (0) state 2\n"
    "%  3  4 Motor velocity ref (m/s) left, right: 0.00 0.00\n%  5  6 Wheel velocity [m/s] left, right: 0.0 0.0\n",
    "% Drive of\n% wheel base: 0.5 m\n% 0 \tTime (sec)\n% 1 \tmode (0=automatic, 1=manual)\n"
    "% 2,3 \tDesired wheel velocity left, right (m/s)\n% 4 \tVelocity left (m/s)\n% 5 \tVelocity right (m/s)\n",
]


@pytest.mark.parametrize("legend", LEGENDS)
def test_comments_that_number_the_columns_give_them_their_names(tmp_path, legend):
    c = columns()
    table = np.column_stack([c["t"], np.full(len(c["t"]), 2), *wheel_speeds(c)])
    path = tmp_path / "drive.txt"
    path.write_text(legend + "".join(" ".join(f"{one:.5f}" for one in row) + " \n" for row in table))
    log, _ = convert(ConvertConfig(path, tmp_path / "log", wheel_radius=0.1, track=0.5))
    check(log.trials[0], pose=False)


def test_comments_that_only_begin_with_a_number_name_nothing(tmp_path):
    path = tmp_path / "drive.txt"
    path.write_text("% 3 laps of the hall\n% 12 March, wet\n" + "".join(f"{k} {k % 3} 0 0\n" for k in range(20)))
    assert list(read_table(path).columns) == ["column1", "column2", "column3", "column4"]


def test_who_says_which_columns_are_the_wheel_commands_needs_no_word_on_a_set_speed_beside_them(tmp_path):
    c = columns()
    names = ("leftCommand", "rightCommand", "leftSpeed", "rightSpeed")
    sides = dict(zip(names, wheel_speeds(c), strict=True))
    path = write(tmp_path / "drive.csv", {"time": c["t"], "targetSpeed": np.full(len(c["t"]), 200.0), **sides})
    said = tuple(f"{role}={name}:m/s" for role, name in zip(
        ("command.left", "command.right", "wheels.left", "wheels.right"), names, strict=True))
    log, _ = convert(ConvertConfig(path, tmp_path / "log", columns=said, wheel_radius=0.1, track=0.5))
    check(log.trials[0], pose=False)


DRIVES = {  # v and omega of 60 s, and whether the path shows where the vehicle heads
    "circles": (lambda t: 0.5 + 0 * t, lambda t: 0.6 + 0 * t), "spin": (lambda t: 0 * t, lambda t: 0.6 + 0 * t),
    "one turn": (lambda t: 0.4 + 0 * t, lambda t: 0.3 * ((t > 5) & (t < 8))),
    "nearly straight": (lambda t: 0.5 + 0 * t, lambda t: 0.05 * np.sin(0.3 * t)),
    "there and back": (lambda t: 0.5 * (t % 15 < 10), lambda t: 0.628 * (t % 15 >= 10)),
}


@pytest.mark.parametrize("lever", [0.0, 0.3])
@pytest.mark.parametrize(("size", "unit"), [(1.0, "rad"), (180 / np.pi, "deg")])
@pytest.mark.parametrize("drive", DRIVES)
def test_the_unit_of_a_heading_is_that_in_which_it_follows_its_path_or_the_commands(drive, size, unit, lever):
    t, noise = np.arange(0.0, 60.0, 0.05), np.random.default_rng(0).normal(size=(3, 1200))
    v, omega = (of(t) for of in DRIVES[drive])
    x, y, yaw = integrate_speeds(t, v, omega)
    x, y = x + lever * np.cos(yaw) + 0.003 * noise[0], y + lever * np.sin(yaw) + 0.003 * noise[1]
    table = {"t": t, "cmd_v": v, "cmd_w": size * omega, "gt_x": x, "gt_y": y,
             "gt_yaw": size * (yaw + 1.0 + 0.005 * noise[2])}
    found = {one.role: one for one in guess([Table("drive", table)])}
    assert found["ground_truth.yaw"].sure and found["ground_truth.yaw"].unit == unit
    if drive != "nearly straight":  # nothing else would show 0.05 rad/s from 3 deg/s
        assert found["command.omega"].unit == f"{unit}/s"


def test_a_heading_that_nothing_else_shows_the_unit_of_is_asked_for(tmp_path):
    t = np.arange(0.0, 30.0, 0.05)
    table = {"t": t, "cmd_v": 0 * t, "cmd_w": 0 * t, "gt_x": 0 * t, "gt_y": 0 * t, "gt_yaw": 0.4 * t}
    path = write(tmp_path / "pushed.csv", table)
    with pytest.raises(ValueError, match="not clear what pushed/gt_yaw is"):
        convert(ConvertConfig(path, tmp_path / "log"))


@pytest.mark.parametrize(("rate", "seconds", "size", "unit"), [
    (500, 20, 1e3, "asks"), (1000, 20, 1e6, "asks"), (500, 20, 1e9, "asks"),
    (200, 20, 1e3, "ms"), (200, 20, 1e6, "us"), (100, 20, 1e9, "ns"),
    (500, 20, 1.0, "s"), (1, 300, 1.0, "s"), (0.5, 600, 1.0, "s"), (1, 300, 1e3, "ms"),
    (0.15, 120, 1.0, "s"),
])
def test_a_step_of_time_that_fits_two_units_is_asked_for(rate, seconds, size, unit):
    t = np.arange(0.0, seconds, 1 / rate)
    found = {one.role: one for one in guess([Table("drive", {"t": size * t, "cmd_v": 0 * t, "cmd_w": 0 * t})])}
    assert (found["time"].unit if found["time"].sure else "asks") == unit


def test_of_seconds_since_1970_one_a_second_is_no_millisecond():
    t = 1.7e9 + np.arange(0.0, 3000.0, 1.0)
    (time, *_) = guess([Table("drive", {"t": t, "cmd_v": 0 * t, "cmd_w": 0 * t})])
    assert time.sure and time.unit == "s"


def test_rows_whose_quaternion_is_all_zero_are_left_out_and_counted(tmp_path):
    c = columns()
    turned = quaternion(c["gyaw"])
    lost = np.arange(len(c["t"])) % 50 == 7
    table = {"t": c["t"], "cmd_v": c["cv"], "cmd_omega": c["cw"], "odom_x": c["x"], "odom_y": c["y"],
             "odom_yaw": c["yaw"], "odom_v": c["v"], "odom_omega": c["w"], "gt_x": c["gx"], "gt_y": c["gy"],
             **{f"gt_{name}": np.where(lost, 0.0, one) for name, one in turned.items()}}
    log, notes = convert(ConvertConfig(write(tmp_path / "drive.csv", table), tmp_path / "out"))
    assert any(f"{lost.sum()} rows of ground_truth with an orientation that is all zero left out" in one
               for one in notes)
    pose = log.trials[0].ground_truth
    np.testing.assert_allclose(pose.yaw, np.interp(pose.t, DRIVE.ground_truth.t, DRIVE.ground_truth.yaw), atol=0.02)


@pytest.mark.parametrize("name", ["...csv", ".hidden.csv"])
def test_a_trial_is_no_hidden_folder(tmp_path, name):
    log, _ = convert(ConvertConfig(write(tmp_path / "in" / name, columns_by_name()), tmp_path / "out"))
    assert [trial.name[0] for trial in log.trials] == [log.trials[0].name[0]] and log.trials[0].name[0] != "."
    (tmp_path / "out" / "trials" / ".ipynb_checkpoints").mkdir()
    assert load_log(tmp_path / "out").trials[0].name == log.trials[0].name


def columns_by_name():
    c = columns()
    names = {"t": "t", "cv": "cmd_v", "cw": "cmd_omega", "x": "odom_x", "y": "odom_y", "yaw": "odom_yaw", "v": "odom_v",
             "w": "odom_omega", "gx": "gt_x", "gy": "gt_y", "gyaw": "gt_yaw"}
    return {names[key]: one for key, one in c.items()}


def test_a_stamp_is_asked_of_bags_alone(tmp_path):
    with pytest.raises(ValueError, match="--stamp header: rows of tables have one time each"):
        convert(ConvertConfig(write(tmp_path / "drive.csv", columns_by_name()), tmp_path / "out", stamp="header"))
    assert not (tmp_path / "out").exists()


def test_a_broken_link_is_left_out_by_name(tmp_path):
    write(tmp_path / "in" / "a.csv", columns_by_name())
    (tmp_path / "in" / "b.csv").symlink_to(tmp_path / "nowhere.csv")
    _, notes = convert(ConvertConfig(tmp_path / "in", tmp_path / "out"))
    assert any("b.csv: no file that can be read" in one for one in notes)


@pytest.mark.parametrize(("begin", "kind"), [(b"\x1f\x8b\x08", "a gzip archive"), (b"PAR1\x15", "a Parquet file"),
                                             (b"\x89MCAP0\r\n", "an MCAP recording")])
def test_what_is_no_text_is_called_what_it_is(tmp_path, begin, kind):
    (tmp_path / "drive.csv").write_bytes(begin + bytes(range(200)))
    with pytest.raises(ValueError, match=f"drive.csv: is {kind}, whatever its name says"):
        read_table(tmp_path / "drive.csv")
    (tmp_path / "drive.csv").write_text("PAR1,PAR2,t\n" + "1,2,3\n" * 20)  # a text that begins like a Parquet file
    assert list(read_table(tmp_path / "drive.csv").columns) == ["PAR1", "PAR2", "t"]


def test_rows_without_a_time_are_left_out_and_counted(tmp_path):
    c = columns()
    lost = np.arange(len(c["t"])) % 50 == 7
    table = {"t": np.where(lost, np.nan, c["t"]), "cmd_v": c["cv"], "cmd_omega": c["cw"], "odom_x": c["x"],
             "odom_y": c["y"], "odom_yaw": c["yaw"], "odom_v": c["v"], "odom_omega": c["w"]}
    log, notes = convert(ConvertConfig(write(tmp_path / "drive.csv", table), tmp_path / "out"))
    for stream in ("command", "odometry"):
        assert any(f"{lost.sum()} rows of {stream} without a time left out" in one for one in notes), notes
    assert sum(len(trial.odometry.t) for trial in log.trials) <= (~lost).sum()
