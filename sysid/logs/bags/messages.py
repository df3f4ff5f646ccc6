"""The numbers of one message."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sysid.logs.bags.recording import CHAIR_STATE, COLUMNS
from sysid.logs.bags.wheel_states import chair_row, joint_row
from sysid.logs.planar import yaw_of


def read_message(stream: str, kind: str, message: Any) -> tuple[float, ...]:
    """`COLUMNS` of one message: all nan where a number is not finite, and inf where the orientation was never set."""
    row = _columns(stream, kind, message)
    whole = all(map(math.isfinite, row)) or all(map(math.isinf, row)) or kind == "JointState"
    return row if whole else (math.nan,) * len(row)


def _columns(stream: str, kind: str, message: Any) -> tuple[float, ...]:
    if kind == CHAIR_STATE:
        return chair_row(message)
    if kind == "Imu":
        return (float(message.angular_velocity.z),)
    if kind == "JointState":
        return joint_row(message)
    if stream == "command":
        twist = _inner(message, "twist")
        return float(twist.linear.x), float(twist.angular.z)
    pose = message.transform if kind == "TransformStamped" else _inner(message, "pose")
    position = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    if abs(q.w) + abs(q.x) + abs(q.y) + abs(q.z) < 1e-6:
        return (float("inf"),) * len(COLUMNS[stream])
    planar = float(position.x), float(position.y), float(yaw_of(q.w, q.x, q.y, q.z))
    if stream == "ground_truth":
        return planar
    speed = _inner(message, "twist")
    return *planar, float(speed.linear.x), float(speed.angular.z)


def _inner(message: Any, name: str) -> Any:
    """The twist or the pose in a message, which may have a header or covariances around it."""
    while hasattr(message, name):
        message = getattr(message, name)
    return message


def header_time(message: Any) -> float:
    """Header stamp [s]; nan where the message has none."""
    header = getattr(message, "header", None)
    return float("nan") if header is None else header.stamp.sec + header.stamp.nanosec * 1e-9


def frames_of(message: Any) -> str:
    """Names of the frames of a message, parent and child; empty where it has none."""
    parent, child = getattr(getattr(message, "header", None), "frame_id", ""), getattr(message, "child_frame_id", "")
    return " to ".join(one for name in (parent, child) if (one := str(name).strip("/")))


def without_stamp(stamped: np.ndarray) -> np.ndarray:
    """Which stamps (T,) [s] are zero although most are set: of a driver that does set them (T,) bool."""
    zero = stamped <= 0
    return zero if zero.mean() < 0.5 else np.zeros(len(stamped), bool)


def sideways_speed(message: Any) -> float:
    """Size of the speed to the side that a command asks for [m/s]; 0 where it has none."""
    twist = getattr(message, "twist", message)
    size = abs(float(getattr(getattr(twist, "linear", None), "y", 0.0)))
    return size if math.isfinite(size) else 0.0
