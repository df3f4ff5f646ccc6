"""What a policy reads beside the sensor that paces it: further cameras, laser scans, odometry, goal; no ROS.

Each of them has a limit of age of its own and holds the vehicle while it is older. Times `now` are seconds of a steady
clock.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bridge.policy import SensorInput
from bridge.safeguards.safety import Command, SafetyConfig, Supervisor
from bridge.sensing.frames import FrameWatch

AGE = 2.5
"""Periods after which a value is too old, as for the camera: 250 ms at 10 Hz."""
PATIENCE = 0.02
"""Seconds that a camera waits for the other cameras of its period."""
FULL_TURN, REACH = 2 * math.pi, 10.0
"""Field of view [rad] and reach [m] of a lidar whose file names none."""


class SenseError(ValueError):
    """The message does not give what the policy needs; it is to be dropped."""


@dataclass(frozen=True)
class Scan:
    """The numbers of a sensor_msgs/LaserScan."""

    angle_min: float
    """[rad], from straight ahead to the left."""
    angle_increment: float
    """[rad], negative where the scanner turns to the right."""
    range_min: float
    range_max: float
    ranges: np.ndarray
    """(N,) [m]"""


def rays_of(scan: Scan, sensor: SensorInput) -> np.ndarray:
    """Return the distances (rays,) float32 [m] that a policy's lidar would show: of the beam nearest to each ray.

    A beam without a return, or outside the scanner's range, shows the reach; one that met something too close to be
    measured (-inf) shows the scanner's least range. Where no beam gives any, the scanner is blind, not the hall wide.

    Raises:
        SenseError: the scan is damaged, or does not look where a ray of the policy does.
    """
    ranges, step = np.asarray(scan.ranges, np.float32), scan.angle_increment
    if not (math.isfinite(scan.range_min) and scan.range_min >= 0):
        raise SenseError(f"range_min of the scan is {scan.range_min:g} m; it must be a finite distance. Correct the "
                         "publisher.")
    if not (len(ranges) and math.isfinite(step) and step and math.isfinite(scan.angle_min)):
        raise SenseError(f"scan of {len(ranges)} beams, {step:g} rad apart from {scan.angle_min:g} rad: there must be "
                         "some, at an angle. Correct the publisher.")
    # a wide hall has inf, a hung scanner zeros, also one that states no least range
    if not ((ranges > 0) & (ranges >= scan.range_min) | (ranges == -np.inf)).any():
        raise SenseError(f"scan without a single valid range (all are below {scan.range_min:g} m or no numbers): the "
                         "scanner is blind. Check it.")
    rays, fov = sensor.shape[0], float(sensor.settings.get("fov", FULL_TURN))
    reach = float(sensor.settings.get("reach", REACH))
    angles = fov * ((np.arange(rays) + 0.5) / rays - 0.5)
    index = np.rint((angles - scan.angle_min) / step).astype(int)
    turn = round(FULL_TURN / abs(step))
    if len(ranges) >= turn:  # a scanner that looks around; its first beam may look anywhere
        index %= turn
    unseen = (index < 0) | (index >= len(ranges))
    if unseen.any():
        ends = sorted((scan.angle_min, scan.angle_min + step * (len(ranges) - 1)))
        raise SenseError(f"the scan looks from {ends[0]:.2f} to {ends[1]:.2f} rad, and the policy needs {-fov / 2:.2f} "
                         f"to {fov / 2:.2f}. Take a scanner that sees as much, or train with this one's fov.")
    found = ranges[index]
    near, far = min(scan.range_min, reach), scan.range_max if scan.range_max > 0 else math.inf
    shown = np.where((found >= scan.range_min) & (found <= far), found, reach)
    return np.where(found == -np.inf, near, np.minimum(shown, reach)).astype(np.float32)


def numbers(*values: float) -> np.ndarray:
    """Return finite numbers as (N,) float32.

    Raises:
        SenseError: one of them is not finite, or too large for float32.
    """
    with np.errstate(over="ignore"):
        found = np.array(values, np.float64).astype(np.float32)
    if not np.isfinite(found).all():
        raise SenseError(f"values {', '.join(f'{value:g}' for value in values)} are not all finite. Correct the "
                         "publisher.")
    return found


class Stream:
    """The newest value of one sensor, and whether it is young enough."""

    def __init__(self, sensor: SensorInput, limit: float, stamp_age: float) -> None:
        """Wait for a first value.

        Args:
            sensor: what gives the values.
            limit: seconds after which a value is too old.
            stamp_age: stamps further than this [s] from their receipt are refused.
        """
        self.sensor = sensor
        self.limit = limit
        self.value: np.ndarray | None = None
        self.waits = True
        """Whether no value came since the last step."""
        self.unusable = ""
        """Why the last message could not be used; empty where it could."""
        self.received = -math.inf
        """Steady time of the last message [s], usable or not."""
        self._watch = FrameWatch(self.limit, stamp_age, 5)

    @property
    def is_frozen(self) -> bool:
        """Whether its values stand still although the vehicle moves, as of a camera that hangs."""
        return self._watch.frozen

    def take(self, now: float, stamp: float, stamp_age: float, value: np.ndarray, digest: int, moving: bool) -> None:
        """Take a value; `digest` is a hash that differs from one measurement to the next where the sensor works."""
        self.received = now
        verdict = self._watch.judge(now, stamp, digest, stamp_age, moving)
        self.unusable = "" if verdict == "fresh" else f"its stamps are {verdict} ({stamp_age:.2f} s old)"
        if verdict == "fresh":
            self.value, self.waits = value, False

    def refuse(self, now: float, why: str) -> None:
        """Note a message that gives nothing."""
        self.received, self.unusable = now, why

    def is_silent(self, now: float) -> bool:
        """Return whether the newest value is too old, or there is none."""
        return self.value is None or self._watch.is_silent(now)


class Senses:
    """The sensors of one policy; those beside the pacer are streams."""

    def __init__(self, sensors: Mapping[str, SensorInput], pacer: SensorInput, period: float, supervisor: Supervisor
                 ) -> None:
        """Prepare for the sensors of a policy with this period [s]; the supervisor is held while one is missing."""
        self.pacer, self._supervisor = pacer, supervisor
        stamp_age = supervisor.config.stamp_age
        slower = supervisor.config.frame_age / SafetyConfig.frame_age  # --frame-age, as of a simulator off real time
        self.streams = {name: Stream(one, AGE * max(period, one.age) * slower, stamp_age)
                        for name, one in sensors.items() if name != pacer.name and one.kind != "commands"}
        """By name; not the pacer and what the bridge itself knows."""
        self._sensors = sensors
        self._cameras = [stream for stream in self.streams.values() if stream.sensor.kind == pacer.kind == "camera"]
        self._commands = np.zeros(max((one.shape[0] for one in sensors.values() if one.kind == "commands"), default=0),
                                  np.float32)
        self._origins: dict[str, np.ndarray] = {}
        self._turned: dict[str, float] = {}
        self.watch(0.0)

    @property
    def complete(self) -> bool:
        """Whether each other camera has a new image, so that a step need not wait."""
        return not any(stream.waits for stream in self._cameras)

    def unwrapped(self, name: str, pose: np.ndarray) -> np.ndarray:
        """Return x, y, yaw, v, omega of an odometry whose yaw goes on over a half turn."""
        before = self._turned.get(name, float(pose[2]))
        self._turned[name] = before + math.remainder(float(pose[2]) - before, 2 * math.pi)
        return np.array([pose[0], pose[1], self._turned[name], pose[3], pose[4]])

    def watch(self, now: float) -> None:
        """Hold the vehicle by all that is missing, frozen, or will be too old before the next look."""
        block, soon = self._supervisor.block, now + self._supervisor.config.tick
        for name, stream in self.streams.items():
            block(f"no {name}", stream.value is None)
            block(f"{name} too old", stream.value is not None and stream.is_silent(soon))
            block(f"{name} does not change", stream.is_frozen)

    def observation(self, paced: np.ndarray) -> np.ndarray | dict[str, np.ndarray]:
        """Return what the policy reads now, where its pacer shows `paced`; each stream must have a value."""
        if not self.streams and not len(self._commands) and self.pacer.kind != "odometry":
            return paced
        seen: dict[str, np.ndarray] = {}
        for name, sensor in self._sensors.items():
            if sensor.kind == "commands":
                seen[name] = self._commands[: sensor.shape[0]].copy()
                continue
            value = paced if name == self.pacer.name else self.streams[name].value
            assert value is not None
            seen[name] = self._from_start(name, value) if sensor.kind == "odometry" else value
        for stream in self._cameras:
            stream.waits = True
        return seen

    def begin(self) -> None:
        """Begin an episode: odometry counts from here, and no command was sent."""
        self._origins.clear()
        self._commands[:] = 0

    def sent(self, command: Command) -> None:
        """Remember the command that answered an observation."""
        if len(self._commands):
            self._commands[2:] = self._commands[:-2].copy()
            self._commands[:2] = command.v, command.omega

    def _from_start(self, name: str, pose: np.ndarray) -> np.ndarray:
        """Return an odometry (5,) float32 as seen from where the episode began."""
        origin = self._origins.setdefault(name, pose[:3].copy())
        (dx, dy), yaw = pose[:2] - origin[:2], origin[2]
        ahead, left = dx * math.cos(yaw) + dy * math.sin(yaw), dy * math.cos(yaw) - dx * math.sin(yaw)
        return np.array([ahead, left, pose[2] - yaw, pose[3], pose[4]], np.float32)
