"""The contact plant driven as it goes, a command at a time, instead of by a whole table of them.

Effects and sensors are written for whole drives and never look ahead. So what they make of a drive's beginning does not
change when it goes on: targets and reports are computed anew from the start, and the new rows are taken.
"""

from __future__ import annotations

import math

import numpy as np

from benchmarks.plant.base import TICK
from benchmarks.plant.make import Setting, make_effects
from benchmarks.plant.sensors import odometry, outside_pose
from benchmarks.plant.trial import Noise, Plant, wheel_targets

LONGEST = 900.0
"""Seconds of one trial."""
AHEAD = 250
"""Ticks for which targets are computed beyond the newest message."""


class OnlinePlant:
    """One vehicle on one day, which drives trial after trial."""

    def __init__(self, setting: Setting) -> None:
        self.setting = setting
        self.noise = Noise().of(setting.chair).scaled(setting.noise)
        self._plant = Plant(setting.chair, setting.contact)
        self._session = 0.0
        self.place(0)

    def place(self, index: int, start: tuple[float, float, float] | None = None) -> None:
        """Stand at the start of a trial, with the disturbances of its number.

        Args:
            index: of the trial; disturbances, sensor noise and the effects' own chance depend on it.
            start: x, y [m], yaw [rad]; default: the origin, with a heading drawn for the trial.
        """
        seed = self.setting.seed
        if start is None:
            start = (0.0, 0.0, float(np.random.default_rng([seed, 4, index]).uniform(-np.pi, np.pi)))
        self._session += self.t if hasattr(self, "_trial") else 0.0
        self._index = index
        effects = make_effects(self.setting, index)
        random = np.random.default_rng([seed, 2, index])
        longest = round(LONGEST / TICK)
        self._trial = self._plant.begin(longest, start, effects, self.noise, random, self._session)
        self._messages: list[tuple[float, float, float]] = []
        self._known = 0
        self._reported = [0, 0]

    @property
    def t(self) -> float:
        """Seconds since the start of the trial."""
        return self._trial.ticks * TICK

    @property
    def state(self) -> tuple[float, float, float, float, float]:
        """True x, y [m], yaw [rad], forward speed [m/s], yaw rate [rad/s] of the drive-axle centre now."""
        q, w = self._plant.data.qpos, self._plant.data.qvel
        yaw = math.atan2(2 * (q[3] * q[6] + q[4] * q[5]), 1 - 2 * (q[5] ** 2 + q[6] ** 2))
        return float(q[0]), float(q[1]), yaw, float(math.cos(yaw) * w[0] + math.sin(yaw) * w[1]), float(w[5])

    def command(self, t: float, v: float, omega: float) -> None:
        """Take a message: sent at t [s] of the trial, v [m/s], omega [rad/s]; it holds until the next one."""
        before = self._messages[-1][0] if self._messages else -math.inf
        self._messages.append((max(t, before + 1e-6), v, omega))
        self._known = self._trial.ticks

    def advance(self, ticks: int) -> None:
        """Drive for so many ticks.

        Raises:
            ValueError: the trial lasts longer than LONGEST, or the motion is no longer finite.
        """
        trial, end = self._trial, self._trial.ticks + ticks
        if end > len(trial.target):
            raise ValueError(f"the trial lasts longer than {LONGEST:g} s. Place the vehicle for a new one.")
        if end > self._known and self._messages:
            self._known = min(end + AHEAD, len(trial.target))
            times = np.arange(self._known) * TICK
            effects = make_effects(self.setting, self._index)
            target = wheel_targets(self.setting.chair, np.array(self._messages), times, effects)
            trial.target[trial.ticks:self._known] = target[trial.ticks:]
        self._plant.advance(trial, ticks)
        if not np.isfinite(self._plant.data.qpos).all():
            raise ValueError(f"the motion became non-finite with {dict(self.setting.effects)}. Use smaller sizes.")

    def reports(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows since the last call: odometry (M, 6) t, x, y, yaw, v, omega and outside pose (L, 4) t, x, y, yaw."""
        drive = self._trial.record(self._plant)
        reading = np.random.default_rng([self.setting.seed, 3, self._index])
        pose_reading = np.random.default_rng([self.setting.seed, 6, self._index])
        effects = make_effects(self.setting, self._index)
        rows = odometry(drive, effects, self.noise, reading)
        poses = outside_pose(drive, self.noise, pose_reading)
        new = rows[self._reported[0]:], poses[self._reported[1]:]
        self._reported = [len(rows), len(poses)]
        return new
