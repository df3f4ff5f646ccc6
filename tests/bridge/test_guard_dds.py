"""Nothing drives without a guard, and a guard stops what dies."""

import json
import os
import signal
import time

from ros_graph import taken_for_others

from benchmarks.bridge_robot import message_type


def drive_alone(graph, policy, *options):
    """A robot and a bridge that has just begun to drive it."""
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, *options)
    robot.wait_until(lambda robot: robot.moving())
    return robot


def stopped(robot):
    return robot.commands[-1][1:] == (0.0, 0.0)


def test_bridge_killed_at_its_first_command_leaves_a_standing_vehicle(graph, policy):
    robot = drive_alone(graph, policy)
    graph.end("drive", signal.SIGKILL)
    robot.wait_until(stopped)


def test_bridge_killed_on_another_topic_leaves_a_standing_vehicle(graph, policy):
    from bridge.nodes.commands import is_marked

    robot, heard = graph.peer("robot"), []
    robot.node.create_subscription(message_type("geometry_msgs/Twist"), "/base/velocity",
                                   lambda message: heard.append((message.linear.x, is_marked(message))), 10)
    robot.camera()
    robot.e_stop()
    for _ in range(5):  # where a pause had stopped the vehicle before the kill, the guard has nothing to do: once more
        before = len(heard)
        graph.start("drive", policy, "--command-topic", "/base/velocity")
        robot.wait_until(lambda _, before=before: any(v for v, _ in heard[before:]))
        graph.end("drive", signal.SIGKILL)
        robot.wait_until(lambda _: heard[-1][0] == 0.0)
        if heard[-1][1]:
            break
    robot.wait_until(lambda _: "vehicle stopped" in graph.log("drive"))  # the guard says so in its starter's log


def test_frozen_bridge_is_stopped_by_the_guard_and_drives_on_after_fresh_frames(graph, policy):
    robot = drive_alone(graph, policy, "--signal-age", 600)  # however long the pause on a busy machine
    graph.processes["drive"].send_signal(signal.SIGSTOP)
    robot.wait_until(stopped)
    graph.processes["drive"].send_signal(signal.SIGCONT)
    since = time.monotonic()
    robot.wait_until(lambda robot: robot.moving(since))  # and its own guard is not taken for a stranger


def test_bridge_that_waits_for_another_guard_stands_without_it(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    graph.start("drive", policy, "--guard", "other")
    robot.wait_for_status(reason="no guard", causes="no guard is running")
    time.sleep(0.5)
    assert robot.commands == []
    graph.start("guard", "--command-topic", "/elsewhere")
    robot.wait_for_status(reason="no guard", causes="the guard follows /elsewhere")
    graph.end("guard")
    graph.start("guard")
    robot.wait_for_status(driving=True)
    graph.end("guard")
    robot.wait_for_status(state="standing", reason="no guard")
    robot.wait_until(stopped)


def test_guard_that_was_killed_is_started_again_and_the_vehicle_stands_meanwhile(graph, policy):
    robot = drive_alone(graph, policy)
    outlive_guard(graph, robot)
    # DDS lists the dead guard for 20 s more, and nobody takes it, or a zero of either guard, for another commander
    assert not taken_for_others(robot)


def test_tool_that_listens_in_another_type_does_not_mislead_a_guard_that_is_started_again(graph, policy):
    robot = graph.peer("robot")
    robot.base(kind="geometry_msgs/TwistStamped")
    robot.watch(), robot.camera(), robot.e_stop()
    graph.start("drive", policy)
    robot.wait_until(lambda robot: robot.moving())
    graph.peer("tool").base(kind="geometry_msgs/Twist")
    outlive_guard(graph, robot)
    robot.wait_until(lambda robot: not stopped(robot))
    graph.end("drive", signal.SIGKILL)
    robot.wait_until(stopped)


def test_bridge_leaves_no_guard_behind(graph, policy):
    robot = drive_alone(graph, policy)
    guard = child_of(graph.processes["drive"].pid)
    graph.end("drive")
    robot.wait_until(lambda _: not os.path.exists(f"/proc/{guard}"))


def outlive_guard(graph, robot):
    """Kill the guard of a bridge that drives, and wait until the vehicle has stood and drives again."""
    robot.wait_for_status(driving=True)
    before = len(robot.statuses)  # counted first: the bridge may report sooner than this thread goes on
    os.kill(child_of(graph.processes["drive"].pid), signal.SIGKILL)
    robot.wait_for_status(since=before, reason="no guard")  # it passes by itself
    stood = len(robot.statuses)
    robot.wait_for_status(since=stood, driving=True)


def child_of(pid):
    """The one child process."""
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        (child,) = file.read().split()
    return int(child)


def test_a_bridge_of_another_name_is_no_base_to_its_guard(graph, policy):
    beats = []
    robot = graph.peer("robot")
    robot.watch(), robot.camera(), robot.e_stop()
    robot.node.create_subscription(message_type("std_msgs/String"), "bridge/guard",
                                   lambda message: beats.append(json.loads(message.data)), 10)
    graph.start("drive", policy, "--command-type", "Twist", "--ros-args", "-r", "__node:=pilot")
    robot.wait_until(lambda _: sum(bool(beat["hears"]) for beat in beats) > 20)  # a second
    assert not any(beat["ready"] for beat in beats if beat["hears"])
    robot.base()
    robot.wait_for_status(driving=True)
