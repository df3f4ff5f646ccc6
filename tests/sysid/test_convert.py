"""ROS bags and measured sets into a dataset: written with rosbags itself, read back through the loader."""

from __future__ import annotations

import re
import shutil
import socket
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import shared_folder
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.reader import zstd
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import sysid.convert as convert_module
from sysid.logs.bags.messages import CHAIR_DEFINITION, JOYSTICK_FIELDS
from sysid.logs.bags.recording import CHAIR_STATE
from sysid.logs.conversion import ConvertConfig, convert
from sysid.logs.loaders import load_any, load_whole
from sysid.logs.log import load_log, make_trial
from sysid.logs.planar import yaw_of
from sysid.logs.published.drive_norlab import load_drive
from sysid.logs.records import Command, OdometryStream, PoseStream
from sysid.logs.sources import refuse_recording
from whill_mjx.io.folders import FolderRefused

pytestmark = pytest.mark.quick
STORE = get_typestore(Stores.ROS2_JAZZY)
T0 = 1_700_000_000.0  # s, Unix time of the recordings
COMMAND, ODOMETRY, TRUTH = "/whill/controller/cmd_vel", "/whill/odom", "/ground_truth/odom"


def message(kind, **fields):
    return STORE.types[kind](**fields)


def vector(x=0.0, y=0.0, z=0.0):
    return message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def header(t):
    stamp = message("builtin_interfaces/msg/Time", sec=int(t), nanosec=int(round((t % 1) * 1e9)) % 1_000_000_000)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id="odom")


def twist(v, omega):
    return message("geometry_msgs/msg/Twist", linear=vector(v), angular=vector(z=omega))


def pose(x, y, yaw, scale=1.0):
    return message("geometry_msgs/msg/Pose", position=message("geometry_msgs/msg/Point", x=x, y=y, z=0.3),
                   orientation=message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=scale * np.sin(yaw / 2),
                                       w=scale * np.cos(yaw / 2)))


def odometry(t, x, y, yaw, v, omega, scale=1.0):
    blank = np.zeros(36)
    return message(
        "nav_msgs/msg/Odometry", header=header(t), child_frame_id="base_link",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose(x, y, yaw, scale), covariance=blank),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist(v, omega), covariance=blank))


def motion(t):
    """A drive from 2 to 8 s at 0.5 m/s and 1 rad/s, another from 14 to 18 s backwards: v, omega, x, y, yaw."""
    forward, back = np.clip(t - 2, 0, 6), np.clip(t - 14, 0, 4)
    going, backing = (t >= 2) & (t < 8), (t >= 14) & (t < 18)
    v, omega = 0.5 * going - 0.4 * backing, 1.0 * going + 0.0 * t
    yaw = forward
    x = 0.5 * np.sin(yaw) - 0.4 * back * np.cos(6.0)
    y = 0.5 * (1 - np.cos(yaw)) - 0.4 * back * np.sin(6.0)
    return v, omega, x, y, yaw


def write_bag(folder, storage=StoragePlugin.SQLITE3, topics=(COMMAND, ODOMETRY, TRUTH), stamped=False, late=0.03,
              edit=None, truth_kind="nav_msgs/msg/Odometry", end=21.0):
    """A recording of `motion`: commands at 10 Hz, odometry at 20 Hz from (3, 1, 2 rad), outside pose at 10 Hz.

    `late` is how much later than its header a message is received.
    """
    command_topic, odometry_topic, truth_topic = topics
    kind = "geometry_msgs/msg/TwistStamped" if stamped else "geometry_msgs/msg/Twist"
    rows = []
    for t in np.arange(0.0, end, 0.1):
        v, omega, *_ = (float(value) for value in motion(t))
        command = twist(v, omega)
        rows.append((t, command_topic, kind, message(kind, header=header(T0 + t), twist=command) if stamped
                     else command))
    cos, sin = np.cos(2.0), np.sin(2.0)
    for t in np.arange(0.01, end, 0.05):
        v, omega, x, y, yaw = (float(value) for value in motion(t))
        rows.append((t + late, odometry_topic, "nav_msgs/msg/Odometry", odometry(
            T0 + t, 3 + cos * x - sin * y, 1 + sin * x + cos * y, yaw + 2.0, v, omega, scale=3.0)))
    for t in np.arange(0.02, end, 0.1):
        v, omega, x, y, yaw = (float(value) for value in motion(t))
        if truth_kind == "geometry_msgs/msg/PoseStamped":
            seen = message(truth_kind, header=header(T0 + t), pose=pose(x, y, yaw))
        else:
            seen = odometry(T0 + t, x, y, yaw, v, omega)
        rows.append((t + late, truth_topic, truth_kind, seen))
    rows = [row for row in sorted(rows, key=lambda row: row[0]) if row[1]]
    if edit:
        rows = edit(rows)
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        connections = {one: writer.add_connection(*one, typestore=STORE) for one in {(row[1], row[2]) for row in rows}}
        for t, topic, kind, content in rows:
            writer.write(connections[topic, kind], int(round((T0 + t) * 1e9)), STORE.serialize_cdr(content, kind))
    return folder


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bags") / "figure_1")


def test_files_that_metadata_does_not_name_are_read_without_it(bag, tmp_path):
    folder = shutil.copytree(bag, tmp_path / "drive")
    next(folder.glob("*.db3")).rename(folder / "other.db3")
    log, notes = convert(ConvertConfig(folder, tmp_path / "data"))
    assert len(log.trials) == 1 and any("what is in other.db3 is read without it" in note for note in notes)


def test_topics_that_may_be_meant_are_asked_for_and_speeds_to_the_side_are_named(tmp_path):
    bag = write_bag(tmp_path / "drive", topics=("/nav/cmd_vel", ODOMETRY, TRUTH), edit=lambda rows: [
        *rows, *((t, "/joy/cmd_vel", kind, message(kind, linear=vector(y=0.3), angular=vector()))
                 for t, topic, kind, _ in rows if topic == "/nav/cmd_vel")])
    with pytest.raises(ValueError, match="any of /joy/cmd_vel, /nav/cmd_vel may be the commands .* --command-topic"):
        convert(ConvertConfig(bag, tmp_path / "data"))
    _, notes = convert(ConvertConfig(bag, tmp_path / "data", command_topic="/joy/cmd_vel"))
    assert any("up to 0.3 m/s sideways" in note for note in notes)


def test_a_topic_of_two_types_is_named_with_both(tmp_path):
    def both(rows):
        kind = "geometry_msgs/msg/TwistStamped"
        return rows + [(t, topic, kind, message(kind, header=header(T0 + t), twist=content))
                       for t, topic, _, content in rows if topic == COMMAND]

    with pytest.raises(ValueError, match=f"{COMMAND} has messages of Twist and TwistStamped, .*--command-topic"):
        convert(ConvertConfig(write_bag(tmp_path / "bag", edit=both), tmp_path / "data"))


