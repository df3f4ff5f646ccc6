"""A policy of several sensors drives over real DDS, and each sensor that fails stops it."""

import pytest
import tiny_policy


@pytest.fixture
def sensing(tmp_path):
    return tiny_policy.write_sensing(tmp_path / "sensing")


def test_policy_of_two_cameras_a_lidar_and_odometry_drives_the_simulator_until_its_odometry_says_so(graph, sensing):
    base = graph.peer("base")
    base.base()
    base.watch()
    graph.start("simulate", "--simulator", "point_robot:SensingRobot")
    graph.start("drive", sensing)
    base.wait_until(lambda base: base.moving())
    assert base.moving()[-1][1] == pytest.approx(0.3)
    base.wait_until(lambda base: base.statuses and base.statuses[-1]["driving"] and base.commands
                    and base.commands[-1][1] == 0.0)  # its odometry has counted 0.25 m
    assert graph.end("simulate") == 0, graph.log("simulate")
    base.wait_for_status(driving=False)
    assert graph.end("drive") == 0, graph.log("drive")


def test_missing_and_wrong_sensors_are_named_and_hold_the_vehicle(graph, sensing):
    robot = graph.peer("robot")
    robot.base()
    robot.watch()
    robot.e_stop()
    robot.publisher("std_msgs/String", "sensing/lidar/scan")
    graph.start("drive", sensing)
    status = robot.wait_for_status(causes="/sensing/lidar/scan carries std_msgs/msg/String, and the policy")
    named = " ".join(robot.wait_for_status(causes="no publisher on /whill/odom, the policy's odometry")["causes"])
    assert "no publisher on /sensing/camera/rear/image_raw, the policy's rear" in named
    assert "no publisher on /sensing/camera/front/image_raw: start the camera" in named
    assert {"no lidar", "no odometry", "no rear"} <= set(status["holds"]) and not status["driving"]
    assert not robot.commands or not robot.moving()
