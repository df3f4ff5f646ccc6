"""The recorder's files: the dataset format, whole trials only."""

import argparse
import csv
import math
import os
import shutil
import tomllib

import pytest

from bridge.nodes.exits import Exit
from bridge.nodes.ros import PROFILE, split_ros_arguments, use_dds_profile
from bridge.record import finish, main, parse_arguments
from bridge.recording.dataset_file import toml_text, write_dataset_file
from bridge.recording.record_node import believed
from bridge.recording.split_writer import SplitWriter
from bridge.recording.trial_writer import TrialWriter

pytestmark = pytest.mark.quick


def read(path):
    with open(path, encoding="utf-8", newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def test_trial_has_the_columns_of_the_format_and_one_time_origin(tmp_path):
    writer = TrialWriter(tmp_path, "circle_1")
    for t in (900.0, 999.0):  # before the first pose only the command in force matters
        writer.command(t, t / 1000, 0.0)
    writer.odometry(1000.0, (0.0, 0.0, 0.0), (0.1, 0.0))
    writer.command(1000.05, 0.5, -0.2)
    writer.command(1000.05, 0.5, -0.2)
    writer.ground_truth(1000.1, 3.0, 4.0, 1.5)
    assert not list((tmp_path / "trials").iterdir())  # not before it is whole
    folder = writer.close()
    assert read(folder / "command.csv") == [{"t": 0.0, "v": 0.999, "omega": 0.0}, {"t": 0.05, "v": 0.5, "omega": -0.2}]
    assert read(folder / "odometry.csv") == [{"t": 0, "x": 0, "y": 0, "yaw": 0, "v": 0.1, "omega": 0, "stamp": 0}]
    assert read(folder / "ground_truth.csv") == [{"t": 0.1, "x": 3.0, "y": 4.0, "yaw": 1.5, "stamp": 0}]


@pytest.mark.parametrize("stamp, time", [(9.5, 9.5), (10.05, 10.05), (0.0, 10.0), (1.7e9, 10.0)])
def test_a_stamp_of_another_clock_is_replaced_by_the_time_of_receipt(stamp, time):
    assert believed(stamp, now=10.0) == time


def test_odometry_is_moved_to_the_origin_and_its_heading_unwrapped(tmp_path):
    writer = TrialWriter(tmp_path, "spin_1")
    for i in range(100):  # two turns on a circle that starts at (5, 6) heading east of north
        yaw = 1.0 + 0.13 * i
        wrapped = math.remainder(yaw, 2 * math.pi)
        x, y = 5 + math.sin(yaw) - math.sin(1.0), 6 - math.cos(yaw) + math.cos(1.0)
        writer.odometry(i * 0.05, (x, y, wrapped), (1.0, 1.0))
    rows = read(writer.close() / "odometry.csv")
    for i, row in enumerate(rows):
        turn = 0.13 * i
        assert row["yaw"] == pytest.approx(turn, abs=1e-5)
        assert (row["x"], row["y"]) == pytest.approx((math.sin(turn), 1 - math.cos(turn)), abs=1e-5)


def test_recording_that_begins_with_a_manoeuvre_has_its_times_and_nothing_of_before(tmp_path):
    writer = TrialWriter(tmp_path, "turn_1")
    writer.begin(7.0)
    writer.odometry(7.0, (3.0, 2.0, 1.5), (0.0, 0.0))  # of where the vehicle was carried from, and late
    writer.ground_truth(6.95, 3.0, 2.0, 1.5)
    writer.command(7.0, 0.0, 0.0)
    writer.odometry(7.05, (0.0, 0.0, -0.5), (0.0, 0.0))
    writer.ground_truth(7.05, 1.0, 0.0, -0.5)
    folder = writer.close()
    assert [row["t"] for row in read(folder / "command.csv")] == [0.0]
    [odometry] = read(folder / "odometry.csv")
    assert (odometry["t"], odometry["x"], odometry["yaw"]) == (0.05, 0.0, 0.0)
    assert [row["t"] for row in read(folder / "ground_truth.csv")] == [0.05]


def test_a_long_recording_is_split_where_the_vehicle_stands(tmp_path):
    """Drives of 4 s and of 2 s, with 10 s of standstill before, between and after them."""
    now, found = [0.0], []
    (tmp_path / "trials" / "walk_1").mkdir(parents=True)  # of another day
    writer = SplitWriter(tmp_path, "walk", 3.0, lambda folder, rows: found.append((folder.name, dict(rows))),
                         lambda: now[0])
    for i in range(360):
        now[0] = 0.1 * i
        v = 0.4 if 10 <= now[0] < 14 or 24 <= now[0] < 26 else 0.0
        writer.command(now[0], v, 0.0)
        writer.odometry(now[0], (0.1 * i, 0.0, 0.0), (v + 0.002, 0.0))
    assert writer.close() is None and [name for name, _ in found] == ["walk_2", "walk_3"]
    for (name, rows), driven in zip(found, (4.0, 2.0), strict=True):
        commands = read(tmp_path / "trials" / name / "command.csv")
        moving = [row["t"] for row in commands if row["v"]]
        assert moving[0] == pytest.approx(3.0, abs=0.15) and moving[-1] - moving[0] == pytest.approx(driven, abs=0.15)
        assert commands[-1]["t"] - moving[-1] == pytest.approx(3.0, abs=0.15) and commands[0]["t"] == 0
        assert rows["odometry"] == pytest.approx(10 * (driven + 6), abs=4)
    assert writer.rows["odometry"] == sum(rows["odometry"] for _, rows in found)


def test_a_split_recording_without_motion_writes_no_trial_and_one_that_goes_silent_ends_its_drive(tmp_path, capsys):
    now = [0.0]
    writer = SplitWriter(tmp_path, "walk", 3.0, lambda folder, rows: None, lambda: now[0])
    writer.odometry(0.0, (0.0, 0.0, 0.0), (0.0, 0.0))
    assert finish(writer) and "never moved" in capsys.readouterr().err and not (tmp_path / "trials").exists()
    writer.odometry(1.0, (0.0, 0.0, 0.0), (0.3, 0.0))
    now[0] = 9.0
    writer.flush()
    assert [folder.name for folder in writer.trials] == ["walk_1"]


def test_whole_messages_of_a_standstill_wait_on_disk_and_keep_their_time_of_receipt(tmp_path, monkeypatch):
    """An hour of images before a drive: the trial has those of its last three seconds, and the memory none."""
    now, kept = [0.0], []
    monkeypatch.setattr("bridge.recording.split_writer.time.time_ns", lambda: int(now[0] * 1e9))
    monkeypatch.setattr(TrialWriter, "message", lambda self, *message: kept.append(message))
    writer = SplitWriter(tmp_path, "walk", 3.0, lambda folder, rows: None, lambda: now[0])
    for i in range(3600):
        now[0] = float(i)
        writer.message("image", bytes, bytes([i % 256]) * 100_000)
    assert len(writer._waiting) == 0 and sum(len(index) for _, _, index in writer._spool._parts) <= 8
    on_disk = sum(file.seek(0, os.SEEK_END) for _, file, _ in writer._spool._parts)
    assert on_disk <= 800_000 and not list(tmp_path.iterdir())  # files without a name: nothing is left of a killed one
    writer.odometry(now[0], (0.0, 0.0, 0.0), (0.3, 0.0))
    assert [(data[0], received) for _, _, data, received in kept] == [
        (i % 256, i * 1_000_000_000) for i in (3596, 3597, 3598, 3599)]
    writer.message("image", bytes, b"moving")
    assert kept[-1] == ("image", bytes, b"moving") and not writer._spool._parts
    writer.close()


def test_values_that_are_not_finite_are_left_out(tmp_path):
    writer = TrialWriter(tmp_path, "a")
    writer.ground_truth(0.0, 0.0, 0.0, 0.0)
    writer.command(0.0, math.nan, 0.0)
    writer.command(0.1, 0.2, 0.0)
    assert len(read(writer.close() / "command.csv")) == 1


def test_recordings_that_are_put_aside_never_replace_one_another(tmp_path):
    def aside():
        writer = TrialWriter(tmp_path, "circle_1")
        writer.odometry(1.0, (0, 0, 0), (0, 0))
        return writer.put_aside()

    first, second = aside(), aside()
    shutil.rmtree(first)
    assert len({second, aside(), aside()}) == 3 and second.exists()


def test_recording_never_replaces_a_trial(tmp_path):
    TrialWriter(tmp_path, "a").close()
    with pytest.raises(ValueError, match="exists already"):
        TrialWriter(tmp_path, "a")


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a b"])
def test_trial_name_that_is_no_folder_name_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="names a folder"):
        TrialWriter(tmp_path, name)