@pytest.mark.parametrize("topic", [ODOMETRY, TRUTH])
@pytest.mark.parametrize("child", ["base_footprint", "base_link"])
def test_of_two_nodes_that_send_on_one_topic_one_is_taken_or_they_are_named(tmp_path, topic, child):
    def doubled(rows):
        more = []
        for t, name, kind, one in rows:
            if name == topic:
                place = one.pose.pose.position
                other = odometry(T0 + t, place.x + 0.3, place.y - 0.2, 0.0, one.twist.twist.linear.x, 0.0)
                other.pose.pose.orientation = one.pose.pose.orientation
                other.twist.twist.angular.z, other.child_frame_id = one.twist.twist.angular.z, child
                more.append((t + 0.02, name, kind, other))
        return sorted([*rows, *more[3:]], key=lambda row: row[0])

    log, notes = convert(ConvertConfig(write_bag(tmp_path / "drive", edit=doubled, late=0.0), tmp_path / "data"))
    alone, _ = convert(ConvertConfig(write_bag(tmp_path / "alone", late=0.0), tmp_path / "data_alone"))
    stream = "odometry" if topic == ODOMETRY else "ground_truth"
    if child == "base_link":
        assert any(f"{stream}: in 1 of 1 trials" in one and "take turns between two poses 0.3" in one for one in notes)
        return
    assert any(f"{topic}: messages in the frames 'odom to base_footprint' (" in note for note in notes)
    for mine, theirs in zip(log.trials, alone.trials, strict=True):
        np.testing.assert_allclose(getattr(mine, stream).x, getattr(theirs, stream).x, atol=1e-6)


def test_joint_states_beside_commands_are_the_odometry(tmp_path):
    kind = "sensor_msgs/msg/JointState"

    def wheels(rows):
        made = [row for row in rows if row[1] == COMMAND]
        for t in np.arange(0.0, 21.0, 0.05):
            v, omega, *_ = motion(t)
            made.append((t, "/joint_states", kind, message(
                kind, header=header(T0 + t), name=["left_wheel", "right_wheel"], position=np.zeros(0),
                velocity=np.array([v - omega * 0.08, v + omega * 0.08]) / 0.033, effort=np.zeros(0))))
        return sorted(made, key=lambda row: row[0])

    bag = write_bag(tmp_path / "drive", edit=wheels)
    log, _ = convert(ConvertConfig(bag, tmp_path / "data", wheel_radius=0.033, track=0.16))
    odometry = log.trials[0].odometry
    assert odometry.v.max() == pytest.approx(0.5, abs=1e-3) and odometry.yaw.max() == pytest.approx(6.0, abs=0.1)


@pytest.mark.parametrize(("position", "gone", "said"), [
    (np.zeros(0), [100], "1 messages with numbers that are not finite"),
    (np.zeros(2), [100, 101, 102], "3 messages with numbers that are not finite"),
    (None, range(1, 420), ""),
    (None, None, ""),
])
def test_joint_states_without_rates_are_left_out_or_their_angles_are_taken(tmp_path, position, gone, said):
    kind, empty = "sensor_msgs/msg/JointState", np.zeros(0)

    def wheels(rows):
        made, angle = [row for row in rows if row[1] == COMMAND], np.zeros(2)
        for k, t in enumerate(np.arange(0.0, 21.0, 0.05)):
            v, omega, *_ = motion(t)
            rates = np.array([v - omega * 0.08, v + omega * 0.08]) / 0.033
            angle = angle + 0.05 * rates
            made.append((t, "/joint_states", kind, message(
                kind, header=header(T0 + t), name=["left_wheel", "right_wheel"], effort=empty,
                position=angle if position is None else position,
                velocity=np.zeros(2) if gone is None else rates + (np.nan if k in gone else 0.0))))
            made.append((t + 0.01, "/joint_states", kind, message(
                kind, header=header(T0 + t), name=["arm"], position=np.zeros(1), velocity=np.zeros(1), effort=empty)))
        return sorted(made, key=lambda row: row[0])

    bag = write_bag(tmp_path / "drive", edit=wheels)
    log, notes = convert(ConvertConfig(bag, tmp_path / "data", wheel_radius=0.033, track=0.16))
    odometry = log.trials[0].odometry
    moving = (odometry.t > 2.5) & (odometry.t < 7.5)
    np.testing.assert_allclose(odometry.v[moving], 0.5, atol=1e-3)
    assert len(odometry.t) == pytest.approx(420 - len(gone) if said else 420, abs=2)
    assert any("420 messages without a wheel are left out" in note for note in notes)
    assert any(said in note for note in notes) if said else not any("not finite" in note for note in notes)


def test_angles_of_wheels_that_came_in_bursts_are_differenced_over_their_header_stamps(tmp_path):
    kind, empty = "sensor_msgs/msg/JointState", np.zeros(0)

    def wheels(rows):
        made, angle = [row for row in rows if row[1] == COMMAND], np.zeros(2)
        for k, t in enumerate(np.arange(0.0, 21.0, 0.05)):
            v, omega, *_ = motion(t)
            angle = angle + 0.05 * np.array([v - omega * 0.08, v + omega * 0.08]) / 0.033
            received = 0.5 * np.ceil((t + 0.01) / 0.5) + 1e-4 * (k % 10)
            made.append((received, "/joint_states", kind, message(
                kind, header=header(T0 + t), name=["left_wheel", "right_wheel"], position=angle, velocity=empty,
                effort=empty)))
        return sorted(made, key=lambda row: row[0])

    bag = write_bag(tmp_path / "drive", edit=wheels)
    log, _ = convert(ConvertConfig(bag, tmp_path / "data", wheel_radius=0.033, track=0.16, stamp="header"))
    odometry = log.trials[0].odometry
    moving = (odometry.t > 2.5) & (odometry.t < 7.5)
    np.testing.assert_allclose(odometry.v[moving], 0.5, atol=1e-3)
    assert odometry.yaw[moving][-1] == pytest.approx(5.4, abs=0.2)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_a_bag_becomes_a_trial_that_the_loader_accepts(tmp_path, storage):
    write_bag(tmp_path / "circle_1", storage)
    log, notes = convert(ConvertConfig(tmp_path / "circle_1", tmp_path / "log"))
    (trial,) = log.trials
    assert (trial.name, trial.manoeuvre) == ("circle_1", "circle")
    assert any(COMMAND in note for note in notes)
    t = trial.odometry.t
    assert np.median(np.diff(t)) == pytest.approx(0.05, abs=1e-3)
    origin = 0.05  # s into the recording: the later of the first odometry and outside pose received, both 30 ms late
    v, omega, x, y, yaw = motion(t + origin - 0.03)
    for found, expected in ((trial.odometry.v, v), (trial.odometry.omega, omega), (trial.odometry.x, x),
                            (trial.odometry.y, y), (trial.odometry.yaw, yaw)):
        np.testing.assert_allclose(found, expected, atol=1e-4)
    np.testing.assert_allclose(trial.ground_truth.yaw, motion(trial.ground_truth.t + origin - 0.03)[4], atol=1e-4)
    assert trial.command.t[0] == 0.0 and trial.command.v[0] == 0.0
    start = trial.command.t[np.flatnonzero(trial.command.v)[0]]
    assert start == pytest.approx(2.0 - origin, abs=1e-3)
    assert log.spec.wheel_radius == 0.1325


