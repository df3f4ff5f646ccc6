"""The simulator's topics as ordinary ROS tools hear them: default subscribers, /clock, camera info, a scanner."""

import math

import pytest

from benchmarks.bridge_robot import message_type
from bridge.simulate import SimulatedClock, planar_covariance


def listen(peer, kind, topic, profile=10):
    heard = []
    peer.node.create_subscription(message_type(kind), topic, heard.append, profile)
    return heard


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
    peer.wait_until(lambda _: info[0].header.stamp in [one.header.stamp for one in image])
    assert list(scan[-1].ranges) == [4.0, 1.0, math.inf, 1.0] and scan[-1].angle_increment == pytest.approx(math.pi / 2)
    for message, deviation in ((odometry[-1], 0.05), (truth[-1], 0.001)):
        assert message.pose.covariance[0] == pytest.approx(deviation**2) and message.pose.covariance[14] == 1e6
        assert message.twist.covariance[35] > 0
    assert graph.end("simulate") == 0, graph.log("simulate")


def test_best_effort_subscribers_are_served_too(graph):
    from bridge import ros

    peer = graph.peer()
    heard = [listen(peer, kind, topic, ros.best_effort()) for kind, topic in
             (("sensor_msgs/Image", "sensing/camera/front/image_raw"), ("nav_msgs/Odometry", "whill/odom"))]
    start(graph)
    peer.wait_until(lambda _: min(map(len, heard)) >= 3)


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
    pause.publish(message_type("std_msgs/Bool")(data=True))
    stopped = peer.wait_until_quiet(lambda: len(clock))
    pause.publish(message_type("std_msgs/Bool")(data=False))
    peer.wait_until(lambda _: len(clock) > stopped + 5)


@pytest.mark.quick
def test_stamps_of_the_simulated_clock_begin_at_one_second_and_stay_whole():
    clock = SimulatedClock(2.0, True)
    assert clock.stamp() == (1, 0)
    for _ in range(39):
        clock.advance(0.05)
    assert clock.stamp() == (2, 950_000_000)


@pytest.mark.quick
def test_a_planar_covariance_leaves_what_is_not_measured_open():
    values = planar_covariance(0.1, 0.2, 0.3)
    assert values[0] == pytest.approx(0.01) and values[7] == pytest.approx(0.04) and values[35] == pytest.approx(0.09)
    assert values[14] == values[21] == values[28] == 1e6 and sum(value != 0 for value in values) == 6