def test_dataset_file_is_valid_and_an_existing_one_is_kept(tmp_path):
    options = parse_arguments([str(tmp_path), "a", "--vehicle", 'the "blue" \\ chair\n'])
    write_dataset_file(tmp_path, options)
    table = tomllib.loads((tmp_path / "dataset.toml").read_text(encoding="utf-8"))
    assert table["schema"] == 1 and table["track"] == 0.496 and table["held_out"] == []
    assert table["vehicle"] == 'the "blue" \\ chair\n' and "mass" not in table
    write_dataset_file(tmp_path, argparse.Namespace(**{**vars(options), "track": 9.0}))
    assert tomllib.loads((tmp_path / "dataset.toml").read_text(encoding="utf-8"))["track"] == 0.496


@pytest.mark.parametrize("text", ["plain", '"', "\\", "\\u0041", "a\tb", "\x7f", "日本"])
def test_any_text_survives_the_dataset_file(text):
    assert tomllib.loads(f"a = {toml_text(text)}")["a"] == text


def test_own_dds_profile_is_used_unless_the_user_chose_one():
    environment = {}
    assert use_dds_profile(environment) == str(PROFILE) == environment["FASTRTPS_DEFAULT_PROFILES_FILE"]
    assert PROFILE.is_file() and "33554432" in PROFILE.read_text()
    for variable in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"):
        environment = {variable: "mine.xml"}
        assert use_dds_profile(environment) == "mine.xml" and environment == {variable: "mine.xml"}


