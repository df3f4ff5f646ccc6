"""Whole recordings: what sysid reads of them, however the recorder ended."""

import signal

import pytest

from benchmarks.bridge_robot import message_type
from bridge.recording.mcap_file import McapWriter, definition_of, mend, stamp_of
from bridge.recording.trial_writer import MCAP

pytest.importorskip("rclpy")


def odometry(i):
    message = message_type("nav_msgs/Odometry")()
    message.header.stamp.sec, message.header.stamp.nanosec = 100 + i // 100, i % 100 * 10_000_000
    message.pose.pose.position.x, message.pose.pose.orientation.w = 0.01 * i, 1.0
    return message


def write(path, count):
    from rclpy.serialization import serialize_message

    writer = McapWriter(path)
    for i in range(count):
        for topic, message in (("/whill/odom", odometry(i)), ("/whill/controller/cmd_vel", command(0.1 * i))):
            writer.write(topic, type(message), serialize_message(message), 10**18 + i * 10**7)
    return writer


def command(v):
    message = message_type("geometry_msgs/Twist")()
    message.linear.x = v
    return message


def read(path):
    from sysid.logs.bags.reader import read_bag

    return read_bag(path).streams


def test_sysid_reads_the_messages_with_receipt_and_stamp(tmp_path):
    write(tmp_path / "a.mcap", 50).close()
    streams = read(tmp_path / "a.mcap")
    assert streams["odometry"].values[:, 0] == pytest.approx([0.01 * i for i in range(50)])
    assert streams["odometry"].stamped[10] == pytest.approx(100.1)
    assert streams["odometry"].received[10] - streams["odometry"].received[0] == pytest.approx(0.1)
    assert streams["command"].values[:, 0] == pytest.approx([0.1 * i for i in range(50)])


@pytest.mark.parametrize("lost", [0, 1, 7, 40, 800])
def test_a_file_that_was_cut_off_anywhere_keeps_its_whole_messages(tmp_path, lost):
    path = tmp_path / "a.mcap"
    writer = write(path, 20)
    writer.flush()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - lost])
    mend(path)
    rows = len(read(path)["odometry"].values)
    assert rows == 20 if lost == 0 else 18 <= rows <= 20
    mended = path.read_bytes()
    mend(path)
    assert path.read_bytes() == mended


def test_a_file_that_is_no_recording_is_left_alone(tmp_path):
    path = tmp_path / "a.mcap"
    for content in (b"", b"x", b"something else altogether"):
        path.write_bytes(content)
        mend(path)
        assert path.read_bytes() == content


def test_definitions_are_those_that_another_reader_writes():
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    for name in ("nav_msgs/Odometry", "sensor_msgs/JointState", "sensor_msgs/Image", "geometry_msgs/TwistStamped",
                 "sensor_msgs/LaserScan", "nav_msgs/OccupancyGrid", "std_msgs/Bool"):
        package, _, kind = name.partition("/")
        full = f"{package}/msg/{kind}"
        types = get_types_from_msg(definition_of(message_type(name)), full)
        store = get_typestore(Stores.ROS2_JAZZY)
        assert {key: [one[1] for one in fields[1]] for key, fields in types.items()} == {
            key: [one[1] for one in store.fielddefs[key][1]] for key in types}


def test_only_messages_with_a_header_have_a_stamp():
    from rclpy.serialization import serialize_message

    assert stamp_of(message_type("nav_msgs/Odometry"), serialize_message(odometry(150))) == 101_500_000_000
    assert stamp_of(message_type("geometry_msgs/Twist"), serialize_message(command(1.0))) == 0


def test_a_killed_recorder_leaves_every_topic_but_images_in_a_file_that_converts(graph, tmp_path):
    peer = graph.peer()
    joints = message_type("sensor_msgs/JointState")(name=["left", "right"], position=[1.0, 2.0])
    image = message_type("sensor_msgs/Image")()
    number = iter(range(10**6))
    peer.repeat(peer.publisher("sensor_msgs/JointState", "joint_states", 10), 0.05, lambda: joints)
    peer.repeat(peer.publisher("sensor_msgs/Image", "camera", 10), 0.05, lambda: image)
    peer.repeat(peer.publisher("geometry_msgs/Twist", "whill/controller/cmd_vel", 10), 0.05, lambda: command(0.3))
    peer.repeat(peer.publisher("nav_msgs/Odometry", "whill/odom", 10), 0.02, lambda: odometry(next(number)))
    graph.start("record", tmp_path / "logs", "whole_1", "--mcap")

    def size(_):
        return sum(path.stat().st_size for path in (tmp_path / "logs").glob(f".whole_1.partial-*/{MCAP}"))

    peer.wait_until(lambda _: size(_) > 60_000)
    graph.end("record", signal.SIGKILL)
    graph.start("record", tmp_path / "logs", "--recover", key="recover")
    assert graph.wait("recover") == 0, graph.log("recover")
    path = tmp_path / "logs" / "trials" / "whole_1" / MCAP
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        counts = {topic: about.msgcount for topic, about in reader.topics.items()}
        (first, *_) = (reader.deserialize(data, one.msgtype) for one, _, data in reader.messages()
                       if one.topic == "/joint_states")
    assert "/camera" not in counts and {"/joint_states", "/whill/controller/cmd_vel", "/whill/odom"} <= set(counts)
    assert list(first.name) == ["left", "right"] and list(first.position) == [1.0, 2.0]
    streams = read(path)
    assert len(streams["odometry"].values) > 30 and set(streams["command"].values[:, 0]) == {0.3}