def test_the_same_command_goes_on_after_a_conversion_that_was_killed(bag, tmp_path):
    out = tmp_path / "log"
    (out / f".partial-{socket.gethostname()}-{2**22 + 1}" / "trials" / "figure_1").mkdir(parents=True)
    (out / ".lock").write_text("{}")
    convert_module.main(ConvertConfig(bag, out))
    assert sorted(path.name for path in out.iterdir()) == [".lock", "dataset.toml", "trials"]
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "todo.txt").write_text("mine")
    with pytest.raises(FolderRefused, match="holds other files, and no dataset.toml"):
        convert_module.main(ConvertConfig(bag, tmp_path / "notes"))


@pytest.mark.parametrize(("here", "given"), [("circle_1", "."), ("circle_1/below", "..")])
def test_a_recording_is_called_after_its_folder_also_where_that_is_the_current_one(tmp_path, monkeypatch, here, given):
    write_bag(tmp_path / "circle_1")
    (tmp_path / here).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / here)
    log, _ = convert(ConvertConfig(Path(given), tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["circle_1"]
    monkeypatch.chdir(tmp_path / "log")
    assert load_any(".").name == "log"


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_a_bag_file_without_its_folder_is_read_too(tmp_path, suffix):
    storage = StoragePlugin.MCAP if suffix == ".mcap" else StoragePlugin.SQLITE3
    (source,) = write_bag(tmp_path / "bag", storage).glob(f"*{suffix}")
    shutil.copy(source, tmp_path / f"drive{suffix}")
    log, _ = convert(ConvertConfig(tmp_path / f"drive{suffix}", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["drive"]


def test_header_stamps_undo_the_delay_of_receipt(bag, tmp_path):
    log, notes = convert(ConvertConfig(bag, tmp_path / "log", stamp="header"))
    t = log.trials[0].odometry.t
    np.testing.assert_allclose(log.trials[0].odometry.v, motion(t + 0.02)[0], atol=1e-4)
    assert any("commands have no header" in note for note in notes)


def test_what_a_stream_that_covers_little_costs_the_others_is_noted(bag, tmp_path):
    short = write_bag(tmp_path / "drive", edit=lambda rows: [row for row in rows if row[1] != TRUTH or row[0] > 13])
    log, notes = convert(ConvertConfig(short, tmp_path / "log"))
    assert log.trials[0].duration < 9
    (said,) = [note for note in notes if TRUTH in note and "covers" in note]
    assert re.search(r"covers 13.* to 2.* s of 2.* s.*--truth-topic ''", said)
    log, notes = convert(ConvertConfig(short, tmp_path / "whole", truth_topic=""))
    assert log.trials[0].duration > 20 and not any("covers" in note for note in notes)
    for split in ("bag", "standstill"):
        _, notes = convert(ConvertConfig(bag, tmp_path / split, split=split))
        assert not any("covers" in note for note in notes)


def test_drives_are_split_at_standstill(bag, tmp_path):
    log, notes = convert(ConvertConfig(bag, tmp_path / "log", split="standstill", held_out=("figure_1-02",)))
    assert [trial.name for trial in log.trials] == ["figure_1-01", "figure_1-02"]
    assert [trial.name for trial in log.held_out] == ["figure_1-02"]
    first, second = log.trials
    for trial, moving in ((first, 6.0), (second, 4.0)):
        told = np.flatnonzero((np.abs(trial.command.v) > 0) | (np.abs(trial.command.omega) > 0))
        assert trial.command.t[told[0]] == pytest.approx(2.0, abs=0.15)
        assert trial.command.t[told[-1] + 1] - trial.command.t[told[0]] == pytest.approx(moving, abs=0.11)
        assert trial.duration == pytest.approx(moving + 4.0, abs=0.3)
    assert np.ptp(second.odometry.x) == pytest.approx(1.6, abs=0.01) and second.odometry.x[-1] < 0
    assert np.abs(second.odometry.yaw).max() < 1e-3


def test_stamped_commands_poses_and_other_names_are_read(tmp_path):
    write_bag(tmp_path / "bag", topics=("/teleop/twist", "/base/odometry", "/vrpn/chair/pose"), stamped=True,
              truth_kind="geometry_msgs/msg/PoseStamped")
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", truth_topic="/vrpn/chair/pose",
                                       truth_ahead=0.2, stamp="header"))
    assert "command is taken from /teleop/twist" in " ".join(notes)
    truth = log.trials[0].ground_truth
    v, omega, x, y, yaw = motion(truth.t + 0.02)
    np.testing.assert_allclose(truth.x, x - 0.2 * np.cos(yaw), atol=1e-4)
    np.testing.assert_allclose(truth.y, y - 0.2 * np.sin(yaw), atol=1e-4)


def test_outside_pose_is_never_guessed_and_can_be_left_out(bag, tmp_path):
    write_bag(tmp_path / "bag", topics=(COMMAND, ODOMETRY, "/second/odom"))
    log, _ = convert(ConvertConfig(tmp_path / "bag", tmp_path / "a"))
    assert log.trials[0].ground_truth is None
    log, _ = convert(ConvertConfig(bag, tmp_path / "b", truth_topic=""))
    assert log.trials[0].ground_truth is None and log.trials[0].odometry is not None


TRUTHS = ("/robot/ground_truth/state", "/base_pose_ground_truth", "/robot/odom_gt", "/true_odom")
TRACKED = ("/mocap/rigid_body/odom", "/OptiTrack/robot")


@pytest.mark.parametrize(("truth", "own"), [*((one, "/robot/odom") for one in TRUTHS),
                                            *((one, "") for one in (*TRUTHS, *TRACKED))])
def test_a_topic_whose_name_says_truth_is_never_the_vehicles_odometry(tmp_path, truth, own):
    bag = write_bag(tmp_path / "bag", topics=("/robot/cmd_vel", own, truth))
    log, notes = convert(ConvertConfig(bag, tmp_path / "log"))
    (trial,) = log.trials
    assert any(f"ground_truth is taken from {truth}" in note and "--truth-topic ''" in note for note in notes)
    assert trial.ground_truth.x[0] == pytest.approx(0.0, abs=0.02)  # the odometry's own begins at 3 m
    assert any(f"odometry is taken from {own}" in note for note in notes) if own else trial.odometry is None


@pytest.mark.parametrize("tracked", TRACKED)
def test_a_tracked_body_beside_the_vehicles_odometry_may_be_another_one_and_is_not_taken_unasked(tmp_path, tracked):
    bag = write_bag(tmp_path / "bag", topics=("/robot/cmd_vel", "/robot/odom", tracked))
    log, notes = convert(ConvertConfig(bag, tmp_path / "log"))
    assert log.trials[0].ground_truth is None and log.trials[0].odometry is not None
    assert any(f"{tracked} may be one: --truth-topic {tracked}" in note for note in notes)


def test_a_namespace_that_says_truth_hides_no_commands(tmp_path):
    bag = write_bag(tmp_path / "bag", topics=("/gt/cmd_vel", "", "/gt/odom"))
    log, _ = convert(ConvertConfig(bag, tmp_path / "log"))
    assert log.trials[0].ground_truth is not None and np.ptp(log.trials[0].command.v) > 0


def test_of_several_topics_that_say_truth_none_is_taken_unasked_and_the_first_can_be_named(tmp_path):
    def second(rows):
        return [*rows, *((t, "/vicon/wall/odom", kind, one) for t, topic, kind, one in rows if topic == "/gt/odom")]

    bag = write_bag(tmp_path / "bag", topics=("/robot/cmd_vel", "/robot/odom", "/gt/odom"), edit=second)
    log, notes = convert(ConvertConfig(bag, tmp_path / "log"))
    assert log.trials[0].odometry is not None and log.trials[0].ground_truth is None
    assert any("/gt/odom, /vicon/wall/odom may be one: --truth-topic /gt/odom" in note for note in notes)
    log, _ = convert(ConvertConfig(bag, tmp_path / "named", odometry_topic="/gt/odom", truth_topic=""))
    assert log.trials[0].odometry is not None and log.trials[0].ground_truth is None


def test_a_name_that_only_contains_the_letters_of_truth_says_nothing(tmp_path):
    bag = write_bag(tmp_path / "bag", topics=("/robot/cmd_vel", "/length/odom", ""))
    log, _ = convert(ConvertConfig(bag, tmp_path / "log"))
    assert log.trials[0].odometry is not None and log.trials[0].ground_truth is None


def test_bags_of_one_folder_are_trials_and_can_be_added_later(bag, tmp_path):
    source = tmp_path / "bags"
    for name in ("figure_2", "figure_3"):
        shutil.copytree(bag, source / name)
    convert(ConvertConfig(bag, tmp_path / "log"))
    log, _ = convert(ConvertConfig(source, tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["figure_1", "figure_2", "figure_3"]
    _, notes = convert(ConvertConfig(source, tmp_path / "log"))  # as after a kill
    assert "figure_3 is there already, with the same contents" in notes
    (tmp_path / "log" / "trials" / "figure_2" / "odometry.csv").unlink()
    with pytest.raises(ValueError, match="figure_2: exists already, with other contents"):
        convert(ConvertConfig(source, tmp_path / "log"))
    assert not list(tmp_path.glob(".*partial*"))


def test_messages_out_of_order_or_not_finite_are_left_out_and_counted(tmp_path):
    def edit(rows):
        rows = [list(row) for row in rows]
        at = [k for k, row in enumerate(rows) if row[1] == ODOMETRY]
        rows[at[100]][3] = odometry(T0 + 5.0, np.nan, 0.0, 0.0, 0.0, 0.0)
        rows[at[50]][3] = odometry(T0 + 2.4, 0.0, 0.0, 0.0, 0.0, 0.0)  # stamped before its forerunner
        return rows

    write_bag(tmp_path / "bag", edit=edit)
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", stamp="header"))
    text = " ".join(notes)
    assert "1 messages with numbers that are not finite" in text and "odometry: 1 messages out of order" in text
    assert len(log.trials[0].odometry.t) >= 415


def drop(topic, keep=0):
    def edit(rows):
        mine = [row for row in rows if row[1] == topic]
        return [row for row in rows if row[1] != topic or any(row is one for one in mine[:keep])]
    return edit


def set_clock_back(rows):
    return [(t, topic, kind, odometry(T0 + t - 9.0 * (t > 10), 0.0, 0.0, 0.0, 0.0, 0.0) if topic == ODOMETRY else one)
            for t, topic, kind, one in rows]


def receive_at(clock, topics=(COMMAND, ODOMETRY, TRUTH)):
    """Rows received when a clock says: messages of some topics at other times than they were."""
    def edit(rows):
        return sorted([(float(clock(row[0])) if row[1] in topics else row[0], *row[1:]) for row in rows],
                      key=lambda row: row[0])
    return edit


def zero_quaternion(rows):
    return [(t, topic, kind, odometry(T0 + t, 0, 0, 0, 0, 0, scale=0.0) if topic == ODOMETRY else one)
            for t, topic, kind, one in rows]


def zero_stamps(rows):
    return [(t, topic, kind, odometry(0.0, 0, 0, 0, 0, 0) if topic == ODOMETRY else one)
            for t, topic, kind, one in rows]


@pytest.mark.parametrize(("edit", "options", "rule"), [
    (drop(COMMAND), {"input": "commands"}, r"no command topic found \(topics with messages: .*--command-topic"),
    (drop(ODOMETRY, 1), {}, "topic /whill/odom has 1 usable messages.*--odometry-topic"),
    (None, {"odometry_topic": "/nowhere"}, "no topic '/nowhere'.*Correct --odometry-topic"),
    (None, {"command_topic": ODOMETRY}, "/whill/odom is nav_msgs/msg/Odometry; command must be"),
    (None, {"odometry_topic": "", "truth_topic": ""}, "neither odometry nor outside pose"),
    (set_clock_back, {"stamp": "header"}, "header's clock of /whill/odom was set back by .* Use --stamp receive"),
    (zero_quaternion, {}, "topic /whill/odom: the orientation is all zero"),
    (receive_at(lambda t: 0.0), {}, "all 120 messages have one time of receipt: .* record them again"),
    (zero_stamps, {"stamp": "header"}, "topic /whill/odom: all header stamps are zero. Use --stamp receive"),
    (None, {"held_out": ("eight_1",)}, "--held-out eight_1: no such trial"),
    (None, {"vehicle": "my chair"}, "--vehicle my chair: not built in .*--wheel-radius"),
])
def test_errors_name_file_topic_rule_and_remedy(tmp_path, edit, options, rule):
    write_bag(tmp_path / "bag", edit=edit, end=12.0)
    with pytest.raises(ValueError, match=rule):
        convert(replace(ConvertConfig(tmp_path / "bag", tmp_path / "log"), **options))
    assert not (tmp_path / "log" / "trials").exists()


def test_damaged_messages_and_stray_times_are_left_out_and_counted(bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.db3")
    with sqlite3.connect(file) as content:
        content.execute("update messages set data = x'0001' where id in (40, 41, 42, 43)")
        content.execute("update messages set timestamp = 0 where id = 60")
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))
    assert sum(int(re.search(r": (\d+) damaged messages", note)[1]) for note in notes if "damaged" in note) == 4
    assert sum("1 messages whose time is more than a day from the others'" in note for note in notes) == 1
    assert log.trials[0].duration > 20.0


def test_a_damaged_bag_is_refused_by_its_name(bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.db3")
    file.write_bytes(file.read_bytes()[:3000])
    with pytest.raises(ValueError, match="bag: cannot be read as a ROS bag"):
        convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))


def test_heading_of_a_quaternion_of_any_length_and_tilt():
    assert yaw_of(2 * np.cos(0.6), 0.0, 0.0, 2 * np.sin(0.6)) == pytest.approx(1.2)
    assert yaw_of(-np.cos(0.6), 0.0, 0.0, -np.sin(0.6)) == pytest.approx(1.2)
    half = np.sqrt(0.5)  # tilted a little about the vehicle's own axis after turning by 90 degrees
    tilt = (half * np.cos(0.05), half * np.sin(0.05), half * np.sin(0.05), half * np.cos(0.05))
    assert yaw_of(*tilt) == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(("told", "reported", "start"), [(0.0, 0.4, 0.0), (0.5, 0.4, 0.4), (0.5, 0.01, 0.0),
                                                         (0.5, None, 0.5)])
def test_a_trial_whose_first_command_moves_starts_in_motion(told, reported, start):
    t = np.arange(5) * 0.1
    stream = None if reported is None else OdometryStream(t, 0 * t, 0 * t, 0 * t, np.full(5, reported), 0 * t)
    trial = make_trial("x", Command(t, np.full(5, told), 0 * t), stream, PoseStream(t, 0 * t, 0 * t, 0 * t))
    assert trial.start.v == start and trial.start.omega == 0.0


def test_a_measured_run_converts_with_its_moving_starts(tmp_path):
    run = "warthog_grass_2024_07_18_continuous"
    source = shared_folder("drive_norlab")
    log, notes = convert(ConvertConfig(source, tmp_path / "log", select=(run,)))
    original = load_drive(source, (run,), chained=True).trials
    assert len(log.trials) == len(original) and "dead reckoned" in " ".join(notes)
    assert log.spec.drive == "skid" and log.spec.track == original[0].command.v.dtype.type(1.08)
    moving = [(mine, theirs) for mine, theirs in zip(log.trials, original, strict=True)
              if abs(theirs.start.v) > 0.05 and abs(theirs.command.v[0]) > 1e-6]
    assert moving
    for mine, theirs in moving:
        assert mine.start.v == pytest.approx(theirs.start.v, abs=1e-5)
        np.testing.assert_allclose(mine.ground_truth.x[-len(theirs.ground_truth.x):], theirs.ground_truth.x, atol=1e-5)


def test_a_source_that_does_not_exist_ends_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["convert", str(tmp_path / "x.mcap"), "--out", str(tmp_path / "log")])
    with pytest.raises(SystemExit, match="error: .*x.mcap: does not exist"):
        convert_module.cli()


def test_a_folder_without_any_recording_is_refused(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="empty: no dataset.toml"):
        convert(ConvertConfig(tmp_path / "empty", tmp_path / "log"))


def test_a_converted_dataset_is_itself_convertible(bag, tmp_path):
    first, _ = convert(ConvertConfig(bag, tmp_path / "a"))
    again, _ = convert(ConvertConfig(tmp_path / "a", tmp_path / "b"))
    np.testing.assert_allclose(again.trials[0].odometry.x, first.trials[0].odometry.x, atol=2e-6)
    assert load_log(tmp_path / "b").spec.track == first.spec.track


def test_a_bag_joins_a_dataset_that_the_recorder_began(bag, tmp_path):
    from bridge.record import parse_arguments
    from bridge.recording.dataset_file import write_dataset_file
    from bridge.recording.trial_writer import TrialWriter

    folder = tmp_path / "log"
    writer = TrialWriter(folder, "straight_1")
    write_dataset_file(folder, parse_arguments([str(folder), "straight_1"]))
    for t in np.arange(0.0, 4.0, 0.05):
        writer.command(t, 0.5 * (t > 1), 0.0)
        writer.odometry(t, (0.5 * max(t - 1, 0), 0.0, 0.0), (0.5 * (t > 1), 0.0))
    writer.close()
    log, _ = convert(ConvertConfig(bag, folder))
    assert [trial.name for trial in log.trials] == ["figure_1", "straight_1"]
    assert log.spec.name == "WHILL Model CR"


def test_messages_before_the_first_orientation_are_left_out_and_counted(tmp_path):
    def edit(rows):
        first = next(k for k, row in enumerate(rows) if row[1] == ODOMETRY)
        blank = odometry(T0, 0.0, 0.0, 0.0, 0.0, 0.0, scale=0.0)
        return [*rows[:first], (*rows[first][:3], blank), *rows[first + 1:]]

    write_bag(tmp_path / "bag", edit=edit)
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))
    assert "/whill/odom: 1 messages with an orientation that is all zero are left out" in notes[0]
    assert len(log.trials[0].odometry.t) >= 415


