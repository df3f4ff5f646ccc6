"""Range and steps of the gyro."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, in_steps
from whill_mjx.effects.card import Card
from whill_mjx.effects.gyro_bias import ALONE
from whill_mjx.vehicle.types import Motion, Odometry, parameter

MAKER = {"limit": 2.1817, "step": 4.375e-3 * 0.017453293}
"""The chair's gyro (LSM6DS3): +-125 degrees/s in steps of 4.375 millidegrees/s."""


@struct.dataclass
class GyroRange(Effect):
    """omega_gyro -> rounded to its step and clipped to its range; the wheel odometry does not change."""

    name = "gyro_range"
    typical = {"limit": (2.1, 4.4), "step": (7e-5, 1.6e-4)}
    source = "maker's protocol specification: +-125 degrees/s, 4.375 millidegrees/s"
    card = Card(stepped=True, limits=f"{ALONE} Replays of logs leave it out.")
    limit: jax.Array = parameter("rad/s", 0.1, 40.0, float("inf"), "largest rate that is reported")
    step: jax.Array = parameter("rad/s", 0.0, 0.05, 0.0, "step of the rate")

    def sensing(self, memory: tuple[()], reading: Odometry, motion: Motion) -> tuple[tuple[()], Odometry]:
        """Reading with the gyro's rate as its converter reports it."""
        stepped = in_steps(jnp.asarray(reading.gyro), self.step)
        return memory, replace(reading, gyro=jnp.minimum(jnp.maximum(stepped, -self.limit), self.limit))
