"""The simulator's topics as ordinary ROS tools hear them: default subscribers, /clock, camera info, a scanner."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

from benchmarks.bridge_robot import message_type
from bridge.simulation.simulate_node import SimulateNode
from bridge.simulation.simulated import SimulatedClock
from bridge.simulation.simulated_messages import between, planar_covariance


def listen(peer, kind, topic, profile=10):
    heard = []
    peer.node.create_subscription(message_type(kind), topic, heard.append, profile)
    return heard


def stamps(heard):
    return {(one.header.stamp.sec, one.header.stamp.nanosec) for one in list(heard)}


CONFIG = Path(__file__).parents[2] / "bridge" / "config"


def start(graph, *options):
    graph.start("simulate", "--simulator", "point_robot:EndlessRobot", "--wait", 0, *options)


def test_default_subscribers_hear_every_topic_and_find_it_filled(graph):
    peer = graph.peer()
    image = listen(peer, "sensor_msgs/Image", "sensing/camera/front/image_raw")
    info = listen(peer, "sensor_msgs/CameraInfo", "sensing/camera/front/camera_info")
    scan = listen(peer, "sensor_msgs/LaserScan", "sensing/lidar/scan")
    odometry = listen(peer, "nav_msgs/Odometry", "whill/odom")
    truth = listen(peer, "nav_msgs/Odometry", "ground_truth/odom")
    start(graph, "--image-size", 128, 128)
    peer.wait_until(lambda _: min(map(len, (image, info, scan, odometry, truth))) >= 3)
    assert (image[-1].height, info[-1].height, info[-1].k[0], info[-1].k[2]) == (128, 128, 120.0, 64.0)
    # Either topic may be found first, so its first messages may be alone.
    peer.wait_until(lambda _: stamps(info) & stamps(image))
    assert list(scan[-1].ranges) == [4.0, 1.0, math.inf, 1.0] and scan[-1].angle_increment == pytest.approx(math.pi / 2)
    for message, deviation in ((odometry[-1], 0.05), (truth[-1], 0.001)):
        assert message.pose.covariance[0] == pytest.approx(deviation**2) and message.pose.covariance[14] == 1e6
        assert message.twist.covariance[35] > 0
    grid = listen(peer, "nav_msgs/OccupancyGrid", "map", latched())  # as nav2's costmap asks for it
    peer.wait_until(lambda _: grid)
    assert (grid[0].info.height, grid[0].info.width, list(grid[0].data)) == (2, 3, [0, 0, 100, 0, 0, 0])
    assert grid[0].header.frame_id == "map" and grid[0].info.origin.position.x == -1.0
    assert graph.end("simulate") == 0, graph.log("simulate")


def latched():
    from bridge.nodes import ros

    return ros.latched()


def shown_by_foxglove():
    """Topics of the layout and the types that its panels show; None where a panel takes any."""
    layout = json.loads((CONFIG / "foxglove.json").read_text())
    panels = layout["configById"]
    for name, panel in panels.items():
        kind = name.partition("!")[0]
        if kind == "3D":
            yield from ((topic, None) for topic, settings in panel["topics"].items() if settings.get("visible"))
        elif kind == "Image":
            yield panel["imageMode"]["imageTopic"], "sensor_msgs/msg/Image"
            yield panel["imageMode"]["calibrationTopic"], "sensor_msgs/msg/CameraInfo"
        elif kind == "Plot":
            yield from ((path["value"].partition(".")[0], None) for path in panel["paths"])
        elif kind in ("RawMessages", "Indicator"):
            yield panel.get("topicPath", panel.get("path", "")).partition(".")[0], None
        else:
            raise AssertionError(f"panel {name} is not known to this test")


RVIZ = {"Odometry": "nav_msgs/msg/Odometry", "Map": "nav_msgs/msg/OccupancyGrid", "Image": "sensor_msgs/msg/Image",
        "LaserScan": "sensor_msgs/msg/LaserScan"}
"""Types that the displays of rviz_default_plugins show."""


def shown_by_rviz():
    displays = yaml.safe_load((CONFIG / "whill.rviz").read_text())["Visualization Manager"]["Displays"]
    for display in displays:
        if "Topic" in display:
            yield display["Topic"]["Value"], RVIZ[display["Class"].partition("/")[2]]


def test_the_shipped_layouts_show_topics_that_the_simulator_publishes_in_their_types(graph):
    peer = graph.peer()
    start(graph)
    shown = [*shown_by_foxglove(), *shown_by_rviz()]
    assert len(shown) > 10

    def published(_):
        return {name: kinds for name, kinds in peer.node.get_topic_names_and_types()
                if peer.node.get_publishers_info_by_topic(name)}

    peer.wait_until(lambda _: {topic for topic, _ in shown} <= published(_).keys())
    topics = published(peer)
    for topic, kind in shown:
        assert topic in topics and kind in (None, topics[topic][0]), topic


def test_best_effort_subscribers_are_served_too(graph):
    from bridge.nodes import ros

    peer = graph.peer()
    heard = [listen(peer, kind, topic, ros.best_effort()) for kind, topic in
             (("sensor_msgs/Image", "sensing/camera/front/image_raw"), ("nav_msgs/Odometry", "whill/odom"))]
    start(graph)
    peer.wait_until(lambda _: min(map(len, heard)) >= 3)


def test_chairs_in_namespaces_are_driven_apart(graph):
    peer = graph.peer()
    for side in ("left", "right"):
        graph.start("simulate", "--simulator", "point_robot:RovingRobot", "--wait", 0, "--ros-args", "-r",
                    f"__ns:=/{side}", key=side)
    left, right = (listen(peer, "nav_msgs/Odometry", f"/{side}/whill/odom") for side in ("left", "right"))
    scan = listen(peer, "sensor_msgs/LaserScan", "/right/sensing/lidar/scan")
    publisher, make = peer.commander(0.5, "/left/whill/controller/cmd_vel")
    peer.repeat(publisher, 0.05, make)
    peer.wait_until(lambda _: left and left[-1].pose.pose.position.x > 0.3 and right and scan)
    assert {message.pose.pose.position.x for message in right} == {0.0}


def test_a_collision_is_published_once_and_taken_back_with_the_next_episode(graph):
    peer = graph.peer()
    graph.start("simulate", "--simulator", "point_robot:CrashingRobot", "--wait", 0)
    heard = listen(peer, "std_msgs/Bool", "collision_sensor", latched())
    peer.wait_until(lambda _: [one.data for one in heard][-4:] in ([True, False] * 2, [False, True] * 2))


def test_simulated_time_runs_at_its_speed_pauses_and_stamps_the_messages(graph):
    peer = graph.peer()
    clock = listen(peer, "rosgraph_msgs/Clock", "/clock")
    odometry = listen(peer, "nav_msgs/Odometry", "whill/odom")
    pause = peer.publisher("std_msgs/Bool", "simulate/pause")
    start(graph, "--clock", "--speed", 4)
    peer.wait_until(lambda _: len(clock) > 10 and len(odometry) > 10 and pause.get_subscription_count())
    times = [one.clock.sec + one.clock.nanosec * 1e-9 for one in list(clock)]
    steps = [(b - a) / 0.05 for a, b in zip(times, times[1:], strict=False)]
    assert all(step > 0.9 and abs(step - round(step)) < 0.02 for step in steps)  # a busy listener misses some
    assert odometry[-1].header.stamp.sec < 1000  # simulated time, not the wall's
    paused = [True]  # said again and again: the simulator may not have found its sender yet
    peer.repeat(pause, 0.1, lambda: message_type("std_msgs/Bool")(data=paused[-1]))
    stopped = peer.wait_until_quiet(lambda: len(clock))
    paused.append(False)
    peer.wait_until(lambda _: len(clock) > stopped + 5)


@pytest.mark.quick
def test_stamps_of_the_simulated_clock_begin_at_one_second_and_stay_whole():
    clock = SimulatedClock(2.0, True)
    assert clock.stamp() == (1, 0)
    for _ in range(39):
        clock.advance(0.05)
    assert clock.stamp() == (2, 950_000_000)


@pytest.mark.quick
def test_the_frame_of_the_odometry_puts_its_pose_where_the_vehicle_is():
    inner, outer = (0.7, -0.2, 0.4), (3.0, 2.0, -2.9)
    x, y, yaw = between(outer, inner)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    assert turn @ inner[:2] + [x, y] == pytest.approx(outer[:2])
    assert math.remainder(yaw + inner[2] - outer[2], 2 * math.pi) == pytest.approx(0)


@pytest.mark.quick
def test_a_planar_covariance_leaves_what_is_not_measured_open():
    values = planar_covariance(0.1, 0.2, 0.3)
    assert values[0] == pytest.approx(0.01) and values[7] == pytest.approx(0.04) and values[35] == pytest.approx(0.09)
    assert values[14] == values[21] == values[28] == 1e6 and sum(value != 0 for value in values) == 6


def test_simulator_says_when_it_is_ready_where_it_listens_and_how_an_episode_ended(graph):
    graph.start("simulate", "--simulator", "benchmarks.bridge:ShortRobot", "--wait", 0, "--episodes", 1)
    assert graph.wait("simulate") == 0, graph.log("simulate")
    log = graph.log("simulate")
    assert log.index("ready; commands are heard on /whill/controller/cmd_vel") < log.index(
        "episode 1: neither arrived nor collided after 10 steps and 0 commands")


@pytest.mark.quick
def test_the_simulator_says_that_it_is_ready_when_its_topics_are_there(monkeypatch):
    pytest.importorskip("rclpy")
    calls = MagicMock()
    monkeypatch.setattr("bridge.simulation.simulate_node.ros", calls.ros)
    calls.node.resolve_topic_name.return_value = "/cmd_vel"
    vehicle = SimpleNamespace(period=0.1, reset=lambda seed: None, step=lambda v, omega: None)
    options = SimpleNamespace(seed=0, speed=1.0, clock=True, command_type="Twist")
    SimulateNode(calls.node, vehicle, options)
    words = [str(call) for call in calls.mock_calls]
    [ready] = [number for number, word in enumerate(words) if "ready; commands are heard on /cmd_vel" in word]
    made = [number for number, word in enumerate(words)
            if word.startswith(("call.node.create_", "call.ros.subscribe_state(", "call.ros.steady_timer("))]
    assert len(made) > 8 and max(made) < ready