def test_one_bag_that_cannot_be_used_does_not_keep_the_others_out(bag, tmp_path):
    source = tmp_path / "bags"
    shutil.copytree(bag, source / "figure_1")
    write_bag(source / "parked_1", edit=drop(COMMAND))
    (source / "torn_1.mcap").write_bytes(b"no bag")
    log, notes = convert(ConvertConfig(source, tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["figure_1"]
    left_out = [note for note in notes if note.startswith("left out: ")]
    assert len(left_out) == 2 and "no command topic" in left_out[0] and "torn_1.mcap" in left_out[1]


def too_far(rows):
    return [(t, topic, kind, odometry(T0 + t, 1e3 * t, 0.0, 0.0, 0.0, 0.0) if topic == ODOMETRY else one)
            for t, topic, kind, one in rows]


def test_a_refused_trial_is_not_written_and_a_second_call_works(bag, tmp_path):
    write_bag(tmp_path / "bags" / "far_1", edit=too_far)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"log/trials/far_1/odometry.csv: x spans .*Nothing was written"):
            convert(ConvertConfig(tmp_path / "bags", tmp_path / "log"))
        assert not (tmp_path / "log").exists() and not list(tmp_path.glob(".*partial*"))
    shutil.copytree(bag, tmp_path / "bags" / "figure_1")
    with pytest.raises(ValueError, match="far_1 is held out, but .* spans"):
        convert(ConvertConfig(tmp_path / "bags", tmp_path / "log", held_out=("far_1",)))
    log, notes = convert(ConvertConfig(tmp_path / "bags", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["figure_1"]
    assert any("left out" in note and "far_1" in note for note in notes)


def test_fields_that_the_loader_refuses_are_never_written(bag, tmp_path):
    with pytest.raises(ValueError, match="wheel_radius"):
        convert(ConvertConfig(bag, tmp_path / "log", wheel_radius=-0.1))
    assert not (tmp_path / "log").exists()
    convert(ConvertConfig(bag, tmp_path / "log"))


def test_a_bag_whose_recorder_was_killed_is_read_by_the_name_of_its_folder(bag, tmp_path):
    (file,) = bag.glob("*.db3")
    (tmp_path / "circle_1").mkdir()
    shutil.copy(file, tmp_path / "circle_1" / "circle_1_0.db3")
    log, _ = convert(ConvertConfig(tmp_path / "circle_1", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["circle_1"]
    (tmp_path / "packed").mkdir()
    packed = tmp_path / "packed" / "packed_0.db3.zstd"
    packed.write_bytes(zstd.compress(file.read_bytes()))
    log, _ = convert(ConvertConfig(tmp_path / "packed", tmp_path / "packed_log"))
    assert [trial.name for trial in log.trials] == ["packed"]
    packed.write_bytes(b"(")
    with pytest.raises(ValueError, match=r"packed_0.db3.zstd: cannot be unpacked .*zstd -d"):
        convert(ConvertConfig(tmp_path / "packed", tmp_path / "other"))


@pytest.mark.parametrize(("name", "trials"), [("circle_2/circle_2_0.db3", ["circle_1", "circle_2"]),
                                              ("old/failed.db3", ["circle_1"])])
def test_a_recording_that_was_killed_is_read_beside_those_that_were_closed(bag, tmp_path, name, trials):
    shutil.copytree(bag, tmp_path / "bags" / "circle_1")
    killed = tmp_path / "bags" / name
    killed.parent.mkdir()
    shutil.copy(next(bag.glob("*.db3")), killed)
    (tmp_path / "bags" / "photos").mkdir()
    log, _ = convert(ConvertConfig(tmp_path / "bags", tmp_path / "log"))
    assert [one.name for one in log.trials] == trials


def test_recordings_that_were_all_killed_are_read_by_the_names_of_their_folders(bag, tmp_path):
    for name in ("circle_1", "circle_2"):
        (tmp_path / "bags" / name).mkdir(parents=True)
        shutil.copy(next(bag.glob("*.db3")), tmp_path / "bags" / name / f"{name}_0.db3")
    log, _ = convert(ConvertConfig(tmp_path / "bags", tmp_path / "log"))
    assert [trial.name for trial in log.trials] == ["circle_1", "circle_2"]


TUM = "# timestamp tx ty tz qx qy qz qw\n" + "1.0 0.1 0.2 0 0 0 0 1\n" * 3


@pytest.fixture
def given(bag, tmp_path):
    """Files and folders that people have, by name."""
    (tmp_path / "bags").mkdir()
    shutil.copytree(bag, tmp_path / "bags" / "figure_1")
    (file,) = bag.glob("*.db3")
    shutil.copy(file, tmp_path / "drive.db3")
    (tmp_path / "poses.txt").write_text(TUM)
    (tmp_path / "wheels.csv").write_text("\ufefftime,left,right\n1,2,3\n")
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "poses.txt").write_text(TUM)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "report.json").write_text("{}")
    (tmp_path / "run" / "series.npz").write_bytes(b"")
    (tmp_path / "world.sdf").write_text("<sdf/>")
    (tmp_path / "strangers").mkdir()
    (tmp_path / "strangers" / "odometry.csv").write_text("time,x,y\n0,0,0\n")
    convert(ConvertConfig(bag, tmp_path / "log"))
    return tmp_path


@pytest.mark.parametrize(("name", "said"), [
    ("bags", r"a folder of ROS bags \(figure_1\). Convert it first: python -m sysid.convert"),
    ("bags/figure_1", "a ROS bag. Convert it first: python -m sysid.convert"),
    ("drive.db3", "a ROS bag. Convert it first: python -m sysid.convert"),
    ("poses.txt", "a trajectory in TUM form .* commands or wheel speeds, then: python -m sysid.convert"),
    ("texts", r"a folder of text files \(poses.txt\), not a dataset. Convert it first"),
    ("wheels.csv", "a text file with the columns time, left, right. Convert it first: python -m sysid.convert"),
    ("run", "the folder of a fit. Give the folder of the dataset"),
    ("log/trials/figure_1", "one trial, not a dataset. Give the folder that holds dataset.toml"),
    ("log/dataset.toml", "a file of a dataset. Give its folder"),
    ("log/trials/figure_1/command.csv", "one file of a trial. Give the folder of the dataset"),
    ("strangers", r"a folder of text files \(odometry.csv\), not a dataset. Convert it first"),
    ("world.sdf", "a model of Gazebo .SDF.. Give the URDF"),
    ("nowhere", "no such folder or file"),
])
def test_a_command_given_something_else_than_a_dataset_says_what_it_is_and_what_to_do(given, name, said):
    for load in (load_any, load_whole):
        with pytest.raises((ValueError, FileNotFoundError), match=f"{name}: {said}"):
            load(given / name)


@pytest.mark.parametrize("name", ["bags", "drive.db3", "poses.txt", "wheels.csv", "log", "log/trials/figure_1"])
def test_a_command_that_takes_a_vehicle_refuses_drives_by_saying_what_they_are(given, name):
    with pytest.raises(ValueError, match=f"{name}: .*Needed here: a vehicle file"):
        refuse_recording(given / name, "a vehicle file.")
    refuse_recording(given / "run", "a vehicle file.")


def restamped(clock):
    """Rows whose odometry has header stamps of another clock."""
    def edit(rows):
        def again(t, content):
            moved = T0 + float(clock(t - 0.03))
            return replace(content, header=header(moved))
        return [(t, topic, kind, again(t, one) if topic == ODOMETRY else one) for t, topic, kind, one in rows]
    return edit


def set_at(t, seconds, when=10.0):
    return t + seconds * (t > when)


@pytest.mark.parametrize("seconds", [-2.03, -0.5, -2e6, 3.0])
def test_a_recorder_whose_clock_was_set_in_the_drive_is_refused(tmp_path, seconds):
    write_bag(tmp_path / "bag", edit=receive_at(lambda t: set_at(t, seconds)))
    size = re.escape(f"{abs(seconds):.3g}")
    way = f"set {'back' if seconds < 0 else 'forward'} by {size} s, (9.9|10).* s into the recording"
    for stamp in ("receive", "header"):
        with pytest.raises(ValueError, match=f"recorder's clock was {way}.*Cut the bag there"):
            convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", stamp=stamp))
    write_bag(tmp_path / "stamped", stamped=True, edit=receive_at(lambda t: set_at(t, seconds)))
    with pytest.raises(ValueError, match="Use --stamp header"):
        convert(ConvertConfig(tmp_path / "stamped", tmp_path / "log"))
    log, notes = convert(ConvertConfig(tmp_path / "stamped", tmp_path / "log", stamp="header"))
    assert any("recorder's clock was set" in note for note in notes)
    np.testing.assert_allclose(log.trials[0].odometry.v, motion(log.trials[0].odometry.t + 0.02)[0], atol=1e-4)


@pytest.mark.parametrize("seconds", [-0.45, -2e6, 3.0])
def test_header_stamps_of_a_clock_that_was_set_are_not_used(tmp_path, seconds):
    write_bag(tmp_path / "bag", edit=restamped(lambda t: set_at(t, seconds)))
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))
    assert any(f"the header's clock of {ODOMETRY} was set" in note for note in notes)
    with pytest.raises(ValueError, match="header's clock of /whill/odom was set .* Use --stamp receive"):
        convert(ConvertConfig(tmp_path / "bag", tmp_path / "again", stamp="header"))


def test_receipt_in_bursts_is_named_and_header_stamps_undo_it(tmp_path):
    write_bag(tmp_path / "bag", edit=receive_at(lambda t: 0.5 * np.ceil(t / 0.5) + 1e-3 * (t % 0.5), (ODOMETRY,)))
    _, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "a"))
    assert any("/whill/odom came in bursts" in note and "--stamp header" in note for note in notes)
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "b", stamp="header"))
    assert not any("bursts" in note for note in notes)
    assert np.diff(log.trials[0].odometry.t).max() == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize("clock", [lambda t: t, lambda t: t + 0.02 * np.sin(7 * t), lambda t: 1.0001 * t + 5.0,
                                   lambda t: t + 2.0 * np.clip(1 - (t - 6) / 2, 0, 1) * (t > 6)])
