"""The topics of a policy's sensors: which message carries what, for the node that drives and for the simulator."""

from __future__ import annotations

import array
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bridge.nodes import ros
from bridge.policy import SensorInput, pacer_of
from bridge.sensing.senses import FULL_TURN, REACH, Scan, SenseError, numbers, rays_of
from bridge.sensing.view import View

BODY_FRAMES = ("base_link", "base_footprint")
"""Frames in which a goal may be given: ahead and to the left of the vehicle itself."""
Reading = tuple[np.ndarray, int]
"""A value in the form of the policy's input, and a hash of what was measured."""


@dataclass(frozen=True)
class SenseTopic:
    """Where a sensor's messages are."""

    topic: str
    kind: str
    """Message type, such as sensor_msgs/LaserScan."""

    @property
    def message(self) -> Any:
        """The class of the messages."""
        return ros.message_type(self.kind)

    @property
    def full_kind(self) -> str:
        """The type as the graph names it."""
        return self.kind.replace("/", "/msg/")


def topics_of(sensors: Mapping[str, SensorInput]) -> dict[str, SenseTopic]:
    """Return the topic of each sensor by name; what the bridge itself knows has none.

    The first camera and the first lidar have the usual topics, further ones a topic of their own name.
    """
    found: dict[str, SenseTopic] = {}
    kinds = {"camera": ("sensor_msgs/Image", ros.IMAGE_TOPIC, "sensing/camera/{}/image_raw"),
             "lidar": ("sensor_msgs/LaserScan", ros.SCAN_TOPIC, "sensing/lidar/{}/scan"),
             "odometry": ("nav_msgs/Odometry", ros.ODOMETRY_TOPIC, "sensing/{}"),
             "imu": ("sensor_msgs/Imu", ros.IMU_TOPIC, "sensing/{}"),
             "goal": ("geometry_msgs/PointStamped", ros.GOAL_TOPIC, "sensing/{}")}
    used = set()
    pacer = pacer_of(sensors)
    for name, one in sorted(sensors.items(), key=lambda pair: (pair[1] is not pacer, pair[0])):
        if one.kind in kinds:
            kind, first, further = kinds[one.kind]
            found[name] = SenseTopic(further.format(name) if one.kind in used else first, kind)
            used.add(one.kind)
    return found


def reader_of(sensor: SensorInput, unwrap: Callable[[str, np.ndarray], np.ndarray]) -> Callable[[Any], Reading]:
    """Return the function that turns the messages of a sensor into values of the policy's input.

    Args:
        sensor: what the policy reads.
        unwrap: makes the yaw of the odometry of that name go on over a half turn.

    The function raises SenseError or ImageError where a message cannot be used.
    """
    if sensor.kind == "camera":
        view = View(sensor.size)

        def image(message: Any) -> Reading:
            value = view.raw(message)
            return value, zlib.crc32(value.data)

        return image
    if sensor.kind == "lidar":
        return lambda message: _scan(message, sensor)
    if sensor.kind == "odometry":
        return lambda message: _stamped(unwrap(sensor.name, _pose(message)), message)
    return {"imu": _imu, "goal": _goal}[sensor.kind]


def _counted(value: np.ndarray) -> Reading:
    """A value with a hash of its bytes."""
    return value, zlib.crc32(value.tobytes())


def _stamped(value: np.ndarray, message: Any) -> Reading:
    """A value with a hash of its stamp: it may stay the same until the vehicle moves, though its sensor works."""
    return value, hash((message.header.stamp.sec, message.header.stamp.nanosec))


def _scan(message: Any, sensor: SensorInput) -> Reading:
    ranges = np.asarray(message.ranges, np.float32)
    scan = Scan(message.angle_min, message.angle_increment, message.range_min, message.range_max, ranges)
    rays = rays_of(scan, sensor)
    empty = rays.min() >= float(sensor.settings.get("reach", REACH))
    # in a wide hall nothing changes, and yet the scanner works
    return _stamped(rays, message) if empty else (rays, zlib.crc32(ranges.tobytes()))


def _pose(message: Any) -> np.ndarray:
    p, twist = message.pose.pose.position, message.twist.twist
    values = p.x, p.y, ros.yaw_of(message.pose.pose.orientation), twist.linear.x, twist.angular.z
    numbers(*values)  # an orientation of zeros is none, and has no yaw
    return np.array(values)  # not rounded: far from the origin of a map float32 has steps of half a metre


def _imu(message: Any) -> Reading:
    force, turn = message.linear_acceleration, message.angular_velocity
    if not (ros.is_measured(message.linear_acceleration_covariance)
            and ros.is_measured(message.angular_velocity_covariance)):
        raise SenseError("the message says by a covariance of -1 that it measures no specific force or no angular "
                         "velocity, and the policy needs both. Name an IMU that measures them.")
    return _counted(numbers(force.x, force.y, force.z, turn.x, turn.y, turn.z))


def _goal(message: Any) -> Reading:
    frame = message.header.frame_id
    if frame.rpartition("/")[2] not in BODY_FRAMES:
        raise SenseError(f"the goal is given in the frame {frame[:40]!r}; it must be in {' or '.join(BODY_FRAMES)}, "
                         "ahead and to the left of the vehicle. Transform it before.")
    return _stamped(numbers(message.point.x, message.point.y), message)


def message_of(header: Any, sensor: SensorInput, value: np.ndarray, period: float) -> Any:
    """Return the message that carries a value of a policy's input, as the simulator publishes it."""
    from bridge.simulation.simulated_messages import ODOMETRY_DEVIATION, image_message, pose_message

    if sensor.kind == "camera":
        return image_message(header, value)
    if sensor.kind == "odometry":
        return pose_message(header, tuple(map(float, value)), ODOMETRY_DEVIATION)  # type: ignore[arg-type]
    x = [float(one) for one in value]
    if sensor.kind == "goal":
        from geometry_msgs.msg import Point, PointStamped

        return PointStamped(header=header, point=Point(x=x[0], y=x[1]))
    if sensor.kind == "imu":
        from sensor_msgs.msg import Imu

        message = Imu(header=header)
        message.orientation_covariance[0] = -1.0  # no orientation
        (message.linear_acceleration.x, message.linear_acceleration.y, message.linear_acceleration.z,
         message.angular_velocity.x, message.angular_velocity.y, message.angular_velocity.z) = x
        return message
    from sensor_msgs.msg import LaserScan

    fov, reach = float(sensor.settings.get("fov", FULL_TURN)), float(sensor.settings.get("reach", REACH))
    message = LaserScan(header=header, range_max=reach, scan_time=period, angle_increment=fov / len(value))
    message.angle_min = -fov / 2 + message.angle_increment / 2
    message.angle_max = message.angle_min + fov - message.angle_increment
    message.ranges = array.array("f", np.where(value >= reach, np.inf, value).astype(np.float32).tobytes())
    return message
