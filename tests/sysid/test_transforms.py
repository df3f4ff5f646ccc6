"""The vehicle's pose out of /tf: chains of frames become odometry or outside pose."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from test_convert import COMMAND, ODOMETRY, T0, header, message, motion, write_bag

from sysid.logs.conversion import ConvertConfig, convert

pytestmark = pytest.mark.quick
KIND = "tf2_msgs/msg/TFMessage"


def link(t, parent, child, x=0.0, y=0.0, yaw=0.0):
    """A message with one transform; z and a tilt of what is on the vehicle do not count."""
    about = header(T0 + t)
    about.frame_id = parent
    turn = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))
    moved = message("geometry_msgs/msg/Transform", rotation=turn,
                    translation=message("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=0.1))
    return message(KIND, transforms=[message("geometry_msgs/msg/TransformStamped", header=about, child_frame_id=child,
                                             transform=moved)])


def inverse(x, y, yaw):
    return -np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x - np.cos(yaw) * y, -yaw


def bag_of_frames(folder, links, keep=(), storage=StoragePlugin.SQLITE3, unstamped=(), **named):
    """A recording with the commands of `motion`, topics to keep, and rows of transforms at 20 Hz: each a function of
    the time, the pose, which gives (parent, child, x, y, yaw) or None, and static ones of (parent, child, x, y, yaw).

    `links` are those of /tf, or by the topic of each namespace; `unstamped` are messages whose stamp is zero; `named`
    goes to `write_bag`.
    """
    def edit(rows):
        made = [row for row in rows if row[1] in (COMMAND, *keep)]
        for topic, ones in (links if isinstance(links, dict) else {"/tf": links}).items():
            for k, t in enumerate(np.arange(0.01, 21.0, 0.05)):
                for one in ones:
                    if callable(one) and (found := one(k, t, *motion(t)[2:])) is not None:
                        made.append((t + 0.02, topic, KIND, link(-T0 if k in unstamped else t, *found)))
            made += [(0.0, f"{topic}_static", KIND, link(0.0, *one)) for one in ones if not callable(one)]
        return sorted(made, key=lambda row: row[0])

    return write_bag(folder, storage, edit=edit, **named)


def odom(k, t, x, y, yaw, parent="odom", child="base_footprint"):
    return parent, child, x, y, yaw


def lidar(k, t, *pose):  # on the vehicle, as its own driver sends it
    return "base_link", "laser", 0.2, 0.0, 0.3


def corrected(k, t, *pose):
    """A localisation that comes at 2 Hz and has the vehicle elsewhere."""
    return ("map", "odom", 2.0, 1.0, np.pi / 2) if k % 10 == 0 else None


def wheel(k, t, *pose):
    return "base_link", "wheel_left", 0.0, 0.2, 7 * t


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP], ids=["sqlite3", "mcap"])
def test_a_pose_in_odom_is_the_odometry_and_its_speeds_are_computed(tmp_path, storage):
    bag = bag_of_frames(tmp_path / "drive", [odom, corrected, lidar, wheel, ("base_footprint", "base_link", 0, 0, 0)],
                        storage=storage)
    log, notes = convert(ConvertConfig(bag, tmp_path / "data"))
    (trial,) = log.trials
    assert trial.ground_truth is None and any("--truth-topic /tf:map:base_footprint" in note for note in notes)
    assert any("odometry is 'base_footprint' in 'odom'" in note for note in notes)
    t = trial.odometry.t - 0.01
    v, omega, x, y, yaw = motion(t)
    np.testing.assert_allclose([trial.odometry.x, trial.odometry.y], [x, y], atol=1e-2)
    steady = (t > 3) & (t < 7)
    np.testing.assert_allclose(trial.odometry.v[steady], 0.5, atol=1e-2)
    np.testing.assert_allclose(trial.odometry.omega[steady], 1.0, atol=1e-2)


@pytest.mark.parametrize("name", ["/tf", "/tf:map:base_link", "/tf:/map"])
def test_the_pose_in_the_map_is_chained_through_odom(tmp_path, name):
    bag = bag_of_frames(tmp_path / "drive", [odom, corrected, ("base_footprint", "base_link", 0.1, 0, 0)], [ODOMETRY])
    log, notes = convert(ConvertConfig(bag, tmp_path / "data", truth_topic=name))
    (trial,) = log.trials
    x, y, yaw = motion(trial.ground_truth.t - 0.01)[2:]
    ahead = 0.1 if "base_link" in name else 0.0
    expected = [2.0 - (y + ahead * np.sin(yaw)), 1.0 + x + ahead * np.cos(yaw)]
    np.testing.assert_allclose([trial.ground_truth.x, trial.ground_truth.y], expected, atol=2e-2)
    np.testing.assert_allclose(np.angle(np.exp(1j * (trial.ground_truth.yaw - yaw - np.pi / 2))), 0.0, atol=0.05)


def test_transforms_beside_an_odometry_are_not_taken_without_being_asked_for(tmp_path):
    bag = bag_of_frames(tmp_path / "drive", [odom, corrected], [ODOMETRY])
    log, notes = convert(ConvertConfig(bag, tmp_path / "data"))
    assert log.trials[0].ground_truth is None and any("--truth-topic /tf takes" in note for note in notes)


@pytest.mark.parametrize("frames", [("mocap", "rigid_body_3"), ("world", "robot1/base_link"), ("arena", "base")])
def test_a_tracked_body_in_the_room_is_the_outside_pose(tmp_path, frames):
    def tracked(k, t, *pose):
        return *frames, *pose

    bag = bag_of_frames(tmp_path / "drive", [tracked])
    log, notes = convert(ConvertConfig(bag, tmp_path / "data"))
    assert log.trials[0].odometry is None
    np.testing.assert_allclose(log.trials[0].ground_truth.x, motion(log.trials[0].ground_truth.t - 0.01)[2], atol=1e-2)
    assert any(f"{frames[1]!r} in {frames[0]!r}" in note for note in notes)


def test_links_are_used_against_their_direction(tmp_path):
    def inverted(k, t, *pose):
        return "base_link", "odom_lidar", *inverse(*pose)

    bag = bag_of_frames(tmp_path / "drive", [inverted])
    (trial,) = convert(ConvertConfig(bag, tmp_path / "data"))[0].trials
    np.testing.assert_allclose(trial.odometry.x, motion(trial.odometry.t - 0.01)[2], atol=1e-2)


@pytest.mark.parametrize(("links", "options", "said"), [
    ([lidar, corrected], {}, "no links lead from odom, map or world to 'base_link' .*'map' to 'odom'.*/tf:PARENT"),
    ([lambda *a: odom(*a, child="a/base_link"), lambda *a: odom(*a, child="b/base_link")], {},
     "'a/base_link', 'b/base_link' may be the vehicle's frame"),
    ([wheel], {}, "no links lead from odom"),
    ([odom], {"truth_topic": "/tf:vicon:base_footprint"}, "no links lead from 'vicon' to 'base_footprint'"),
    ([odom], {"truth_topic": "/tf"}, "no frame of the room leads to 'base_footprint'"),
    ([("odom", "base_link", 0, 0, 0)], {}, "was sent once: it never moves"),
    ([odom], {"odometry_topic": "", "truth_topic": ""}, "neither odometry nor outside pose found"),
])  # fmt: skip
def test_frames_without_a_chain_are_refused_by_name(tmp_path, links, options, said):
    bag = bag_of_frames(tmp_path / "drive", links)
    with pytest.raises(ValueError, match=said) as raised:
        convert(ConvertConfig(bag, tmp_path / "data", **options))
    assert str(bag) in str(raised.value) and not (tmp_path / "data").exists()


def test_wheel_speeds_and_a_tracked_body_need_no_commands(tmp_path):
    kind = "sensor_msgs/msg/JointState"
    def edit(rows):
        made = []
        for t in np.arange(0.0, 21.0, 0.05):
            v, omega, x, y, yaw = (float(one) for one in motion(t))
            left, right = (v - 0.2 * omega) / 0.1, (v + 0.2 * omega) / 0.1
            made += [(t, "/joint_states", kind, message(
                kind, header=header(T0 + t), name=["wheel_left_joint", "wheel_right_joint"],
                position=np.zeros(2), velocity=np.array([left, right]), effort=np.zeros(0))),
                (t + 0.01, "/tf", KIND, link(t + 0.01, "world", "base_link", x, y, yaw))]
        return made

    bag = write_bag(tmp_path / "drive", edit=edit)
    log, _ = convert(ConvertConfig(bag, tmp_path / "data", wheel_radius=0.1, track=0.4))
    assert log.fields["input"] == "wheels" and log.trials[0].ground_truth is not None


def beside(k, t, x, y, yaw):
    """Another robot, which turns the other way, and whose frames have the same names."""
    return "odom", "base_footprint", x, -y, -yaw


def seconds(one, begin, end):
    """A link that is sent only for a while."""
    return lambda k, t, *pose: one(k, t, *pose) if begin <= t < end else None


@pytest.mark.parametrize(("topic", "sign"), [("/left/tf", 1.0), ("/right/tf", -1.0)])
def test_of_two_robots_in_namespaces_the_named_one_is_read(tmp_path, topic, sign):
    bag = bag_of_frames(tmp_path / "drive", {"/left/tf": [odom], "/right/tf": [beside]})
    log, notes = convert(ConvertConfig(bag, tmp_path / "data", odometry_topic=topic))
    (trial,) = log.trials
    np.testing.assert_allclose(trial.odometry.y, sign * motion(trial.odometry.t - 0.01)[3], atol=1e-2)
    assert any(f"of the transforms of {topic}" in note for note in notes)


@pytest.mark.parametrize(("right", "said"), [
    (beside, "/left/tf and /right/tf both have 'odom' to 'base_footprint': they may be two robots"),
    (lambda *a: odom(*a, child="base_link"), "/left/tf and /right/tf each have the pose of a vehicle"),
], ids=["same names", "other names"])  # fmt: skip
def test_two_robots_in_namespaces_of_which_none_is_named_are_refused_by_their_topics(tmp_path, right, said):
    bag = bag_of_frames(tmp_path / "drive", {"/left/tf": [odom], "/right/tf": [right]})
    with pytest.raises(ValueError, match=f"{said}.*--odometry-topic /left/tf:PARENT:CHILD"):
        convert(ConvertConfig(bag, tmp_path / "data"))


def test_a_namespace_goes_with_its_own_static_transforms_or_with_those_of_all(tmp_path):
    links = {"/left/tf": [odom, ("base_footprint", "seat", 0.5, 0, 0)], "/right/tf": [beside],
             "/tf": [("base_footprint", "seat", 0.2, 0, 0)]}
    bag = bag_of_frames(tmp_path / "drive", links)
    for topic, ahead in (("/left/tf", 0.5), ("/right/tf", 0.2)):
        name = f"{topic}:odom:seat"
        log, _ = convert(ConvertConfig(bag, tmp_path / topic[1:], odometry_topic=name))
        x, _, yaw = motion(log.trials[0].odometry.t - 0.01)[2:]
        np.testing.assert_allclose(log.trials[0].odometry.x, x + ahead * (np.cos(yaw) - 1), atol=3e-2)


def test_the_remedy_names_the_topic_that_the_bag_has_and_works(tmp_path):
    bag = bag_of_frames(tmp_path / "drive", {"/left/tf": [odom, corrected, ("base_footprint", "base_link", 0, 0, 0)]})
    _, notes = convert(ConvertConfig(bag, tmp_path / "data"))
    (said,) = [note for note in notes if "no outside pose is taken" in note]
    remedy = said.partition("--truth-topic ")[2].partition(",")[0]
    assert remedy == "/left/tf:map:base_footprint"
    log, _ = convert(ConvertConfig(bag, tmp_path / "again", truth_topic=remedy))
    assert log.trials[0].ground_truth is not None


def drifting(k, t, *pose):
    """A localisation at 2 Hz that corrects the odometry."""
    return ("map", "odom", 0.01 * t, 0.0, 0.0) if k % 10 == 0 else None


def test_links_that_share_no_time_are_refused_with_their_spans(tmp_path):
    bag = bag_of_frames(tmp_path / "drive", [seconds(odom, 0, 8), seconds(drifting, 12, 30)])
    spans = "share no time: 'map' to 'odom' from 12.0 to 20.5 s, 'odom' to 'base_footprint' from 0.0 to 8.0 s"
    with pytest.raises(ValueError, match=spans):
        convert(ConvertConfig(bag, tmp_path / "data", truth_topic="/tf"))


@pytest.mark.parametrize(("end", "held"), [(6.0, True), (30.0, False)])
def test_a_link_that_is_held_long_after_its_end_is_noted(tmp_path, end, held):
    bag = bag_of_frames(tmp_path / "drive", [odom, seconds(drifting, 0, end)])
    _, notes = convert(ConvertConfig(bag, tmp_path / "data", truth_topic="/tf"))
    said = "'map' to 'odom' was last sent 15.5 s before the end and is held from there on"
    assert [said in note for note in notes if "held from there on" in note] == [True] * held


def test_a_pose_beside_frames_without_a_chain_is_named_first_and_can_be_taken(tmp_path):
    def camera(k, t, *pose):
        return "camera_link", "camera_optical", 0.0, 0.0, 0.0

    topic = "/vrpn/robot/pose"
    bag = bag_of_frames(tmp_path / "drive", [camera], [topic], topics=(COMMAND, ODOMETRY, topic),
                        truth_kind="geometry_msgs/msg/PoseStamped")
    with pytest.raises(ValueError, match=f"topics with messages: .*{topic} .PoseStamped.*--truth-topic {topic}.*"
                                         "no frame is called base_footprint"):
        convert(ConvertConfig(bag, tmp_path / "data"))
    log, _ = convert(ConvertConfig(bag, tmp_path / "data", truth_topic=topic))
    assert log.trials[0].ground_truth is not None
    with pytest.raises(ValueError, match="^[^:]*: /tf: no links lead from 'map' to 'base_link'"):
        convert(ConvertConfig(bag, tmp_path / "other", truth_topic="/tf:map:base_link"))


def test_single_transforms_without_a_stamp_do_not_hide_a_clock_that_was_set(tmp_path):
    bag = bag_of_frames(tmp_path / "drive", [odom], unstamped=(0, 200), stamped=True)
    log, _ = convert(ConvertConfig(bag, tmp_path / "data", stamp="header"))
    x, y = motion(log.trials[0].odometry.t - log.trials[0].odometry.t[0] + 0.06)[2:4]
    np.testing.assert_allclose([log.trials[0].odometry.x, log.trials[0].odometry.y], [x, y], atol=1e-2)
