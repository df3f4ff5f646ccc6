"""Motion in the plane: headings of quaternions, poses in other frames, speeds of poses, and what speeds add up to."""

from __future__ import annotations

import numpy as np

DIFFERENCED = 0.2  # s over which a pose is differenced to speeds
TURN = 2 * np.pi * 1.02  # rad of an angle that wraps at a turn, with some noise
AS_SAID = 0.01  # rad^2 of turns beside which the turns that are expected count as they are
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


def turned_by(
    x: np.ndarray | float, y: np.ndarray | float, angle: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """x and y (T,) or () turned to the left by angles (T,) or () [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * x - sin * y, sin * x + cos * y


def half_span(t: np.ndarray) -> float:
    """Half of the time [s] over which a pose at times (T,) is differenced."""
    return max(DIFFERENCED / 2, float(np.median(np.diff(t))))


def differenced(t: np.ndarray, values: np.ndarray, when: np.ndarray, half: float) -> np.ndarray:
    """Rates (G,) of values (T,) at times `when` (G,), between half a span before and after [s]."""
    return np.asarray((np.interp(when + half, t, values) - np.interp(when - half, t, values)) / (2 * half))


def pose_speeds(t: np.ndarray, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forward speed and yaw rate (T,) of a pose (T,) whose yaw does not wrap, over `DIFFERENCED` seconds."""
    half = half_span(t)
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


def rates_left_at_zero(angles: np.ndarray, rates: np.ndarray) -> bool:
    """Whether a driver leaves the rates (T, 2) of two wheels at 0, while their angles (T, 2) [rad] move."""
    return bool(not rates.any() and np.isfinite(angles).all() and np.ptp(angles, axis=0).any())


def unwrapped(yaw: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Heading (T,) without jumps of full turns [rad].

    Between two rows it may turn further than half a turn, where others were lost. Turns (T - 1,) that are `expected`
    then show by how many full turns, by as much as it follows them elsewhere: wheels that slide turn a vehicle less.
    """
    steps, sure = np.diff(yaw), np.abs(expected) < np.pi / 2
    plain = steps - 2 * np.pi * np.round(steps / (2 * np.pi))
    share = (AS_SAID + plain[sure] @ expected[sure]) / (AS_SAID + expected[sure] @ expected[sure])
    turns = np.round((steps - share * expected) / (2 * np.pi))
    return np.asarray(yaw - 2 * np.pi * np.append(0.0, np.cumsum(turns)))


def added_up(when: np.ndarray, rate: np.ndarray, t: np.ndarray) -> np.ndarray:
    """What a rate (T,) at times `when` (T,) [s] adds up to at times t (M,) from its first; before it was as then."""
    added = np.append(0.0, np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(when)))
    return np.asarray(np.interp(t, when, added) + np.minimum(t - when[0], 0.0) * rate[0])


def integrate_speeds(t: np.ndarray, v: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dead reckoning of speeds (T,): x, y and yaw that an odometry would report that only logged its wheels."""
    yaw, steps = added_up(t, omega, t), (v[1:] + v[:-1]) / 2 * np.diff(t)
    middle = (yaw[1:] + yaw[:-1]) / 2
    x, y = (np.append(0.0, np.cumsum(steps * turn(middle))) for turn in (np.cos, np.sin))
    return x, y, yaw