def test_ros_arguments_are_passed_on():
    assert split_ros_arguments(["a", "--b", "--ros-args", "-r", "x:=y"]) == (["a", "--b"], ["--ros-args", "-r", "x:=y"])
    assert split_ros_arguments(["a"]) == (["a"], [])


def test_option_behind_the_arguments_of_ros_is_heeded():
    """ROS ends its own at --, as in `ros2 run`; an option --require-arm behind it would count for nothing."""
    words = ["--ros-args", "-r", "x:=y", "--", "policy", "--require-arm", "--ros-args", "-p", "a:=b"]
    assert split_ros_arguments(words) == (["policy", "--require-arm"], ["--ros-args", "-r", "x:=y", "-p", "a:=b"])
    assert split_ros_arguments(["a", "--", "-b"]) == (["a", "--", "-b"], [])


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_full_disk_ends_the_recording_with_its_cause_and_keeps_what_was_written(tmp_path, capsys):
    writer = TrialWriter(tmp_path, "full")
    writer.odometry(0.0, (0.0, 0.0, 0.0), (0.0, 0.0))
    writer.flush()
    writer._files["command"] = open("/dev/full", "w")  # each write to it fails for want of space
    writer.command(0.1, 0.3, 0.0)
    with pytest.raises(OSError, match="No space"):
        writer.flush()
    assert not finish(writer)
    said = capsys.readouterr().err
    assert "No space left on device" in said and "Make room" in said
    (partial,) = tmp_path.glob(".full.partial-*")
    assert len((partial / "odometry.csv").read_text().splitlines()) == 2 and not (tmp_path / "trials" / "full").exists()


def test_recording_of_a_killed_recorder_is_recovered_without_its_torn_row(tmp_path, capsys):
    writer = TrialWriter(tmp_path, "killed_1")
    for i in range(3):
        writer.odometry(i * 0.1, (i * 0.05, 0.0, 0.0), (0.5, 0.0), stamp=100 + i * 0.1)
    writer.flush()
    (partial,) = tmp_path.glob(".killed_1.partial-*")
    assert main(["--recover", str(tmp_path)]) == 0 and partial.exists()  # its recorder still runs
    with open(partial / "odometry.csv", "a") as file:
        file.write("0.300000,0.15")
    gone = partial.with_name(".killed_1.partial-4194304")  # above the largest number that a process can have
    partial.rename(gone)
    assert main(["--recover", str(tmp_path)]) == 0
    rows = read(tmp_path / "trials" / "killed_1" / "odometry.csv")
    assert [row["x"] for row in rows] == [0.0, 0.05, 0.1] and rows[2]["stamp"] == 100.2
    assert "recovered" in capsys.readouterr().err
    gone.mkdir()
    assert main(["--recover", str(tmp_path)]) == Exit.FAULT and "exists already" in capsys.readouterr().err


def test_recording_that_may_still_be_written_is_left_alone_and_named(tmp_path, capsys):
    TrialWriter(tmp_path, "killed_1")
    assert main(["--recover", str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert f"partial-{os.getpid()}: left alone, because a process {os.getpid()} runs" in said
    assert "no recording" not in said
    with pytest.raises(ValueError, match=r"is a recording that was killed. Make a trial of it with --recover"):
        TrialWriter(tmp_path, "killed_1")  # by a process of the same number, as in a container


def test_yaw_rate_of_an_imu_is_kept_with_its_stamps(tmp_path):
    writer = TrialWriter(tmp_path, "a")
    writer.odometry(5.0, (0.0, 0.0, 0.0), (0.0, 0.0))
    writer.imu(5.02, 0.3, stamp=77.25)
    assert read(writer.close() / "imu.csv") == [{"t": 0.02, "gyro": 0.3, "stamp": 77.25}]


@pytest.mark.parametrize("words", [["logs"], ["logs", "a", "--recover"], ["logs", "a", "--seconds", "-1"]])
def test_unfit_options_are_refused(words, capsys):
    with pytest.raises(SystemExit) as end:
        parse_arguments(words)
    assert end.value.code == 2
