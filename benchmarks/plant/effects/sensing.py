"""Effects on what is reported."""

from __future__ import annotations

import numpy as np

from benchmarks.plant.base import Effect


class OdometryScale(Effect):
    """The odometry assumes a radius larger by s: pose and speeds, forward and in yaw, grow alike."""

    def scale(self) -> float:
        return 1 + self.size


class SensorDelay(Effect):
    """A report is s old when it is stamped, give or take a quarter of s of its own."""

    def stamps(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        age = self.size * (1 + 0.25 * self.random.uniform(-1, 1, len(t)))
        return np.maximum.accumulate(t - age), t


class ClockOffset(Effect):
    """The odometry's clock is ahead by s at the start of a trial, and by one percent of s more each second."""

    def stamps(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return t, t + self.size * (1 + t / 100)
