"""Low-pass of the reported speeds."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from whill_mjx.effects.base import Effect
from whill_mjx.vehicle.types import Motion, Odometry, parameter


@struct.dataclass
class OdometryLag(Effect):
    """First-order low-pass of the reported v and omega; the pose comes from encoder counts and is not filtered.

    Source: the maker's driver documentation, which advises to use angle and counter instead of the filtered speed.
    """

    name = "odometry_lag"
    typical = {"time_constant": (0.02, 0.1)}
    source = "maker's driver documentation: the motor speed is low-pass filtered"
    time_constant: jax.Array = parameter("s", 0.0, 0.3, 0.0, "time constant of the low-pass")

    def init(self) -> jax.Array:
        return jnp.zeros(2)  # filtered v and omega

    def sensing(self, memory: jax.Array, reading: Odometry, motion: Motion) -> tuple[jax.Array, Odometry]:
        """Reading with filtered v and omega."""
        raw = jnp.stack([reading.v, reading.omega])
        filtered = raw + (memory - raw) * self.time_constant / (self.time_constant + motion.dt)
        return filtered, replace(reading, v=filtered[0], omega=filtered[1])
