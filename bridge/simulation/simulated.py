"""What any simulator behind the vehicle's topics gives, and how its time and its episodes are kept; no ROS."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

SCAN_RANGE, SCAN_HEIGHT, SCAN_RAYS = 10.0, 0.2, 360
"""Range of the scanner [m], its height above the ground [m], rays around the vehicle."""


@dataclass(frozen=True)
class Grid:
    """A map of the room as nav2 has it."""

    occupied: np.ndarray
    """(H, W) bool, by y and x."""
    resolution: float
    """Edge of a cell [m]."""
    x: float
    """Of the corner of the first cell in the room [m]."""
    y: float
    """[m]"""


@dataclass(frozen=True)
class Frame:
    """What is known at the end of a control period."""

    image: np.ndarray
    """(H, W, 3) uint8 rgb8."""
    x: float
    """Drive-axle centre in the room [m]."""
    y: float
    """[m]"""
    yaw: float
    """[rad]"""
    v: float
    """True forward speed [m/s]."""
    omega: float
    """True yaw rate [rad/s]."""
    collided: bool = False
    reached_goal: bool = False
    done: bool = False
    terminated: bool = False
    """Whether the episode ended by itself; one that is done and not terminated ran out of time."""
    reward: float = 0.0
    """Of the last period, where the simulator has one."""
    odometry: tuple[float, float, float, float, float] | None = None
    """x, y, yaw, v, omega as the vehicle's own odometry reports them; None where the simulator has none."""
    ranges: np.ndarray | None = None
    """(N,) free distances [m] around the drive-axle centre, evenly spaced, the first one straight ahead, growing to the
    left; SCAN_RANGE where nothing is. None where the simulator has no scanner."""
    sensed: Mapping[str, np.ndarray] = field(default_factory=dict)
    """What the sensors of a policy show, by the names of its inputs."""


class SimulatedVehicle(Protocol):
    """Any simulator that can be driven one control period at a time."""

    period: float
    """Control period [s]."""
    intrinsics: tuple[float, float, float, float]
    """Optional: focal lengths and principal point of the camera, fx, fy, cx, cy [pixels]."""
    grid: Grid | None
    """Optional: map of the episode's room; None where there is none."""
    sensors: Mapping[str, Any]
    """Optional: the `SensorInput` of each value in a frame's `sensed`."""

    def reset(self, seed: int) -> Frame:
        """Begin an episode."""

    def step(self, v: float, omega: float) -> Frame:
        """Advance one control period with the command v [m/s], omega [rad/s]."""


@dataclass
class Episode:
    """Outcome of one episode, for the results file."""

    seed: int
    steps: int = 0
    collided: bool = False
    reached_goal: bool = False
    x: float = 0.0
    """Last place of the drive-axle centre [m]."""
    y: float = 0.0
    commands: int = 0
    began: float = 0.0
    """Steady time of the first image [s]."""
    ended: float = 0.0
    """Steady time of the last image [s]."""

    def summary(self) -> str:
        """Return the outcome in words."""
        how = "collided" if self.collided else "arrived" if self.reached_goal else "neither arrived nor collided"
        return (f"{how} after {self.steps} steps and {self.commands} commands, at x {self.x:.2f} m, y {self.y:.2f} m "
                f"(seed {self.seed})")


class SimulatedClock:
    """Simulated time: what stamps count in, and what a control period lasts on the steady clock; pure.

    Without `published` stamps are those of the node's own clock, and simulated time is the wall clock's.
    """

    def __init__(self, speed: float, published: bool) -> None:
        """Set how many simulated seconds pass in one second, and whether the time is published on /clock."""
        self.speed, self.published = speed, published
        self.now = 0.0
        """Simulated seconds since the start."""

    def advance(self, seconds: float) -> None:
        """Let simulated time pass."""
        self.now += seconds

    def stamp(self) -> tuple[int, int]:
        """Return seconds and nanoseconds of the simulated time, which begins at 1 s: a stamp of 0 means none."""
        seconds, nanoseconds = divmod(round(self.now * 1e9), 1_000_000_000)
        return seconds + 1, nanoseconds


def halfway(a: Frame, b: Frame) -> Frame:
    """Return the frame in the middle of two; angles go the short way round."""
    def middle(p: tuple[float, ...], q: tuple[float, ...]) -> tuple[float, ...]:
        turn = math.remainder(q[2] - p[2], 2 * math.pi)
        return (p[0] + q[0]) / 2, (p[1] + q[1]) / 2, p[2] + turn / 2, (p[3] + q[3]) / 2, (p[4] + q[4]) / 2

    x, y, yaw, v, omega = middle((a.x, a.y, a.yaw, a.v, a.omega), (b.x, b.y, b.yaw, b.v, b.omega))
    odometry = None if a.odometry is None or b.odometry is None else middle(a.odometry, b.odometry)
    return Frame(a.image, x, y, yaw, v, omega, odometry=odometry)  # type: ignore[arg-type]  # five numbers each


def enlarge(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the image at (height, width) by repeating pixels, as a camera of that size would send it."""
    rows = np.arange(size[0]) * image.shape[0] // size[0]
    columns = np.arange(size[1]) * image.shape[1] // size[1]
    return image[rows[:, None], columns]
