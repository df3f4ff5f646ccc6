"""The WHILL Model CR2 as its maker's ROS 2 driver shows it: pure functions, no ROS.

Sources: the driver's whill_node.cpp and whill.cpp (commands, units, fields), the serial specification (ranges, expiry),
and a drive of 2026-06-14 by users of a CR2 (the right wheel counts down when the chair drives forward). The driver
itself limits nothing, has no time-out and publishes no odometry.
"""

import math
import statistics
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

from bridge.driving.bases import WHILL_SPEED_UNITS, WHILL_TURN_UNITS
from bridge.safeguards.safety import Supervisor

WHEEL_RADIUS = 0.1325
"""[m], of the maker's driver and URDF; a loaded tyre is smaller: measure it."""
TREAD = 0.496
"""[m], of the maker's driver."""
KMH = 1 / 3.6
"""One km/h in m/s."""
STATE_AGE = 1.5
"""Seconds after which the chair's state is unknown: three of the driver's default intervals of 500 ms."""
JOYSTICK_MOVED = 10
"""Deflection of the chair's joystick [%] that counts as its rider taking over."""
BATTERY_LOW = 20
"""[%]; below it the bridge does not drive."""
JOYSTICK_QUIET = 1.0
"""Seconds for which a moved joystick counts as a driver: two intervals of the state."""
POWER, ERROR = "the chair's power is off", "the chair reports an error"
BATTERY, UNKNOWN = "battery low", "chair state unknown"


@dataclass(frozen=True)
class ChairState:
    """Fields of whill_msgs/ModelCr2State in the driver's own units and signs."""

    right_motor_angle: float = 0.0
    """[rad], wraps at +-pi, falls while the chair drives forward."""
    left_motor_angle: float = 0.0
    """[rad], wraps at +-pi, rises while the chair drives forward."""
    right_motor_speed: float = 0.0
    """[km/h], low-pass filtered, negative while the chair drives forward."""
    left_motor_speed: float = 0.0
    """[km/h], low-pass filtered."""
    power_on: int = 1
    error: int = 0
    """Code of the chair; 0: none."""
    battery_power: int = 100
    """[%]"""
    joy_front: int = 0
    """Joystick of the chair, forward [%]; 0 where the driver does not report it."""
    joy_side: int = 0
    """To the right [%]."""

    @classmethod
    def of(cls, message: Any) -> "ChairState":
        """Return the state of a message; fields that older drivers lack keep their defaults."""
        return cls(**{name: getattr(message, name) for name in cls.__dataclass_fields__ if hasattr(message, name)})

    @property
    def is_finite(self) -> bool:
        """Whether all angles and speeds of the motors are numbers: no odometry follows from others."""
        return all(map(math.isfinite, (self.right_motor_angle, self.left_motor_angle, self.right_motor_speed,
                                       self.left_motor_speed)))


@dataclass(frozen=True)
class Odometry:
    """Pose and speed of the drive-axle centre."""

    x: float = 0.0
    """[m]"""
    y: float = 0.0
    """[m]"""
    yaw: float = 0.0
    """[rad], not wrapped."""
    v: float = 0.0
    """[m/s]"""
    omega: float = 0.0
    """[rad/s]"""


def reported_speed(state: ChairState, tread: float = TREAD) -> tuple[float, float]:
    """Return v [m/s] and omega [rad/s] that the motors' filtered speeds mean."""
    left, right = state.left_motor_speed * KMH, -state.right_motor_speed * KMH
    return (left + right) / 2, (right - left) / tread


def command_words(v: float, omega: float) -> tuple[int, int]:
    """Return the forward and turn word that the driver makes of a command, truncated towards zero.

    One forward unit is 1.11 mm/s, one turn unit 2.24 mrad/s; the turn word has the opposite sign of omega.
    """
    return int(v * WHILL_SPEED_UNITS), int(omega * -WHILL_TURN_UNITS)


def command_of_words(forward: int, turn: int) -> tuple[float, float]:
    """Return v [m/s] and omega [rad/s] that the chair aims at."""
    return forward / WHILL_SPEED_UNITS, -turn / WHILL_TURN_UNITS


