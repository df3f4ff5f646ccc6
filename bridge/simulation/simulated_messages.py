"""The messages of the simulator's topics, filled as ordinary ROS tools expect them."""

import array
import math
from typing import Any

import numpy as np

from bridge.simulation.simulated import SCAN_RANGE, Grid

OCCUPIED, FREE = 100, 0
"""Of nav_msgs/OccupancyGrid [%]."""
TRUTH_DEVIATION = (1e-3, 1e-3)
"""Standard deviations that the ground truth states, of a position [m] and a heading [rad]."""
ODOMETRY_DEVIATION = (0.05, 0.05)
"""The same of the odometry, whose drift grows: what a filter may take it for over some metres."""
TWIST_DEVIATION = (0.02, 0.02)
"""Of the speeds [m/s, rad/s]."""
UNKNOWN_VARIANCE = 1e6
"""Variance of what a planar vehicle does not measure: height, roll, pitch."""


def planar_covariance(x: float, y: float, yaw: float) -> list[float]:
    """Return the 36 numbers of a ROS covariance of a planar vehicle from its standard deviations."""
    variances = (x * x, y * y, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, yaw * yaw)
    return [variances[i] if i == j else 0.0 for i in range(6) for j in range(6)]


def pose_message(header: Any, values: tuple[float, float, float, float, float], deviation: tuple[float, float]) -> Any:
    """Return nav_msgs/Odometry of x, y [m], yaw [rad], v [m/s], omega [rad/s] and the deviations of a pose."""
    from nav_msgs.msg import Odometry

    x, y, yaw, v, omega = (float(value) for value in values)
    message = Odometry(header=header, child_frame_id="base_link")
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    message.twist.twist.linear.x, message.twist.twist.angular.z = v, omega
    message.pose.covariance = planar_covariance(deviation[0], deviation[0], deviation[1])
    message.twist.covariance = planar_covariance(TWIST_DEVIATION[0], TWIST_DEVIATION[0], TWIST_DEVIATION[1])
    return message


def image_message(header: Any, image: np.ndarray) -> Any:
    """Return sensor_msgs/Image of an image (H, W, 3) uint8."""
    from sensor_msgs.msg import Image

    message = Image(header=header, encoding="rgb8", step=image.shape[1] * 3)
    message.height, message.width = image.shape[:2]
    message.data = array.array("B", image.tobytes())  # an ndarray would be copied byte by byte
    return message


def camera_info(image: Any, intrinsics: tuple[float, ...], size: tuple[int, ...]) -> Any:
    """Return sensor_msgs/CameraInfo of an ideal pinhole for an image message that was enlarged from `size`."""
    from sensor_msgs.msg import CameraInfo

    rows, columns = image.height / size[0], image.width / size[1]
    fx, fy, cx, cy = (one * scale for one, scale in zip(intrinsics, (columns, rows, columns, rows), strict=True))
    info = CameraInfo(header=image.header, height=image.height, width=image.width)
    info.distortion_model, info.d = "plumb_bob", [0.0] * 5
    info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def scan_message(header: Any, ranges: np.ndarray, scan_time: float) -> Any:
    """Return sensor_msgs/LaserScan; REP 117: infinite where nothing is within the range."""
    from sensor_msgs.msg import LaserScan

    message = LaserScan(header=header, range_max=SCAN_RANGE, scan_time=scan_time)
    message.angle_increment = 2 * math.pi / len(ranges)
    message.angle_max = 2 * math.pi - message.angle_increment
    message.ranges = array.array("f", np.where(ranges >= SCAN_RANGE, np.inf, ranges).astype(np.float32).tobytes())
    return message


def grid_message(header: Any, grid: Grid) -> Any:
    """Return nav_msgs/OccupancyGrid, as nav2's map server publishes it."""
    from nav_msgs.msg import OccupancyGrid

    message = OccupancyGrid(header=header)
    message.info.map_load_time, message.info.resolution = header.stamp, grid.resolution
    message.info.height, message.info.width = grid.occupied.shape
    message.info.origin.position.x, message.info.origin.position.y = grid.x, grid.y
    message.info.origin.orientation.w = 1.0
    message.data = array.array("b", np.where(grid.occupied, OCCUPIED, FREE).astype(np.int8).tobytes())
    return message


def between(outer: tuple[float, ...], inner: tuple[float, ...]) -> tuple[float, float, float]:
    """Return x, y, yaw of the frame in which a pose is `inner`, where it is `outer` in the room: map to odom."""
    yaw = math.remainder(outer[2] - inner[2], 2 * math.pi)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return outer[0] - cos * inner[0] + sin * inner[1], outer[1] - sin * inner[0] - cos * inner[1], yaw