def test_clocks_that_only_differ_and_receipt_after_an_outage_are_no_set_clock(tmp_path, clock):
    write_bag(tmp_path / "bag", edit=receive_at(clock))
    _, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))
    assert not any("was set" in note for note in notes)


def test_a_tracked_body_that_was_turned_is_turned_back(bag, tmp_path):
    plain, _ = convert(ConvertConfig(bag, tmp_path / "a"))
    log, _ = convert(ConvertConfig(bag, tmp_path / "b", truth_turned=10.0))
    turn = log.trials[0].ground_truth.yaw - plain.trials[0].ground_truth.yaw
    np.testing.assert_allclose(turn, np.deg2rad(-10.0), atol=1e-5)


def test_a_bag_of_joint_states_and_an_outside_pose_has_wheel_speeds_as_its_input(tmp_path):
    def wheels(rows):
        kept = [row for row in rows if row[1] == TRUTH]
        for t in np.arange(0.0, 21.0, 0.02):
            v, omega, *_ = motion(np.array([t]))
            rates = [float(v[0] + side * 0.25 * omega[0]) / 0.1 for side in (-1, 1)]
            state = message("sensor_msgs/msg/JointState", header=header(T0 + t), name=["left_wheel", "right_wheel"],
                            position=np.zeros(2), velocity=np.array(rates), effort=np.zeros(0))
            kept.append((t, ODOMETRY, "sensor_msgs/msg/JointState", state))
        return sorted(kept, key=lambda row: row[0])

    write_bag(tmp_path / "bag", edit=wheels)
    options = {"vehicle": "rover", "wheel_radius": 0.1, "track": 0.5}
    log, _ = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", **options))
    (trial,) = log.trials
    assert log.fields["input"] == "wheels" and trial.odometry is None and trial.ground_truth is not None
    middle = int(np.searchsorted(trial.command.t, 5.0))
    assert (trial.command.v[middle], trial.command.omega[middle]) == pytest.approx((0.5, 1.0), abs=1e-4)


