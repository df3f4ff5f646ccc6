"""Who drives: a person who takes over wins, a second commander is refused, namespaces keep bridges apart."""

import time

import pytest
from ros_graph import send_until_disarmed

from benchmarks.bridge_robot import message_type

LISTENERS = 3
"""Base, bridge and guard."""


def test_person_who_takes_over_while_driving_is_never_fought_and_the_bridge_needs_arming_afterwards(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, "--allow-other-commanders")
    person = graph.peer("joystick")
    publisher, make = person.commander(0.11)
    robot.wait_for_status(driving=True)
    robot.wait_until(lambda robot: robot.moving())
    timer = person.repeat(publisher, 0.05, make)
    robot.wait_for_status(state="yielded", reason="another node drives")
    robot.wait_until(lambda robot: {v for _, v, _ in robot.commands[-20:]} == {0.11})  # the bridge is silent
    timer.cancel()
    robot.wait_for_status(state="disarmed", reason="another node drove")
    robot.wait_until_quiet(lambda: len(robot.commands))  # the WHILL is left to its rider
    robot.drive_again()


def test_bridge_yields_to_a_person_at_another_source_of_a_mux_and_needs_arming_afterwards(graph, policy):
    """The mux lets the person's commands pass and then the policy's again, so the bridge itself must have let go."""
    robot = graph.peer("mux")
    robot.whole()
    robot.node.create_subscription(message_type("geometry_msgs/Twist"), "joy/cmd_vel", lambda message: None, 1)
    graph.start("drive", policy, "--yield-to", "joy/cmd_vel", "nav/cmd_vel_smoothed")
    person = graph.peer("joystick")
    publisher, make = person.commander(0.11, "joy/cmd_vel")
    robot.wait_for_status(driving=True)
    timer = person.repeat(publisher, 0.05, make)
    robot.wait_for_status(state="yielded", reason="another node drives")
    timer.cancel()
    robot.wait_for_status(state="disarmed", reason="another node drove")
    robot.wait_until_quiet(lambda: len(robot.commands))
    robot.drive_again()


def test_single_stray_command_of_another_node_ends_the_drive(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, "--allow-other-commanders")
    publisher, make = graph.peer("stray").commander(9.0)
    robot.wait_for_status(driving=True)
    robot.wait_until(lambda _: publisher.get_subscription_count() >= LISTENERS)
    send_until_disarmed(robot, publisher, make)


def test_base_that_keeps_its_last_command_is_stopped_when_the_other_driver_falls_silent(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, "--allow-other-commanders", "--base", "generic")
    publisher, make = graph.peer("joystick").commander(0.11)
    robot.wait_for_status(driving=True)
    robot.wait_until(lambda _: publisher.get_subscription_count() >= LISTENERS)
    send_until_disarmed(robot, publisher, make)
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))


@pytest.mark.parametrize("kind", ["geometry_msgs/Twist", "geometry_msgs/TwistStamped"])
def test_commands_come_in_the_type_that_the_base_listens_to(graph, policy, kind):
    robot = graph.peer("robot")
    robot.base(kind=kind), robot.camera(), robot.e_stop()
    graph.start("drive", policy)
    robot.wait_until(lambda robot: robot.moving())


def test_second_commander_that_is_there_before_the_start_is_named_and_nothing_moves(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    graph.peer("planner").commander(0.0)
    graph.start("drive", policy)
    robot.wait_for_status(state="standing", reason="another node publishes commands", causes="/planner")
    time.sleep(0.5)
    assert robot.commands == []


def test_arming_one_of_two_bridges_in_namespaces_leaves_the_other_disarmed(graph, policy):
    robot = graph.peer("robot")
    for side in ("left", "right"):
        robot.e_stop(f"/{side}/e_stop")
        robot.base(f"/{side}/whill/controller/cmd_vel")
        robot.camera(f"/{side}/sensing/camera/front/image_raw")
        graph.start("drive", policy, "--require-arm", "--ros-args", "-r", f"__ns:=/{side}", key=side)
    left, right = graph.peer("left_operator"), graph.peer("right_operator")
    left.watch("/left/bridge/status"), right.watch("/right/bridge/status")
    for operator in (left, right):
        operator.wait_for_status(state="disarmed", holds="[]")
    empty = message_type("std_msgs/Empty")
    arming = left.publisher("std_msgs/Empty", "/left/bridge/rearm")
    timer = left.repeat(arming, 1.0, empty)  # again and again: a pause may refuse it
    left.wait_for_status(driving=True)
    timer.cancel()
    time.sleep(1.0)
    assert right.statuses[-1]["state"] == "disarmed" and not any(one["driving"] for one in right.statuses)


def test_remapped_command_topic_is_followed_by_bridge_and_guard(graph, policy):
    robot = graph.peer("robot")
    robot.base("/cmd_vel")
    robot.camera()
    robot.e_stop()
    graph.start("drive", policy, "--ros-args", "-r", "whill/controller/cmd_vel:=/cmd_vel")
    robot.wait_until(lambda robot: robot.moving())
    graph.wait_for("drive", "guarding /cmd_vel")