class WheelOdometry:
    """Integrates the motors' angles; pure, with injected time."""

    def __init__(self, wheel_radius: float = WHEEL_RADIUS, tread: float = TREAD, longest_gap: float = 2.0) -> None:
        """Start at the origin.

        Args:
            wheel_radius: of the drive wheels [m].
            tread: between the drive wheels [m].
            longest_gap: longest time [s] between two states that is bridged; after a longer one the pose stays.
        """
        self.pose = Odometry()
        self.gaps = 0
        """Gaps that were too long."""
        self._radius, self._tread, self._longest_gap = wheel_radius, tread, longest_gap
        self._last: tuple[float, ChairState] | None = None
        self._intervals: deque[float] = deque(maxlen=5)
        self._places: deque[tuple[float, float, float]] = deque(maxlen=5)  # last times [s], ways [m], yaws [rad]
        self._way = 0.0

    def update(self, now: float, state: ChairState) -> Odometry:
        """Take a state at a steady time [s]; return pose and mean speed since the last one.

        A state has no stamp, and one that was held up comes just before the next one. So what comes sooner than half
        the usual interval gives the mean speed since the one before that.
        """
        before, self._last = self._last, (now, state)
        if before is not None and now <= before[0]:
            return self.pose
        elapsed = now - before[0] if before is not None else math.inf
        if before is None or elapsed > self._longest_gap:
            self.gaps += before is not None
            self._places.clear()
            v, omega = reported_speed(state, self._tread)
            self.pose = replace(self.pose, v=v, omega=omega)
            return self.pose
        left = self._travel(before[1].left_motor_angle, state.left_motor_angle,
                            before[1].left_motor_speed, state.left_motor_speed, elapsed)
        right = -self._travel(before[1].right_motor_angle, state.right_motor_angle,
                              before[1].right_motor_speed, state.right_motor_speed, elapsed)
        distance, turn = (left + right) / 2, (right - left) / self._tread
        pose, half = self.pose, turn / 2
        chord = distance * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        self._places.append((before[0], self._way, pose.yaw))
        self._intervals.append(elapsed)
        self._way += distance
        v, omega = self._speed(now, pose.yaw + turn)
        self.pose = Odometry(pose.x + chord * math.cos(pose.yaw + half), pose.y + chord * math.sin(pose.yaw + half),
                             pose.yaw + turn, v, omega)
        return self.pose

    def _speed(self, now: float, yaw: float) -> tuple[float, float]:
        """Return v [m/s] and omega [rad/s] since the newest place that is half a usual interval old, or the oldest."""
        least = statistics.median(self._intervals) / 2
        at, way, before = next((one for one in reversed(self._places) if now - one[0] >= least), self._places[0])
        return (self._way - way) / (now - at), (yaw - before) / (now - at)

    def _travel(self, before: float, after: float, speed_before: float, speed_after: float, elapsed: float) -> float:
        """Return how far a wheel rolled [m].

        The angle is known but for whole turns: at 500 ms a wheel of a chair at 0.83 m/s makes half a turn. The filtered
        speeds say which whole turn.
        """
        expected = (speed_before + speed_after) / 2 * KMH * elapsed / self._radius
        return self._radius * (expected + math.remainder(after - before - expected, 2 * math.pi))


class ChairGate:
    """Lets the policy drive only a chair that is on, sound, charged, heard of, and not driven by its own joystick."""

    def __init__(self, supervisor: Supervisor, battery_low: float = BATTERY_LOW) -> None:
        """Hold the supervisor until a first state has come."""
        self.supervisor = supervisor
        self.error = 0
        """Code that the chair reports; 0: none."""
        self._battery_low = battery_low
        self._heard = -math.inf
        self._joystick = -math.inf
        supervisor.block(UNKNOWN, True)

    def take(self, now: float, state: ChairState) -> None:
        """Take a state of the chair."""
        self._heard, self.error = now, state.error
        self.supervisor.block(POWER, not state.power_on)
        self.supervisor.block(ERROR, bool(state.error), latching=True)
        self.supervisor.block(BATTERY, state.battery_power < self._battery_low)
        if max(abs(state.joy_front), abs(state.joy_side)) >= JOYSTICK_MOVED:
            self._joystick = now
        self.watch(now)

    def watch(self, now: float) -> None:
        """Hold the vehicle while its state is unknown, and yield while its rider moves the joystick."""
        self.supervisor.block(UNKNOWN, now - self._heard > STATE_AGE)
        if now - self._joystick < JOYSTICK_QUIET:
            self.supervisor.foreign_command(now)