@pytest.mark.parametrize("joystick", [True, False])
def test_a_bag_with_the_states_of_a_chair_has_odometry(tmp_path, joystick):
    kind = f"whill_msgs/msg/{CHAIR_STATE}"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(CHAIR_DEFINITION + (JOYSTICK_FIELDS if joystick else ""), kind))
    state, twist_kind = store.types[kind], "geometry_msgs/msg/Twist"
    with Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        commands = writer.add_connection("/whill/controller/cmd_vel", twist_kind, typestore=store)
        states = writer.add_connection("/whill/states/model_cr2", kind, typestore=store)
        for t in np.arange(0.0, 12.0, 0.05):
            stamp, angle = int((T0 + t) * 1e9), 0.5 * max(t - 2.0, 0.0) / 0.1325
            speed = 0.5 * 3.6 * (t > 2.0)
            writer.write(commands, stamp, store.serialize_cdr(twist(0.5 * (t > 2.0), 0.0), twist_kind))
            fields = {"battery_power": 90, "battery_current": 1.0, "right_motor_angle": -np.angle(np.exp(1j * angle)),
                      "left_motor_angle": np.angle(np.exp(1j * angle)), "right_motor_speed": -speed,
                      "left_motor_speed": speed, "power_on": 1, "speed_mode_indicator": 0, "error": 0,
                      **({"joy_front": 0, "joy_side": 0} if joystick else {})}
            writer.write(states, stamp, store.serialize_cdr(state(**fields), kind))
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log"))
    stream = log.trials[0].odometry
    assert stream.x[-1] == pytest.approx(0.5 * (stream.t[-1] - 2.0), abs=0.01)
    assert stream.v[100] == pytest.approx(0.5, abs=1e-3) and abs(stream.omega).max() < 1e-3
    assert any("odometry from /whill/states/model_cr2" in note for note in notes)


