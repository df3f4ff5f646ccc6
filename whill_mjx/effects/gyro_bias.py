"""Errors of the gyro."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.types import Motion, Odometry, parameter

ALONE = "It shows in the gyro alone, and in `imu.csv` of a drive."


@struct.dataclass
class GyroBias(Effect):
    """omega_gyro -> s omega_gyro + b; the wheel odometry does not change."""

    name = "gyro_bias"
    typical = {"bias": (-0.0175, 0.0175), "scale": (0.99, 1.01)}
    source = "estimate: 0.1 to 1 degree per second"
    card = Card(
        limits=f"{ALONE} Drives with a gyro are fitted with both; an outside pose shows the scale.",
        mirrored=("bias",),
    )
    bias: jax.Array = parameter("rad/s", -0.2, 0.2, 0.0, "reading at standstill, b")
    scale: jax.Array = parameter("-", 0.8, 1.2, 1.0, "scale, s")

    def sensing(self, memory: tuple[()], reading: Odometry, motion: Motion) -> tuple[tuple[()], Odometry]:
        """Reading with a wrong gyro."""
        return memory, replace(reading, gyro=self.scale * reading.gyro + self.bias)

    def turned(self, turn: jax.Array, dt: float) -> jax.Array:
        """Turn (R,) [rad] that the gyro adds up to, of the true one every `dt` [s]: for replays of logs."""
        return self.scale * turn + self.bias * dt * jnp.arange(turn.shape[0])
