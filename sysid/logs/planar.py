"""Motion in the plane: the heading of a quaternion, the speeds of a pose, and the pose that speeds add up to."""

import numpy as np

DIFFERENCED = 0.2  # s over which a pose is differenced to speeds
TURN = 2 * np.pi * 1.02  # rad of an angle that wraps at a turn, with some noise
RESET = 10.0  # times the 99th percentile of its steps by which an encoder changes where its counter begins anew


def yaw_of(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Heading [rad] (T,) or () of quaternions of any length."""
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def twist_of_wheels(
    left: np.ndarray, right: np.ndarray, wheel_radius: float, track: float
) -> tuple[np.ndarray, np.ndarray]:
    """v [m/s] and omega [rad/s] of an ideal differential drive, from its wheel speeds [rad/s], or those of its rims and
    a radius of 1."""
    return wheel_radius * (left + right) / 2, wheel_radius * (right - left) / track


def pose_speeds(t: np.ndarray, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forward speed and yaw rate (T,) of a pose (T,) whose yaw does not wrap, over `DIFFERENCED` seconds."""
    half = max(DIFFERENCED / 2, float(np.median(np.diff(t))))
    low, high = np.clip(t - half, t[0], t[-1]), np.clip(t + half, t[0], t[-1])
    dx, dy, turn = (np.interp(high, t, one) - np.interp(low, t, one) for one in (x, y, yaw))
    return (np.cos(yaw) * dx + np.sin(yaw) * dy) / (high - low), turn / (high - low)


def without_wraps(angle: np.ndarray) -> np.ndarray:
    """Angle (T,) of a wheel [rad] that goes on over turns. One that leaves a turn does so already, however far it gets
    between two samples; but a counter of many turns may overflow, or begin anew with its driver."""
    if np.subtract(*np.percentile(angle, (99, 1))) <= TURN:  # one odd sample does not make it a counter of turns
        return np.unwrap(angle)
    steps = np.diff(angle)
    over = np.abs(steps) > max(np.pi, RESET * float(np.percentile(np.abs(steps), 99)))
    if over.any() and not over.all():
        steps[over] = np.interp(np.flatnonzero(over), np.flatnonzero(~over), steps[~over])
    return np.concatenate([angle[:1], angle[0] + np.cumsum(steps)])


def integrate_speeds(t: np.ndarray, v: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dead reckoning of speeds (T,): x, y and yaw that an odometry would report that only logged its wheels."""
    dt = np.diff(t)
    turn = (omega[1:] + omega[:-1]) / 2 * dt
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    step, middle = (v[1:] + v[:-1]) / 2 * dt, yaw[:-1] + turn / 2
    return (np.concatenate([[0.0], np.cumsum(step * np.cos(middle))]),
            np.concatenate([[0.0], np.cumsum(step * np.sin(middle))]), yaw)