def with_imu(rate, end=21.0, topic="/imu/data"):
    """Rows of a recording and those of a gyro at 100 Hz."""
    def add(rows):
        still = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        more = [(t + 0.03, topic, "sensor_msgs/msg/Imu", message(
            "sensor_msgs/msg/Imu", header=header(T0 + t), orientation=still, orientation_covariance=np.zeros(9),
            angular_velocity=vector(z=float(rate(t))), angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(z=9.8), linear_acceleration_covariance=np.zeros(9)))
            for t in np.arange(0.0, end, 0.01)]
        return sorted([*rows, *more], key=lambda row: row[0])
    return add


def test_the_yaw_rate_of_an_imu_becomes_the_gyro_of_a_trial(tmp_path):
    write_bag(tmp_path / "circle_1", edit=with_imu(lambda t: -motion(t)[1]))  # upside down
    log, notes = convert(ConvertConfig(tmp_path / "circle_1", tmp_path / "out"))
    (trial,) = log.trials
    assert trial.gyro.turn[-1] == pytest.approx(6.0, abs=0.05)
    assert any("imu from /imu/data" in note for note in notes)
    assert any("its sign is changed" in note for note in log.notes)


@pytest.mark.parametrize(("rate", "end"), [(lambda t: 200.0, 21.0), (lambda t: np.nan, 21.0), (lambda t: 0.0, 0.005)])
def test_a_gyro_that_cannot_be_used_does_not_cost_the_drive(tmp_path, rate, end):
    write_bag(tmp_path / "circle_1", edit=with_imu(rate, end))
    log, notes = convert(ConvertConfig(tmp_path / "circle_1", tmp_path / "out"))
    assert log.trials[0].gyro is None and any("left out" in note for note in notes)


def write_dataset(folder, fields, trials=("wh_1", "wh_2"), encoder=False):
    """A dataset of `motion`: rows at 10 Hz, with a pause of the commands from 4 to 6 s, and a gyro upside down."""
    t = np.arange(0.0, 21.0, 0.1)
    v, omega, x, y, yaw = motion(t)
    sent = (t < 4.05) | (t > 5.95)
    streams = {"command": ("t,v,omega", [t[sent], v[sent], omega[sent]]),
               "odometry": ("t,x,y,yaw,v,omega", [t, x + 3, y, yaw, v, omega]),
               "ground_truth": ("t,x,y,yaw", [t, x, y, yaw]), "imu": ("t,gyro", [t, -omega])}
    if encoder:
        streams["encoder"] = ("t,left,right,counter", [t, 0 * t, 0 * t, 0 * t])
    for name in trials:
        (folder / "trials" / name).mkdir(parents=True)
        for stream, (head, columns) in streams.items():
            np.savetxt(folder / "trials" / name / f"{stream}.csv", np.column_stack(columns), "%.6f", ",", header=head,
                       comments="")
    (folder / "dataset.toml").write_text("schema = 1\n" + "\n".join(fields) + "\n")
    return folder


def numbers(folder, stream):
    return np.loadtxt(folder / f"{stream}.csv", delimiter=",", skiprows=1)


FIELDS = ['vehicle = "small"', "wheel_radius = 0.033", "track = 0.16", 'held_out = ["wh_2"]', "command_timeout = 0.5",
          'ground_truth = "ceiling cameras"', 'columns = ["time=a/t:s"]', 'reference_point = "vehicle centre"']


@pytest.mark.parametrize("more", ['input = "commands"', 'input = "wheels"'])
def test_a_dataset_that_is_converted_keeps_its_fields_and_its_rows(tmp_path, more):
    write_dataset(tmp_path / "k1", [*FIELDS, more], encoder=True)
    before = load_log(tmp_path / "k1")
    log, _ = convert(ConvertConfig(tmp_path / "k1", tmp_path / "k2", truth_turned=10.0))
    assert log.fields == before.fields and log.spec == before.spec
    assert [trial.name for trial in log.held_out] == ["wh_2"]
    for stream in ("command", "odometry", "imu", "encoder"):
        old, new = (numbers(tmp_path / name / "trials" / "wh_1", stream) for name in ("k1", "k2"))
        np.testing.assert_array_equal(old, new)
    old, new = (numbers(tmp_path / name / "trials" / "wh_1", "ground_truth") for name in ("k1", "k2"))
    np.testing.assert_allclose(np.angle(np.exp(1j * (new[:, 3] - old[:, 3]))), np.deg2rad(-10.0), atol=1e-5)


