"""Effects on the torques that the drives make."""

from __future__ import annotations

import math
from dataclasses import replace

from benchmarks.plant.base import TICK, Effect, Moment
from benchmarks.plant.chair import Chair


class ActuatorLag(Effect):
    """Torque through two first-order lags of s / 2 each."""

    def start(self) -> None:
        self.keep = math.exp(-TICK / (self.size / 2)) if self.size else 0.0
        self.stages = [[0.0, 0.0], [0.0, 0.0]]

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        for stage in self.stages:
            stage[0] = left = left + self.keep * (stage[0] - left)
            stage[1] = right = right + self.keep * (stage[1] - right)
        return left, right


class TorqueSaturation(Effect):
    """Hard limit that falls with wheel speed: limit - s (1 + |w| / 5 rad/s), never below 1 N m."""

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        most = [max(1.0, self.chair.torque_limit - self.size * (1 + abs(spin) / 5)) for spin in moment.spin]
        return min(most[0], max(-most[0], left)), min(most[1], max(-most[1], right))


class SupplySag(Effect):
    """Gain 1 - s (session / 600 s + load): charge spent so far, and both drives' load through a lag of 2 s."""

    def start(self) -> None:
        self.load_now = 0.0

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        wanted = (abs(left) + abs(right)) / (2 * self.chair.torque_limit)
        self.load_now += TICK / 2.0 * (wanted - self.load_now)
        gain = max(0.1, 1 - self.size * (moment.session / 600 + self.load_now))
        return gain * left, gain * right


class DriveGainDifference(Effect):
    """Left torque times 1 + s / 2, right torque times 1 - s / 2."""

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        return (1 + self.size / 2) * left, (1 - self.size / 2) * right


class Backlash(Effect):
    """Rotor and wheel are two bodies, free of each other within +-s; the encoders sit on the wheels."""

    @staticmethod
    def change(chair: Chair, size: float) -> Chair:
        return replace(chair, play=size)


class GainFade(Effect):
    """Gain 1 - s (1 - exp(-t / 8 s)) within each trial: the drives heat up. Not catalogued."""

    def torque(self, moment: Moment, left: float, right: float) -> tuple[float, float]:
        gain = 1 - self.size * (1 - math.exp(-moment.t / 8))
        return gain * left, gain * right
