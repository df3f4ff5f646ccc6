"""Emergency stop, enable, dead-man button and collision sensor over real DDS, in both durabilities."""

import re
import time

import pytest
from ros_graph import taken_for_others

from benchmarks.bridge_robot import message_type


def latched_profile():
    from bridge.nodes import ros

    return ros.latched()


@pytest.mark.parametrize("topic", ["e_stop", "collision_sensor"])
def test_stop_that_was_latched_before_the_bridge_started_is_heard(graph, policy, topic):
    robot = graph.peer("robot")
    beat = robot.whole()
    if topic == "e_stop":
        beat.timer.cancel()
    bell = robot.publisher("std_msgs/Bool", topic, latched_profile())
    bell.publish(message_type("std_msgs/Bool")(data=True))  # once, and never again
    graph.start("drive", policy)
    robot.wait_for_status(state="disarmed", reason="emergency stop" if topic == "e_stop" else "collision")
    time.sleep(1.0)
    assert not robot.moving()


@pytest.mark.parametrize("durability", ["volatile", "transient local"])
def test_pulled_emergency_stop_ends_the_drive_until_it_is_released_and_armed(graph, policy, durability):
    robot = graph.peer("robot")
    robot.base(), robot.watch(), robot.camera()
    boolean = message_type("std_msgs/Bool")
    bell = robot.publisher("std_msgs/Bool", "e_stop", 1 if durability == "volatile" else latched_profile())
    state = {"pulled": False}
    robot.repeat(bell, 0.05, lambda: boolean(data=state["pulled"]))
    graph.start("drive", policy)
    robot.wait_for_status(driving=True)
    state["pulled"] = True
    robot.wait_for_status(state="disarmed", reason="emergency stop", holds="emergency stop")
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))
    robot.arm()
    # A pause of the guard may hold it too, and would be named in one line with the stop.
    robot.wait_until(lambda _: re.search("not armed: .*emergency stop.* still holds", graph.log("drive")))
    state["pulled"] = False
    robot.wait_for_status(state="disarmed", holds="[]")
    robot.drive_again()
    assert not taken_for_others(robot)


def test_collision_that_a_best_effort_sensor_reports_stops_the_drive(graph, policy):
    from bridge.nodes import ros

    robot = graph.peer("robot")
    robot.whole()
    bumper = robot.publisher("std_msgs/Bool", "collision_sensor", ros.best_effort())
    graph.start("drive", policy)
    robot.wait_for_status(driving=True)
    robot.wait_until(lambda _: bumper.get_subscription_count())
    robot.repeat(bumper, 0.1, lambda: message_type("std_msgs/Bool")(data=True))
    robot.wait_for_status(state="disarmed", reason="collision")
    robot.wait_until(lambda robot: robot.commands[-1][1:] == (0.0, 0.0))


def test_emergency_stop_that_falls_silent_while_driving_stops_and_needs_arming(graph, policy):
    robot = graph.peer("robot")
    beat = robot.whole()
    graph.start("drive", policy, "--signal-age", 2)
    for _ in range(10):  # where a pause has stopped the drive before the silence does, it needs no arming: once more
        robot.wait_until(lambda robot: robot.statuses and (robot.statuses[-1]["driving"]
                                                           or robot.statuses[-1]["state"] == "disarmed"))
        beat.timer.cancel()
        if robot.wait_for_status(holds="emergency stop unknown")["state"] == "disarmed":
            break
        beat.timer.reset()
    robot.wait_for_status(state="disarmed", reason="emergency stop unknown")
    beat.timer.reset()
    robot.wait_for_status(state="disarmed", reason="emergency stop unknown", holds="[]")


def test_nothing_moves_while_no_emergency_stop_is_heard(graph, policy):
    robot = graph.peer("robot")
    robot.base(), robot.watch(), robot.camera()
    graph.start("drive", policy)
    robot.wait_for_status(reason="emergency stop unknown", holds="['emergency stop unknown']")
    time.sleep(0.5)
    assert robot.commands == []


def test_vehicle_moves_only_while_the_dead_man_button_is_held(graph, policy):
    robot = graph.peer("robot")
    robot.whole()
    joy = robot.publisher("sensor_msgs/Joy", "joy")
    buttons = [0, 0, 0]
    timer = robot.repeat(joy, 0.05, lambda: message_type("sensor_msgs/Joy")(buttons=buttons))
    graph.start("drive", policy, "--dead-man-button", 2, "--signal-age", 3, "--e-stop", "ignore")
    robot.wait_for_status(reason="dead-man button released", holds="['dead-man button released']")
    buttons[2] = 1
    robot.wait_for_status(driving=True)
    buttons[2] = 0
    robot.wait_for_status(state="standing", reason="dead-man button released")
    buttons[2] = 1
    robot.wait_for_status(driving=True)
    timer.cancel()  # the joystick is unplugged with the button held
    robot.wait_for_status(state="standing", reason="dead-man button released")