def test_held_out_trials_of_a_dataset_may_be_stated_anew_and_follow_a_selection(tmp_path):
    write_dataset(tmp_path / "k1", FIELDS)
    log, _ = convert(ConvertConfig(tmp_path / "k1", tmp_path / "k2", held_out=("wh_1",)))
    assert [trial.name for trial in log.held_out] == ["wh_1"]
    log, _ = convert(ConvertConfig(tmp_path / "k1", tmp_path / "k3", select=("wh_1",)))
    assert [trial.name for trial in log.trials] == ["wh_1"] and not log.held_out
    _, notes = convert(ConvertConfig(tmp_path / "k1", tmp_path / "k3"))
    assert any("wh_2: held out in" in note and "Add it to held_out" in note for note in notes)


@pytest.mark.parametrize(("size", "there"), [(None, 52.0 * (0.16 / 0.496) ** 3), (2.5, 2.5)])
def test_a_robot_that_is_not_built_in_is_in_proportion_and_only_what_was_given_is_stated(bag, tmp_path, size, there):
    log, _ = convert(ConvertConfig(bag, tmp_path / "log", vehicle="small", wheel_radius=0.033, track=0.16, mass=size))
    assert log.spec.mass == pytest.approx(there) and log.spec.wheelbase == pytest.approx(0.6 * 0.16 / 0.496)
    assert ("mass" in log.fields) == (size is not None) and not {"wheelbase", "command_limits"} & set(log.fields)
    assert any("wheelbase is not in dataset.toml: 0.194 is assumed" in note for note in log.notes)


@pytest.mark.parametrize(("options", "said"), [
    ({"track": 0.5}, r"track is 0.4, and --track 0.5 differs. Leave --track out, or choose another --out"),
    ({"mass": 7.0}, r"mass is 52.0, and --mass 7.0 differs. Leave --mass out, write mass = 7 there, or choose"),
    ({"command_timeout": 0.5}, r"command_timeout is not stated, and --command-timeout 0.5 differs"),
    ({"vehicle": "husky"}, r"vehicle is whill_cr, and --vehicle husky differs"),
])
def test_an_option_that_differs_from_the_dataset_that_trials_join_is_refused(bag, tmp_path, options, said):
    given = {"wheel_radius": 0.1, "track": 0.4}
    convert(ConvertConfig(bag, tmp_path / "log", **given))
    shutil.copytree(bag, tmp_path / "figure_2")
    with pytest.raises(ValueError, match=rf"log/dataset.toml: {said}"):
        convert(replace(ConvertConfig(tmp_path / "figure_2", tmp_path / "log"), **options))
    log, _ = convert(ConvertConfig(tmp_path / "figure_2", tmp_path / "log", **given))
    assert len(log.trials) == 2


def test_wheel_speeds_that_join_a_dataset_are_read_with_its_geometry(tmp_path):
    t = np.arange(0.0, 20.0, 0.05)
    v, omega, *_ = motion(t)
    for name in ("w_1", "w_2"):
        rates = [(v + side * 0.2 * omega) / 0.1 for side in (-1, 1)]
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, v, omega, *rates]), "%.6f", ",", comments="",
                   header="time [s],cmd_v [m/s],cmd_w [rad/s],left_wheel [rad/s],right_wheel [rad/s]")
    convert(ConvertConfig(tmp_path / "w_1.csv", tmp_path / "log", wheel_radius=0.1, track=0.4))
    log, _ = convert(ConvertConfig(tmp_path / "w_2.csv", tmp_path / "log"))
    np.testing.assert_allclose(log.trials[1].odometry.omega, omega, atol=1e-4)


def test_trials_of_a_dataset_of_another_vehicle_or_time_out_do_not_join(tmp_path):
    write_dataset(tmp_path / "a", [one for one in FIELDS if "held_out" not in one], ("wh_1",))
    for name, changed, said in (("b", FIELDS[1].replace("0.033", "0.1"), "wheel_radius is 0.1"),
                                ("c", FIELDS[4].replace("0.5", "0.9"), "command_timeout is 0.9")):
        fields = [changed if one.split(" =")[0] == changed.split(" =")[0] else one for one in FIELDS]
        write_dataset(tmp_path / name, fields)
        with pytest.raises(ValueError, match=f"its {said}, and that of the new trials is 0"):
            convert(ConvertConfig(tmp_path / "a", tmp_path / name))


def unstamped(rows, *which, topic=ODOMETRY):
    """Rows whose messages of a topic have a header stamp of zero, those of the numbers `which`."""
    mine = [k for k, row in enumerate(rows) if row[1] == topic]
    chosen = {mine[k] for k in which}
    return [(*row[:3], replace(row[3], header=header(0.0))) if k in chosen else row for k, row in enumerate(rows)]


@pytest.mark.parametrize("stamp", ["receive", "header"])
def test_one_message_without_a_stamp_does_not_switch_off_the_checks_of_the_clock(tmp_path, stamp):
    def edit(rows):
        return receive_at(lambda t: set_at(t, -2.0))(unstamped(rows, 0))

    write_bag(tmp_path / "bag", topics=(COMMAND, ODOMETRY, ""), edit=edit)
    with pytest.raises(ValueError, match="recorder's clock was set back by 2 s"):
        convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", stamp=stamp))


@pytest.mark.parametrize("which", [(60,), (60, 100, 200, 201)])
def test_measurements_without_a_stamp_among_others_are_left_out_and_counted(tmp_path, which):
    write_bag(tmp_path / "bag", edit=lambda rows: unstamped(rows, *which))
    whole, _ = convert(ConvertConfig(write_bag(tmp_path / "whole"), tmp_path / "all", stamp="header"))
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", stamp="header"))
    assert any(f"{len(which)} messages with a header stamp of zero, though" in note for note in notes)
    expected = np.delete(whole.trials[0].odometry.values, [k - 1 for k in which], axis=0)  # it begins with the pose
    np.testing.assert_allclose(log.trials[0].odometry.values, expected, atol=1e-6)


def test_commands_without_a_stamp_among_others_are_kept(tmp_path):
    def edit(rows):
        return unstamped(rows, 0, 50, 80, topic=COMMAND)

    write_bag(tmp_path / "bag", stamped=True, edit=edit)
    write_bag(tmp_path / "whole", stamped=True)
    log, notes = convert(ConvertConfig(tmp_path / "bag", tmp_path / "log", stamp="header"))
    whole, _ = convert(ConvertConfig(tmp_path / "whole", tmp_path / "all", stamp="header"))
    assert any("3 messages with a header stamp of zero are stamped like those around" in note for note in notes)
    np.testing.assert_allclose(log.trials[0].command.table, whole.trials[0].command.table, atol=2e-6)
