"""Whose a command is, and in which type a base listens."""

import types

import numpy as np
import pytest

from bridge.commands import NAMELESS, UNKNOWN, Commanders, CommandListener, Ear, Endpoint, choose_type, without

pytestmark = pytest.mark.quick
TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"


def reports(ear, *zeros):
    """Let the guard report; return whether a foreign zero was found at any report."""
    return any([(ear.guard_reports(count), ear.foreign_zero())[1] for count in zeros])


def test_own_commands_are_never_taken_for_those_of_another_even_where_some_are_lost():
    rng = np.random.default_rng(0)
    ear = Ear()
    for _ in range(1000):
        command = (float(rng.choice([0.0, 0.1, rng.normal()])), 0.0)
        ear.sent(*command)
        if rng.random() < 0.9:
            assert not ear.heard(*command)
        assert not reports(ear, 0, 0)


@pytest.mark.parametrize("foreign", [(9.0, 0.0), (0.0, 0.1), (float("nan"), 0.0), (0.1000001, 0.0)])
def test_command_that_nobody_of_ours_sent_is_foreign_at_once(foreign):
    ear = Ear()
    ear.sent(0.1, 0.0)
    assert ear.heard(*foreign)
    assert not ear.heard(0.1, 0.0)


def test_zero_of_another_node_is_noticed_but_the_guards_zeros_are_not_taken_for_it():
    ear = Ear()
    assert not reports(ear, 7, 9)  # seven stops before this bridge began
    assert not ear.heard(0.0, 0.0) and not ear.heard(0.0, 0.0)
    assert not reports(ear, 9, 9, 9, 9)
    assert not ear.heard(0.0, 0.0)
    assert not reports(ear, 9, 9) and reports(ear, 9) and not reports(ear, 9, 9, 9)


def test_zero_of_the_guard_may_overtake_our_own_commands():
    """They come from two nodes, so nothing orders them: on a busy computer ours were taken for a stranger's."""
    ear = Ear()
    reports(ear, 0)
    for v in (0.3, 0.2, 0.0):
        ear.sent(v, 0.0)
    assert not ear.heard(0.0, 0.0)  # of the guard
    assert not any(ear.heard(v, 0.0) for v in (0.3, 0.2, 0.0))
    assert not reports(ear, 1, 1, 1, 1, 1)


def test_zero_heard_before_the_guard_reports_it_is_the_guards_however_long_that_takes():
    ear = Ear()
    reports(ear, 0)
    ear.heard(0.0, 0.0)
    assert not any(ear.foreign_zero() for _ in range(1000))  # this process was paused, or the guard was
    assert not reports(ear, 1, 1, 1, 1, 1)


def test_report_of_a_zero_that_was_lost_excuses_no_later_one():
    ear = Ear()
    assert not reports(ear, 0, *[1] * 30)
    ear.heard(0.0, 0.0)
    assert reports(ear, 1, 1, 1)


def test_restarted_guard_counts_from_zero_again():
    ear = Ear()
    reports(ear, 12)
    ear.heard(0.0, 0.0), ear.heard(0.0, 0.0)
    assert not reports(ear, 2, 2, 2, 2, 2)


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
    names = [("/", "bridge_drive"), ("/", "bridge_guard"), ("/", "bridge_record"),
             ("_NODE_NAMESPACE_UNKNOWN_", "_NODE_NAME_UNKNOWN_"), ("/left", "bridge_guard"), ("/", "base")]
    monkeypatch.setattr("bridge.commands.ros.hears_commands", lambda requested: True)
    infos = [types.SimpleNamespace(node_namespace=space, node_name=name, topic_type=TWIST, qos_profile=None)
             for space, name in names]
    node = types.SimpleNamespace(
        resolve_topic_name=lambda topic: f"/{topic}", get_namespace=lambda: "/", get_name=lambda: "bridge_guard",
        get_subscriptions_info_by_topic=lambda topic: infos)
    listener = CommandListener(node, "cmd_vel", "auto", print)
    assert [end.node for end in listener.listeners()] == ["/left/bridge_guard", "/base"]


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
