"""Steps of the wheel encoders."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Odometry, parameter

MAKER = {"angle": 0.001, "speed": 0.004 / 3.6}
"""The chair's state message: wheel angle in 0.001 rad, wheel speed in 0.004 km/h."""
TINY = 1e-12  # keeps the division defined at a step of 0


@struct.dataclass
class EncoderResolution(Effect):
    """Wheel angles and speeds rounded to their steps; the odometry is off by what rounding takes from either wheel.

    Rounding does not add up: the pose differs by half a step at most, whatever the distance. Noise, not bias: it shows
    in slow motion only. Not smooth.
    """

    name = "encoder_resolution"
    typical = {"angle": (0.0005, 0.002), "speed": (0.0005, 0.0012)}
    source = "maker's protocol specification, data set 1: 0.001 rad and 0.004 km/h"
    angle: jax.Array = parameter("rad", 0.0, 0.1, 0.0, "step of the wheel angle")
    speed: jax.Array = parameter("m/s", 0.0, 0.05, 0.0, "step of the wheel speed")

    def init(self) -> jax.Array:
        return jnp.zeros(2)  # travel of the left and right wheel [m]

    def sensing(self, memory: jax.Array, reading: Odometry, motion: Motion) -> tuple[jax.Array, Odometry]:
        """Reading in steps."""
        turn = reading.omega * motion.track / 2
        speeds = jnp.stack([reading.v - turn, reading.v + turn])
        travel = memory + speeds * motion.dt
        left, right = _rounded(travel, self.angle * motion.wheel_radius) - travel
        ahead = (left + right) / 2
        left_fast, right_fast = _rounded(speeds, self.speed) - speeds
        return travel, replace(
            reading,
            x=reading.x + ahead * jnp.cos(reading.yaw),
            y=reading.y + ahead * jnp.sin(reading.yaw),
            yaw=reading.yaw + (right - left) / motion.track,
            v=reading.v + (left_fast + right_fast) / 2,
            omega=reading.omega + (right_fast - left_fast) / motion.track,
        )


def _rounded(value: jax.Array, step: jax.Array) -> jax.Array:
    return jnp.where(step > 0, step * jnp.round(value / jnp.maximum(step, TINY)), value)
