"""Readers of the recorder on a graph of made-up publishers."""

import types

import pytest

pytest.importorskip("rclpy")
pytestmark = pytest.mark.quick


class Node:
    """A node whose graph is a list of publishers; it keeps the readers that are made."""

    def __init__(self, *offered):
        self.offered, self.readers, self.destroyed = list(offered), [], []

    def get_name(self):
        return "bridge_record"

    def get_namespace(self):
        return "/"

    def resolve_topic_name(self, topic):
        return f"/{topic.lstrip('/')}"

    def get_publishers_info_by_topic(self, topic):
        return [types.SimpleNamespace(qos_profile=one, node_name="base", node_namespace="/",
                                      topic_type="geometry_msgs/msg/Twist") for one in self.offered]

    def get_subscriptions_info_by_topic(self, topic):
        return []

    def create_subscription(self, kind, topic, callback, profile, *, event_callbacks, raw=False):
        self.readers.append(types.SimpleNamespace(topic=topic, heard=callback, profile=profile, events=event_callbacks))
        return self.readers[-1]

    def destroy_subscription(self, reader):
        self.destroyed.append(reader)

    def create_timer(self, *_, **__):
        pass


def odometry(x):
    from nav_msgs.msg import Odometry

    message = Odometry()
    message.header.stamp.sec, message.pose.pose.position.x = 7, x
    return message


def test_messages_of_one_stamp_are_each_recorded():
    from bridge.nodes import ros
    from bridge.nodes.streams import Stream

    heard, node = [], Node(ros.reliable())
    stream = Stream(node, type(odometry(0.0)), "odom", heard.append)
    assert stream.look()
    for x in (0.0, 0.1):  # within one tick of a coarse /clock
        node.readers[0].heard(odometry(x))
    assert [message.pose.pose.position.x for message in heard] == [0.0, 0.1]


@pytest.mark.parametrize("raw", [False, True])
def test_whole_recording_gets_what_was_published_before_it_began(raw):
    from rclpy.qos import DurabilityPolicy

    from bridge.nodes import ros
    from bridge.nodes.streams import Stream

    node = Node(ros.latched())
    stream = Stream(node, type(odometry(0.0)), "map", print, raw)
    stream.look(), stream.look()
    assert [one.profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for one in node.readers] == [raw]
    node.offered.append(ros.reliable())  # a reader of kept values would not hear this publisher
    stream.look()
    assert node.readers[-1].profile.durability != DurabilityPolicy.TRANSIENT_LOCAL
    assert node.destroyed == node.readers[:-1]


def test_commands_that_the_middleware_lost_are_reported():
    from bridge.nodes import ros
    from bridge.record import parse_arguments
    from bridge.recording.record_node import RecordNode

    node = Node(ros.reliable())
    recorder = RecordNode(node, None, parse_arguments(["logs", "one"]))
    recorder._look()
    (commands,) = [reader for reader in node.readers if reader.topic.endswith("cmd_vel")]
    assert recorder.lost() == {}
    commands.events.message_lost(types.SimpleNamespace(total_count_change=3))
    assert recorder.lost() == {commands.topic: 3}


@pytest.mark.parametrize("profile, hears", [
    ({}, True), ({"depth": 10}, True), ({"deadline": 2**63 - 1}, True), ({"deadline": 10**8}, False),
    ({"durability": "TRANSIENT_LOCAL"}, False), ({"reliability": "BEST_EFFORT"}, True),
    ({"liveliness_lease_duration": 2**63 - 1}, True), ({"liveliness_lease_duration": 10**8}, False),
    ({"liveliness": "AUTOMATIC"}, True), ({"liveliness": "MANUAL_BY_TOPIC"}, False),
])
def test_base_hears_commands_unless_it_asks_for_kept_ones_a_deadline_or_signs_of_life(profile, hears):
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

    from bridge.nodes import ros

    def time(value):
        return Duration(nanoseconds=value)

    make = {"deadline": time, "liveliness_lease_duration": time, "durability": DurabilityPolicy.__getitem__,
            "reliability": ReliabilityPolicy.__getitem__, "liveliness": LivelinessPolicy.__getitem__, "depth": int}
    asked = QoSProfile(**{"depth": 1, **{name: make[name](value) for name, value in profile.items()}})
    assert ros.hears_commands(asked) == hears
