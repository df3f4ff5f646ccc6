"""The recorder beside plain ROS publishers: it loses nothing, whatever quality of service they offer."""

import csv
import time

import pytest

from benchmarks.bridge_robot import message_type


def publish(peer, publisher, count, per_burst=50, heard=lambda last: True):
    """Publish numbered odometry in bursts, as a pause of the recorder makes them, each when the last one is heard."""
    odometry = message_type("nav_msgs/Odometry")
    for i in range(count):
        message = odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = 100 + i // 100, i % 100 * 10_000_000
        message.pose.pose.position.x = i * 0.01
        message.pose.pose.orientation.w = 1.0
        publisher.publish(message)
        if i % per_burst == per_burst - 1:
            time.sleep(0.05)
            peer.wait_until(lambda _, i=i: heard(i))


def first_one(peer, publisher, dataset, trial):
    """Publish an earlier message again and again until the recorder has written it."""
    odometry = message_type("nav_msgs/Odometry")()
    odometry.header.stamp.sec, odometry.pose.pose.orientation.w = 50, 1.0
    timer = peer.repeat(publisher, 0.1, lambda: odometry)
    peer.wait_until(lambda _: written(dataset, trial))
    timer.cancel()


def written(dataset, trial, last=0):
    """Whether the recorder has handed out a row, or the row of a number."""
    end = f",{100 + last / 100:.6f}\n" if last else "\n"
    rows = [line for path in dataset.glob(f".{trial}.partial-*/odometry.csv") for line in open(path).readlines()[1:]]
    return any(line.endswith(end) for line in rows)


def recorded(folder):
    with open(folder / "odometry.csv", encoding="utf-8", newline="") as file:
        numbers = [round(float(row["stamp"]) * 100) - 10_000 for row in csv.DictReader(file)]
    return [number for number in numbers if number >= 0]


@pytest.mark.parametrize("kind", ["reliable", "best_effort"])
def test_every_message_of_a_burst_is_recorded_once(graph, tmp_path, kind):
    from bridge.nodes import ros

    peer = graph.peer()
    publisher = peer.publisher("nav_msgs/Odometry", "whill/odom", getattr(ros, kind)(500))
    graph.start("record", tmp_path / "logs", "burst_1")
    first_one(peer, publisher, tmp_path / "logs", "burst_1")
    if kind == "reliable":
        publish(peer, publisher, 400)
    else:  # while the recorder is paused, the system keeps about 90 messages, and what nobody repeats is lost
        publish(peer, publisher, 400, 40, lambda last: written(tmp_path / "logs", "burst_1", last))
    peer.wait_until(lambda _: written(tmp_path / "logs", "burst_1", 399))
    assert graph.end("record") == 0, graph.log("record")
    rows = recorded(tmp_path / "logs" / "trials" / "burst_1")
    assert rows == sorted(set(rows)), "a message was recorded twice"
    assert len(rows) >= 399


def test_best_effort_publisher_that_joins_a_reliable_one_is_heard_too(graph, tmp_path):
    from bridge.nodes import ros

    peer = graph.peer()
    first = peer.publisher("nav_msgs/Odometry", "whill/odom", ros.reliable(500))
    graph.start("record", tmp_path / "logs", "two_1")
    peer.wait_until(lambda _: first.get_subscription_count())
    second = peer.publisher("nav_msgs/Odometry", "whill/odom", ros.best_effort(500))
    peer.wait_until(lambda _: second.get_subscription_count())
    first_one(peer, second, tmp_path / "logs", "two_1")
    publish(peer, second, 50)
    peer.wait_until(lambda _: written(tmp_path / "logs", "two_1", 49))
    assert graph.end("record") == 0, graph.log("record")
    assert len(recorded(tmp_path / "logs" / "trials" / "two_1")) >= 49
