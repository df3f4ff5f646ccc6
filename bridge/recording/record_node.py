"""The ROS node that records: the streams of the graph, each as a row or whole, go to one writer."""

import argparse
import importlib
import math
import time
from collections.abc import Callable
from typing import Any

from bridge.nodes import ros
from bridge.nodes.commands import CommandListener
from bridge.nodes.streams import DEPTH, Stream
from bridge.recording.split_writer import SplitWriter
from bridge.recording.trial_writer import TrialWriter

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
"""Types that are kept whole on request only: they take megabytes a second."""
AHEAD = 1.0
"""Seconds by which a stamp may be ahead of this node's clock; one that is further is of another clock."""
LOOK_PERIOD = 0.1
"""Seconds between two looks for publishers."""


class StampedListener(CommandListener):
    """Hears commands with their own time, and whole; best effort, so that no recorder ever holds up a command."""

    def __init__(self, node: Any, topic: str, on_message: Callable[[Any, float, float, float], None]) -> None:
        """Listen in the type that the base hears.

        `on_message` gets the message, its stamp [s] (0 where it has none), v [m/s] and omega [rad/s].
        """
        self._on_message = on_message
        self.lost = 0
        """Commands that the middleware reports as lost."""
        super().__init__(node, topic, "auto", lambda v, omega, marked: None)

    def _open(self, kind: str) -> None:
        from geometry_msgs import msg

        def heard(message: Any) -> None:
            planar, stamp = message, 0.0
            if kind == "TwistStamped":
                planar, stamp = message.twist, ros.stamp_seconds(message.header.stamp)
            self._on_message(message, stamp, planar.linear.x, planar.angular.z)

        def count(event: Any) -> None:
            self.lost += event.total_count_change

        self.kind = kind
        topic = ros.Topic(getattr(msg, kind), self.name, ros.best_effort(DEPTH))
        ros.subscribe_counting_losses(self.node, topic, heard, count, use_default_callbacks=False)


class RecordNode:
    """Writes the streams of the graph to one trial.

    Times are those of receipt on the steady clock. With `--time stamp` they are the messages' own; a command without
    one has the node's time at its receipt.
    """

    def __init__(self, node: Any, writer: TrialWriter | SplitWriter | None, options: argparse.Namespace,
                 seconds: float = 0.0) -> None:
        """Listen on the graph, for so long [s] or without end. What comes is dropped while `writer` is None."""
        from nav_msgs.msg import Odometry
        from sensor_msgs.msg import Imu

        self.writer: Any = writer
        """What takes the rows; None while nothing is recorded."""
        self.failure: OSError | None = None
        """Why the recording ended early, such as a full disk."""
        self._started = time.monotonic()
        self._seconds = seconds
        self._node, self._by_stamp = node, options.time == "stamp"
        self._commands = StampedListener(node, options.command_topic, self._on_command)
        self.streams = [Stream(node, Odometry, options.odometry_topic, self._on_odometry),
                        Stream(node, Odometry, options.ground_truth_topic, self._on_ground_truth),
                        Stream(node, Imu, options.imu_topic, self._on_imu)]
        self._images = options.images
        self._whole: dict[str, Stream] | None = {} if options.mcap or options.images else None
        ros.steady_timer(node, LOOK_PERIOD, self._look)
        ros.steady_timer(node, 1.0, self._flush)

    def finished(self) -> bool:
        """Return whether the recording time is over, or nothing can be written any more."""
        return self.failure is not None or bool(self._seconds) and time.monotonic() - self._started > self._seconds

    def lost(self) -> dict[str, int]:
        """Return how many messages of each topic the middleware lost, where it lost any."""
        heard: list[StampedListener | Stream] = [self._commands, *self.streams, *(self._whole or {}).values()]
        return {stream.name: stream.lost for stream in heard if stream.lost}

    def _look(self) -> None:
        self._commands.look()
        for stream in self.streams:
            stream.look()
        if self._whole is not None:
            self._look_for_topics(self._whole)

    def _look_for_topics(self, known: dict[str, Stream]) -> None:
        """Listen to every topic of the graph, whose messages go whole into the MCAP file."""
        for topic, kinds in self._node.get_topic_names_and_types():
            kind = message_class(kinds[0])
            own = topic == self._commands.name  # a second reader of commands would look like a base that listens
            if topic in known or own or kind is None or (kinds[0] in IMAGES and not self._images):
                continue
            if self._node.get_publishers_info_by_topic(topic):
                known[topic] = Stream(self._node, kind, topic, self._keeper(topic, kind), raw=True)
        for stream in known.values():
            stream.look()

    def _keeper(self, topic: str, kind: Any) -> Callable[[bytes], None]:
        def keep(data: bytes) -> None:
            self._write(lambda writer: writer.message(topic, kind, data))

        return keep

    def _flush(self) -> None:
        self._write(lambda writer: writer.flush())

    def now(self) -> float:
        """Return the present time of what is recorded [s]."""
        return float(self._node.get_clock().now().nanoseconds * 1e-9) if self._by_stamp else time.monotonic()

    def _time(self, stamp: float) -> float:
        """Return the time that a message of this stamp gets."""
        return believed(stamp, self.now()) if self._by_stamp else self.now()

    def _on_command(self, message: Any, stamp: float, v: float, omega: float) -> None:
        t = self._time(stamp)
        self._write(lambda writer: writer.command(t, v, omega))
        if self._whole is not None:
            from rclpy.serialization import serialize_message

            self._keeper(self._commands.name, type(message))(serialize_message(message))

    def _on_odometry(self, message: Any) -> None:
        speed, stamp = message.twist.twist, ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        self._write(lambda writer: writer.odometry(t, planar_pose(message), (speed.linear.x, speed.angular.z), stamp))

    def _on_ground_truth(self, message: Any) -> None:
        stamp = ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        self._write(lambda writer: writer.ground_truth(t, *planar_pose(message), stamp))

    def _on_imu(self, message: Any) -> None:
        stamp = ros.stamp_seconds(message.header.stamp)
        t = self._time(stamp)
        gyro = message.angular_velocity.z if ros.is_measured(message.angular_velocity_covariance) else math.nan
        self._write(lambda writer: writer.imu(t, gyro, stamp))

    def _write(self, write: Callable[[Any], None]) -> None:
        """Write, and end the recording where that fails; the vehicle's nodes are other processes and drive on."""
        try:
            if self.writer is not None:
                write(self.writer)
        except OSError as error:
            self.failure = self.failure or error


def believed(stamp: float, now: float) -> float:
    """Return a stamp [s], or the receiver's time where there is none or it is from the future.

    Such a one counts on another clock, as that of a guard beside a simulation.
    """
    return stamp if 0 < stamp < now + AHEAD else now


def message_class(name: str) -> Any:
    """Return the class of a message such as nav_msgs/msg/Odometry; None where its package is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        return None


def planar_pose(message: Any) -> tuple[float, float, float]:
    """Return x [m], y [m], yaw [rad] of nav_msgs/Odometry; the yaw is nan where the message has no orientation."""
    position = message.pose.pose.position
    return position.x, position.y, ros.yaw_of(message.pose.pose.orientation)
