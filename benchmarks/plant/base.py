"""What an effect may touch: the chair, the messages, the set-points, the torques, the loads, the report.

An effect overrides the methods of the places where it acts; everything else passes through. `size` is in the unit that
the table in `effects.py` states, and size 0 is the plain chair.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from benchmarks.plant.chair import Chair

TICK = 0.004  # s: sample time of the wheel-speed controllers
FRAME = 0.02  # s: sample time of the odometry


@dataclass
class Moment:
    """What is true at one tick; pairs are left, right."""

    t: float = 0.0
    """Since the start of the trial [s]."""
    session: float = 0.0
    """Since the start of the dataset's first trial [s]."""
    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    """Drive-axle centre in the room [m, rad]."""
    v: float = 0.0
    side: float = 0.0
    omega: float = 0.0
    """Speed of the drive-axle centre forward and to the left [m/s], yaw rate [rad/s]."""
    spin: tuple[float, float] = (0.0, 0.0)
    """Wheel speeds [rad/s]."""
    angle: tuple[float, float] = (0.0, 0.0)
    """Wheel angles since the start [rad]."""
    torque: tuple[float, float] = (0.0, 0.0)
    """Drive torques of the tick before [N m]."""


@dataclass
class Load:
    """What acts on the chair during one tick beside its drives: filled by effects, applied by the plant."""

    wheel: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Torque on each wheel about its axle [N m]."""
    forward: float = 0.0
    left: float = 0.0
    """Force on the chassis in its own frame [N]."""
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    """Torque on the chassis about its own axes, from the drive-axle centre [N m]."""

    def push(self, forward: float, left: float, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
        """Add a force at a point (x, y, z) of the chassis."""
        self.forward += forward
        self.left += left
        self.yaw += x * left - y * forward
        self.pitch += z * forward
        self.roll -= z * left


class Effect:
    """One physical effect of one size; a new one is made for every trial, so memory may live in attributes.

    Args:
        size: in the unit of the table.
        random: private to effect and trial.
        chair: as it is on that day, with all effects on the chair done.
    """

    def __init__(self, size: float, random: np.random.Generator, chair: Chair) -> None:
        self.size, self.random, self.chair = size, random, chair
        self.start()

    def start(self) -> None:
        """Set up memory."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        """The chair with the effect built in."""
        return chair

    def messages(self, messages: np.ndarray) -> np.ndarray:
        """Messages (T, 3) as they reach the controller: t, v, omega; rows may be late or missing."""
        return messages

    def command(self, command: np.ndarray) -> np.ndarray:
        """Commands (K, 2) v, omega in force at every tick."""
        return command

    def target(self, target: np.ndarray) -> np.ndarray:
        """Wanted wheel speeds (K, 2) [rad/s] at every tick."""
        return target

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        """Drive torques [N m] that the motors make of the wanted ones."""
        return left, right

    def load(self, moment: Moment, load: Load) -> None:
        """Add forces and torques."""

    def scale(self) -> float:
        """Radius that the odometry assumes, over the nominal one."""
        return 1.0

    def stamps(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For reports due at t (M,): the times at which they were true, and the times written beside them."""
        return t, t
