"""The numbers of one message; and the motion of two driven wheels out of what drivers publish of them: joint states,
and the state of a WHILL Model CR2.

The chair's state (whill_msgs/ModelCr2State, 2 to 20 Hz, no header) has motor angles in rad that wrap at pi, low-pass
filtered speeds in km/h, and a right motor that counts down forward. At 2 Hz the speeds say which whole turn it was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sysid.logs.bags.recording import CHAIR_STATE, COLUMNS
from sysid.logs.planar import rates_left_at_zero, twist_of_wheels, without_wraps, yaw_of

CHAIR_DEFINITION = """int32 battery_power
float32 battery_current
float32 right_motor_angle
float32 left_motor_angle
float32 right_motor_speed
float32 left_motor_speed
int32 power_on
int32 speed_mode_indicator
int32 error
"""
JOYSTICK_FIELDS = "int8 joy_front\nint8 joy_side\n"  # that newer drivers add
KMH = 1 / 3.6  # m/s
COARSE = 0.15  # s between states, above which speeds are too coarse to identify a drive from


def chair_row(state: Any) -> tuple[float, float, float, float]:
    """Left and right motor angle [rad] and speed [m/s] of a chair's state, both growing forwards."""
    return (float(state.left_motor_angle), -float(state.right_motor_angle), float(state.left_motor_speed) * KMH,
            -float(state.right_motor_speed) * KMH)


def chair_odometry(t: np.ndarray, rows: np.ndarray, wheel_radius: float, track: float) -> np.ndarray:
    """Odometry (T, 5) x, y, yaw, v, omega of a chair's `chair_row`s (T, 4), received at times (T,) [s]."""
    dt = np.diff(t)[:, None]
    expected = (rows[1:, 2:] + rows[:-1, 2:]) / 2 * dt / wheel_radius
    turned = expected + np.remainder(np.diff(rows[:, :2], axis=0) - expected + np.pi, 2 * np.pi) - np.pi
    left, right = wheel_radius * np.vstack([np.zeros(2), np.cumsum(turned, axis=0)]).T
    way, yaw = (left + right) / 2, (right - left) / track
    half = np.diff(yaw) / 2
    chord = np.diff(way) * np.sinc(half / np.pi)
    x, y = (np.append(0.0, np.cumsum(chord * turn(yaw[:-1] + half))) for turn in (np.cos, np.sin))
    return np.column_stack([x, y, yaw, np.gradient(way, t), np.gradient(yaw, t)])


def joint_twist(t: np.ndarray, rows: np.ndarray, wheel_radius: float, track: float) -> np.ndarray:
    """(T, 2) v and omega of `joint_row`s (T, 4), as `usable_joints` leaves them, at times (T,) [s]."""
    angles, rates = rows[:, :2], rows[:, 2:]
    if not np.isfinite(rates).all() or rates_left_at_zero(angles, rates):
        rates = np.gradient(np.column_stack([without_wraps(angle) for angle in angles.T]), t, axis=0)
    return np.column_stack(twist_of_wheels(rates[:, 0], rates[:, 1], wheel_radius, track))


def usable_joints(rows: np.ndarray) -> np.ndarray:
    """Which rows (T, 4) of angles and rates show a motion (T,): those with rates, or with angles where most that have
    these have no rates."""
    angles, rates = (np.isfinite(part).all(axis=1) for part in (rows[:, :2], rows[:, 2:]))
    return angles if (angles & ~rates).sum() > rates.sum() else rates


def joint_row(state: Any) -> tuple[float, float, float, float]:
    """Left and right angle [rad] and rate [rad/s], means over a side's wheels: nan without, inf without any wheel."""
    sides = wheel_joints(state.name)
    if sides is None:
        return (float("inf"),) * 4

    def mean(values: Sequence[float], side: int) -> float:
        return float(np.mean([values[k] for k in sides[side]])) if len(values) == len(state.name) else float("nan")

    return mean(state.position, 0), mean(state.position, 1), mean(state.velocity, 0), mean(state.velocity, 1)


def wheel_joints(names: Sequence[str]) -> tuple[list[int], list[int]] | None:
    """Indices of the left and of the right wheels among joints; None where there are not both."""
    wheels = [k for k, name in enumerate(names) if "wheel" in name.lower() and "caster" not in name.lower()]
    wheels = wheels or [k for k, name in enumerate(names) if "caster" not in name.lower()]
    left = [k for k in wheels if "left" in names[k].lower() or names[k].lower().startswith(("l_", "fl_", "rl_"))]
    right = [k for k in wheels if "right" in names[k].lower() or names[k].lower().startswith(("r_", "fr_", "rr_"))]
    return (left, right) if left and right else None


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
