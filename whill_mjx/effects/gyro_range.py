"""Range and steps of the gyro."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Odometry, parameter

MAKER = {"limit": 2.1817, "step": 4.375e-3 * 0.017453293}
"""The chair's gyro (LSM6DS3): +-125 degrees/s in steps of 4.375 millidegrees/s."""
TINY = 1e-12  # keeps the division defined at a step of 0


@struct.dataclass
class GyroRange(Effect):
    """omega_gyro -> rounded to its step and cut off at its range; the wheel odometry is not touched."""

    name = "gyro_range"
    typical = {"limit": (2.1, 4.4), "step": (7e-5, 1.6e-4)}
    source = "maker's protocol specification: +-125 degrees/s, 4.375 millidegrees/s"
    limit: jax.Array = parameter("rad/s", 0.1, 40.0, float("inf"), "largest rate that is reported")
    step: jax.Array = parameter("rad/s", 0.0, 0.05, 0.0, "step of the rate")

    def sensing(self, memory: tuple[()], reading: Odometry, motion: Motion) -> tuple[tuple[()], Odometry]:
        """Reading with the gyro's rate as its converter gives it."""
        gyro = jnp.asarray(reading.gyro)
        stepped = jnp.where(self.step > 0, self.step * jnp.round(gyro / jnp.maximum(self.step, TINY)), gyro)
        return memory, replace(reading, gyro=jnp.minimum(jnp.maximum(stepped, -self.limit), self.limit))
