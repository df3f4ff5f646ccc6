"""Whose a command is, and in which type a base listens."""

import types

import numpy as np
import pytest

from bridge.nodes.commands import (
    NAMELESS,
    UNKNOWN,
    Commanders,
    CommandListener,
    Ear,
    Endpoint,
    choose_type,
    is_marked,
    mark_zero,
    without,
)

pytestmark = pytest.mark.quick
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def test_own_commands_are_never_taken_for_those_of_another_even_where_some_are_lost():
    rng = np.random.default_rng(0)
    ear = Ear()
    for _ in range(1000):
        command = (float(rng.choice([0.0, 0.1, rng.normal()])), 0.0)
        ear.sent(*command)
        if rng.random() < 0.9:
            assert not ear.heard(*command, marked=False)


@pytest.mark.parametrize("foreign", [(9.0, 0.0), (0.0, 0.1), (float("nan"), 0.0), (0.1000001, 0.0), (0.0, 0.0)])
def test_command_that_nobody_of_ours_sent_is_foreign_at_once(foreign):
    ear = Ear()
    ear.sent(0.1, 0.0)
    assert ear.heard(*foreign, marked=False)
    assert not ear.heard(0.1, 0.0, marked=False)


def test_zeros_of_a_guard_are_nobody_elses_in_whatever_order_and_number_they_come():
    """Of our own guard, of one that was killed, or of an earlier node's: heard before or after its first report."""
    rng = np.random.default_rng(1)
    ear, waiting = Ear(), []
    for _ in range(1000):
        assert not ear.heard(0.0, 0.0, marked=True)
        waiting.append((float(rng.choice([0.0, 0.3])), 0.0))
        ear.sent(*waiting[-1])
        while waiting and rng.random() < 0.5:
            assert not ear.heard(*waiting.pop(0), marked=False)


def test_mark_of_a_guard_excuses_no_motion():
    assert Ear().heard(0.1, 0.0, marked=True)


def twist(*rest):
    """A made-up Twist with linear.y, linear.z, angular.x and angular.y; x and yaw rate are zero."""
    y, z, roll, pitch = rest or (0.0,) * 4
    return types.SimpleNamespace(linear=types.SimpleNamespace(x=0.0, y=y, z=z),
                                 angular=types.SimpleNamespace(x=roll, y=pitch, z=0.0))


def test_marked_zero_is_a_zero_to_every_base():
    zero = twist()
    assert not is_marked(zero)
    mark_zero(zero)
    assert is_marked(zero) and zero == twist()


@pytest.mark.parametrize("rest", [(-0.0,) * 4, (0.0, -0.0, 0.0, 0.0), (0.0, -0.1, 0.0, -0.0), (-0.0, 0.0, -0.0, 0.0),
                                  (float("nan"), -0.0, 0.0, -0.0)])
def test_zero_of_another_node_is_not_marked(rest):
    assert not is_marked(twist(*rest))


def test_mark_of_a_guard_crosses_a_message():
    messages = pytest.importorskip("geometry_msgs.msg")
    serialization = pytest.importorskip("rclpy.serialization")
    zero = messages.Twist()
    mark_zero(zero)
    assert is_marked(serialization.deserialize_message(serialization.serialize_message(zero), messages.Twist))


@pytest.mark.parametrize("types, chosen", [
    ([], ""), ([TWIST], "Twist"), ([STAMPED], "TwistStamped"), ([STAMPED, TWIST], "Twist"),
    (["std_msgs/msg/String"], ""), (["std_msgs/msg/String", STAMPED], "TwistStamped"),
])
def test_commands_are_sent_as_the_base_listens(types, chosen):
    assert choose_type([Endpoint("/base", kind) for kind in types]) == chosen


def test_second_node_of_the_same_name_is_somebody_else():
    ends = [Endpoint(name, TWIST) for name in ("/bridge_drive", "/bridge_guard", "/bridge_drive", "/left/bridge_guard")]
    assert [end.node for end in without(ends, "/bridge_drive", "/bridge_guard")] == ["/bridge_drive",
                                                                                    "/left/bridge_guard"]


def test_neither_the_bridges_own_nodes_nor_one_without_a_name_yet_is_a_base(monkeypatch):
    names = [("/", "bridge_drive"), ("/", "bridge_guard"), ("/", "bridge_guard"), ("/", "bridge_record"),
             ("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_"), ("/left", "bridge_guard"), ("/", "base")]
    monkeypatch.setattr("bridge.nodes.commands.ros.hears_commands", lambda requested: True)
    infos = [types.SimpleNamespace(node_namespace=space, node_name=name, topic_type=TWIST, qos_profile=None)
             for space, name in names]
    node = types.SimpleNamespace(
        resolve_topic_name=lambda topic: f"/{topic}", get_namespace=lambda: "/", get_name=lambda: "bridge_guard",
        get_subscriptions_info_by_topic=lambda topic: infos)
    listener = CommandListener(node, "cmd_vel", "auto", print)
    assert [end.node for end in listener.listeners()] == ["/left/bridge_guard", "/base"]


def test_guard_that_was_killed_and_is_still_listed_is_no_commander_beside_its_successor():
    names = [("/", "bridge_drive"), ("/", "bridge_guard"), ("/", "bridge_guard"), ("/left", "bridge_guard"),
             ("/", "planner"), ("/", "bridge_drive")]
    infos = [types.SimpleNamespace(node_namespace=space, node_name=name, topic_type=TWIST) for space, name in names]
    node = types.SimpleNamespace(
        resolve_topic_name=lambda topic: f"/{topic}", get_namespace=lambda: "/", get_name=lambda: "bridge_drive",
        get_publishers_info_by_topic=lambda topic: infos)
    listener = CommandListener(node, "cmd_vel", "auto", print)
    assert listener.commanders() == ["/bridge_drive", "/left/bridge_guard", "/planner"]


UNNAMED = f"/{UNKNOWN}"


def test_nobody_counts_as_absent_before_the_list_has_stayed_the_same():
    others = Commanders(10.0)
    others.look(10.2, [])
    assert not others.settled(10.9)
    others.look(10.9, ["/planner"])
    assert not others.settled(11.8)
    assert others.settled(11.95)


def test_a_commander_with_a_name_counts_at_once():
    others = Commanders(10.0)
    others.look(10.2, ["/planner", UNNAMED])
    assert others.names(10.2) == ["/planner"]


def test_a_commander_without_a_name_counts_when_it_stays():
    others = Commanders(10.0)
    for step in range(20):
        now = 10.25 + 0.125 * step
        others.look(now, [UNNAMED])
        assert others.names(now) == ([] if now < 11.0 else [NAMELESS])


def test_a_guard_that_gets_its_name_late_never_counts_but_the_wait_begins_again():
    others = Commanders(10.0)
    others.look(12.0, [])
    assert others.settled(12.0)
    others.look(12.2, [UNNAMED])
    others.look(12.8, [])
    assert others.names(13.5) == []
    assert not others.settled(13.5) and others.settled(13.8)
