"""Errors of the gyro."""

from __future__ import annotations

from dataclasses import replace

import jax
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import Motion, Odometry, parameter

NO_GYRO = "Fits read no gyro: it shows in the simulated gyro alone, and in `imu.csv` of a drive."


@struct.dataclass
class GyroBias(Effect):
    """omega_gyro -> s omega_gyro + b; the wheel odometry does not change."""

    name = "gyro_bias"
    typical = {"bias": (-0.0175, 0.0175), "scale": (0.99, 1.01)}
    source = "estimate: 0.1 to 1 degree per second"
    card = Card(limits=NO_GYRO, mirrored=("bias",))
    bias: jax.Array = parameter("rad/s", -0.2, 0.2, 0.0, "reading at standstill, b")
    scale: jax.Array = parameter("-", 0.8, 1.2, 1.0, "scale, s")

    def sensing(self, memory: tuple[()], reading: Odometry, motion: Motion) -> tuple[tuple[()], Odometry]:
        """Reading with a wrong gyro."""
        return memory, replace(reading, gyro=self.scale * reading.gyro + self.bias)
