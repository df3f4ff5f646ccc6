"""Steps of the wheel encoders."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect, in_steps
from whill_mjx.effects.card import Card
from whill_mjx.vehicle.kinematics import wheel_speeds
from whill_mjx.vehicle.types import Motion, Odometry, parameter

MAKER = {"angle": 0.001, "speed": 0.004 / 3.6}
"""The chair's state message: wheel angle in 0.001 rad, wheel speed in 0.004 km/h."""


@struct.dataclass
class EncoderResolution(Effect):
    """Wheel angles and speeds are rounded to their steps; the odometry carries the rounding error of both wheels.

    Errors do not add up: the pose differs by half a step at most, at any distance. It is noise, not bias, and shows
    only in slow motion. Not smooth.
    """

    name = "encoder_resolution"
    typical = {"angle": (0.0005, 0.002), "speed": (0.0005, 0.0012)}
    source = "maker's protocol specification, data set 1: 0.001 rad and 0.004 km/h"
    card = Card(stepped=True)
    angle: jax.Array = parameter("rad", 0.0, 0.1, 0.0, "step of the wheel angle")
    speed: jax.Array = parameter("m/s", 0.0, 0.05, 0.0, "step of the wheel speed")

    def init(self) -> jax.Array:
        return jnp.zeros(2)  # travel of the left and right wheel [m]

    def sensing(self, memory: jax.Array, reading: Odometry, motion: Motion) -> tuple[jax.Array, Odometry]:
        """Reading in steps."""
        speeds = wheel_speeds(jnp.stack([reading.v, reading.omega]), motion.track)
        travel = memory + speeds * motion.dt
        left, right = in_steps(travel, self.angle * motion.wheel_radius) - travel
        ahead = (left + right) / 2
        left_fast, right_fast = in_steps(speeds, self.speed) - speeds
        return travel, replace(
            reading,
            x=reading.x + ahead * jnp.cos(reading.yaw),
            y=reading.y + ahead * jnp.sin(reading.yaw),
            yaw=reading.yaw + (right - left) / motion.track,
            v=reading.v + (left_fast + right_fast) / 2,
            omega=reading.omega + (right_fast - left_fast) / motion.track,
        )
