"""Loaders of the measured sets: on small fabricated files, and on the real ones where they are at hand."""

from __future__ import annotations

import gzip
from dataclasses import replace

import numpy as np
import pytest
from conftest import shared_folder

from sysid.close_loop import Arguments, load
from sysid.logs.loaders import detect_format, load_any, split
from sysid.logs.published.drive_norlab import CONTINUOUS_COLUMNS, load_drive
from sysid.logs.published.mrclam import load_mrclam
from sysid.logs.published.poses import only_changes
from whill_mjx.vehicle.specs import CREATE, WARTHOG

pytestmark = pytest.mark.quick
BLOCKS = ("cmd_left", "cmd_right", "left_wheel_vel", "right_wheel_vel", "icp_x", "icp_y", "icp_yaw", "imu_yaw")


def write_drive(path, rows=3, update=5, pace=1.0):
    """Windows of straight driving at 1 rad/s of both wheels (0.3 m/s), with the ICP held for `update` samples."""
    columns = [f"{name}_{i}" for name in BLOCKS for i in range(40)]
    data = np.zeros((rows, len(columns)))
    index = {name: i for i, name in enumerate(columns)}
    for i in range(40):
        for name in BLOCKS[:4]:
            data[:, index[f"{name}_{i}"]] = 1.0
        data[:, index[f"icp_x_{i}"]] = 0.3 * 0.05 * pace * (i // update * update)
        data[:, index[f"imu_yaw_{i}"]] = 0.1
    np.savez(path, data=data, columns=np.array(columns))


def test_a_drive_window_starts_at_the_measured_wheel_speed_and_scores_only_new_poses(tmp_path):
    write_drive(tmp_path / "warthog_sand_1.npz")
    log = load_drive(tmp_path, ("warthog_sand_1",))
    assert log.spec == WARTHOG and len(log.trials) == 3
    trial = log.trials[0]
    assert (trial.start.v, trial.start.omega) == (pytest.approx(0.3), 0.0)
    np.testing.assert_allclose(trial.ground_truth.t, np.arange(5, 40, 5) * 0.05)
    np.testing.assert_allclose(trial.command.v, 0.3)
    assert trial.odometry.x is None and trial.group == "sand"


def write_arc(path, omega, gyro_sign=1.0, heading=0.0, rows=6, update=5, v=1.2):
    """Steps of 6 s on an arc, in the published form: ICP held for `update` samples, yaw of the original wrapped and
    counted from a window's first sample, positions turned by the mean of its first five yaws. Every third window
    begins where an update falls on its first sample."""
    columns = [f"{name}_{i}" for name in BLOCKS for i in range(40)]
    data = np.zeros((rows, len(columns)))
    index = {name: i for i, name in enumerate(columns)}

    def put(row, name, values):
        data[row, [index[f"{name}_{i}"] for i in range(40)]] = values

    for row in range(rows):
        sample = 40 * (row % 3) + np.arange(40)
        t = 0.05 * ((sample + 2) // update * update - 2)  # of the last update
        raw = heading + omega * t
        x, y = (v / omega * (np.sin(raw) - np.sin(heading)), -v / omega * (np.cos(raw) - np.cos(heading)))
        raw = (raw + np.pi) % (2 * np.pi) - np.pi
        turned = raw[:5].mean()
        dx, dy = x - x[0], y - y[0]
        put(row, "icp_x", np.cos(turned) * dx + np.sin(turned) * dy)
        put(row, "icp_y", -np.sin(turned) * dx + np.cos(turned) * dy)
        put(row, "icp_yaw", raw - raw[0])
        put(row, "imu_yaw", gyro_sign * omega)
        for side, sign in (("left", -1), ("right", 1)):
            for name in (f"cmd_{side}", f"{side}_wheel_vel"):
                put(row, name, (v + sign * WARTHOG.track / 2 * omega) / WARTHOG.wheel_radius)
    np.savez(path, data=data, columns=np.array(columns))


@pytest.mark.parametrize("omega, heading", [(0.8, 0.0), (-1.4, 2.0), (1.4, np.pi - 0.1), (-0.8, -np.pi + 0.1)])
def test_positions_of_a_window_are_in_the_frame_of_its_first_sample(tmp_path, omega, heading):
    write_arc(tmp_path / "warthog_sand_1.npz", omega, heading=heading)
    for trial in load_drive(tmp_path, ("warthog_sand_1",)).trials:
        truth = trial.ground_truth
        np.testing.assert_allclose(truth.x, 1.2 / omega * np.sin(truth.yaw), atol=1e-9)
        np.testing.assert_allclose(truth.y, 1.2 / omega * (1 - np.cos(truth.yaw)), atol=1e-9)


@pytest.mark.parametrize("update", [4, 5, 7])
def test_chained_windows_lie_on_the_arc_and_held_joints_are_not_scored(tmp_path, update):
    write_arc(tmp_path / "warthog_sand_1.npz", 0.8, update=update)
    log = load_drive(tmp_path, ("warthog_sand_1",), chained=True)
    truth = log.trials[0].ground_truth
    np.testing.assert_allclose(np.hypot(truth.x, truth.y - 1.5), 1.5, atol=2e-3)
    moved = np.hypot(np.diff(truth.x), np.diff(truth.y))
    assert moved.min() > 0.5 * 1.2 * 0.05 * update
    assert truth.yaw[-1] == pytest.approx(0.8 * truth.t[-1], abs=0.8 * 0.05 * update)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_sign_of_a_gyro_is_told_from_each_log(tmp_path, sign):
    write_arc(tmp_path / "warthog_gravel.npz", 0.5, gyro_sign=sign)
    write_arc(tmp_path / "warthog_sand_1.npz", 0.5)
    log = load_drive(tmp_path, ("warthog_gravel", "warthog_sand_1"))
    assert log.fields["gyro"]["warthog_gravel/000.0"] == pytest.approx(0.5)
    assert log.fields["gyro"]["warthog_sand_1/000.0"] == pytest.approx(0.5)
    assert ("its sign is changed" in log.notes[0]) == (sign < 0) and "sign" not in log.notes[1]


def test_a_gyro_that_nothing_turns_keeps_its_sign(tmp_path):
    write_drive(tmp_path / "warthog_sand_1.npz")
    log = load_drive(tmp_path, ("warthog_sand_1",))
    assert log.fields["gyro"]["warthog_sand_1/000.0"] == pytest.approx(0.1)
    assert "taken as logged" in log.notes[0]


def test_chained_windows_continue_each_other_and_state_the_error_of_the_joints(tmp_path):
    write_drive(tmp_path / "warthog_sand_1.npz")
    log = load_drive(tmp_path, ("warthog_sand_1",), chained=True)
    truth = log.trials[0].ground_truth
    assert len(log.trials) == 1 and truth.t[-1] == pytest.approx(4 + 35 * 0.05)
    when, rate = log.fields["yaw_rate"]["warthog_sand_1/000.0"]
    assert len(when) == len(rate) == 120 and when[-1] == pytest.approx(5.95)
    assert (np.diff(truth.x) > 0).all()
    # Each window loses the update between its last change (sample 35) and the next window's first sample.
    assert "100% of the joints seem to miss an ICP update" in log.notes[0]
    assert truth.x[-1] == pytest.approx(0.3 * 0.05 * 115, abs=2e-3)


def test_rounding_of_a_held_pose_is_no_motion():
    x = np.array([0.0, 1.0, 1.0 + 1e-15, 2.0])
    np.testing.assert_allclose(only_changes(np.arange(4.0), x, 0 * x, 0 * x).t, [1.0, 3.0])


def test_a_staircase_is_reduced_to_its_steps_and_yaw_is_unwrapped():
    yaw = np.array([3.1, 3.1, -3.1, -3.1])
    pose = only_changes(np.arange(4.0), np.zeros(4), np.zeros(4), yaw)
    np.testing.assert_allclose(pose.t, [2.0])
    np.testing.assert_allclose(pose.yaw, [2 * np.pi - 3.1])


def write_mrclam(folder, robot=1, commanded=0.08):
    time = 1248444175.0 + np.arange(0.0, 40.0, 0.05)
    command = np.column_stack([time, np.full_like(time, commanded), np.zeros_like(time)])
    truth = np.column_stack([time + 3.0, 0.08 * (time - time[0]), np.zeros_like(time), np.zeros_like(time)])
    for kind, table in (("Odometry", command), ("Groundtruth", truth)):
        with gzip.open(folder / f"MRCLAM_Dataset6_Robot{robot}_{kind}.dat.gz", "wt") as file:
            np.savetxt(file, table, header="as published")


def test_mrclam_windows_intersect_commands_and_truth_and_start_as_fast_as_the_pose_shows(tmp_path):
    write_mrclam(tmp_path, commanded=0.1)
    log = load_mrclam(tmp_path, (1,))
    assert log.spec == CREATE and len(log.trials) == 2
    trial = log.trials[1]
    assert trial.start.v == pytest.approx(0.08) and trial.start.x == pytest.approx(0.08 * 15, abs=0.01)
    assert trial.command.t[0] == 0.0 and np.diff(trial.ground_truth.t).min() > 0.09


def test_mrclam_files_are_read_as_they_are_published_whatever_the_data_set(tmp_path):
    write_mrclam(tmp_path)
    expected = load_mrclam(tmp_path, (1,)).trials[1].ground_truth.x
    for path in list(tmp_path.iterdir()):
        kind = path.name.removesuffix(".dat.gz").rpartition("_")[2]
        (tmp_path / f"Robot1_{kind}.dat").write_bytes(gzip.decompress(path.read_bytes()))
    with pytest.raises(ValueError, match="there is another one"):
        load_mrclam(tmp_path, (1,))
    for path in tmp_path.glob("*.gz"):
        path.unlink()
    assert detect_format(tmp_path) == "mrclam"
    np.testing.assert_array_equal(load_mrclam(tmp_path, (1,)).trials[1].ground_truth.x, expected)


def test_formats_are_told_apart_and_bad_calls_named(tmp_path):
    with pytest.raises(ValueError, match="no dataset.toml"):
        detect_format(tmp_path)
    write_drive(tmp_path / "warthog_sand_1.npz")
    assert detect_format(tmp_path) == "drive_norlab"
    with pytest.raises(ValueError, match="--train"):
        load_any(tmp_path)
    with pytest.raises(FileNotFoundError, match="no run 'warthog_moon'"):
        load_drive(tmp_path, ("warthog_moon",))
    write_drive(tmp_path / "husky_steps_000_133.npz")
    with pytest.raises(ValueError, match="different robots"):
        load_drive(tmp_path, ("warthog_sand_1", "husky_steps_000_133"))
    np.savez(tmp_path / "warthog_sand_2.npz", data=np.zeros((3, 2)), columns=np.array(["a", "b"]))
    with pytest.raises(ValueError, match="cmd_left"):
        load_drive(tmp_path, ("warthog_sand_2",))
    write_mrclam(tmp_path)
    assert detect_format(tmp_path) == "mrclam"
    with pytest.raises(FileNotFoundError, match="Robot2_Odometry"):
        load_mrclam(tmp_path, (2,))


def test_the_loop_takes_parts_of_a_measured_set_and_its_reference_another(tmp_path):
    for run, pace in (("warthog_sand_1", 1.0), ("warthog_gravel", 0.9)):
        write_drive(tmp_path / f"{run}.npz", rows=9, pace=pace)
    given = Arguments(dataset=tmp_path, train=("warthog_sand_1:0-0.6",), held_out=("warthog_sand_1:0.6-1",),
                      reference=(tmp_path,), reference_train=("warthog_gravel",))
    log, [reference], _ = load(given)
    assert (len(log.training), len(log.held_out), len(reference.training)) == (6, 3, 9)
    assert {trial.group for trial in reference.trials} == {"gravel"}
    with pytest.raises(ValueError, match="among the drives in question already"):
        load(replace(given, reference_train=("warthog_sand_1",)))
    with pytest.raises(ValueError, match="Give --train"):
        load(Arguments(dataset=tmp_path))


@pytest.mark.parametrize(("selection", "runs"), [
    ("sand", ["warthog_sand_1", "warthog_sand_2"]), ("warthog_sand_2", ["warthog_sand_2"]),
    ("warthog_gravel/001.0", ["warthog_gravel"])])
def test_a_selection_is_a_run_a_group_of_runs_or_a_trial(tmp_path, selection, runs):
    for run in ("warthog_sand_1", "warthog_sand_2", "warthog_gravel"):
        write_arc(tmp_path / f"{run}.npz", 0.5)
    log = load_any(tmp_path, train=(selection,))
    assert sorted({trial.name.split("/")[0] for trial in log.training}) == runs


def test_a_run_whose_name_has_no_robot_says_whose_sizes_are_taken(tmp_path):
    write_arc(tmp_path / "course_7.npz", 0.5)
    log = load_drive(tmp_path, ("course_7",))
    assert log.spec == WARTHOG and "no robot" in log.notes[0]


@pytest.mark.parametrize("selection", ["warthog_gravel:0.9-0.2", "warthog_gravel:2-3"])
def test_a_share_in_which_no_trial_lies_is_refused(tmp_path, selection):
    write_arc(tmp_path / "warthog_gravel.npz", 0.5)
    with pytest.raises(ValueError, match="no trial of 6 lies there"):
        load_any(tmp_path, train=(selection,))


def test_a_robot_that_the_set_does_not_have_is_named(tmp_path):
    (tmp_path / "Robot1_Odometry.dat").write_text("0 0 0\n")
    with pytest.raises(ValueError, match="robot1 to robot5"):
        load_any(tmp_path, train=("robotx",))


def test_selections_split_a_run_by_share_and_must_be_disjoint(tmp_path):
    write_drive(tmp_path / "warthog_sand_1.npz", rows=9)
    log = load_drive(tmp_path, ("warthog_sand_1",))
    parts = split(log, ("warthog_sand_1:0-0.6",), ("warthog_sand_1:0.6-1",))
    assert (len(parts.training), len(parts.held_out)) == (6, 3)
    assert {trial.name for trial in parts.training}.isdisjoint(trial.name for trial in parts.held_out)
    with pytest.raises(ValueError, match="disjoint"):
        split(log, ("warthog_sand_1",), ("warthog_sand_1:0.5-1",))
    with pytest.raises(ValueError, match="FROM-TO"):
        split(log, ("warthog_sand_1:half",), ())
    with pytest.raises(ValueError, match="matches no trial"):
        split(log, ("gravel",), ())


def test_the_published_drive_runs_load_with_the_gyro_sign_of_the_icp():
    folder = shared_folder("drive_norlab")
    for run in ("warthog_gravel", "warthog_asphalt_a"):
        log = load_drive(folder, (run,))
        assert len(log.trials) > 280
        turned = np.array([trial.ground_truth.yaw[-1] / trial.ground_truth.t[-1] for trial in log.trials])
        gyro = np.array([log.fields["gyro"][trial.name] for trial in log.trials])
        assert (turned * gyro).sum() / (gyro**2).sum() == pytest.approx(0.95, abs=0.15)


def write_continuous(path, sign=1.0, omega=0.5, v=0.4):
    """30 s on an arc at 20 Hz, the ICP held for 4 samples, as one log with a gyro."""
    names = [*CONTINUOUS_COLUMNS, "imu_z", "ros_time", "calib_state"]
    rows = [dict.fromkeys(names, 0.0)]
    for i in range(600):
        yaw = omega * 0.05 * (i // 4 * 4)
        left, right = (v + side * omega * WARTHOG.track / 2 for side in (-1, 1))
        rows.append(dict.fromkeys(names, 0.0) | {
            "icp_quat_z": np.sin(yaw / 2), "icp_quat_w": np.cos(yaw / 2), "icp_pos_x": v / omega * np.sin(yaw),
            "icp_pos_y": v / omega * (1 - np.cos(yaw)), "meas_left_vel": left / WARTHOG.wheel_radius,
            "meas_right_vel": right / WARTHOG.wheel_radius, "cmd_vel_x": v, "cmd_vel_omega": omega,
            "imu_z": sign * omega, "ros_time": 10**18 + i * 50_000_000, "calib_state": "calib"})
    lines = [",".join(names), *(",".join(str(row[name]) for name in names) for row in rows)]
    path.write_bytes(gzip.compress("\n".join(lines).encode()))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_gyro_of_a_continuous_log_is_a_channel(tmp_path, sign):
    write_continuous(tmp_path / "warthog_grass_continuous.csv.gz", sign)
    log = load_drive(tmp_path, ("grass",), chained=True)
    assert len(log.trials) == 4 and ("sign is changed" in log.notes[0]) == (sign < 0)
    for trial in log.trials:
        assert trial.gyro.turn[-1] == pytest.approx(0.5 * trial.gyro.t[-1])
        np.testing.assert_allclose(log.fields["yaw_rate"][trial.name][1], 0.5)


def test_the_published_continuous_run_loads():
    run = "warthog_grass_2024_07_18_continuous"
    log = load_drive(shared_folder("drive_norlab"), (run,))
    assert len(log.trials) > 30 and log.trials[0].group == "grass"


def test_the_published_mrclam_robots_load():
    log = load_mrclam(shared_folder("mrclam"), (1, 4))
    assert len(log.trials) > 80
    assert all(trial.ground_truth.t[-1] <= 15.1 and len(trial.ground_truth.t) > 30 for trial in log.trials)
